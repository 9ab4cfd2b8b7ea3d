"""The fused engine: the torch step traced once, lowered to scalar C, compiled and cached."""

from difffilter.public import offered

__all__, __getattr__, __dir__ = offered(__name__, globals())
