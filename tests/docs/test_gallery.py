"""The gallery's models: of few lines, equal to filters in NumPy, exported C that repeats them."""

from __future__ import annotations

import subprocess
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from oracles import own

from difffilter import Checkpoint, Filter, Log, Model, export_c, load_models, plain, run
from difffilter.engine.build import compiler
from docs.make.gallery import FOLDER, PAGES, write_model

NAMES = sorted(PAGES)


def made(name: str, folder: Path) -> Model:
    """A page's model."""
    factory = getattr(load_models(write_model(name, folder)), PAGES[name].factory)
    model = factory()
    assert isinstance(model, Model)
    return model


def test_every_page_is_tuned_by_the_script() -> None:
    assert sorted(p.stem for p in FOLDER.glob("*.md") if p.stem != "index") == NAMES


@pytest.mark.parametrize("name", NAMES)
def test_a_model_has_sixty_lines_at_most(name: str, tmp_path: Path) -> None:
    lines = write_model(name, tmp_path).read_text(encoding="utf-8").splitlines()
    assert sum(bool(line.strip()) for line in lines) <= 60


@pytest.mark.parametrize("name", NAMES)
def test_the_plain_filter_is_that_of_numpy(name: str, tmp_path: Path) -> None:
    model = made(name, tmp_path)
    assert isinstance(model.recipe, Filter)
    recipe = replace(model.recipe, weight=plain, gate=None)
    batch = model.started(model.simulated(2, 1, "oracle"))
    log = _single(batch, 12)
    track = run(recipe, log, engine="torch")
    values = {n: v.numpy() for n, v in recipe.published().items()}
    oracle = getattr(own, name)(values, {n: v.numpy() for n, v in log.inputs.items()})
    assert batch.start is not None
    assert batch.start.covariance is not None
    mean, cov = batch.start.mean[0].numpy(), batch.start.covariance[0].numpy()
    begin = batch.start.time if batch.start.time is not None else float(log.time[0])
    means, covs = own.ekf(oracle, log.time.numpy(), log.z.numpy(), mean, cov, begin)
    scale = np.sqrt(np.einsum("tii->ti", covs))
    size = scale if len(recipe.states) == len(recipe.error_states) else 0.01
    assert np.abs((track.mean.numpy() - means) / size).max() < 1e-9
    both = scale[:, :, None] * scale[:, None, :]
    assert np.abs((track.covariance.numpy() - covs) / both).max() < 1e-9


def _single(log: Log, rows: int) -> Log:
    """The first trajectory without its dimension, its first rows with every fifth channel lost."""
    start = log.start
    assert start is not None
    assert start.covariance is not None
    one = replace(start, mean=start.mean[0], covariance=start.covariance[0])
    z = log.z[:rows, 0].clone()
    z.view(-1)[::5] = torch.nan
    inputs = {n: v[:rows, 0] if v.dim() > 1 else v[:rows] for n, v in log.inputs.items()}
    time = log.time if log.time.dim() == 1 else log.time[:, 0]
    return Log(log.channels, time[:rows], z, inputs=inputs, start=one)


@pytest.mark.skipif(compiler() is None, reason="no C compiler")
@pytest.mark.parametrize("name", NAMES)
def test_exported_c_passes_its_self_test(name: str, tmp_path: Path) -> None:
    model = made(name, tmp_path)
    export_c(Checkpoint(model, model.name, model.recipe.published()), tmp_path, name)
    files = [tmp_path / f"{name}.c", tmp_path / f"{name}_test.c"]
    program = tmp_path / "program"
    flags = ["-std=c99", "-Wall", "-Wextra", "-Werror", "-pedantic", "-O0"]
    subprocess.run([compiler() or "cc", *flags, *files, "-lm", "-o", program], check=True)
    done = subprocess.run([program], capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stdout
