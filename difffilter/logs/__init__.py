"""Measurements over time, estimates over time, and the files that hold them."""

from difffilter.public import offered

__all__, __getattr__, __dir__ = offered(__name__, globals())
