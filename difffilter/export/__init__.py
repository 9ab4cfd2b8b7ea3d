"""Frozen filters as C99: the step's own scalar program, for machines without Python."""

from difffilter.public import offered

__all__, __getattr__, __dir__ = offered(__name__, globals())
