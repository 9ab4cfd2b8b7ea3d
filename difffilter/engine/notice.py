"""Warnings that are given once."""

from __future__ import annotations

import warnings

__all__ = ["tell"]

_told: set[str] = set()


def tell(reason: object, consequence: str = "torch runs instead, slower") -> None:
    """Warn, once for each reason, of what follows from it."""
    text = str(reason)
    if text not in _told:
        _told.add(text)
        warnings.warn(f"{text}; {consequence}", stacklevel=3)
