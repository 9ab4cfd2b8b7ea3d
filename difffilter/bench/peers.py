"""Who is compared: which peers were asked for and are installed."""

from __future__ import annotations

from collections.abc import Iterable
from importlib import import_module
from importlib.metadata import PackageNotFoundError, version
from typing import Any

from difffilter.bench.job import Contender, Task, own
from difffilter.errors import InputError

__all__ = ["PEERS", "chosen", "contenders", "installed", "only"]

#: Distributions of the extra ``bench``; each has a module ``NAME_peer`` here.
PEERS = ("jax", "dynamax", "filterpy")


def installed(name: str) -> str | None:
    """Version, or None."""
    try:
        return version(name)
    except PackageNotFoundError:
        return None


def chosen(names: str | None) -> tuple[str, ...]:
    """Peers by a comma-separated list, ``none``, or those that are installed.

    Raises:
        InputError: an unknown peer, or one that was named and is not installed.
    """
    if names is None:
        return tuple(name for name in PEERS if installed(name))
    asked = [name.strip() for name in names.split(",")]
    if asked == ["none"]:
        return ()
    for name in asked:
        if name not in PEERS:
            raise InputError(f"--peers: found {name!r}, expected some of {', '.join(PEERS)}")
        if not installed(name):
            raise InputError(
                f"--peers: {name} is not installed, expected pip install 'difffilter[bench]'"
            )
    return tuple(name for name in PEERS if name in asked)


def contenders(task: Task, peers: Iterable[str], engines: Iterable[str]) -> list[Contender]:
    """This library by these engines, and what each peer makes of the task.

    Raises:
        InputError: a peer that is installed but cannot be imported.
    """
    found = [own(task, engine) for engine in engines]
    for name in peers:
        found += _module(name).contenders(task)
    return found


def only(task: Task, name: str) -> Contender:
    """The contender of that name: no other is made, as far as can be."""
    group = {"JAX": ("jax",), "dynamax": ("dynamax",), "filterpy": ("filterpy",)}
    engine = {"difffilter, fused": ("fused",), "difffilter, torch": ("torch",)}
    peers = group.get(name.split(",")[0], ())
    made = contenders(task, peers, engine.get(name, ()))
    return next(one for one in made if one.name == name)


def _module(name: str) -> Any:
    try:
        return import_module(f"difffilter.bench.{name}_peer")
    except ImportError as error:
        raise InputError(f"--peers: {name} cannot be imported: {error}") from None
