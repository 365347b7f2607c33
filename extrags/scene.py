"""A reconstructed scene: Gaussians, and optionally a near-field light model, rendered together."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any, ClassVar

import numpy as np
import torch
from jaxtyping import Float, Int8
from torch import Tensor
from torch.nn import functional

from extrags.arguments import check_argument
from extrags.cameras import Cameras
from extrags.errors import ShapeError
from extrags.gaussians import Gaussians
from extrags.illumination import NearFieldLight
from extrags.raster import CameraLight, Rendering, rasterize
from extrags.store.storable import Storable
from extrags.threads import one_torch_thread
from extrags.zarr_io import group_exists, new_group, open_group, read_array, write_array

__all__ = ["NEAR", "SHALLOWEST", "Scene"]


NEAR = 0.01
"""Depth in world units up to which nothing is rendered; see `Scene.near`."""
SHALLOWEST = 20 * NEAR
"""Typical depth, in world units, below which the near plane would cut off parts of a scene without light."""


@dataclass(frozen=True)
class Scene(Storable):
    """Gaussians, and the near-field light if the scene was reconstructed with one.

    Args:
        gaussians: what the scene is made of.
        light: lamp and exposures; None for colours as they are.
        facing: 1 where a Gaussian's shortest axis points to the side from which it was seen, -1 where it
            points to the other, 0 where it has no sides, [N]; None where nobody knows. Views of evaluation go
            by it (`extrags.facing`), `render` does not.

    Raises:
        ShapeError: for sides of another number of Gaussians.
    """

    stored_as: ClassVar[str] = "scene"

    gaussians: Gaussians
    light: NearFieldLight | None = None
    facing: Int8[Tensor, "n"] | None = None

    def __post_init__(self) -> None:
        if self.facing is not None and self.facing.shape != (len(self.gaussians),):
            raise ShapeError(
                f"facing has shape {tuple(self.facing.shape)}, expected ({len(self.gaussians)},)"
            )

    def __repr__(self) -> str:
        return f"Scene({self.gaussians!r}, {'without' if self.light is None else 'near-field'} light)"

    @property
    def near(self) -> float:
        """z-depth, in world units, up to which nothing is rendered.

        A hundredth of the light's reference distance where that is below one unit: the unit of a model from
        structure from motion is arbitrary. A scene without light has no length of its own.
        """
        return NEAR if self.light is None else NEAR * min(1.0, self.light.reference_distance)

    @property
    def device(self) -> torch.device:
        """Where the scene is, and where it is rendered."""
        return self.gaussians.device

    def to(self, device: torch.device | str) -> Scene:
        """The same scene on a device; this very one where it is there already."""
        if self.device == torch.device(device):
            return self
        light = None if self.light is None else self.light.to(device)
        return Scene(
            self.gaussians.to(device), light, None if self.facing is None else self.facing.to(device)
        )

    @one_torch_thread()
    def render(
        self,
        cameras: Cameras,
        *,
        exposure: Float[Tensor, "c"] | None = None,
        sh_degree: int | None = None,
        viewmats: Float[Tensor, "c 4 4"] | None = None,
        camera_light: CameraLight | None = None,
        **options: Any,
    ) -> Rendering:
        """Render all cameras, on the scene's device.

        Args:
            cameras: the views.
            exposure: gain per camera, on any device; None is the mean exposure of the training frames.
            sh_degree: use spherical harmonics up to this degree only.
            viewmats: world-to-camera matrices that replace those of the cameras; differentiable.
            camera_light: of the cameras, in place of the scene's at these exposures.
            options: further arguments of `extrags.raster.rasterize` (visibility, query_points, ...).

        Returns:
            Renderings of all cameras in one batch.

        Raises:
            TypeError: when `cameras` are none, such as a sequence.
        """
        check_argument(cameras, Cameras, "Scene.render", "cameras")
        degree = self.gaussians.sh_degree
        return self._rasterized(
            cameras,
            self.gaussians.sh,
            viewmats=viewmats,
            sh_degree=degree if sh_degree is None else min(sh_degree, degree),
            light=self._camera_light(len(cameras), exposure) if camera_light is None else camera_light,
            **options,
        )

    @one_torch_thread()
    def render_attributes(
        self, cameras: Cameras, attributes: Float[Tensor, "n k"]
    ) -> tuple[Float[Tensor, "c h w k"], Float[Tensor, "c h w"]]:
        """Alpha-blend arbitrary attributes of the Gaussians instead of colours, without light.

        Args:
            cameras: the views.
            attributes: k values per Gaussian.

        Returns:
            The attributes summed with the blending weights, and alpha, the sum of the weights.
        """
        parts = []
        alpha = torch.zeros(len(cameras), cameras.height, cameras.width, device=self.device)
        for part in attributes.to(self.device).split(3, dim=1):
            colors = functional.pad(part, (0, 3 - part.shape[1]))
            rendering = self._rasterized(cameras, None, colors=colors)
            parts.append(rendering.rgb[..., : part.shape[1]])
            alpha = rendering.alpha
        return torch.cat(parts, dim=-1), alpha

    def _rasterized(
        self,
        cameras: Cameras,
        sh: Float[Tensor, "n k 3"] | None,
        *,
        viewmats: Float[Tensor, "c 4 4"] | None = None,
        **options: Any,
    ) -> Rendering:
        gaussians = self.gaussians
        return rasterize(
            gaussians.means,
            gaussians.quats,
            gaussians.scales.exp(),
            gaussians.opacities.sigmoid(),
            sh,
            self.array(cameras.viewmats) if viewmats is None else viewmats,
            self.array(cameras.K),
            cameras.width,
            cameras.height,
            lens=cameras.lens,
            **{"near": self.near, **options},
        )

    def _camera_light(self, count: int, exposure: Float[Tensor, "c"] | None) -> CameraLight | None:
        gain = torch.ones(count, device=self.device) if exposure is None else exposure.to(self.device)
        if self.light is not None:
            return self.light.camera_light(gain)
        if exposure is None:
            return None
        zero, one = gain.new_zeros(()), gain.new_ones(())
        return CameraLight(gain[:, None].expand(-1, 3), one, zero, zero, zero, gain.new_zeros(3), zero, 1.0)

    def array(self, values: Float[np.ndarray, "*shape"]) -> Float[Tensor, "*shape"]:
        """A copy of an array, such as poses, in the dtype and on the device of the Gaussians."""
        means = self.gaussians.means
        # Rounded on the processor: some devices know no float64.
        return torch.from_numpy(values.astype(np.float64)).to(means.dtype).to(means.device)

    def detached(self) -> Scene:
        """A copy without gradient history."""
        light = None if self.light is None else self.light.detached()
        return Scene(self.gaussians.detached(), light, None if self.facing is None else self.facing.clone())

    def save(self, path: Path) -> None:
        """Write the groups `gaussians` and, where there are some, `light` and `facing`."""
        path.mkdir(parents=True, exist_ok=True)
        self.gaussians.save(path / "gaussians")
        if self.light is not None:
            self.light.save(path / "light")
        if self.facing is not None:
            with new_group(path / "facing") as group:
                write_array(group, "facing", self.facing.cpu().numpy())

    @classmethod
    def load(cls, path: Path) -> Scene:
        """Read what `save` wrote."""
        light = NearFieldLight.load(path / "light") if group_exists(path / "light") else None
        facing = None
        if group_exists(path / "facing"):
            facing = torch.from_numpy(read_array(open_group(path / "facing"), "facing"))
        return cls(Gaussians.load(path / "gaussians"), light, facing)
