"""Random junk anywhere in a scenario raises an input error or nothing."""

from __future__ import annotations

import copy
from typing import Any

from hypothesis import given, settings
from hypothesis import strategies as st

from difffilter.errors import InputError
from difffilter.scenario.document import read_document
from difffilter.scenario.scenario import read_scenario

A, U = "airport-mlat", "uwb-ranges"
HUGE = 10**400


def _places(node: Any, path: tuple[Any, ...] = ()) -> list[tuple[Any, ...]]:
    children = node.items() if isinstance(node, dict) else enumerate(node)
    found = []
    for key, value in children:
        found.append((*path, key))
        if isinstance(value, (dict, list)):
            found += _places(value, (*path, key))
    return found


DOCUMENTS = {name: read_document(name) for name in (A, U)}
PLACES = [(name, place) for name in (A, U) for place in _places(DOCUMENTS[name][0])]
JUNK = st.recursive(
    st.one_of(
        st.none(), st.booleans(), st.integers(-3, 12), st.just(HUGE), st.just(-HUGE),
        st.floats(), st.text(max_size=4), st.datetimes(),
        st.sampled_from(["tdoa", "ekf", "m-ekf", "filter", "constant", "zero", "position", "a.b"]),
    ),
    lambda inner: st.one_of(
        st.lists(inner, max_size=4), st.dictionaries(st.text(max_size=5), inner, max_size=3)
    ),
    max_leaves=8,
)  # fmt: skip


@settings(max_examples=250)
@given(place=st.sampled_from(PLACES), junk=JUNK, more=st.booleans(), key=st.text(max_size=8))
def test_junk_in_any_place_raises_an_input_error_or_nothing(
    place: tuple[str, tuple[Any, ...]], junk: Any, more: bool, key: str
) -> None:
    name, where = place
    document = copy.deepcopy(DOCUMENTS[name][0])
    table: Any = document
    for step in where[:-1]:
        table = table[step]
    if more and isinstance(table, dict):
        table[key] = junk
    else:
        table[where[-1]] = junk
    try:
        scenario = read_scenario(document, DOCUMENTS[name][1])
    except InputError as error:
        message = str(error)
    else:
        message = " ".join(scenario.systems)
    assert message
