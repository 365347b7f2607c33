"""ingest: reads a source into an `EndoscopicSequence`, and extracts its training frames."""

from __future__ import annotations

import logging
from typing import Any

from data_catalog import Source
from extrags.config import IngestConfig
from extrags.errors import SourceError
from extrags.store import Ref, Slot, digest_of
from tasks.stage import stage

__all__ = ["ingest", "training_frames"]

log = logging.getLogger(__name__)


# The fingerprint covers the content of the files; their location is not part of the key.
@stage("ingest", version=12, ignore=("source", "calibration"))
def ingest(
    slot: Slot,
    source: Source,
    fingerprint: dict[str, Any],
    config: IngestConfig,
    calibration: str | None = None,
) -> None:
    """Read a source into `sequence/`.

    Args:
        slot: the artefact to write.
        source: where it lies.
        fingerprint: of its content, and of the calibration file's.
        config: settings without `calibration`, whose path is not part of the key.
        calibration: path of the calibration file; None without.

    Raises:
        SourceError: what reading raises, or files that are others than when the fingerprint was taken: the
            artefact would stand under the key of other content.
    """
    from data_catalog import read
    from data_catalog.catalog import footage_glance, measured_detail, source_fingerprint
    from data_catalog.detail import detail_size
    from extrags.sequence import saturated_mask

    config = config.model_copy(update={"calibration": calibration})
    asked = measured_detail(source, config)
    sequence = read(source, config, detail=asked)
    # By content, as for the key. Where this process made the key, only files are read again that changed
    # since, or not long before; another process, as a cluster's worker, reads all of them: 1.3 s per GB.
    if digest_of(source_fingerprint(source, config)) != digest_of(fingerprint):
        problem = "the files changed while they were read; run again"
        raise SourceError(problem, file=source.path or source.name)
    slot.save(sequence)
    footage = footage_glance(source, config)
    if footage is not None:
        # How long it took cannot be told from the frames that were chosen alone.
        slot.counts.update(
            looked_at=footage.looked_at,
            passed_over=footage.passed_over,
            source_pixels=footage.source_pixels,
        )
    detail = asked or detail_size(sequence, config.detail_psnr_db)
    log.info("%s: frames hold %s", sequence.name, detail)
    inside = max(1, int(sequence.mask.sum()))
    # Frame by frame: what is made of all of them at once would be as large as they are.
    frames = zip(sequence.rgb, sequence.mask, strict=True)
    saturated = float(sum(int((saturated_mask(image) & mask).sum()) for image, mask in frames))
    slot.counts.update(
        frames=len(sequence),
        train=len(sequence.train),
        test=len(sequence.test),
        width=sequence.width,
        height=sequence.height,
        has_poses=int(sequence.world_from_camera is not None),
        intrinsics=sequence.intrinsics,
        scale=sequence.scale_words if sequence.world_from_camera is not None else "",
        has_depth=int(sequence.training_depth_known),
        depth_error=sequence.median_depth_error,
        detail_width=detail.reduced_width,
        detail_height=detail.reduced_height,
        detail=str(detail),
        stereo_camera=sequence.stereo_camera or "",
        masked_share=float(1 - sequence.mask.mean()),
        specular_share=0.0 if sequence.specular is None else float(sequence.specular.sum() / inside),
        saturated_share=saturated / inside,
    )


@stage("training-frames", version=1)
def training_frames(slot: Slot, sequence: Ref) -> None:
    """Extract the training frames (`EndoscopicSequence.training_part`); writes `sequence/`."""
    from extrags.sequence import EndoscopicSequence

    part = slot.load(EndoscopicSequence, sequence).training_part()
    slot.save(part)
    slot.counts.update(frames=len(part))
