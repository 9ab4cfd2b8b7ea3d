"""Rules of the engine: each turns one ATen operation into scalar expressions.

A file per theme; each registers its rules in :data:`RULES` when it is imported.
"""

from difffilter.engine.rules import (
    activations,
    arithmetic,
    elementary,
    factories,
    indexing,
    linear_algebra,
    logic,
    products,
    reductions,
    shapes,
)
from difffilter.engine.rules.table import RULES

__all__ = [
    "RULES", "activations", "arithmetic", "elementary", "factories", "indexing", "linear_algebra",
    "logic", "products", "reductions", "shapes",
]  # fmt: skip
