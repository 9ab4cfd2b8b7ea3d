"""Every operation that torch calls while a function is traced, handed to its rule."""

from __future__ import annotations

import traceback
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch.utils._python_dispatch import TorchDispatchMode

from difffilter.engine.rules import RULES
from difffilter.engine.rules.table import Array, Lower
from difffilter.errors import EngineError

__all__ = ["Calls"]

LIBRARY = Path(__file__).resolve().parent.parent
TORCH, PYTHON = Path(torch.__file__).resolve().parent, Path(traceback.__file__).resolve().parent
#: In place, and of another shape: the tensor gets a new array.
RESHAPING = {"squeeze_", "unsqueeze_", "transpose_", "t_", "swapaxes_"}
#: Of truth values; on whole numbers they do something else.
LOGICAL = {"bitwise_and", "bitwise_or", "bitwise_xor", "bitwise_not"}
#: Complaints about values, which are only samples here.
CHECKS = {"_linalg_check_errors", "_assert_async", "_assert_scalar", "_assert_tensor_metadata"}


class Calls(TorchDispatchMode):  # type: ignore[no-untyped-call]
    """Sees every operation that torch calls, and what is known of its tensors."""

    def __init__(self, lowering: Lower) -> None:
        super().__init__()  # type: ignore[no-untyped-call]
        self.lowering = lowering
        # Tensors are kept: the number of one that is gone could be another's.
        self.known: dict[int, tuple[torch.Tensor, Array]] = {}

    @classmethod
    def _should_skip_dynamo(cls) -> bool:
        """Nothing is compiled by torch here; to import its compiler takes a second."""
        return False

    def bind(self, tensor: torch.Tensor, nodes: Array) -> None:
        """Note the array of a tensor."""
        self.known[id(tensor)] = (tensor, nodes)

    def array(self, tensor: torch.Tensor) -> Array:
        """The array of a tensor; one that nobody has called for is a constant."""
        if id(tensor) not in self.known:
            self.bind(tensor, self.lowering.constant(tensor))
        return self.known[id(tensor)][1]

    def __torch_dispatch__(self, func: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        kwargs = kwargs or {}
        name = str(func).split(".")[1]
        if name in CHECKS:
            return None
        if name == "_local_scalar_dense":
            return self._number(func, args)
        entry = RULES.get(name.strip("_"))
        if entry is None:
            return self._composed(func, name, args, kwargs)
        self._check(name, args)
        made = self._made(entry, name, args, kwargs)
        result = func(*args, **kwargs)
        self._note(name, args, made, result)
        return result

    def _made(self, entry: Callable[..., Any], name: str, args: Any, kwargs: Any) -> Any:
        """What the rule gives; where it does not fit the call, an error with the line."""
        try:
            return entry(self.lowering, *self._mapped(args), **self._mapped(kwargs))
        except EngineError as error:
            found = str(error)
            raise EngineError(found if ", used at" in found else found + caller()) from None
        except (TypeError, ValueError, IndexError, AttributeError) as error:
            raise EngineError(f"engine: no rule for {name} called so ({error}){caller()}") from None

    def _note(self, name: str, args: Any, made: Any, result: Any) -> None:
        """Bind what came out; in place, views change too."""
        if name.endswith("_") and not name.startswith("__"):
            if name in RESHAPING:
                self.bind(args[0], made)
            else:
                target = self.array(args[0])
                if not target.flags.writeable:
                    raise EngineError(f"engine: no rule for {name} on a repeated entry{caller()}")
                target[...] = made
            return
        single = isinstance(result, torch.Tensor)
        pairs = [(result, made)] if single else list(zip(result, made, strict=True))
        for tensor, nodes in pairs:
            if nodes is None or not isinstance(tensor, torch.Tensor):
                continue
            if np.shape(nodes) != tuple(tensor.shape):
                raise EngineError(
                    f"engine: no rule for {name} of shape {list(tensor.shape)}{caller()}"
                )
            self.bind(tensor, np.asarray(nodes, dtype=object))

    def _composed(self, func: Any, name: str, args: Any, kwargs: Any) -> Any:
        """An operation that is made of others, or one of constants alone."""
        with self:
            try:
                parts = func.decompose(*args, **kwargs)
            except (NotImplementedError, ValueError, TypeError) as error:
                raise EngineError(f"engine: no rule for {name} ({error}){caller()}") from None
        if parts is not NotImplemented:
            return parts
        if name.endswith("_") or not self._constant([args, kwargs]):
            raise EngineError(f"engine: no rule for {name}{caller()}")
        return func(*args, **kwargs)

    def _number(self, func: Any, args: Any) -> Any:
        """A tensor as a Python number: only where it is a constant."""
        if not self._constant(args[0]):
            raise EngineError(f"engine: a branch on a value that is not known before{caller()}")
        return func(*args)

    def _check(self, name: str, args: Any) -> None:
        """Refuse what rules would take for something else."""
        if name.strip("_") in LOGICAL:
            for x in args:
                if isinstance(x, torch.Tensor) and x.dtype != torch.bool:
                    raise EngineError(f"engine: no rule for {name} of {x.dtype}{caller()}")
        if any(isinstance(x, torch.Tensor) and x.is_complex() for x in args):
            raise EngineError(f"engine: no rule for complex numbers{caller()}")

    def _constant(self, tree: Any) -> bool:
        """Whether all tensors hold constants."""
        if isinstance(tree, torch.Tensor):
            return self.lowering.known(self.array(tree)) is not None
        if isinstance(tree, (list, tuple)):
            return all(map(self._constant, tree))
        return all(map(self._constant, tree.values())) if isinstance(tree, dict) else True

    def _mapped(self, tree: Any) -> Any:
        if isinstance(tree, torch.Tensor):
            return self.array(tree)
        if isinstance(tree, (list, tuple)):
            return [self._mapped(item) for item in tree]
        if isinstance(tree, dict):
            return {key: self._mapped(item) for key, item in tree.items()}
        return tree


def caller() -> str:
    """File and line of the user's model that calls an operation, else of the library."""
    stack = traceback.extract_stack()
    frames = [f for f in stack if TORCH not in (others := Path(f.filename).parents)
              and others[0] != PYTHON]  # fmt: skip
    own = [f for f in frames if LIBRARY in Path(f.filename).parents]
    frames = frames[frames.index(own[0]) :] if own else frames
    models = [f for f in frames if LIBRARY not in Path(f.filename).parents]
    engine = [f for f in own if Path(f.filename).parent.name not in ("engine", "rules")]
    frame = (models or engine or frames)[-1]
    return f", used at {frame.filename}:{frame.lineno}: {frame.line}"
