"""Robust Kalman-type filters in pure PyTorch: tuned by gradient, frozen, compared, deployed.

Public names are those of ``__init__.pyi``, one line each. A name is imported when it is first
used, so that what needs no PyTorch does not wait for it.
"""

from __future__ import annotations

from difffilter.public import offered

__all__, __getattr__, __dir__ = offered(__name__, globals())
