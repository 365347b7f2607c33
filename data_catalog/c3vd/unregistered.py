"""Scenes recorded in this layout that are not in the catalogue: `FOLDER/SCENE@SETTING`.

A scene is what the folders `SCENE_v1`, `SCENE_v2`, ... in one folder show. Settings mean what they mean for
registered scenes: v1 and the next recording there is (v2, or where there is none v3, ...) are the pair. Under
`sparse` the latter trains and all of v1 evaluates, under `distanced` the other way round. Of the recording
that trains every 10th frame is used; all of them where it has fewer than 60, for it is thinned already then.
"""

from __future__ import annotations

import re
from pathlib import Path

from data_catalog.c3vd.published import Recording, RecordingPair
from data_catalog.c3vd.video import Video
from extrags.errors import SourceNotFoundError, UnknownSequenceError, did_you_mean

__all__ = ["SETTINGS", "folders_of_scene", "unregistered_pair"]

SETTINGS = ("sparse", "distanced")
_VERSION = 1
_TRAIN_EVERY = 10
_THINNED_BELOW = 60
"""No registered video of real length is shorter."""
_RECORDING = re.compile(r"(.+)_v(\d+)")
_NAMED = 6


def folders_of_scene(folder: Path, name: str) -> tuple[Path, Path] | None:
    """The recordings that a scene under a setting means: the one that trains, the one that evaluates.

    Args:
        folder: holds the recordings.
        name: `SCENE@SETTING`; without a setting it is none of these names.

    Raises:
        UnknownSequenceError: no such setting.
        SourceNotFoundError: a recording is absent; names its folder.
    """
    scene, at, setting = name.partition("@")
    if not at or not scene:
        return None
    if setting not in SETTINGS:
        raise UnknownSequenceError(
            f"{name}: no setting {setting!r}; known: {', '.join(SETTINGS)}{did_you_mean(setting, SETTINGS)}"
        )
    recordings = _recordings(folder)
    numbers = sorted(number for shown, number in recordings if shown == scene)
    if not numbers:
        scenes = sorted({shown for shown, _ in recordings})
        listed = ", ".join(scenes[:_NAMED]) + (", ..." if len(scenes) > _NAMED else "")
        there = (
            f"there are recordings of {listed}{did_you_mean(scene, scenes)}" if scenes else "there is none"
        )
        raise SourceNotFoundError(
            f"no recording of this scene; expected folders {scene}_v1 and {scene}_v2; {there}",
            file=folder / f"{scene}_v1",
        )
    absent = 1 if 1 not in numbers else 2 if len(numbers) < 2 else None
    if absent is not None:
        listed = " and ".join(recordings[scene, number].name for number in numbers)
        raise SourceNotFoundError(
            f"no such folder: {setting} takes one recording to train and another to evaluate, v1 and the "
            f"next there is; there is {listed}, which can be read alone",
            file=folder / f"{scene}_v{absent}",
        )
    first, other = recordings[scene, 1], recordings[scene, numbers[1]]
    return (other, first) if setting == "sparse" else (first, other)


def unregistered_pair(name: str, train: Path, test: Path) -> RecordingPair:
    """Which frames of two recordings train and evaluate.

    Args:
        name: `SCENE@SETTING`.
        train: folder of the recording that trains.
        test: folder of the recording that evaluates.

    Raises:
        SourceError: a recording is damaged; names file, frame and field.
    """
    scene, _, setting = name.partition("@")
    recordings = [
        Recording(
            dataset="",
            segment=scene,
            texture="",
            video=folder.name.removeprefix(f"{scene}_"),
            frames=len(Video.open(folder)),
        )
        for folder in (train, test)
    ]
    return RecordingPair(
        setting=setting,
        version=_VERSION,
        train_every=_TRAIN_EVERY if recordings[0].frames >= _THINNED_BELOW else 1,
        train=recordings[0],
        test=recordings[1],
    )


def _recordings(folder: Path) -> dict[tuple[str, int], Path]:
    """Folders by scene and number."""
    found = {}
    for place in sorted(folder.iterdir()):
        match = _RECORDING.fullmatch(place.name)
        if match is not None and place.is_dir():
            found[match[1], int(match[2])] = place
    return found
