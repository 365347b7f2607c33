"""ingest: any source to an `EndoscopicSequence`, and the part of it the reconstruction may see."""

from __future__ import annotations

from typing import Any

from data_catalog import Source
from extrags.config import IngestConfig
from extrags.store import Ref, Slot
from tasks.stage import stage

__all__ = ["ingest", "training_frames"]


# The fingerprint holds the content of the files; where they lie does not matter.
@stage("ingest", version=2, ignore=("source",))
def ingest(slot: Slot, source: Source, fingerprint: dict[str, Any], config: IngestConfig) -> None:
    """Read a source into `sequence/`."""
    from data_catalog import read
    from extrags.sequence import saturated_mask

    sequence = read(source, config)
    slot.save(sequence)
    inside = max(1, int(sequence.mask.sum()))
    slot.counts.update(
        frames=len(sequence),
        train=len(sequence.train),
        test=len(sequence.test),
        width=sequence.width,
        height=sequence.height,
        has_poses=int(sequence.world_from_camera is not None),
        has_depth=int(sequence.depth_mm is not None),
        masked_share=float(1 - sequence.mask.mean()),
        specular_share=0.0 if sequence.specular is None else float(sequence.specular.sum() / inside),
        saturated_share=float((saturated_mask(sequence.rgb) & sequence.mask).sum() / inside),
    )


@stage("training-frames", version=1)
def training_frames(slot: Slot, sequence: Ref) -> None:
    """Take the held-out frames away; writes `sequence/`."""
    from extrags.sequence import EndoscopicSequence

    part = slot.load(EndoscopicSequence, sequence).training_part()
    slot.save(part)
    slot.counts.update(frames=len(part))
