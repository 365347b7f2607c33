"""Which sequences a run takes: names, patterns and manifests become a list, each with its settings."""

from __future__ import annotations

import json
import logging
import os
import re
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from data_catalog.names import comparable_name, plain_name
from data_catalog.patterns import is_pattern, matching_names
from extrags.config import PipelineConfig
from extrags.config.settings import parsed_words, settings_of
from extrags.errors import ConfigError, reason_of
from extrags.store import digest_of
from extrags.user_paths import expanded
from extrags.yaml_text import read_yaml

__all__ = ["Chosen", "absolute_manifests", "chosen_sequences"]

log = logging.getLogger(__name__)

MANIFEST_MARK = "@"
FIELDS = frozenset({"sequence", "settings"})


@dataclass(frozen=True)
class Chosen:
    """A sequence, and what a manifest sets for it alone.

    Args:
        name: as in the catalogue, or a path in its plain spelling (`data_catalog.names`).
        settings: overrides by dotted name.
    """

    name: str
    settings: dict[str, Any] = field(default_factory=dict)


def chosen_sequences(given: Sequence[str]) -> list[Chosen]:
    """Expand what a user or a deployment named, in its order; what several patterns match is there once.

    Args:
        given: names, paths, patterns over the catalogue's names (`data_catalog.patterns`), and `@FILE` for
            a manifest: a text with one of these per line, where `#` begins a comment at the beginning of
            a line or behind white space, unless it belongs to the path of something that is there; or a
            YAML or JSON file with a list of names or of `{sequence: NAME, settings: {...}}`, alone or as
            `sequences` beside `settings` for all of them.

    Raises:
        ConfigError: for a manifest that cannot be read, a wrong word for a setting, one sequence with
            different settings, a name that stands there twice, or one that is no UTF-8.
        UnknownSequenceError: for a pattern that matches nothing.
        SourceNotFoundError: for a pattern whose sequences are all elsewhere.
    """
    found: dict[str, Chosen] = {}
    literal: set[str] = set()
    for item in _without_manifests(given):
        _check_is_text(item.name)
        names: Sequence[str] = [plain_name(item.name)]
        if is_pattern(item.name):
            names, elsewhere = matching_names(item.name)
            if elsewhere:
                log.warning(
                    "%s: %d of %d sequences are not on this machine and left out",
                    item.name,
                    len(elsewhere),
                    len(elsewhere) + len(names),
                )
        else:
            place = comparable_name(item.name)
            if place in literal:
                raise ConfigError(f"a sequence is named twice: {item.name}")
            literal.add(place)
        for name in names:
            known = found.setdefault(name, Chosen(name, item.settings))
            if digest_of(known.settings) != digest_of(item.settings):
                raise ConfigError(f"{name} is chosen twice, with different settings")
    if not found:
        raise ConfigError(f"no sequence is named in {', '.join(given) or 'an empty list'}")
    return list(found.values())


def _check_is_text(name: str) -> None:
    """Refuse what Python takes the bytes of a path for that are no UTF-8.

    Manifests, pages and Prefect's parameters hold text: the run would end at the first of them.
    """
    try:
        name.encode()
    except UnicodeEncodeError as error:
        # Messages are text as well.
        shown = name.encode(errors="backslashreplace").decode()
        raise ConfigError(
            f"the name {shown} is no UTF-8, as artefacts and pages are; rename the folder or file"
        ) from error


def absolute_manifests(given: Sequence[str]) -> list[str]:
    """The same with absolute paths of manifests, for who reads them in another directory."""
    return [
        f"{MANIFEST_MARK}{expanded(text[1:]).absolute()}" if text.startswith(MANIFEST_MARK) else text
        for text in given
    ]


def _without_manifests(given: Sequence[str]) -> Iterator[Chosen]:
    for text in given:
        if text.startswith(MANIFEST_MARK):
            yield from _manifest(expanded(text[1:]))
        else:
            yield Chosen(text)


def _manifest(file: Path) -> Iterator[Chosen]:
    try:
        # Editors of some systems begin a file with a byte-order mark.
        text = file.read_text(encoding="utf-8-sig")
    except OSError as error:
        raise ConfigError(f"the manifest {file} cannot be read: {reason_of(error)}") from error
    except UnicodeDecodeError as error:
        raise ConfigError(f"the manifest {file} cannot be read: {error}") from error
    suffix = file.suffix.lower()
    if suffix not in (".yaml", ".yml", ".json"):
        for line in text.splitlines():
            if name := _without_comment(line):
                yield Chosen(name)
        return
    try:
        content = json.loads(text) if suffix == ".json" else read_yaml(text)
    except (RecursionError, ValueError) as error:
        raise ConfigError(f"the manifest {file} is no {suffix[1:].upper()}: {error}") from error
    shared: dict[str, Any] = {}
    if isinstance(content, dict):
        unknown = set(content) - {"sequences", "settings"}
        if unknown:
            raise ConfigError(
                f"the manifest {file} has the field {sorted(map(str, unknown))[0]}; "
                "expected sequences and settings"
            )
        shared = _settings(content.get("settings"), file, "settings")
        content = content.get("sequences")
    if not isinstance(content, list):
        raise ConfigError(f"the manifest {file} holds no list of sequences")
    for number, entry in enumerate(content):
        where = f"entry {number + 1}"
        if isinstance(entry, str):
            entry = {"sequence": entry}
        if (
            not isinstance(entry, dict)
            or not set(entry) <= FIELDS
            or not isinstance(entry.get("sequence"), str)
            or not entry["sequence"].strip()
        ):
            raise ConfigError(
                f"the manifest {file}, {where}: expected a name, or {{sequence: NAME, settings: {{...}}}}"
            )
        yield Chosen(entry["sequence"].strip(), shared | _settings(entry.get("settings"), file, where))


def _without_comment(line: str) -> str:
    """The name in a line of a text; empty where it holds none.

    The longest part that is a path counts: folders may be called `scan #3`, with `scan` beside them.
    """
    line = line.strip()
    if line.startswith("#"):
        return ""
    # `@` cannot begin a comment: it stands within names, as `#` does without white space before it.
    ends = [found.start() for found in re.finditer(r"\s+#", line)]
    parts = [line, *(line[:end] for end in reversed(ends))]
    return next((part for part in parts if os.path.exists(os.path.expanduser(part))), parts[-1])


def _settings(given: Any, file: Path, where: str) -> dict[str, Any]:
    if given is None:
        return {}
    if not isinstance(given, dict) or not all(isinstance(name, str) for name in given):
        raise ConfigError(
            f"the manifest {file}, {where}: expected settings by dotted name, e.g. {{coarse.iterations: 500}}"
        )
    try:
        return parsed_words(given, settings_of(PipelineConfig))
    except ConfigError as error:
        raise ConfigError(f"the manifest {file}, {where}: {error}") from error
