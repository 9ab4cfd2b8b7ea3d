"""The experiments run from end to end, at small sizes, on the public interface alone."""

import ast
import importlib
import json
import subprocess
import sys
from pathlib import Path

import pytest

import difffilter as df

ROOT = Path(__file__).resolve().parents[2]
TRAINING = ROOT / "training"
SCRIPTS = sorted((*TRAINING.rglob("*.py"), *(ROOT / "docs" / "make").glob("*.py")))
UWB = ROOT.parent / "shared" / "data" / "uwb_ranges"
PUBLIC = {
    "difffilter",
    "difffilter.reports.page",
    "difffilter.reports.report",
    "difffilter.scoring.metrics",
    "difffilter.files",
    "difffilter.comparison.optimality",
    "difffilter.adaptation.trust",
    "difffilter.verdict",
    "difffilter.verdict.guarantee",
    "difffilter.verdict.judge",
    "difffilter.scoring.differences",
}


def run_quick(script: str, out: Path) -> dict:
    """Run an experiment with --quick; returns its report.json."""
    command = [sys.executable, "-m", script, "--quick", "--quiet", "--out", str(out)]
    done = subprocess.run(command, capture_output=True, text=True, check=False, cwd=ROOT)
    assert done.returncode == 0, done.stderr
    return json.loads((out / "report.json").read_text())


def test_the_airport_experiment_runs_and_leaves_reports_figures_and_checkpoints(
    tmp_path: Path,
) -> None:
    report = run_quick("training.airport.run", tmp_path)
    assert len(report["tables"]["reference values"]) == 30
    assert len(report["comparisons"]) == 3
    for figure in report["figures"]:
        assert (tmp_path / f"{figure['name']}.png").stat().st_size > 10_000
        assert (tmp_path / f"{figure['name']}.svg").is_file()
    for stem in ("airport-mlat", "airport-mlat-intermittent", "airport-mlat-literal-50ns"):
        assert df.load(tmp_path / f"{stem}.json").system == "m-ekf"


def test_the_bearing_experiment_runs_and_leaves_reports_figures_and_checkpoints(
    tmp_path: Path,
) -> None:
    report = run_quick("training.bearing.run", tmp_path)
    for name in ("airborne-bearing", "airborne-bearing-clean"):
        rows = report["tables"][f"curves, {name}"]
        assert {row["system"] for row in rows} == {
            "ls", "weighted-ls", "ekf", "robust", "robust-noise", "gated", "clairvoyant",
        }  # fmt: skip
        assert [row["from"] for row in rows].count("reference") == 4
    assert {f"figure-{number}" for number in (2, 3, 4)} | {"lock-out"} <= {
        figure["name"] for figure in report["figures"]
    }
    for figure in report["figures"]:
        assert (tmp_path / f"{figure['name']}.png").stat().st_size > 10_000
        assert (tmp_path / f"{figure['name']}.svg").is_file()
    for stem in ("airborne-bearing", "airborne-bearing-clean", "airborne-bearing-multipath"):
        tuned = df.load(tmp_path / f"{stem}.json")
        assert (tuned.system, tuned.scenario.name) == ("gated", stem)
        assert tuned.values["start.sigma"][2:].tolist() == [0.0, 0.0]


def test_the_urban_experiment_runs_and_leaves_reports_figures_and_checkpoints(
    tmp_path: Path,
) -> None:
    report = run_quick("training.urban.run", tmp_path)
    rows = report["tables"]["table 1"]
    assert [row["algorithm"] for row in rows if row["from"] == "paper"] == [
        "standard",
        "credibility",
        "ideal",
    ]
    here = {row["algorithm"] for row in rows if row["from"] == "here"}
    assert here == {"standard", "credibility", "ideal", "tuned mapping alone", "tuned"}
    names = {figure["name"] for figure in report["figures"]}
    assert {"figure-3-trust-traps", "figure-4-errors", "fsp-surface"} <= names
    for figure in report["figures"]:
        assert (tmp_path / f"{figure['name']}.png").stat().st_size > 10_000
        assert (tmp_path / f"{figure['name']}.svg").is_file()
    tuned = df.load(tmp_path / "urban-credibility.json")
    assert (tuned.system, tuned.scenario.name) == ("credibility", "urban-credibility")


