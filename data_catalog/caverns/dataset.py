"""The judging family as a dataset: `caverns/N@sparse` and `caverns/N@distanced`."""

from __future__ import annotations

from data_catalog.caverns.config import GENERATOR_VERSION, CavernConfig
from data_catalog.dataset import Source
from data_catalog.rendered_dataset import RenderedDataset
from extrags.sequence import EndoscopicSequence

__all__ = ["CAVERNS"]


class CavernsDataset(RenderedDataset[CavernConfig]):
    """Procedural caverns that nothing is trained on, rendered on request."""

    def record(self, config: CavernConfig, source: Source) -> EndoscopicSequence:
        """Render both recordings of a scene."""
        from data_catalog.caverns.recording import record

        return record(config, source.name)

    def train_frames(self, config: CavernConfig) -> int:
        """Frames of the training recording."""
        return config.train_frames


CAVERNS = CavernsDataset(
    "caverns",
    GENERATOR_VERSION,
    CavernConfig,
    "Procedural cavern number {scene} with exact ground truth; its family trains nothing",
)
