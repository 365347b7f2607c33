"""Damaged files by the thousand: what readers make of bytes that somebody else has written.

`python -m tests.fuzzing FOLDER CASE:FIRST:COUNT ...` reads mutations of good files, one line of JSON each: a
named error or a read is as it should be; anything else, a crash, a hang or a memory blow-up is not. Seeds are
fixed by case and number, so that each can be had again.
"""

from __future__ import annotations

import json
import logging
import resource
import shutil
import signal
import sys
import time
import traceback
import warnings
import zlib
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.random import Generator

LIMIT_S = 10
LIMIT_BYTES = 2 << 30
"""Of address space beyond what the process has when it begins."""

VALUES: tuple[Any, ...] = (
    None,
    True,
    -1,
    0,
    3,
    10**30,
    1e308,
    -1e-320,
    float("nan"),
    float("inf"),
    "",
    "x",
    "../../../etc/passwd",
    "a\0b",
    "9" * 5000,
    [],
    {},
    [[]],
    {"frames": []},
    [1, 2, 3],
    "\ud800",
)
WORDS = (
    b"nan",
    b"-1",
    b"1e400",
    b"99999999999999999999",
    b"",
    b"inf",
    b"0",
    b"\xff\xfe",
    b"{",
    b"[",
    b"9" * 5000,
    b"0x1p3",
)


class TooSlowError(BaseException):
    """One read took longer than the limit."""


@dataclass(frozen=True)
class Case:
    """One kind of file.

    Args:
        make: writes a good source into a folder and returns what is read.
        file: which file is spoilt, relative to the folder.
        read: what reads it.
    """

    make: Callable[[Path], Path]
    file: str
    read: Callable[[Path], object]


def mutated(content: bytes, generator: Generator) -> bytes:
    """One change of the bytes; of JSON half of the changes are of its structure."""
    if content[:1] in (b"{", b"[") and generator.random() < 0.6:
        return _other_structure(content, generator)
    if not content:
        return b"\0"
    for _ in range(int(generator.integers(1, 4))):
        content = _CHANGES[int(generator.integers(len(_CHANGES)))](content, generator)
        if not content:
            break
    return content


def _place(content: bytes, generator: Generator) -> int:
    # Headers tell the most: half of the changes are there.
    near = len(content) if generator.random() < 0.5 else min(len(content), 400)
    return int(generator.integers(near))


def _flip(content: bytes, generator: Generator) -> bytes:
    at = _place(content, generator)
    return content[:at] + bytes([content[at] ^ (1 << int(generator.integers(8)))]) + content[at + 1 :]


def _truncate(content: bytes, generator: Generator) -> bytes:
    return content[: _place(content, generator)]


def _delete(content: bytes, generator: Generator) -> bytes:
    at = _place(content, generator)
    return content[:at] + content[at + int(generator.integers(1, 40)) :]


def _splice(content: bytes, generator: Generator) -> bytes:
    at, other = _place(content, generator), _place(content, generator)
    return content[:at] + content[other : other + int(generator.integers(1, 200))] + content[at:]


def _huge(content: bytes, generator: Generator) -> bytes:
    at = _place(content, generator)
    size = int(generator.choice([1, 2, 4, 8]))
    return content[:at] + bytes([int(generator.choice([0, 0x7F, 0x80, 0xFF]))]) * size + content[at + size :]


def _word(content: bytes, generator: Generator) -> bytes:
    words = content.split(b" ")
    words[int(generator.integers(len(words)))] = WORDS[int(generator.integers(len(WORDS)))]
    return b" ".join(words)


def _line(content: bytes, generator: Generator) -> bytes:
    lines = content.split(b"\n")
    first, second = (int(value) for value in generator.integers(len(lines), size=2))
    lines[first], lines[second] = lines[second], lines[first]
    if generator.random() < 0.5:
        del lines[first]
    return b"\n".join(lines)


_CHANGES = (_flip, _truncate, _delete, _splice, _huge, _word, _line)


def _other_structure(content: bytes, generator: Generator) -> bytes:
    tree = json.loads(content)
    node, key = tree, None
    while isinstance(node, dict | list) and node and (key is None or generator.random() < 0.8):
        keys = list(node) if isinstance(node, dict) else list(range(len(node)))
        parent, key = node, keys[int(generator.integers(len(keys)))]
        node = parent[key]
    if key is None or generator.random() < 0.02:
        return b"[" * 100_000
    chosen = int(generator.integers(len(VALUES) + 2))
    if chosen < len(VALUES):
        parent[key] = VALUES[chosen]
    elif chosen == len(VALUES) and isinstance(parent, dict):
        del parent[key]
    else:
        parent[key] = [parent[key]] * 3
    return json.dumps(tree).encode()


def seed_of(case: str, number: int) -> list[int]:
    """Of one mutation."""
    return [zlib.crc32(case.encode()), number]


def try_one(case: Case, name: str, number: int, good: Path, place: Path) -> dict[str, Any]:
    """Read one mutation; what came of it."""
    from extrags.errors import ExtragsError

    shutil.rmtree(place, ignore_errors=True)
    shutil.copytree(good, place)
    target = place / _targets[good].relative_to(good)
    spoilt = place / case.file
    spoilt.write_bytes(mutated(spoilt.read_bytes(), np.random.default_rng(seed_of(name, number))))
    begun = time.monotonic()
    told: dict[str, Any] = {"case": name, "number": number}
    signal.alarm(LIMIT_S)
    try:
        case.read(target)
        told["end"] = "read"
    except ExtragsError as error:
        told.update(end="named", what=f"{type(error).__name__}: {error}"[:300])
    except TooSlowError:
        told.update(end="hung", what="".join(traceback.format_exc()[-1500:]))
    except BaseException as error:
        told.update(
            end="other", what=f"{type(error).__name__}: {error}"[:300], where=traceback.format_exc()[-1200:]
        )
    finally:
        signal.alarm(0)
    told["seconds"] = round(time.monotonic() - begun, 2)
    return told


_targets: dict[Path, Path] = {}


def main(arguments: list[str]) -> None:
    """Read the mutations that the arguments name."""
    from tests.fuzzing_cases import CASES

    warnings.simplefilter("ignore")
    logging.disable(logging.CRITICAL)
    root = Path(arguments[0])

    def too_slow(*_: object) -> None:
        raise TooSlowError

    signal.signal(signal.SIGALRM, too_slow)
    first = True
    for argument in arguments[1:]:
        name, begin, count = argument.split(":")
        case, good = CASES[name], root / f"good-{name}"
        shutil.rmtree(good, ignore_errors=True)
        good.mkdir(parents=True)
        _targets[good] = case.make(good)
        case.read(_targets[good])
        if first:
            # Everything is loaded by now.
            pages = int(Path("/proc/self/statm").read_text().split()[0])
            limit = pages * resource.getpagesize() + LIMIT_BYTES
            resource.setrlimit(resource.RLIMIT_AS, (limit, limit))
            first = False
        for number in range(int(begin), int(begin) + int(count)):
            print(json.dumps({"case": name, "number": number, "end": "begun"}), flush=True)
            print(json.dumps(try_one(case, name, number, good, root / "spoilt")), flush=True)


if __name__ == "__main__":
    main(sys.argv[1:])
