"""Where a run begins: fits of the first rows to positions, ranges, bearings."""

from difffilter.public import offered

__all__, __getattr__, __dir__ = offered(__name__, globals())
