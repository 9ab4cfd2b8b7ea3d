"""Adaptations by name: what scenario files call them, and how each is made for a filter."""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple, TypeVar

from difffilter.adaptation.correction import PredictionCorrection
from difffilter.adaptation.credibility import Credibility
from difffilter.adaptation.fading import MultipleFading, StrongTracking
from difffilter.adaptation.matching import InnovationMatching
from difffilter.adaptation.protocol import Adaptation
from difffilter.adaptation.scaling import InnovationScaling
from difffilter.registry import Registry
from difffilter.weights.weight import Weight

__all__ = ["ADAPTATIONS", "Host", "adapter"]


class Host(NamedTuple):
    """The filter that an adaptation is made for.

    Attributes:
        weight: its weight function.
        systems: indices of the channels of each sensor.
        axes: components of its position.
    """

    weight: Weight
    systems: tuple[tuple[int, ...], ...]
    axes: int


Maker = Callable[[Host], Adaptation]
M = TypeVar("M", bound=Callable[..., Adaptation])

#: How each adaptation is made, by the name that scenario files know it by.
ADAPTATIONS: Registry[Maker] = Registry("adaptation")


def adapter(name: str) -> Callable[[M], M]:
    """Decorator: enters an adaptation in :data:`ADAPTATIONS`.

    It decorates a class whose arguments all have defaults, or a function of a :class:`Host`
    that returns an :class:`Adaptation`, for one that must know its filter.

    Raises:
        InputError: the name is taken, or is no name.
    """

    def enter(made: M) -> M:
        ADAPTATIONS.add(name, (lambda host: made()) if isinstance(made, type) else made)
        return made

    return enter


adapter("innovation-scaling")(InnovationScaling)
ADAPTATIONS.add("credibility", lambda host: Credibility(host.systems, host.axes))
ADAPTATIONS.add("ideal-credibility", lambda host: Credibility(host.systems, host.axes, ideal=True))
adapter("innovation-matching")(InnovationMatching)
ADAPTATIONS.add("prediction-correction", lambda host: PredictionCorrection(host.axes))
ADAPTATIONS.add("strong-tracking", lambda host: StrongTracking(host.weight))
ADAPTATIONS.add("multiple-fading", lambda host: MultipleFading(host.weight))
