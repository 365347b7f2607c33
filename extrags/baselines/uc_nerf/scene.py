"""A scene as the baseline keeps it: the trained networks and the training frames they are conditioned on."""

from __future__ import annotations

import json
from dataclasses import dataclass
from pathlib import Path
from typing import Any, ClassVar

import numpy as np
import torch
from jaxtyping import Bool, Float, UInt8
from torch import Tensor, nn

from extrags.baselines.uc_nerf.field import ConditionedField, RayColors, Rays, sample_depths
from extrags.baselines.uc_nerf.stereo import EncodedViews, PosedImages, StereoNetwork, camera_tensors
from extrags.cameras import Cameras, rotation_angle_deg
from extrags.config import UcNerfConfig
from extrags.store.storable import Storable
from extrags.threads import one_torch_thread
from extrags.zarr_io import new_group, open_group, read_array, write_array, write_frames

__all__ = ["UcNerf", "UcNerfNetwork", "nearest_views"]

RAYS_PER_BATCH = 4096
"""Rays rendered at once; limits the memory."""


class UcNerfNetwork(nn.Module):
    """Stereo and radiance field, trained together."""

    def __init__(self, config: UcNerfConfig) -> None:
        super().__init__()
        self.stereo = StereoNetwork(config)
        self.field = ConditionedField(config)


@dataclass(frozen=True)
class UcNerf(Storable):
    """A radiance field conditioned on multi-view stereo.

    Args:
        network: trained on the frames.
        config: settings the network was made with.
        rgb: colours of the training frames, uint8, [F, H, W, 3].
        mask: their pixels that show tissue, [F, H, W].
        cameras: of these frames.
        inverse_range: inverse z-depth of the far and the near end of rays.
        center: mean camera centre, origin of the position encoding, [3].
        scale: median depth, the field's unit of length.
    """

    stored_as: ClassVar[str] = "uc_nerf"

    network: UcNerfNetwork
    config: UcNerfConfig
    rgb: UInt8[np.ndarray, "f h w 3"]
    mask: Bool[np.ndarray, "f h w"]
    cameras: Cameras
    inverse_range: tuple[float, float]
    center: Float[np.ndarray, "3"]
    scale: float

    def encoded(self) -> EncodedViews:
        """The training frames as source views."""
        with torch.no_grad(), one_torch_thread():
            return self.network.stereo.encode(PosedImages.of(self.rgb, self.cameras, self.mask))

    def render(
        self,
        camera: Cameras,
        encoded: EncodedViews | None = None,
        *,
        color: bool = True,
        leave_out: int | None = None,
    ) -> RayColors:
        """Render one view; the result does not depend on the number of threads.

        Args:
            camera: one camera.
            encoded: from `encoded`, so that several views share it; None computes it.
            color: False: depth and alpha alone.
            leave_out: index of the training frame that is rendered: it is none of its own sources. None: of
                no training frame.

        Returns:
            Values of the pixels, row by row.
        """
        encoded = self.encoded() if encoded is None else encoded
        with torch.no_grad(), one_torch_thread():
            nearest = nearest_views(camera, self.cameras, self.scale).tolist()
            views = encoded[[place for place in nearest if place != leave_out][: self.config.source_views]]
            (K,), (viewmat,) = camera_tensors(camera)
            prior = self.network.stereo(views, K, viewmat, self.inverse_range, camera.width, camera.height)
            v, u = torch.meshgrid(
                torch.arange(camera.height) + 0.5, torch.arange(camera.width) + 0.5, indexing="ij"
            )
            pixels = torch.stack([u, v], dim=-1).reshape(-1, 2)
            center = torch.from_numpy(self.center.astype(np.float32))
            parts = []
            for part in pixels.split(RAYS_PER_BATCH):
                rays = Rays(part, K, viewmat, camera.width, camera.height)
                inverse, deviation = rays.sampled(torch.stack([prior.inverse, prior.deviation]))
                z = sample_depths(
                    inverse,
                    deviation,
                    self.inverse_range,
                    self.config.samples_uniform,
                    self.config.samples_prior,
                )
                parts.append(
                    self.network.field(
                        rays, z, views, prior, self.inverse_range, center, self.scale, color=color
                    )
                )
        return _joined(parts)

    def save(self, path: Path) -> None:
        """Write a zarr v3 group: frames, cameras and the networks' parameters."""
        with new_group(path) as group:
            write_frames(group, "rgb", self.rgb)
            write_frames(group, "mask", self.mask)
            write_array(group, "K", self.cameras.K)
            write_array(group, "world_from_camera", self.cameras.world_from_camera)
            write_array(group, "center", self.center)
            for name, value in self.network.state_dict().items():
                write_array(group, f"network/{name}", value.numpy())
            group.attrs.update(
                {
                    "config": json.loads(self.config.model_dump_json()),
                    "inverse_range": list(self.inverse_range),
                    "scale": self.scale,
                }
            )

    @classmethod
    def load(cls, path: Path) -> UcNerf:
        """Read what `save` wrote."""
        group = open_group(path)
        attributes: dict[str, Any] = dict(group.attrs)
        config = UcNerfConfig.model_validate(attributes["config"])
        network = UcNerfNetwork(config)
        network.load_state_dict(
            {name: torch.from_numpy(read_array(group, f"network/{name}")) for name in network.state_dict()}
        )
        rgb = read_array(group, "rgb")
        cameras = Cameras(
            read_array(group, "K"), read_array(group, "world_from_camera"), rgb.shape[2], rgb.shape[1]
        )
        far, near = attributes["inverse_range"]
        return cls(
            network,
            config,
            rgb,
            read_array(group, "mask"),
            cameras,
            (float(far), float(near)),
            read_array(group, "center"),
            float(attributes["scale"]),
        )


def nearest_views(camera: Cameras, cameras: Cameras, scale: float) -> np.ndarray:
    """Indices of cameras, the most similar to one camera first.

    Dissimilarity is the distance of the centres in units of `scale` plus the angle between the orientations
    in radians: a turn by one radian moves the image about as far as a step by the depth.

    Args:
        camera: one camera.
        cameras: the candidates.
        scale: the median depth.
    """
    distance = np.linalg.norm(cameras.centers - camera.centers[0], axis=1) / scale
    pose = camera.world_from_camera[:1, :3, :3]
    angle = np.deg2rad(
        rotation_angle_deg(np.repeat(pose, len(cameras), 0), cameras.world_from_camera[:, :3, :3])
    )
    return np.argsort(distance + angle, kind="stable")


def _joined(parts: list[RayColors]) -> RayColors:
    def cat(values: list[Tensor]) -> Tensor:
        return torch.cat(values)

    return RayColors(
        None if parts[0].rgb is None else cat([part.rgb for part in parts if part.rgb is not None]),
        cat([part.alpha for part in parts]),
        cat([part.depth for part in parts]),
        cat([part.median_depth for part in parts]),
    )
