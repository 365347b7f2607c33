"""YAML of others: what it stands for, and how deep it is nested, is looked at before anything is made of it.

An alias stands for all of what it names: a few lines of aliases of aliases are a thousand million values,
once somebody walks through them or merges them. What is nested too deeply ends PyYAML's parser in C, and
the process with it.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    import yaml

__all__ = ["read_yaml"]

_DEEPEST = 100
"""Lists and mappings inside each other."""
_MOST_VALUES = 1_000_000
"""Of a text with aliases, each counted with all that it stands for."""


def read_yaml(text: str, loader: Any = None) -> Any:
    """What a text holds: numbers, words, lists and mappings; never objects of Python.

    Args:
        text: of one document.
        loader: `yaml.SafeLoader` by default, or a class that is derived from it; or `yaml.CSafeLoader`.

    Raises:
        ValueError: when it is no YAML, is nested too deeply, or stands for too many values.
    """
    import yaml

    loader = loader or yaml.SafeLoader
    safe = (yaml.SafeLoader, getattr(yaml, "CSafeLoader", yaml.SafeLoader))
    if not issubclass(loader, safe):
        raise TypeError(f"{loader.__name__} makes objects of Python")
    try:
        _check(yaml.parse(text, Loader=loader))
        return yaml.load(text, Loader=loader)
    except yaml.YAMLError as error:
        raise ValueError(" ".join(str(error).split())) from error
    except RecursionError as error:
        raise ValueError("it is nested too deeply") from error


def _check(events: Any) -> None:
    """Raises `ValueError` for a text that is small, and what it stands for is not."""
    import yaml

    sizes: dict[str, int] = {}
    """Values that each anchor stands for."""
    # One for the document, which holds the outermost value.
    open_anchors: list[str | None] = [None]
    open_sizes = [0]
    aliases = False
    for event in events:
        if isinstance(event, yaml.CollectionStartEvent):
            if len(open_sizes) > _DEEPEST:
                raise ValueError(
                    f"it is nested too deeply{_place(event)}; at most {_DEEPEST} levels are read"
                )
            open_anchors.append(event.anchor)
            open_sizes.append(1)
            continue
        if isinstance(event, yaml.CollectionEndEvent):
            anchor, size = open_anchors.pop(), open_sizes.pop()
        elif isinstance(event, yaml.AliasEvent) and event.anchor is not None:
            if event.anchor in open_anchors:
                raise ValueError(f"*{event.anchor} stands for what it is a part of{_place(event)}")
            # One that is not known is refused by whoever loads the text, with its place.
            anchor, size, aliases = None, sizes.get(event.anchor, 1), True
        elif isinstance(event, yaml.ScalarEvent):
            anchor, size = event.anchor, 1
        else:
            continue
        if anchor is not None:
            sizes[anchor] = size
        open_sizes[-1] += size
        if aliases and open_sizes[-1] > _MOST_VALUES:
            raise ValueError(f"its aliases stand for more than {_MOST_VALUES} values{_place(event)}")


def _place(event: yaml.Event) -> str:
    mark = event.start_mark
    return "" if mark is None else f" (line {mark.line + 1})"
