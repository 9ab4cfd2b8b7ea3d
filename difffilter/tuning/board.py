"""What a tuning run shows in TensorBoard."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from difffilter.logs.log import Log
from difffilter.logs.track import Track
from difffilter.parameters.parameters import Parameter, Values
from difffilter.reports.figures.tracks import track_figure

__all__ = ["Board"]


class Board:
    """Writes losses, values beside published ones, gradient norms, weights, a track.

    Args:
        folder: TensorBoard's log folder; None writes nothing.
    """

    def __init__(self, folder: str | Path | None) -> None:
        self._writer: Any = None
        if folder is not None:
            from torch.utils.tensorboard import SummaryWriter

            self._writer = SummaryWriter(str(folder))

    def gradient(self, step: int, total: float, terms: Mapping[str, Tensor], norm: float) -> None:
        """After a gradient step: loss, its terms, and the norm before clipping."""
        if self._writer is None:
            return
        self._writer.add_scalar("loss/training", total, step)
        for name, term in terms.items():
            self._writer.add_scalar(f"loss/{name}", float(term.detach()), step)
        self._writer.add_scalar("gradient/norm", norm, step)

    def validation(
        self,
        step: int,
        loss: float,
        values: Values,
        declarations: Mapping[str, Parameter],
        track: Callable[[], Track],
        log: Log,
    ) -> None:
        """After a validation of the frozen form; ``track`` runs it where it is shown."""
        if self._writer is None:
            return
        self._writer.add_scalar("loss/validation", loss, step)
        for name, parameter in declarations.items():
            if parameter.tuned:
                self._values(step, parameter, values[name])
        shown = track()
        if shown.record is not None:
            weights = shown.record.weight[shown.record.present]
            self._writer.add_histogram("weights", weights.to(torch.float32), step)
        self._writer.add_figure("track", track_figure(log, shown, 0), step)

    def _values(self, step: int, parameter: Parameter, value: Tensor) -> None:
        flat = value.detach().reshape(-1).tolist()
        published = parameter.tensor().reshape(-1).tolist()
        for entry, tuned, old in zip(parameter.entries(), flat, published, strict=True):
            pair = {"tuned": tuned, "published": old}
            self._writer.add_scalars(f"values/{entry} ({parameter.unit})", pair, step)

    def close(self) -> None:
        """Flush."""
        if self._writer is not None:
            self._writer.close()
