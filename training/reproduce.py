"""Runs every experiment and its verdict, writes report/; ``make reproduce`` calls it.

Experiments run side by side, one per core: each is a process of its own, whose stages drive a
progress bar here and whose output goes to report/NAME/run.log. After it ``difffilter report``
judges the values that it froze, on data of another seed, into report/NAME/verdict.

    python -m training.reproduce [--quick] [--seed S] [--out report]
"""

from __future__ import annotations

import argparse
import json
import os
import subprocess
import sys
import time
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any, TextIO

from tqdm import tqdm

from difffilter import write_index as write_table
from difffilter.files import json_text, write_atomically
from difffilter.reports.page import page
from difffilter.reports.report import HELD, Report
from training.common import ROOT, recordings

EXPERIMENTS = {
    "airport-mlat": "training.airport.run",
    "airborne-bearing": "training.bearing.run",
    "manoeuvre-fusion": "training.manoeuvre.run",
    "urban-credibility": "training.urban.run",
    "uwb-ranges": "training.uwb.run",
    "weights": "docs.make.weights",
}

#: Checkpoints that are judged after each experiment, and tunings per method of the contest.
VERDICTS = {
    "airport-mlat": ("airport-mlat-intermittent", "airport-mlat-literal-50ns", "airport-mlat"),
    "airborne-bearing": ("airborne-bearing", "airborne-bearing-multipath",
                         "airborne-bearing-clean", "airborne-bearing-matched"),
    "manoeuvre-fusion": ("manoeuvre-fusion-1", "manoeuvre-fusion-2"),
    "urban-credibility": ("urban-credibility",),
    "uwb-ranges": ("uwb-simulated",),
}  # fmt: skip
#: The recorded run that the verdict on recordings holds out.
HELD_OUT = "nlos_A2"


def main() -> int:
    """Run all; exit 1 if one failed."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--quick", action="store_true", help="small sizes")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--out", type=Path, default=ROOT / "report")
    options = parser.parse_args()
    options.out = options.out.resolve()
    began = time.monotonic()
    bars = {
        name: tqdm(
            desc=name,
            total=1,
            position=place,
            bar_format="{desc:14} |{bar:20}| {elapsed} {postfix}",
        )
        for place, name in enumerate(EXPERIMENTS)
    }
    with ThreadPoolExecutor(max_workers=max(os.cpu_count() or 1, 1)) as pool:
        jobs = {
            name: pool.submit(follow, name, module, bars[name], options)
            for name, module in EXPERIMENTS.items()
        }
        while not all(job.done() for job in jobs.values()):
            time.sleep(1.0)
            for bar in bars.values():
                bar.refresh()  # the clock goes on within a stage
        codes = {name: job.result() for name, job in jobs.items()}
    for bar in bars.values():
        bar.close()
    index = write_index(options.out)
    print(f"\n{time.monotonic() - began:.0f} s; report: {index}")
    for name, code in codes.items():
        if code:
            print(f"{name}: failed with exit code {code}, see {options.out / name / 'run.log'}")
    return int(any(codes.values()))


def follow(name: str, module: str, bar: tqdm, options: argparse.Namespace) -> int:
    """Run one experiment and its verdict; their ``[i/n] text`` lines drive the bar."""
    folder = options.out / name
    folder.mkdir(parents=True, exist_ok=True)
    command = ["-m", module, "--quiet", "--seed", str(options.seed)]
    command += ["--out", str(folder), *(["--quick"] if options.quick else [])]
    with (folder / "run.log").open("w") as log:
        code = drive(command, log, bar)
        for verdict in verdicts(name, options) if code == 0 else []:
            bar.set_postfix_str(f"verdict on {Path(verdict[0]).stem}")
            code = code or drive(["-m", "difffilter", "report", *verdict], log, bar)
    if code == 0:
        bar.n = bar.total
    return code


def verdicts(name: str, options: argparse.Namespace) -> list[list[str]]:
    """Arguments of ``difffilter report`` for each part of an experiment's verdict."""
    if not (options.out / name / "report.json").is_file():
        return []  # recordings absent
    frozen = options.out / name if options.quick else ROOT / "checkpoints"
    size = ["--trajectories", "8"] if options.quick else ["--trajectories", "200"]
    size += ["--contest", "0" if options.quick else "3", "--seed", str(options.seed + 5)]
    parts = []
    files = [frozen / f"{stem}.json" for stem in VERDICTS.get(name, ())]
    files = [str(path) for path in files if path.is_file()][: 1 if options.quick else None]
    if files:
        out = options.out / name / "verdict"
        parts.append([*files, *size, "--quiet", "--out", str(out)])
    rotated = options.out / name / f"uwb-ranges-without-{HELD_OUT}.json"
    if rotated.is_file():
        runs = {path.stem: str(path) for path in sorted(recordings().glob("*os_A*.csv"))}
        held = runs.pop(HELD_OUT)
        out = options.out / name / "verdict-recorded"
        parts.append([str(rotated), "--log", held, "--train", *runs.values(), *size, "--quiet",
                      "--out", str(out)])  # fmt: skip
    return parts


