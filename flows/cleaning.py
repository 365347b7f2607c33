"""Cleaning of a store, for the flow and the command: what cannot be done in one place hinders no other."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from typing import TypeVar

from extrags.errors import StoreError, reason_of
from extrags.store import Store
from extrags.store.retention import Cleaning, Policy, apply_policy, planned_removals
from extrags.store.runs import sweep_unreadable
from flows.outcome_records import sweep_outcomes
from tasks.locks import sweep_locks

__all__ = ["Cleaned", "clean_store"]

T = TypeVar("T")


@dataclass
class Cleaned:
    """What went from a store, or would go.

    Args:
        leftovers: names of what killed runs and failures left, and of records of how runs ended of which
            nothing else is left.
        artefacts: what the policy says.
        problems: why something could not be done; all else was.
    """

    leftovers: list[str] = field(default_factory=list)
    artefacts: Cleaning = field(default_factory=lambda: Cleaning([], [], []))
    problems: list[StoreError] = field(default_factory=list)

    def check(self) -> None:
        """Tell of what could not be done, once all else has been.

        Raises:
            StoreError: the first of the problems, with the number of all.
        """
        if self.problems:
            first = self.problems[0]
            more = f" (and {len(self.problems) - 1} more)" if len(self.problems) > 1 else ""
            raise StoreError(f"not all could be cleaned: {first}{more}") from first

    def attempt(self, step: Callable[[], T]) -> T | None:
        """The result of a step; None, and a problem more, where it failed."""
        try:
            return step()
        except StoreError as error:
            self.problems.append(error)
        except OSError as error:
            problem = StoreError(f"{error.filename or 'a file'}: {reason_of(error)}")
            problem.__cause__ = error
            self.problems.append(problem)
        return None


def clean_store(store: Store, policy: Policy, *, dry_run: bool = False) -> Cleaned:
    """Remove leftovers, and the artefacts that a policy does not keep.

    Args:
        store: which.
        policy: the rules.
        dry_run: remove nothing.
    """
    done = Cleaned()
    done.leftovers += done.attempt(lambda: store.gc(dry_run=dry_run, refused=done.problems)) or []
    if not dry_run:
        done.leftovers += done.attempt(lambda: sweep_locks(store.locks)) or []
    done.leftovers += done.attempt(lambda: sweep_unreadable(store, dry_run=dry_run)) or []
    clean = planned_removals if dry_run else apply_policy
    cleaning = done.attempt(lambda: clean(store, policy))
    if cleaning is not None:
        done.artefacts = cleaning
        done.problems += cleaning.refused.values()
    age = policy.older_than_s
    if cleaning is not None and age is not None:
        # Else a sequence that failed once, and is of no use any more, fails in `extrags status` for ever.
        there = set(store.keys()) - {item.key for item in cleaning.removed}
        swept = done.attempt(lambda: sweep_outcomes(store, age, there, dry_run=dry_run))
        done.leftovers += [f"records/{name}.json" for name in swept or []]
    return done
