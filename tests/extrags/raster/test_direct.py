from __future__ import annotations

import numpy as np
import pytest
import torch

from extrags.errors import ConfigError, NonFiniteError, ShapeError
from extrags.raster import l1_ssim_loss, native, rasterize, set_num_threads
from extrags.raster.direct import DirectStep, Target
from extrags.raster.loss import huber_depth_gradient, inverse_depth_loss
from tests.extrags.raster.scenes import relative_l2

NAMES = ("means", "quats", "scales", "opacities", "sh")


def _parameters(n: int = 300, coefficients: int = 4) -> dict[str, torch.Tensor]:
    generator = torch.Generator().manual_seed(5)
    means = torch.randn(n, 3, generator=generator)
    means[:, 2] = 4 + means[:, 2].abs()
    return {
        "means": means,
        "quats": torch.randn(n, 4, generator=generator),
        "scales": torch.randn(n, 3, generator=generator) * 0.4 - 1.5,
        "opacities": torch.randn(n, generator=generator),
        "sh": torch.randn(n, coefficients, 3, generator=generator) * 0.3,
    }


def _target(width: int = 61, height: int = 43) -> Target:
    generator = torch.Generator().manual_seed(6)
    K = np.array([[50.0, 0, width / 2], [0, 50.0, height / 2], [0, 0, 1]])
    depth = 3 + 3 * torch.rand(height, width, generator=generator)
    depth[:5] = 0
    weight = torch.rand(height, width, generator=generator)
    weight[:, :4] = 0
    rgb = torch.rand(height, width, 3, generator=generator)
    return Target(np.eye(4), K, rgb, weight=weight, depth=depth)


def _autograd(
    parameters: dict[str, torch.Tensor], target: Target, degree: int, absgrad: bool
) -> tuple[float, dict[str, torch.Tensor], torch.Tensor]:
    leaves = {k: v.clone().requires_grad_() for k, v in parameters.items()}
    rendering = rasterize(
        leaves["means"], leaves["quats"], leaves["scales"].exp(), leaves["opacities"].sigmoid(), leaves["sh"],
        torch.from_numpy(target.viewmat)[None], torch.from_numpy(target.K)[None], target.width, target.height,
        sh_degree=degree, absgrad=absgrad,
    )  # fmt: skip
    assert target.weight is not None
    assert target.depth is not None
    loss = l1_ssim_loss(
        rendering.rgb[0], torch.from_numpy(target.rgb), dssim_weight=0.3, mask=torch.from_numpy(target.weight)
    )
    depth = torch.from_numpy(target.depth)
    loss = loss + 0.2 * inverse_depth_loss(rendering.depth[0], rendering.alpha[0], depth, scale=4.0)
    (0.7 * loss).backward()
    found = {k: v.grad for k, v in leaves.items() if v.grad is not None}
    means2d = rendering.means2d
    moved = means2d.absgrad if absgrad else means2d.grad  # type: ignore[attr-defined]
    return 0.7 * float(loss.detach()), found, moved


@pytest.mark.parametrize("degree", [0, 1])
@pytest.mark.parametrize("absgrad", [False, True])
def test_equals_autograd(degree: int, absgrad: bool, isa: str) -> None:
    parameters, target = _parameters(), _target()
    expected_loss, expected, moved = _autograd(parameters, target, degree, absgrad)
    direct = DirectStep(absgrad=absgrad)
    direct.bind(parameters)
    # Stale numbers of an earlier step must not come through.
    for gradient in direct.gradients.values():
        gradient.fill_(float("nan"))
    weights = {"dssim_weight": 0.3, "loss_weight": 0.7, "depth_weight": 0.2, "depth_scale": 4.0}
    loss = direct.run(target, sh_degree=degree, **weights)
    assert loss == pytest.approx(expected_loss, rel=1e-6)
    for name in NAMES:
        assert relative_l2(direct.gradients[name], expected[name].double()) < 1e-5, name
    means2d = direct.rendering(target).means2d
    own = means2d.absgrad if absgrad else means2d.grad  # type: ignore[attr-defined]
    assert relative_l2(own, moved.double()) < 1e-5
    assert torch.equal(direct.visible, direct.rendering(target).visible[0])


