"""Benchmark: what a pass costs, by the engines of this library and by others."""

from difffilter.public import offered

__all__, __getattr__, __dir__ = offered(__name__, globals())
