from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch
from jaxtyping import Float
from torch import Tensor

from extrags.cameras import Cameras, pixel_rays, pose_distances
from extrags.illumination import NearFieldLight
from extrags.view_synthesis.references import LightTransfer, ReferenceViews
from extrags.view_synthesis.warp import (
    covisibility,
    depth_normals,
    fit_falloff_exponent,
    seen_by_others,
    warp_references,
)
from tests.extrags.lit_tube import cast_tube, exact_references, tube_cameras, tube_light


def _target() -> tuple:
    light = tube_light(1)
    cameras = tube_cameras(3, offset_mm=4.0, start_mm=6.0, turn=0.15)
    rgb, depth = cast_tube(cameras, light)
    target = torch.from_numpy(rgb.astype(np.float32)).permute(0, 3, 1, 2)
    return light, cameras, target, torch.from_numpy(depth.astype(np.float32))[:, None]


def _error(warped, target: torch.Tensor) -> float:
    trusted = (warped.blend_weight > 0.5).expand_as(target)
    assert trusted.float().mean() > 0.5
    return float((warped.blend - target).abs()[trusted].mean())


def test_compensated_warp_reproduces_an_exactly_lit_scene() -> None:
    light, cameras, target, depth = _target()
    warped = warp_references(exact_references(tube_cameras(8), light), cameras, depth, count=4)
    assert _error(warped, target) < 5e-3
    near = (warped.nearest_weight > 0.5).expand_as(target)
    assert (warped.nearest - target).abs()[near].mean() < 5e-3


def test_all_references_in_the_order_of_their_scores() -> None:
    # As many as are blended: the order of the choice must not part images from poses.
    light, cameras, target, depth = _target()
    for order in (slice(None), slice(None, None, -1)):
        references = exact_references(tube_cameras(8)[order], light)
        warped = warp_references(references, cameras, depth, count=len(references))
        assert _error(warped, target) < 5e-3


def test_the_nearest_reference_comes_first_on_request() -> None:
    light, cameras, _, depth = _target()
    references = exact_references(tube_cameras(8), light)
    # Of what the nearest view shows nothing is known: no co-visibility would choose it.
    nearest = pose_distances(cameras, references.cameras, references.transfer.scale_mm).argmin(axis=1)
    references.packed[nearest, 3] = 0
    best = warp_references(references, cameras, depth, count=4)
    named = warp_references(references, cameras, depth, count=4, reference="nearest")
    assert not (best.reference.numpy() == nearest).any()
    np.testing.assert_array_equal(named.reference, nearest)
    np.testing.assert_array_equal(named.chosen[:, 1:], best.chosen[:, :3])
    assert named.nearest_weight.max() == 0
    assert best.nearest_weight.max() > 0.5


@pytest.mark.parametrize(("width", "height"), [(40, 4), (3, 3), (1, 30)])
def test_references_are_ranked_in_views_of_few_rows_or_columns(width: int, height: int) -> None:
    light = tube_light(1)
    cameras = tube_cameras(8).resized(width, height)
    _, depth = cast_tube(cameras, light)
    references = exact_references(cameras, light)
    views = torch.from_numpy(depth.astype(np.float32))[:, None]
    # Trust ends before the border of the image.
    references.packed[:, 3] = 1
    scores = covisibility(references, cameras, views)
    assert scores.isfinite().all()
    assert torch.equal(scores.argmax(dim=1), torch.arange(8))
    references.packed[:, 3] = 0
    named = warp_references(references, cameras, views, count=2, reference="nearest")
    assert torch.equal(named.reference, torch.arange(8))
    assert 0 <= fit_falloff_exponent(references) <= 3


def test_without_compensation_it_does_not() -> None:
    light, cameras, target, depth = _target()
    references = exact_references(tube_cameras(8), light).with_transfer(LightTransfer(None, 0.0, 20.0))
    assert _error(warp_references(references, cameras, depth, count=4), target) > 0.02


def test_exposures_are_compensated() -> None:
    light, cameras, target, depth = _target()
    references = exact_references(tube_cameras(8), light)
    references.packed[:, :3] *= 0.8
    references.exposure.fill_(0.8)
    gain = torch.full((3,), 0.9)
    warped = warp_references(references, cameras, depth, count=4, exposure=gain)
    assert _error(warped, target * 0.9) < 5e-3


