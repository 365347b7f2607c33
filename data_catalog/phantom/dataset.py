"""The phantom as a dataset: `phantom/N@sparse` and `phantom/N@distanced`."""

from __future__ import annotations

from data_catalog.phantom.config import GENERATOR_VERSION, PhantomConfig
from data_catalog.rendered_dataset import RenderedDataset
from extrags.sequence import EndoscopicSequence

__all__ = ["PHANTOM"]


class PhantomDataset(RenderedDataset[PhantomConfig]):
    """Procedural colons, rendered on request."""

    def record(self, config: PhantomConfig, name: str) -> EndoscopicSequence:
        """Render both recordings of a scene."""
        from data_catalog.phantom.recording import record

        return record(config, name)

    def train_frames(self, config: PhantomConfig) -> int:
        """Frames of the training recording."""
        return len(range(0, config.video_frames, config.train_every))


PHANTOM = PhantomDataset(
    "phantom",
    GENERATOR_VERSION,
    PhantomConfig,
    "Procedural colon number {scene} with exact ground truth, rendered on request",
)
