"""Torch on one thread, and independent items on several."""

from __future__ import annotations

import threading
from collections.abc import Iterator

import pytest
import torch

from extrags.events import MetricRecorded, emit, subscribed
from extrags.raster import native, set_num_threads
from extrags.threads import in_threads, one_torch_thread, torch_threads


@pytest.fixture(autouse=True)
def _four_threads() -> Iterator[None]:
    before = torch.get_num_threads(), native.num_threads()
    torch.set_num_threads(4)
    set_num_threads(4)
    yield
    torch.set_num_threads(before[0])
    set_num_threads(before[1])


class TestTorchThreads:
    def test_they_are_put_back(self) -> None:
        with torch_threads(2):
            assert torch.get_num_threads() == 2
            with pytest.raises(ZeroDivisionError), one_torch_thread():
                1 // (torch.get_num_threads() - 1)
            assert torch.get_num_threads() == 2
        assert torch.get_num_threads() == 4

    def test_other_threads_keep_theirs(self) -> None:
        found, ready, go = [], threading.Event(), threading.Event()

        def work() -> None:
            with torch_threads(3):
                ready.set()
                go.wait()
                found.append(torch.get_num_threads())

        other = threading.Thread(target=work)
        other.start()
        ready.wait()
        with one_torch_thread():
            go.set()
            other.join()
        assert found == [3]
        assert torch.get_num_threads() == 4

    def test_a_sum_is_the_same_bits(self) -> None:
        values = torch.rand(3_000_000, generator=torch.Generator().manual_seed(0))
        sums = set()
        for count in (1, 2, 3, 4):
            torch.set_num_threads(count)
            with one_torch_thread():
                sums.add(float(values.sum()))
        assert len(sums) == 1


class TestInThreads:
    def test_in_the_order_of_the_items(self) -> None:
        barrier = threading.Barrier(4, timeout=20)

        def work(item: int) -> tuple[int, int]:
            barrier.wait()  # All four are at work at the same time, or this fails.
            return item, torch.get_num_threads()

        assert in_threads(work, range(4)) == [(item, 1) for item in range(4)]
        assert torch.get_num_threads() == 4

    def test_numbers_that_other_threads_set_do_not_count(self) -> None:
        def work(_: int) -> int:
            other = threading.Thread(target=torch.set_num_threads, args=(3,))
            other.start()
            other.join()
            return torch.get_num_threads()

        assert in_threads(work, range(4)) == [1] * 4

    @pytest.mark.parametrize("items", [[], [1], [1, 2]])
    def test_few_items(self, items: list[int]) -> None:
        assert in_threads(lambda item: (item, torch.get_num_threads()), items) == [
            (item, 1) for item in items
        ]

    def test_on_a_single_thread(self) -> None:
        set_num_threads(1)
        assert (
            in_threads(lambda _: threading.current_thread().name, range(3))
            == [threading.current_thread().name] * 3
        )

    def test_no_threads_of_threads(self) -> None:
        def names(_: int) -> set[str]:
            own = threading.current_thread().name
            return {own, *in_threads(lambda _: threading.current_thread().name, range(3))}

        assert all(len(found) == 1 for found in in_threads(names, range(3)))

    def test_calls_side_by_side_share_the_threads(self) -> None:
        found: list[set[str]] = []

        def beside(item: int) -> None:
            if item == 0:
                names = threading.Thread(
                    target=lambda: found.append(
                        set(in_threads(lambda _: threading.current_thread().name, range(3)))
                    )
                )
                names.start()
                names.join()

        in_threads(beside, range(4))
        assert len(found[0]) == 1

    def test_gradient_mode_and_events_are_the_callers(self) -> None:
        def work(item: int) -> tuple[bool, bool]:
            emit(MetricRecorded("test", "item", float(item)))
            return torch.is_grad_enabled(), torch.is_inference_mode_enabled()

        events: list[object] = []
        with subscribed(events.append), torch.no_grad():
            assert in_threads(work, range(3)) == [(False, False)] * 3
        assert {event.value for event in events if isinstance(event, MetricRecorded)} == {0, 1, 2}
        assert in_threads(work, range(3)) == [(True, False)] * 3
        with torch.inference_mode():
            assert in_threads(work, range(3)) == [(False, True)] * 3

    def test_the_first_error_is_raised(self) -> None:
        def work(item: int) -> int:
            if item in (1, 2):
                raise ValueError(f"item {item}")
            return item

        with pytest.raises(ValueError, match="item 1"):
            in_threads(work, range(4))
