"""Tuning by gradient: settings, loop, resumable state, TensorBoard."""

from difffilter.public import offered

__all__, __getattr__, __dir__ = offered(__name__, globals())
