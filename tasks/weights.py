"""Weights as part of cache keys: the digest of their content, or that they are absent."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from pydantic import BaseModel, ConfigDict

from extrags.config import DepthConfig, EnhanceConfig, EvaluateConfig, LpipsNet
from extrags.errors import WeightsError
from extrags.file_digests import size_and_digest

if TYPE_CHECKING:
    from extrags.confidence import PerceptualDifference
    from extrags.metrics.lpips import Lpips

__all__ = [
    "Weights",
    "depth_completion_digest",
    "depth_monocular_digest",
    "lpips_by_net",
    "lpips_weights",
    "refiner_digest",
    "restorer_digest",
]


class Weights(BaseModel):
    """Weights that were found, or the reason why there are none."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    net: LpipsNet
    paths: tuple[str, ...] = ()
    digest: str | None = None
    reason: str = ""

    def perceptual_difference(self) -> PerceptualDifference:
        """LPIPS with these weights, else `perceptual_map` with the reason."""
        from extrags.confidence import PerceptualDifference

        return PerceptualDifference(self.lpips(), self.reason)

    def lpips(self) -> Lpips | None:
        """LPIPS with these weights; None without.

        Raises:
            WeightsError: when the files are others than those that the key of an artefact stands for.
        """
        from extrags.metrics.lpips import Lpips

        if not self.paths:
            return None
        files = tuple(map(Path, self.paths))
        if not all(file.is_file() for file in files) or size_and_digest(*files)[1] != self.digest:
            raise WeightsError(
                f"the weights of LPIPS with {self.net} in {', '.join(self.paths)} are not those this run "
                "began with: they changed meanwhile, or this worker sees other files; run again"
            )
        return Lpips.read(files, self.net)


def lpips_weights(config: EvaluateConfig) -> list[Weights]:
    """Search the weights of each LPIPS backbone that is asked for (`extrags.metrics.lpips_weights`).

    Raises:
        WeightsError: when the settings name a file that is not there.
    """
    from extrags.metrics import lpips_weights as search

    found = []
    for net in config.lpips_nets:
        try:
            files = search.find_weights(config.lpips_weights, net)
        except WeightsError as error:
            if config.lpips_weights is not None:
                raise
            found.append(Weights(net=net, reason=str(error)))
            continue
        found.append(Weights(net=net, paths=tuple(map(str, files)), digest=size_and_digest(*files)[1]))
    return found


def lpips_by_net(weights: Sequence[Weights]) -> dict[LpipsNet, Lpips | str]:
    """LPIPS by backbone: the metric with its weights, or the reason why there are none."""
    return {item.net: item.lpips() or item.reason for item in weights}


def restorer_digest(config: EnhanceConfig) -> str | None:
    """Digest of the pretrained model that a scene's restorer starts from; None where there is none.

    Raises:
        ExtragsError: when it is not there; says how to get it.
    """
    from extrags.restoration import backends

    return backends.restorer_digest(config)


def refiner_digest() -> str:
    """Digest of the refiner of restored held-out views."""
    from extrags.restoration.refinement.weights import refiner_digest as digest

    return digest()


def depth_completion_digest(config: DepthConfig) -> str | None:
    """Digest of the network that completes estimated depth; None where the settings do without.

    Raises:
        WeightsError: when the settings name a file that is not there.
    """
    from extrags.depth.weights import completion_digest

    return completion_digest(config.completion)


def depth_monocular_digest(folder: str | None) -> str | None:
    """Digest of the monocular depth network in a folder; None for None.

    Raises:
        WeightsError: when the folder holds none.
        MissingDependencyError: without the package that reads it.
    """
    from extrags.depth.monocular_network import monocular_digest

    return monocular_digest(folder)
