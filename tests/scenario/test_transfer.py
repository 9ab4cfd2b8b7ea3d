"""Values tuned in simulation or on some recorded runs, run on others: the scenario, the tables."""

from __future__ import annotations

import json
from pathlib import Path
from types import ModuleType

import pytest
import torch

import difffilter as df
from difffilter.reports.report import Report

RUNS = ("los_A1", "los_A2", "nlos_A1", "nlos_A2")


@pytest.fixture(scope="module")
def tables() -> ModuleType:
    """The experiment's own tables."""
    from training.uwb import claims, figures, scores, tables

    merged = ModuleType("tables")
    for part in (tables, claims, figures, scores):
        vars(merged).update({name: x for name, x in vars(part).items() if name[0] != "_"})
    return merged


@pytest.fixture(scope="module")
def stage() -> ModuleType:
    """What tunes and runs."""
    from training.uwb import transfer

    return transfer


def scored(tables: ModuleType, simulated: float, nees: float, single: float = 0.8) -> dict:
    """All values alike but those tuned in simulation and those tuned on los_A1."""
    scores = {}
    for run in RUNS:
        scores |= {(name, run): tables.Score(0.8, 1.0) for name in tables.ORDER}
        scores[tables.HAND, run] = tables.Score(1.0, 12.0)
        scores[tables.SIMULATED, run] = tables.Score(simulated, nees)
    scores["los_A1", "los_A2"] = tables.Score(single, 1.0)
    return scores


def test_the_simulated_world_keeps_what_the_recorded_one_assumes() -> None:
    made, recorded = df.load_scenario("uwb-simulated"), df.load_scenario("uwb-ranges")
    assert made.world is not None
    assert made.declarations() == recorded.declarations()
    assert (
        made.document["sensors"]["range"]["stations"]
        == (recorded.document["sensors"]["range"]["stations"])
    )
    for key in ("start", "motion", "score"):
        assert made.document[key] == recorded.document[key]
    for name, spec in recorded.systems.items():
        assert made.system(name).declarations == recorded.system(name).declarations
        assert made.systems[name].options["weight"] == spec.options["weight"]
    assert made.tuning.loss == recorded.tuning.loss
    assert made.tuning.system == recorded.tuning.system


def test_the_simulated_world_is_of_the_kind_that_is_described() -> None:
    scenario = df.load_scenario("uwb-simulated")
    log = df.simulate(scenario, 40, 3)
    stations = torch.tensor(scenario.document["sensors"]["range"]["stations"])[:, :2]
    apart = (log.truth[..., None, :2] - stations).norm(dim=-1).amin(-1)
    assert 3.0 < float(apart.min()) < 5.0
    assert 30.0 < float(apart.amax(0).median()) < 50.0
    assert 0.05 < float(log.z.isnan().double().mean()) < 0.2
    assert float(log.inputs["fault.mean"].min()) == 0.0


def test_bursts_that_last_longer_are_as_frequent_in_all(stage: ModuleType) -> None:
    world = df.load_scenario("uwb-simulated")
    longer = world.with_overrides(stage.lasting(world))
    changed = {n for n, fault in longer.faults.items() if fault != world.faults[n]}
    assert changed == {"nlos-weak", "nlos-strong", "body"}
    for name in changed:
        before, after = world.faults[name], longer.faults[name]
        assert after.duration == 5 * before.duration
        assert after.probability * after.duration == pytest.approx(
            before.probability * before.duration
        )


@pytest.mark.parametrize(("share", "expected"), [(0.0, 0.0), (1.0, 1.0), (0.5, 0.5)])
def test_range_errors_are_taken_without_wild_ones(
    stage: ModuleType, share: float, expected: float
) -> None:
    scenario = df.load_scenario("uwb-simulated")
    clean = {f"faults.{name}.probability": 0.0 for name in scenario.faults}
    log = df.simulate(scenario.with_overrides(clean), 4, 1)
    generator = torch.Generator().manual_seed(5)
    stations = torch.tensor(scenario.document["sensors"]["range"]["stations"], dtype=log.z.dtype)
    tag = torch.cat([log.truth[..., :2], torch.ones_like(log.truth[..., :1])], dim=-1)
    exact = (tag.unsqueeze(-2) - stations).norm(dim=-1)
    # Slow errors: one period per two of the lags, so that the lag's own correlation is 1.
    slow = torch.sin(2 * torch.pi * torch.arange(log.steps) / 10).to(exact)[:, None, None]
    white = torch.randn(exact.shape, generator=generator, dtype=exact.dtype)
    z = exact + 0.1 * (share**0.5 * 2**0.5 * slow + (1 - share) ** 0.5 * white)
    z[::50] += 25.0
    z[7::11] = torch.nan
    found = stage.range_errors(type(log)(**(vars(log) | {"z": z})), scenario)
    assert found.deviation == pytest.approx(0.1, rel=0.02)
    assert found.correlation == pytest.approx(expected, abs=0.03)


