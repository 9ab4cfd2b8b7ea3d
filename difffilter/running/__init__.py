"""A filter over a log, over a stream, and the loss with its derivatives."""

from difffilter.public import offered

__all__, __getattr__, __dir__ = offered(__name__, globals())
