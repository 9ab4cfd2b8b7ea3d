"""Plug-ins around predict and condition; each works with any linearisation and any weight."""

from difffilter.public import offered

__all__, __getattr__, __dir__ = offered(__name__, globals())
