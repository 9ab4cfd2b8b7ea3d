"""Scenario files: worlds, sensors, systems and what to tune, as data; and frozen values."""

from difffilter.public import offered

__all__, __getattr__, __dir__ = offered(__name__, globals())