def test_the_manoeuvre_experiment_runs_and_leaves_reports_figures_and_checkpoints(
    tmp_path: Path,
) -> None:
    report = run_quick("training.manoeuvre.run", tmp_path)
    rows = report["tables"]["reference"]
    assert [row["system"] for row in rows if row["from"] == "reference"] == [
        "srckf", "robust-srckf", "lcasrckf", "stf-srckf", "rmckf", "fusion",
    ]  # fmt: skip
    assert len([row for row in rows if row["from"] == "here"]) == 12
    assert len(report["tables"]["tuned"]) == 4
    assert {row["system"] for row in report["tables"]["equal terms"]} >= {"fusion", "pooled-robust"}
    assert len(report["claims"]) == 9
    names = {figure["name"] for figure in report["figures"]}
    assert names == {"figure-2-track", *(f"figure-{number}" for number in range(3, 9))}
    for name in names:
        assert (tmp_path / f"{name}.png").stat().st_size > 10_000
        assert (tmp_path / f"{name}.svg").is_file()
    for stem in ("manoeuvre-fusion-1", "manoeuvre-fusion-2"):
        tuned = df.load(tmp_path / f"{stem}.json")
        assert (tuned.system, tuned.scenario.name) == ("fusion", stem)
        assert {"matching.beta", "correction.lambda", "r.sigma"} <= set(tuned.values)


@pytest.mark.skipif(not UWB.is_dir(), reason="no UWB recordings in ../shared/data/uwb_ranges")
def test_the_uwb_experiment_runs_all_four_rotations(tmp_path: Path) -> None:
    report = run_quick("training.uwb.run", tmp_path)
    rows = report["tables"]["held-out runs"]
    assert {row["run"] for row in rows} == {"los_A1", "los_A2", "nlos_A1", "nlos_A2"}
    assert len([row for row in rows if row["values"].startswith("tuned")]) == 12
    transferred = report["tables"]["transfer"]
    assert len(transferred) == 4 * 11
    assert len([row for row in transferred if row["in-sample"]]) == 8
    assert len([claim for claim in report["claims"] if "simulation" in claim["claim"]]) == 2
    assert {"transfer", "transfer-nees"} <= {figure["name"] for figure in report["figures"]}
    for stem in ("uwb-ranges", "uwb-simulated"):
        frozen = df.load(tmp_path / f"{stem}.json")
        assert (frozen.system, frozen.scenario.name) == ("robust", stem)
        assert set(frozen.values) == {
            "motion.acceleration",
            "range.sigma",
            "range.bias",
            "imq.k",
            "start.sigma",
        }


def test_without_recordings_the_uwb_experiment_says_that_it_is_skipped(tmp_path: Path) -> None:
    command = [sys.executable, "-m", "training.uwb.run", "--data", str(tmp_path)]
    done = subprocess.run(command, capture_output=True, text=True, check=False, cwd=ROOT)
    assert done.returncode == 0
    assert done.stdout.startswith(f"skipped: no recordings in {tmp_path}")


@pytest.mark.parametrize(
    "script", SCRIPTS, ids=lambda path: path.relative_to(ROOT).with_suffix("").as_posix()
)
def test_training_scripts_use_only_the_public_interface(script: Path) -> None:
    for node in ast.walk(ast.parse(script.read_text())):
        if isinstance(node, ast.ImportFrom) and (node.module or "").startswith("difffilter"):
            public(str(node.module))
            module = importlib.import_module(str(node.module))
            exported = getattr(module, "__all__", dir(module))
            missing = {alias.name for alias in node.names} - set(exported)
            assert not missing, f"{node.module}: {missing}"
        elif isinstance(node, ast.Import):
            for alias in node.names:
                if alias.name.startswith("difffilter"):
                    public(alias.name)


def public(module: str) -> None:
    """A module of the public interface."""
    assert module in PUBLIC or module.startswith("difffilter.reports.figures"), module


@pytest.mark.parametrize("paper", ["airport", "bearing", "manoeuvre", "urban", "uwb"])
def test_each_experiment_has_the_same_few_files(paper: str) -> None:
    files = {path.stem for path in (TRAINING / paper).glob("*.py")}
    assert {"run", "claims", "tables"} <= files
    assert ("paper" in files) == (paper != "uwb")  # recordings, no paper
    assert files <= {
        "run", "paper", "claims", "tables", "figures", "tracks", "equations", "traps",
        "scores", "transfer", "mixtures", "smoothing", "without_truth", "lasting",
    }  # fmt: skip
