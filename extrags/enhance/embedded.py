"""The default restorer: a conditional diffusion that the pipeline trains on its own pairs."""

from __future__ import annotations

import json
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from extrags.config import EnhanceConfig
from extrags.enhance.augmentation import CropSampler
from extrags.enhance.conditioning import CONDITION_CHANNELS, Layers, condition
from extrags.enhance.diffusion import TrainingSettings, sample, train_network
from extrags.enhance.gamut import Gamut
from extrags.enhance.network import RestorationNetwork, build_network
from extrags.enhance.pairs import Pairs
from extrags.enhance.protocol import Clip, Restoration
from extrags.enhance.references import LightTransfer
from extrags.errors import WeightsError
from extrags.events import MetricRecorded, emit
from extrags.metrics.image import psnr_per_image, ssim_map

__all__ = ["EmbeddedEnhancer", "has_fast_half_precision", "validation_scores"]

FORMAT = 1
"""Raised when a saved restorer cannot be read by newer code."""
CANDIDATE_STEPS = (1, 4)
"""More steps never gained on held-out pairs; which of these does differs from scene to scene."""
VIEWS_AT_ONCE = 4


def has_fast_half_precision() -> bool:
    """Whether this processor computes bfloat16 convolutions faster than float32 ones."""
    return bool(torch.cpu._is_avx512_bf16_supported())


@dataclass(frozen=True)
class EmbeddedEnhancer:
    """A trained restorer.

    Args:
        network: in evaluation mode.
        steps: of the sampler.
        samples: drawn per view and averaged; more than one also gives a deviation.
        seed: of the noise, together with the clip's index.
        half_precision: convolutions in bfloat16.
        gamut: hues of the scene's real frames, bounds of the restored ones.
        record: how it was trained and what it reached on validation pairs.
    """

    network: RestorationNetwork
    steps: int
    samples: int
    seed: int
    half_precision: bool
    gamut: Gamut
    record: dict[str, Any]

    name = "embedded"

    @classmethod
    def train(cls, pairs: Pairs, transfer: LightTransfer, config: EnhanceConfig) -> EmbeddedEnhancer:
        """Train on pairs, then choose the number of steps on the pairs kept back.

        The same pairs and settings give the same weights, for one number of threads.

        Args:
            pairs: what the pipeline made.
            transfer: how brightness changes with distance in this scene.
            config: budget, widths and seed.

        Raises:
            ConfigError: when nothing is left to train on, or the images are too small.
            DivergedError: when the loss stops being finite.
        """
        half = _half_precision(config)
        generator = torch.Generator().manual_seed(config.seed)
        network = build_network(CONDITION_CHANNELS, config.channels, generator)
        sampler = CropSampler(pairs, transfer, batch=config.batch, crop_px=config.crop, seed=config.seed)
        settings = TrainingSettings(config.train_iterations, config.learning_rate, half)
        network, history = train_network(network, sampler.draw, settings, generator)
        candidates = CANDIDATE_STEPS if config.steps == "auto" else (config.steps,)
        chosen = pairs.subset(np.flatnonzero(~pairs.validation))
        gamut = Gamut.of_images(chosen.target, chosen.weight)
        untested = cls(network, candidates[0], config.samples, config.seed, half, gamut, {})
        scores = validation_scores(untested, pairs, transfer, candidates)
        steps = max(candidates, key=lambda count: scores[f"embedded_{count}"]["psnr"])
        for method, values in scores.items():
            emit(MetricRecorded("enhance", f"validation_psnr_{method}", values["psnr"]))
        record = {
            "training_pairs": int((~pairs.validation).sum()),
            "validation_pairs": int(pairs.validation.sum()),
            "iterations": config.train_iterations,
            "history": history,
            "validation": scores,
        }
        return replace(untested, steps=steps, record=record)

    def restore(self, clip: Clip) -> Restoration:
        """Restore all views of a clip.

        All views of a clip share their noise, so that neighbours differ by their geometry alone.
        """
        size = (clip.cameras.height, clip.cameras.width)
        draws = []
        for index in range(self.samples):
            noise = _noise(size, self.seed, clip.index, index)
            draws.append(self.restored_layers(clip.layers, clip.transfer, noise, steps=self.steps))
        stacked = torch.stack(draws)
        deviation = None
        if self.samples > 1:
            deviation = stacked.std(dim=0, correction=0).mean(dim=1).numpy()
        rgb = stacked.mean(dim=0).permute(0, 2, 3, 1).contiguous().numpy()
        return Restoration(rgb, deviation, self.provenance)

    def restored_layers(
        self,
        layers: Layers,
        transfer: LightTransfer,
        noise: Float[Tensor, "1 3 h w"],
        *,
        steps: int,
    ) -> Float[Tensor, "t 3 h w"]:
        """One sample of each view.

        Args:
            layers: of T views.
            transfer: how brightness changes with distance.
            noise: shared by all views.
            steps: of the sampler.

        Returns:
            In [0, 1].
        """
        parts = []
        # In small groups: the working set of a whole clip would not stay in the cache, and peaks add up.
        for first in range(0, len(layers), VIEWS_AT_ONCE):
            with torch.no_grad():
                conditioning = condition(layers[first : first + VIEWS_AT_ONCE], transfer)
            start = noise.expand(len(conditioning.base), -1, -1, -1)
            restored = sample(
                self.network, conditioning, start, steps=steps, half_precision=self.half_precision
            )
            parts.append(self.gamut.bounded(restored))
        return torch.cat(parts)

    @property
    def provenance(self) -> dict[str, Any]:
        """What restored views came from."""
        return {
            "backend": self.name,
            "steps": self.steps,
            "samples": self.samples,
            "seed": self.seed,
            "precision": "bfloat16" if self.half_precision else "float32",
            "validation": self.record.get("validation", {}),
        }

    def save(self, path: Path) -> None:
        """Write `restorer.safetensors` and `restorer.json`."""
        from safetensors.torch import save_file

        path.mkdir(parents=True, exist_ok=True)
        weights = {name: value.contiguous() for name, value in self.network.state_dict().items()}
        save_file(weights, str(path / "restorer.safetensors"))
        description = {
            "backend": self.name,
            "format": FORMAT,
            "condition_channels": self.network.condition_channels,
            "widths": list(self.network.widths),
            "steps": self.steps,
            "samples": self.samples,
            "seed": self.seed,
            "half_precision": self.half_precision,
            "gamut": self.gamut.as_dict(),
            "record": self.record,
        }
        (path / "restorer.json").write_text(json.dumps(description, indent=2) + "\n")

    @classmethod
    def load(cls, path: Path) -> EmbeddedEnhancer:
        """Read what `save` wrote.

        Raises:
            WeightsError: when a file is missing, or does not fit this version.
        """
        from safetensors.torch import load_file

        weights_file, description_file = path / "restorer.safetensors", path / "restorer.json"
        for file in (weights_file, description_file):
            if not file.exists():
                raise WeightsError(f"{file}: no such file; train the restorer first (stage enhance)")
        description = json.loads(description_file.read_text())
        if description.get("format") != FORMAT or description["condition_channels"] != CONDITION_CHANNELS:
            raise WeightsError(
                f"{description_file}: format {description.get('format')} with "
                f"{description.get('condition_channels')} channels, this version reads format {FORMAT} "
                f"with {CONDITION_CHANNELS}; train the restorer again"
            )
        first, second, third = description["widths"]
        network = build_network(CONDITION_CHANNELS, (first, second, third), torch.Generator())
        try:
            network.load_state_dict(load_file(str(weights_file)))
        except RuntimeError as error:
            raise WeightsError(f"{weights_file}: not the weights of this network ({error})") from error
        return cls(
            network.eval(),
            int(description["steps"]),
            int(description["samples"]),
            int(description["seed"]),
            bool(description["half_precision"]),
            Gamut(**description["gamut"]),
            description["record"],
        )