def test_the_edge_of_a_mask_is_like_the_edge_of_an_image(isa: str) -> None:
    """A rectangle that is shown is the smaller image: no window of SSIM reaches beyond it."""
    parameters, whole = _parameters(), _target()
    left, top, right, bottom = 9, 6, 50, 37
    shown = torch.zeros(whole.height, whole.width, dtype=torch.bool)
    shown[top:bottom, left:right] = True
    rgb = torch.from_numpy(whole.rgb)
    target = Target(whole.viewmat, whole.K, rgb, weight=shown.float(), shown=shown)
    direct = DirectStep()
    direct.bind(parameters)
    loss = direct.run(target, sh_degree=1, dssim_weight=0.3)
    leaves = {name: value.clone().requires_grad_() for name, value in parameters.items()}
    rendering = rasterize(
        leaves["means"], leaves["quats"], leaves["scales"].exp(), leaves["opacities"].sigmoid(), leaves["sh"],
        torch.from_numpy(whole.viewmat)[None], torch.from_numpy(whole.K)[None], whole.width, whole.height,
        sh_degree=1,
    )  # fmt: skip
    window = slice(top, bottom), slice(left, right)
    expected = l1_ssim_loss(rendering.rgb[0][window], rgb[window], dssim_weight=0.3)
    expected.backward()
    assert loss == pytest.approx(float(expected.detach()), rel=1e-6)
    for name in NAMES:
        gradient = leaves[name].grad
        assert gradient is not None
        assert relative_l2(direct.gradients[name], gradient.double()) < 1e-5, name
    # The caller's colours are left as they were.
    assert torch.equal(rgb, torch.from_numpy(_target().rgb))


def test_arrays_stay_while_the_number_of_gaussians_does() -> None:
    parameters = _parameters()
    direct = DirectStep()
    direct.bind(parameters)
    addresses = []
    for _ in range(2):
        direct.run(_target(), sh_degree=1)
        addresses.append([g.data_ptr() for g in direct.gradients.values()])
    assert addresses[0] == addresses[1]


def test_parameters_may_change_in_place() -> None:
    parameters, target = _parameters(), _target()
    direct = DirectStep()
    direct.bind(parameters)
    before = direct.run(target, sh_degree=1)
    parameters["scales"] -= 0.5
    after = direct.run(target, sh_degree=1)
    fresh = DirectStep()
    fresh.bind(parameters)
    assert after != before
    assert fresh.run(target, sh_degree=1) == after


def test_views_of_several_sizes_take_turns() -> None:
    parameters = _parameters()
    direct = DirectStep()
    direct.bind(parameters)
    small, large = _target(30, 20), _target()
    first = direct.run(small, sh_degree=1)
    direct.run(large, sh_degree=1)
    assert direct.rendering(large).rgb.shape == (1, 43, 61, 3)
    assert direct.run(small, sh_degree=1) == first


@pytest.mark.parametrize("name", NAMES)
def test_nonfinite_parameters_are_named(name: str) -> None:
    parameters = _parameters()
    parameters[name][3] = float("nan")
    direct = DirectStep()
    direct.bind(parameters)
    with pytest.raises(NonFiniteError, match=rf"{name}\[3"):
        direct.run(_target(), sh_degree=0)


def test_a_nonfinite_gaussian_out_of_sight_is_named() -> None:
    # The check goes with the projection, which leaves Gaussians behind the camera early.
    parameters = _parameters()
    parameters["means"][5, 2] = -3
    parameters["sh"][5, 3, 1] = float("inf")
    direct = DirectStep()
    direct.bind(parameters)
    with pytest.raises(NonFiniteError, match=r"sh\[5, 3, 1\] is inf \(1 such"):
        direct.run(_target(), sh_degree=0)
    parameters["sh"][5, 3, 1] = 0
    assert np.isfinite(direct.run(_target(), sh_degree=0))


def test_a_nonfinite_pose_is_named() -> None:
    """Poses that are refined are written into a target that has been checked."""
    direct, target = DirectStep(), _target()
    direct.bind(_parameters())
    target.viewmat[1, 3] = float("nan")
    with pytest.raises(NonFiniteError, match=r"viewmats\[0, 1, 3\] is nan"):
        direct.run(target, sh_degree=0, pose=True)


@pytest.mark.parametrize("near", [0.0, -1.0, float("nan"), float("inf")])
def test_the_near_plane_is_checked(near: float) -> None:
    direct = DirectStep()
    direct.bind(_parameters())
    with pytest.raises(ShapeError, match="near is"):
        direct.run(_target(), sh_degree=0, near=near)


@pytest.mark.parametrize("degree", [-1, -(2**31), 2, 4])
def test_degrees_without_coefficients_are_refused(degree: int) -> None:
    direct = DirectStep()
    direct.bind(_parameters(coefficients=25 if degree == 4 else 4))
    told = "sh has an unexpected size" if degree == 2 else f"degree is {degree}, expected 0 to 3"
    with pytest.raises(ValueError, match=told):
        direct.run(_target(), sh_degree=degree)


