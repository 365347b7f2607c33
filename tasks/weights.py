"""Weights as part of cache keys: the digest of their content, or that they are absent."""

from __future__ import annotations

import hashlib
from typing import TYPE_CHECKING

from pydantic import BaseModel, ConfigDict

from extrags.config import EnhanceConfig, EvaluateConfig, LpipsNet
from extrags.errors import WeightsError

if TYPE_CHECKING:
    from extrags.confidence import PerceptualDifference

__all__ = ["Weights", "lpips_weights", "restorer_digest"]


class Weights(BaseModel):
    """Weights that were found, or the reason why there are none."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    net: LpipsNet
    path: str | None = None
    digest: str | None = None
    reason: str = ""

    def perceptual_difference(self) -> PerceptualDifference:
        """LPIPS with these weights, else `perceptual_map` with the reason."""
        from extrags.confidence import PerceptualDifference
        from extrags.metrics.lpips import Lpips

        lpips = None if self.path is None else Lpips.load(self.path, net=self.net)
        return PerceptualDifference(lpips, self.reason)


def lpips_weights(config: EvaluateConfig) -> Weights:
    """Search LPIPS weights (`extrags.metrics.lpips.find_weights`).

    Raises:
        WeightsError: when the settings name a file that is not there.
    """
    from extrags.metrics.lpips import find_weights

    try:
        path = find_weights(config.lpips_weights, config.lpips_net)
    except WeightsError as error:
        if config.lpips_weights is not None:
            raise
        return Weights(net=config.lpips_net, reason=str(error))
    digest = hashlib.blake2b(path.read_bytes(), digest_size=16).hexdigest()
    return Weights(net=config.lpips_net, path=str(path), digest=digest)


def restorer_digest(config: EnhanceConfig) -> str | None:
    """Digest of the pretrained model that a scene's restorer starts from; None where there is none.

    Raises:
        ExtragsError: when it is not there; says how to get it.
    """
    from extrags.restoration import backends

    return backends.restorer_digest(config)
