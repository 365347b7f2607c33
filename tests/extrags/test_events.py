from __future__ import annotations

from extrags.events import Event, MetricRecorded, emit, subscribed


def test_a_nested_block_takes_the_events_from_the_outer_one() -> None:
    outer: list[Event] = []
    inner: list[Event] = []

    def passed_on(event: Event) -> None:
        inner.append(event)
        outer.append(event)

    first, second, third, last = (MetricRecorded("stage", name, 1.0) for name in "abcd")
    with subscribed(outer.append):
        emit(first)
        with subscribed(inner.append):
            emit(second)
        with subscribed(passed_on):
            emit(third)
        emit(last)
    emit(first)
    assert outer == [first, third, last]
    assert inner == [second, third]
