"""Log files: exact round trips, and an error with its line for whatever is wrong."""

from __future__ import annotations

import math
from pathlib import Path

import pytest
import torch
from helpers import tensor
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from difffilter.errors import InputError, LogError
from difffilter.logs.log import Log
from difffilter.logs.logfile import read_any, read_log, write_log

CHANNELS = ("tdoa_2", "tdoa_3")
NUMBERS = st.floats(allow_nan=False, allow_infinity=False)
TIMES = st.floats(-1e9, 1e9)
FIELDS = st.one_of(NUMBERS, st.just(math.nan))

GOOD = """\
time,tdoa_2,tdoa_3,truth_x
0.0,1.5,-2.5,10.0
0.5,,3.25,
1.25,1e3,,11.0
"""


@st.composite
def logs(draw: st.DrawFn) -> Log:
    times = draw(st.lists(TIMES, min_size=1, max_size=8, unique=True))
    rows, width = len(times), draw(st.integers(1, 3))
    z = draw(
        st.lists(st.lists(FIELDS, min_size=width, max_size=width), min_size=rows, max_size=rows)
    )
    wind = draw(st.lists(NUMBERS, min_size=rows, max_size=rows))
    truth = draw(st.one_of(st.none(), st.lists(FIELDS, min_size=rows, max_size=rows)))
    return Log(
        tuple(f"c_{i}" for i in range(width)),
        tensor(sorted(times)),
        tensor(z),  # type: ignore[arg-type]
        None if truth is None else tensor(truth).unsqueeze(-1),
        () if truth is None else ("x",),
        {"wind": tensor(wind)},
    )


def same(found: torch.Tensor, expected: torch.Tensor) -> bool:
    """Bit by bit, but for the sign of a NaN."""
    a, b = (x.nan_to_num(123.25, posinf=torch.inf, neginf=-torch.inf) for x in (found, expected))
    signs = torch.equal(a.signbit(), b.signbit())
    return torch.equal(found.isnan(), expected.isnan()) and torch.equal(a, b) and signs


