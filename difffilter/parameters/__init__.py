"""What may be tuned: declarations, their constraints, and sets of values."""

from difffilter.public import offered

__all__, __getattr__, __dir__ = offered(__name__, globals())
