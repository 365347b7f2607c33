"""A second device for tests on a machine without one: the arithmetic is real, mixing devices is refused.

Inside `second_device()` the device `meta` holds values. Its tensors wrap tensors of the processor; every
operation is done there, and comes back wrapped. What would fail between a processor and a GPU fails here in
the same place: an operation on tensors of both, except for the processor's scalars and indices, and numpy on
a tensor that is not on the processor.
"""

from __future__ import annotations

import functools
from collections.abc import Iterable, Iterator, Sequence
from contextlib import contextmanager
from typing import Any
from unittest.mock import patch

import torch
from torch import Tensor
from torch.overrides import TorchFunctionMode
from torch.utils._python_dispatch import TorchDispatchMode, return_and_correct_aliasing
from torch.utils._pytree import tree_leaves, tree_map

__all__ = ["DEVICE", "MixedDevicesError", "SecondDeviceTensor", "second_device"]

DEVICE = torch.device("meta")
"""The only device besides the processor for which autograd needs no driver."""

CARRIES = frozenset({"copy_", "_to_copy"})
"""Operations from one device to another."""

LISTS = frozenset({"cat", "stack"})
"""Operations in which scalars of the processor are no exception."""


class MixedDevicesError(RuntimeError):
    """An operation on tensors of both devices."""


class SecondDeviceTensor(Tensor):
    """A tensor of the second device; `held` are its values."""

    held: Tensor

    @staticmethod
    def __new__(cls, held: Tensor) -> SecondDeviceTensor:
        """Wrap a tensor of the processor."""
        made: SecondDeviceTensor = Tensor._make_wrapper_subclass(  # type: ignore[attr-defined]
            cls,
            held.size(),
            strides=held.stride(),
            storage_offset=held.storage_offset(),
            dtype=held.dtype,
            device=DEVICE,
        )
        made.held = held
        return made

    def __repr__(self, **_: Any) -> str:
        """The values, and that they are on the second device."""
        return f"SecondDeviceTensor({self.held})"

    def tolist(self) -> Any:
        """Carried to the processor, as from any device."""
        return self.detach().cpu().tolist()

    def new_tensor(self, data: Any, *, dtype: torch.dtype | None = None, **_: Any) -> Tensor:
        """Torch makes it without a dispatched operation: it would be a tensor without values."""
        return torch.tensor(data, dtype=self.dtype if dtype is None else dtype).to(DEVICE)

    __torch_function__ = torch._C._disabled_torch_function_impl

    @classmethod
    def __torch_dispatch__(cls, func: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        """Do an operation on the processor, unless it mixes devices."""
        return _done(func, args, kwargs or {})


class _Factories(TorchDispatchMode):
    """What is made on, or carried to, the second device."""

    @classmethod
    def _should_skip_dynamo(cls) -> bool:
        # Nothing is compiled here, and keeping the compiler out costs every operation.
        return False

    def __torch_dispatch__(self, func: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        return _done(func, args, kwargs or {})


class _FromNumbers(TorchFunctionMode):
    """`torch.tensor` makes its tensor without a dispatched operation: it would have no values."""

    def __torch_function__(self, func: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        kwargs = kwargs or {}
        asked = kwargs.get("device")
        if func is torch.tensor and asked is not None and torch.device(asked) == DEVICE:
            return torch.tensor(*args, **{**kwargs, "device": "cpu"}).to(DEVICE)
        return func(*args, **kwargs)


def _without_inference(mode: bool = True, *, of: Any = torch.inference_mode) -> Any:
    """Tensors that wrap others have no inference mode."""
    return torch.no_grad() if mode else of(False)


@contextmanager
def second_device() -> Iterator[torch.device]:
    """Within, `meta` is a device with values."""
    with patch.object(torch, "inference_mode", _without_inference), _FromNumbers(), _Factories():
        yield DEVICE


def _done(func: Any, args: Any, kwargs: dict[str, Any]) -> Any:
    name = _name(func)
    there: list[Tensor] = []
    here: list[Tensor] = []
    _sort(args, there, here)
    if kwargs:
        _sort(kwargs.values(), there, here)
    _check(name, func, args, there, here)
    asked = kwargs.get("device")
    if asked is None and not there:
        # Most operations of a test, which does on the processor what the second device is compared with.
        return func(*args, **kwargs)
    given = {key: _values(value) for key, value in kwargs.items()}
    if asked is not None:
        given["device"] = torch.device("cpu")
    on_device = bool(there) if asked is None else torch.device(asked) == DEVICE
    if name == "copy_":
        on_device = isinstance(args[0], SecondDeviceTensor)
    found = func(*map(_values, args), **given)
    if name == "_local_scalar_dense":
        return found
    if on_device:
        found = SecondDeviceTensor(found) if isinstance(found, Tensor) else tree_map(_wrapped, found)
    # Views share the storage of what they look at, and what was changed in place is itself again.
    return return_and_correct_aliasing(func, args, kwargs, found) if on_device and there else found


@functools.cache
def _name(func: Any) -> str:
    name: str = func._schema.name
    return name.removeprefix("aten::")


def _sort(values: Iterable[Any], there: list[Tensor], here: list[Tensor]) -> None:
    """Tensors among arguments, which nest no deeper than lists: a general walk takes most of the time."""
    for value in values:
        if isinstance(value, SecondDeviceTensor):
            there.append(value)
        elif isinstance(value, Tensor):
            here.append(value)
        elif isinstance(value, list | tuple):
            _sort(value, there, here)


def _check(name: str, func: Any, args: Any, there: Sequence[Tensor], here: Sequence[Tensor]) -> None:
    if any(tensor.is_meta for tensor in here):
        raise MixedDevicesError(f"{name}: a tensor without values, made without a dispatched operation")
    if not there or not here or name in CARRIES:
        return
    if name.startswith(("index", "_index_put")) and isinstance(args[0], SecondDeviceTensor):
        # Indices of the processor may choose rows of a device's tensor; values must be on the device.
        indices = tree_leaves(args[1])
        here = [tensor for tensor in here if not any(tensor is index for index in indices)]
    wrong = [tensor for tensor in here if tensor.ndim > 0 or name in LISTS]
    if func._schema.is_mutable and not isinstance(args[0], SecondDeviceTensor):
        # A scalar of the processor may be read, not changed.
        wrong = here
    if wrong:
        shapes = ", ".join(str(tuple(tensor.shape)) for tensor in wrong)
        raise MixedDevicesError(f"{name}: {shapes} on the processor, with tensors of the second device")


def _values(value: Any) -> Any:
    if isinstance(value, SecondDeviceTensor):
        return value.held
    return type(value)(map(_values, value)) if isinstance(value, list | tuple) else value


def _wrapped(value: Any) -> Any:
    return SecondDeviceTensor(value) if isinstance(value, Tensor) else value
