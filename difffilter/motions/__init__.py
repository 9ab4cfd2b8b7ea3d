"""How a state moves, and the noise that comes in: the protocol, blocks, a user's own."""

from difffilter.public import offered

__all__, __getattr__, __dir__ = offered(__name__, globals())
