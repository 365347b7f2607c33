"""Which registered videos there are, and which of them train and evaluate together.

`videos.json` holds every registered video with its number of frames, as published; `splits/DATASET.json` the
named, versioned split manifests. Names: `c3vdv2/c1_cecum_t1_v2` is one video, `c3vdv2/c1_cecum_t1@sparse` two
videos of one scene under a manifest (without a setting: `sparse`).

Not known, and not guessed at here: which colon and which videos the paper's two scenes are (the manifests
take v2 to train and v1 to evaluate, which gives plausible counts), and the exposure of either video. The
videos with a deforming colon (v4) and the screening videos have no depth; they are not in this list, but
their folders can be read by path.
"""

from __future__ import annotations

import json
import math
from functools import lru_cache
from pathlib import Path
from typing import Any

from pydantic import BaseModel, ConfigDict

from data_catalog.c3vd.scaramuzza import CalibrationName
from extrags.errors import UnknownSequenceError

__all__ = [
    "PublishedSet",
    "Recording",
    "RecordingPair",
    "SplitManifest",
    "find",
    "find_recording",
    "find_scene",
    "published_sets",
]

_HERE = Path(__file__).parent


class _Model(BaseModel):
    model_config = ConfigDict(frozen=True, extra="forbid")


class Recording(_Model):
    """One registered video."""

    dataset: str
    """Empty where it is not registered."""
    segment: str
    """Colon and part of it, e.g. `c1_cecum`."""
    texture: str
    """`t1` to `t4`; empty where it is not registered."""
    video: str
    """`v1`, `v2`, `v3`; of C3VD `a`, `b`, `c`."""
    frames: int

    @property
    def scene(self) -> str:
        """Segment and texture: what several videos show."""
        return f"{self.segment}_{self.texture}" if self.texture else self.segment

    @property
    def stem(self) -> str:
        """Name of its folder."""
        return f"{self.scene}_{self.video}"

    @property
    def name(self) -> str:
        """`DATASET/SEQUENCE`."""
        return _named(self.dataset, self.stem)


class RecordingPair(_Model):
    """Two videos of one scene: one trains, the other evaluates."""

    setting: str
    version: int
    train_every: int
    """Every n-th frame of the one trains; all frames of the other evaluate."""
    train: Recording
    test: Recording

    @property
    def name(self) -> str:
        """`DATASET/SCENE@SETTING`."""
        return _named(self.train.dataset, f"{self.train.scene}@{self.setting}")

    @property
    def train_frames(self) -> range:
        """Which frames of the training video are used, by position."""
        return range(0, self.train.frames, self.train_every)

    @property
    def frames(self) -> int:
        """Frames that are used, both videos together."""
        return math.ceil(self.train.frames / self.train_every) + self.test.frames


def _named(dataset: str, sequence: str) -> str:
    return f"{dataset}/{sequence}" if dataset else sequence


class _Roles(_Model):
    train: str
    test: str


class SplitManifest(_Model):
    """One setting of a dataset: which video of each scene trains, which evaluates."""

    version: int
    """Raised by hand when frames change."""
    rule: str
    train_every: int
    scenes: dict[str, _Roles]


