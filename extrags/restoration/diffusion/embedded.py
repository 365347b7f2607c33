"""The default restorer: a conditional diffusion whose pretrained weights come with the package."""

from __future__ import annotations

import shutil
from dataclasses import dataclass, field, replace
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from extrags.array_files import load_safetensors, save_safetensors
from extrags.config import EnhanceConfig
from extrags.depth.completion import CompletionNetwork
from extrags.depth.hidden import depth_from_image
from extrags.depth.weights import hidden_digest, load_hidden
from extrags.errors import ConfigError, WeightsError, reason_of
from extrags.restoration.description import description_fields, read_description, write_description
from extrags.restoration.diffusion.frame_features import sequence_features
from extrags.restoration.diffusion.network import RestorationNetwork, build_network
from extrags.restoration.diffusion.precision import chosen_precision
from extrags.restoration.diffusion.rectified_flow import Sampled, sample
from extrags.restoration.diffusion.seamless_cloning import certainty, cloned_seamlessly
from extrags.restoration.diffusion.texture_transfer import PatchFeatures
from extrags.restoration.diffusion.weights import WEIGHTS, find_weights
from extrags.restoration.protocol import Clip, Restoration
from extrags.restoration.uncertainty.calibration import Calibration
from extrags.restoration.uncertainty.domain import Domain
from extrags.restoration.uncertainty.error_model import ErrorModel, error_features
from extrags.sequence import EndoscopicSequence
from extrags.threads import in_threads
from extrags.view_synthesis.conditioning import (
    COLOR_CENTER,
    COLOR_SCALE,
    CONDITION_CHANNELS,
    INVENTED_CHANNELS,
    Layers,
    condition,
    filled_depth,
)
from extrags.view_synthesis.gamut import Gamut
from extrags.view_synthesis.references import LightTransfer

__all__ = ["EmbeddedEnhancer", "pretrained"]

FORMAT = 8
"""Raised when a saved restorer cannot be read by newer code."""
_UNKNOWN_DOMAIN: dict[str, Any] = {"domain": None, "domain_score": None, "scene_calibrated": False}
_ONE_CURVE: dict[str, Any] = {"weights_calibration": None}
_PLAIN: dict[str, Any] = {"trained_on": "", "seamless": False, **_ONE_CURVE}
EARLIER_FORMATS: dict[int, dict[str, Any]] = {
    2: {"generative": False, "drawing": False, "depth_from_image": None, **_PLAIN},
    3: {"depth_from_image": None, **_PLAIN},
    4: _PLAIN,
    5: _PLAIN,
    6: {"seamless": False, **_ONE_CURVE},
    7: _ONE_CURVE,
}
"""What earlier formats that can be read lack, and what stands for it."""
FIRST_DOMAIN_FORMAT = 5
"""Domains of earlier formats are of other features, and not read."""
PATCHES = "patches.safetensors"
UNTRAINED = "untrained"
"""Folder inside that of a restorer."""
COLOR_STEPS = 255
CHANNELS_OF_NETWORKS = (CONDITION_CHANNELS, CONDITION_CHANNELS + INVENTED_CHANNELS)
"""Without and with channels of their own for what keyframes have invented."""
OF_A_SCENE = ("judged", "unjudged", "scene_training_kept")
"""What a record holds of one scene alone."""
MOST_MODESTY = 3.0
CANDIDATE_STEPS = (1, 4)
"""More steps never gained on held-out pairs; which of these does differs from scene to scene."""
VIEWS_AT_ONCE = 4


