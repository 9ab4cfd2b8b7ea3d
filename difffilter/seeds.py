"""Random streams: one per purpose, so that splits and draws never share numbers."""

from __future__ import annotations

import hashlib

import torch
from torch import Generator

__all__ = ["stream"]


def stream(seed: int, *purpose: str | int) -> Generator:
    """A generator that depends on the seed and the purpose alone.

    Streams with different purposes (``"train"``, ``"test"``, a fault's name) are
    independent; changing one part of a world leaves the draws of the others as they were.
    """
    text = "/".join(str(part) for part in (seed, *purpose))
    digest = hashlib.sha256(text.encode()).digest()
    return torch.Generator().manual_seed(int.from_bytes(digest[:8], "big") >> 1)
