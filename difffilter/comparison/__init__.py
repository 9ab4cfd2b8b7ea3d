"""Systems beside each other on the same held-out trajectories."""

from difffilter.public import offered

__all__, __getattr__, __dir__ = offered(__name__, globals())
