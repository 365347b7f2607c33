"""ingest: any source to a `Sequence`."""

from __future__ import annotations

from typing import Any

from data_catalog.catalog import Source
from extrags.config import IngestConfig
from extrags.store import Slot
from tasks.stage import stage

__all__ = ["ingest"]


# The fingerprint holds the content of the files; where they lie does not matter.
@stage("ingest", version=1, ignore=("source",))
def ingest(slot: Slot, source: Source, fingerprint: dict[str, Any], config: IngestConfig) -> None:
    """Read a source into `sequence/`."""
    from data_catalog.catalog import read

    sequence = read(source, config)
    sequence.save(slot.path / "sequence")
    slot.counts.update(
        frames=len(sequence),
        train=len(sequence.train),
        test=len(sequence.test),
        width=sequence.width,
        height=sequence.height,
        has_poses=int(sequence.world_from_camera is not None),
        has_depth=int(sequence.depth_mm is not None),
    )
