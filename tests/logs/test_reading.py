"""Logs as people have them: names, units, times, what is missing, several files."""

from __future__ import annotations

import csv
from datetime import datetime
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from difffilter import LogError, load_logs, load_scenario, read_log
from difffilter.errors import InputError
from difffilter.logs.merging import between
from difffilter.logs.times import Clock, read_times

FERRY = Path(__file__).parents[4] / "shared" / "data" / "ferry"
if not FERRY.is_dir():
    FERRY = Path("/work/shared/data/ferry")
FINDER = """\
schema = 1
name = "finder"
title = "Bearings and ranges"
[sensors]
b = { kind = "bearing" }
r = { kind = "range", stations = [[0.0, 0.0], [9.0, 0.0], [0.0, 9.0]] }
[parameters]
motion.acceleration = { value = 1.0 }
[systems.ekf]
sensors = ["r"]
"""
ROWS = "time,b,r_1,r_2,r_3\n0.0,0.5,3.0,4.0,5.0\n1.0,0.6,3.0,4.0,5.0\n"


def read(tmp_path: Path, text: str, **layout: Any) -> Any:
    (tmp_path / "log.csv").write_bytes(text.encode())
    return read_log(tmp_path / "log.csv", layout.pop("channels", ["r"]), **layout)


def test_names_units_and_what_is_ignored(tmp_path: Path) -> None:
    text = "t,dist_ft,note\n1000,10,a\n2500,20,b\n"
    log = read(tmp_path, text, time="t", format="ms", columns={"dist_ft": "r"}, units={"r": "ft"},
               ignore=["note"])  # fmt: skip
    assert log.time.tolist() == [1.0, 2.5]
    np.testing.assert_allclose(log.z[:, 0], [3.048, 6.096], rtol=1e-15)


@pytest.mark.parametrize(
    ("unit", "si"),
    [("km", 1000.0), ("nmi", 1852.0), ("ns", 0.299792458), ("deg", np.pi / 180),
     ("kn", 1852 / 3600), ("km/h", 1 / 3.6), ("g", 9.80665), ("us", 299.792458), ("mi", 1609.344)],
)  # fmt: skip
def test_units(tmp_path: Path, unit: str, si: float) -> None:
    log = read(tmp_path, "time,r\n0,2\n", units={"r": unit})
    assert float(log.z[0, 0]) == pytest.approx(2 * si, rel=1e-15)
    with pytest.raises(InputError, match=r"units\.r: found 'degs', .* did you mean deg"):
        read(tmp_path, "time,r\n0,2\n", units={"r": "degs"})


def test_separators_commas_and_missing(tmp_path: Path) -> None:
    text = '\ufeff"time";"r"\r\n0,5;1,25\r\n1,5;NaN\r\n2,5;NULL\r\n3,5;-1\r\n4,5;\r\n5,5;OUT\r\n'
    log = read(tmp_path, text, separator=";", decimal=",", missing=[-1, "out"])
    assert log.time.tolist() == [0.5, 1.5, 2.5, 3.5, 4.5, 5.5]
    assert log.present[:, 0].tolist() == [True] + [False] * 5
    with pytest.raises(LogError, match="line 5, column r: found 'OUT', expected a finite number"):
        read(tmp_path, "time,r\n0,1\n1,2\n2,nan\n3,OUT\n")


def test_several_unknown_columns_are_named_at_once(tmp_path: Path) -> None:
    with pytest.raises(LogError, match=r"line 1: found columns 'a', 'b', 'c', expected time, r or"):
        read(tmp_path, "time,a,r,b,c\n0,1,2,3,4\n")
    assert read(tmp_path, "time,a,r,b,c\n0,1,2,3,4\n", ignore=["*"]).z.tolist() == [[2.0]]


def test_times_that_run_back(tmp_path: Path) -> None:
    text = "time,r\n1700000000.25,1\n1700000000.5,2\n1700000000.125,3\n1700000000.5,4\n"
    message = r"line 4, .* found 1700000000\.125 after 1700000000\.5, .*back by 0\.375 s in 1 rows"
    with pytest.raises(LogError, match=message):
        read(tmp_path, text)
    log = read(tmp_path, text, sort=True)
    assert log.z[:, 0].tolist() == [3.0, 1.0, 2.0]  # the first of two at one time


