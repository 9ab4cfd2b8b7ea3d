"""Random recipes over random rows: sound covariances, finite numbers, named errors, equal engines.

Well-conditioned problems of moderate numbers, on which engines must agree to 1e-6: rows 1 s apart,
states of some hundred m and some m/s, noise between 0.1 and 10 m, a start of some m and m/s.
"""

from __future__ import annotations

import random
import warnings
from typing import Any

import recipes
import rows
import torch
from outcome import Tally, Violation

from difffilter import DifffilterError, run

__all__ = ["case"]

#: Largest difference of the engines, in standard deviations of the estimate.
AGREE = 1e-6
#: Share of the moderate cases that run compiled as well: each compiles its step.
COMPILED = 0.25


def case(seed: int, tally: Tally) -> None:
    """One recipe over one log; a violation is shrunk and noted."""
    rng = random.Random(seed)
    hostile = rng.random() < 0.7
    drawn = {"recipe": recipes.draw(rng), "log": rows.draw(rng, hostile)}
    drawn["compiled"] = not hostile and rng.random() < COMPILED
    tally.counts["recipes drawn"] += 1
    recipe = recipes.build(drawn["recipe"])
    if recipe is None:
        tally.counts["recipes refused by name"] += 1
        return
    try:
        check(drawn, tally)
    except Violation as error:
        small = shrink(drawn, str(error))
        tally.violation("numbers", seed, str(error), small)


def check(drawn: dict[str, Any], tally: Tally) -> None:
    """Raise Violation where something is wrong."""
    recipe = recipes.build(drawn["recipe"])
    if recipe is None:
        return
    log, start = rows.make(drawn["log"], recipe)
    tally.counts["steps"] += log.steps * log.trajectories
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        warnings.filterwarnings("ignore", category=DeprecationWarning, module="torch")
        track = _run(recipe, log, start, "torch", tally)
    if track is None:
        return
    _sound(track)
    if drawn["compiled"]:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            other = _run(recipe, log, start, "fused", tally)
        tally.counts["steps compiled"] += log.steps * log.trajectories
        if other is None:
            raise Violation("torch has a result, the compiled engine none")
        _equal(track, other)
        _hostile(recipe, drawn["log"], tally)


def _hostile(recipe: Any, spec: dict[str, Any], tally: Tally) -> None:
    """What is compiled once goes over hostile logs too: sound, or an error by name."""
    rng = random.Random(spec["seed"])
    for _ in range(4):
        log, start = rows.make({**rows.draw(rng, True), "float32": False}, recipe)
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            track = _run(recipe, log, start, "fused", tally)
        tally.counts["steps compiled"] += log.steps * log.trajectories
        if track is not None:
            _sound(track)


def _run(recipe: Any, log: Any, start: Any, engine: str, tally: Tally) -> Any:
    try:
        with torch.no_grad():
            return run(recipe, log, start=start, engine=engine)
    except DifffilterError as error:
        tally.counts[f"{type(error).__name__} ({engine})"] += 1
        return None
    except Warning as error:
        raise Violation(f"{engine}: warning {error!r}") from error
    except Exception as error:
        raise Violation(f"{engine}: {type(error).__name__}: {error}") from error


def _sound(track: Any) -> None:
    for name, value in (("mean", track.mean), ("deviations", track.deviations)):
        if not bool(torch.isfinite(value).all()):
            raise Violation(f"{name}: not finite, and no error")
    covariance = track.covariance
    scale = covariance.diagonal(dim1=-2, dim2=-1).amax(-1)
    least = torch.linalg.eigvalsh(covariance.double()).amin(-1)
    slack = 50 * torch.finfo(covariance.dtype).eps * scale.double()
    if bool((least < -slack).any()):
        raise Violation(f"covariance: least eigenvalue {float((least / scale).amin()):.3g} of P")
    record = track.record
    for name, value in record._asdict().items():
        if value.is_floating_point() and not bool(torch.isfinite(value).all()):
            raise Violation(f"record.{name}: not finite, and no error")
    outside = (record.weight < -1e-12) | (record.weight > 1.0 + 1e-6)
    if bool(outside.any()):
        raise Violation(f"record.weight: {float(record.weight[outside][0])} outside [0, 1]")
    try:
        nis = record.nis
    except RuntimeError as error:
        raise Violation(f"record.nis: {type(error).__name__}: {error}") from error
    if bool((nis < 0.0).any()) or not bool(torch.isfinite(nis).all()):
        raise Violation("record.nis: negative or not finite")


def _equal(first: Any, second: Any) -> None:
    std = first.std.clamp_min(1e-9)
    worst = float(((first.mean - second.mean) / std).abs().max())
    if not worst < AGREE:
        raise Violation(f"engines: means differ by {worst:.3g} standard deviations")
    worst = float(((first.std - second.std) / std).abs().max())
    if not worst < AGREE:
        raise Violation(f"engines: standard deviations differ by {worst:.3g}")


def shrink(drawn: dict[str, Any], what: str) -> dict[str, Any]:
    """The smallest case that still is a violation of the same sort: fewer options, fewer rows."""
    words = what.split(":")[0]
    plain = {
        "motion": "discrete", "sensors": "position", "weight": "plain", "iterations": 0,
        "weigh_prior": False, "mad": False, "scope": "channel", "distance": "rms",
        "standardise": None, "gate": "none", "recovery": "none", "adaptation": "none",
        "federated": False, "linearise": "taylor", "common": False, "fusion": False, "modes": False,
    }  # fmt: skip
    best = drawn
    quiet = Tally(out=None)  # type: ignore[arg-type]

    def still(candidate: dict[str, Any]) -> bool:
        try:
            check(candidate, quiet)
        except Violation as error:
            return str(error).split(":")[0] == words
        return False

    for key, value in plain.items():
        candidate = {**best, "recipe": {**best["recipe"], key: value}}
        if candidate != best and still(candidate):
            best = candidate
    for hazard in best["log"]["hazards"]:
        less = [name for name in best["log"]["hazards"] if name != hazard]
        candidate = {**best, "log": {**best["log"], "hazards": less}}
        if still(candidate):
            best = candidate
    for key, values in (("trajectories", (1, 8)), ("steps", (2, 5, 10)), ("float32", (False,))):
        for value in values:
            candidate = {**best, "log": {**best["log"], key: value}}
            if still(candidate):
                best = candidate
                break
    return best
