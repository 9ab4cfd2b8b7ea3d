"""How a filter is tuned."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field

__all__ = ["HIDES", "OPTIMISERS", "TuneSettings"]

#: What is hidden from the filter so that losses are of predictions.
HIDES = ("nothing", "channels", "sensors", "ahead", "windows")
OPTIMISERS = ("auto", "gauss-newton", "adam", "lbfgs", "random", "nelder-mead", "cma-es")


@dataclass(frozen=True)
class TuneSettings:
    """Settings of one tuning run; the defaults serve most scenarios.

    Attributes:
        system: which system is tuned.
        loss: weight of each loss by name (see :mod:`difffilter.scoring.losses`); their sum is
            minimised.
        optimiser: ``gauss-newton`` (all trajectories in every step, tens of steps), ``adam``
            (batches, hundreds), ``lbfgs``; ``auto``: Gauss-Newton where the fused engine
            runs, ``position`` is among the losses and all others are consistencies; else
            Adam. Without derivatives, to compare with: ``random``, ``nelder-mead`` (needs
            scipy), ``cma-es`` (needs cma).
        trajectories: simulated training trajectories.
        validation: simulated validation trajectories, for early stopping.
        test: simulated held-out trajectories, for the result that is frozen with the values.
        batch: trajectories (or windows of recorded logs) per gradient of Adam.
        steps: steps at most, per start.
        runs: filter runs at most, per start; 0 for no limit. One is one trajectory once through
            the filter; with p derivatives it counts as 1 + p.
        learning_rate: of Adam, on unconstrained numbers (0.05 is about 5 % of a scale);
            falls along a cosine to a twentieth of it.
        clip: largest gradient norm of Adam.
        temperature: first and last temperature of the soft weights, geometric between: over
            all steps of Adam, over the first eight of the others.
        evaluate_every: steps of Adam between validations of the frozen form; the others,
            whose steps do more, validate five times as often.
        patience: validations without improvement before stopping.
        starts: how many starts; the first is the published values, others are scattered
            around them.
        scatter: standard deviation of that scattering, in unconstrained numbers.
        degrees: degrees of freedom of the likelihood loss's Student density.
        hide: what the filter is not given in tuning, and is asked for instead: each channel
            in turn (``channels``), each sensor (``sensors``), windows of ``ahead`` seconds
            (``ahead``), or such windows drawn at random and asked of the smoother
            (``windows``). Losses are then of the hidden innovations.
        ahead: s.
        window: rows of a training window of recorded logs.
        refresh: gradient steps between refreshes of the windows' warm starts.
    """

    system: str = ""
    loss: Mapping[str, float] = field(default_factory=lambda: {"position": 1.0})
    optimiser: str = "auto"
    trajectories: int = 256
    validation: int = 128
    test: int = 200
    batch: int = 64
    steps: int = 120
    runs: float = 0.0
    learning_rate: float = 0.08
    clip: float = 1.0
    temperature: tuple[float, float] = (0.5, 0.02)
    evaluate_every: int = 10
    patience: int = 6
    starts: int = 1
    scatter: float = 0.4
    degrees: float = 4.0
    hide: str = "nothing"
    ahead: float = 1.0
    window: int = 200
    refresh: int = 20
