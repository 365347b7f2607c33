"""What the runs of a page share: the size of their images, the settings that were given, the time spent."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from typing import Any

from extrags.report.run_tables import plain_value

__all__ = ["given_settings", "seconds_of_all", "shared_facts"]


def shared_facts(
    sizes: Iterable[Sequence[int] | None], settings: Sequence[Mapping[str, Any]]
) -> list[tuple[str, str]]:
    """Image size, and the settings that all runs were given beside the profile; each with its label.

    Args:
        sizes: width and height of the images of each run in px; None where nobody knows.
        settings: of each run, values by dotted name.
    """
    known = dict.fromkeys(f"{size[0]} \N{MULTIPLICATION SIGN} {size[1]} px" for size in sizes if size)
    facts = [("Image size", ", ".join(known))] if known else []
    if _are_shared(settings):
        facts.append(("Settings given", _words(settings[0]) or "none beside the profile"))
    return facts


def given_settings(labels: Sequence[str], settings: Sequence[Mapping[str, Any]]) -> list[tuple[str, str]]:
    """The settings of each run, where they are not the same for all; the same ones of one label once."""
    if _are_shared(settings):
        return []
    words = (_words(given) or "none beside the profile" for given in settings)
    return list(dict.fromkeys(zip(labels, words, strict=True)))


def seconds_of_all(runs: Iterable[tuple[float, Iterable[Mapping[str, Any]]]]) -> float:
    """Time of several runs together; a stage that they share counts once.

    Args:
        runs: seconds of each, and its stages: `{artefacts, made_seconds}`, both where they are known.
    """
    shared: dict[tuple[str, ...], float] = {}
    alone = 0.0
    for seconds, stages in runs:
        told = {tuple(stage.get("artefacts", ())): stage.get("made_seconds", 0.0) for stage in stages}
        told.pop((), None)
        shared |= told
        alone += max(0.0, seconds - sum(told.values()))
    return sum(shared.values()) + alone


def _are_shared(settings: Sequence[Mapping[str, Any]]) -> bool:
    return bool(settings) and all(given == settings[0] for given in settings)


def _words(settings: Mapping[str, Any]) -> str:
    return ", ".join(f"{name} = {plain_value(value)}" for name, value in settings.items())
