"""Keys of JSON files that no reader asks for: what is misspelt must not be passed over in silence."""

from __future__ import annotations

import logging
from collections.abc import Collection, Iterable, Iterator, Mapping
from dataclasses import dataclass
from difflib import SequenceMatcher, get_close_matches
from pathlib import Path
from typing import Any

from data_catalog.lens_entries import is_about_lens, tells_distortion

__all__ = ["warn_of_unknown_keys"]

logger = logging.getLogger(__name__)

_NAMED_KEYS = 5
_LONGEST_NAME = 40
_PERHAPS, _LIKELY, _VERY_LIKELY = 0.5, 0.6, 0.75
"""Similarity of a key to the one that was perhaps meant; that was probably meant; and that was meant where
programs write many others."""


def warn_of_unknown_keys(
    content: Mapping[str, Any],
    *,
    known: Collection[str],
    known_of_frames: Collection[str],
    frame_name: str,
    file: Path,
    others: Collection[str] | None = None,
) -> None:
    """Warn, once for a file, of keys that nothing asks for.

    A key that begins with `_` or `/` is a remark, and needs no warning.

    Args:
        content: of the file, with a list `frames` where it has some.
        known: keys beside `frames`, itself among them.
        known_of_frames: keys of a frame.
        frame_name: key of a frame that names it.
        file: named in the warning.
        others: keys that programs write and that change nothing here. With them, any further key may be such
            a one: only what is nearly spelt like a known key, or tells of distortion, is worth a warning.
            Without them all are named but those that `check_pinhole` looks at.
    """
    unknown = list(_unknown(content, set(known), set(known_of_frames), frame_name))
    if others is None:
        unknown = [key for key in unknown if not is_about_lens(key.name)]
    else:
        unknown = [
            key
            for key in unknown
            if key.name not in others
            and (key.about_lens or (key.similarity >= _VERY_LIKELY and not _has_word_of_its_own(key)))
        ]
    if not unknown:
        return
    told = "; ".join(str(key) for key in unknown[:_NAMED_KEYS])
    more = f"; and {len(unknown) - _NAMED_KEYS} more" if len(unknown) > _NAMED_KEYS else ""
    misspelt = next((key for key in unknown if key.similarity >= _LIKELY), None)
    logger.warning(
        "%s: unknown keys are ignored: %s%s",
        file,
        told,
        more,
        # With a topic it is a finding of `data check`: what is misspelt was to say something.
        extra={} if misspelt is None else {"topic": "unknown key", "field": misspelt.shown},
    )


@dataclass
class _UnknownKey:
    """A key that nothing asks for, and where it is."""

    name: str
    similarity: float
    """To what was perhaps meant."""
    hint: str
    """What was perhaps meant, as the end of a sentence; empty where nothing is near."""
    meant: str = ""
    """What was perhaps meant; empty where nothing is near."""
    about_lens: bool = False
    first: str = ""
    """The first frame that has it."""
    count: int = 0
    """How many frames have it; 0 for a key beside them."""
    frames: int = 0
    """How many there are."""

    @property
    def shown(self) -> str:
        """The key, at a length that fits into a message."""
        return self.name if len(self.name) <= _LONGEST_NAME else f"{self.name[:_LONGEST_NAME]}..."

    def __str__(self) -> str:
        where = f" in {self.count} of {self.frames} frames, {self.first} first" if self.count else ""
        return f"{self.shown!r}{where}{self.hint}"


def _unknown(
    content: Mapping[str, Any], known: set[str], known_of_frames: set[str], frame_name: str
) -> Iterator[_UnknownKey]:
    """Keys beside the frames, then those of frames, each once."""
    frames = content.get("frames", ())
    for name in _not_asked_for(content, known):
        key = _unknown_key(name, known, known_of_frames, "in each frame")
        key.about_lens = tells_distortion(name, content[name])
        yield key
    found: dict[str, _UnknownKey] = {}
    for entry in frames:
        for name in _not_asked_for(entry, known_of_frames):
            if name not in found:
                key = found[name] = _unknown_key(name, known_of_frames, known, "beside the frames")
                key.first, key.frames = str(entry[frame_name])[-_LONGEST_NAME:], len(frames)
            found[name].count += 1
            found[name].about_lens |= tells_distortion(name, entry[name])
    yield from found.values()


def _not_asked_for(entries: Iterable[str], known: set[str]) -> list[str]:
    return [name for name in entries if name not in known and not name.startswith(("_", "/"))]


def _unknown_key(name: str, known: set[str], known_elsewhere: set[str], elsewhere: str) -> _UnknownKey:
    if name in known_elsewhere:
        return _UnknownKey(name, 1.0, f" (it is looked for {elsewhere})")
    small = {other.lower(): other for other in sorted(known)}
    given = name.lower()[:_LONGEST_NAME]
    near = get_close_matches(given, small, n=1, cutoff=_PERHAPS)
    if not near:
        return _UnknownKey(name, 0.0, "")
    return _UnknownKey(
        name,
        SequenceMatcher(None, near[0], given).ratio(),
        f" (did you mean {small[near[0]]}?)",
        small[near[0]],
    )


def _has_word_of_its_own(key: _UnknownKey) -> bool:
    """Whether a key differs from what was perhaps meant by a whole word: then it is another key's name.

    As `lidar_file_path` does from `depth_file_path`; a word that is missing, abbreviated or nearly spelt like
    the other is a mistake.
    """
    if not key.meant:
        return False
    given, meant = (name.lower().split("_") for name in (key.name, key.meant))
    if len(given) != len(meant):
        return len(given) > len(meant) and set(meant) < set(given)
    return any(not _is_like(one, other) for one, other in zip(given, meant, strict=True))


def _is_like(word: str, other: str) -> bool:
    short, long = sorted((word, other), key=len)
    begins = len(short) > 1 and long.startswith(short)
    return word == other or begins or SequenceMatcher(None, word, other).ratio() >= _LIKELY
