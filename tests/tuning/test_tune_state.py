"""The resumable state of a tuning run: whole, or refused; never unpickled."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest
import torch
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from difffilter.errors import CheckpointError
from difffilter.tuning.state import load_state, save_state


@pytest.fixture(scope="module")
def state(tmp_path_factory: pytest.TempPathFactory) -> bytes:
    """A sound state file."""
    path = tmp_path_factory.mktemp("state") / "x.state.pt"
    parameter = torch.nn.Parameter(torch.ones(3).double())
    optimiser = torch.optim.Adam([parameter])
    parameter.sum().backward()
    optimiser.step()
    history = [{"step": 0, "validation": 1.5, "values": {"a": [1.0, 2.0]}}]
    content = {"fingerprint": "mine", "raw": [torch.arange(4.0).double()], "history": history}
    save_state(path, content | {"optimiser": optimiser.state_dict()})
    assert load_state(path, "mine")["history"] == history
    return path.read_bytes()


def refused(tmp_path: Path, content: bytes) -> None:
    path = tmp_path / "x.state.pt"
    path.write_bytes(content)
    with pytest.raises(CheckpointError, match=r"x\.state\.pt: "):
        load_state(path, "mine")


@settings(max_examples=100, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(share=st.floats(0.0, 1.0, exclude_max=True))
def test_a_state_cut_anywhere_is_refused(tmp_path: Path, state: bytes, share: float) -> None:
    refused(tmp_path, state[: int(share * len(state))])


@settings(max_examples=100, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(share=st.floats(0.0, 1.0, exclude_max=True), change=st.integers(1, 255))
def test_a_state_with_any_byte_changed_is_refused(
    tmp_path: Path, state: bytes, share: float, change: int
) -> None:
    content = bytearray(state)
    content[int(share * len(state))] ^= change
    refused(tmp_path, bytes(content))


class Evil:
    """Unpickling it would create a file."""

    def __init__(self, path: str) -> None:
        self.path = path

    def __reduce__(self) -> tuple[Any, ...]:
        return open, (self.path, "w")


def test_a_pickle_is_refused_and_never_run(tmp_path: Path, state: bytes) -> None:
    import pickle

    trace = tmp_path / "trace"
    content = pickle.dumps(Evil(str(trace)))
    refused(tmp_path, content)
    torch.save({"fingerprint": "mine", "x": Evil(str(trace))}, tmp_path / "evil.pt")
    refused(tmp_path, (tmp_path / "evil.pt").read_bytes())
    save_state(tmp_path / "x.state.pt", {"fingerprint": "mine", "x": Evil(str(trace))})
    with pytest.raises(CheckpointError, match="damaged"):  # a forged digest: still weights alone
        load_state(tmp_path / "x.state.pt", "mine")
    assert not trace.exists()


def test_a_state_that_cannot_be_read_is_refused(tmp_path: Path) -> None:
    (tmp_path / "x.state.pt").mkdir()
    with pytest.raises(CheckpointError, match=r"x\.state\.pt: cannot be read"):
        load_state(tmp_path / "x.state.pt", "mine")