def test_surface_hidden_from_a_reference_is_not_borrowed() -> None:
    light, cameras, _, depth = _target()
    references = exact_references(tube_cameras(8), light)
    references.packed[:, 4] *= 2  # something stands at half the distance in every reference
    warped = warp_references(references, cameras, depth, count=4)
    for weight, shown in (
        (warped.blend_weight, warped.blend),
        (warped.nearest_weight, warped.nearest),
    ):
        assert weight.max() == 0
        assert shown.abs().max() == 0


def test_the_best_reference_is_the_view_itself() -> None:
    light = tube_light(1)
    cameras = tube_cameras(8)
    _, depth = cast_tube(cameras, light)
    scores = covisibility(
        exact_references(cameras, light), cameras, torch.from_numpy(depth.astype(np.float32))[:, None]
    )
    assert torch.equal(scores.argmax(dim=1), torch.arange(8))
    assert scores.min() >= 0
    assert scores.max() <= 1


@pytest.mark.parametrize("exponent", [0.5, 1.3])
def test_the_falloff_exponent_is_found_from_the_images(exponent: float) -> None:
    light = tube_light(1)
    references = exact_references(tube_cameras(10), None)
    _, depth = cast_tube(references.cameras, light)
    from extrags.cameras import pixel_rays

    distance = depth * np.linalg.norm(pixel_rays(references.cameras), axis=-1)
    fall = torch.from_numpy(((distance / 20) ** -exponent).astype(np.float32))
    references.packed[:, :3] *= fall[:, None]
    assert abs(fit_falloff_exponent(references) - exponent) < 0.12


def test_the_angle_to_the_wall_is_compensated() -> None:
    """A lamp that darkens slanted walls: carried into another view, the wall has the right brightness."""
    light = replace(tube_light(6), cosine=torch.tensor(0.9))
    cameras = tube_cameras(8)
    colors = []
    for camera in range(len(cameras)):
        view = cameras[camera]
        rgb, depth = cast_tube(view, tube_light(6))
        rays = torch.from_numpy(pixel_rays(view)[0].astype(np.float32))
        normals = depth_normals(rays, torch.from_numpy(depth.astype(np.float32)))
        points = view.centers[:, None, None] + depth[..., None] * pixel_rays(view)
        radial = np.concatenate([points[..., :2], np.zeros_like(points[..., :1])], axis=-1)
        exact = (radial / np.linalg.norm(radial, axis=-1, keepdims=True))[0]
        facing = (pixel_rays(view)[0] * exact).sum(-1) / np.linalg.norm(pixel_rays(view)[0], axis=-1)
        near = depth[0] < 60
        agreement = np.abs((normals.numpy() * exact).sum(-1))[near]
        assert np.median(agreement) > 0.995
        turned = torch.from_numpy(facing)
        near_lens = torch.ones_like(turned)
        darker = light.falloff(near_lens, None, turned) / light.falloff(near_lens)
        colors.append(rgb * darker.numpy()[None, ..., None])
    references = exact_references(cameras[list(range(6))], light)
    packed = references.packed.clone()
    packed[:, :3] = torch.from_numpy(np.concatenate(colors[:6]).astype(np.float32)).permute(0, 3, 1, 2)
    references = replace(references, packed=packed)
    _, depth = cast_tube(cameras[[7]], light)
    depth_mm = torch.from_numpy(depth.astype(np.float32))[:, None]
    truth = torch.from_numpy(colors[7].astype(np.float32)).permute(0, 3, 1, 2)
    blind = references.with_transfer(
        replace(references.transfer, light=replace(light, cosine=torch.tensor(0.0)))
    )
    errors = []
    for views in (references, blind):
        warped = warp_references(views, cameras[[7]], depth_mm, count=4)
        sure = (warped.blend_weight > 0.5).expand(-1, 3, -1, -1)
        errors.append(float((warped.blend - truth).abs()[sure].mean()))
    assert errors[0] < 0.6 * errors[1]


