"""Shared settings and fixtures."""

from __future__ import annotations

import os
from collections.abc import Iterator

import numpy as np
import pytest
import torch
from hypothesis import settings

from difffilter.engine import build

# Tests that are not about the compiled engine do not wait for a compiler.
os.environ.setdefault("DIFFFILTER_ENGINE", "torch")

settings.register_profile("difffilter", deadline=None, derandomize=True, max_examples=60)
settings.load_profile("difffilter")


@pytest.fixture(scope="session", autouse=True)
def own_cache(tmp_path_factory: pytest.TempPathFactory) -> Iterator[None]:
    """Compiled steps of the tests do not touch the user's cache."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("DIFFFILTER_CACHE", str(tmp_path_factory.getbasetemp() / "cache"))
        yield


@pytest.fixture
def quick_compiler(monkeypatch: pytest.MonkeyPatch) -> None:
    """Compile without optimising: derivatives are right or wrong either way."""
    assert build._flags("")[0] == "-O2"
    monkeypatch.setattr(build, "_flags", lambda source: ("-O0", *build.FLAGS))


@pytest.fixture
def rng() -> np.random.Generator:
    """Random numbers, the same in every run."""
    return np.random.default_rng(20240817)


@pytest.fixture
def generator() -> torch.Generator:
    """Random tensors, the same in every run."""
    return torch.Generator().manual_seed(20240817)
