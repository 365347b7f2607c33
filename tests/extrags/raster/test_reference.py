from __future__ import annotations

import math
from dataclasses import replace

import pytest
import torch

from extrags.radial_lens import RadialLens
from extrags.raster import rasterize
from extrags.raster.torch_tiles import rasterize_tiles
from tests.extrags.raster.scenes import RasterScene, tube, weighted_sum


def _one(opacity: float = 0.6, z: float = 2.0, scale: float = 0.3) -> RasterScene:
    """One round red Gaussian straight ahead, its centre on the centre of pixel (5, 4)."""
    return RasterScene(
        means=torch.tensor([[0.0, 0.0, z]], dtype=torch.float64),
        quats=torch.tensor([[2.0, 0.0, 0.0, 0.0]], dtype=torch.float64),
        scales=torch.full((1, 3), scale, dtype=torch.float64),
        opacities=torch.tensor([opacity], dtype=torch.float64),
        sh=None,
        colors=torch.tensor([[1.0, 0.0, 0.0]], dtype=torch.float64),
        viewmats=torch.eye(4, dtype=torch.float64)[None],
        Ks=torch.tensor([[[10.0, 0, 5.5], [0, 10.0, 4.5], [0, 0, 1]]], dtype=torch.float64),
        background=None,
        width=11,
        height=9,
    )


def test_single_gaussian_by_hand() -> None:
    rendering = _one().render("reference")
    # Focal length over depth times scale, squared, plus the low-pass
    variance = (10 / 2.0 * 0.3) ** 2 + 0.3
    for dx, dy in ((0, 0), (1, 0), (-2, 1)):
        expected = 0.6 * math.exp(-0.5 * (dx * dx + dy * dy) / variance)
        assert rendering.alpha[0, 4 + dy, 5 + dx].item() == pytest.approx(expected, rel=1e-12)
        assert rendering.rgb[0, 4 + dy, 5 + dx, 0].item() == pytest.approx(expected, rel=1e-12)
        assert rendering.depth[0, 4 + dy, 5 + dx].item() == pytest.approx(2.0, rel=1e-12)
    extent = math.sqrt(2 * math.log(255 * 0.6) * variance)
    assert rendering.radius_px[0, 0].item() == pytest.approx(extent, rel=1e-12)
    assert rendering.alpha[0, 0, 0].item() == 0  # beyond the 1/255 cut


def test_nearer_gaussian_covers_the_farther() -> None:
    near, far = _one(0.6, z=2.0), _one(0.8, z=4.0)
    # The farther first, to see the sort at work
    both = {
        name: torch.cat([getattr(far, name), getattr(near, name)])
        for name in ("means", "quats", "scales", "opacities")
    }
    colors = torch.tensor([[0.0, 1.0, 0.0], [1.0, 0.0, 0.0]], dtype=torch.float64)
    rendering = rasterize(
        **both,
        sh=None,
        colors=colors,
        viewmats=near.viewmats,
        Ks=near.Ks,
        width=11,
        height=9,
        background=torch.tensor([0.0, 0.0, 1.0], dtype=torch.float64),
        backend="reference",
        median_depth=True,
        visibility=True,
        query_points=torch.tensor([[0.0, 0, 1], [0, 0, 3], [0, 0, 5], [9, 0, 5], [0, 0, -1]]).double(),
    )
    pixel = rendering.rgb[0, 4, 5]
    assert pixel.tolist() == pytest.approx([0.6, 0.4 * 0.8, 0.4 * 0.2], rel=1e-12)
    assert rendering.depth[0, 4, 5].item() == pytest.approx((0.6 * 2 + 0.32 * 4) / 0.92)
    assert rendering.median_depth is not None
    assert rendering.median_depth[0, 4, 5].item() == 2
    assert rendering.median_depth[0, 0, 0].item() == 0
    assert rendering.visibility_max is not None
    assert rendering.visibility_max[0].tolist() == pytest.approx([0.32, 0.6])
    assert rendering.transmittance is not None
    inside, outside = rendering.transmittance[0, :3], rendering.transmittance[0, 3:]
    assert inside.tolist() == pytest.approx([1, 0.4, 0.08])
    assert bool(outside.isnan().all())


def test_opaque_gaussian_stops_at_the_clip() -> None:
    rendering = _one(1.0 - 1e-9).render("reference")
    assert rendering.alpha[0, 4, 5].item() == pytest.approx(0.999)