def _with_lamp_beside(
    cameras: Cameras, light: NearFieldLight, lamp: NearFieldLight
) -> tuple[Float[Tensor, "v 3 h w"], Float[Tensor, "v 1 h w"]]:
    """Images and depth of the tube, whose `light` at the lens is replaced by one beside it."""
    rgb, depth = cast_tube(cameras, light)
    in_camera = Cameras(cameras.K, np.tile(np.eye(4), (len(cameras), 1, 1)), cameras.width, cameras.height)
    points = torch.from_numpy((pixel_rays(in_camera) * depth[..., None]).astype(np.float32))
    signal = light.invert_response(torch.from_numpy(rgb.astype(np.float32)))
    # Darker, so that what is near the lamp does not exceed one.
    signal = 0.7 * signal * (lamp.gain(points) / light.gain(points))[..., None]
    return light.apply_response(signal).permute(0, 3, 1, 2), torch.from_numpy(depth.astype(np.float32))[
        :, None
    ]


@pytest.mark.parametrize("origin_mm", [0.0, 1e5])
def test_a_lamp_beside_the_lens_is_compensated(origin_mm: float) -> None:
    light = replace(tube_light(8), log_shoulder=torch.tensor(-torch.inf))
    lamp = replace(light, offset=torch.tensor([0.15, -0.1, 0.0]))
    recorded = tube_cameras(8)
    cameras = tube_cameras(3, offset_mm=4.0, start_mm=6.0, turn=0.6)
    shown, _ = _with_lamp_beside(recorded, light, lamp)
    target, depth = _with_lamp_beside(cameras, light, lamp)
    references = exact_references(recorded, light)
    packed = references.packed.clone()
    packed[:, :3] = shown
    transfer = replace(references.transfer, light=lamp)
    away = np.array([origin_mm, -origin_mm, 0.0])
    references = replace(references, packed=packed, cameras=_moved(recorded, away), transfer=transfer)
    told = warp_references(references, _moved(cameras, away), depth, count=4)
    blind = references.with_transfer(replace(transfer, light=light))
    unaware = warp_references(blind, _moved(cameras, away), depth, count=4)
    assert _error(told, target) < 5e-3
    assert _error(unaware, target) > 3 * _error(told, target)


def test_the_place_of_a_lamp_is_in_world_units() -> None:
    light = replace(tube_light(2), offset=torch.tensor([0.1, 0.0, -0.05]))
    expected = light.reference_distance * np.array([0.1, 0.0, -0.05])
    np.testing.assert_allclose(LightTransfer(light, 0.5, 20.0).lamp_position, expected, rtol=1e-6)
    assert not bool(LightTransfer(None, 0.5, 20.0).lamp_position.any())


def _moved(cameras: Cameras, by: Float[np.ndarray, "3"]) -> Cameras:
    poses = cameras.world_from_camera.copy()
    poses[:, :3, 3] += by
    return replace(cameras, world_from_camera=poses)


def _rays(width: int, height: int) -> Tensor:
    focal = 0.6 * max(width, height)
    K = np.array([[focal, 0, 0.47 * width], [0, focal, 0.52 * height], [0, 0, 1]])
    return torch.from_numpy(pixel_rays(Cameras(K[None], np.eye(4)[None], width, height))[0])


def _angles_deg(found: Tensor, true: Tensor) -> Tensor:
    sines = torch.linalg.cross(found, true.expand_as(found)).norm(dim=-1)
    assert float((found * true).sum(-1).min()) > 0
    return torch.rad2deg(torch.asin(sines.clamp(max=1)))


@pytest.mark.parametrize("size", [(64, 48), (40, 60), (3, 3), (2, 2), (2, 9)])
def test_normals_of_a_plane_are_exact_up_to_the_border(size: tuple[int, int]) -> None:
    rays = _rays(*size)
    normal = torch.nn.functional.normalize(torch.tensor([0.3, -0.5, 1.0], dtype=torch.float64), dim=0)
    found = depth_normals(rays, (20 / (rays @ normal))[None])
    assert float(_angles_deg(found, normal).max()) < 1e-6


def test_normals_within_a_sphere_are_right_to_first_order_at_the_border() -> None:
    rays, radius = _rays(64, 48), 30.0
    center = torch.tensor([3.0, -2.0, 10.0], dtype=torch.float64)
    squared, along = rays.square().sum(-1), rays @ center
    depth = (along + torch.sqrt(along**2 - squared * (center @ center - radius**2))) / squared
    angles = _angles_deg(depth_normals(rays, depth[None]), (rays * depth[..., None] - center) / radius)
    assert float(angles[5:-5, 5:-5].max()) < 0.2
    # Mirrored at the border, depth seemed to have no slope there: up to 38 degrees.
    assert float(angles.max()) < 2.0


