"""Confidence of restored views, the weight they have in fine-tuning: per image and per pixel.

Both are computed once, from the coarse scene, and stored with the pseudo-views.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Bool, Float
from torch import Tensor

from extrags.config import DEFAULT_PROFILE, PROFILES, EvaluateConfig, IouSet
from extrags.errors import ShapeError, WeightsError
from extrags.metrics.lpips import MIN_SIDE_PX, Lpips
from extrags.metrics.perceptual import perceptual_map
from extrags.threads import in_threads

__all__ = ["PerceptualDifference", "gaussian_iou", "image_confidence", "pixel_confidence"]

LPIPS_SCALE = 0.25
"""LPIPS at which the confidence reaches 1 - 1/e. Strong local changes have an LPIPS of 0.3 to 1."""
VIEWS_AT_ONCE = 4


def gaussian_iou(
    virtual: Bool[Tensor, "v n"], reference: Bool[Tensor, "v n"], over: IouSet = "reference"
) -> Float[Tensor, "v"]:
    r"""Share of the Gaussians seen by a reference view that the virtual view also sees.

    .. math:: GIOU = |vis(V) \cap vis(ref)| / |vis(ref)|

    Visibility is taken from blending weights, so occluded Gaussians do not count. The published code of
    [ExtraGS] and [Kim2025] divides by :math:`|vis(V) \cup vis(ref)|`: `over="union"`.

    Args:
        virtual: Gaussians seen by each virtual view.
        reference: Gaussians seen by the reference view of each.
        over: the set whose size divides.

    Returns:
        Values in [0, 1]; 0 where that set is empty.

    Raises:
        ShapeError: when the shapes differ.

    Source: [ExtraGS, eq. 20 and 21], see docs/references.md.
    """
    if virtual.shape != reference.shape:
        raise ShapeError(f"visibilities {tuple(virtual.shape)} and {tuple(reference.shape)} do not fit")
    common = (virtual & reference).sum(dim=1)
    whole = reference if over == "reference" else virtual | reference
    return common / whole.sum(dim=1).clamp_min(1)


def image_confidence(
    virtual: Bool[Tensor, "v n"], reference: Bool[Tensor, "v n"], over: IouSet = "reference"
) -> Float[Tensor, "v"]:
    """U_img = 1 - GIOU: the less a virtual view overlaps its reference view, the higher its weight.

    Args:
        virtual: Gaussians seen by each virtual view.
        reference: Gaussians seen by its reference view.
        over: as `gaussian_iou`.

    Raises:
        ShapeError: when the shapes differ.

    Source: [ExtraGS, eq. 22], see docs/references.md.
    """
    return 1 - gaussian_iou(virtual, reference, over)


@dataclass(frozen=True)
class PerceptualDifference:
    """Perceptual difference that U_pixel is computed from: LPIPS, or `perceptual_map` without its weights.

    Args:
        lpips: the metric, or None for `extrags.metrics.perceptual.perceptual_map`, which needs no weights.
        reason: why LPIPS is not used; empty when it is.
        raw: U_pixel is as in the paper: LPIPS itself, without an upper bound, of the rendering and the whole
            restored image instead of the blend of both that `keep_known` makes.

    Raises:
        WeightsError: when it is raw, and there is no LPIPS.
    """

    lpips: Lpips | None
    reason: str = ""
    raw: bool = False

    def __post_init__(self) -> None:
        if self.raw and self.lpips is None:
            raise WeightsError(f"enhance.pixel_confidence=raw is LPIPS itself: {self.reason}")

    @classmethod
    def available(cls, config: EvaluateConfig | None = None) -> PerceptualDifference:
        """LPIPS if its weights can be found, else `perceptual_map`.

        Args:
            config: its first backbone, and optionally where the weights are; None takes those of the profile
                `balanced`.

        Raises:
            WeightsError: when the settings name a file that cannot be used.
        """
        config = PROFILES[DEFAULT_PROFILE].evaluate if config is None else config
        try:
            return cls(Lpips.load(config.lpips_weights, config.lpips_nets[0]))
        except WeightsError as error:
            if config.lpips_weights is not None:
                raise
            return cls(None, str(error))

    def for_images(self, width: int, height: int) -> PerceptualDifference:
        """The measure for images of a size: `perceptual_map`, with the reason, for too small ones.

        Raises:
            ShapeError: when they are, and it is raw.
        """
        if self.lpips is None or min(width, height) >= MIN_SIDE_PX:
            return self
        reason = f"LPIPS needs images of at least {MIN_SIDE_PX} px a side, these have {width} x {height}"
        if self.raw:
            raise ShapeError(f"enhance.pixel_confidence=raw is LPIPS itself: {reason}")
        return PerceptualDifference(None, reason)

    @property
    def name(self) -> str:
        """Name of the measure in the provenance: `lpips_alex`, `raw_lpips_alex` or `perceptual_map`."""
        if self.lpips is None:
            return "perceptual_map"
        return f"raw_{self.lpips.name}" if self.raw else self.lpips.name


def pixel_confidence(
    rendered: Float[np.ndarray, "v h w 3"],
    restored: Float[np.ndarray, "v h w 3"],
    measure: PerceptualDifference,
) -> Float[np.ndarray, "v h w"]:
    r"""U_pixel: perceptual difference between rendered and restored image, per pixel.

    LPIPS d has no upper bound and is mapped to [0, 1] by :math:`1 - e^{-d / 0.25}`, unless the measure is
    `raw`: then it is d itself, as in the paper. `perceptual_map` is in [0, 1] already.

    Args:
        rendered: renderings of the coarse scene in [0, 1].
        restored: the restored images in [0, 1].
        measure: LPIPS or `perceptual_map`.

    Returns:
        Values in [0, 1]; raw LPIPS may exceed one.

    Raises:
        ShapeError: when the images differ in shape, or are too small for the measure.

    Source: [ExtraGS, eq. 23], see docs/references.md; the mapping to [0, 1] is our own.
    """
    if rendered.shape != restored.shape:
        raise ShapeError(f"images {rendered.shape} and {restored.shape} do not fit")

    def confidence(start: int) -> Tensor:
        first = torch.from_numpy(np.ascontiguousarray(rendered[start : start + VIEWS_AT_ONCE]))
        second = torch.from_numpy(np.ascontiguousarray(restored[start : start + VIEWS_AT_ONCE]))
        with torch.no_grad():
            if measure.lpips is None:
                return perceptual_map(first, second).clamp(0, 1)
            distance = measure.lpips.distance_map(first, second)
            return distance if measure.raw else (1 - torch.exp(-distance / LPIPS_SCALE)).clamp(0, 1)

    maps = in_threads(confidence, range(0, len(rendered), VIEWS_AT_ONCE))
    if not maps:
        return np.zeros(rendered.shape[:3], np.float32)
    return np.asarray(torch.cat(maps).numpy(), dtype=np.float32)
