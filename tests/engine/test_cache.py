"""Compiled libraries on disk: whole, private, rebuilt; and what happens without a place."""

from __future__ import annotations

import ctypes
import os
import subprocess
import warnings
from collections.abc import Iterator
from pathlib import Path

import pytest
import torch

from difffilter import ConstantVelocity, Filter, Log, Position, Start, run
from difffilter.engine import build as builder
from difffilter.engine import cache, notice
from difffilter.engine.build import build, compiler
from difffilter.errors import EngineError

pytestmark = pytest.mark.skipif(compiler() is None, reason="no C compiler")

SOURCE = "int answer(void) { return 42; } /* %s */"


@pytest.fixture
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Path]:
    """A cache of its own."""
    monkeypatch.setenv("DIFFFILTER_CACHE", str(tmp_path / "cache"))
    forget()
    yield tmp_path / "cache"
    forget()


def forget() -> None:
    """What a new process does not know."""
    build.cache_clear()
    cache._clean.cache_clear()
    notice._told.clear()


def answer(name: str) -> int:
    found = build(SOURCE % name).answer
    found.restype = ctypes.c_int
    return int(found())


def spoiled(path: Path, content: bytes) -> None:
    """Another file in its place: the loaded one stays as it is."""
    path.unlink()
    path.write_bytes(content)


@pytest.mark.parametrize("damage", ["truncated", "flipped", "foreign", "empty", "folder", "digest"])
def test_a_damaged_entry_is_built_again(folder: Path, damage: str) -> None:
    assert answer(damage) == 42
    (path,) = folder.glob("*.so")
    content = path.read_bytes()
    if damage == "truncated":
        spoiled(path, content[: len(content) // 2])
    elif damage == "flipped":
        spoiled(path, content[:700] + bytes(255 - b for b in content[700:900]) + content[900:])
    elif damage == "foreign":
        build("int other(void) { return 1; }")
        (other,) = set(folder.glob("*.so")) - {path}
        spoiled(path, other.read_bytes())
        digest = path.with_suffix(".sha256")
        digest.write_bytes(other.with_suffix(".sha256").read_bytes())
    elif damage == "empty":
        spoiled(path, b"")
    elif damage == "folder":
        path.unlink()
        path.mkdir()
    else:
        path.with_suffix(".sha256").unlink()
    forget()
    assert answer(damage) == 42
    assert path.stat().st_size == len(content)


def test_a_whole_entry_is_used_as_it_is(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    answer("whole")
    forget()
    monkeypatch.setattr(builder, "_compile", lambda *_: pytest.fail("compiled again"))
    assert answer("whole") == 42


def test_the_folder_is_private(folder: Path) -> None:
    answer("private")
    assert folder.stat().st_mode & 0o077 == 0


def test_a_folder_that_others_may_write_in_is_not_used(folder: Path) -> None:
    folder.mkdir()
    folder.chmod(0o777)
    with pytest.warns(UserWarning, match="that others may write in, expected chmod go-w"):
        assert answer("open") == 42
    assert list(folder.iterdir()) == []


def test_a_file_in_place_of_the_folder(folder: Path) -> None:
    folder.write_text("")
    with pytest.warns(UserWarning, match="compiled filters are not kept"):
        assert answer("file") == 42


def test_no_home(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(cache, "cache_folder", lambda: None)
    with pytest.warns(UserWarning, match="found no home folder"):
        assert answer("homeless") == 42


def test_a_full_disk_is_left_for_another_folder(
    folder: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def full(place: Path, *_: object) -> Path:
        if place == folder:
            raise OSError(28, "No space left on device")
        return store(place, *_)  # type: ignore[arg-type]

    store = cache.store
    monkeypatch.setattr(builder, "store", full)
    assert answer("full") == 42


def test_what_killed_processes_leave_is_removed(folder: Path) -> None:
    gone = subprocess.Popen(["true"])
    gone.wait()
    folder.mkdir(mode=0o700)
    mine, left = (folder / f"tmp-{cache._host()}-{pid}-x" for pid in (os.getpid(), gone.pid))
    old = folder / "tmpabcd"
    for made in (mine, left, old):
        made.mkdir()
        (made / "step.c").write_text("")
    os.utime(old, (0, 0))
    answer("clean")
    assert (mine.exists(), left.exists(), old.exists()) == (True, False, False)


WRONG = {
    "missing": None,
    "failing": "#!/bin/sh\necho broken >&2\nexit 1\n",
    "silent": "#!/bin/sh\nexit 1\n",
    "not UTF-8": "#!/bin/sh\nprintf '\\377\\376' >&2\nexit 1\n",
    "no file": "#!/bin/sh\nexit 0\n",
    "no library": '#!/bin/sh\nwhile [ "$1" != -o ]; do shift; done\necho junk > "$2"\n',
}


@pytest.mark.parametrize("kind", WRONG)
def test_auto_ends_in_torch_whatever_the_compiler_does(
    folder: Path, kind: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    cc, script = tmp_path / "cc", WRONG[kind]
    if script is not None:
        cc.write_text(script)
        cc.chmod(0o700)
    monkeypatch.setenv("DIFFFILTER_CC", str(cc))
    monkeypatch.delenv("DIFFFILTER_ENGINE", raising=False)
    filter = Filter(ConstantVelocity(axes=1), (Position(axes=1, sigma=1.0),))
    time = torch.arange(600, dtype=torch.float64)
    start = Start(torch.zeros(2, dtype=torch.float64), torch.eye(2, dtype=torch.float64))
    log = Log(filter.channels, time, 0.1 * time[:, None], start=start)
    with pytest.raises(EngineError, match="engine: "):
        run(filter, log, engine="fused")
    with warnings.catch_warnings(record=True) as told:
        warnings.simplefilter("always")
        found = run(filter, log), run(filter, log)
    assert ["torch runs instead" in str(w.message) for w in told] == [True]
    expected = run(filter, log, engine="torch")
    assert torch.equal(found[0].mean, expected.mean)
