"""Monocular depth networks that transformers saves: found, checked, loaded from local files alone.

Images are prepared here, as the model's own `preprocessor_config.json` says: the image processors of
transformers would bring torchvision, or differ between its versions.
"""

from __future__ import annotations

import importlib
import importlib.util
import json
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor
from torch.nn import functional

from extrags.errors import MissingDependencyError, WeightsError, installed_with, reason_of
from extrags.model_files import fingerprint, lacking_weights
from extrags.user_paths import expanded

__all__ = ["MonocularNetwork", "Preparation", "find_monocular", "load_monocular", "monocular_digest"]

INSTALL = installed_with("monocular")
CONFIG, PREPROCESSOR, WEIGHTS = "config.json", "preprocessor_config.json", "model.safetensors"

ARCHITECTURES = ("DepthAnythingForDepthEstimation", "DPTForDepthEstimation")
"""Whose output is known: inverse depth up to scale and shift, or depth where the configuration says so."""

MODES = {0: "nearest", 2: "bilinear", 3: "bicubic"}
"""Ways to resize by their numbers in Pillow, which preprocessor files use."""

NEAREST_SHARE = 1e-2
"""Metric depths are taken to be at least so much of a frame's median: their inverse stays finite."""


@dataclass(frozen=True)
class Preparation:
    """How a network wants its images.

    Args:
        size: height and width they are resized to; None leaves them as they are.
        keep_aspect_ratio: one side alone is of this size: that which changes the image less.
        multiple: sides are multiples of it.
        mode: of the interpolation.
        mean: subtracted from colours in [0, 1].
        std: they are divided by afterwards.
        unit: of the colours, before mean and std: 1, or 255 for those that are not rescaled.
    """

    size: tuple[int, int] | None
    keep_aspect_ratio: bool
    multiple: int
    mode: str
    mean: tuple[float, ...]
    std: tuple[float, ...]
    unit: float

    @classmethod
    def read(cls, file: Path) -> Preparation:
        """From a `preprocessor_config.json`.

        Raises:
            WeightsError: when it cannot be read, or asks for what is not known here.
        """
        found = _json(file)
        try:
            size = found.get("size", {"height": 384, "width": 384})
            size = {"height": size, "width": size} if isinstance(size, int) else size
            normalised = bool(found.get("do_normalize", True))
            rescaled = bool(found.get("do_rescale", True))
            factor = 255 * float(found.get("rescale_factor", 1 / 255))
            if found.get("do_pad", False):
                raise ValueError("do_pad is not supported")
            return cls(
                size=(int(size["height"]), int(size["width"])) if found.get("do_resize", True) else None,
                keep_aspect_ratio=bool(found.get("keep_aspect_ratio", False)),
                multiple=int(found.get("ensure_multiple_of", 1)),
                mode=MODES[int(found.get("resample", 3))],
                mean=tuple(map(float, found["image_mean"])) if normalised else (0.0, 0.0, 0.0),
                std=tuple(map(float, found["image_std"])) if normalised else (1.0, 1.0, 1.0),
                unit=factor if rescaled else 255.0,
            )
        except (KeyError, TypeError, ValueError) as error:
            raise WeightsError(f"{file}: not a preprocessor that is known here ({error!r})") from error

    def target(self, height: int, width: int) -> tuple[int, int]:
        """Height and width that an image is resized to."""
        if self.size is None:
            return height, width
        by_height, by_width = self.size[0] / height, self.size[1] / width
        if self.keep_aspect_ratio:
            by_height = by_width = min(by_height, by_width, key=lambda factor: abs(1 - factor))
        sides = (factor * side for factor, side in ((by_height, height), (by_width, width)))
        rows, columns = (max(1, round(side / self.multiple)) * self.multiple for side in sides)
        return rows, columns

    def __call__(self, rgb: Float[Tensor, "3 h w"]) -> Float[Tensor, "1 3 height width"]:
        """The network's input from an image with colours in [0, 1]."""
        image, target = rgb[None], self.target(*rgb.shape[1:])
        if image.shape[2:] != target:
            smooth: dict[str, bool] = (
                {} if self.mode == "nearest" else {"align_corners": False, "antialias": True}
            )
            image = functional.interpolate(image, size=target, mode=self.mode, **smooth).clamp(0, 1)
        mean, std = (image.new_tensor(values)[:, None, None] for values in (self.mean, self.std))
        return (self.unit * image - mean) / std