def test_near_plane_culls() -> None:
    assert bool(_one(z=0.5).render("reference", near=0.49).visible.all())
    assert not bool(_one(z=0.5).render("reference", near=0.51).visible.any())


@pytest.mark.parametrize(("sigma_px", "drawn"), [(0.99e6, True), (1.01e6, False)])
@pytest.mark.parametrize("lens", [None, RadialLens((0.1, 0.0, 0.0, 0.0), 1.0)], ids=["pinhole", "lens"])
def test_what_covers_too_many_pixels_is_culled(sigma_px: float, drawn: bool, lens: RadialLens | None) -> None:
    scene = replace(_one(z=0.02), scales=torch.full((1, 3), sigma_px * 0.02 / 10, dtype=torch.float64))
    for backend, dtype in (("reference", torch.float64), ("native", torch.float32)):
        rendering = scene.to(dtype).render(backend, lens=lens)
        assert bool(rendering.visible.all()) == drawn
        assert bool((rendering.alpha > 0.5).all()) == drawn
    if lens is None:
        given = {name: getattr(scene, name) for name in ("means", "quats", "scales", "opacities")}
        given |= {"sh": torch.zeros(1, 1, 3, dtype=torch.float64), "viewmats": scene.viewmats, "Ks": scene.Ks}
        assert bool((rasterize_tiles(given, 11, 9).alpha > 0.5).all()) == drawn


def test_gradcheck() -> None:
    scene = tube(6, 7, 6, sh_degree=2, seed=4).to(torch.float64)
    names = ("means", "quats", "scales", "opacities", "sh", "viewmats", "background")
    leaves = [getattr(scene, name).clone().requires_grad_() for name in names]
    leaves[2] = (leaves[2].detach() * 0.6).requires_grad_()

    def render(*values: torch.Tensor) -> tuple[torch.Tensor, ...]:
        of = dict(zip(names, values, strict=True))
        rendering = rasterize(
            **{k: of[k] for k in names[:6]},
            Ks=scene.Ks,
            width=scene.width,
            height=scene.height,
            background=of["background"],
            backend="reference",
        )
        return rendering.rgb, rendering.alpha, rendering.depth

    assert torch.autograd.gradcheck(render, leaves, eps=1e-7, atol=1e-6, rtol=1e-4, fast_mode=True)


def test_gradcheck_of_colors_per_camera() -> None:
    scene = tube(5, 6, 5, sh_degree=None, cameras=2, colors_per_camera=True, seed=2).to(torch.float64)
    assert scene.colors is not None
    colors = scene.colors.clone().requires_grad_()

    def render(values: torch.Tensor) -> torch.Tensor:
        return rasterize(
            scene.means,
            scene.quats,
            scene.scales,
            scene.opacities,
            None,
            scene.viewmats,
            scene.Ks,
            scene.width,
            scene.height,
            colors=values,
            backend="reference",
        ).rgb

    assert torch.autograd.gradcheck(render, [colors], fast_mode=True)


def test_gradients_of_the_centres() -> None:
    """Signed: against shifting the principal point; absolute: never smaller, never below the signed."""
    scene = tube(20, 16, 12, seed=1).to(torch.float64, gradients=True)
    rendering = scene.render("reference", absgrad=True)
    weighted_sum(rendering).backward()
    gradient, absolute = rendering.means2d.grad, rendering.means2d.absgrad  # type: ignore[attr-defined]
    assert gradient is not None
    assert bool((absolute >= gradient.abs() - 1e-9).all())
    assert float(absolute.sum()) > float(gradient.abs().sum()) > 0

    def loss(shift: float) -> float:
        K = scene.Ks.clone()
        K[:, 0, 2] += shift
        with torch.no_grad():
            moved = rasterize(
                *(scene.means, scene.quats, scene.scales, scene.opacities, scene.sh, scene.viewmats, K),
                scene.width,
                scene.height,
                background=scene.background,
                backend="reference",
            )
            return float(weighted_sum(moved))

    # The principal point also bounds the Jacobian's field of view: no Gaussian of this scene is out there
    # far enough for a visible effect on the sum.
    slope = (loss(1e-6) - loss(-1e-6)) / 2e-6
    assert float(gradient[..., 0].sum()) == pytest.approx(slope, rel=2e-2)