@pytest.mark.parametrize("size", [(1, 9), (9, 1), (1, 1)])
def test_images_of_one_pixel_have_normals_that_face_the_camera(size: tuple[int, int]) -> None:
    rays = _rays(*size)
    found = depth_normals(rays, torch.full((1, *rays.shape[:2]), 7.0, dtype=torch.float64))
    lengths = found.norm(dim=-1)
    torch.testing.assert_close(lengths, torch.ones_like(lengths))
    across = 0 if size[0] == 1 else 1
    towards = torch.nn.functional.normalize(rays, dim=-1)
    if size == (1, 1):
        torch.testing.assert_close(found, towards)
    else:
        # A fronto-parallel wall, known along one axis alone.
        assert float(found[..., 1 - across].abs().max()) < 1e-9
        assert float((found * towards).sum(-1).min()) > 0.5


def test_normals_beside_a_step_in_depth_are_finite() -> None:
    depth = torch.ones(1, 12, 12)
    depth[..., 2:] = 1e4
    found = depth_normals(_rays(12, 12).float(), depth)
    torch.testing.assert_close(found.norm(dim=-1), torch.ones(12, 12))


def test_far_from_the_origin_of_the_world() -> None:
    light, cameras, _, depth = _target()
    references = exact_references(tube_cameras(8), light)

    def moved(given: Cameras) -> Cameras:
        poses = given.world_from_camera.copy()
        poses[:, :3, 3] += 1e5
        return replace(given, world_from_camera=poses)

    far = replace(references, cameras=moved(references.cameras))
    here = warp_references(references, cameras, depth, count=4)
    there = warp_references(far, moved(cameras), depth, count=4)
    torch.testing.assert_close(there.blend, here.blend, atol=1e-4, rtol=1e-4)


def _same_place(
    colors: list[tuple[float, float, float]], trust: list[float]
) -> tuple[ReferenceViews, Tensor]:
    """References that stand in one place and show nothing but one colour each, and the depth from there."""
    cameras = tube_cameras(4)[[3] * len(colors)]
    references = exact_references(cameras, None)
    references.packed[:, :3] = torch.tensor(colors)[:, :, None, None]
    references.packed[:, 3] = torch.tensor(trust)[:, None, None]
    return references, 1 / references.packed[:1, 4:5]


def test_what_is_trusted_less_counts_by_the_square() -> None:
    references, depth = _same_place([(0.4, 0.4, 0.4), (0.42, 0.42, 0.42)], [1.0, 0.5])
    blend = warp_references(references, references.cameras[[0]], depth, count=2).blend
    # A fifth of the difference, less what the brighter one is taken for a highlight.
    torch.testing.assert_close(blend, torch.full_like(blend, 0.404), atol=5e-4, rtol=0)


@pytest.mark.parametrize("faint", [1e-4, 1e-9, 1e-20])
def test_however_faint_trust_is_the_blend_is_a_mean(faint: float) -> None:
    references, depth = _same_place([(0.4, 0.4, 0.4), (0.42, 0.42, 0.42)], [faint, faint / 2])
    warped = warp_references(references, references.cameras[[0]], depth, count=2)
    torch.testing.assert_close(warped.blend, torch.full_like(warped.blend, 0.404), atol=5e-4, rtol=0)
    assert 0 < warped.blend_weight.max() < 1.0


def test_a_highlight_is_not_blended() -> None:
    dark, bright = (0.4, 0.4, 0.4), (0.9, 0.9, 0.9)
    references, depth = _same_place([dark, bright, dark, dark], [1.0] * 4)
    blend = warp_references(references, references.cameras[[0]], depth, count=4).blend
    torch.testing.assert_close(blend, torch.full_like(blend, 0.4), atol=1e-3, rtol=0)


def test_what_is_too_bright_keeps_its_hue() -> None:
    references, depth = _same_place([(0.5, 0.25, 0.125)], [1.0])
    references.exposure.fill_(0.25)
    blend = warp_references(references, references.cameras[[0]], depth, count=1).blend
    expected = torch.tensor([1.0, 0.5, 0.25])[None, :, None, None]
    torch.testing.assert_close(blend, expected.expand_as(blend))


