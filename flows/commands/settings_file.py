"""`--config FILE`: settings of a run from a YAML or JSON file."""

from __future__ import annotations

import json
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

from extrags.errors import ConfigError
from extrags.user_paths import expanded
from extrags.yaml_text import read_yaml

__all__ = ["settings_of_file"]

_OPTIONS = ("profile", "method", "seed", "store", "runner")
"""What a user may look for in such a file, and what is an option of its own."""


def settings_of_file(file: Path) -> dict[str, Any]:
    """The settings in a file by dotted name, checked as those of `--set` are.

    Args:
        file: YAML, or JSON where it ends in `.json`: an object with dotted names, with groups inside each
            other, or with both: `{"coarse": {"iterations": 500, "light.enabled": false}}`. An empty group
            sets nothing.

    Raises:
        ConfigError: a file that cannot be read, or a setting that is unknown (with the nearest), given twice,
            or of a wrong kind or out of range. It names the file.
    """
    from extrags.config import PipelineConfig
    from extrags.config.settings import settings_of, unknown_setting

    known = settings_of(PipelineConfig)
    groups = {name.rpartition(".")[0] for name in known}
    groups |= {group.rpartition(".")[0] for group in groups}
    found: dict[str, Any] = {}
    for name, value in _entries(_content(file), file, known, groups - {""}):
        if name in found:
            raise ConfigError(f"--config {file}: {name} is given twice")
        try:
            if name not in known:
                raise unknown_setting(name, known)
            found[name] = known[name].checked(value)
        except ConfigError as error:
            option = f"; --{name} is an option of the command line" if name in _OPTIONS else ""
            raise ConfigError(f"--config {file}: {error}{option}") from error
    return found


def _content(file: Path) -> Mapping[Any, Any]:
    """The object that a file holds; an empty one of an empty file."""
    kind = "JSON" if file.suffix.lower() == ".json" else "YAML"
    try:
        # Editors on Windows put a mark at the beginning.
        text = expanded(file).read_text(encoding="utf-8-sig")
    except (OSError, UnicodeDecodeError) as error:
        problem = getattr(error, "strerror", None) or error
        raise ConfigError(f"--config {file} cannot be read: {problem}") from error
    try:
        content = _of_json(text) if kind == "JSON" else _of_yaml(text)
    except _RepeatedKeyError as error:
        raise ConfigError(f"--config {file}: {error}") from error
    except (RecursionError, ValueError) as error:
        raise ConfigError(f"--config {file} is no {kind}: {' '.join(str(error).split())}") from error
    if content is None:
        return {}
    if not isinstance(content, dict):
        raise ConfigError(f"--config {file}: expected settings by name, e.g. coarse.iterations: 500")
    return content


class _RepeatedKeyError(Exception):
    """A key that one object of a file has twice: of the two values, parsers keep the last."""


def _of_json(text: str) -> Any:
    def unique(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
        made: dict[str, Any] = {}
        for key, value in pairs:
            if key in made:
                raise _RepeatedKeyError(f"{key} is given twice")
            made[key] = value
        return made

    return json.loads(text, object_pairs_hook=unique)


def _of_yaml(text: str) -> Any:
    import yaml

    class UniqueKeys(yaml.SafeLoader):
        # Not where objects are constructed: by then, `<<` may have put keys there that others override.
        def compose_mapping_node(self, anchor: Any) -> yaml.MappingNode:
            node = super().compose_mapping_node(anchor)
            seen = set()
            for key, _ in node.value:
                if isinstance(key, yaml.ScalarNode):
                    if (key.tag, key.value) in seen:
                        line = key.start_mark.line + 1
                        raise _RepeatedKeyError(f"{key.value} is given twice, again in line {line}")
                    seen.add((key.tag, key.value))
            return node

    return read_yaml(text, UniqueKeys)


def _entries(
    content: Mapping[Any, Any], file: Path, known: Mapping[str, Any], groups: set[str], prefix: str = ""
) -> Iterator[tuple[str, Any]]:
    """Dotted names and values of all groups."""
    for key, value in content.items():
        if not isinstance(key, str):
            raise ConfigError(f"--config {file}: {prefix}{key}: expected the name of a setting or a group")
        name = f"{prefix}{key}"
        if name in groups and name not in known and (value is None or isinstance(value, dict)):
            yield from _entries(value or {}, file, known, groups, f"{name}.")
        else:
            yield name, value
