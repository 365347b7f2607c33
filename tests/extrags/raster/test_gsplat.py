"""What is put round gsplat: the light as a function of torch, and the outputs that it has not.

gsplat's own kernels need a GPU; where there is none the reference stands in for them. It gets what gsplat
would get, and nothing of the light but the colours.
"""

from __future__ import annotations

from typing import Any

import pytest
import torch
from torch import Tensor

from extrags.errors import ConfigError
from extrags.radial_lens import RadialLens
from extrags.raster import CameraLight, available_backends, rasterize
from extrags.raster.gsplat import rasterize_gsplat
from extrags.raster.reference import rasterize_reference
from extrags.raster.rendering import DILATION_PX2, RasterInputs, RasterOptions, checked_inputs
from tests.extrags.raster.scenes import RasterScene, relative_l2, tube, weighted_sum
from tests.extrags.raster.test_light import LEARNED, a_light

SCENES = [
    pytest.param(tube(300, 41, 33, cameras=2), id="degree3-two-cameras"),
    pytest.param(tube(200, 40, 30, sh_degree=0), id="degree0"),
    pytest.param(tube(200, 40, 30, sh_degree=None, cameras=3, colors_per_camera=True), id="colors"),
]


def stand_in(**given: Any) -> tuple[Tensor, Tensor, dict[str, Tensor]]:
    """`gsplat.rasterization`, as far as it is used here, by the reference."""
    assert given["eps2d"] == DILATION_PX2
    assert given["render_mode"] == "RGB+ED"
    harmonics = given["sh_degree"] is not None
    inputs = RasterInputs(
        given["means"],
        given["quats"],
        given["scales"],
        given["opacities"],
        given["colors"] if harmonics else None,
        None if harmonics else given["colors"],
        given["viewmats"],
        given["Ks"],
        given["backgrounds"],
        None,
    )
    options = RasterOptions(
        given["width"],
        given["height"],
        given["sh_degree"] or 0,
        given["near_plane"],
        median_depth=False,
        visibility=False,
        absgrad=False,
    )
    found = rasterize_reference(inputs, options)
    images = torch.cat([found.rgb, found.depth[..., None]], -1)
    radii = found.radius_px.ceil().to(torch.int32)[..., None].expand(-1, -1, 2)
    return images, found.alpha[..., None], {"means2d": found.means2d, "radii": radii}


def inputs_of(scene: RasterScene, light: CameraLight | None) -> tuple[RasterInputs, RasterOptions]:
    named = dict(vars(scene))
    inputs = RasterInputs(
        named["means"],
        named["quats"],
        named["scales"],
        named["opacities"],
        named.get("sh"),
        named.get("colors"),
        named["viewmats"],
        named["Ks"],
        named.get("background"),
        None,
        None if light is None else light.packed(),
    )
    inputs, degree = checked_inputs(inputs, scene.width, scene.height, 0.01, None)
    options = RasterOptions(
        scene.width, scene.height, degree, 0.01, median_depth=True, visibility=True, absgrad=False
    )
    return inputs, options


@pytest.mark.parametrize("scene", SCENES)
@pytest.mark.parametrize("lit", [True, False], ids=["lit", "unlit"])
def test_the_light_round_it_is_ours(scene: RasterScene, lit: bool, monkeypatch: pytest.MonkeyPatch) -> None:
    """Images and gradients, of the light as well, against the native kernels, which have the light inside."""
    monkeypatch.setattr("gsplat.rasterization", stand_in)
    found = scene.to(torch.float64, gradients=True)
    light = a_light(len(scene.viewmats), torch.float64, gradients=True) if lit else None
    # Medians and blending weights come from the native kernels, in their single precision.
    inputs, options = inputs_of(found, light)
    with pytest.MonkeyPatch.context() as plain:
        plain.setattr("extrags.raster.gsplat.native_isa", lambda: None)
        rendering = rasterize_gsplat(inputs, options)
    weighted_sum(rendering).backward()

    expected = scene.to(torch.float32, gradients=True)
    ours = a_light(len(scene.viewmats), torch.float32, gradients=True) if lit else None
    native = expected.render("native", light=ours, median_depth=True, visibility=True)
    weighted_sum(native).backward()
    for name in ("rgb", "alpha", "depth"):
        assert relative_l2(getattr(native, name), getattr(rendering, name)) < 1e-5, name
    for name in ("median_depth", "visibility_max", "visibility_sum"):
        assert relative_l2(getattr(native, name), getattr(rendering, name)) < 1e-4, name
    for (name, leaf), (_, other) in zip(found.leaves(), expected.leaves(), strict=True):
        assert leaf.grad is not None
        assert other.grad is not None
        assert relative_l2(other.grad, leaf.grad) < 1e-3, name
    if light is not None and ours is not None:
        for name in LEARNED:
            assert relative_l2(getattr(ours, name).grad, getattr(light, name).grad) < 1e-3, name


@pytest.mark.gpu
@pytest.mark.skipif("gsplat" not in available_backends(), reason="no CUDA device with gsplat on this machine")
@pytest.mark.parametrize("scene", SCENES)
def test_gradients_under_a_light_on_a_gpu(scene: RasterScene) -> None:
    grads = []
    for device, backend in (("cpu", "native"), ("cuda", "gsplat")):
        moved = {k: v.to(device) if isinstance(v, Tensor) else v for k, v in vars(scene).items()}
        leaves = RasterScene(**moved).to(torch.float32, gradients=True)
        values = a_light(len(scene.viewmats), torch.float32)
        learned = {name: getattr(values, name).to(device).requires_grad_() for name in LEARNED}
        light = CameraLight(**learned, reference_distance=values.reference_distance)
        rendering = leaves.render(backend, light=light)
        (weighted_sum(rendering) if device == "cpu" else weighted_sum_there(rendering)).backward()
        found = {name: leaf.grad for name, leaf in leaves.leaves()}
        grads.append(found | {name: value.grad for name, value in learned.items()})
    for name, expected in grads[0].items():
        assert expected is not None
        assert grads[1][name] is not None
        assert relative_l2(grads[1][name].cpu(), expected) < 1e-3, name


def weighted_sum_there(rendering: Any) -> Tensor:
    """`weighted_sum` of a rendering on another device: carried to the processor, the graph with it."""
    here = {k: v.cpu() if isinstance(v, Tensor) else v for k, v in vars(rendering).items()}
    return weighted_sum(type(rendering)(**here))


def test_a_lens_is_refused_by_name() -> None:
    scene = tube(5, 8, 8, sh_degree=0).to(torch.float32)
    inputs, options = inputs_of(scene, None)
    lens = RadialLens((0.0, 0.0, 0.0, 0.0), 1.2)
    with pytest.raises(ConfigError, match=r"ingest\.lens=pinhole"):
        rasterize_gsplat(inputs, RasterOptions(**{**vars(options), "lens": lens}))


def test_a_processor_s_tensors_are_refused_by_name() -> None:
    scene = tube(5, 8, 8, sh_degree=0).to(torch.float32)
    with pytest.raises(ConfigError, match=r"gsplat takes float32 CUDA tensors, got torch\.float32 on cpu"):
        rasterize(
            scene.means, scene.quats, scene.scales, scene.opacities, scene.sh, scene.viewmats, scene.Ks, 8, 8,
            backend="gsplat",
        )  # fmt: skip
