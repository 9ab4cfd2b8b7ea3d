"""Losses: values, what they punish, and gradients that no missing row can spoil."""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import replace

import numpy as np
import pytest
import torch
from helpers import tensor
from run_cases import FILTERS, airport_log
from torch import Tensor

from difffilter.errors import InputError
from difffilter.logs.log import Log, Rows
from difffilter.logs.track import Track
from difffilter.parameters.parameters import Values
from difffilter.running.batch import run
from difffilter.running.objectives import Problem, sum_losses
from difffilter.scenario.table import Table
from difffilter.scenario.tuning import read_tuning
from difffilter.scoring.differences import scored_rows
from difffilter.scoring.losses import LOSSES, LossContext, total_loss
from difffilter.scoring.losses import loss as register
from difffilter.scoring.metrics import nees, nees_states, nis_per_channel, position_error, rmse
from difffilter.tuning.curvature import known

BARE = airport_log(25, 4, seed=8)
TRACK = run(FILTERS["m-ekf"], BARE)
#: Squared errors of another filter: in the first scene better, in the second worse.
REFERENCE = (
    position_error(BARE, TRACK) * torch.cat([tensor([0.8] * 10), tensor([2.0] * 15)])[:, None]
)
LOG = replace(BARE, inputs={"reference.squared": REFERENCE})
CONTEXT = LossContext(scenes=((1, 10), (11, 25)))
NAN = torch.nan


def loss(name: str, track: Track = TRACK, log: Log = LOG, context: LossContext = CONTEXT) -> Tensor:
    return LOSSES[name](track, log, context)


def test_position_is_the_log_of_the_mean_square() -> None:
    assert float(loss("position")) == pytest.approx(2 * math.log(float(rmse(LOG, TRACK))))
    context = LossContext(score="measured")
    expected = 2 * math.log(float(rmse(LOG, TRACK, "measured")))
    assert float(loss("position", context=context)) == pytest.approx(expected)
    assert expected != pytest.approx(float(loss("position")))


def test_likelihood_is_students_density_of_the_nominal_innovations() -> None:
    record = TRACK.record
    assert record is not None
    for degrees in (3.0, 10.0):
        scale = record.innovation_variance.sqrt()
        density = torch.distributions.StudentT(tensor(degrees), tensor(0.0), scale)
        expected = -density.log_prob(record.innovation)[record.present].mean()
        found = loss("likelihood", context=LossContext(degrees=degrees))
        assert float(found) == pytest.approx(float(expected), rel=1e-12)


def test_rejecting_everything_does_not_raise_the_likelihood() -> None:
    """Clipping points far below the noise: all weights go to 0, the nominal S stays."""
    blind = {"tanh.ab": tensor([1e-4, 2e-4])}
    rejecting = run(FILTERS["m-ekf"], LOG, blind)
    assert rejecting.record is not None
    assert float(rejecting.record.weight.mean()) < 0.01
    assert float(loss("likelihood", rejecting)) > float(loss("likelihood")) + 0.1


def test_the_likelihood_reads_no_weight() -> None:
    record = TRACK.record
    assert record is not None
    nothing = record._replace(
        weight=torch.zeros_like(record.weight), gate=torch.zeros_like(record.gate)
    )
    assert torch.equal(loss("likelihood", replace(TRACK, record=nothing)), loss("likelihood"))


def scaled(track: Track, factor: float) -> Track:
    return replace(track, deviations=track.deviations * factor**0.5)


def test_consistency_is_zero_where_the_nees_per_state_is_one() -> None:
    per_state = float(nees(LOG, TRACK).mean() / nees_states(LOG, TRACK))
    honest = scaled(TRACK, per_state)
    assert float(loss("consistency", honest)) == pytest.approx(0.0, abs=1e-12)
    for factor in (0.2, 0.8, 1.25, 5.0):
        found = float(loss("consistency", scaled(honest, factor)))
        assert found == pytest.approx(math.sqrt(1 + math.log(factor) ** 2) - 1, rel=1e-9)


def test_direction_consistency_is_the_departure_along_each_direction() -> None:
    """Against the eigenvectors of NumPy, on what was known of every row."""
    names = ["x", "y"]
    p = TRACK.covariance[..., :2, :2].numpy()
    values, vectors = np.linalg.eigh(p)
    error = (TRACK.mean[..., TRACK.named(names)] - LOG.truth[..., :2]).numpy()  # type: ignore[index]
    along = np.einsum("...ij,...i->...j", vectors, error) ** 2 / values
    rows = scored_rows(LOG, TRACK).numpy()
    means = along[rows].mean(0)
    expected = (np.sqrt(1.0 + np.log(means) ** 2) - 1.0).sum()
    assert float(loss("direction-consistency", TRACK)) == pytest.approx(expected, rel=1e-9)