def drive(command: list[str], log: TextIO, bar: tqdm) -> int:
    """Run Python with these arguments, output into ``log``; the exit code."""
    environment = {**os.environ, "OMP_NUM_THREADS": "1", "PYTHONUNBUFFERED": "1"}
    pipe = {"stdout": subprocess.PIPE, "stderr": subprocess.STDOUT, "text": True}
    with subprocess.Popen([sys.executable, *command], env=environment, cwd=ROOT, **pipe) as process:
        for line in process.stdout or ():
            log.write(line)
            log.flush()
            if line.startswith("["):
                place, _, text = line[1:].partition("]")
                at, _, total = place.partition("/")
                bar.total, bar.n = int(total) + 1, int(at) - 1
                bar.set_postfix_str(f"{place} {text.strip()[-60:]}")
    return process.returncode


def write_index(folder: Path) -> Path:
    """What to do about each checkpoint, and the claims: README.md, index.json, index.html.

    One table, a row per checkpoint, the best grade first; experiments have pages of their own.
    """
    lines, pages = [], []
    advised: dict[str, str] = {}
    judged: dict[str, dict[str, Any]] = {}
    claimed: dict[str, list[dict[str, Any]]] = {}
    for name in EXPERIMENTS:
        parts = [
            f"{name}/{part}".removesuffix("/.") for part in ("verdict", "verdict-recorded", ".")
        ]
        parts = [part for part in parts if (folder / part / "report.json").is_file()]
        if not parts:
            lines += [f"- {name}: no report (recordings absent, or the run failed)"]
            continue
        for part in parts:
            found = json.loads((folder / part / "report.json").read_text(encoding="utf-8"))
            advised |= found["verdicts"]
            for case, data in found["judged"].items():
                judged[case] = data | {"page": f"{part}/{data['page']}"}
            claimed.setdefault(name, []).extend(found["claims"])
        if parts[-1] == name:
            pages.append(f'<a href="{name}/report.html">{name}</a>')
        lines += claims_of(name, claimed[name])
    table = Report(folder, "Published against tuned")
    write_table(table, judged)
    path = folder / "index.html"
    body = [*table.body, "<h2>Experiments</h2>", f"<nav>{' '.join(pages)}</nav>"]
    write_atomically(path, page("Published against tuned", body))
    data = json_text({"verdicts": advised, "judged": judged, "claims": claimed})
    write_atomically(folder / "index.json", data + "\n")
    short = [f"**{case}: {text.partition(':')[0]}.**" for case, text in advised.items()]
    text = "\n".join(["# Reports", "", *(f"- {line}" for line in short), "", *lines])
    write_atomically(folder / "README.md", text + "\n")
    return path


def claims_of(name: str, claims: list[dict[str, Any]]) -> list[str]:
    """How many claims held, and which did not."""
    held, missed, unknown = (sum(c["held"] is x for c in claims) for x in (True, False, None))
    first = (
        f"- [{name}]({name}/report.md): {held} of {held + missed} claims held, "
        f"{unknown} cannot be checked"
    )
    return [first, *(f"  - {HELD[False]}: {c['claim']}" for c in claims if c["held"] is False)]


if __name__ == "__main__":
    sys.exit(main())
