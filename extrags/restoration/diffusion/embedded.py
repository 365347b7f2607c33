"""The default restorer: a pretrained conditional diffusion, and may learn from a scene."""

from __future__ import annotations

import copy
import json
import math
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from extrags.config import EnhanceConfig
from extrags.errors import WeightsError
from extrags.events import MetricRecorded, emit
from extrags.metrics.image import psnr_per_image, ssim_map
from extrags.restoration.diffusion.network import RestorationNetwork, build_network
from extrags.restoration.diffusion.rectified_flow import Sampled, TrainingSettings, sample, train_network
from extrags.restoration.diffusion.weights import DESCRIPTION, WEIGHTS
from extrags.restoration.protocol import Clip, Restoration
from extrags.restoration.training_data.augmentation import CropSampler
from extrags.restoration.training_data.pairs import Pairs
from extrags.restoration.uncertainty.calibration import Calibration, cell_means
from extrags.restoration.uncertainty.error_model import ErrorModel, error_features
from extrags.view_synthesis.conditioning import CONDITION_CHANNELS, Layers, condition
from extrags.view_synthesis.gamut import Gamut
from extrags.view_synthesis.references import LightTransfer

__all__ = ["EmbeddedEnhancer", "has_fast_half_precision", "validation_scores"]

FORMAT = 2
"""Raised when a saved restorer cannot be read by newer code."""
CANDIDATE_STEPS = (1, 4)
"""More steps never gained on held-out pairs; which of these does differs from scene to scene."""
VIEWS_AT_ONCE = 4
MOSTLY_VALID = 0.5
"""Cells with a smaller share of valid pixels judge nothing."""
SHORTEST_PROBED = 200
PROBE_PART = 5
"""A training on a scene of so many steps and more is tried out with a part of them."""
MIN_GAIN_DB = 0.1
"""Training on a scene must gain so much on validation pairs; less is chance."""


def has_fast_half_precision() -> bool:
    """Whether this processor computes bfloat16 convolutions faster than float32 ones."""
    return bool(torch.cpu._is_avx512_bf16_supported())


