"""The gallery's models: tuned, compared, drawn, judged, timed; writes their pages' results.

python -m docs.make.gallery [NAME ...] [--quick]      # all, or the pages named
"""

from __future__ import annotations

import re
import sys
import tempfile
import time
from dataclasses import dataclass, field
from pathlib import Path

import torch

from difffilter import Log, Model, Report, TuneResult, compare, load_models, run, tune
from difffilter.reports.figures.style import COLOURS, axes_grid, save_figure
from difffilter.verdict.judge import verdict
from docs.make.docs_tables import put

__all__ = ["PAGES", "Page", "main", "write_model"]

ROOT = Path(__file__).resolve().parents[2]
FOLDER = ROOT / "docs" / "gallery"
FILE = re.compile(r"^```python\n(# (\w+)\.py\n.*?)^```$", re.MULTILINE | re.DOTALL)
#: Trajectories and rows on which the engines are timed.
TIMED = 64


@dataclass(frozen=True)
class Page:
    """How a page's model is tuned, and what its figure shows.

    Attributes:
        factory: function of the page's file.
        tuned: patterns of parameters; loss, settings: of the tuning.
        shown: states whose errors are drawn; unit, factor: of the drawing.
    """

    factory: str
    tuned: tuple[str, ...]
    loss: dict[str, float]
    shown: tuple[str, ...]
    unit: str = "m"
    factor: float = 1.0
    settings: dict[str, float | str] = field(default_factory=dict)


PAGES = {
    "radar": Page(
        factory="model",
        tuned=("motion.*", "*.sigma", "huber.k"),
        loss={"position": 1.0, "consistency": 0.3},
        shown=("x", "y"),
    ),
    "lorenz": Page(
        factory="model",
        tuned=("lorenz.*", "gauge.sigma", "huber.k"),
        loss={"position": 1.0, "consistency": 0.3},
        shown=("a", "c"),
        unit="1",
    ),
}


def write_model(name: str, folder: Path) -> Path:
    """The model file that a page shows, written into a folder."""
    for source, stem in FILE.findall((FOLDER / f"{name}.md").read_text(encoding="utf-8")):
        if stem == name:
            path = folder / f"{name}.py"
            path.write_text(source, encoding="utf-8")
            return path
    raise ValueError(f"{name}.md: found no python block that begins with # {name}.py")


def loaded(name: str, factory: str) -> Model:
    """The model of a page."""
    with tempfile.TemporaryDirectory() as folder:
        module = load_models(write_model(name, Path(folder)))
    made = getattr(module, factory)()
    assert isinstance(made, Model)
    return made


def tuned(page: Page, model: Model, engine: str, settings: dict[str, float | str]) -> TuneResult:
    """The page's tuning."""
    return tune(
        model,
        tuned=page.tuned,
        loss=page.loss,
        settings={**page.settings, **settings},
        engine=engine,
    )


def ratio(page: Page, model: Model) -> float:
    """How many times as long a gradient step of Adam takes by torch as by the engine.

    Each is the difference of two tunings, of few and of more steps: what both do alike
    (drawing logs, compiling, validation) is not counted.
    """
    common: dict[str, float | str] = {
        "trajectories": TIMED, "batch": TIMED, "validation": 2, "test": 2, "optimiser": "adam",
        "evaluate_every": 1000, "patience": 1000,
    }  # fmt: skip

    def seconds(engine: str, steps: int) -> float:
        began = time.perf_counter()
        tuned(page, model, engine, common | {"steps": steps})
        return time.perf_counter() - began

    def per_step(engine: str, few: int, many: int) -> float:
        seconds(engine, few)  # compiled, and everything imported
        return (seconds(engine, many) - seconds(engine, few)) / (many - few)

    return per_step("torch", 1, 3) / per_step("fused", 1, 101)


def figure(page: Page, model: Model, result: TuneResult, path: Path) -> None:
    """Errors of one held-out trajectory with their standard deviations, before and after."""
    log = model.started(model.simulated(1, 3, "picture"))
    drawn, axes = axes_grid(1, len(page.shown))
    for values, recipe in (
        ("published", model.recipe),
        ("tuned", result.checkpoint.filter),
    ):
        track = run(recipe, log, engine="fused")
        for name, ax in zip(page.shown, axes, strict=True):
            _draw(ax, page, log, track, name, values)
    for name, ax in zip(page.shown, axes, strict=True):
        ax.set(xlabel="time (s)", ylabel=f"error of {name} ({page.unit})")
        ax.legend(fontsize=8)
    save_figure(drawn, path)


def _draw(ax: object, page: Page, log: Log, track: object, name: str, values: str) -> None:
    """One state's error and band of one standard deviation to either side."""
    from difffilter.scoring.differences import difference

    at = track.errors.index(name)  # type: ignore[attr-defined]
    error = page.factor * difference(log, track, [name])[:, 0, 0]  # type: ignore[arg-type]
    std = page.factor * track.std[:, 0, at]  # type: ignore[attr-defined]
    time, colour = log.time, COLOURS[values]
    ax.plot(time, error, color=colour, lw=1.0, label=values)  # type: ignore[attr-defined]
    ax.fill_between(time, -std, std, color=colour, alpha=0.2, lw=0)  # type: ignore[attr-defined]


def results(name: str, quick: bool = False) -> str:
    """Everything below a page's marker, as Markdown."""
    page, small = PAGES[name], {}
    if quick:
        small = {"trajectories": 16, "validation": 8, "test": 8, "steps": 2}
    model = loaded(name, page.factory)
    began = time.perf_counter()
    result = tuned(page, model, "fused", small)
    took = time.perf_counter() - began
    held = compare(model, {"published": None, "tuned": result.checkpoint}, 20 if quick else 200, 1)
    with tempfile.TemporaryDirectory() as folder:
        report = Report(folder, name)
        advice = verdict(report, result.checkpoint, 20 if quick else 200, 1, engine="fused")
    figure(page, model, result, ROOT / "docs" / "images" / f"gallery-{name}")
    errors = result.checkpoint.training.get("standard_errors", {})
    lines = ["| parameter | by hand | tuned | standard error | unit |", "|---|---|---|---|---|"]
    for key, p in result.checkpoint.published_filter.declarations.items():
        if p.tuned:
            before, after = (
                x.reshape(-1).tolist() for x in (p.tensor(), result.checkpoint.values[key])
            )
            for entry, old, new in zip(p.entries(), before, after, strict=True):
                error = errors.get(entry)
                told = "" if error is None else f"{error:.2g}"
                lines.append(f"| `{entry}` | {old:.4g} | {new:.4g} | {told} | {p.unit} |")
    return "\n".join([
        *lines, "", held.markdown().strip(), "",
        f"![Errors of one held-out run](../images/gallery-{name}.png)", "",
        f"The verdict: {advice}", "",
        f"Tuned by the compiled engine in {took:.0f} s; a gradient step takes torch "
        f"{ratio(page, model):.0f} times as long.", "",
    ])  # fmt: skip


def main(words: list[str]) -> int:
    """Write the results of the pages named, or of all."""
    torch.set_num_threads(1)
    names = [word for word in words if not word.startswith("-")] or list(PAGES)
    for name in names:
        put(
            FOLDER / f"{name}.md",
            "results",
            results(name, "--quick" in words),
            "docs/make/gallery.py",
        )
        print(f"docs/gallery/{name}.md written")
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
