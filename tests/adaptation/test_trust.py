"""Trust traps: equation 16 against equation 11, and their figure."""

from __future__ import annotations

from itertools import pairwise

import numpy as np
import pytest
import torch
from helpers import array, tensor
from hypothesis import assume, given
from hypothesis import strategies as st

from difffilter.adaptation.trust import credibility_share, trap_width, trust_gap
from difffilter.reports.figures.surface import surface_figure

ERRORS = st.floats(-20, 20)


def share(own: float, others: float, systems: int) -> float:
    """Equation 11, one system of N, in plain numbers."""
    inverse = [1 / own**2] + [1 / others**2] * (systems - 1)
    return inverse[0] / sum(inverse)


@given(a=ERRORS, b=ERRORS, systems=st.integers(2, 30))
def test_the_gap_is_the_difference_of_equation_11(a: float, b: float, systems: int) -> None:
    assume(min(abs(a), abs(b), abs(a - 1), abs(b - 1)) > 1e-3)
    expected = share(a, b, systems) - share(a - 1, b - 1, systems)
    found = float(trust_gap(tensor(a), tensor(b), systems))
    assert found == pytest.approx(expected, abs=1e-9)
    assert -1.0 <= found <= 1.0


@given(own=ERRORS, others=ERRORS, systems=st.integers(2, 30))
def test_a_share_is_equation_11(own: float, others: float, systems: int) -> None:
    assume(min(abs(own), abs(others)) > 1e-3)
    found = float(credibility_share(tensor(own), tensor(others), systems))
    assert found == pytest.approx(share(own, others, systems), rel=1e-12)


def test_equal_errors_leave_no_gap_and_erring_with_the_prediction_is_a_trap() -> None:
    same = tensor(np.linspace(-3, 0.9, 20))
    assert not trust_gap(same, same, 4).any()
    assert float(trust_gap(tensor(1.0), tensor(0.1), 2)) < -0.95
    assert float(trust_gap(tensor(0.1), tensor(1.0), 2)) > 0.95


def width(b: float, systems: int, depth: float) -> float:
    """Length of the trap around a = 1 by bisection of both edges."""

    def gap(a: float) -> float:
        return share(a, b, systems) - share(a - 1, b - 1, systems)

    edges = []
    for outside in (b + 1e-6, 5.0):
        inside = 1.0 + 1e-9
        for _ in range(60):
            middle = 0.5 * (inside + outside)
            inside, outside = (middle, outside) if gap(middle) < -depth else (inside, middle)
        edges.append(inside)
    return abs(edges[1] - edges[0])


@pytest.mark.parametrize("systems", [2, 3, 5, 10])
def test_the_width_of_a_trap_is_where_the_gap_is_deep(systems: int) -> None:
    assert trap_width(0.1, systems) == pytest.approx(width(0.1, systems, 0.5), abs=2e-4)
    deeper = trap_width(0.1, systems, depth=0.8)
    assert deeper == pytest.approx(width(0.1, systems, 0.8), abs=2e-4)


@pytest.mark.parametrize("b", [0.05, 0.1, 0.2])
def test_traps_narrow_as_systems_are_added(b: float) -> None:
    widths = [trap_width(b, systems) for systems in (2, 3, 5, 10, 20)]
    assert widths[-1] > 0.0
    assert all(wide > narrow for wide, narrow in pairwise(widths))


def test_a_surface_is_drawn_with_a_panel_per_entry_and_marked_points() -> None:
    x, y = [0.1, 1.0, 10.0], [1.0, 2.0, 4.0, 8.0]
    table = [[1.0 + i * j for i in range(3)] for j in range(4)]
    figure = surface_figure(
        {"one": table, "two": table, "three": table}, x, y, "process noise", "kappa", "delta (m)",
        points={"tuned": (1.0, 2.0), "published": (0.2, 4.0)},
    )  # fmt: skip
    panels = [ax for ax in figure.axes if ax.get_title()]
    assert [ax.get_title() for ax in panels] == ["one", "two", "three"]
    bars = [ax for ax in figure.axes if ax.get_ylabel() == "delta (m)"]
    assert len(bars) == 3
    for ax in panels:
        assert (ax.get_xlabel(), ax.get_ylabel()) == ("process noise", "kappa")
        assert (ax.get_xscale(), ax.get_yscale()) == ("log", "log")
        drawn = {line.get_label(): line.get_xydata()[0].tolist() for line in ax.get_lines()}  # type: ignore[index]
        assert drawn == {"tuned": [1.0, 2.0], "published": [0.2, 4.0]}
        legend = ax.get_legend()
        assert legend is not None
        assert [text.get_text() for text in legend.get_texts()] == ["tuned", "published"]
    colours = {line.get_label(): line.get_markerfacecolor() for line in panels[0].get_lines()}
    assert colours["tuned"] != colours["published"]


def test_a_signed_surface_has_plain_axes_and_levels_about_zero() -> None:
    a = torch.linspace(-2.0, 3.0, 11).double()
    gap = array(trust_gap(a[None, :] + 0.01, a[:, None] + 0.02, 2))
    figure = surface_figure(
        {"two systems": gap.tolist()}, a.tolist(), a.tolist(), "a", "b", "gap",
        log=(False, False), columns=1, diverging=True,
    )  # fmt: skip
    (panel,) = [ax for ax in figure.axes if ax.get_title()]
    assert (panel.get_xscale(), panel.get_yscale()) == ("linear", "linear")
    assert panel.get_legend() is None
    low, high = panel.collections[0].get_clim()
    assert low == pytest.approx(-high)
