"""The tube of the report's tests as Gaussians under a light at the camera."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch

from extrags.cameras import Cameras, pixel_rays
from extrags.gaussians import Gaussians
from extrags.illumination import NearFieldLight
from extrags.raster.light import shortest_axes
from extrags.report import ReportInputs
from extrags.scene import Scene
from extrags.sequence import EndoscopicSequence


@pytest.fixture(scope="session")
def scene(sequence: EndoscopicSequence) -> Scene:
    """Flat, turned Gaussians on the wall, with harmonics of degree 2 and seven terms of the light in use."""
    frames = sequence.train[[0, 3, 5]]
    depth = sequence.depth_mm[frames]
    cameras = sequence.cameras[frames]
    points = cameras.centers[:, None, None] + depth[..., None] * pixel_rays(cameras)
    points = points.reshape(-1, 3)[::3]
    rgb = sequence.rgb[frames].reshape(-1, 3)[::3] / 255
    radial = points * np.array([0, 1, 1])
    normals = radial / np.linalg.norm(radial, axis=1, keepdims=True)
    gaussians = Gaussians.from_points(
        points, rgb, np.full(len(points), 0.45), opacity=0.8, sh_degree=2, normals=normals, thickness=0.2
    )
    random = torch.Generator().manual_seed(3)
    gaussians = replace(
        gaussians,
        shN=0.05 * torch.randn(gaussians.shN.shape, generator=random),
        opacities=gaussians.opacities + torch.randn(len(gaussians), generator=random),
        scales=gaussians.scales + 0.3 * torch.randn(len(gaussians), 3, generator=random),
    )
    light = replace(
        NearFieldLight.initial(len(sequence.train), 12.0),
        offset=torch.tensor([0.1, -0.05, 0.0]),
        log_exposure=torch.linspace(-0.4, 0.4, len(sequence.train)),
        spread=torch.tensor(1.5),
    )
    return Scene(gaussians, light)


@pytest.fixture(scope="session")
def virtual_cameras(sequence: EndoscopicSequence) -> Cameras:
    """As many as the report's tests have virtual views."""
    return sequence.cameras[np.arange(12) % 11]


@pytest.fixture(scope="session")
def drawn(inputs: ReportInputs, scene: Scene, virtual_cameras: Cameras) -> ReportInputs:
    """The inputs of a report with both scenes; the final one has lost some Gaussians, and knows its sides."""
    kept = scene.gaussians.subset(torch.arange(0, len(scene.gaussians), 2))
    inward = -kept.means * torch.tensor([0, 1, 1])
    facing = (shortest_axes(kept.quats, kept.scales) * inward).sum(dim=1).sign().to(torch.int8)
    facing[::7] = 0
    final = Scene(kept, scene.light, facing)
    return replace(inputs, coarse_scene=scene, final_scene=final, virtual_cameras=virtual_cameras)
