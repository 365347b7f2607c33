"""Torch on several cores, with results that do not depend on their number.

Torch divides an operation between its threads. Where a sum is divided, and at which element vector
instructions give way to scalar ones, both depend on the number of threads, and so do the last bits of the
result. Hence torch itself gets one thread, and what is independent (views, frames) is handed out whole.

Torch's number of threads belongs to the calling thread (OpenMP's and MKL's do), so that neither function
here disturbs what other threads compute.
"""

from __future__ import annotations

import threading
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from contextvars import copy_context
from typing import TypeVar

import torch

from extrags.raster import native

__all__ = ["in_threads", "kernel_threads", "one_torch_thread", "torch_threads"]

T = TypeVar("T")
R = TypeVar("R")

_worker = threading.local()


class _Budget:
    """Threads at work in this process: stages that run side by side share them."""

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._taken = 0

    @contextmanager
    def take(self, wanted: int) -> Iterator[int]:
        """As many as are left of the kernels' number, `wanted` at most; 0 where only one is left."""
        with self._lock:
            left = (native.num_threads() if native.native_isa() else 1) - self._taken
            count = min(wanted, left) if min(wanted, left) > 1 else 0
            self._taken += count
        try:
            yield count
        finally:
            with self._lock:
                self._taken -= count


_budget = _Budget()


@contextmanager
def torch_threads(count: int) -> Iterator[None]:
    """Torch divides the calling thread's work by `count`, whatever the number of cores.

    Args:
        count: part of what decides on the result.
    """
    before = torch.get_num_threads()  # Before anything is set, see `_begin`.
    torch.set_num_threads(count)
    try:
        yield
    finally:
        torch.set_num_threads(before)


@contextmanager
def kernel_threads(count: int | None) -> Iterator[None]:
    """The kernels, and `in_threads`, have so many threads in this process; None leaves their number alone.

    For processes that do one thing at a time and share the cores with others, as Dask workers do.
    """
    if count is None or not native.native_isa():
        yield
        return
    before = native.num_threads()
    native.set_num_threads(count)
    try:
        yield
    finally:
        native.set_num_threads(before)


@contextmanager
def one_torch_thread() -> Iterator[None]:
    """Torch computes in the calling thread alone; also a decorator.

    Results then do not depend on the number of threads. They still depend on the processor's instruction
    set, see docs/running_at_scale.md.
    """
    with torch_threads(1):
        yield


def in_threads(function: Callable[[T], R], items: Iterable[T]) -> list[R]:
    """Apply a function to items that are independent of each other, on several cores.

    There are as many threads as the kernels use (`extrags.raster.set_num_threads`), together with those of
    other calls, each with one thread of torch: the number changes the time it takes, never the result.
    Called from one of these threads, it goes through the items one after the other. Events, gradient mode
    and inference mode are the caller's.

    Args:
        function: must not change what the items share.
        items: few and expensive rather than many and cheap.

    Returns:
        The results in the order of the items.

    Raises:
        Exception: the first in the order of the items that the function raised.
    """
    items = list(items)
    with _budget.take(0 if getattr(_worker, "busy", False) else len(items)) as workers:
        if workers > 0:
            return _on_workers(workers, function, items)
    with one_torch_thread():
        return [function(item) for item in items]


def _on_workers(workers: int, function: Callable[[T], R], items: list[T]) -> list[R]:
    gradients, inference = torch.is_grad_enabled(), torch.is_inference_mode_enabled()

    def applied(item: T) -> R:
        with torch.inference_mode(inference), torch.set_grad_enabled(gradients):
            return function(item)

    with ThreadPoolExecutor(workers, "extrags", _begin) as pool:
        # A context can be entered once at a time: each item gets a copy.
        futures = [pool.submit(copy_context().run, applied, item) for item in items]
        try:
            return [future.result() for future in futures]
        finally:
            for future in futures:
                future.cancel()


def _begin() -> None:
    _worker.busy = True
    # At its first operation a new thread takes the number that any thread set last, even if it has set one
    # of its own before; not if it has asked for the number.
    torch.get_num_threads()
    torch.set_num_threads(1)
