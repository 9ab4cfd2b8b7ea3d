"""What the experiments share: arguments, where things go, stages that a caller can follow."""

from __future__ import annotations

import argparse
import sys
from pathlib import Path

import torch

import difffilter as df

#: Appended to the introduction of a report that was made with small sizes.
QUICK = " **A quick run: too small for the claims at the end; it shows that everything works.**"

ROOT = Path(__file__).resolve().parent.parent


def arguments(name: str, data: bool = False) -> argparse.Namespace:
    """--quick, --seed, --out, --checkpoints, --quiet (and --data for recorded logs)."""
    module = sys.modules["__main__"].__doc__ or name
    parser = argparse.ArgumentParser(
        description=module, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--quick", action="store_true", help="small sizes, under a minute")
    parser.add_argument("--seed", type=int, default=0, help="of everything random (default 0)")
    parser.add_argument(
        "--out", type=Path, default=ROOT / "report" / name, help="folder of the report"
    )
    parser.add_argument(
        "--checkpoints",
        type=Path,
        default=None,
        help="folder of the frozen values (default: checkpoints/, with --quick the report's)",
    )
    parser.add_argument("--quiet", action="store_true", help="no progress bars, stages as lines")
    if data:
        parser.add_argument(
            "--data",
            type=Path,
            default=recordings(),
            help="folder of the recordings",
        )
    options = parser.parse_args()
    if options.seed < 0:
        parser.error(f"--seed: found {options.seed}, expected 0 or more")
    torch.set_num_threads(1)  # small tensors: a second thread only costs
    return options


def recordings() -> Path:
    """Where the recorded logs are, if they are here at all."""
    return ROOT.parent / "shared" / "data" / "uwb_ranges"


def checkpoint_path(stem: str, options: argparse.Namespace) -> Path:
    """Where the frozen values of an experiment go; a quick run leaves checkpoints/ alone."""
    folder = options.checkpoints or (options.out if options.quick else ROOT / "checkpoints")
    return Path(folder) / f"{stem}.json"


def values_table(checkpoint: df.Checkpoint) -> tuple[list[str], list[list[object]]]:
    """Each tuned value before and after."""
    rows: list[list[object]] = []
    for name, parameter in checkpoint.published_filter.declarations.items():
        if parameter.tuned:
            before, after = parameter.tensor().reshape(-1), checkpoint.values[name].reshape(-1)
            for entry, b, a in zip(parameter.entries(), before, after, strict=True):
                rows.append([entry, float(b), float(a), parameter.unit, parameter.source])
    return ["parameter", "published", "tuned", "unit", "source of the published value"], rows


class Stages:
    """Announces stages as lines ``[2/8] text``, which training/reproduce.py follows."""

    def __init__(self, total: int, quiet: bool) -> None:
        self.total, self.at, self.quiet = total, 0, quiet

    def next(self, text: str) -> None:
        """Begin a stage."""
        self.at += 1
        print(f"[{self.at}/{self.total}] {text}", flush=True)

    def detail(self, text: str) -> None:
        """A part of a stage."""
        if not self.quiet:
            print(f"      {text}", flush=True)
