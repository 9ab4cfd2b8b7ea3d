"""The equations: beliefs, the one measurement update, linearisation, square-root factors.

A newcomer starts with :mod:`difffilter.core.equations`: the Kalman update, once.
Knows nothing of models, weights or logs."""
