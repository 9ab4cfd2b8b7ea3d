"""Random recipes, logs, files and faults of the machine for as long as told: ``make fuzz``.

``python tests/fuzz/campaign.py --seconds 3600 --seed 1`` runs for an hour. The seed alone says
which cases come and in which order; the time says after how many of them it ends. Each is made of
a seed of its own, so that a violation can be run again: ``--only numbers:SEED``. Exits 1 if there
is a violation; the smallest input of each is written into ``--out``.
"""

from __future__ import annotations

import argparse
import os
import random
import sys
import tempfile
import time
from collections.abc import Callable, Collection, Iterator
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parent))

import documents
import numbers_ as numbers
import processes
import torch
from outcome import Tally

#: How many cases in a round are of each kind: about the same time for numbers, files and processes.
ROUND = {"numbers": 8, "documents": 60, "kill": 4, "disk": 2, "cache": 1}


def main(argv: list[str] | None = None) -> int:
    """Run it; 1 if something was found."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--seconds", type=float, default=120.0)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--out", type=Path, default=Path("report/fuzz"))
    parser.add_argument("--only", help="KIND or KIND:SEED")
    args = parser.parse_args(argv)
    torch.set_num_threads(1)
    tally = Tally(args.out)
    with tempfile.TemporaryDirectory() as temporary:
        folder = Path(temporary)
        os.environ.setdefault("DIFFFILTER_CACHE", str(folder / "compiled"))
        kinds: dict[str, Callable[[int], None]] = {
            "numbers": lambda seed: numbers.case(seed, tally),
            "documents": lambda seed: documents.case(seed, tally, folder),
            "kill": lambda seed: processes.kill(seed, tally, folder),
            "disk": lambda seed: processes.disk(seed, tally, folder),
            "cache": lambda seed: processes.cache(seed, tally, folder),
        }
        documents.originals("log", folder)
        only, _, seed = (args.only or "").partition(":")
        if seed:
            kinds[only](int(seed))
        else:
            chosen = {name: kinds[name] for name in ([only] if only else kinds)}
            _run(chosen, args.seconds, args.seed, tally)
    print(tally.text())
    if not args.only:
        tally.save()
    return 1 if tally.counts["violations"] else 0


def order(seed: int, kinds: Collection[str]) -> Iterator[str]:
    """The kind of each case without end: round after round, each in an order of its own."""
    rng = random.Random(seed)
    rounds = [kind for kind in ROUND if kind in kinds for _ in range(ROUND[kind])]
    while True:
        yield from rng.sample(rounds, len(rounds))


def _run(kinds: dict[str, Callable[[int], None]], seconds: float, seed: int, tally: Tally) -> None:
    """Cases in their order until the time is over."""
    begun = told = time.monotonic()
    for made, kind in enumerate(order(seed, kinds)):
        if (now := time.monotonic()) - begun >= seconds:
            return
        kinds[kind]((seed << 32) + made)
        tally.counts[f"cases: {kind}"] += 1
        tally.counts["seconds"] = round(time.monotonic() - begun)
        if now - told > 60.0:
            told = now
            tally.save()
            print(f"{told - begun:.0f} s: {tally.counts['steps']:,} steps", flush=True)


if __name__ == "__main__":
    sys.exit(main())
