"""Several processes that tune together: each runs its share of the trajectories."""

from __future__ import annotations

import atexit
import os
import signal
import threading
from collections.abc import Iterator, Sequence
from contextlib import contextmanager, suppress
from typing import NoReturn

import torch
from torch import Tensor

from difffilter.errors import InputError, RankError

__all__ = ["Ranks", "ranks"]


class Ranks:
    """The processes of a run, and this one's place among them; alone by default.

    Sums over trajectories are added over the processes (gloo), so that all see the same loss,
    gradient and curvature, and take the same steps.
    """

    def __init__(self, rank: int = 0, size: int = 1) -> None:
        self.rank, self.size = rank, size

    @property
    def first(self) -> bool:
        """Whether this process writes files and prints."""
        return self.rank == 0

    def share(self, index: Tensor) -> Tensor:
        """This process's part of a batch of trajectories."""
        if len(index) < self.size:
            raise InputError(
                f"ranks: found {len(index)} trajectories for {self.size} processes, "
                "expected at least one for each"
            )
        return index[self.rank :: self.size]

    def add(self, x: Tensor) -> Tensor:
        """The sum over all processes."""
        if self.size == 1:
            return x
        import torch.distributed as dist

        total = x.detach().clone().contiguous()
        with self._lost():
            dist.all_reduce(total)
        return total

    def differentiable_sum(self, x: Tensor) -> Tensor:
        """The sum over all processes, whose gradient is this process's part of it."""
        return x if self.size == 1 else x + (self.add(x) - x.detach())

    def agree(self, tensors: Sequence[Tensor]) -> None:
        """Take over the first process's numbers, so that no rounding sets them apart."""
        if self.size > 1:
            import torch.distributed as dist

            with self._lost(), torch.no_grad():
                for x in tensors:
                    dist.broadcast(x, 0)

    def told(self, content: bytes | None) -> bytes:
        """Bytes of the first process, at all of them."""
        size = torch.tensor([len(content or b"")])
        self.agree([size])
        data = torch.zeros(int(size), dtype=torch.uint8)
        if content:
            data = torch.frombuffer(bytearray(content), dtype=torch.uint8).clone()
        self.agree([data])
        return data.numpy().tobytes()

    def meet(self) -> None:
        """Wait until all have come here: whoever leaves now, nobody waits for it."""
        if self.size > 1:
            import torch.distributed as dist

            with self._lost():
                dist.barrier()

    @contextmanager
    def _lost(self) -> Iterator[None]:
        try:
            yield
        except RuntimeError as error:
            if isinstance(error, RankError):
                raise
            if threading.current_thread() is threading.main_thread():
                signal.signal(signal.SIGTERM, signal.SIG_IGN)  # it is ending already
            raise RankError(
                f"ranks: process {self.rank} of {self.size} lost the connection to another one"
            ) from None


def _leave() -> None:
    """Close the group, whatever the way out: left to the interpreter's end it may abort."""
    import torch.distributed as dist

    with suppress(Exception):  # others may be gone already
        if dist.is_initialized():
            dist.destroy_process_group()


def ranks() -> Ranks:
    """The processes that torchrun started; one, alone, without it.

    Raises:
        RankError: the others cannot be reached.
    """
    size = int(os.environ.get("WORLD_SIZE", "1"))
    if size == 1:
        return Ranks()
    import torch.distributed as dist

    rank = os.environ.get("RANK", "0")

    def stopped(number: int, frame: object) -> NoReturn:
        signal.signal(signal.SIGTERM, signal.SIG_IGN)
        raise RankError(f"ranks: process {rank} of {size} was stopped: another one was lost")

    if threading.current_thread() is threading.main_thread():
        signal.signal(signal.SIGTERM, stopped)  # torchrun's, to those that are left
    if not dist.is_initialized():
        try:
            dist.init_process_group("gloo")
        except (RuntimeError, ValueError) as error:
            raise RankError(f"ranks: {str(error).splitlines()[0]}") from None
        atexit.register(_leave)
    return Ranks(dist.get_rank(), dist.get_world_size())
