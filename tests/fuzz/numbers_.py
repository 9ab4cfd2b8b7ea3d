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
#: Share of the recipes that run compiled as well: each compiles its step.
COMPILED = 0.3


def case(seed: int, tally: Tally) -> None:
    """One recipe over one log; a violation is shrunk and noted."""
    rng = random.Random(seed)
    drawn = {"recipe": recipes.draw(rng), "log": rows.draw(rng, rng.random() < 0.7)}
    drawn["compiled"] = rows.draw(rng, False) if rng.random() < COMPILED else None
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
    track = _in_torch(recipe, log, start, tally)
    if track is not None:
        _sound(track)
    if drawn["compiled"] is not None:
        _compared(recipe, drawn, tally)


def _in_torch(recipe: Any, log: Any, start: Any, tally: Tally) -> Any:
    tally.counts["steps"] += log.steps * log.trajectories
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        warnings.filterwarnings("ignore", category=DeprecationWarning, module="torch")
        return _run(recipe, log, start, "torch", tally)


def _compared(recipe: Any, drawn: dict[str, Any], tally: Tally) -> None:
    """Both engines over moderate rows; what is compiled for these goes over hostile ones too."""
    spec = drawn["compiled"]
    log, start = rows.make(spec, recipe)
    track = _in_torch(recipe, log, start, tally)
    if track is None:
        raise Violation("moderate rows: an error")
    _sound(track)
    other = _compiled(recipe, log, start, tally)
    if other is None:
        raise Violation("torch has a result, the compiled engine none")
    _equal(track, other)
    tally.counts["recipes compared in both engines"] += 1
    for option in recipes.options(drawn["recipe"]):
        tally.counts[f"engines: {option}"] += 1
    rng = random.Random(spec["seed"])
    for _ in range(4):
        log, start = rows.make({**rows.draw(rng, True), "float32": False}, recipe)
        other = _compiled(recipe, log, start, tally)
        if other is not None:
            _sound(other)


def _compiled(recipe: Any, log: Any, start: Any, tally: Tally) -> Any:
    tally.counts["steps compiled"] += log.steps * log.trajectories
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        return _run(recipe, log, start, "fused", tally)


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
    for name in ("weight", "gate", "modes"):
        a, b = getattr(first.record, name), getattr(second.record, name)
        worst = float((a - b).abs().max()) if a.numel() else 0.0
        if not worst < AGREE:
            raise Violation(f"engines: record.{name} differs by {worst:.3g}")


def shrink(drawn: dict[str, Any], what: str) -> dict[str, Any]:
    """The smallest case that still is a violation of the same sort: fewer options, fewer rows."""
    words = what.split(":")[0]
    best = drawn
    quiet = Tally(out=None)  # type: ignore[arg-type]

    def still(candidate: dict[str, Any]) -> bool:
        try:
            check(candidate, quiet)
        except Violation as error:
            return str(error).split(":")[0] == words
        return False

    if still({**best, "compiled": None}):
        best = {**best, "compiled": None}
    for key, value in recipes.PLAIN.items():
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
