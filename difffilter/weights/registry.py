"""Weight functions w(s): each multiplies one channel's information (R -> R / w).

``s`` is a standardised residual. Every function has the published (hard) form, used when
``temperature`` is None, and a soft form for training, smooth in s and in its parameters,
that converges to the hard one as the temperature goes to 0. A new robust filter is a new
function, wrapped in a :class:`Weight` and entered in :data:`WEIGHTS`.
"""

from __future__ import annotations

from difffilter.errors import InputError
from difffilter.weights.clipped import danish, huber, igg3, tanh, tukey
from difffilter.weights.smooth import barron, cauchy, imq, plain, student_t, welsch
from difffilter.weights.weight import Weight

__all__ = [
    "WEIGHTS", "Weight", "barron", "cauchy", "danish", "huber", "igg3", "imq", "plain",
    "student_t", "tanh", "tukey", "weight_named", "welsch",
]  # fmt: skip

#: Every weight function by name, as scenario files know it. What is entered here they know too.
WEIGHTS = {
    weight.name: weight
    for weight in (
        plain, huber, igg3, tanh, danish, tukey, cauchy, welsch, imq, student_t, barron,
    )
}  # fmt: skip


def weight_named(name: str) -> Weight:
    """The weight function of that name; InputError if there is none."""
    if name not in WEIGHTS:
        raise InputError(f"weight: found {name!r}, expected one of {', '.join(WEIGHTS)}")
    return WEIGHTS[name]