@dataclass(frozen=True)
class EmbeddedEnhancer:
    """A trained restorer.

    Args:
        network: in evaluation mode.
        steps: of the sampler.
        samples: drawn per view and averaged; their spread adds to the expected error.
        seed: of the noise, together with the clip's index.
        half_precision: convolutions in bfloat16.
        gamut: hues of the scene's real frames, bounds of the restored ones.
        record: how it was trained and what it reached on validation pairs.
        error_model: the expected error, from the network's own and from what it was given.
        calibration: from the expected error to the one it makes.
        deterministic: trained as a plain regression: no noise, one step.
    """

    network: RestorationNetwork
    steps: int
    samples: int
    seed: int
    half_precision: bool
    gamut: Gamut
    record: dict[str, Any]
    error_model: ErrorModel = field(default_factory=ErrorModel)
    calibration: Calibration = field(default_factory=Calibration)
    deterministic: bool = False

    name = "embedded"

    @classmethod
    def train(
        cls,
        pairs: Pairs,
        transfer: LightTransfer,
        config: EnhanceConfig,
        start: EmbeddedEnhancer | None = None,
        *,
        deterministic: bool = False,
    ) -> EmbeddedEnhancer:
        """Train on a scene's pairs, and keep what the validation pairs show to be better.

        With `start`, its network is trained on; where that does not help on the validation pairs, the
        network stays as it came. The same pairs and settings give the same weights, for one number of
        threads.

        Args:
            pairs: what the pipeline made.
            transfer: how brightness changes with distance in this scene.
            config: budget, widths and seed.
            start: a restorer that was pretrained on other scenes.
            deterministic: train a plain regression instead of a diffusion.

        Raises:
            ConfigError: when nothing is left to train on, or the images are too small.
            DivergedError: when the loss stops being finite.
        """
        generator = torch.Generator().manual_seed(config.seed)
        chosen = pairs.subset(np.flatnonzero(~pairs.validation))
        gamut = Gamut.of_images(chosen.target, chosen.weight)
        if start is None:
            network = build_network(CONDITION_CHANNELS, config.channels, generator)
            rate = config.learning_rate
            base = cls(network, 1, 1, config.seed, False, gamut, {}, deterministic=deterministic)
        else:
            base = start
            rate = config.scene_learning_rate
            deterministic = start.deterministic
        base = base.with_settings(config, gamut)
        candidates = base.candidate_steps(config)
        before = {} if start is None else validation_scores(base, pairs, transfer, candidates)

        def trained_for(iterations: int) -> tuple[EmbeddedEnhancer, list[dict[str, float]], float]:
            """Trained on the scene, and by how much that helped."""
            learner = replace(base, network=copy.deepcopy(base.network))
            sampler = CropSampler(pairs, transfer, batch=config.batch, crop_px=config.crop, seed=config.seed)
            settings = TrainingSettings(iterations, rate, base.half_precision, deterministic=deterministic)
            _, history = train_network(learner.network, sampler.draw, settings, generator)
            after.update(validation_scores(learner, pairs, transfer, candidates))
            gain = _best(after, candidates)[1] - (_best(before, candidates)[1] if before else -math.inf)
            return learner, history, gain

        after: dict[str, dict[str, float]] = {}
        iterations = config.train_iterations
        if start is not None and iterations >= SHORTEST_PROBED:
            # A short training first: where it brings nothing, the long one is not worth its time.
            trained, history, gain = trained_for(iterations // PROBE_PART)
            iterations = config.train_iterations if gain > 0 else iterations // PROBE_PART
        if start is None or iterations == config.train_iterations:
            trained, history, gain = trained_for(iterations)
        scores = {**after, **{f"untrained_{name}": value for name, value in _embedded_only(before).items()}}
        # Without validation pairs nothing can be said, and the pretrained network is trusted.
        helped = gain > MIN_GAIN_DB and (start is None or _validation_pairs(pairs) is not None)
        kept = trained if helped else base
        steps = _best(after if helped else before, candidates)[0]
        for method, values in scores.items():
            emit(MetricRecorded("enhance", f"validation_psnr_{method}", values["psnr"]))
        record = {
            **base.record,
            "training_pairs": int((~pairs.validation).sum()),
            "validation_pairs": int(pairs.validation.sum()),
            "iterations": iterations,
            "history": history,
            "validation": scores,
            "scene_training_kept": helped,
        }
        kept = replace(kept, steps=steps, record=record)
        return kept.calibrated(pairs, transfer)

    def with_settings(self, config: EnhanceConfig, gamut: Gamut) -> EmbeddedEnhancer:
        """The same network under a scene's settings."""
        steps = self.steps if config.steps == "auto" else config.steps
        return replace(
            self,
            steps=1 if self.deterministic else steps,
            samples=1 if self.deterministic else config.samples,
            seed=config.seed,
            half_precision=_half_precision(config),
            gamut=gamut,
        )

    def candidate_steps(self, config: EnhanceConfig) -> tuple[int, ...]:
        """Numbers of steps to choose from."""
        if self.deterministic:
            return (1,)
        return CANDIDATE_STEPS if config.steps == "auto" else (config.steps,)

    def calibrated(self, pairs: Pairs, transfer: LightTransfer) -> EmbeddedEnhancer:
        """With the curve that the validation pairs show; the present one where they are too few.

        The line below it stays: a few pairs of one scene are enough for a curve, not for six weights.

        Args:
            pairs: all pairs.
            transfer: how brightness changes with distance.
        """
        kept = _validation_pairs(pairs)
        if kept is None:
            return self
        calibration = Calibration.fitted(*self.cell_errors(kept, transfer))
        return replace(self, calibration=calibration) if calibration.predicted else self

    def with_error_model(self, scenes: Sequence[tuple[Pairs, LightTransfer]]) -> EmbeddedEnhancer:
        """With line and curve of the expected error fitted to pairs of many scenes.

        Args:
            scenes: pairs that were not trained on, and how brightness changes with distance in each.
        """
        plain = replace(self, error_model=ErrorModel(), calibration=Calibration())
        features, errors = [], []
        for pairs, transfer in scenes:
            for view in range(len(pairs)):
                layers, weight = pairs.layers[view], pairs.weight[view : view + 1]
                noise = plain._noise((int(weight.shape[-2]), int(weight.shape[-1])), view, 0)
                restored = plain.restored_layers(layers, transfer, noise, steps=plain.steps)
                error = (restored.rgb - pairs.target[view : view + 1]).abs().mean(dim=1, keepdim=True)
                mean, share = cell_means(error, weight)
                each = error_features(layers, restored.rgb, restored.error)
                columns = [cell_means(each[:, [k]], weight)[0] for k in range(each.shape[1])]
                features.append(np.stack(columns, axis=1)[share > MOSTLY_VALID])
                errors.append(mean[share > MOSTLY_VALID])
        lined = replace(
            plain, error_model=ErrorModel.fitted(np.concatenate(features), np.concatenate(errors))
        )
        cells = [lined.cell_errors(pairs, transfer) for pairs, transfer in scenes]
        expected, true = (np.concatenate(part) for part in zip(*cells, strict=True))
        return replace(lined, calibration=Calibration.fitted(expected, true))

    def cell_errors(
        self, pairs: Pairs, transfer: LightTransfer
    ) -> tuple[Float[np.ndarray, "m"], Float[np.ndarray, "m"]]:
        """Expected (not calibrated) and true absolute errors of cells that are mostly valid.

        Args:
            pairs: with the truth.
            transfer: how brightness changes with distance.
        """
        size = (int(pairs.target.shape[-2]), int(pairs.target.shape[-1]))
        expected, true = [], []
        for view in range(len(pairs)):
            noise = self._noise(size, view, 0)
            restored = self.restored_layers(pairs.layers[view], transfer, noise, steps=self.steps)
            weight = pairs.weight[view : view + 1]
            error = (restored.rgb - pairs.target[view : view + 1]).abs().mean(dim=1, keepdim=True)
            predicted, share = cell_means(restored.error, weight)
            expected.append(predicted[share > MOSTLY_VALID])
            true.append(cell_means(error, weight)[0][share > MOSTLY_VALID])
        return np.concatenate(expected), np.concatenate(true)

    def restore(self, clip: Clip) -> Restoration:
        """Restore all views of a clip.

        All views of a clip share their noise, so that neighbours differ by their geometry alone.
        """
        size = (clip.cameras.height, clip.cameras.width)
        draws = []
        for index in range(self.samples):
            noise = self._noise(size, clip.index, index)
            draws.append(self.restored_layers(clip.layers, clip.transfer, noise, steps=self.steps))
        colors = torch.stack([draw.rgb for draw in draws])
        spread = colors.std(dim=0, correction=0).mean(dim=1, keepdim=True)
        error = torch.stack([draw.error for draw in draws]).mean(dim=0)
        expected = torch.hypot(error, spread)[:, 0].contiguous().numpy()
        return Restoration(
            colors.mean(dim=0).permute(0, 2, 3, 1).contiguous().numpy(),
            self.calibration.applied(expected),
            self.provenance,
            draws[0].depth_mm[:, 0].contiguous().numpy(),
        )

    def restored_layers(
        self,
        layers: Layers,
        transfer: LightTransfer,
        noise: Float[Tensor, "1 3 h w"],
        *,
        steps: int,
    ) -> Sampled:
        """One sample of each view.

        Args:
            layers: of T views.
            transfer: how brightness changes with distance.
            noise: shared by all views.
            steps: of the sampler.
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
            rgb = self.gamut.bounded(restored.rgb)
            features = error_features(layers[first : first + VIEWS_AT_ONCE], rgb, restored.error)
            parts.append(replace(restored, rgb=rgb, error=self.error_model.applied(features)))
        return Sampled(
            torch.cat([part.rgb for part in parts]),
            torch.cat([part.depth_mm for part in parts]),
            torch.cat([part.error for part in parts]),
        )

    def _noise(self, size: tuple[int, int], clip: int, index: int) -> Float[Tensor, "1 3 h w"]:
        if self.deterministic:
            return torch.zeros(1, 3, *size)
        return _noise(size, self.seed, clip, index)

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
            "scene_training_kept": self.record.get("scene_training_kept"),
        }

    def save(self, path: Path, *, half: bool = False) -> None:
        """Write `restorer.safetensors` and `restorer.json`.

        Args:
            path: a folder.
            half: weights in float16: half the size, for shipping.
        """
        from safetensors.torch import save_file

        path.mkdir(parents=True, exist_ok=True)
        weights = {
            name: (value.half() if half else value).contiguous()
            for name, value in self.network.state_dict().items()
        }
        save_file(weights, str(path / WEIGHTS))
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
            "error_model": self.error_model.as_dict(),
            "calibration": self.calibration.as_dict(),
            "deterministic": self.deterministic,
            "record": self.record,
        }
        (path / DESCRIPTION).write_text(json.dumps(description, indent=2) + "\n")

    @classmethod
    def load(cls, path: Path) -> EmbeddedEnhancer:
        """Read what `save` wrote.

        Args:
            path: the folder, or its .safetensors file with the .json beside it.

        Raises:
            WeightsError: when a file is missing, or does not fit this version.
        """
        from safetensors import SafetensorError
        from safetensors.torch import load_file

        weights_file = path / WEIGHTS if path.is_dir() or path.suffix != ".safetensors" else path
        description_file = weights_file.with_suffix(".json")
        for file in (weights_file, description_file):
            if not file.exists():
                raise WeightsError(f"{file}: no such file; train the restorer first (stage enhance)")
        try:
            description = dict(json.loads(description_file.read_text()))
        except (ValueError, TypeError) as error:
            raise WeightsError(f"{description_file}: not readable as a JSON object ({error})") from error
        if description.get("format") != FORMAT or description.get("condition_channels") != CONDITION_CHANNELS:
            raise WeightsError(
                f"{description_file}: format {description.get('format')} with "
                f"{description.get('condition_channels')} channels, this version reads format {FORMAT} "
                f"with {CONDITION_CHANNELS}; train the restorer again"
            )
        try:
            first, second, third = description["widths"]
            network = build_network(CONDITION_CHANNELS, (first, second, third), torch.Generator())
            enhancer = cls(
                network.eval(),
                int(description["steps"]),
                int(description["samples"]),
                int(description["seed"]),
                bool(description["half_precision"]),
                Gamut(**description["gamut"]),
                description["record"],
                ErrorModel(
                    tuple(description["error_model"]["weights"]), float(description["error_model"]["offset"])
                ),
                Calibration(**{k: tuple(v) for k, v in description["calibration"].items()}),
                bool(description["deterministic"]),
            )
        except (KeyError, TypeError, ValueError, AttributeError) as error:
            raise WeightsError(
                f"{description_file}: not the description of a restorer ({error!r})"
            ) from error
        try:
            network.load_state_dict(
                {name: value.float() for name, value in load_file(str(weights_file)).items()}
            )
        except (OSError, RuntimeError, SafetensorError) as error:
            raise WeightsError(f"{weights_file}: not the weights of this network ({error})") from error
        return enhancer


def validation_scores(
    enhancer: EmbeddedEnhancer, pairs: Pairs, transfer: LightTransfer, candidates: tuple[int, ...]
) -> dict[str, dict[str, float]]:
    """PSNR and SSIM inside the mask on leave-out pairs that were kept back.

    Where leave-out pairs are among the validation pairs, synthetic ones are not counted: their artefacts are
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
    kept = _validation_pairs(pairs) or pairs
    with torch.no_grad():
        conditioning = condition(kept.layers, transfer)
    size = (int(kept.target.shape[-2]), int(kept.target.shape[-1]))
    images = {"none": kept.layers.get("rendered").clamp(0, 1), "classical": conditioning.base}
    for steps in candidates:
        parts = [
            enhancer.restored_layers(
                kept.layers[view], transfer, enhancer._noise(size, view, 0), steps=steps
            ).rgb
            for view in range(len(kept))
        ]
        images[f"embedded_{steps}"] = torch.cat(parts)
    return {name: _score(image, kept) for name, image in images.items()}


def _validation_pairs(pairs: Pairs) -> Pairs | None:
    """Validation pairs; the leave-out ones alone where there are any. None where nothing was kept back."""
    chosen = np.flatnonzero(pairs.validation & ~pairs.synthetic)
    if len(chosen) == 0:
        chosen = np.flatnonzero(pairs.validation)
    return pairs.subset(chosen) if len(chosen) else None


def _embedded_only(scores: dict[str, dict[str, float]]) -> dict[str, dict[str, float]]:
    return {name: value for name, value in scores.items() if name.startswith("embedded_")}


def _best(scores: dict[str, dict[str, float]], candidates: tuple[int, ...]) -> tuple[int, float]:
    """The best number of steps and its PSNR."""
    steps = max(candidates, key=lambda count: scores[f"embedded_{count}"]["psnr"])
    return steps, scores[f"embedded_{steps}"]["psnr"]


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