def test_targets_are_checked(unchecked: None) -> None:
    rgb, eye = torch.zeros(4, 5, 3), np.eye(3)
    with pytest.raises(ShapeError, match="rgb has shape"):
        Target(np.eye(4), eye, rgb[0])
    with pytest.raises(ShapeError, match="weight has shape"):
        Target(np.eye(4), eye, rgb, weight=torch.zeros(5, 4))
    with pytest.raises(ShapeError, match="ssim_weight has shape"):
        Target(np.eye(4), eye, rgb, ssim_weight=torch.zeros(5, 4))
    with pytest.raises(ShapeError, match="shown has shape"):
        Target(np.eye(4), eye, rgb, shown=torch.zeros(5, 4, dtype=torch.bool))
    with pytest.raises(NonFiniteError, match="Ks"):
        Target(np.eye(4), eye * np.nan, rgb)


@pytest.mark.parametrize("shape", [(1, 1), (37, 53), (150, 131)])
def test_inverse_depth_kernel(shape: tuple[int, int], isa: str, threads: None) -> None:
    generator = torch.Generator().manual_seed(1)
    depth = (10 * torch.rand(shape, generator=generator)).requires_grad_()
    alpha, target = torch.rand(shape, generator=generator), 10 * torch.rand(shape, generator=generator) - 1
    with torch.no_grad():
        depth[0, 0], alpha[0, 0], target[0, 0] = 3.0, 0.9, 4.0
        depth[-1, -1], target[-1, -1] = (3.0, 4.0) if shape == (1, 1) else (0.0, 5.0)
    expected = inverse_depth_loss(depth, alpha, target, scale=5.0)
    (0.3 * expected).backward()
    arrays = [value.detach().numpy() for value in (depth, alpha, target)]
    results = []
    for count in (1, 3):
        set_num_threads(count)
        gradient = np.full(shape, np.nan, dtype=np.float32)
        loss, compared = native.compiled_kernels().inverse_depth(*arrays, gradient, 5.0, 0.3)
        results.append((loss, gradient))
        assert compared == int(((target > 0) & (alpha > 0.5) & (depth > 5e-3)).sum())
        assert loss == pytest.approx(0.3 * float(expected.detach()), rel=1e-6)
        assert relative_l2(torch.from_numpy(gradient), depth.grad.double()) < 1e-6  # type: ignore[union-attr]
    assert results[0][0] == results[1][0]
    assert np.array_equal(results[0][1], results[1][1])


def test_inverse_depth_with_nothing_to_compare(isa: str) -> None:
    depth, gradient = np.ones((4, 4), dtype=np.float32), np.full((4, 4), np.nan, dtype=np.float32)
    zero = np.zeros_like(depth)
    loss, compared = native.compiled_kernels().inverse_depth(depth, depth, zero, gradient, 1.0, 1.0)
    assert (loss, compared) == (0.0, 0)
    assert not gradient.any()
    leaf = torch.ones(1, 4, 4, requires_grad=True)
    nothing = inverse_depth_loss(leaf, leaf.detach(), torch.zeros(1, 4, 4), scale=1.0)
    nothing.backward()
    assert float(nothing.detach()) == 0
    assert leaf.grad is not None
    assert not leaf.grad.any()


def test_depth_confidence_scales_each_pixel(isa: str) -> None:
    generator = torch.Generator().manual_seed(2)
    shape = (19, 23)
    depth = (1 + 10 * torch.rand(shape, generator=generator)).requires_grad_()
    target, confidence = 1 + torch.rand(shape, generator=generator), torch.rand(shape, generator=generator)
    alpha = torch.ones(shape)
    expected = inverse_depth_loss(depth, alpha, target, scale=3.0, confidence=confidence)
    (0.4 * expected).backward()
    arrays = [value.detach().numpy() for value in (depth, alpha, target)]
    gradient = np.empty(shape, dtype=np.float32)
    loss, compared = native.compiled_kernels().inverse_depth(
        *arrays, gradient, 3.0, 0.4, confidence=confidence.numpy()
    )
    assert compared == depth.numel()
    assert loss == pytest.approx(0.4 * float(expected.detach()), rel=1e-6)
    assert relative_l2(torch.from_numpy(gradient), depth.grad.double()) < 1e-6  # type: ignore[union-attr]


