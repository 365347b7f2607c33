"""The phantom as a dataset: `phantom/N@sparse` and `phantom/N@distanced`, for every N, without files."""

from __future__ import annotations

import re
from collections.abc import Iterator
from typing import Any, get_args

from data_catalog.dataset import Descriptor, Source
from data_catalog.phantom.config import GENERATOR_VERSION, PhantomConfig, Setting
from data_catalog.rendered_size import rendered_size
from extrags.config import IngestConfig
from extrags.errors import ConfigError, UnknownSequenceError
from extrags.sequence import EndoscopicSequence

__all__ = ["PhantomDataset", "phantom_config"]

_NAME = re.compile(r"phantom/(?P<scene>\d+)(?:@(?P<setting>\w+))?")
_LISTED_SCENES = 4


class PhantomDataset:
    """Procedural colons, rendered on request."""

    name = "phantom"
    spelling = ", ".join(f"phantom/N@{setting}" for setting in get_args(Setting))

    def entries(self) -> Iterator[Descriptor]:
        """The first few scenes in each setting."""
        for scene in range(_LISTED_SCENES):
            yield from (_described(scene, setting) for setting in get_args(Setting))

    def describe(self, name: str) -> Descriptor | None:
        """The descriptor of any scene; raises `UnknownSequenceError` for a setting that there is not."""
        found = _scene_and_setting(name)
        return None if found is None else _described(*found)

    def resolve(self, name_or_path: str) -> Source | None:
        """Any scene by name; without a setting the sparse one."""
        found = _scene_and_setting(name_or_path)
        if found is None:
            return None
        scene, setting = found
        return Source(name=f"phantom/{scene}@{setting}", dataset=self.name, format=self.name)

    def fingerprint(self, source: Source, config: IngestConfig) -> dict[str, Any]:
        """Settings and version of the generator."""
        return {
            "format": self.name,
            "version": GENERATOR_VERSION,
            "config": phantom_config(source, config).model_dump(mode="json"),
        }

    def read(self, source: Source, config: IngestConfig) -> EndoscopicSequence:
        """Render both recordings."""
        from data_catalog.phantom.recording import record

        return record(phantom_config(source, config), source.name)


def phantom_config(source: Source, config: IngestConfig) -> PhantomConfig:
    """The phantom's settings that follow from the ingest settings.

    Without a height, the width's own proportion (5 : 4) is kept.

    Raises:
        ConfigError: for a source that is no phantom, or a height without a width.
    """
    found = _scene_and_setting(source.name)
    if found is None:
        raise ConfigError(f"{source.name} is not a phantom")
    plain = PhantomConfig()
    width, height = rendered_size(config, plain.width, plain.height)
    scene, setting = found
    return PhantomConfig(
        scene=scene, setting=setting, width=width, height=height, max_frames=config.max_frames
    )


def _scene_and_setting(name: str) -> tuple[int, Setting] | None:
    match = _NAME.fullmatch(name)
    if match is None:
        return None
    setting = match["setting"] or "sparse"
    for known in get_args(Setting):
        if setting == known:
            return int(match["scene"]), known
    raise UnknownSequenceError(
        f"the phantom has no setting {setting!r}; known: {', '.join(get_args(Setting))}"
    )


def _described(scene: int, setting: Setting) -> Descriptor:
    plain = PhantomConfig()
    train = len(range(0, plain.video_frames, plain.train_every))
    return Descriptor(
        name=f"phantom/{scene}@{setting}",
        description=f"Procedural colon number {scene} with exact ground truth, rendered on request",
        frames=train + plain.test_frames,
        width=plain.width,
        height=plain.height,
        length_unit="mm",
        axes="OpenCV camera axes, camera-to-world",
        has_depth=True,
        has_poses=True,
        split=f"{train} frames of recording B train, all {plain.test_frames} of recording A evaluate",
        licence="Apache-2.0 (generated)",
        format="phantom",
    )
