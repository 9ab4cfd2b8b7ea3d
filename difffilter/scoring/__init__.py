"""What is measured on estimates: errors, consistency, and the losses that tuning minimises."""

from difffilter.public import offered

__all__, __getattr__, __dir__ = offered(__name__, globals())
