"""Frozen filters: one small readable JSON file, strict on load."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, NoReturn

import torch
from torch import Tensor

from difffilter.errors import CheckpointError, InputError, shown
from difffilter.files import json_text, write_atomically
from difffilter.filters.recipe import Recipe
from difffilter.provenance import git_commit, library_versions
from difffilter.running.tracker import Tracker
from difffilter.scenario.case import Case
from difffilter.scenario.model import Model
from difffilter.scenario.own import model_of
from difffilter.scenario.scenario import read_scenario
from difffilter.scenario.strict_json import numbers, read_json, same_keys

__all__ = ["FORMAT", "VERSION", "Checkpoint", "load", "save"]

FORMAT = "difffilter-checkpoint"
VERSION = 1

_KEYS: dict[str, type | tuple[type, ...]] = {
    "format": str,
    "version": int,
    "scenario": str,
    "system": str,
    "temperature": (int, float, type(None)),
    "parameters": dict,
    "recipe": dict,
    "training": dict,
    "result": dict,
    "versions": dict,
    "git_commit": (str, type(None)),
    "document": dict,
}
_PARAMETER_KEYS = {
    "value",
    "published",
    "unit",
    "source",
    "tuned",
}


@dataclass(frozen=True)
class Checkpoint:
    """A system with frozen values.

    Attributes:
        scenario: validated; its document is stored whole, so that the file stands alone. Of a
            model made in Python, name, factory and digest are stored, and whoever loads brings
            the recipe.
        system: name of the system.
        values: frozen physical value of every parameter, by name.
        temperature: None for the hard form; else the temperature of the soft one.
        training: loss, seed, settings, data.
        result: the held-out comparison made after tuning.
    """

    scenario: Case
    system: str
    values: Mapping[str, Tensor]
    temperature: float | None = None
    training: Mapping[str, Any] = field(default_factory=dict)
    result: Mapping[str, Any] = field(default_factory=dict)

    @property
    def filter(self) -> Recipe:
        """The recipe, with the frozen values declared in place of the published ones."""
        return self.published_filter.with_values(self.values)

    @property
    def published_filter(self) -> Recipe:
        """The recipe with the published values."""
        system = self.scenario.system(self.system)
        if not isinstance(system, Recipe):
            raise InputError(f"system {self.system}: is a baseline, expected a filter")
        return system

    def tracker(
        self,
        mean: Tensor | Sequence[float],
        covariance: Tensor | Sequence[Sequence[float]],
        engine: str = "auto",
    ) -> Tracker:
        """A streaming tracker that runs the frozen values from this belief.

        Args:
            mean: (n,), covariance: (n, n), in the units of the states.
            engine: as for :class:`difffilter.running.tracker.Tracker`.

        Raises:
            InputError: a baseline, or a mean or covariance that does not fit.
        """
        return Tracker(
            self.published_filter, mean, covariance, self.values, self.temperature, engine
        )

    def as_dict(self) -> dict[str, Any]:
        """What the JSON file holds."""
        declarations = self.published_filter.declarations
        spec, own = self.scenario.systems[self.system], isinstance(self.scenario, Model)
        document = dict(self.scenario.document)
        return {
            "format": FORMAT,
            "version": VERSION,
            "scenario": self.scenario.name,
            "system": self.system,
            "temperature": self.temperature,
            "parameters": {
                name: {
                    "value": _plain(self.values[name]),
                    "published": _listed(parameter.value),
                    "unit": parameter.unit,
                    "source": parameter.source,
                    "tuned": parameter.tuned,
                }
                for name, parameter in declarations.items()
            },
            "recipe": {key: _listed(value) for key, value in spec.recipe.items()},
            "training": dict(self.training),
            "result": dict(self.result),
            "versions": library_versions(),
            "git_commit": git_commit(),
            "document": {"model": document} if own else document,
        }


def save(checkpoint: Checkpoint, path: str | Path) -> None:
    """Write the checkpoint as JSON, atomically.

    Raises:
        InputError: a value outside its constraint, or a place that cannot be written.
    """
    declarations = checkpoint.published_filter.declarations
    same_keys(Path(path), "values", checkpoint.values, set(declarations))
    for name, parameter in declarations.items():
        parameter.check(checkpoint.values[name])
    write_atomically(path, json_text(checkpoint.as_dict()) + "\n")


def load(path: str | Path, recipe: Recipe | Model | None = None) -> Checkpoint:
    """Read a checkpoint; everything in it is checked, and nothing is imported.

    Args:
        path: the JSON file.
        recipe: of a model made in Python: what its factory makes.

    Raises:
        CheckpointError: no such file, truncated or malformed JSON, another format or
            version, a missing or extra key, a value that is NaN, of a wrong shape or
            outside its constraint, a recipe or published value that does not belong to the
            stored scenario. The message names the file and the key.
    """
    path = Path(path)

    def fail(key: str, found: object, expected: str) -> NoReturn:
        raise CheckpointError(f"{path}: {key}: found {shown(found)}, expected {expected}")

    data = read_json(path)
    if not isinstance(data, dict) or data.get("format") != FORMAT:
        found = data.get("format") if isinstance(data, dict) else type(data).__name__
        fail("format", found, repr(FORMAT))
    if data.get("version") != VERSION:
        fail("version", data.get("version"), f"{VERSION}")
    same_keys(path, "", data, set(_KEYS))
    for key, kind in _KEYS.items():
        if not isinstance(data[key], kind) or isinstance(data[key], bool):
            fail(key, data[key], "another kind of value")
    temperature = data["temperature"]
    if temperature is not None and not temperature > 0:
        fail("temperature", temperature, "null or a number above 0")
    scenario = _case(path, data, recipe)
    try:
        system = scenario.system(data["system"])
    except InputError as error:
        raise CheckpointError(f"{path}: {error}") from None
    if not isinstance(system, Recipe):
        fail("system", data["system"], "a filter")
    if data["scenario"] != scenario.name:
        fail("scenario", data["scenario"], repr(scenario.name))
    values = _read_values(path, data["parameters"], system)
    checkpoint = Checkpoint(
        scenario=scenario,
        system=data["system"],
        values=values,
        temperature=temperature,
        training=data["training"],
        result=data["result"],
    )
    expected = checkpoint.as_dict()["recipe"]
    # A file of an older version may not name what was added since; the document decides.
    same_keys(path, "recipe", expected | data["recipe"], set(expected))
    for key in data["recipe"]:
        if data["recipe"][key] != expected[key]:
            fail(f"recipe.{key}", data["recipe"][key], repr(expected[key]))
    return checkpoint


def _case(path: Path, data: dict[str, Any], recipe: Recipe | Model | None) -> Case:
    """The scenario of the stored document, or the model that it names."""
    document = data["document"]
    own = document.get("model")
    if isinstance(own, dict):
        entries = data["parameters"].items()
        tuned = [n for n, entry in entries if isinstance(entry, dict) and entry.get("tuned")]
        return model_of(path, own, recipe, tuned)
    if recipe is not None:
        raise CheckpointError(f"{path}: holds a scenario of its own, expected no recipe")
    try:
        return read_scenario(document, Path(f"{path} (document)"))
    except InputError as error:
        raise CheckpointError(str(error)) from None


def _read_values(path: Path, entries: dict[str, Any], system: Recipe) -> dict[str, Tensor]:
    declarations = system.declarations
    same_keys(path, "parameters", entries, set(declarations))
    values = {}
    for name, parameter in declarations.items():
        where, entry = f"{path}: parameters.{name}", entries[name]
        if not isinstance(entry, dict):
            raise CheckpointError(f"{where}: found {shown(entry)}, expected a table")
        same_keys(path, f"parameters.{name}", entry, _PARAMETER_KEYS)
        expected = {
            "published": _listed(parameter.value),
            "unit": parameter.unit,
            "source": parameter.source,
            "tuned": parameter.tuned,
        }
        for key, value in expected.items():
            if entry[key] != value:
                raise CheckpointError(
                    f"{where}.{key}: found {shown(entry[key])}, expected {shown(value)} "
                    "as in the stored document"
                )
        try:
            values[name] = torch.tensor(numbers(entry["value"]), dtype=torch.float64)
            parameter.check(values[name])
        except (InputError, TypeError, ValueError) as error:
            raise CheckpointError(f"{where}.value: {error}") from None
    return values


def _plain(value: Tensor) -> Any:
    return value.detach().to(torch.float64).tolist()


def _listed(value: Any) -> Any:
    """Nested tuples to nested lists, as JSON has them."""
    if isinstance(value, Mapping):
        return {key: _listed(item) for key, item in value.items()}
    return [_listed(item) for item in value] if isinstance(value, tuple) else value
