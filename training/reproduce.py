"""Runs every experiment and writes report/README.md; ``make reproduce`` calls it.

Experiments run side by side, one per core: each is a process of its own, whose stages drive a
progress bar here and whose output goes to report/NAME/run.log.

    python training/reproduce.py [--quick] [--seed S] [--out report]
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

from tqdm import tqdm

from difffilter import page
from difffilter.files import write_atomically
from difffilter.report import HELD

HERE = Path(__file__).resolve().parent
EXPERIMENTS = {
    "airport-mlat": "airport_mlat.py",
    "airborne-bearing": "airborne_bearing.py",
    "manoeuvre-fusion": "manoeuvre_fusion.py",
    "urban-credibility": "urban_credibility.py",
    "uwb-ranges": "uwb_ranges.py",
    "weights": "weights.py",
}


def main() -> int:
    """Run all; exit 1 if one failed."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--quick", action="store_true", help="small sizes")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--out", type=Path, default=HERE.parent / "report")
    options = parser.parse_args()
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
            name: pool.submit(follow, name, script, bars[name], options)
            for name, script in EXPERIMENTS.items()
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


def follow(name: str, script: str, bar: tqdm, options: argparse.Namespace) -> int:
    """Run one experiment; its ``[i/n] text`` lines drive the bar."""
    folder = options.out / name
    folder.mkdir(parents=True, exist_ok=True)
    command = [sys.executable, str(HERE / script), "--quiet", "--seed", str(options.seed)]
    command += ["--out", str(folder), *(["--quick"] if options.quick else [])]
    environment = {**os.environ, "OMP_NUM_THREADS": "1", "PYTHONUNBUFFERED": "1"}
    pipe = {"stdout": subprocess.PIPE, "stderr": subprocess.STDOUT, "text": True}
    with (
        (folder / "run.log").open("w") as log,
        subprocess.Popen(command, env=environment, **pipe) as process,
    ):
        for line in process.stdout or ():
            log.write(line)
            log.flush()
            if line.startswith("["):
                place, _, text = line[1:].partition("]")
                at, _, total = place.partition("/")
                bar.total, bar.n = int(total), int(at) - 1
                bar.set_postfix_str(f"{place} {text.strip()[-60:]}")
        if process.wait() == 0:
            bar.n = bar.total
    return process.returncode


def write_index(folder: Path) -> Path:
    """Links to every experiment's report, and its claims."""
    lines = ["# Reports", ""]
    for name in EXPERIMENTS:
        path = folder / name / "report.json"
        if not path.is_file():
            lines += [f"- {name}: no report (recordings absent, or the run failed)"]
            continue
        claims = json.loads(path.read_text())["claims"]
        held = sum(claim["held"] is True for claim in claims)
        lines += [f"- [{name}]({name}/report.md): {held} of {len(claims)} claims held"]
        lines += [f"  - {HELD[c['held']]}: {c['claim']}" for c in claims if not c["held"]]
    index = folder / "README.md"
    index.write_text("\n".join(lines) + "\n")
    write_page(folder)
    return index


def write_page(folder: Path) -> None:
    """All reports in one HTML page that stands alone."""
    links, bodies = [], []
    for name in EXPERIMENTS:
        path = folder / name / "report.html"
        if path.is_file():
            whole = path.read_text(encoding="utf-8")
            links.append(f'<a href="#{name}">{name}</a>')
            bodies.append(f'<h1 id="{name}">{name}</h1>')
            bodies.append(whole.partition(page.START)[2].partition(page.END)[0])
    body = [f"<nav>{' '.join(links)}</nav>", *bodies]
    write_atomically(folder / "index.html", page.page("Published against tuned", body))


if __name__ == "__main__":
    sys.exit(main())
