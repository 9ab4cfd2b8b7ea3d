"""What guards an update: groups of channels, gates, weighing, recovery, local filters."""

from difffilter.public import offered

__all__, __getattr__, __dir__ = offered(__name__, globals())