def validation_scores(
    enhancer: EmbeddedEnhancer, pairs: Pairs, transfer: LightTransfer, candidates: tuple[int, ...]
) -> dict[str, dict[str, float]]:
    """PSNR and SSIM inside the mask on leave-out pairs that were kept back.

    Where leave-out pairs are among the validation pairs, cheap ones are not counted: their artefacts are
    not those of an optimised scene.

    Args:
        enhancer: trained.
        pairs: all pairs.
        transfer: how brightness changes with distance.
        candidates: numbers of sampling steps.

    Returns:
        Of `none` (the rendering), `classical` (blend and fill) and `embedded_N`: `{psnr, ssim}`, and
        `psnr_hole` where a validation pair has pixels of alpha below one half.
    """
    chosen = np.flatnonzero(pairs.validation & ~pairs.cheap)
    if len(chosen) == 0:
        chosen = np.flatnonzero(pairs.validation)
    if len(chosen) == 0:
        chosen = np.arange(len(pairs))
    kept = pairs.subset(chosen)
    with torch.no_grad():
        conditioning = condition(kept.layers, transfer)
    size = (int(kept.target.shape[-2]), int(kept.target.shape[-1]))
    images = {"none": kept.layers.get("rendered").clamp(0, 1), "classical": conditioning.base}
    for steps in candidates:
        parts = [
            enhancer.restored_layers(
                kept.layers[view], transfer, _noise(size, enhancer.seed, view, 0), steps=steps
            )
            for view in range(len(kept))
        ]
        images[f"embedded_{steps}"] = torch.cat(parts)
    return {name: _score(image, kept) for name, image in images.items()}


def _score(image: Float[Tensor, "n 3 h w"], pairs: Pairs) -> dict[str, float]:
    render = image.permute(0, 2, 3, 1)
    target = pairs.target.permute(0, 2, 3, 1)
    mask = pairs.weight[:, 0] > 0
    hole = mask & (pairs.layers.get("alpha")[:, 0] < 0.5)
    known = [value for value in psnr_per_image(render, target, mask) if value is not None]
    score = {
        "psnr": float(np.mean(known)),
        "ssim": float(ssim_map(render, target)[mask].mean()),
    }
    if bool(hole.any()):
        error = (render - target)[hole].square().mean()
        score["psnr_hole"] = float(-10 * error.clamp_min(1e-10).log10())
    return score


def _noise(size: tuple[int, int], seed: int, clip: int, index: int) -> Float[Tensor, "1 3 h w"]:
    generator = np.random.default_rng([seed, 3, clip, index])
    height, width = size
    return torch.from_numpy(generator.standard_normal((1, 3, height, width), dtype=np.float32))


def _half_precision(config: EnhanceConfig) -> bool:
    if config.precision == "auto":
        return has_fast_half_precision()
    return config.precision == "bfloat16"
