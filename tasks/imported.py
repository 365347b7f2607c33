"""An imported scene in place of the coarse one."""

from __future__ import annotations

from pathlib import Path

from extrags.config import ImportedConfig
from extrags.errors import ConfigError, SourceError, SourceNotFoundError
from extrags.file_digests import size_and_digest
from extrags.store import Ref, Slot
from extrags.user_paths import expanded
from tasks.coarse import HISTORY
from tasks.stage import stage

__all__ = ["imported_scene", "scene_digest"]


def scene_digest(config: ImportedConfig) -> str:
    """Digest of the content of the file that the settings name.

    Raises:
        SourceNotFoundError: when there is no such file.
        ConfigError: when the settings name none.
    """
    if config.scene is None:
        raise ConfigError("imported.scene names no file")
    file = expanded(config.scene)
    if not file.is_file():
        raise SourceNotFoundError("no such file", file=file, field="imported.scene")
    return size_and_digest(file)[1]


@stage("import-scene", version=1, ignore=("file",))
def imported_scene(slot: Slot, sequence: Ref, digest: str, scale: float, file: str) -> None:
    """Read and check a scene that another program has made; writes `scene/` and an empty `history.json`.

    Args:
        slot: to write into.
        sequence: the training frames.
        digest: of the file's content, in place of its path.
        scale: of its unit.
        file: where it is.
    """
    from extrags.sequence import EndoscopicSequence
    from extrags.splat_files.importing import import_scene

    config = ImportedConfig(scene=file, scale=scale)
    if scene_digest(config) != digest:
        raise SourceError("it changed while it was used", file=file, field="imported.scene")
    found = import_scene(expanded(file), slot.load(EndoscopicSequence, sequence), config)
    slot.save(found.scene)
    slot.save_json(HISTORY, [])
    slot.counts.update(
        n_gaussians=len(found.scene.gaussians),
        sh_degree=found.scene.gaussians.sh_degree,
        has_light=int(found.scene.light is not None),
        imported=Path(file).name,
        seen_share=found.seen_share,
        training_psnr=found.psnr,
        random_start=0,
        refined_poses=0,
        corrected_colors=0,
        summary=f"imported from {Path(file).name}, {found.psnr:.1f} dB on the training frames; "
        + "; ".join(found.statements),
    )
