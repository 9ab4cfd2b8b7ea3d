"""Whether to adopt tuned values, and at what risk."""

from difffilter.public import offered

__all__, __getattr__, __dir__ = offered(__name__, globals())
