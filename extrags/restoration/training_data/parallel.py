"""Training batches drawn by several processes: a GPU computes faster than one processor core cuts crops."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from itertools import cycle
from multiprocessing.process import BaseProcess
from queue import Empty
from typing import Any

import torch

from extrags.errors import ExtragsError
from extrags.restoration.training_data.augmentation import Batch

__all__ = ["drawn_in_processes"]

AHEAD = 4
"""Batches that each process may have waiting."""
LOOK_SECONDS = 5.0
"""A process that died is noticed after so long at most."""


@contextmanager
def drawn_in_processes(
    make_sampler: Callable[[int, int], Callable[[], Batch]], workers: int
) -> Iterator[Callable[[], Batch]]:
    """A function that gives the next batch, drawn ahead by processes of their own.

    Batches come from the processes in turn, so that their order does not depend on which one is faster.

    Args:
        make_sampler: called in each process with its number and the number of processes; gives what draws a
            batch there. It is pickled, so it has to be importable.
        workers: processes; with 0 batches are drawn where they are asked for.

    Raises:
        ExtragsError: by the returned function, what a process raised, or that one has ended.
    """
    if workers == 0:
        yield make_sampler(0, 1)
        return
    import torch.multiprocessing as processes

    context: Any = processes.get_context("spawn")
    with ExitStack() as stack:
        queues, running = [], []
        for number in range(workers):
            queue = context.Queue(AHEAD)
            process = context.Process(target=_draw, args=(make_sampler, number, workers, queue), daemon=True)
            process.start()
            stack.callback(process.join)
            stack.callback(process.terminate)
            queues.append(queue)
            running.append(process)
        turns = cycle(zip(queues, running, strict=True))
        yield lambda: _taken(*next(turns))


def _taken(queue: Any, process: BaseProcess) -> Batch:
    while True:
        try:
            given: Batch | ExtragsError = queue.get(timeout=LOOK_SECONDS)
        except Empty:
            if not process.is_alive():
                raise ExtragsError(
                    f"a process that draws training batches ended with exit code {process.exitcode}"
                ) from None
        else:
            if isinstance(given, ExtragsError):
                raise given
            return given


def _draw(
    make_sampler: Callable[[int, int], Callable[[], Batch]], number: int, workers: int, queue: Any
) -> None:
    torch.set_num_threads(1)
    try:
        sampler = make_sampler(number, workers)
        while True:
            queue.put(sampler())
    except ExtragsError as error:
        # Its sentence says what to do; a process that merely ends would say nothing.
        queue.put(error)
