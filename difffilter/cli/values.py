"""Sets of values: published, tuned (the package's own), or a checkpoint file."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

from difffilter.errors import InputError, shown
from difffilter.files import data_folder

if TYPE_CHECKING:
    from difffilter.scenario.case import Case
    from difffilter.scenario.checkpoint import Checkpoint

__all__ = ["HELP", "own_checkpoint", "read_values", "unfit"]

HELP = "published, tuned (the package's own) or a checkpoint file"


def own_checkpoint(scenario: Case, inherited: bool = False) -> Path:
    """Where the package keeps tuned values of a scenario; ``inherited``: or of what it extends."""
    from difffilter.scenario.document import ancestors
    from difffilter.scenario.scenario import Scenario

    names = [scenario.name]
    if inherited and isinstance(scenario, Scenario):
        names += ancestors(scenario.path)
    places = [data_folder("checkpoints") / f"{name}.json" for name in names]
    return next((place for place in places if place.is_file()), places[0])


def read_values(label: str, scenario: Case) -> Checkpoint | None:
    """The checkpoint behind a label; None for the published values."""
    from difffilter.scenario.checkpoint import load

    if label == "published":
        return None
    if label == "tuned":
        path = own_checkpoint(scenario, inherited=True)
        if not path.is_file():
            raise InputError(
                f"--values tuned: found none for {scenario.name} in the package, "
                "expected published or a checkpoint file (difffilter tune writes one)"
            )
        return load(path)
    if not Path(label).is_file():
        raise InputError(f"--values: found {shown(label)}, expected {HELP}")
    return load(label)


def unfit(checkpoint: Checkpoint, scenario: Case, system: str) -> str:
    """Why a checkpoint's values do not fit a system of the scenario; "" where they do."""
    if checkpoint.system != system:
        return f"tuned for system {checkpoint.system}, expected {system}"
    declared = scenario.system(system).declarations
    differing = sorted(set(declared) ^ set(checkpoint.values))
    if differing:
        return f"do not fit system {system} of {scenario.name} (parameters {', '.join(differing)})"
    try:
        for name, parameter in declared.items():
            parameter.check(checkpoint.values[name])
    except InputError as error:
        return str(error)
    return ""