def test_innovation_consistency_is_zero_where_the_nis_per_channel_is_one() -> None:
    record = TRACK.record
    assert record is not None
    per_channel = float(nis_per_channel(TRACK))

    def divided(by: float) -> Track:
        return replace(TRACK, record=record._replace(innovation=record.innovation / by**0.5))

    assert float(loss("innovation-consistency", divided(per_channel))) < 1e-12
    found = float(loss("innovation-consistency", divided(3.0 * per_channel)))
    assert found == pytest.approx(math.sqrt(1 + math.log(3.0) ** 2) - 1, rel=1e-9)


def gradients(name: str, log: Log, temperature: float | None = 0.3) -> list[Tensor]:
    filter = FILTERS["m-ekf"]
    values: Values = {k: v.requires_grad_() for k, v in filter.published().items()}
    track = run(filter, log, values, temperature=temperature)
    total = loss(name, track, log)
    return list(torch.autograd.grad(total, list(values.values())))


def same(found: list[Tensor], expected: list[Tensor]) -> bool:
    return all(
        torch.allclose(a, b, rtol=1e-9, atol=1e-12) for a, b in zip(found, expected, strict=True)
    )


#: Losses of one world; the other is tested in tuning/test_tune_worlds.py.
ALONE = [name for name in LOSSES if name != "worlds"]


@pytest.mark.parametrize("name", ALONE)
def test_missing_truth_and_padding_never_count_and_never_spoil_a_gradient(name: str) -> None:
    assert LOG.truth is not None
    assert LOG.start is not None
    tail = 6
    short = LOG.rows(0, LOG.steps - tail)
    padded = replace(
        LOG,
        time=torch.cat([short.time, short.time[-1:].expand(tail)]),
        z=torch.cat([short.z, torch.full_like(LOG.z[-tail:], NAN)]),
        truth=torch.cat([short.truth, torch.full_like(LOG.truth[-tail:], NAN)]),  # type: ignore[list-item]
    )
    found, expected = gradients(name, padded), gradients(name, short)
    assert all(bool(g.isfinite().all()) for g in found)
    assert same(found, expected)


@pytest.mark.parametrize("name", [n for n in ALONE if LOSSES[n].needs_truth])
def test_a_row_without_truth_is_left_out(name: str) -> None:
    assert LOG.truth is not None
    truth = LOG.truth.clone()
    truth[4:9, 1] = NAN
    truth[12, 2, 1] = NAN
    log = replace(LOG, truth=truth)
    wild = replace(LOG, truth=truth.nan_to_num(1e6))
    assert all(bool(g.isfinite().all()) for g in gradients(name, log))
    assert float(loss(name, log=log)) != float(loss(name, log=wild))
    mean = TRACK.mean.clone()
    mean[4:9, 1] += 50.0
    assert float(loss(name, replace(TRACK, mean=mean), log)) == float(loss(name, TRACK, log))


@pytest.mark.parametrize("name", ALONE)
def test_every_loss_has_a_gradient_towards_the_noise(name: str) -> None:
    sigma = list(FILTERS["m-ekf"].declarations).index("tdoa.sigma")
    assert float(gradients(name, LOG)[sigma]) != 0.0


def test_losses_without_truth_need_none() -> None:
    bare = replace(LOG, truth=None, truth_states=())
    for name, one in LOSSES.items():
        if one.needs_truth:
            with pytest.raises(InputError, match=f"loss {name}: needs truth.*without: likelihood"):
                total_loss({name: 1.0}, TRACK, bare, CONTEXT)
        else:
            total, _ = total_loss({name: 1.0}, TRACK, bare, CONTEXT)
            assert float(total) == pytest.approx(float(loss(name)))


def test_the_total_is_the_weighted_sum_of_its_terms() -> None:
    weights = {"position": 1.0, "likelihood": 0.25, "consistency": 2.0}
    total, terms = total_loss(weights, TRACK, LOG, CONTEXT)
    expected = sum(weights[name] * float(loss(name)) for name in weights)
    assert float(total) == pytest.approx(expected, rel=1e-12)
    assert {name: float(term) for name, term in terms.items()} == {
        name: float(loss(name)) for name in weights
    }


def test_unknown_losses_and_estimators_without_records_are_refused() -> None:
    with pytest.raises(InputError, match="loss: found 'rmse', expected one of position"):
        total_loss({"rmse": 1.0}, TRACK, LOG, CONTEXT)
    bare = replace(TRACK, record=None)
    for name in ("likelihood", "innovation-consistency"):
        with pytest.raises(InputError, match=f"{name}: expected a filter with records"):
            total_loss({name: 1.0}, bare, LOG, CONTEXT)


def by_hand(
    errors: list[float], reference: list[float], scenes: tuple[tuple[int, int], ...]
) -> float:
    """Loss ``scenes`` of made-up errors along x: one trajectory, one row per error."""
    steps = len(errors)
    log = replace(
        BARE.rows(0, steps).select([0]),
        truth=torch.zeros(steps, 1, 4).double(),
        inputs={"reference.squared": tensor(reference).square()[:, None]},
    )
    mean = torch.zeros(steps, 1, 4).double()
    mean[:, 0, 0] = tensor(errors)
    track = replace(TRACK, mean=mean, deviations=TRACK.deviations[:steps, :1], record=None)
    return float(loss("scenes", track, log, LossContext(scenes=scenes)))


