"""Plane-sweep stereo in the frustum of any view: depth and its uncertainty from the views around it.

A two-level cascade. On each level features of the source views are warped to depth hypotheses of the target
view; where the hypothesis is right they agree, so their variance is the matching cost. The coarse level
spans the whole range of depth, the fine one the interval that the coarse one leaves uncertain.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import cast

import numpy as np
import torch
from jaxtyping import Bool, Float
from torch import Tensor, nn
from torch.nn import functional

from extrags.cameras import Cameras
from extrags.config import UcNerfConfig

__all__ = [
    "DepthPrior",
    "EncodedViews",
    "PosedImages",
    "StereoNetwork",
    "camera_tensors",
    "depth_distribution",
    "image_grid",
    "inside_mask",
    "locally_normalised",
    "plane_sweep",
    "projection_to_views",
    "variance_cost",
]

FEATURES = 8
"""Channels of the learned features, and of the regularised volume."""
_NORMALISING_WINDOW_PX = 7
_MIN_CONTRAST = 0.01
"""Standard deviation of grey below which a window counts as untextured: two levels of 256."""
_UNMATCHED_COST = 1.0
"""Cost of a hypothesis that fewer than two views see: that of unrelated patches of unit variance."""
_START_SHARPNESS = 8.0
_WHOLE = 0.999
"""Share of a mask from which a place counts as wholly inside; the rest is rounding."""
_FINE_DEVIATIONS = 2.0
"""Half the fine interval, in standard deviations of the coarse distribution."""


def camera_tensors(cameras: Cameras) -> tuple[Float[Tensor, "v 3 3"], Float[Tensor, "v 4 4"]]:
    """Intrinsics and world-to-camera matrices in float32."""
    return (
        torch.from_numpy(cameras.K.astype(np.float32)),
        torch.from_numpy(cameras.viewmats.astype(np.float32)),
    )


@dataclass(frozen=True)
class PosedImages:
    """Images with their cameras, as tensors.

    Args:
        rgb: colours in [0, 1], [V, 3, H, W].
        K: intrinsics in pixels, [V, 3, 3].
        viewmats: camera from world, [V, 4, 4].
        mask: pixels that show tissue; the others match nothing and lend no colour. None is all.
    """

    rgb: Float[Tensor, "v 3 h w"]
    K: Float[Tensor, "v 3 3"]
    viewmats: Float[Tensor, "v 4 4"]
    mask: Bool[Tensor, "v h w"] | None = None

    @staticmethod
    def of(rgb: np.ndarray, cameras: Cameras, mask: np.ndarray | None = None) -> PosedImages:
        """Frames, uint8 [V, H, W, 3], black outside their masks, [V, H, W]; and their cameras."""
        colors = torch.from_numpy(rgb.astype(np.float32) / 255).permute(0, 3, 1, 2).contiguous()
        if mask is None or mask.all():
            return PosedImages(colors, *camera_tensors(cameras))
        counted = torch.from_numpy(mask)
        return PosedImages(colors * counted[:, None], *camera_tensors(cameras), counted)

    def __len__(self) -> int:
        return int(self.rgb.shape[0])

    def __getitem__(self, index: list[int]) -> PosedImages:
        mask = None if self.mask is None else self.mask[index]
        return PosedImages(self.rgb[index], self.K[index], self.viewmats[index], mask)

    def resized(self, width: int, height: int) -> PosedImages:
        """The same views at another size, averaged over areas; intrinsics are scaled."""
        h, w = self.rgb.shape[-2:]
        if (w, h) == (width, height):
            return self
        rgb = functional.interpolate(self.rgb, (height, width), mode="area")
        K = _scaled(self.K, width / w, height / h)
        return PosedImages(rgb, K, self.viewmats, self.resized_mask(width, height))

    def resized_mask(self, width: int, height: int) -> Bool[Tensor, "v h2 w2"] | None:
        """The masks at another size: true where all that is averaged over is inside; None is all."""
        if self.mask is None or self.mask.shape[-2:] == (height, width):
            return self.mask
        share = functional.interpolate(self.mask[:, None].float(), (height, width), mode="area")
        return share[:, 0] > _WHOLE


@dataclass(frozen=True)
class EncodedViews:
    """Source views with what the network sees in them.

    Args:
        images: at full size.
        coarse: learned and hand-crafted features on the coarse level, [V, 1 + F, h, w].
        fine: the same on the fine level, [V, 1 + F, 2h, 2w].
    """

    images: PosedImages
    coarse: Float[Tensor, "v f h w"]
    fine: Float[Tensor, "v f h2 w2"]

    def __getitem__(self, index: list[int]) -> EncodedViews:
        return EncodedViews(self.images[index], self.coarse[index], self.fine[index])


@dataclass(frozen=True)
class DepthPrior:
    """Inverse depth of a view as the stereo sees it.

    Args:
        inverse: expected inverse z-depth, [H, W].
        deviation: its standard deviation under the distribution over hypotheses, [H, W].
        uncertainty: entropy of the distribution, from 0 (certain) to 1 (all hypotheses alike), [H, W].
        coarse_inverse: expected inverse z-depth on the coarse level, [h, w].
        volume: regularised features of the coarse cost volume, first hypothesis farthest, [F, D, h, w].
    """

    inverse: Float[Tensor, "h w"]
    deviation: Float[Tensor, "h w"]
    uncertainty: Float[Tensor, "h w"]
    coarse_inverse: Float[Tensor, "h2 w2"]
    volume: Float[Tensor, "f d h2 w2"]

    def detached(self) -> DepthPrior:
        """A copy without gradient history."""
        return replace(self, **{name: value.detach() for name, value in vars(self).items()})


def projection_to_views(
    K: Float[Tensor, "3 3"],
    viewmat: Float[Tensor, "4 4"],
    source_K: Float[Tensor, "n 3 3"],
    source_viewmats: Float[Tensor, "n 4 4"],
) -> tuple[Float[Tensor, "n 3 3"], Float[Tensor, "n 3"]]:
    """`A` and `b` such that pixel (u, v) at z-depth z lies at the homogeneous pixel `z A (u, v, 1) + b`.

    Args:
        K: intrinsics of the target view.
        viewmat: camera from world of the target view.
        source_K: intrinsics of the source views.
        source_viewmats: camera from world of the source views.
    """
    rotation, translation = viewmat[:3, :3], viewmat[:3, 3]
    relative = source_viewmats[:, :3, :3] @ rotation.T
    shift = source_viewmats[:, :3, 3] - relative @ translation
    return source_K @ relative @ torch.linalg.inv(K), (source_K @ shift[..., None])[..., 0]


def plane_sweep(
    features: Float[Tensor, "n f hs ws"],
    source_K: Float[Tensor, "n 3 3"],
    source_viewmats: Float[Tensor, "n 4 4"],
    K: Float[Tensor, "3 3"],
    viewmat: Float[Tensor, "4 4"],
    inverse: Float[Tensor, "d h w"],
    mask: Bool[Tensor, "n hs ws"] | None = None,
) -> tuple[Float[Tensor, "n f d h w"], Bool[Tensor, "n d h w"]]:
    """Source features as seen in the target view if its surface lay at each depth hypothesis.

    Args:
        features: of the source views.
        source_K: their intrinsics, in pixels of the features.
        source_viewmats: camera from world of the source views.
        K: intrinsics of the target view, in pixels of the hypotheses.
        viewmat: camera from world of the target view.
        inverse: inverse z-depth of the hypotheses of each pixel.
        mask: pixels of the source views that count; None is all.

    Returns:
        Features, bilinearly interpolated, and where they are from inside the source image and its mask.
    """
    d, h, w = inverse.shape
    A, b = projection_to_views(K, viewmat, source_K, source_viewmats)
    v, u = torch.meshgrid(torch.arange(h) + 0.5, torch.arange(w) + 0.5, indexing="ij")
    pixels = torch.stack([u, v, torch.ones_like(u)]).to(inverse.dtype).reshape(3, -1)
    # Scaled by the inverse depth: finite for points at infinity, and the sign of z stays.
    homogeneous = (A @ pixels)[:, :, None] + b[:, :, None, None] * inverse.reshape(1, 1, d, -1)
    grid, valid = image_grid(homogeneous.movedim(1, -1), features.shape[-1], features.shape[-2])
    warped = functional.grid_sample(features, grid, padding_mode="border", align_corners=False)
    valid = inside_mask(valid, grid, mask)
    return warped.reshape(*warped.shape[:2], d, h, w), valid.reshape(-1, d, h, w)


def image_grid(
    homogeneous: Float[Tensor, "n *p 3"], width: int, height: int
) -> tuple[Float[Tensor, "n *p 2"], Bool[Tensor, "n *p"]]:
    """Homogeneous pixels as positions for `grid_sample`, and whether they are in front and in the image."""
    z = homogeneous[..., 2]
    pixels = homogeneous[..., :2] / z.clamp_min(1e-9)[..., None]
    grid = pixels * pixels.new_tensor([2 / width, 2 / height]) - 1
    valid = (z > 1e-9) & (grid.abs() <= 1).all(dim=-1)
    # Far outside the image float32 positions overflow the integers of the interpolation.
    return grid.clamp(-2, 2), valid


def inside_mask(
    valid: Bool[Tensor, "n *p"], grid: Float[Tensor, "n *p 2"], mask: Bool[Tensor, "n h w"] | None
) -> Bool[Tensor, "n *p"]:
    """Which valid positions of `image_grid` are interpolated from pixels inside the masks alone."""
    if mask is None:
        return valid
    places = grid.reshape(len(grid), 1, -1, 2)
    share = functional.grid_sample(
        mask[:, None].to(grid.dtype), places, padding_mode="border", align_corners=False
    )
    return valid & (share.reshape(valid.shape) > _WHOLE)


def variance_cost(
    warped: Float[Tensor, "n f d h w"], valid: Bool[Tensor, "n d h w"]
) -> tuple[Float[Tensor, "f d h w"], Float[Tensor, "d h w"]]:
    """Variance of the warped features over the views that see the hypothesis, and the share that do.

    Source: Yao et al.: MVSNet: Depth Inference for Unstructured Multi-view Stereo, ECCV 2018, eq. 2.
    """
    weight = valid[:, None].to(warped.dtype)
    count = weight.sum(dim=0).clamp_min(1)
    mean = (warped * weight).sum(dim=0) / count
    variance = ((warped - mean).square() * weight).sum(dim=0) / count
    return variance, weight.mean(dim=0)[0]


def depth_distribution(
    logits: Float[Tensor, "d h w"], inverse: Float[Tensor, "d h w"]
) -> tuple[Float[Tensor, "h w"], Float[Tensor, "h w"], Float[Tensor, "h w"]]:
    """Mean, standard deviation and normalised entropy of the softmax over depth hypotheses.

    Args:
        logits: score of each hypothesis.
        inverse: inverse z-depth of each hypothesis.

    Source: Kendall et al.: End-to-End Learning of Geometry and Context for Deep Stereo Regression, ICCV 2017
    (the mean); Cheng et al.: Deep Stereo Using Adaptive Thin Volume Representation with Uncertainty
    Awareness, CVPR 2020 (the variance).
    """
    log_probability = torch.log_softmax(logits, dim=0)
    probability = log_probability.exp()
    mean = (probability * inverse).sum(dim=0)
    variance = (probability * (inverse - mean).square()).sum(dim=0)
    entropy = -(probability * log_probability).sum(dim=0) / np.log(len(logits))
    return mean, (variance + 1e-12).sqrt(), entropy


def locally_normalised(
    rgb: Float[Tensor, "v 3 h w"], mask: Bool[Tensor, "v h w"] | None = None
) -> Float[Tensor, "v 1 h w"]:
    """Grey with the mean of its window subtracted, divided by its standard deviation.

    The lamp moves with the camera, so a surface point differs in brightness from view to view: only what is
    invariant to gain and offset can be matched.

    Args:
        rgb: colours.
        mask: pixels that count in the windows; others are 0 in the result. None is all.
    """
    grey = rgb.mean(dim=1, keepdim=True)
    pad = _NORMALISING_WINDOW_PX // 2

    def pooled(image: Tensor) -> Tensor:
        return functional.avg_pool2d(
            image, _NORMALISING_WINDOW_PX, stride=1, padding=pad, count_include_pad=False
        )

    if mask is None:
        centred = grey - pooled(grey)
        return centred / (pooled(centred.square()) + _MIN_CONTRAST**2).sqrt()
    inside = mask[:, None].to(grey.dtype)
    share = pooled(inside).clamp_min(1e-6)
    centred = (grey - pooled(grey * inside) / share) * inside
    return centred / (pooled(centred.square()) / share + _MIN_CONTRAST**2).sqrt()


class _Regulariser(nn.Module):
    """From learned variances, hand-crafted cost and share of views to a feature volume and a logit.

    A convolution in three dimensions as one within the planes and one across them: on a processor torch has
    fast kernels for two dimensions alone.

    Source: Tran et al.: A Closer Look at Spatiotemporal Convolutions for Action Recognition, CVPR 2018.
    """

    def __init__(self) -> None:
        super().__init__()
        self.within = nn.Conv2d(FEATURES + 2, FEATURES, 3, padding=1)
        self.across = nn.Conv2d(3 * FEATURES, FEATURES, 1)
        self.out = nn.Conv2d(FEATURES, FEATURES + 1, 3, padding=1)
        with torch.no_grad():
            # The logit starts as the hand-crafted cost alone.
            self.out.weight[-1].zero_()
            cast("Tensor", self.out.bias)[-1].zero_()

    def forward(self, volume: Float[Tensor, "f d h w"]) -> Float[Tensor, "g d h w"]:
        planes = functional.relu(self.within(volume.movedim(0, 1)))
        before, after = torch.cat([planes[:1], planes[:-1]]), torch.cat([planes[1:], planes[-1:]])
        mixed = functional.relu(self.across(torch.cat([before, planes, after], dim=1)))
        return cast("Tensor", self.out(mixed)).movedim(1, 0)


class StereoNetwork(nn.Module):
    """The cascade: learned features and a learned regulariser on top of a hand-crafted matching cost.

    The published network is pre-trained on many scenes. Without its weights the two learned parts start from
    nothing, on the frames of one scene: so the logits start as the negative variance of the locally
    normalised grey, and what the regulariser adds to them starts at zero.
    """

    def __init__(self, config: UcNerfConfig) -> None:
        super().__init__()
        self.stereo_width = config.stereo_width
        self.planes = (config.coarse_planes, config.fine_planes)
        self.encoders = nn.ModuleList(
            nn.Sequential(nn.Conv2d(4, 16, 3, padding=1), nn.ReLU(), nn.Conv2d(16, FEATURES, 3, padding=1))
            for _ in range(2)
        )
        self.regularisers = nn.ModuleList(_Regulariser() for _ in range(2))
        self.log_sharpness = nn.Parameter(torch.full((2,), float(np.log(_START_SHARPNESS))))

    def encode(self, images: PosedImages) -> EncodedViews:
        """Features of the views on both levels."""
        h, w = images.rgb.shape[-2:]
        levels = []
        for level, encoder in enumerate(self.encoders):
            width = min(w, self.stereo_width << level)
            small = images.resized(width, max(2, round(h * width / w)))
            grey = locally_normalised(small.rgb, small.mask)
            levels.append(torch.cat([grey, encoder(torch.cat([small.rgb, grey], dim=1))], dim=1))
        return EncodedViews(images, *levels)

    def forward(
        self,
        views: EncodedViews,
        K: Float[Tensor, "3 3"],
        viewmat: Float[Tensor, "4 4"],
        inverse_range: tuple[float, float],
        width: int,
        height: int,
    ) -> DepthPrior:
        """Depth of a view, of which only the camera is used.

        Args:
            views: the source views.
            K: intrinsics of the target view.
            viewmat: camera from world of the target view.
            inverse_range: inverse z-depth of the farthest and the nearest hypothesis.
            width: width of the target view in pixels.
            height: height of the target view in pixels.
        """
        far, near = inverse_range
        size = width, height
        h, w = views.coarse.shape[-2:]
        coarse = torch.linspace(far, near, self.planes[0], dtype=K.dtype)[:, None, None].expand(-1, h, w)
        logits, volume = self._level(0, views, views.coarse, K, viewmat, coarse, size)
        coarse_mean, coarse_deviation, coarse_entropy = depth_distribution(logits, coarse)

        h, w = views.fine.shape[-2:]
        spacing = (near - far) / (self.planes[0] - 1)
        stacked = torch.stack([coarse_mean, coarse_deviation, coarse_entropy])[None]
        mean, deviation, entropy = functional.interpolate(
            stacked, (h, w), mode="bilinear", align_corners=False
        )[0]
        half = (_FINE_DEVIATIONS * deviation).clamp_min(spacing).detach()
        steps = torch.linspace(-1, 1, self.planes[1], dtype=K.dtype)[:, None, None]
        fine = (mean.detach() + steps * half).clamp(far, near)
        logits, _ = self._level(1, views, views.fine, K, viewmat, fine, size)
        fine_mean, fine_deviation, fine_entropy = depth_distribution(logits, fine)
        return DepthPrior(fine_mean, fine_deviation, (entropy + fine_entropy) / 2, coarse_mean, volume)

    def _level(
        self,
        level: int,
        views: EncodedViews,
        features: Tensor,
        K: Tensor,
        viewmat: Tensor,
        inverse: Tensor,
        size: tuple[int, int],
    ) -> tuple[Tensor, Tensor]:
        images = views.images
        height, width = features.shape[-2:]
        source_K = _scaled(images.K, width / images.rgb.shape[-1], height / images.rgb.shape[-2])
        target_K = _scaled(K, width / size[0], height / size[1])
        mask = images.resized_mask(width, height)
        warped, valid = plane_sweep(features, source_K, images.viewmats, target_K, viewmat, inverse, mask)
        variance, share = variance_cost(warped, valid)
        # One view always agrees with itself.
        matched = valid.sum(dim=0) >= 2
        cost = torch.where(matched, variance[0], _UNMATCHED_COST)
        cost = functional.avg_pool2d(cost[None], 3, stride=1, padding=1, count_include_pad=False)[0]
        learned = torch.where(matched, variance[1:], 0.0)
        volume = self.regularisers[level](torch.cat([learned, cost[None], share[None]]))
        return volume[-1] - self.log_sharpness[level].exp() * cost, volume[:-1]


def _scaled(K: Tensor, across: float, down: float) -> Tensor:
    return K * K.new_tensor([across, down, 1.0])[:, None]
