"""Own models of checkpoints and of the command line: made by whom, and what must fit."""

from __future__ import annotations

import importlib.util
import sys
import traceback
from collections.abc import Mapping
from pathlib import Path
from types import ModuleType
from typing import Any

from difffilter.errors import CheckpointError, InputError
from difffilter.filters.recipe import Recipe
from difffilter.scenario.model import Model, digest, tuning_alone

__all__ = ["load_models", "made", "model_of"]

#: Modules that the user named, by module name: factories are looked up here and nowhere else.
_MODULES: dict[str, ModuleType] = {}


def load_models(path: str | Path) -> ModuleType:
    """Run a Python file that the user named, under its stem.

    Its factories ``module:function`` can then be named as scenarios are, and found by
    checkpoints; weights, losses and other parts that it registers are known.

    Raises:
        InputError: no such file, a name that is no module's, or an error in it.
    """
    path = Path(path)
    if path.suffix != ".py" or not path.stem.isidentifier():
        raise InputError(f"--models: found {str(path)!r:.200}, expected a Python file, NAME.py")
    spec = importlib.util.spec_from_file_location(path.stem, path)
    if not path.is_file() or spec is None or spec.loader is None:
        raise InputError(f"--models {path}: found no such file")
    module = importlib.util.module_from_spec(spec)
    held = sys.modules.get(path.stem)
    sys.modules[path.stem] = module  # dataclasses look there
    try:
        spec.loader.exec_module(module)
    except Exception as error:
        where = _where(error, module)
        raise InputError(f"--models {path}: {type(error).__name__}: {error} ({where})") from None
    finally:
        if held is not None:
            sys.modules[path.stem] = held
    _MODULES[path.stem] = module
    return module


def _where(error: Exception, module: ModuleType) -> str:
    """File and line of the user's module that an error came through last."""
    path = str(module.__file__)
    lines = [f.lineno for f in traceback.extract_tb(error.__traceback__) if f.filename == path]
    return f"line {lines[-1]} of {path}" if lines else path


def made(factory: str) -> Model:
    """The model that a factory ``module:function`` of a loaded module makes.

    Raises:
        InputError: a module that was not loaded, a function that it has not or that fails,
            something else than a filter or a model.
    """
    module, _, name = factory.partition(":")
    if module not in _MODULES:
        raise InputError(f"{factory}: found no module {module}, expected --models {module}.py")
    function = getattr(_MODULES[module], name, None)
    if not callable(function):
        raise InputError(f"{factory}: found no function {name} in {module}.py")
    try:
        found = function()
    except InputError as error:
        raise InputError(f"{factory}: {error}") from None
    except Exception as error:
        raise InputError(
            f"{factory}: {type(error).__name__}: {error} ({_where(error, _MODULES[module])})"
        ) from None
    if isinstance(found, Recipe):
        found = Model(found, name)
    if not isinstance(found, Model):
        raise InputError(f"{factory}: gave {type(found).__name__}, expected a Recipe or a Model")
    return Model(**{**vars(found), "factory": factory})


def model_of(
    path: Path, data: Mapping[str, Any], recipe: Recipe | Model | None, tuned: list[str]
) -> Model:
    """The model that a checkpoint's document names, made of what the caller brings.

    Args:
        data: the document's ``model``; recipe: None looks for the factory among loaded modules.
        tuned: names of the parameters that were tuned.

    Raises:
        CheckpointError: no recipe, or one that does not fit; one line says how.
    """
    name, factory = _text(path, data, "name"), _text(path, data, "factory")
    if recipe is None:
        if factory.partition(":")[0] not in _MODULES:
            how = f"--models {factory.partition(':')[0]}.py, or " if factory else ""
            raise CheckpointError(
                f"{path}: holds values of {factory or name}, a model made in Python; expected "
                f"{how}load(..., recipe=...)"
            )
        try:
            recipe = made(factory)
        except InputError as error:
            raise CheckpointError(f"{path}: {error}") from None
    model = recipe if isinstance(recipe, Model) else Model(recipe, name, factory=factory)
    filter = model.recipe
    for key, own in (("states", filter.states), ("channels", filter.channels)):
        if data.get(key) != list(own):
            raise CheckpointError(
                f"{path}: {key}: found {data.get(key)!r:.200}, expected {list(own)} of the recipe"
            )
    unknown = sorted(set(tuned) - set(filter.declarations))
    if not unknown and data.get("digest") != digest(filter):
        raise CheckpointError(
            f"{path}: digest: found values of another recipe (its parameters differ in name, "
            "shape, unit or bounds), expected those of the recipe given"
        )
    known = [n for n in tuned if n not in unknown]
    own_name = Model(**{**vars(model), "name": name, "recipe": tuning_alone(filter, known)})
    settings = data.get("tuning")
    if not isinstance(settings, dict):
        raise CheckpointError(f"{path}: document.model.tuning: expected a table")
    settings = {key: value for key, value in settings.items() if key != "system"}
    try:
        return own_name.with_overrides({f"tuning.{key}": v for key, v in settings.items()})
    except InputError as error:
        raise CheckpointError(f"{path}: {error}") from None


def _text(path: Path, data: Mapping[str, Any], key: str) -> str:
    found = data.get(key)
    if not isinstance(found, str):
        raise CheckpointError(f"{path}: document.model.{key}: found {found!r:.80}, expected text")
    return found
