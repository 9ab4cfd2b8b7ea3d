"""What a measurement should read: the protocol, built-in sensors, a user's own."""

from difffilter.public import offered

__all__, __getattr__, __dir__ = offered(__name__, globals())
