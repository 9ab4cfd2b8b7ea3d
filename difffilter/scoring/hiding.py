"""Which measurements of a log are hidden, so that the rest can be asked for them.

Ways told apart by what they can see. One sensor or channel at a time is predicted from
the others: an error of a channel that lasts is foretold by nobody else. Or all of a window
is predicted from what came before it, some seconds ahead: the motion has to carry it. Or random
windows are asked of the smoother, which knows what came after them too.
"""

from __future__ import annotations

from dataclasses import replace

import torch
from torch import Tensor

from difffilter.errors import InputError
from difffilter.filters.hiding import HIDDEN
from difffilter.filters.recipe import Recipe
from difffilter.logs.log import Log
from difffilter.seeds import stream

__all__ = ["hide_ahead", "hide_channels", "hide_windows", "per_sensor"]


def hide_channels(log: Log, groups: tuple[tuple[int, ...], ...] | None = None) -> Log:
    """The log once for each group of channels (each channel by itself if None), that group hidden.

    Args:
        log: (T, m) or (T, B, m). The result has B times as many trajectories as groups.
    """
    channels = len(log.channels)
    groups = groups if groups is not None else tuple((i,) for i in range(channels))
    if len(groups) < 2:
        raise InputError("hide channels: found one, expected two or more to predict each other")
    masks = [torch.zeros(channels, dtype=log.z.dtype) for _ in groups]
    for mask, group in zip(masks, groups, strict=True):
        mask[list(group)] = 1.0
    return _variants(log, [mask.expand(log.steps, channels) for mask in masks])


def hide_ahead(log: Log, seconds: float, parts: int = 4) -> Log:
    """The log ``parts`` times, in each other windows of ``seconds`` hidden whole.

    In time a window is hidden in one of the parts; the first is hidden in none.

    Raises:
        InputError: seconds that are none, or a log that is shorter than a window of each part.
    """
    window = _windows(log, seconds, parts, "hide ahead")
    masks = [((window % parts == i) & (window > 0)).to(log.z.dtype) for i in range(parts)]
    return _variants(log, [m.unsqueeze(-1).expand(*m.shape, len(log.channels)) for m in masks])


def hide_windows(log: Log, seconds: float, parts: int = 4, seed: int = 0) -> Log:
    """The log ``parts`` times; each window of ``seconds`` is hidden in a part drawn at random.

    Windows that stand side by side may fall to the same part, so that gaps have all lengths;
    the first is hidden in none. Shares of a trajectory's rows: 1 / ``parts`` in each.

    Raises:
        InputError: as for :func:`hide_ahead`.
    """
    window = _windows(log, seconds, parts, "hide windows")
    drawn = torch.randint(parts, (int(window.max()) + 1,), generator=stream(seed, "windows"))
    drawn[0] = parts
    part = drawn[window]
    masks = [(part == i).to(log.z.dtype) for i in range(parts)]
    return _variants(log, [m.unsqueeze(-1).expand(*m.shape, len(log.channels)) for m in masks])


def _windows(log: Log, seconds: float, parts: int, what: str) -> Tensor:
    """(T,) or (T, B), the window that each row is of."""
    if not seconds > 0.0:
        raise InputError(f"{what}: found {seconds} s, expected more than 0")
    window = torch.floor((log.time - log.time[0]) / seconds).long()
    if int(window[-1].max()) < parts:  # beside a longer log a short one may be part of a window
        raise InputError(
            f"{what}: found a log of {float((log.time[-1] - log.time[0]).max()):.6g} s, "
            f"expected more than {parts} windows of {seconds:.6g} s"
        )
    return window


def per_sensor(recipe: Recipe) -> tuple[tuple[int, ...], ...]:
    """Indices of each sensor's channels."""
    at = 0
    return tuple(tuple(range(at, at := at + len(sensor.channels))) for sensor in recipe.sensors)


def _variants(log: Log, masks: list[Tensor]) -> Log:
    """The log's trajectories once for each mask (T, m) or (T, B, m), as the input ``hidden``."""
    if log.z.dim() == 2:
        z = log.z.unsqueeze(1)
        truth = None if log.truth is None else log.truth.unsqueeze(1)
        inputs = {name: value.unsqueeze(1) for name, value in log.inputs.items()}
        start = log.start
        if start is not None:
            covariance = None if start.covariance is None else start.covariance.unsqueeze(0)
            start = replace(start, mean=start.mean.unsqueeze(0), covariance=covariance)
        log = replace(log, z=z, truth=truth, inputs=inputs, start=start)
    count = log.trajectories
    chosen = log.select([b for _ in masks for b in range(count)])
    each = [m if m.dim() == 3 else m.unsqueeze(1).expand(-1, count, -1) for m in masks]
    hidden = torch.cat(each, dim=1)
    return replace(chosen, inputs={**chosen.inputs, HIDDEN: hidden})