def test_a_set_of_values_is_in_sample_on_the_runs_that_it_was_tuned_on(tables: ModuleType) -> None:
    inside = {(name, run) for name in tables.ORDER for run in RUNS if tables.own(name, run)}
    assert inside == {(run, run) for run in RUNS} | {
        ("both LOS", "los_A1"), ("both LOS", "los_A2"),
        ("both NLOS", "nlos_A1"), ("both NLOS", "nlos_A2"),
    }  # fmt: skip


def test_the_table_has_every_set_on_every_run(tables: ModuleType) -> None:
    rows = tables.transfer_rows(scored(tables, 1.2, 2.0))
    assert [(row[0], row[1]) for row in rows] == [(r, n) for r in RUNS for n in tables.ORDER]
    assert all(row[3] == row[2] / 1.0 for row in rows)
    assert rows[0] == ["los_A1", tables.SIMULATED, 1.2, 1.2, 2.0, ""]


@pytest.mark.parametrize(
    ("simulated", "nees", "single", "held"),
    [
        (1.0, 1.0, 0.8, [True, True, True]),
        (1.2, 1.0, 0.8, [False, True, True]),
        (1.0, 9.0, 0.8, [True, False, True]),
        (1.0, 0.2, 0.8, [True, False, True]),
        (1.0, 1.0, 1.2, [True, True, False]),
    ],
)
def test_the_claims_follow_the_numbers(
    tables: ModuleType,
    tmp_path: Path,
    simulated: float,
    nees: float,
    single: float,
    held: list[bool],
) -> None:
    report = Report(tmp_path, "transfer")
    tables.judge_transfer(report, scored(tables, simulated, nees, single))
    report.write()
    claims = json.loads((tmp_path / "report.json").read_text())["claims"]
    assert [claim["held"] for claim in claims] == held


@pytest.mark.parametrize(
    ("simulated", "nees", "correlation", "process", "words"),
    [
        (1.2, 1.0, 0.3, 1.0, ["is honest", "costs accuracy", "whiter than", "smooths more than"]),
        (
            1.0,
            9.0,
            0.9,
            9.0,
            ["is overconfident", "costs little or no", "about as", "no more"],
        ),
        (1.0, 0.3, 0.9, 9.0, ["is too cautious", "costs little or no", "about as", "no more"]),
    ],
)
def test_the_words_follow_the_numbers(
    tables: ModuleType,
    simulated: float,
    nees: float,
    correlation: float,
    process: float,
    words: list[str],
) -> None:
    errors = {run: tables.Errors(0.17, 0.88) for run in RUNS}
    errors |= {tables.SIMULATED: tables.Errors(0.2, correlation)}
    errors |= {tables.LASTING: tables.Errors(0.2, 0.6)}
    q = dict.fromkeys(tables.ORDER, 8.0) | {tables.SIMULATED: process}
    text = tables.finding(scored(tables, simulated, nees), q, 1.1, errors)
    for part in words:
        assert part in text


def test_the_matrix_has_a_number_in_each_cell_and_frames_the_in_sample_ones(
    tables: ModuleType,
) -> None:
    numbers = {key: score.nees for key, score in scored(tables, 1.2, 2.0).items()}
    (ax,) = tables.matrix_figure(numbers).axes
    shown = [text.get_text() for text in ax.texts]
    assert len(shown) == len(tables.ORDER) * len(RUNS)
    assert shown[:4] == ["2.00"] * 4
    assert shown.count("12") == 4
    assert sum(text.get_bbox_patch() is not None for text in ax.texts) == 8