@pytest.mark.parametrize("format", ["unix", "unix-ms", "unix-us", "unix-ns"])
def test_unix_times(tmp_path: Path, format: str) -> None:
    scale = {"unix": 0, "unix-ms": 3, "unix-us": 6, "unix-ns": 9}[format]
    stamps = [1620114891 * 10**scale + k * 10**scale for k in (0, 1, 5)]
    text = "time,r\n" + "".join(f"{stamp},1\n" for stamp in stamps)
    assert read(tmp_path, text, format=format).time.tolist() == [0.0, 1.0, 5.0]
    if format != "unix":
        with pytest.raises(
            LogError, match=f'expected seconds; .* write the time format "{format}"'
        ):
            read(tmp_path, text)


def test_iso_times(tmp_path: Path) -> None:
    stamps = ["2021-05-04T09:54:51.25+02:00", "2021-05-04T07:54:52Z", "2021-05-04 07:54:53.125Z"]
    text = "time,r\n" + "".join(f"{stamp},1\n" for stamp in stamps)
    np.testing.assert_allclose(read(tmp_path, text, format="iso").time, [0.25, 1.0, 2.125])
    local = "time,r\n2021-10-31T02:30:00,1\n2021-10-31T03:30:00,1\n"
    hour = read(tmp_path, local, format="iso", zone="Europe/Oslo").time
    assert (hour[1] - hour[0]).item() == 7200.0  # the clock was set back between
    with pytest.raises(LogError, match=r"line 3, column time: found '2021-05-04T07:54:52'.*zone"):
        read(tmp_path, text.replace("52Z", "52"), format="iso")
    with pytest.raises(LogError, match=r"line 2.*found '2021.*time format \"iso\""):
        read(tmp_path, text)


@given(st.integers(0, 4 * 10**15))
def test_iso_times_come_back(micros: int) -> None:
    seconds, origin = read_times([f"{micros // 10**6}.{micros % 10**6:06d}"], "unix", "", None)
    assert origin is not None
    (text,) = Clock("iso", origin).write(seconds)
    when = datetime.fromisoformat(text).timestamp()
    assert when == pytest.approx(micros / 1e6, abs=2e-6)
    (stamp,) = Clock("unix", origin).write(seconds)
    assert float(stamp) == pytest.approx(micros / 1e6, abs=2e-6)


def recorded(tmp_path: Path, rows: str, log: str = "") -> Any:
    (tmp_path / "finder.toml").write_text(FINDER + log)
    (tmp_path / "log.csv").write_text(rows)
    return load_logs(load_scenario(tmp_path / "finder.toml"), [tmp_path / "log.csv"])


def test_an_angle_in_degrees_is_found(tmp_path: Path) -> None:
    message = r'line 3, column b: found 60\.5, expected an angle within 2 pi.*the unit "deg"'
    with pytest.raises(LogError, match=message):
        recorded(tmp_path, ROWS.replace("0.6", "60.5"))
    log = recorded(tmp_path, ROWS.replace("0.6", "60.5"), '[log]\nunits = { b = "deg" }\n')
    assert log.z[1, 0, 0].item() == pytest.approx(np.radians(60.5))


@pytest.mark.parametrize("value", ["-1", "0"])
def test_a_range_is_above_0(tmp_path: Path, value: str) -> None:
    rows = ROWS.replace("4.0", value)
    with pytest.raises(
        LogError, match=rf"line 2, column r_2: found {value}.*, expected a range abo"
    ):
        recorded(tmp_path, rows)
    for log in (f"[log]\nmissing = [{value}]\n", '[log]\nbeyond = "missing"\n'):
        present = recorded(tmp_path, rows, log).present[:, 0]
        assert present.tolist() == [[True, True, False, True]] * 2