@dataclass(frozen=True)
class MonocularNetwork:
    """A `MonocularPredictor` from a saved model of transformers.

    Args:
        model: it.
        preparation: how it wants its images.
        gives_depth: its output is depth, not inverse depth up to scale and shift.
    """

    model: Any
    preparation: Preparation
    gives_depth: bool

    @torch.no_grad()
    def inverse_depth(self, rgb: Float[Tensor, "3 h w"]) -> Float[Tensor, "h w"]:
        """Inverse depth up to scale and shift, of a frame with colours in [0, 1] on the model's device."""
        found = self.model(pixel_values=self.preparation(rgb)).predicted_depth.float()
        if self.gives_depth:
            found = 1 / found.clamp_min(NEAREST_SHARE * found.median().clamp_min(1e-6))
        enlarged = functional.interpolate(
            found[:, None], size=rgb.shape[1:], mode="bilinear", align_corners=False
        )
        return enlarged[0, 0]


def find_monocular(setting: str) -> Path:
    """The folder of a saved model.

    Raises:
        WeightsError: when it is not there, not whole, or another kind of model.
        MissingDependencyError: without transformers.
    """
    if importlib.util.find_spec("transformers") is None:
        raise MissingDependencyError(
            f"depth.monocular needs transformers: not installed. Install with: {INSTALL}"
        )
    folder = expanded(setting)
    said = f"depth.monocular={setting}"
    if not folder.is_dir():
        raise WeightsError(
            f"{said}: there is no such folder; expected one that holds {CONFIG}, {PREPROCESSOR} and "
            f"{WEIGHTS} of a monocular depth network. Nothing is downloaded"
        )
    for name in (CONFIG, PREPROCESSOR):
        if not (folder / name).is_file():
            raise WeightsError(f"{said}: {folder} holds no {name}")
    lacking = lacking_weights(folder, WEIGHTS)
    if lacking is not None:
        raise WeightsError(
            f"{said}: {folder} is not whole, {lacking} (weights are read from .safetensors alone)"
        )
    named = _json(folder / CONFIG).get("architectures") or ["no architecture"]
    if named[0] not in ARCHITECTURES:
        raise WeightsError(
            f"{said}: {folder / CONFIG} names {named[0]}; expected one of {', '.join(ARCHITECTURES)}"
        )
    Preparation.read(folder / PREPROCESSOR)
    return folder


def monocular_digest(setting: str | None) -> str | None:
    """Digest of a saved model, independent of its path; None for None.

    Raises:
        ExtragsError: as `find_monocular`.
    """
    return None if setting is None else fingerprint(find_monocular(setting))


def load_monocular(setting: str, device: torch.device) -> MonocularNetwork:
    """The network, ready to use.

    Raises:
        WeightsError: as `find_monocular`, or when files do not fit each other.
        MissingDependencyError: without transformers.
    """
    folder = find_monocular(setting)
    logging = importlib.import_module("transformers.utils.logging")
    automatic = importlib.import_module("transformers").AutoModelForDepthEstimation
    shown = logging.is_progress_bar_enabled()
    logging.disable_progress_bar()
    try:
        model, info = automatic.from_pretrained(
            str(folder),
            local_files_only=True,
            use_safetensors=True,
            trust_remote_code=False,
            dtype=torch.float32,
            output_loading_info=True,
        )
    except (OSError, ValueError, TypeError, KeyError, RuntimeError) as error:
        raise WeightsError(
            f"depth.monocular={setting}: {folder} cannot be loaded: {reason_of(error)}"
        ) from error
    finally:
        if shown:
            logging.enable_progress_bar()
    # What a file lacks would be random numbers.
    absent = [*info["missing_keys"], *info.get("mismatched_keys", ())]
    if absent:
        raise WeightsError(
            f"depth.monocular={setting}: the weights in {folder} lack {len(absent)} tensors of the network, "
            f"{absent[0]} among them"
        )
    kind = getattr(model.config, "depth_estimation_type", "relative")
    return MonocularNetwork(
        model.to(device).eval(), Preparation.read(folder / PREPROCESSOR), gives_depth=kind == "metric"
    )


def _json(file: Path) -> dict[str, Any]:
    try:
        found = json.loads(file.read_text(encoding="utf-8"))
    except (OSError, ValueError) as error:
        raise WeightsError(f"{file}: not readable as JSON ({reason_of(error)})") from error
    if not isinstance(found, dict):
        raise WeightsError(f"{file}: expected a JSON object")
    return found
