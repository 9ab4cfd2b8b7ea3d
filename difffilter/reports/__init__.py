"""Pages that stand alone: HTML, Markdown and JSON, with figures."""

from difffilter.public import offered

__all__, __getattr__, __dir__ = offered(__name__, globals())
