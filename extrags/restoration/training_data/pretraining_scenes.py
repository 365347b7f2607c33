"""Pretraining data: renderings of views far off the trajectory, paired with the truth.

A pretraining scene is reconstructed like any other, with a random number of iterations; then views far from
all training frames are rendered, whose true images are known. The pairs of a scene and its light are one
safetensors file.
"""

from __future__ import annotations

import json
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from extrags.config import CoarseConfig, EnhanceConfig
from extrags.errors import ShapeError, WeightsError
from extrags.illumination import NearFieldLight
from extrags.restoration.training_data.pairs import Pairs, pair_views
from extrags.sequence import EndoscopicSequence
from extrags.training.reconstruction import reconstruct
from extrags.view_synthesis.conditioning import Layers, observe_views
from extrags.view_synthesis.gather import gather_references
from extrags.view_synthesis.references import LightTransfer

__all__ = ["PretrainingScene", "make_pretraining_scene"]

PRETRAINING_DATA_VERSION = 2
"""Raised by hand whenever the same scene and settings give other pairs."""
ITERATIONS = (400, 2000)
"""Range of the random number of iterations, so that renderings of different quality occur."""
MAX_FRAMES = 24
GAUSSIANS = (0.35, 1.0)
"""Range of the random share of the starting points and of the limit on Gaussians."""


@dataclass(frozen=True)
class PretrainingScene:
    """Pairs of one scene.

    Args:
        pairs: renderings with the truth; none is for validation.
        transfer: how brightness changes with distance in this scene.
        frames: some of the frames it was reconstructed from, in [0, 1], [F, 3, H, W]; None in older files.
    """

    pairs: Pairs
    transfer: LightTransfer
    frames: Float[Tensor, "f 3 h w"] | None = None

    def save(self, path: Path, *, origin: str = "") -> None:
        """Write one safetensors file: colours and layers in half precision.

        Args:
            path: the file.
            origin: what the scene was made from, read by `made_from`.
        """
        from safetensors.torch import save_file

        light = self.transfer.light
        tensors = {
            "layers": self.pairs.layers.data.half(),
            "target": (self.pairs.target * 255).round().to(torch.uint8),
            "weight": self.pairs.weight.to(torch.uint8),
            "depth_mm": self.pairs.depth_mm.half(),
            "frame": torch.from_numpy(np.asarray(self.pairs.frame, dtype=np.int64)),
        }
        if self.frames is not None:
            tensors["frames"] = (self.frames * 255).round().to(torch.uint8)
        if light is not None:
            tensors.update(
                {f"light.{name}": value.detach().clone() for name, value in light.parameters().items()}
            )
        scales = {
            "exponent": self.transfer.exponent,
            "scale_mm": self.transfer.scale_mm,
            "reference_distance": None if light is None else light.reference_distance,
        }
        path.parent.mkdir(parents=True, exist_ok=True)
        partial = path.with_suffix(".partial")
        save_file(
            {k: v.contiguous() for k, v in tensors.items()},
            str(partial),
            {"scales": json.dumps(scales), "origin": origin},
        )
        partial.replace(path)

    @staticmethod
    def made_from(path: Path) -> str | None:
        """The `origin` a file was saved with; None where there is no such file."""
        from safetensors import SafetensorError, safe_open

        try:
            with safe_open(str(path), "pt") as file:
                return str((file.metadata() or {}).get("origin", ""))
        except (OSError, SafetensorError):
            return None

    @classmethod
    def load(cls, path: Path) -> PretrainingScene:
        """Read what `save` wrote.

        Raises:
            WeightsError: when the file holds no pretraining scene.
        """
        from safetensors import SafetensorError, safe_open

        try:
            with safe_open(str(path), "pt") as file:
                metadata = file.metadata() or {}
                tensors = {name: file.get_tensor(name) for name in file.keys()}  # noqa: SIM118
            scales = json.loads(metadata["scales"])
            light = None
            if scales["reference_distance"] is not None:
                values = {k.removeprefix("light."): v for k, v in tensors.items() if k.startswith("light.")}
                light = NearFieldLight(**values, reference_distance=scales["reference_distance"])
            transfer = LightTransfer(light, scales["exponent"], scales["scale_mm"])
            count = len(tensors["frame"])
            frames = tensors["frames"].half() / 255 if "frames" in tensors else None
            pairs = Pairs(
                Layers(tensors["layers"].float()),
                tensors["target"].float() / 255,
                tensors["weight"].float(),
                tensors["depth_mm"].float(),
                tensors["frame"].numpy(),
                np.zeros(count, dtype=bool),
                np.zeros(count, dtype=bool),
            )
        except (OSError, SafetensorError, KeyError, ValueError, TypeError, ShapeError) as error:
            raise WeightsError(f"{path}: not the pairs of a pretraining scene ({error})") from error
        return cls(pairs, transfer, frames)


def make_pretraining_scene(
    sequence: EndoscopicSequence, config: EnhanceConfig, coarse: CoarseConfig, seed: int
) -> PretrainingScene:
    """Reconstruct a pretraining scene from its training frames and pair its test views with the truth.

    Args:
        sequence: a scene made for pretraining; its test frames are at the mean exposure.
        config: how many references.
        coarse: settings of the reconstruction; steps and number of Gaussians are drawn below them.
        seed: of the draws and of the reconstruction.

    Raises:
        DivergedError: when the reconstruction does not stay finite.
    """
    generator = np.random.default_rng([seed, 5])
    share = float(generator.uniform(*GAUSSIANS))
    iterations = int(np.exp(generator.uniform(*np.log(ITERATIONS))))
    settings = coarse.model_copy(
        update={
            "iterations": iterations,
            "sh_every": max(1, iterations // 4),
            "max_points": round(share * coarse.max_points),
            "densify": coarse.densify.model_copy(
                update={"max_gaussians": round(share * coarse.densify.max_gaussians)}
            ),
            "seed": seed,
        }
    )
    scene = reconstruct(sequence.training_part(), settings, stage="pretraining-scene").scene
    references = gather_references(scene, sequence, sequence.train)
    frames = np.asarray(sequence.test, dtype=np.int64)
    observation = observe_views(scene, references, sequence.cameras[frames], count=config.references)
    pairs = pair_views(sequence, observation.layers, frames, synthetic=False)
    pairs.validation[:] = False
    shown = sequence.train[np.linspace(0, len(sequence.train) - 1, MAX_FRAMES).round().astype(int)]
    rgb = sequence.rgb[np.unique(shown)].astype(np.float32) / 255
    return PretrainingScene(pairs, references.transfer, torch.from_numpy(rgb).permute(0, 3, 1, 2))
