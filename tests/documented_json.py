"""JSON that commands write, held against the tables of docs/json.md."""

from __future__ import annotations

import re
from functools import cache
from pathlib import Path
from typing import Any

PAGE = Path(__file__).resolve().parents[1] / "docs" / "json.md"

PLAIN: dict[str, tuple[type, ...]] = {
    "text": (str,),
    "boolean": (bool,),
    "integer": (int,),
    "number": (int, float),
    "object": (dict,),
    "list": (list,),
    "null": (type(None),),
}


@cache
def tables() -> dict[str, dict[str, str]]:
    """Types of keys by the anchor of the section; a view has the keys of the metrics as well."""
    found = {}
    for section in re.split(r"^#+ ", PAGE.read_text(encoding="utf-8"), flags=re.MULTILINE)[1:]:
        heading = section.partition("\n")[0]
        rows = [row.strip("|").split("|") for row in re.findall(r"^\|.*", section, re.MULTILINE)[2:]]
        keys = {key: row[1].strip() for row in rows for key in re.findall(r"`(\w+)`", row[0])}
        if keys:
            found[heading.lower().replace(" ", "-")] = keys
    found["a-view"] = {**found["metrics"], **found["a-view"]}
    return found


def undocumented(value: Any, section: str) -> list[str]:
    """What of a JSON object is not as its section says: keys that are missing there or here, other types.

    Args:
        value: of a command.
        section: anchor in docs/json.md.
    """
    return _of_object(value, section, "$")


def undocumented_items(items: Any, section: str) -> list[str]:
    """The same of a list of JSON objects, of which there has to be one at least.

    Args:
        items: of a command.
        section: anchor of what one of them is.
    """
    if not isinstance(items, list) or not items:
        return ["$ is no list with items"]
    return [line for index, item in enumerate(items) for line in _of_object(item, section, f"$.{index}")]


def _of_object(value: Any, section: str, where: str) -> list[str]:
    if not isinstance(value, dict):
        return [f"{where} is {type(value).__name__}, not an object"]
    table, found = tables()[section], []
    used = set()
    for key, inside in value.items():
        name = key if key in table else next((known for known in table if _is_called(key, known)), None)
        if name is None:
            found.append(f"{where}.{key} is not documented")
            continue
        used.add(name)
        found += _of_type(inside, table[name].removeprefix("optional "), f"{where}.{key}")
    missing = [key for key, kind in table.items() if key not in used and not kind.startswith("optional ")]
    return [*found, *(f"{where}.{key} is not there" for key in missing)]


def _is_called(key: str, known: str) -> bool:
    """Whether a key is one of those that a name in capitals stands for: `lpips_NET`."""
    return re.fullmatch(re.sub(r"[A-Z]+", "[a-z]+", known), key) is not None


def _of_type(value: Any, kind: str, where: str) -> list[str]:
    if container := re.match(r"(list|map) of (.*)", kind):
        if value is None and "null" in kind.split(" or "):
            return []
        expected = list if container[1] == "list" else dict
        if not isinstance(value, expected):
            return [f"{where} is {type(value).__name__}, not a {container[1]}"]
        inside = value.items() if isinstance(value, dict) else enumerate(value)
        return [line for name, item in inside for line in _of_type(item, container[2], f"{where}.{name}")]
    kinds = kind.split(" or ")
    for one in kinds:
        if link := re.fullmatch(r"\[.*\]\(#(.*)\)", one):
            if isinstance(value, dict):
                return _of_object(value, link[1], where)
        elif isinstance(value, PLAIN[one]) and (one == "boolean" or not isinstance(value, bool)):
            return []
    return [f"{where} is {type(value).__name__}, not {kind}"]
