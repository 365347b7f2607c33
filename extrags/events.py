"""Typed progress events of long loops.

The library never prints. Loops call `emit`; progress bars, logs and Prefect artifacts subscribe.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from contextvars import ContextVar
from dataclasses import dataclass, field

__all__ = ["Emit", "Event", "MetricRecorded", "Progress", "emit", "subscribed"]


@dataclass(frozen=True, slots=True)
class Progress:
    """A step of a loop whose length is known."""

    stage: str
    """Name of the stage the loop belongs to."""
    done: int
    """Steps finished so far."""
    total: int
    """Steps in all."""
    values: dict[str, float] = field(default_factory=dict)
    """Further values to display, by name: loss, number of Gaussians, ..."""


@dataclass(frozen=True, slots=True)
class MetricRecorded:
    """A single measured value of a stage."""

    stage: str
    name: str
    value: float


Event = Progress | MetricRecorded
Emit = Callable[[Event], None]

_subscriber: ContextVar[Emit | None] = ContextVar("extrags_event_subscriber", default=None)


def emit(event: Event) -> None:
    """Send an event to the current subscriber; without one it is dropped."""
    subscriber = _subscriber.get()
    if subscriber is not None:
        subscriber(event)


@contextmanager
def subscribed(subscriber: Emit) -> Iterator[None]:
    """Receive all events emitted inside the block, in this thread and in contexts copied from it.

    A nested block takes the events inside it from the outer one, whose subscriber does not hear of them: an
    inner subscriber that shall pass them on calls the outer one itself.

    Args:
        subscriber: called with each event, where it is emitted.
    """
    token = _subscriber.set(subscriber)
    try:
        yield
    finally:
        _subscriber.reset(token)