class PublishedSet(_Model):
    """What all videos of a dataset share."""

    name: str
    title: str
    folders: tuple[str, ...]
    """Folders below a data root in which the videos may lie."""
    calibration: CalibrationName
    depth_range_mm: float
    """What the largest 16-bit code stands for."""
    width: int
    height: int
    licence: str
    recordings: tuple[Recording, ...]
    aliases: dict[str, str]
    """Other beginnings of the folders' names: C3VD was renamed when C3VDv2 came out."""
    remarks: dict[str, str]
    """What is particular to each kind of video."""
    splits: dict[str, SplitManifest]

    def recording(self, scene: str, video: str) -> Recording | None:
        """A video, or None where there is none."""
        return next((item for item in self.recordings if (item.scene, item.video) == (scene, video)), None)

    def pairs(self) -> tuple[RecordingPair, ...]:
        """Every scene under every manifest."""
        return tuple(self.pair(scene, name) for name, split in self.splits.items() for scene in split.scenes)

    def pair(self, scene: str, setting: str) -> RecordingPair:
        """Two videos of a scene under a manifest.

        Raises:
            UnknownSequenceError: no such setting or scene, or the scene has no two videos to compare.
        """
        split = self.splits.get(setting)
        if split is None:
            raise UnknownSequenceError(
                f"{self.name} has no setting {setting!r}; known: {', '.join(self.splits)}"
            )
        roles = split.scenes.get(scene)
        if roles is None:
            videos = [item for item in self.recordings if item.scene == scene]
            if not videos:
                raise UnknownSequenceError(f"{self.name} has no scene {scene!r}")
            listed = " and ".join(item.stem for item in videos)
            raise UnknownSequenceError(
                f"{self.name}/{scene} has no two videos on different trajectories, so nothing to hold out; "
                f"there is {listed}, which can be read alone"
            )
        train, test = self.recording(scene, roles.train), self.recording(scene, roles.test)
        if train is None or test is None:
            raise UnknownSequenceError(f"{self.name}@{setting} names a video of {scene} that is not listed")
        return RecordingPair(
            setting=setting, version=split.version, train_every=split.train_every, train=train, test=test
        )

    def stems(self, recording: Recording) -> tuple[str, ...]:
        """Names a video's folder may have."""
        new = self.aliases.get(recording.segment)
        if new is None:
            return (recording.stem,)
        return (recording.stem, f"{new}_{recording.texture}_v{'abc'.index(recording.video) + 1}")

    def folder_names(self, recording: Recording) -> tuple[str, ...]:
        """Where a video may lie below a data root, or below a folder that holds all of them."""
        stems = self.stems(recording)
        return (*(f"{folder}/{stem}" for folder in self.folders for stem in stems), *stems)


@lru_cache(maxsize=1)
def published_sets() -> dict[str, PublishedSet]:
    """The sets by name, C3VDv2 first."""
    content: dict[str, dict[str, Any]] = json.loads((_HERE / "videos.json").read_text())
    found = {}
    for name, entry in content.items():
        letters = entry.pop("videos")
        recordings = tuple(
            Recording(dataset=name, segment=segment, texture=texture, video=video, frames=frames)
            for segment, textures in entry.pop("frames").items()
            for texture, counts in textures.items()
            for video, frames in zip(letters, counts, strict=False)
            if frames is not None
        )
        splits = json.loads((_HERE / "splits" / f"{name}.json").read_text())
        found[name] = PublishedSet(name=name, recordings=recordings, splits=splits, **entry)
    return found


def find(name: str) -> Recording | RecordingPair | None:
    """What a name stands for; None where it is not a name of these datasets.

    Args:
        name: `DATASET/VIDEO` or `DATASET/SCENE[@SETTING]`.

    Raises:
        UnknownSequenceError: a scene or setting that a dataset does not have.
    """
    dataset_name, slash, rest = name.partition("/")
    dataset = published_sets().get(dataset_name)
    if dataset is None or not slash:
        return None
    scene, at, setting = rest.partition("@")
    recording = next((item for item in dataset.recordings if item.stem == rest), None)
    if recording is not None:
        return recording
    if not at and not any(item.scene == scene for item in dataset.recordings):
        return None
    return dataset.pair(scene, setting or "sparse")


def find_recording(stem: str) -> Recording | None:
    """The video that a folder of this name holds, in whichever dataset knows it."""
    for dataset in published_sets().values():
        for recording in dataset.recordings:
            if stem in dataset.stems(recording):
                return recording
    return None


def find_scene(stem: str) -> RecordingPair | None:
    """The pair that `SCENE@SETTING` stands for in whichever dataset has the scene.

    Raises:
        UnknownSequenceError: a known scene, but no such setting.
    """
    scene, at, setting = stem.partition("@")
    if not at:
        return None
    for dataset in published_sets().values():
        if any(item.scene == scene for item in dataset.recordings):
            return dataset.pair(scene, setting)
    return None
