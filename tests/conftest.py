"""Shared settings and fixtures."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from hypothesis import settings

settings.register_profile("difffilter", deadline=None, derandomize=True, max_examples=60)
settings.load_profile("difffilter")


@pytest.fixture
def rng() -> np.random.Generator:
    """Random numbers, the same in every run."""
    return np.random.default_rng(20240817)


@pytest.fixture
def generator() -> torch.Generator:
    """Random tensors, the same in every run."""
    return torch.Generator().manual_seed(20240817)
