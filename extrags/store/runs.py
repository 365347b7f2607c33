"""Records of runs: which artefacts a run used, and whether it is still going on.

Retention needs to know both (`extrags.store.retention`); nothing else reads them, and a store without any is
whole. While a run goes on, its record lies in `runs/active/` of the store's state directory, and its process
holds a `flock` on it, which the kernel releases however the process ends.
"""

from __future__ import annotations

import datetime
import fcntl
import json
import logging
import os
import secrets
import threading
import time
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from extrags.errors import reason_of
from extrags.store.artefacts import Store
from extrags.store.canonical import digest_of
from extrags.store.records import read_records, remove_record, write_record

__all__ = [
    "FORGOTTEN_DAYS",
    "Run",
    "RunRecord",
    "active_runs",
    "file_killed",
    "forget",
    "recorded_run",
    "runs_of",
    "sweep_unreadable",
]

log = logging.getLogger(__name__)

FORGOTTEN_DAYS = 30.0
"""What runs in progress have written of themselves, and nobody holds or can read, goes after this time."""

_PREFIX = "run-"
_LOOKS, _BETWEEN_LOOKS_S = 20, 0.05
"""How often a record that is half written is read again."""


@dataclass(frozen=True)
class Run:
    """A run of one sequence.

    Args:
        name: of its record; empty where there is none.
        sequence: its display name.
        ended: UTC, ISO 8601; of runs that were killed, when they last recorded something.
        keys: artefacts it made or found.
        interrupted: whether it was told to stop or was killed before its end; records of earlier versions do
            not tell.
        config: digest of its settings; empty where it is not known.
        place: absolute path of a sequence that is named by a relative one; empty for others, and in records
            of earlier versions.
    """

    name: str
    sequence: str
    ended: str
    keys: frozenset[str]
    interrupted: bool = False
    config: str = ""
    place: str = ""


class RunRecord:
    """The record of a run that is going on; see `recorded_run`."""

    def __init__(self, store: Store, sequence: str, config: str = "", place: str = "") -> None:
        self._store, self._sequence, self._config = store, sequence, config
        self._place = "" if place == sequence else place
        self._keys: set[str] = set()
        self._guard = threading.Lock()
        self._written = b""
        self.interrupted = False
        folder = store.state / "runs" / "active"
        folder.mkdir(parents=True, exist_ok=True)
        self._path = folder / f"{secrets.token_hex(8)}.json"
        self._file = os.open(self._path, os.O_RDWR | os.O_CREAT | os.O_EXCL, 0o644)
        try:
            fcntl.flock(self._file, fcntl.LOCK_EX)
            self._write()
        except OSError:
            # A full disk takes the name of a file, and nothing into it.
            self._end()
            raise

    def add(self, keys: Iterable[str]) -> None:
        """Artefacts that the run uses.

        Where they cannot be written, as to a full disk, the run goes on: retention alone misses them.
        """
        with self._guard:
            more = set(keys) - self._keys
            if more:
                self._keys |= more
                try:
                    self._write()
                except OSError as error:
                    reason = reason_of(error)
                    log.warning("the record %s of this run could not be written: %s", self._path, reason)

    def close(self) -> None:
        """The run has ended, well or not. The same artefacts again replace the record of the former run."""
        try:
            if self._keys:
                name = _record_name(self._sequence, self._place, self._keys)
                write_record(self._store, name, self._content())
        finally:
            # Held on to, the lock would tell of a run that goes on for as long as this process lives.
            self._end()

    def _end(self) -> None:
        try:
            self._path.unlink(missing_ok=True)
        finally:
            os.close(self._file)

    def _write(self) -> None:
        text = json.dumps(self._content()).encode()
        try:
            _write_all(self._file, text)
        except OSError:
            # There is room for what was there before: half of the new one would say nothing.
            _write_all(self._file, self._written)
            raise
        self._written = text

    def _content(self) -> dict[str, Any]:
        content = {"sequence": self._sequence, "ended": _now(), "keys": sorted(self._keys)}
        content |= {"config": self._config} if self._config else {}
        content |= {"place": self._place} if self._place else {}
        return content | ({"interrupted": True} if self.interrupted else {})


@contextmanager
def recorded_run(
    store: Store, sequence: str, config: str = "", place: str = ""
) -> Iterator[RunRecord | None]:
    """Record the run inside the block; None where the store cannot be written, as for who only looks.

    Args:
        store: of its artefacts.
        sequence: its display name.
        config: digest of its settings; empty for none.
        place: absolute path of a sequence that is one.
    """
    try:
        record = RunRecord(store, sequence, config, place)
    except OSError as error:
        log.debug("no record of this run in %s: %s", store.root, reason_of(error))
        yield None
        return
    try:
        yield record
    except Exception:
        raise
    except BaseException:
        record.interrupted = True
        raise
    finally:
        try:
            record.close()
        except Exception as error:
            # Retention alone misses it; each fsspec backend raises its own kinds.
            log.warning("the record of this run could not be written: %s", reason_of(error))


def active_runs(store: Store) -> list[Run]:
    """Runs that are going on on this machine, or where the store's directory is shared with locks."""
    return [run for run, going_on in _unfinished(store) if going_on]


