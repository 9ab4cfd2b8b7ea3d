"""Recipes that run step by step: what they declare, and the pure step itself."""

from difffilter.public import offered

__all__, __getattr__, __dir__ = offered(__name__, globals())
