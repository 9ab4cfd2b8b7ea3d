"""What a comparison found: a row for each system and set of values, on the same log."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, Protocol

import torch
from torch import Tensor

from difffilter.errors import InputError, digits
from difffilter.escape import markdown_table
from difffilter.logs.log import Log
from difffilter.logs.track import Track
from difffilter.scoring.differences import scored_states, scored_unit
from difffilter.scoring.metrics import (
    Score,
    bootstrap_interval,
    mean_nees,
    nis_per_channel,
    paired_ratio,
    rejected,
    scored_rows,
    squared_error,
    state_rmse,
)

__all__ = ["Comparison", "Row", "Scene", "labelled", "tabulate"]


class Scene(Protocol):
    """A named stretch of a log: first <= k <= last."""

    @property
    def name(self) -> str: ...
    @property
    def first(self) -> int: ...
    @property
    def last(self) -> int: ...


@dataclass(frozen=True)
class Row:
    """One system with one set of values.

    Attributes:
        system, values: names of both.
        rmse: RMSE over scored rows of the states that the comparison scores, of the position in
            m; ci95: bootstrap interval over trajectories.
        median: median over trajectories of their own RMSE (outliers of a run that lost
            track do not move it).
        ratio: RMSE divided by the reference row's, with its paired interval.
        nees_per_state: mean NEES over the true states that the system estimates; 1 expected.
        nis_per_channel: mean nominal NIS per present channel; 1 expected; None for baselines.
        estimated: share of rows with an estimate.
        per_scene: RMSE per scene, where the scenario has scenes.
        per_state: RMSE of each true state that is estimated, by name, in its own unit.
        rejected: share of each channel's rejected measurements, of a weight below ``REJECTED``.
    """

    system: str
    values: str
    rmse: float
    ci95: tuple[float, float]
    median: float
    ratio: float
    ratio_ci95: tuple[float, float]
    nees_per_state: float
    nis_per_channel: float | None
    estimated: float
    per_scene: Mapping[str, float]
    rejected: Mapping[str, float]
    per_state: Mapping[str, float] = field(default_factory=dict)

    def as_dict(self) -> dict[str, Any]:
        """For JSON."""
        data = dict(vars(self))
        for name in ("per_scene", "per_state"):
            if not data[name]:
                del data[name]
        return data


@dataclass(frozen=True)
class Comparison:
    """Result of :func:`compare`; the reference row is the published tuned-for system.

    Attributes:
        scenario: name; trajectories: how many; seed: of simulated ones, None for logs.
        reference: label of the row that ratios are relative to.
        rows: one for each system and set of values.
        states: names of the states whose error is scored; unit: of that error, empty for
            states of several units.
    """

    scenario: str
    trajectories: int
    seed: int | None
    reference: str
    rows: tuple[Row, ...]
    states: tuple[str, ...] = ()
    unit: str = "m"

    def as_dict(self) -> dict[str, Any]:
        """For JSON."""
        return dict(vars(self)) | {"rows": [row.as_dict() for row in self.rows]}

    def row(self, system: str, values: str = "published") -> Row:
        """The row of a system and a set of values; InputError if there is none."""
        for row in self.rows:
            if (row.system, row.values) == (system, values):
                return row
        raise InputError(f"comparison: has no row {system} with {values} values")

    def markdown(self) -> str:
        """The comparison as a Markdown table; names in it are plain text, whatever they hold."""
        return "\n".join(markdown_table(*self.cells())) + "\n"

    def cells(self) -> tuple[list[str], list[list[str]]]:
        """Head and rows of the table, as they are shown."""
        scenes = list(self.rows[0].per_scene) if self.rows else []
        head = [
            "system", "values", labelled("RMSE", self.unit), "95 % interval",
            labelled("median run", self.unit),
            f"ratio to {self.reference}", "NEES per state", "NIS per channel", *scenes,
        ]  # fmt: skip
        rows = []
        for row in self.rows:
            low, high = row.ratio_ci95
            note = "" if row.estimated == 1.0 else f" ({100 * row.estimated:.1f} % of rows)"
            nis = "" if row.nis_per_channel is None else f"{row.nis_per_channel:.2f}"
            cells = [
                row.system,
                row.values,
                f"{digits(row.rmse)}{note}",
                f"{digits(row.ci95[0])} to {digits(row.ci95[1])}",
                digits(row.median),
                f"{digits(row.ratio)} ({digits(low)} to {digits(high)})",
                f"{row.nees_per_state:.2f}",
                nis,
                *(digits(row.per_scene[name]) for name in scenes),
            ]
            rows.append(cells)
        return head, rows

    def states_markdown(self) -> str:
        """The RMSE of each true state, in its own unit, as a Markdown table."""
        names = dict.fromkeys(name for row in self.rows for name in row.per_state)
        cells = [
            [row.system, row.values, *(_digits(row.per_state.get(name)) for name in names)]
            for row in self.rows
        ]
        return "\n".join(markdown_table(["system", "values", *names], cells)) + "\n"


def labelled(what: str, unit: str) -> str:
    """The head of a column with its unit; alone where there is none, or several.

    Example:
        >>> labelled("RMSE", "m"), labelled("RMSE", "")
        ('RMSE (m)', 'RMSE')
    """
    return f"{what} ({unit})" if unit else what


def _digits(value: float | None) -> str:
    return "" if value is None else digits(value)


def tabulate(
    name: str,
    tracks: Mapping[tuple[str, str], Track],
    log: Log,
    *,
    wanted: tuple[str, str],
    seed: int | None = None,
    score: Score | str = "all",
    scenes: Sequence[Scene] = (),
) -> Comparison:
    """The comparison of tracks of the same log, over the rows that all have an estimate for.

    Args:
        name: of the scenario or of the data.
        tracks: by system and set of values.
        wanted: system and values that ratios are relative to, if they are among the tracks.

    Raises:
        InputError: no such row.
    """
    rows = torch.stack([scored_rows(log, t, score) for t in tracks.values()])
    common = rows.all(0)
    if not bool(common.any()):
        raise InputError(f"compare: {_why_none(log, tracks, rows, score)}")
    squared = {key: squared_error(log, track, score) for key, track in tracks.items()}
    reference = wanted if wanted in tracks else next(iter(tracks))
    scorable = scored_rows(log, tracks[reference], score).sum()
    made = [
        _row(
            key,
            log,
            track,
            squared=squared[key],
            reference=squared[reference],
            rows=common,
            estimated=float(rows[at].sum() / scorable),
            scenes=scenes,
        )
        for at, (key, track) in enumerate(tracks.items())
    ]
    label = f"{reference[0]} {reference[1]}"
    states = scored_states(log, tracks[reference], score)
    return Comparison(
        scenario=name,
        trajectories=log.trajectories,
        seed=seed,
        reference=label,
        rows=tuple(made),
        states=tuple(states),
        unit=scored_unit(log, tracks[reference], score),
    )


def _row(
    key: tuple[str, str],
    log: Log,
    track: Track,
    *,
    squared: Tensor,
    reference: Tensor,
    rows: Tensor,
    estimated: float,
    scenes: Sequence[Scene],
) -> Row:
    """One system's row: squared errors (T, B), its own and the reference's, over ``rows``."""
    ratio, *interval = paired_ratio(squared, reference, rows)
    nis = float(nis_per_channel(track))
    parts = {scene.name: slice(scene.first - 1, scene.last) for scene in scenes}
    return Row(
        *key,
        rmse=_root_mean(squared, rows),
        ci95=bootstrap_interval(squared, rows),
        median=_median_run(squared, rows),
        ratio=ratio,
        ratio_ci95=(interval[0], interval[1]),
        nees_per_state=float(mean_nees(log, track, rows)),
        nis_per_channel=nis if nis == nis else None,
        estimated=estimated,
        per_scene={name: _root_mean(squared[part], rows[part]) for name, part in parts.items()},
        rejected=rejected(track),
        per_state=state_rmse(log, track, rows),
    )


def _why_none(
    log: Log, tracks: Mapping[tuple[str, str], Track], rows: Tensor, score: Score | str
) -> str:
    """Why no row counts: times beside the log's, a system without estimates, or no truth."""
    chosen = Score(score) if isinstance(score, str) else score
    first, last = float(log.time.min()), float(log.time.max())
    if last < chosen.first or first > chosen.last:
        return (
            f"score_times: found {chosen.first:.10g} to {chosen.last:.10g} s, the log has "
            f"{first:.10g} to {last:.10g} s: expected times of the log"
        )
    idle = [key for key, some in zip(tracks, rows.flatten(1).any(1), strict=True) if not some]
    if idle and len(idle) < len(tracks):
        named = ", ".join(" ".join(key) for key in idle)
        rest = dict.fromkeys(system for system, _ in tracks if system not in dict(idle))
        advice = f"; without it: {' '.join(f'--system {name}' for name in rest)}" if rest else ""
        return f"found no row with truth that {named} has an estimate for{advice}"
    return "found no row that every system has an estimate for"


def _root_mean(squared: Tensor, rows: Tensor) -> float:
    return float(squared[rows].mean().sqrt())


def _median_run(squared: Tensor, rows: Tensor) -> float:
    total = torch.where(rows, squared, 0.0).sum(0) / rows.sum(0)
    return float(total.sqrt().nanmedian())
