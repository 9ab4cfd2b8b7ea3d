"""One measurement in a process of its own, see :mod:`difffilter.bench.child`."""

from __future__ import annotations

import json
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

__all__ = ["main"]

#: A tuning that compiles what a larger one needs.
SMALL = {"trajectories": 8, "validation": 4, "test": 4, "steps": 1}


def memory(contender: str, filter: str, steps: int, batch: int) -> dict[str, float]:
    """MiB that value and gradient take at most, beyond what there was just before."""
    from difffilter.bench.job import problem, task
    from difffilter.bench.peers import only

    one = only(task(filter, problem(steps, batch)), contender)
    assert one.gradient is not None
    one.warm()
    before = _forget_peak()
    one.gradient()
    return {"MiB": max(_peak() - before, 0.0)}


def compile(filter: str) -> dict[str, float]:
    """Seconds to the first value and gradient, and from there to the first value."""
    import torch

    evaluate = _library_task(filter)
    ready = time.perf_counter()
    evaluate()
    first = time.perf_counter()
    with torch.no_grad():
        evaluate()
    return {
        "ready": ready,
        "gradient": first - ready,
        "value": time.perf_counter() - first,
    }


def _library_task(filter: str) -> Callable[[], object]:
    """Loss of a small log: by a filter of the benchmark or ``SCENARIO/SYSTEM``."""
    import torch

    from difffilter.bench.job import TASKS, own, problem, task
    from difffilter.running.objectives import Problem, objective
    from difffilter.scenario.scenario import load_scenario
    from difffilter.scenario.simulation import simulate

    if filter in TASKS:
        one = own(task(filter, problem(2, 2)), "fused")
        assert one.gradient is not None
        gradient = one.gradient
        return lambda: gradient() if torch.is_grad_enabled() else one.value()
    name, _, chosen = filter.partition("/")
    scenario = load_scenario(name)
    system: Any = scenario.system(chosen)
    log = simulate(scenario, 2, 0)
    asked = Problem(system, log, scenario.tuning.loss, engine="fused")
    free = {n: p.tensor() for n, p in system.declarations.items() if p.tuned}

    def evaluate() -> object:
        values = {n: v.clone().requires_grad_(torch.is_grad_enabled()) for n, v in free.items()}
        loss, _ = objective(asked, values)
        return torch.autograd.grad(loss, list(values.values())) if loss.requires_grad else loss

    return evaluate


def tuning(scenario: str, settings: dict[str, Any]) -> dict[str, float]:
    """Seconds to tune, the compiled steps being in the cache; loss before and after."""
    from difffilter.scenario.scenario import load_scenario
    from difffilter.tuning.loop import tune

    recipe = load_scenario(scenario)
    tune(recipe, settings=SMALL, engine="fused")
    began = time.perf_counter()
    result = tune(recipe, settings=settings, engine="fused")
    return {
        "s": time.perf_counter() - began,
        "loss published": result.checkpoint.training["validation_loss_published"],
        "loss tuned": result.checkpoint.training["validation_loss"],
    }


def _peak() -> float:
    """Highest resident memory so far, MiB."""
    try:
        return _status("VmHWM")
    except OSError:
        import resource

        most = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
        return most / 2**20 if sys.platform == "darwin" else most / 2**10


def _forget_peak() -> float:
    """Resident memory now, MiB; the peak begins anew from it where the system lets it."""
    try:
        Path("/proc/self/clear_refs").write_text("5", encoding="ascii")
    except OSError:
        return _peak()
    return _status("VmRSS")


def _status(name: str) -> float:
    lines = Path("/proc/self/status").read_text(encoding="ascii").splitlines()
    found = next(line for line in lines if line.startswith(name))
    return float(found.split()[1]) / 2**10


def main(began: float, imported: float) -> None:
    """Run the measurement that the argument names, print what it found.

    Args:
        began, imported: clock before and after torch was imported, for ``compile``.
    """
    asked = json.loads(sys.argv[1])
    what: dict[str, Callable[..., dict[str, float]]]
    what = {"memory": memory, "compile": compile, "tuning": tuning}
    found = what[asked.pop("what")](**asked)
    if "ready" in found:
        ready = found.pop("ready")
        found |= {"importing torch": imported - began, "library and filter": ready - imported}
    print(json.dumps(found))
