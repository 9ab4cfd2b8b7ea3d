"""How a tuning ends is told; what cannot be known is unknown; a second run is refused."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest
import torch
from cli_helpers import environment
from torch import Tensor
from tune_cases import FEW, airport

from difffilter.errors import CheckpointError, InputError
from difffilter.parameters.constraints import Positive
from difffilter.parameters.parameters import Parameter, ParameterSet
from difffilter.tuning.curvature import Expansion
from difffilter.tuning.loop import tune
from difffilter.tuning.standard_errors import certainty
from difffilter.tuning.state import load_state, only_run, save_state


def hill(at: float) -> tuple[ParameterSet, Any]:
    """A sigma whose loss is (log sigma)^2 / 2, determined to 5 %, and where it stands."""
    parameter = Parameter("radar.sigma", at, Positive(), tuned=True)
    parameters = ParameterSet({"radar.sigma": parameter})
    (raw,) = parameters.free().values()

    def expand() -> Expansion:
        u = raw.detach().reshape(1)
        one = torch.eye(1, dtype=u.dtype)
        return Expansion(float(0.5 * u * u), {}, u.clone(), one, 0.05**2 * one)

    return parameters, expand


def test_a_tuning_that_ended_on_its_way_does_not_blame_the_data() -> None:
    parameters, expand = hill(2.0)
    early = certainty(parameters, expand, 10, capped=True)
    assert early.errors == {"radar.sigma": None}
    assert early.free == (
        "radar.sigma: the tuning ended before their best values, give it more steps",
    )
    late = certainty(parameters, expand, 10, capped=False)
    assert late.free == ("radar.sigma: the data do not determine it, or push it to its bound",)
    parameters, expand = hill(1.0)
    there = certainty(parameters, expand, 10, capped=True)
    assert there.free == ()
    assert there.errors["radar.sigma"] == pytest.approx(0.05, rel=1e-6)


def test_one_window_alone_leaves_the_error_unknown() -> None:
    """Its gradient is zero at the optimum, whatever another window's would be."""
    parameters, expand = hill(1.0)
    alone = certainty(parameters, lambda: expand()._replace(spread=torch.zeros(1, 1).double()), 1)
    assert alone.errors == {"radar.sigma": None}
    assert alone.free == ()


@pytest.mark.parametrize(
    ("settings", "end"),
    [({"steps": 2}, "steps"), ({"runs": 1.0}, "runs"),
     ({"learning_rate": 6.0, "patience": 1, "evaluate_every": 1, "steps": 30}, "patience")],
)  # fmt: skip
def test_the_checkpoint_says_how_its_tuning_ended(settings: dict[str, Any], end: str) -> None:
    assert tune(airport(), settings=FEW | settings).checkpoint.training["end"] == end


HOLDING = """
import sys
from pathlib import Path
from difffilter.tuning.state import only_run
with only_run(Path(sys.argv[1])):
    print("held", flush=True)
    sys.stdin.read()
"""


def test_two_runs_into_one_file_are_one_too_many(tmp_path: Path) -> None:
    state = tmp_path / "x.state.pt"
    words = [sys.executable, "-c", HOLDING, str(state)]
    pipe = subprocess.PIPE
    with subprocess.Popen(words, stdin=pipe, stdout=pipe, text=True, env=environment()) as other:
        assert other.stdout is not None
        assert other.stdout.readline() == "held\n"
        with pytest.raises(InputError, match=r"x\.state\.pt: another run writes it"):
            tune(airport(), settings=FEW, out=tmp_path / "x.json")
        other.communicate()
    assert list(tmp_path.iterdir()) == []
    with only_run(state):
        pass


def test_what_a_kill_left_is_removed(tmp_path: Path) -> None:
    """And nothing else, nor what belongs to another run."""
    left, other = tmp_path / ".x.state.pt.ab12_xyz", tmp_path / ".y.state.pt.ab12_xyz"
    for path in (left, other):
        path.write_bytes(b"half")
    with only_run(tmp_path / "x.state.pt"):
        assert not left.exists()
        assert other.exists()
    assert os.listdir(tmp_path) == [other.name]


def test_a_state_with_a_right_digest_and_a_wrong_content_is_damaged(tmp_path: Path) -> None:
    path = tmp_path / "x.state.pt"
    content: dict[str, Tensor] = {"start": torch.zeros(1)}
    save_state(path, content)
    with pytest.raises(CheckpointError, match=r"x\.state\.pt: damaged"):
        load_state(path, "f" * 64)