def test_scenes_is_the_mean_log_rmse_of_the_scenes() -> None:
    """Whatever the scenes' scale and length: each counts alike."""
    scenes = ((1, 2), (3, 7))
    errors, reference = [3.0, -3.0] + [0.1] * 5, [6.0] * 2 + [0.4] * 5
    expected = 0.5 * (math.log(3.0) + math.log(0.1))
    assert by_hand(errors, reference, scenes) == pytest.approx(expected, rel=1e-12)
    assert by_hand([0.5 * e for e in errors], reference, scenes) == pytest.approx(
        expected - math.log(2.0), rel=1e-12
    )
    mixed = by_hand([3.0, 4.0], [10.0, 10.0], ((1, 2),))
    assert mixed == pytest.approx(0.5 * math.log(12.5), rel=1e-12)


def test_a_scene_that_gets_worse_pays_and_one_that_gets_better_is_not_paid() -> None:
    """Hinge 2 log(RMSE / reference) on each scene that is worse, 0 on the others."""
    scenes, reference = ((1, 2), (3, 4)), [2.0] * 4
    expected = 0.5 * (math.log(3.0) + math.log(0.5)) + 2.0 * math.log(1.5)
    assert by_hand([3.0, 3.0, 0.5, 0.5], reference, scenes) == pytest.approx(expected, rel=1e-12)
    both = 0.5 * (math.log(3.0) + math.log(4.0)) + 2.0 * (math.log(1.5) + math.log(2.0))
    assert by_hand([3.0, 3.0, 4.0, 4.0], reference, scenes) == pytest.approx(both, rel=1e-12)
    # A gain that is paid for with the same factor elsewhere is a loss.
    traded = by_hand([1.0, 1.0, 4.0, 4.0], reference, scenes)
    assert traded > by_hand([2.0] * 4, reference, scenes) + 1.0


def test_scenes_needs_scenes_and_the_reference_of_whole_trajectories() -> None:
    message = r"loss scenes: needs a scenario with \[\[scenes\]\], whole trajectories"
    with pytest.raises(InputError, match=message):
        loss("scenes", context=LossContext())
    with pytest.raises(InputError, match=message):
        loss("scenes", log=BARE)


@pytest.fixture
def only_known_losses() -> Iterator[None]:
    """Take back what a test registers."""
    names = set(LOSSES)
    yield
    for name in set(LOSSES) - names:
        LOSSES.remove(name)


@pytest.mark.usefixtures("only_known_losses", "quick_compiler")
@pytest.mark.parametrize("engine", ["torch", "fused"])
def test_a_loss_of_ones_own_is_one_registration(engine: str) -> None:
    """Squares of what the name says, in either engine, with the curvature of its squares."""

    @register("along", squares=True, needs_truth=True, meaning="log of mean squared error in x")
    def along(track: Track, log: Rows, context: LossContext) -> Tensor:
        assert log.truth is not None
        return track.mean[..., :1] - log.truth[..., :1]

    filter = FILTERS["ekf"]
    values = {n: v.requires_grad_() for n, v in filter.published().items()}
    found = sum_losses(Problem(filter, LOG, {"along": 1.0}, engine=engine), values)
    assert LOG.truth is not None
    error = (run(filter, LOG, engine="torch").mean[..., 0] - LOG.truth[..., 0]).numpy()
    squares = (error**2).sum(0)
    assert found.values[:, 0].detach().numpy() == pytest.approx(squares, rel=1e-9)
    assert found.values[:, 1].tolist() == [LOG.steps] * LOG.trajectories
    total = float(LOSSES["along"].value(found.values.sum(0)).detach())
    assert total == pytest.approx(math.log((error**2).mean()), rel=1e-9)
    assert float(found.gram.diagonal(dim1=-2, dim2=-1).sum()) > 0.0
    assert known({"along": 1.0})
    assert known({"along": 1.0, "consistency": 1.0})
    assert not known({"along": 1.0, "likelihood": 1.0})
    assert read_tuning(Table({"loss": {"along": 2.0}}, "here"), ("a",)).loss == {"along": 2.0}


@pytest.mark.parametrize("name", ["position", "consistency"])
def test_an_exact_fit_is_no_error(name: str) -> None:
    """The smallest loss there is, and no gradient; only rows that do not count are refused."""
    sums = torch.tensor([0.0, 12.0], dtype=torch.float64, requires_grad=True)
    value = LOSSES[name].value(sums)
    value.backward()
    assert math.isfinite(float(value.detach()))
    assert sums.grad is not None
    assert sums.grad.tolist() == [0.0, 0.0]
    assert math.isnan(float(LOSSES[name].value(tensor([0.0, 0.0]))))