def test_confidence_counts_only_where_depths_are_compared(isa: str) -> None:
    depth, alpha, confidence = (np.ones((1, 4), dtype=np.float32) for _ in range(3))
    target = np.array([[1.1, 0, 0, 1.2]], dtype=np.float32)
    unknown = np.where(target > 0, confidence, np.float32(np.nan))
    results = []
    for weights in (confidence, unknown):
        for delta in (None, 0.05):
            gradient = np.empty_like(depth)
            images = depth, alpha, target, gradient
            if delta is None:
                found = native.compiled_kernels().inverse_depth(*images, 1.0, 1.0, confidence=weights)
            else:
                found = huber_depth_gradient(*images, scale=1.0, delta=delta, weight=1.0, confidence=weights)
            results.append((*found, *gradient[0].tolist()))
    assert results[:2] == results[2:]
    assert results[0][0] > 0


def test_the_first_nonfinite_value_is_found_in_a_long_array(isa: str, threads: None) -> None:
    set_num_threads(2)
    values = np.zeros(1_000_003, dtype=np.float32)
    first_nonfinite = native.compiled_kernels().first_nonfinite
    assert first_nonfinite(values) == -1
    for place in (1_000_002, 700_000, 262_144, 262_143, 0):
        values[place] = np.nan if place % 2 else -np.inf
        assert first_nonfinite(values) == place


def test_gradients_in_images_much_smaller_than_a_tile() -> None:
    """About the middle of a whole tile, second moments of these would be differences of large sums."""
    generator = torch.Generator().manual_seed(2)
    n = 12
    parameters = {
        "means": torch.cat(
            [0.6 * torch.randn(n, 2, generator=generator), 2 + torch.rand(n, 1, generator=generator)], 1
        ),
        "quats": torch.randn(n, 4, generator=generator),
        "scales": torch.randn(n, 3, generator=generator) * 0.3 - 0.8,
        "opacities": torch.randn(n, generator=generator) + 1,
        "sh": torch.randn(n, 4, 3, generator=generator) * 0.3,
    }
    K = np.array([[2.2, 0, 1.5], [0, 2.2, 2.5], [0, 0, 1]])
    rgb = torch.rand(5, 3, 3, generator=generator)
    step = DirectStep()
    step.bind(parameters)
    step.run(Target(np.eye(4), K, rgb), sh_degree=1)
    leaves = {k: v.double().requires_grad_() for k, v in parameters.items()}
    rendering = rasterize(
        leaves["means"], leaves["quats"], leaves["scales"].exp(), leaves["opacities"].sigmoid(), leaves["sh"],
        torch.eye(4, dtype=torch.float64)[None], torch.from_numpy(K)[None], 3, 5, backend="reference",
    )  # fmt: skip
    l1_ssim_loss(rendering.rgb[0], rgb.double()).backward()
    for name, leaf in leaves.items():
        assert leaf.grad is not None
        assert relative_l2(step.gradients[name], leaf.grad) < 2e-5, name


@pytest.mark.parametrize("shape", [(0, 0, 3), (4, 0, 3), (0, 4, 3), (1, 32769, 3)])
def test_images_of_no_size_are_refused(shape: tuple[int, ...]) -> None:
    with pytest.raises(ShapeError, match=f"image size {shape[1]}x{shape[0]}, expected 1 to 32768"):
        Target(np.eye(4), np.eye(3), torch.zeros(shape))


@pytest.mark.parametrize("normalisation", [0.0, -3.0, float("nan")])
def test_a_normalisation_that_is_not_positive_is_refused(normalisation: float) -> None:
    image = torch.zeros(5, 7, 3)
    with pytest.raises(ConfigError, match="expected a positive number of pixels"):
        Target(np.eye(4), np.eye(3), image, normalisation=normalisation)
    with pytest.raises(ConfigError, match="expected a positive number of pixels"):
        l1_ssim_loss(image, image, normalisation=normalisation)


def test_cameras_of_other_shapes_are_refused(unchecked: None) -> None:
    with pytest.raises(ShapeError, match=r"viewmats has shape \(3, 4\), expected \(4, 4\)"):
        Target(np.eye(4)[:3], np.eye(3), torch.zeros(5, 7, 3))
    with pytest.raises(ShapeError, match=r"Ks has shape \(4, 4\), expected \(3, 3\)"):
        Target(np.eye(4), np.eye(4), torch.zeros(5, 7, 3))


def test_no_weight_of_the_first_term_is_no_loss() -> None:
    direct = DirectStep()
    direct.bind(_parameters())
    none, all_of_it = torch.zeros(43, 61), torch.ones(43, 61)
    target = _target()
    target = Target(
        target.viewmat, target.K, torch.from_numpy(target.rgb), weight=none, ssim_weight=all_of_it
    )
    assert direct.run(target, sh_degree=1) == 0
    assert all(bool((gradient == 0).all()) for gradient in direct.gradients.values())
