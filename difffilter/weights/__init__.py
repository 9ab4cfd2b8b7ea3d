"""Weight functions of a standardised residual, hard and soft, and their registry."""

from difffilter.public import offered

__all__, __getattr__, __dir__ = offered(__name__, globals())
