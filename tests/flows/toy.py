"""A flow of the toy stages; `python -m tests.flows.toy STORE` runs it in a process of its own."""

from __future__ import annotations

import sys
from typing import Any

from prefect import flow
from prefect.states import State

from extrags.store import Ref
from tasks.stage import at
from tests.tasks.toy import PLAIN, ToyConfig, double, source, total


@flow(name="toy")
def toy(store: str, config: ToyConfig = PLAIN, *, refresh: bool = False) -> list[tuple[str, str, Any]]:
    """source(1), source(2) -> double each -> total."""
    states: list[tuple[str, State[Any]]] = []

    def wait(name: str, futures: list[Any]) -> list[Ref]:
        for future in futures:
            future.wait()
            states.append((name, future.state))
        return [future.state.result() for future in futures if future.state.is_completed()]

    sources = wait("source", [at(source, store, refresh=refresh).submit(store=store, seed=s) for s in (1, 2)])
    doubled = wait(
        "double",
        [at(double, store, refresh=refresh).submit(store=store, number=n, config=config) for n in sources],
    )
    if len(doubled) == 2:
        wait("total", [at(total, store, refresh=refresh).submit(store=store, numbers=doubled, die=True)])
    return [(name, state.name, state.data if state.is_failed() else state.result()) for name, state in states]


@flow(name="same-key-twice")
def same_key_twice(store: str) -> list[str]:
    futures = [at(source, store).submit(store=store, seed=9) for _ in range(4)]
    for future in futures:
        future.wait()
    return sorted(future.state.name for future in futures)


if __name__ == "__main__":
    print(*[name for _, name, _ in toy(sys.argv[1])])
