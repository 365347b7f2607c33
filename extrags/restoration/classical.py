"""The restorer without learning: blend of light-compensated real views, holes by push-pull."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch

from extrags.config import CoarseConfig, EnhanceConfig
from extrags.restoration.description import (
    DESCRIPTION,
    description_fields,
    read_description,
    text_field,
    write_description,
)
from extrags.restoration.protocol import Clip, Restoration
from extrags.scene import Scene
from extrags.sequence import EndoscopicSequence
from extrags.view_synthesis.conditioning import condition

__all__ = ["CLASSICAL", "ClassicalEnhancer"]


@dataclass(frozen=True)
class ClassicalEnhancer:
    """Multi-view blend where real views see the surface, the rendering elsewhere, holes filled.

    It is the base image of the embedded diffusion: the baseline it is compared with, and its replacement on
    scenes where it does worse.

    Args:
        reason: why it replaces another restorer; empty where it was asked for.
        judged: what both reached on left-out frames, `{restored_db, filled_db, error_over_expected}`; None
            where they were not compared.
        domain_score: how far the scene is from what the restorer that it replaces was trained on
            (`extrags.restoration.uncertainty.domain`); None where that is not known.
    """

    reason: str = ""
    judged: Mapping[str, float | None] | None = None
    domain_score: float | None = None

    name = "classical"
    follows_keyframes = True
    keeps_known = True

    def restore(self, clip: Clip) -> Restoration:
        """Restore all views of a clip."""
        with torch.no_grad():
            base = condition(clip.layers, clip.transfer).base
        rgb = base.permute(0, 2, 3, 1).contiguous().numpy()
        return Restoration(rgb, None, self._description)

    def save(self, path: Path) -> None:
        """Write `restorer.json`; there are no weights."""
        write_description(path, self._description)

    @property
    def _description(self) -> dict[str, Any]:
        said = {
            "reason": self.reason or None,
            "judged": None if self.judged is None else dict(self.judged),
            "domain_score": self.domain_score,
        }
        return {"backend": self.name, **{name: value for name, value in said.items() if value is not None}}


class ClassicalBackend:
    """`enhance.backend=classical`: nothing to check, nothing to prepare."""

    name = ClassicalEnhancer.name

    def check(self, config: EnhanceConfig) -> None:
        """Nothing is needed."""

    def digest(self, config: EnhanceConfig) -> None:
        """There is no pretrained model."""

    def needs_text(self, config: EnhanceConfig) -> bool:
        """No text is read."""
        return False

    def prepare(
        self, scene: Scene, sequence: EndoscopicSequence, config: EnhanceConfig, coarse: CoarseConfig
    ) -> ClassicalEnhancer:
        """The same for every scene."""
        return ClassicalEnhancer()

    def load(self, path: Path) -> ClassicalEnhancer:
        """Read what `ClassicalEnhancer.save` wrote.

        Raises:
            WeightsError: when `restorer.json` is missing or damaged.
        """
        file = path / DESCRIPTION
        description = read_description(file)
        with description_fields(file):
            reason = text_field(description, "reason") if "reason" in description else ""
            judged = description.get("judged")
            score = description.get("domain_score")
            return ClassicalEnhancer(
                reason, None if judged is None else dict(judged), None if score is None else float(score)
            )


CLASSICAL = ClassicalBackend()