def runs_of(store: Store) -> list[Run]:
    """Runs that ended or were killed, by end; damaged records are left out."""
    found = [_run(name, record) for name, record in read_records(store, _PREFIX).items()]
    found += [replace(run, interrupted=True) for run, going_on in _unfinished(store) if not going_on]
    return sorted((run for run in found if run is not None), key=lambda run: (run.ended, run.name))


def file_killed(store: Store) -> list[str]:
    """Put what killed runs recorded to the records of runs that ended; names of the files that are gone."""
    filed = []
    for run, going_on in list(_unfinished(store)):
        if going_on:
            continue
        if run.keys:
            content = {"sequence": run.sequence, "ended": run.ended, "keys": sorted(run.keys)}
            content |= {"config": run.config} if run.config else {}
            content |= {"place": run.place} if run.place else {}
            name = _record_name(run.sequence, run.place, run.keys)
            write_record(store, name, content | {"interrupted": True})
        (store.state / "runs" / run.name).unlink(missing_ok=True)
        filed.append(f"runs/{run.name}")
    return filed


def sweep_unreadable(store: Store, *, dry_run: bool = False) -> list[str]:
    """Remove records of runs in progress that cannot be read, and have not changed for `FORGOTTEN_DAYS`.

    Half a record is what a full disk or a power loss leaves: what the run used is not known from it. One that
    a process holds stays, and so does a young one, which may belong to a process of another machine.

    Args:
        store: whose.
        dry_run: remove nothing.

    Returns:
        Names of the files that are gone, or would be.
    """
    removed = []
    for path, run, going_on in _looked_at(store):
        if run is not None or going_on:
            continue
        try:
            if time.time() - path.stat().st_mtime < FORGOTTEN_DAYS * 86400:
                continue
            if not dry_run:
                path.unlink()
                log.info("the record %s of a run cannot be read and is old: it is removed", path)
        except FileNotFoundError:
            continue
        except OSError as error:
            log.warning("the record %s of a run cannot be read, nor removed: %s", path, error.strerror)
            continue
        removed.append(f"runs/active/{path.name}")
    return removed


def forget(store: Store, runs: Iterable[Run]) -> None:
    """Remove the records of runs that ended."""
    for run in runs:
        if run.name.startswith("active/"):
            (store.state / "runs" / run.name).unlink(missing_ok=True)
        else:
            remove_record(store, run.name)


def _record_name(sequence: str, place: str, keys: Iterable[str]) -> str:
    return _PREFIX + digest_of([sequence, *([place] if place else []), sorted(keys)])


def _unfinished(store: Store) -> Iterator[tuple[Run, bool]]:
    """Runs that have not recorded their end, and whether they are going on; those that can be read."""
    return ((run, going_on) for _, run, going_on in _looked_at(store) if run is not None)


def _looked_at(store: Store) -> Iterator[tuple[Path, Run | None, bool]]:
    """Files of runs that have not recorded their end, what they say, and whether a process holds them."""
    folder = store.state / "runs" / "active"
    for path in sorted(folder.glob("*.json")) if folder.is_dir() else []:
        try:
            file = os.open(path, os.O_RDONLY)
        except FileNotFoundError:
            continue
        except OSError as error:
            _say_unreadable(path, error)
            yield path, None, False
            continue
        try:
            fcntl.flock(file, fcntl.LOCK_SH | fcntl.LOCK_NB)
            going_on = False
        except BlockingIOError:
            going_on = True
        finally:
            os.close(file)
        try:
            run = _parsed(f"active/{path.name}", path.read_bytes())
            for _ in range(_LOOKS if going_on else 0):
                if run is not None:
                    break
                # Its process is writing it now: what it uses must not be passed over.
                time.sleep(_BETWEEN_LOOKS_S)
                run = _parsed(f"active/{path.name}", path.read_bytes())
        except FileNotFoundError:
            continue  # It ended meanwhile; its record is among the others.
        except OSError as error:
            _say_unreadable(path, error)
            run = None
        yield path, run, going_on


def _say_unreadable(path: Path, error: OSError) -> None:
    """Retention cannot spare what a run uses whose record may not be read."""
    log.warning("the record %s of a run, and so what it uses, cannot be read: %s", path, error.strerror)


def _write_all(file: int, text: bytes) -> None:
    """Make a text the content of an open file; a full disk takes a part, and says so at the next."""
    done = 0
    while done < len(text):
        done += os.pwrite(file, text[done:], done)
    os.ftruncate(file, len(text))


def _parsed(name: str, text: bytes) -> Run | None:
    try:
        return _run(name, json.loads(text))
    except ValueError:
        return None


def _run(name: str, record: dict[str, Any]) -> Run | None:
    try:
        keys = frozenset(map(str, record["keys"]))
        interrupted = record.get("interrupted") is True
        config, place = (str(record.get(field, "")) for field in ("config", "place"))
        return Run(name, str(record["sequence"]), str(record["ended"]), keys, interrupted, config, place)
    except (KeyError, TypeError):
        return None


def _now() -> str:
    return datetime.datetime.now(datetime.UTC).isoformat(timespec="microseconds")
