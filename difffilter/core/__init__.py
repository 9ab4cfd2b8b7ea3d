"""The equations: beliefs, the one measurement update, linearisation, square-root factors.

A newcomer starts with :mod:`difffilter.core.equations`: the Kalman update, once.
Knows nothing of models, weights or logs."""

from difffilter.public import offered

__all__, __getattr__, __dir__ = offered(__name__, globals())
