"""Commands in forked processes: they start at once, may be killed, and a crash is seen.

A server that has imported everything forks a process for each; ``DISK`` is a small or read-only
one of its own, mounted where nobody else sees it.
"""

from __future__ import annotations

import contextlib
import ctypes
import importlib
import json
import multiprocessing
import os
import resource
import signal
import sys
import time
from dataclasses import dataclass
from multiprocessing.process import BaseProcess
from pathlib import Path
from typing import Any

from outcome import Violation

__all__ = ["Command", "whole"]

LIMIT = 180.0
CLONE_NEWNS, CLONE_NEWUSER = 0x00020000, 0x10000000
MS_RDONLY, MS_REC, MS_PRIVATE = 1, 16384, 1 << 18
MODULES = ("tune", "simulate", "run", "show", "export", "compare", "main")

if multiprocessing.current_process().name != "MainProcess" or __name__ != "__main__":
    for _name in MODULES:  # in the server, once
        importlib.import_module(f"difffilter.cli.{_name}")
    for _name in ("tuning.loop", "scenario.checkpoint", "running.batch", "engine.fused"):
        importlib.import_module(f"difffilter.{_name}")
    importlib.import_module("torch._dynamo")  # an optimiser imports it, for seconds


def _context() -> Any:
    context = multiprocessing.get_context("forkserver")
    paths = [str(Path(__file__).parent), os.environ.get("PYTHONPATH", "")]
    if paths[0] not in paths[1].split(os.pathsep):
        os.environ["PYTHONPATH"] = os.pathsep.join(path for path in paths if path)
    context.set_forkserver_preload(["commands"])
    return context


@dataclass
class Command:
    """One command of ``difffilter`` in a process of its own.

    Attributes:
        args: the command and its options.
        log: file that takes what it says on stderr.
        environment: variables that it sees.
        disk: "" or ``PLACE:OPTIONS``: a disk of its own there, ``ro`` or ``size=16k``.
    """

    args: list[str]
    log: Path
    environment: dict[str, str]
    disk: str = ""

    def start(self) -> BaseProcess:
        """The process, running."""
        data = (self.args, str(self.log), self.environment, self.disk)
        process: BaseProcess = _context().Process(target=_child, args=data)
        process.start()
        return process

    def end(self, process: BaseProcess | None = None) -> tuple[int, str]:
        """Exit code (negative: a signal) and what it said; Violation if it does not end."""
        process = process or self.start()
        process.join(LIMIT)
        if process.is_alive():
            process.kill()
            process.join()
            raise Violation(f"{self.args[0]}: does not end in {LIMIT:g} s")
        said = self.log.read_text(errors="replace") if self.log.exists() else ""
        return process.exitcode or 0, said

    def killed(self, after: float, number: signal.Signals) -> bool:
        """Run it and send a signal after some seconds; whether it was still running."""
        process = self.start()
        process.join(after)
        alive = process.is_alive()
        if alive and process.pid is not None:
            os.kill(process.pid, number)
        code, said = self.end(process)
        if "Traceback" in said or (not alive and code != 0):
            raise Violation(f"{self.args[0]}: exit code {code}: {said[-300:]}")
        return alive

    def sound(self, *codes: int) -> tuple[int, str]:
        """Run it to its end: one of these exit codes, and one line where it is 2."""
        code, said = self.end()
        if code not in codes or "Traceback" in said:
            raise Violation(f"{self.args[0]}: exit code {code}: {said[-300:]}")
        wrong = [line for line in said.splitlines() if "error:" in line]
        if code == 2 and len(wrong) != 1:
            raise Violation(f"{self.args[0]}: exit code 2 without its one line: {said[-300:]!r}")
        return code, said


def _child(args: list[str], log: str, environment: dict[str, str], disk: str) -> None:
    import torch

    from difffilter.cli.main import main

    handle = os.open(log, os.O_CREAT | os.O_TRUNC | os.O_WRONLY)
    os.dup2(os.open(os.devnull, os.O_WRONLY), 1)
    os.dup2(handle, 2)
    os.environ.update(environment)
    torch.set_num_threads(1)
    place, _, options = disk.partition(":")
    if disk:
        _mount(Path(place), options)
    code = main(args)
    if disk:
        left = {p.name: whole(p) for p in Path(place).iterdir()}
        Path(log).with_suffix(".left").write_text(json.dumps(left))
    with contextlib.suppress(OSError):
        sys.stdout.flush()
    os._exit(code)


def _mount(place: Path, options: str) -> None:
    """A disk of its own; where that is not allowed, a limit on the size of files."""
    libc = ctypes.CDLL(None, use_errno=True)
    user = 0 if os.getuid() == 0 else CLONE_NEWUSER
    if libc.unshare(CLONE_NEWNS | user) == 0:
        libc.mount(b"none", b"/", None, MS_REC | MS_PRIVATE, None)
        flags, data = (MS_RDONLY, b"") if options == "ro" else (0, options.encode())
        if libc.mount(b"tmpfs", bytes(place), b"tmpfs", flags, data) == 0:
            return
    signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
    size = int(options.removeprefix("size=").removesuffix("k") or 4) if options != "ro" else 0
    resource.setrlimit(resource.RLIMIT_FSIZE, (1024 * size, resource.RLIM_INFINITY))


def whole(path: Path) -> bool:
    """Whether a file is complete, by its sort."""
    if path.is_dir():
        return all(whole(inner) for inner in path.iterdir() if inner.name[0] != ".")
    try:
        data = path.read_bytes()
    except FileNotFoundError:  # moved to its place in between
        return True
    if path.suffix == ".json":
        try:
            json.loads(data)
        except ValueError:
            return False
        return True
    if path.suffix == ".pt":
        from difffilter.tuning.state import DIGEST, MAGIC

        return data.startswith(MAGIC) and len(data) > len(MAGIC) + DIGEST
    return data.endswith(b"\n")


def aged(folder: Path) -> None:
    """What a kill left is two hours old, so that the next run may clear it away."""
    for path in folder.rglob(".*"):
        with contextlib.suppress(OSError):
            os.utime(path, (time.time() - 7200.0,) * 2)
