"""Two kinds of numbers by name that are never to be mixed up: values, and constants."""

from __future__ import annotations

from collections.abc import ItemsView, Iterator, KeysView, Mapping, ValuesView
from typing import Any, overload

import torch
from torch import Tensor

from difffilter.errors import InputError

__all__ = ["Constants", "Values"]

#: Physical values of a recipe's parameters, by parameter name: what users give.
Values = Mapping[str, Tensor]


class Constants:
    """What a recipe makes of its values once per run, by name: what its steps read.

    Made by ``prepare`` of a recipe, motion or sensor: the values themselves, and what is
    derived of them (factors of covariances, variances, station coordinates). It is no mapping,
    so that a type checker tells it from values; :meth:`of` tells them apart at run time.

    Raises:
        InputError: a name that it does not hold.

    Example:
        >>> Constants({"a": torch.tensor(1.0)})["b"]
        Traceback (most recent call last):
        ...
        difffilter.errors.InputError: constants: found no b, expected what prepare makes (found a)
    """

    __slots__ = ("_entries",)

    def __init__(self, entries: Mapping[str, Tensor] | Constants | None = None) -> None:
        self._entries: dict[str, Tensor] = dict(entries or {})

    @classmethod
    def of(cls, constants: Constants) -> Constants:
        """The constants; InputError in one line where something else was given."""
        if isinstance(constants, Constants):
            return constants
        raise InputError(
            f"constants: found a {type(constants).__name__}, expected what prepare(values) of the "
            "filter, motion or sensor makes of the values"
        )

    def __getitem__(self, name: str) -> Tensor:
        try:
            return self._entries[name]
        except KeyError:
            found = ", ".join(self._entries) or "none"
            raise InputError(
                f"constants: found no {name}, expected what prepare makes (found {found:.200})"
            ) from None

    @overload
    def get(self, name: str) -> Tensor | None: ...
    @overload
    def get(self, name: str, default: Tensor) -> Tensor: ...
    def get(self, name: str, default: Tensor | None = None) -> Tensor | None:
        """The constant, or the default."""
        return self._entries.get(name, default)

    def __contains__(self, name: object) -> bool:
        return name in self._entries

    def __iter__(self) -> Iterator[str]:
        return iter(self._entries)

    def __len__(self) -> int:
        return len(self._entries)

    def keys(self) -> KeysView[str]:
        """Names, in order."""
        return self._entries.keys()

    def values(self) -> ValuesView[Tensor]:
        """Tensors, in the order of their names."""
        return self._entries.values()

    def items(self) -> ItemsView[str, Tensor]:
        """Names and tensors, in order."""
        return self._entries.items()

    def __or__(self, more: Mapping[str, Tensor] | Constants) -> Constants:
        return Constants(self._entries | dict(more))

    def __repr__(self) -> str:
        return f"Constants({', '.join(self._entries)})"


def _flatten(constants: Constants) -> tuple[list[Any], list[str]]:
    return list(constants.values()), list(constants)


def _unflatten(tensors: Any, names: Any) -> Constants:
    return Constants(dict(zip(names, tensors, strict=True)))


# torch.func transforms (vmap, grad) pass through it as through a dictionary.
torch.utils._pytree.register_pytree_node(Constants, _flatten, _unflatten)
