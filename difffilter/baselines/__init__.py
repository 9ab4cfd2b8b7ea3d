"""Estimators to compare with: without memory, on Chan's solution, or with adapted noise."""

from difffilter.public import offered

__all__, __getattr__, __dir__ = offered(__name__, globals())