@settings(suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(log=logs())
def test_what_is_written_is_read_back_exactly(tmp_path: Path, log: Log) -> None:
    path = tmp_path / "flight.csv"
    write_log(path, log)
    back = read_log(path, log.channels, ("wind",))
    assert same(back.z, log.z)
    assert same(back.time, log.time)
    assert same(back.inputs["wind"], log.inputs["wind"])
    assert back.channels == log.channels
    assert back.truth_states == log.truth_states
    assert back.names == ("flight",)
    if log.truth is not None:
        assert back.truth is not None
        assert same(back.truth, log.truth)


def read(tmp_path: Path, text: str | bytes, inputs: tuple[str, ...] = ()) -> Log:
    path = tmp_path / "log.csv"
    path.write_bytes(text.encode() if isinstance(text, str) else text)
    return read_log(path, CHANNELS, inputs)


def test_a_batch_of_one_is_written_as_its_trajectory(tmp_path: Path) -> None:
    time, z = tensor([0.0, 1.0]), tensor([[[1.0], [2.0]], [[3.0], [4.0]]])
    batch = Log(("a",), time, z, inputs={"wind": tensor([5.0, 6.0])})
    write_log(tmp_path / "one.csv", batch.select([1]))
    found = read_log(tmp_path / "one.csv", ["a"], ["wind"])
    assert found.z.tolist() == [[2.0], [4.0]]
    assert found.inputs["wind"].tolist() == [5.0, 6.0]
    with pytest.raises(InputError, match="expected one trajectory"):
        write_log(tmp_path / "two.csv", batch)


def test_an_empty_field_is_a_missing_channel(tmp_path: Path) -> None:
    log = read(tmp_path, GOOD)
    assert log.present.tolist() == [[True, True], [False, True], [True, False]]
    assert log.time.tolist() == [0.0, 0.5, 1.25]
    assert log.truth is not None
    assert log.truth.isnan().flatten().tolist() == [False, True, False]


VARIANTS = {
    "CRLF": GOOD.replace("\n", "\r\n").encode(),
    "byte order mark": b"\xef\xbb\xbf" + GOOD.encode(),
    "blank lines at the end": GOOD.encode() + b"\n\n",
    "no newline at the end": GOOD.encode().rstrip(b"\n"),
    "spaces": GOOD.replace(",", " , ").encode(),
    "quotes": GOOD.replace("1.5", '"1.5"').replace("tdoa_2", '"tdoa_2"').encode(),
}


@pytest.mark.parametrize("name", VARIANTS)
def test_what_other_tools_write_is_read_alike(tmp_path: Path, name: str) -> None:
    expected, found = read(tmp_path, GOOD), read(tmp_path, VARIANTS[name])
    assert same(found.z, expected.z)
    assert same(found.time, expected.time)
    assert found.truth_states == ("x",)


def test_columns_are_found_by_name_in_any_order(tmp_path: Path) -> None:
    log = read(tmp_path, "truth_x,tdoa_3,time,tdoa_2\n1,2,3,4\n")
    assert log.z.tolist() == [[4.0, 2.0]]
    assert log.time.tolist() == [3.0]


#: What replaces what in GOOD, and what the message must name.
ERRORS: dict[str, tuple[str, str, str]] = {
    "wrong column": ("tdoa_3", "tdoa_4", r"line 1: found columns .*; expected 'tdoa_3'"),
    "extra column": ("truth_x", "speed", r"line 1: found column 'speed', expected time, tdoa_2"),
    "no time column": ("time", "t", r"line 1: .*expected 'time' among them"),
    "column twice": ("tdoa_3", "tdoa_2", r"line 1: found column 'tdoa_2' twice"),
    "row too short": ("0.5,,3.25,", "0.5,,3.25", r"line 3: found 3 fields, expected 4"),
    "row too long": ("1e3,,11.0", "1e3,,11.0,7", r"line 4: found 5 fields, expected 4"),
    "text": ("3.25", "north", r"line 3, column tdoa_3: found 'north', expected a finite number"),
    "comma as point": ("3.25", "3;25", r"line 3, column tdoa_3: found '3;25'"),
    "underscore": ("1e3", "1_000", r"line 4, column tdoa_2: found '1_000'"),
    "other digits": ("1e3", "\N{ARABIC-INDIC DIGIT ONE}", r"line 4, column tdoa_2: found"),
    "infinite": ("-2.5", "-inf", r"line 2, column tdoa_3: found '-inf'"),
    "overflow": ("1e3", "1e400", r"line 4, column tdoa_2: found '1e400'"),
    "text in truth": ("11.0", "?", r"line 4, column truth_x: found '\?'"),
    "no time": ("0.5,,", ",,", r"line 3, column time: found nothing, expected a number"),
    "time repeated": ("1.25,", "0.5,", r"line 4, column time: found 0.5 after 0.5, expected incr"),
    "time back": ("1.25,", "0.25,", r"line 4, column time: found 0.25 after 0.5"),
    "blank line counts": ("0.5,,3.25,", "\n0.5,,x,", r"line 4, column tdoa_3: found 'x'"),
    "lone blank field": ("0.5,,3.25,", " ", r"line 3: found 1 fields, expected 4"),
    "stray quote": ("1.5", '"1.5', r"line 2: found 2 fields, expected 4"),
}  # fmt: skip


@pytest.mark.parametrize("name", ERRORS)
def test_an_error_names_the_file_and_the_line(tmp_path: Path, name: str) -> None:
    old, new, message = ERRORS[name]
    assert old in GOOD
    with pytest.raises(LogError, match=r"log\.csv, " + message):
        read(tmp_path, GOOD.replace(old, new, 1))


@pytest.mark.parametrize(
    ("content", "message"),
    [
        (b"", "found an empty file, expected a header line"),
        (b"time,tdoa_2,tdoa_3\n", "found a header alone, expected at least one row"),
        (b"\n", "expected 'time'"),
        (b"time,tdoa_2\n\xff\xfe,1\n", "cannot be read as CSV"),
        (b"time,tdoa_2,tdoa_3\n0," + b"1" * 140000 + b",1\n", "cannot be read as CSV"),
    ],
)
def test_a_file_that_is_no_log_is_refused(tmp_path: Path, content: bytes, message: str) -> None:
    with pytest.raises(LogError, match=message):
        read(tmp_path, content)


def test_a_missing_file_is_refused_by_name(tmp_path: Path) -> None:
    with pytest.raises(LogError, match=r"none\.csv: cannot be read"):
        read_log(tmp_path / "none.csv", CHANNELS)
    with pytest.raises(LogError, match="cannot be read"):
        read_log(tmp_path, CHANNELS)


def test_an_input_needs_a_value_in_every_row(tmp_path: Path) -> None:
    text = GOOD.replace("truth_x", "wind")
    with pytest.raises(LogError, match="line 3, column wind: found nothing"):
        read(tmp_path, text, ("wind",))
    log = read(tmp_path, text.replace("3.25,", "3.25,0.5"), ("wind",))
    assert log.inputs["wind"].tolist() == [10.0, 0.5, 11.0]


@settings(suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(text=st.one_of(st.text(max_size=60), st.text('0159.,-e"\n\r nai_', max_size=40)))
def test_no_content_raises_anything_but_a_log_error(tmp_path: Path, text: str) -> None:
    for content in (text, "time,tdoa_2,tdoa_3\n" + text):
        try:
            log = read(tmp_path, content.encode(errors="surrogatepass"))
        except LogError:
            continue
        assert log.steps >= 1
        assert log.time.isfinite().all()


def test_a_batch_is_not_written_as_one_trajectory(tmp_path: Path) -> None:
    log = Log(("a",), torch.zeros(2).double(), torch.zeros(2, 3, 1).double())
    with pytest.raises(InputError, match=r"expected one trajectory"):
        write_log(tmp_path / "log.csv", log)
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize("state", ["x*/", "<b>", "1x", "x y", "a" * 65])
def test_a_true_state_has_a_name(state: str, tmp_path: Path) -> None:
    path = tmp_path / "log.csv"
    path.write_text(GOOD.replace("truth_x", f"truth_{state}"))
    with pytest.raises(LogError, match="expected truth_ and the name of a state"):
        read_log(path, CHANNELS)


@pytest.mark.parametrize("name", ["<script>x", "../../evil", "a b", "x" * 65, "*/ int x; /*"])
def test_a_channel_that_nobody_named_has_a_name(name: str, tmp_path: Path) -> None:
    path = tmp_path / "log.csv"
    path.write_text(f'time,good,"{name}"\n0,1,2\n1,1,2\n')
    with pytest.raises(LogError, match=r"log\.csv, line 1: found column .*expected a name"):
        read_any(path)
