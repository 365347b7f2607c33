"""Procedural scenes as a dataset: `FAMILY/N@SETTING`, for every N, without files.

Every family has the settings `sparse` and `distanced`, and whatever else the field `setting` of its scenes'
settings allows.
"""

from __future__ import annotations

import re
from abc import ABC, abstractmethod
from collections.abc import Iterator
from typing import Any, Generic, Literal, TypeVar, get_args

from pydantic import BaseModel

from data_catalog.dataset import Descriptor, Source
from data_catalog.rendered_size import rendered_size
from extrags.config import IngestConfig
from extrags.errors import ConfigError, UnknownSequenceError
from extrags.sequence import EndoscopicSequence

__all__ = ["RenderedDataset", "Setting"]

Setting = Literal["sparse", "distanced"]
"""The settings of every family, which are the ones that are listed."""
_LISTED_SCENES = 4

C = TypeVar("C", bound=BaseModel)


class RenderedDataset(ABC, Generic[C]):
    """A family of scenes that are rendered on request.

    The settings of a scene have the fields `scene`, `setting`, `width`, `height`, `max_frames` and
    `test_frames`.

    Args:
        name: of the family.
        generator_version: raised whenever the same settings give another scene.
        config_type: settings of a scene.
        description: of scene N, with `{scene}` for its number.
    """

    def __init__(self, name: str, generator_version: int, config_type: type[C], description: str) -> None:
        self.name = name
        self._settings: tuple[str, ...] = get_args(config_type.model_fields["setting"].annotation)
        self.spelling = ", ".join(f"{name}/N@{setting}" for setting in self._settings)
        self._generator_version = generator_version
        self._config_type = config_type
        self._description = description
        self._pattern = re.compile(rf"{name}/(?P<scene>\d+)(?:@(?P<setting>\w+))?")

    @abstractmethod
    def record(self, config: C, source: Source) -> EndoscopicSequence:
        """Render both recordings of a scene."""

    @abstractmethod
    def train_frames(self, config: C) -> int:
        """Frames that train."""

    def split_text(self, config: C, train: int) -> str:
        """What trains and what evaluates, in words."""
        evaluate = getattr(config, "test_frames", 0)
        return f"{train} frames of recording B train, all {evaluate} of recording A evaluate"

    def entries(self) -> Iterator[Descriptor]:
        """The first few scenes in each setting that all families have."""
        for scene in range(_LISTED_SCENES):
            yield from (self.described(scene, setting) for setting in get_args(Setting))

    def describe(self, name: str) -> Descriptor | None:
        """The descriptor of any scene; raises `UnknownSequenceError` for a setting that there is not."""
        found = self._scene_and_setting(name)
        return None if found is None else self.described(*found)

    def resolve(self, name_or_path: str) -> Source | None:
        """Any scene by name; without a setting the sparse one."""
        found = self._scene_and_setting(name_or_path)
        if found is None:
            return None
        scene, setting = found
        return Source(name=f"{self.name}/{scene}@{setting}", dataset=self.name, format=self.name)

    def fingerprint(self, source: Source, config: IngestConfig) -> dict[str, Any]:
        """Settings and version of the generator."""
        return {
            "format": self.name,
            "version": self._generator_version,
            "config": self.scene_config(source, config).model_dump(mode="json"),
        }

    def read(self, source: Source, config: IngestConfig) -> EndoscopicSequence:
        """Render both recordings."""
        return self.record(self.scene_config(source, config), source)

    def scene_config(self, source: Source, config: IngestConfig) -> C:
        """The scene's settings that follow from the ingest settings.

        Without a height, the width's own proportion (5 : 4) is kept.

        Raises:
            ConfigError: for a source of another family, or a height without a width.
        """
        found = self._scene_and_setting(source.name)
        if found is None:
            raise ConfigError(f"{source.name} is not a scene of {self.name}")
        plain: Any = self._config_type()
        width, height = rendered_size(config, plain.width, plain.height)
        scene, setting = found
        return self._config_type(
            scene=scene, setting=setting, width=width, height=height, max_frames=config.max_frames
        )

    def _scene_and_setting(self, name: str) -> tuple[int, str] | None:
        match = self._pattern.fullmatch(name)
        if match is None:
            return None
        setting = match["setting"] or "sparse"
        if setting not in self._settings:
            raise UnknownSequenceError(
                f"{self.name} has no setting {setting!r}; known: {', '.join(self._settings)}"
            )
        return int(match["scene"]), setting

    def described(self, scene: int, setting: str) -> Descriptor:
        """What there is to know about a scene."""
        plain: Any = self._config_type(scene=scene, setting=setting)
        train = self.train_frames(plain)
        return Descriptor(
            name=f"{self.name}/{scene}@{setting}",
            description=self._description.format(scene=scene),
            frames=train + plain.test_frames,
            width=plain.width,
            height=plain.height,
            length_unit="mm",
            axes="OpenCV camera axes, camera-to-world",
            has_depth=True,
            has_poses=True,
            split=self.split_text(plain, train),
            licence="Apache-2.0 (generated)",
            format=self.name,
        )
