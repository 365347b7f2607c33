"""Random damage to the files of a store, and what readers then get.

`python -m tests.flows.damaging STORE [TRIALS]` flips bits, deletes and truncates chunks in copies of the
artefacts of a store, and counts what was noticed, what was silently other data, and what did no harm.
"""

from __future__ import annotations

import json
import os
import random
import shutil
import sys
import tempfile
import zipfile
from collections import Counter
from collections.abc import Callable
from pathlib import Path
from typing import Any, Literal

import numpy as np
import zarr
from safetensors.numpy import load_file

from extrags.store import MANIFEST, Store
from extrags.zarr_io import PACKED, open_group, read_array

End = Literal["named", "raised", "absent", "other", "harmless"]
"""An error that names artefact and file; any other error; nothing in the store; other data; the same data."""


def flip_bit(file: Path, chance: random.Random) -> None:
    content = bytearray(file.read_bytes())
    content[chance.randrange(len(content))] ^= 1 << chance.randrange(8)
    file.write_bytes(content)


def delete(file: Path, chance: random.Random) -> None:
    file.unlink()


def truncate(file: Path, chance: random.Random) -> None:
    content = file.read_bytes()
    file.write_bytes(content[: chance.randrange(len(content))])


def files_of(store: Path) -> list[Path]:
    """All files of all artefacts, manifests and lists of checksums among them, relative to the store."""
    files = (path.relative_to(store) for path in sorted((store / "artefacts").rglob("*")) if path.is_file())
    return [file for file in files if (store / file).stat().st_size]


def chunks_of(store: Path) -> list[Path]:
    """All files with chunks of arrays, relative to the store."""
    return [file for file in files_of(store) if file.name.endswith(PACKED)]


def lose_a_chunk(file: Path, chance: random.Random) -> None:
    """One member of packed arrays is gone, and the zip file is whole."""
    with zipfile.ZipFile(file) as whole:
        members = [(item, whole.read(item)) for item in whole.infolist()]
    lost = chance.choice([item.filename for item, _ in members if "/c" in item.filename])
    with zipfile.ZipFile(file, "w") as less:
        for item, content in members:
            if item.filename != lost:
                less.writestr(item, content)


def served(store: Store, key: str) -> Any:
    """Everything that can be read of an artefact, as its readers get it; None when it is not in the store."""
    ref = store.find(key)
    if ref is None:
        return None
    folder = store.open(ref)
    found: dict[str, Any] = {MANIFEST: store.manifest(ref).model_dump(exclude={"checksum"})}
    for path in sorted(folder.rglob("*")):
        name = path.relative_to(folder).as_posix()
        if path.name.endswith(PACKED):
            group = open_group(path.with_name(path.name.removesuffix(PACKED)))
            found[name] = _arrays(group)
        elif name in (MANIFEST,) or not path.is_file():
            continue
        elif path.suffix == ".json":
            found[name] = json.loads(path.read_bytes())
        elif path.suffix == ".safetensors":
            found[name] = load_file(path)
        else:
            found[name] = path.read_bytes()
    return found


def _arrays(group: zarr.Group) -> dict[str, Any]:
    """Attributes and arrays of a group and of those inside it."""
    found: dict[str, Any] = {"": dict(group.attrs)}
    for name, member in group.members():
        if isinstance(member, zarr.Group):
            found[name] = _arrays(member)
        else:
            found[name] = (read_array(group, name), member.dtype, dict(member.attrs))
    return found


def same(first: Any, second: Any) -> bool:
    """Whether two trees hold the same values and the same bits of arrays."""
    if isinstance(first, np.ndarray) and isinstance(second, np.ndarray):
        return (
            first.dtype == second.dtype
            and first.shape == second.shape
            and first.tobytes() == second.tobytes()
        )
    if isinstance(first, dict) and isinstance(second, dict):
        return first.keys() == second.keys() and all(same(first[name], second[name]) for name in first)
    if isinstance(first, tuple | list) and isinstance(second, tuple | list):
        return len(first) == len(second) and all(map(same, first, second))
    return type(first) is type(second) and bool(first == second)


def trial(
    store: Path, file: Path, damage: Callable[[Path, random.Random], None], chance: random.Random, **how: Any
) -> End:
    """Damage a file in a copy of its artefact, and read the copy."""
    key = file.parts[1]
    with tempfile.TemporaryDirectory(dir=store) as place:
        copy = Path(place)
        # Links, except for the file itself.
        shutil.copytree(store / "artefacts" / key, copy / "artefacts" / key, copy_function=os.link)
        (copy / file).unlink()
        shutil.copyfile(store / file, copy / file)
        damage(copy / file, chance)
        try:
            found = served(Store(copy, **how), key)
        except Exception as error:
            return "named" if key in str(error) and file.name in str(error) else "raised"
    if found is None:
        return "absent"
    return "harmless" if same(found, served(Store(store, **how), key)) else "other"


def trials(store: Path, count: int, seed: int, **how: Any) -> dict[str, Counter[str]]:
    """Flipped bits in any file, then deleted and truncated chunks: how often each came to which end."""
    chance = random.Random(seed)
    zarr.config.set({"async.concurrency": 1})
    kinds: dict[str, tuple[list[Path], list[Callable[[Path, random.Random], None]]]] = {
        "flipped bit in any file": (files_of(store), [flip_bit]),
        "flipped bit in packed arrays": (chunks_of(store), [flip_bit]),
        "chunks deleted or truncated": (chunks_of(store), [delete, truncate, lose_a_chunk]),
    }
    return {
        name: Counter(
            trial(store, chance.choice(files), chance.choice(ways), chance, **how) for _ in range(count)
        )
        for name, (files, ways) in kinds.items()
    }


if __name__ == "__main__":
    for kind, ends in trials(Path(sys.argv[1]), int(sys.argv[2]) if len(sys.argv) > 2 else 100, 0).items():
        print(kind, dict(ends))
