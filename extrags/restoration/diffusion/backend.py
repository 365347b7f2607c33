"""`enhance.backend=embedded`: the conditional diffusion, or the classical fill where that is better."""

from __future__ import annotations

from pathlib import Path

from extrags.config import CoarseConfig, EnhanceConfig
from extrags.depth.weights import hidden_digest, load_hidden
from extrags.restoration.diffusion.weights import weights_digest
from extrags.restoration.protocol import Enhancer
from extrags.scene import Scene
from extrags.sequence import EndoscopicSequence

__all__ = ["EMBEDDED"]


class EmbeddedBackend:
    """The diffusion with pretrained weights, with weights trained on the scene alone, or with both.

    What computes is imported on first use: the digest is asked for whenever an artefact is looked up.
    """

    name = "embedded"

    def check(self, config: EnhanceConfig) -> None:
        """Load the weights, a few megabytes: this shows whether they fit this version.

        Raises:
            WeightsError: when the weights are missing or do not fit.
            ConfigError: when there would be neither weights nor training.
        """
        from extrags.restoration.diffusion.embedded import pretrained

        pretrained(config)
        if config.depth_from_image:
            load_hidden()

    def digest(self, config: EnhanceConfig) -> str | None:
        """Digest of the weights, also of those that depth is read with; None where there are neither.

        Raises:
            WeightsError: when the weights are missing.
        """
        weights = weights_digest(config.pretrained_weights)
        if not config.depth_from_image:
            return weights
        return f"{weights} {hidden_digest()}"

    def needs_text(self, config: EnhanceConfig) -> bool:
        """No text is read."""
        return False

    def prepare(
        self, scene: Scene, sequence: EndoscopicSequence, config: EnhanceConfig, coarse: CoarseConfig
    ) -> Enhancer:
        """Train on the scene's pairs where the settings say so, and compare with the classical fill.

        Raises:
            CaptureError: with too few training frames to train on.
            DivergedError: when a reconstruction or the training does not stay finite.
            WeightsError: when the weights are missing or do not fit.
            ConfigError: when there would be neither weights nor training.
        """
        from extrags.restoration.diffusion.scene_restorer import scene_restorer

        # What it restores later has the working size: pairs of another would tell little about that.
        small = sequence.at_most_width(config.working_width(sequence.width))
        return scene_restorer(scene, small, config, coarse)

    def load(self, path: Path) -> Enhancer:
        """Read what `EmbeddedEnhancer.save` wrote.

        Raises:
            WeightsError: when a file is missing, damaged, or does not fit this version.
        """
        from extrags.restoration.diffusion.embedded import EmbeddedEnhancer

        return EmbeddedEnhancer.load(path)


EMBEDDED = EmbeddedBackend()
