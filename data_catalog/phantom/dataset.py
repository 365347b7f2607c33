"""The phantom as a dataset: `phantom/N@sparse`, `@distanced`, `@covered` and `@pocket`."""

from __future__ import annotations

from data_catalog.dataset import Source
from data_catalog.phantom.config import GENERATOR_VERSION, PhantomConfig
from data_catalog.phantom.thorough import PASSES
from data_catalog.rendered_dataset import RenderedDataset
from extrags.sequence import EndoscopicSequence

__all__ = ["PHANTOM"]


class PhantomDataset(RenderedDataset[PhantomConfig]):
    """Procedural colons, rendered on request."""

    def record(self, config: PhantomConfig, source: Source) -> EndoscopicSequence:
        """Render the recordings of a scene."""
        from data_catalog.phantom.recording import record

        return record(config, source.name)

    def train_frames(self, config: PhantomConfig) -> int:
        """Frames that train; in the setting `pocket`, those it leaves out included."""
        own = len(range(0, config.video_frames, config.train_every))
        return own if config.setting in ("sparse", "distanced") else own * len(PASSES)

    def split_text(self, config: PhantomConfig, train: int) -> str:
        """What trains and what evaluates, in words."""
        if config.setting == "covered":
            return f"{train} frames of six passes train, {config.test_frames} half-way between them evaluate"
        if config.setting == "pocket":
            return (
                f"of {train} frames of six passes those train that hardly show one patch of the wall, "
                f"{config.test_frames} half-way between all of them evaluate"
            )
        return super().split_text(config, train)


PHANTOM = PhantomDataset(
    "phantom",
    GENERATOR_VERSION,
    PhantomConfig,
    "Procedural colon number {scene} with exact ground truth, rendered on request",
)