def test_long_form(tmp_path: Path) -> None:
    rows = "t,anchor,metres\n0.0,105,1.5\n0.1,107,2.5\n0.1,108,3.5\n0.2,9,1\n"
    log = """
[log]
time = "t"
by = "anchor"
value = "metres"
ignore = ["9"]
columns = { 105 = "r_1", 107 = "r_2", 108 = "r_3", b = "b" }
"""
    nan = np.nan
    with pytest.raises(LogError, match="line 5, column anchor: found '9', expected one of"):
        recorded(tmp_path, rows, log.replace('ignore = ["9"]', ""))
    found = recorded(tmp_path, rows, log)
    np.testing.assert_array_equal(
        found.z[:, 0, 1:], [[1.5, nan, nan], [nan, 2.5, 3.5], [nan, nan, nan]]
    )


@given(
    st.lists(st.integers(0, 40), min_size=1, max_size=12, unique=True),
    st.lists(st.integers(-5, 45), min_size=1, max_size=12),
    st.integers(1, 9),
)
def test_between_never_goes_beyond(have: list[int], want: list[int], gap: int) -> None:
    time = np.sort(np.array(have, float))
    values = time**2
    found = between(time, values, np.array(want, float), gap)
    for at, value in zip(want, found, strict=True):
        if at in have:
            expected = at**2
        else:
            below, above = [t for t in have if t < at], [t for t in have if t > at]
            if not below or not above or min(above) - max(below) > gap:
                assert np.isnan(value)
                continue
            a, b = max(below), min(above)
            expected = a**2 + (at - a) / (b - a) * (b**2 - a**2)
        assert value == pytest.approx(expected)


def test_angles_are_interpolated_the_short_way_round() -> None:
    found = between(np.array([0.0, 1.0]), np.array([3.0, -3.0]), np.array([0.5]), 1.0, angle=True)
    assert np.cos(found[0]) == pytest.approx(-1.0)


def test_frames_and_files_of_numbers(tmp_path: Path) -> None:
    frame = {"time": np.array([0.0, 1.0]), "r": np.array([1.0, np.nan])}
    np.savez(tmp_path / "log.npz", **frame)
    for source in (frame, tmp_path / "log.npz"):
        log = read_log(source, ["r"])
        np.testing.assert_array_equal(log.z[:, 0], frame["r"])
    for name, library in (
        ("log.parquet", "pandas"),
        ("log.feather", "pandas"),
        ("log.mat", "scipy"),
    ):
        try:
            __import__(library)
        except ImportError:
            continue
        if library == "scipy":
            from scipy.io import savemat

            savemat(tmp_path / name, frame)
        else:
            import pandas

            getattr(pandas.DataFrame(frame), f"to_{name[4:]}")(tmp_path / name)
        np.testing.assert_array_equal(read_log(tmp_path / name, ["r"]).z[:, 0], frame["r"])


FERRY_TOML = (Path(__file__).parents[2] / "docs" / "ferry.toml").read_text(encoding="utf-8")


@pytest.mark.skipif(not FERRY.is_dir(), reason="the ferry recordings are not here")
@pytest.mark.parametrize("run", ["s2", "s4", "s5"])
def test_ferry_files_become_one_log(tmp_path: Path, run: str) -> None:
    """Against an oracle that reads the files with csv and dictionaries."""
    (tmp_path / "ferry.toml").write_text(FERRY_TOML)
    log = load_logs(load_scenario(tmp_path / "ferry.toml"), [FERRY / run])

    def rows(name: str) -> dict[float, list[float]]:
        with (FERRY / f"{run}_{name}.csv").open() as file:
            return {float(r[0]): [float(v) for v in r[1:]] for r in list(csv.reader(file))[1:]}

    eo, ir, radar, ship = (rows(name) for name in ("eo", "ir", "radar", "ownship"))
    times = sorted({*eo, *ir, *radar})
    whole = float(np.floor(times[0]))
    assert log.steps == len(times)
    np.testing.assert_allclose(log.time[:, 0] + whole, times, atol=1e-6)
    for k, t in enumerate(times):
        at = np.array(
            [np.interp(t, sorted(ship), [ship[s][i] for s in sorted(ship)]) for i in (0, 1)]
        )
        expected = np.concatenate([
            np.radians(eo.get(t, [np.nan])), np.radians(ir.get(t, [np.nan])),
            np.array(radar.get(t, [np.nan, np.nan])[:2]) + at,
        ])  # fmt: skip
        np.testing.assert_allclose(log.z[k, 0], expected, atol=1e-5)