def test_the_ratio_is_that_of_the_references_to_the_views_distance() -> None:
    references, depth = _same_place([(0.4, 0.4, 0.4)], [1.0])
    poses = references.cameras.world_from_camera.copy()
    poses[:, :3, 3] += 3 * poses[:, :3, 2]
    nearer = replace(references.cameras, world_from_camera=poses)
    warped = warp_references(references, nearer, depth - 3, count=1)
    seen = warped.blend_weight > 0.5
    assert seen.any()
    assert warped.log_ratio[seen].min() > 0.01


def _fading_references(exponent: float) -> ReferenceViews:
    references = exact_references(tube_cameras(10), None)
    distance = cast_tube(references.cameras, None)[1] * np.linalg.norm(
        pixel_rays(references.cameras), axis=-1
    )
    fall = torch.from_numpy(((distance / 20) ** -exponent).astype(np.float32))
    references.packed[:, :3] *= fall[:, None]
    return references


def test_the_exponent_is_found_whatever_the_exposures() -> None:
    references = _fading_references(0.8)
    references.packed[:, :3] *= torch.linspace(1, 0.5, 10)[:, None, None, None]
    assert abs(fit_falloff_exponent(references) - 0.8) < 0.12


def test_the_exponent_is_found_in_spite_of_what_shows_another_brightness() -> None:
    references = _fading_references(0.8)
    # Something darkens the lower third of every second view.
    references.packed[::2, :3, 32:] *= 0.5
    assert abs(fit_falloff_exponent(references) - 0.8) < 0.12


def test_the_exponent_is_found_in_spite_of_pixels_that_are_too_bright_or_too_dark() -> None:
    """A floor of noise and the end of what a sensor tells have one brightness at whatever distance."""
    references = _fading_references(1.3)
    luminance = references.packed[:, :3].mean(dim=1)
    for chosen, value in (
        (luminance < luminance.quantile(0.3), 0.05),
        (luminance > luminance.quantile(0.7), 0.95),
    ):
        references.packed[:, :3].masked_fill_(chosen[:, None], value)
    assert abs(fit_falloff_exponent(references) - 1.3) < 0.12


def test_two_views_are_enough_for_an_exponent_and_one_is_not() -> None:
    references = _fading_references(0.8)
    assert abs(fit_falloff_exponent(references.subset(np.array([2, 4]))) - 0.8) < 0.12
    assert fit_falloff_exponent(references.subset(np.array([2]))) == 0.0


def test_views_that_are_not_trusted_tell_no_exponent() -> None:
    references = _fading_references(0.8)
    # Views are compared with the next one, and with the third after them.
    references.packed[1::2, 3] = 0
    assert fit_falloff_exponent(references) == 0.0


def test_other_views_weigh_by_trust_and_by_how_much_alike_they_look() -> None:
    """The view itself weighs what it is trusted; others less, the less the farther away they stand."""
    cameras = tube_cameras(4)[[0, 0, 1, 2, 3]]
    references = exact_references(cameras, None)
    references.packed[:, 3] = 1
    references.packed[1, 3] = 0.5
    rgb, weight = seen_by_others(
        references,
        cameras[[0]],
        1 / references.packed[0, 4:5],
        torch.arange(5),
        gain=torch.ones(()),
        depth_tolerance=0.05,
    )
    torch.testing.assert_close(weight[0], torch.ones_like(weight[0]), atol=1e-3, rtol=0)
    torch.testing.assert_close(weight[1], 0.5 * weight[0], atol=1e-3, rtol=0)
    assert weight.max() <= 1
    means = weight.mean(dim=(1, 2))
    assert means[0] > means[2] > means[3] > means[4]
    known = (weight[2:] > 0.3)[:, None].expand(-1, 3, -1, -1)
    assert known.float().mean() > 0.1
    assert float((rgb[2:] - references.packed[0, :3]).abs()[known].mean()) < 5e-3


def test_chosen_references_keep_what_is_theirs() -> None:
    references = replace(exact_references(tube_cameras(4), None), exposure=torch.arange(1.0, 5.0))
    chosen = references.subset(np.array([3, 1]))
    assert chosen.exposure.tolist() == [4, 2]
    assert chosen.frames.tolist() == [3, 1]
    assert torch.equal(chosen.packed, references.packed[[3, 1]])
    np.testing.assert_array_equal(chosen.cameras.centers, references.cameras.centers[[3, 1]])
