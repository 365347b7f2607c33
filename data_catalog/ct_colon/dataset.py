"""Stretches of the colon as a dataset: `ct_colon/N@sparse` and `ct_colon/N@distanced`."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from data_catalog.cavities.real_textures import FOLDER as FRAMES_FOLDER
from data_catalog.cavities.real_textures import judging_files
from data_catalog.ct_colon.config import GENERATOR_VERSION, CtColonConfig
from data_catalog.ct_colon.model import FOLDER, PATH_FILE, SURFACE_FILE
from data_catalog.dataset import Descriptor, Source, file_digests
from data_catalog.named_folders import find_folder, not_on_this_machine
from data_catalog.rendered_dataset import RenderedDataset
from extrags.config import IngestConfig
from extrags.errors import SourceNotFoundError
from extrags.sequence import EndoscopicSequence

__all__ = ["CT_COLON"]


class CtColonDataset(RenderedDataset[CtColonConfig]):
    """A real colon's wall, lined with real tissue, rendered on request."""

    def resolve(self, name_or_path: str) -> Source | None:
        """Any stretch by name.

        Raises:
            SourceNotFoundError: the model or the frames are not on this machine.
        """
        source = super().resolve(name_or_path)
        if source is None:
            return None
        paths = []
        for folder in (FOLDER, FRAMES_FOLDER):
            found = find_folder((folder,))
            if found is None:
                raise not_on_this_machine(source.name, folder, "another sequence")
            paths.append(str(found.resolve()))
        return source.model_copy(update={"paths": tuple(paths)})

    def fingerprint(self, source: Source, config: IngestConfig) -> dict[str, Any]:
        """Settings, version of the generator and content of the files.

        Raises:
            SourceNotFoundError: a file of the model is missing.
            SourceError: there are no frames.
        """
        model, frames = map(Path, source.paths)
        names = (SURFACE_FILE.format(triangles="100k"), PATH_FILE)
        listed = [
            *((name, model / name) for name in names),
            *((file.name, file) for file in judging_files(frames)),
        ]
        missing = next((file for _, file in listed if not file.is_file()), None)
        if missing is not None:
            raise SourceNotFoundError("no such file, which the colon's model has", file=missing)
        return {**super().fingerprint(source, config), "files": file_digests(listed)}

    def record(self, config: CtColonConfig, source: Source) -> EndoscopicSequence:
        """Render both recordings.

        Raises:
            SourceError: a file is missing or wrong.
        """
        from data_catalog.caverns.recording import recorded
        from data_catalog.ct_colon.stretch import build_stretch, make_lining

        model, frames = map(Path, source.paths)
        passage = build_stretch(config.scene, model)
        truth = {"generator_version": GENERATOR_VERSION, "ct_colon": config.model_dump()}
        return recorded(config, source.name, passage, make_lining(config.seed, passage.wall, frames), truth)

    def train_frames(self, config: CtColonConfig) -> int:
        """Frames of the training recording."""
        return config.train_frames

    def described(self, scene: int, setting: str) -> Descriptor:
        """What there is to know about a stretch, and whether its files are here."""
        here = all(find_folder((folder,)) is not None for folder in (FOLDER, FRAMES_FOLDER))
        about = super().described(scene, setting)
        return about.model_copy(update={"licence": _LICENCE, "available": here})


_LICENCE = "CC BY 4.0 (surface), MIT (tissue)"
CT_COLON = CtColonDataset(
    "ct_colon",
    GENERATOR_VERSION,
    CtColonConfig,
    "Stretch number {scene} of a real colon from CT, lined with real tissue, with exact ground truth",
)
