"""Weight functions w(s): each multiplies one channel's information (R -> R / w).

``s`` is a standardised residual. Every function has the published (hard) form, used when
``temperature`` is None, and a soft form for training, smooth in s and in its parameters,
that converges to the hard one as the temperature goes to 0. A new robust filter is a new
function, entered in :data:`WEIGHTS` by :func:`weight`.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence

from torch import Tensor

from difffilter.parameters.parameters import Parameter, Values
from difffilter.registry import Registry
from difffilter.weights.clipped import danish, huber, igg3, tanh, tukey
from difffilter.weights.smooth import barron, cauchy, imq, plain, student_t, welsch
from difffilter.weights.weight import Weight, WeightFunction

__all__ = [
    "WEIGHTS", "Weight", "barron", "cauchy", "danish", "huber", "igg3", "imq", "plain",
    "student_t", "tanh", "tukey", "weight", "welsch",
]  # fmt: skip

#: Every weight function by name, as scenario files know it. What is entered here they know too.
WEIGHTS: Registry[Weight] = Registry("weight")
for _built_in in (
    plain, huber, igg3, tanh, danish, tukey, cauchy, welsch, imq, student_t, barron,
):  # fmt: skip
    WEIGHTS.add(_built_in.name, _built_in)


def weight(
    name: str,
    parameters: Sequence[Parameter] = (),
    derive: Callable[[Values], dict[str, Tensor]] | None = None,
) -> Callable[[WeightFunction], Weight]:
    """Decorator: makes a function a :class:`Weight` and enters it in :data:`WEIGHTS`.

    Args:
        name: as scenario files and checkpoints will know it.
        parameters: declarations; their values arrive in the function's ``constants`` by name.
        derive: further constants computed once per run from the values.

    Raises:
        InputError: the name is taken, or is no name.

    Example:
        >>> from difffilter import WEIGHTS, weight
        >>> @weight("half")
        ... def half(s, constants, temperature):
        ...     return 1.0 / (1.0 + s.abs())
        >>> WEIGHTS.remove("half") is half
        True
    """
    return lambda function: WEIGHTS.add(name, Weight(name, function, tuple(parameters), derive))