@dataclass(frozen=True)
class EmbeddedEnhancer:
    """Diffusion network of a scene, with its settings, error model and calibration.

    Args:
        network: in evaluation mode.
        steps: of the sampler.
        samples: drawn per view; their spread adds to the expected error. Their mean is the restored view, but
            with `drawing` it is the first.
        seed: of the noise, together with the clip's index.
        half_precision: convolutions in bfloat16.
        gamut: hues of the scene's real frames, bounds of the restored ones.
        record: how it was trained and what it reached on validation pairs.
        error_model: the expected error, from the network's own and from what it was given.
        calibration: curve from the expected error to the error it makes.
        deterministic: trained as a plain regression: no noise, one step.
        drawing: one of the plausible views is restored instead of their mean; generative networks only.
        patches: parts of the scene's real frames, which a generative network takes texture from, in [0, 1],
            [R, 3, S, S]; None without.
        domain: what it was trained on, by which a scene is told to be of that world or not; None where that
            is not known.
        domain_score: how far the scene's frames are from that: above 1 outside; None where that is not known,
            and before there is a scene.
        scene_calibrated: the calibration is that of the scene's left-out frames.
        depth_from_image: depth in holes is read from the restored image.
        untrained: what the restorer was before it was trained on the scene; None where it was not, or began
            with nothing.
        trained_on: kind of scene that its weights have learned from, for reports; empty if unknown.
        seamless: what it invents is cloned seamlessly into the base image, which stays where it is certain:
            for scenes on which the network does harm where all is known.
        weights_calibration: the calibration that its weights came with, where that of the scene has taken its
            place; None where it has not, and where they came with none.
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
    drawing: bool = False
    patches: Float[Tensor, "r 3 s s"] | None = None
    domain: Domain | None = None
    depth_from_image: bool = False
    domain_score: float | None = None
    scene_calibrated: bool = False
    untrained: EmbeddedEnhancer | None = None
    trained_on: str = ""
    seamless: bool = False
    weights_calibration: Calibration | None = None

    name = "embedded"
    follows_keyframes = True

    def with_settings(
        self, config: EnhanceConfig, gamut: Gamut, patches: Float[Tensor, "r 3 s s"] | None = None
    ) -> EmbeddedEnhancer:
        """The same network under a scene's settings.

        Args:
            config: settings.
            gamut: hues of the scene's real frames.
            patches: parts of these frames; a network that is not generative has no use for them.
        """
        steps = self.steps if config.steps == "auto" else config.steps
        samples = 1 if config.samples == "mean" else config.samples
        generative = self.network.generative
        return replace(
            self,
            steps=1 if self.deterministic else steps,
            samples=1 if self.deterministic else samples,
            seed=config.seed,
            half_precision=chosen_precision(config) == "bfloat16",
            gamut=gamut,
            drawing=generative and config.samples != "mean",
            patches=patches if generative else None,
            depth_from_image=config.depth_from_image,
        )

    def without_scene(self) -> EmbeddedEnhancer:
        """The weights alone, for another scene to start from: what was found for a scene is forgotten.

        A saved restorer serves as weights; how the scene that it was saved for was restored and judged says
        nothing of the next one.
        """
        record = {name: value for name, value in self.record.items() if name not in OF_A_SCENE}
        return replace(
            self,
            record=record,
            calibration=self.weights_calibration or self.calibration,
            weights_calibration=None,
            domain_score=None,
            scene_calibrated=False,
            untrained=None,
            seamless=False,
        )

    def with_calibration_of_scene(self, calibration: Calibration) -> EmbeddedEnhancer:
        """The same restorer; its expected error follows the scene's left-out frames, not its weights' own."""
        known = self.calibration if self.calibration.predicted else None
        of_weights = self.weights_calibration if self.scene_calibrated else known
        return replace(self, calibration=calibration, scene_calibrated=True, weights_calibration=of_weights)

    @property
    def keeps_known(self) -> bool:
        """Whether restored views are the base image wherever that is certain."""
        return self.seamless

    def cloning_seamlessly(self) -> EmbeddedEnhancer:
        """The same restorer, and what it was before it was trained on the scene, with `seamless` set.

        Depth is not read from its images: their tissue is foreign to the reader as well.
        """
        untrained = None if self.untrained is None else self.untrained.cloning_seamlessly()
        return replace(self, seamless=True, depth_from_image=False, untrained=untrained)

    def candidate_steps(self, config: EnhanceConfig) -> tuple[int, ...]:
        """Numbers of steps to choose from."""
        if self.deterministic:
            return (1,)
        return CANDIDATE_STEPS if config.steps == "auto" else (config.steps,)

    def restore(self, clip: Clip) -> Restoration:
        """Restore all views of a clip.

        All views of a clip share their noise, so that neighbours differ by their geometry alone.
        """
        size = (clip.cameras.height, clip.cameras.width)
        draws = []
        for index in range(self.samples):
            noise = self.noise(size, clip.index, index)
            draws.append(self.restored_layers(clip.layers, clip.transfer, noise, steps=self.steps))
        colors = torch.stack([draw.rgb for draw in draws])
        # The mean of drawn views would have no texture: the others only tell how far views may differ.
        shown = colors[0] if self.drawing else colors.mean(dim=0)
        error = torch.stack([draw.error for draw in draws]).mean(dim=0)
        if len(draws) > 1:
            error = torch.hypot(error, colors.std(dim=0, correction=0).mean(dim=1, keepdim=True))
        expected = error[:, 0].contiguous().numpy()
        return Restoration(
            shown.permute(0, 2, 3, 1).contiguous().numpy(),
            self.calibration.applied(expected) * self.modesty,
            self.provenance,
            self._depth(clip, shown, draws[0].depth_mm)[:, 0].contiguous().numpy(),
        )

    def _depth(
        self, clip: Clip, rgb: Float[Tensor, "t 3 h w"], guess_mm: Float[Tensor, "t 1 h w"]
    ) -> Float[Tensor, "t 1 h w"]:
        """Z-depth of a restored clip, of which the network has a guess."""
        if not self.depth_from_image:
            return guess_mm
        network = _reader_of_depth()
        filled_mm = filled_depth(clip.layers, clip.transfer.scale_mm)[:, 0]
        # What a keyframe has invented is as sure as its colour.
        opacity = torch.maximum(clip.layers.get("alpha"), clip.layers.get("invented_weight"))[:, 0]
        K = torch.from_numpy(clip.cameras.K).to(rgb)
        half = self.half_precision
        return depth_from_image(network, rgb, filled_mm, guess_mm[:, 0], opacity, K, half_precision=half)[
            :, None
        ]

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
        features = self._patch_features()

        def restored_group(first: int) -> Sampled:
            group = layers[first : first + VIEWS_AT_ONCE]
            with torch.no_grad():
                conditioning = condition(group, transfer, folded=self.network.folded)
            start = noise.expand(len(conditioning.base), -1, -1, -1)
            restored = sample(
                self.network,
                conditioning,
                start,
                steps=steps,
                half_precision=self.half_precision,
                drawing=self.drawing,
                patches=None if features is None else features.expanded(len(start)),
            )
            rgb = self.gamut.bounded(restored.rgb)
            if self.seamless:
                rgb = cloned_seamlessly(rgb, conditioning.base, certainty(group))
            error = self.error_model.applied(error_features(group, rgb, restored.error))
            return replace(restored, rgb=rgb, error=error)

        # In small groups: the working set of a whole clip would not stay in the cache, and peaks add up.
        parts = in_threads(restored_group, range(0, len(layers), VIEWS_AT_ONCE))
        return Sampled(
            torch.cat([part.rgb for part in parts]),
            torch.cat([part.depth_mm for part in parts]),
            torch.cat([part.error for part in parts]),
        )

    def noise(self, size: tuple[int, int], clip: int, index: int) -> Float[Tensor, "1 3 h w"]:
        """Where the sampler starts: zero for a plain regression.

        Args:
            size: height and width in pixels.
            clip: index of the clip.
            index: of the sample.
        """
        height, width = size
        if self.deterministic:
            return torch.zeros(1, 3, height, width)
        generator = np.random.default_rng([self.seed, 3, clip, index])
        return torch.from_numpy(generator.standard_normal((1, 3, height, width), dtype=np.float32))

    def with_domain_score(self, sequence: EndoscopicSequence) -> EmbeddedEnhancer:
        """The same restorer, told how far a scene is from what it was trained on, if that is known.

        Args:
            sequence: with training frames.
        """
        if self.domain is None:
            return self
        features = sequence_features(self.network, sequence)
        return replace(self, domain_score=self.domain.score(features) if len(features) else None)

    @property
    def modesty(self) -> float:
        """Factor of the expected error outside the known world, where no frame of the scene has told it."""
        if self.domain_score is None or self.scene_calibrated:
            return 1.0
        return min(max(self.domain_score, 1.0), MOST_MODESTY)

    def _patch_features(self) -> PatchFeatures | None:
        if self.patches is None or not self.network.generative:
            return None
        normalised = (self.patches - COLOR_CENTER) / COLOR_SCALE
        with torch.no_grad(), torch.autocast("cpu", torch.bfloat16, enabled=self.half_precision):
            return self.network.texture.encode(normalised[None])

    @property
    def provenance(self) -> dict[str, Any]:
        """Settings behind restored views, ready for JSON."""
        return {
            "backend": self.name,
            "steps": self.steps,
            "samples": self.samples,
            "seed": self.seed,
            "precision": "bfloat16" if self.half_precision else "float32",
            "drawing": self.drawing,
            "depth_from_image": self.depth_from_image,
            "trained_on": self.trained_on,
            "seamless": self.seamless,
            "domain_score": self.domain_score,
            "validation": self.record.get("validation", {}),
            "scene_training_kept": self.record.get("scene_training_kept"),
            "judged": self.record.get("judged"),
            "unjudged": self.record.get("unjudged"),
        }

    def save(self, path: Path, *, half: bool = False) -> None:
        """Write `restorer.safetensors` and `restorer.json`, and a folder for what it was before, if anything.

        Args:
            path: a folder.
            half: weights in float16: half the size, for shipping.
        """
        path.mkdir(parents=True, exist_ok=True)
        weights = {name: value.half() if half else value for name, value in self.network.state_dict().items()}
        save_safetensors(path / WEIGHTS, weights)
        # Those of a restorer that was here before are not this one's.
        (path / PATCHES).unlink(missing_ok=True)
        if self.patches is not None:
            levels = (self.patches * COLOR_STEPS).round().to(torch.uint8)
            save_safetensors(path / PATCHES, {"patches": levels})
        shutil.rmtree(path / UNTRAINED, ignore_errors=True)
        if self.untrained is not None:
            self.untrained.save(path / UNTRAINED, half=half)
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
            "generative": self.network.generative,
            "drawing": self.drawing,
            # The weights that read it are not saved: cached views follow their digest.
            "depth_from_image": hidden_digest() if self.depth_from_image else None,
            "domain": None if self.domain is None else self.domain.as_dict(),
            "domain_score": self.domain_score,
            "scene_calibrated": self.scene_calibrated,
            "weights_calibration": (
                None if self.weights_calibration is None else self.weights_calibration.as_dict()
            ),
            "trained_on": self.trained_on,
            "seamless": self.seamless,
            "record": self.record,
        }
        write_description(path, description)

    @classmethod
    def load(cls, path: Path) -> EmbeddedEnhancer:
        """Read what `save` wrote.

        Args:
            path: the folder, or its .safetensors file with the .json beside it.

        Raises:
            WeightsError: when a file is missing, or does not fit this version.
        """
        weights_file = path / WEIGHTS if path.is_dir() or path.suffix != ".safetensors" else path
        description_file = weights_file.with_suffix(".json")
        if not weights_file.exists():
            raise WeightsError(f"{weights_file}: no such file; train the restorer first (stage enhance)")
        description = read_description(description_file)
        channels = description.get("condition_channels")
        for number, entries in EARLIER_FORMATS.items():
            if description.get("format") == number:
                unread = _UNKNOWN_DOMAIN if number < FIRST_DOMAIN_FORMAT else {}
                description = entries | description | unread
        if description.get("format") not in (*EARLIER_FORMATS, FORMAT) or (
            channels not in CHANNELS_OF_NETWORKS
        ):
            readable = " or ".join(map(str, CHANNELS_OF_NETWORKS))
            raise WeightsError(
                f"{description_file}: format {description.get('format')} with {channels} channels, this "
                f"version reads formats {min(EARLIER_FORMATS)} to {FORMAT} with {readable}; train the "
                "restorer again"
            )
        with description_fields(description_file):
            first, second, third = description["widths"]
            network = build_network(
                int(description["condition_channels"]),
                (first, second, third),
                torch.Generator(),
                generative=bool(description["generative"]),
            )
            error_model, of_weights = description["error_model"], description["weights_calibration"]
            enhancer = cls(
                network.eval(),
                int(description["steps"]),
                int(description["samples"]),
                int(description["seed"]),
                bool(description["half_precision"]),
                Gamut(**description["gamut"]),
                dict(description["record"]),
                ErrorModel(tuple(error_model["weights"]), float(error_model["offset"])),
                Calibration.from_dict(description["calibration"]),
                bool(description["deterministic"]),
                bool(description["drawing"]),
                _read_patches(weights_file.with_name(PATCHES)),
                None if description["domain"] is None else Domain.from_dict(description["domain"]),
                bool(description["depth_from_image"]),
                None if description["domain_score"] is None else float(description["domain_score"]),
                bool(description["scene_calibrated"]),
                _read_untrained(weights_file.with_name(UNTRAINED)),
                str(description["trained_on"]),
                bool(description["seamless"]),
                of_weights and Calibration.from_dict(of_weights),
            )
        try:
            network.load_state_dict(
                {name: value.float() for name, value in load_safetensors(weights_file).items()}
            )
        except (OSError, RuntimeError, ValueError) as error:
            raise WeightsError(
                f"{weights_file}: not the weights of this network ({reason_of(error)})"
            ) from error
        return enhancer


@cache
def _reader_of_depth() -> CompletionNetwork:
    network = load_hidden()
    for parameter in network.parameters():
        # Of convolutions: in this layout they are a seventh faster.
        if parameter.dim() == 4:
            parameter.data = parameter.data.contiguous(memory_format=torch.channels_last)
    return network


def _read_patches(file: Path) -> Float[Tensor, "r 3 s s"] | None:
    """Patches of a scene's restorer; None where there is no such file.

    Raises:
        WeightsError: when the file holds no patches.
    """
    if not file.exists():
        return None
    try:
        return load_safetensors(file)["patches"].float() / COLOR_STEPS
    except (OSError, RuntimeError, ValueError, KeyError) as error:
        raise WeightsError(f"{file}: not the patches of a scene's frames ({reason_of(error)})") from error


def _read_untrained(folder: Path) -> EmbeddedEnhancer | None:
    return EmbeddedEnhancer.load(folder) if folder.is_dir() else None


def pretrained(config: EnhanceConfig) -> tuple[EmbeddedEnhancer, ...]:
    """Restorers with pretrained weights, the first preferred; none where training starts from random ones.

    Raises:
        WeightsError: when the weights are missing or do not fit.
        ConfigError: when there would be neither weights nor training.
    """
    weights = find_weights(config.pretrained_weights)
    if not weights and config.train_iterations == 0:
        raise ConfigError(
            "enhance.train_iterations is 0 and enhance.pretrained_weights is none: nothing would restore"
        )
    return tuple(EmbeddedEnhancer.load(file).without_scene() for file in weights)
