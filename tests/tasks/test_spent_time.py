"""Time of tasks that run at once."""

from __future__ import annotations

import threading
import time

import pytest

from tasks.spent_time import SpentTime, SpentTimes, spent_time


class Clocks:
    """Elapsed and processor time that pass when told to."""

    def __init__(self) -> None:
        self.elapsed, self.processor = 50.0, 7.0

    def times(self) -> SpentTimes:
        return SpentTimes(lambda: self.elapsed, lambda: self.processor)

    def pass_by(self, elapsed: float, processor: float) -> None:
        self.elapsed += elapsed
        self.processor += processor


def test_a_task_alone_is_charged_all() -> None:
    clocks = Clocks()
    times = clocks.times()
    clocks.pass_by(100, 100)
    with times.spent() as spent:
        clocks.pass_by(3, 5)
    clocks.pass_by(100, 100)
    assert (spent.elapsed_s, spent.processor_s) == (3, 5)


def test_tasks_at_once_add_up_to_the_time_that_passed() -> None:
    clocks = Clocks()
    times = clocks.times()
    with times.spent() as first:
        clocks.pass_by(2, 2)
        with times.spent() as second:
            clocks.pass_by(6, 8)
        clocks.pass_by(1, 1)
    assert (first.elapsed_s, first.processor_s) == (2 + 3 + 1, 2 + 4 + 1)
    assert (second.elapsed_s, second.processor_s) == (3, 4)


def test_a_task_that_fails_is_charged_no_more() -> None:
    clocks = Clocks()
    times = clocks.times()
    with pytest.raises(ZeroDivisionError), times.spent():
        clocks.pass_by(1, 1 / 0)
    with times.spent() as spent:
        clocks.pass_by(4, 4)
    assert spent.elapsed_s == 4


def test_threads_of_this_process() -> None:
    found: list[SpentTime] = []

    def work() -> None:
        with spent_time() as spent:
            time.sleep(0.05)
            sum(range(200_000))
        found.append(spent)

    begun = time.monotonic()
    threads = [threading.Thread(target=work) for _ in range(4)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    passed = time.monotonic() - begun
    # Other threads of the test run may have begun and ended tasks of their own: never more than that.
    assert 0.04 < sum(spent.elapsed_s for spent in found) <= passed + 0.002
