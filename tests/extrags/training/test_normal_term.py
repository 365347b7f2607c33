"""The normal term and the Huber depth term, against plain float64 versions and between both steps."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from extrags.config import CoarseConfig, DensifyConfig
from extrags.raster import native
from extrags.raster.loss import huber_depth_gradient, huber_depth_loss
from extrags.raster.rotations import rotation_matrices
from extrags.sequence import EndoscopicSequence
from extrags.thresholds import HOLE_ALPHA
from extrags.training import reconstruct
from extrags.training.normal_term import NEAREST_EVERY, NormalTerm, normal_loss
from extrags.training.step import AutogradStep, NativeStep
from extrags.training.strategies import density_strategy
from extrags.training.views import real_views
from tests.extrags.training.shaken_tube import relative_error, shaken_scene, step_schedule


def plain_normal_loss(quats: np.ndarray, log_scales: np.ndarray, normals: np.ndarray) -> float:
    """1 - |cos| Gaussian by Gaussian, with the axis turned by the quaternion product itself."""
    total = 0.0
    for quat, scales, normal in zip(quats, log_scales, normals, strict=True):
        w, *imaginary = quat / math.sqrt(sum(part * part for part in quat))
        vector = np.array(imaginary)
        axis = np.eye(3)[int(np.argmin(scales))]
        turned = axis + 2 * np.cross(vector, np.cross(vector, axis) + w * axis)
        total += 1 - abs(sum(a * b for a, b in zip(turned, normal, strict=True)))
    return total / len(quats)


def plain_huber(
    depth: np.ndarray, alpha: np.ndarray, target: np.ndarray, scale: float, delta: float
) -> float:
    """Pixel by pixel, with the two branches written out."""
    terms = []
    for z, a, truth in zip(depth.flat, alpha.flat, target.flat, strict=True):
        if truth <= 0 or a <= HOLE_ALPHA:
            continue
        x = abs(float(z) - float(truth)) / scale
        terms.append(x * x / 2 if x <= delta else delta * (x - delta / 2))
    return sum(terms) / len(terms) if terms else 0.0


def gaussians(n: int, seed: int) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
    generator = torch.Generator().manual_seed(seed)
    quats, scales, normals = (
        torch.randn(n, size, generator=generator, dtype=torch.float64) for size in (4, 3, 3)
    )
    return quats, scales, torch.nn.functional.normalize(normals, dim=1)


def depths(seed: int, far: float = 1.0) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Rendered depth, alpha and target, with pixels of each kind that is left out."""
    rng = np.random.default_rng(seed)
    target = rng.uniform(5, 15, (7, 9))
    target[0] = 0
    alpha = rng.uniform(0.6, 1, (7, 9))
    alpha[:, 0] = 0.3
    return target + far * rng.normal(0, 3, (7, 9)), alpha, target


class TestNormalLoss:
    @given(seed=st.integers(0, 1000))
    @settings(max_examples=25, deadline=None)
    def test_value(self, seed: int) -> None:
        quats, scales, normals = gaussians(6, seed)
        expected = plain_normal_loss(quats.numpy(), scales.numpy(), normals.numpy())
        assert float(normal_loss(quats, scales, normals)) == pytest.approx(expected, rel=1e-12)

    def test_gradient_turns_the_axis_to_the_normal(self) -> None:
        quats, scales, normals = gaussians(5, 3)
        quats.requires_grad_()
        assert torch.autograd.gradcheck(lambda q: normal_loss(q, scales, normals), (quats,))
        before = normal_loss(quats, scales, normals)
        before.backward()
        assert quats.grad is not None
        with torch.no_grad():
            after = normal_loss(quats - 0.1 * quats.grad, scales, normals)
        assert float(after) < float(before.detach())

    def test_either_sign_of_the_normal_and_aligned_axes(self) -> None:
        quats, scales, normals = gaussians(8, 5)
        assert torch.equal(normal_loss(quats, scales, normals), normal_loss(quats, scales, -normals))
        shortest = rotation_matrices(quats)[torch.arange(8), :, scales.argmin(1)]
        assert float(normal_loss(quats, scales, shortest)) == pytest.approx(0, abs=1e-12)
        other = rotation_matrices(quats)[torch.arange(8), :, scales.argmax(1)]
        assert float(normal_loss(quats, scales, other)) == pytest.approx(1, abs=1e-12)


class TestNormalTerm:
    def term(self, **changes: float) -> NormalTerm:
        points = np.array([[0.0, 0, 0], [10, 0, 0]])
        normals = np.array([[1.0, 0, 0], [0, 1, 0]])
        return NormalTerm(points, normals, **{"weight": 1.0, "start": 0.0, "every": 1, **changes})  # type: ignore[arg-type]

    def parameters(self, x: float) -> dict[str, torch.Tensor]:
        # The shortest axis is x itself.
        return {
            "means": torch.tensor([[x, 1.0, 0]]),
            "quats": torch.tensor([[1.0, 0, 0, 0]]),
            "scales": torch.tensor([[-3.0, 0, 0]]),
        }

    def test_the_nearest_point_gives_the_normal(self) -> None:
        near, far = self.term().penalty(self.parameters(4.9), 0), self.term().penalty(self.parameters(5.1), 0)
        assert near is not None
        assert far is not None
        assert (float(near), float(far)) == (0, 1)

    def test_when_it_is_active(self) -> None:
        term = self.term(start=10.0, every=2)
        active = [i + 1 for i in range(20) if term.penalty(self.parameters(0), i) is not None]
        assert active == [12, 14, 16, 18, 20]

    def test_weight(self) -> None:
        found = self.term(weight=0.2).penalty(self.parameters(9), 0)
        assert float(found) == pytest.approx(0.2)  # type: ignore[arg-type]

    def test_a_round_of_densification_may_have_moved_rows(self) -> None:
        term, parameters = self.term(round_every=30), self.parameters(0)
        assert float(term.penalty(parameters, 29)) == 0  # type: ignore[arg-type]
        # In place, as a relocation does: the tensor is the same.
        parameters["means"][0, 0] = 9
        assert float(term.penalty(parameters, 30)) == 1  # type: ignore[arg-type]

    def test_moved_and_new_gaussians_find_another_point(self) -> None:
        term, parameters = self.term(), self.parameters(0)
        assert float(term.penalty(parameters, 0)) == 0  # type: ignore[arg-type]
        parameters["means"][0, 0] = 9
        assert float(term.penalty(parameters, NEAREST_EVERY - 1)) == 0  # type: ignore[arg-type]
        assert float(term.penalty(parameters, NEAREST_EVERY)) == 1  # type: ignore[arg-type]
        assert float(term.penalty(self.parameters(0), NEAREST_EVERY)) == 0  # type: ignore[arg-type]


class TestHuber:
    @given(seed=st.integers(0, 1000), delta=st.floats(0.01, 2))
    @settings(max_examples=25, deadline=None)
    def test_value(self, seed: int, delta: float) -> None:
        images = depths(seed)
        found = huber_depth_loss(*map(torch.from_numpy, images), scale=10.0, delta=delta)
        assert float(found) == pytest.approx(plain_huber(*images, 10.0, delta), rel=1e-12)

    def test_gradients_agree(self) -> None:
        depth, alpha, target = (image.astype(np.float32) for image in depths(2))
        leaf = torch.from_numpy(depth.copy()).requires_grad_()
        loss = 0.7 * huber_depth_loss(
            leaf, torch.from_numpy(alpha), torch.from_numpy(target), scale=10.0, delta=0.2
        )
        loss.backward()
        filled = np.full_like(depth, np.nan)
        own, compared = huber_depth_gradient(depth, alpha, target, filled, scale=10.0, delta=0.2, weight=0.7)
        assert own == pytest.approx(float(loss.detach()), rel=1e-5)
        assert compared == 6 * 8
        assert leaf.grad is not None
        np.testing.assert_allclose(filled, leaf.grad.numpy(), rtol=1e-4, atol=1e-9)
        images = tuple(torch.from_numpy(image) for image in depths(2))
        assert torch.autograd.gradcheck(
            lambda z: huber_depth_loss(z, images[1], images[2], scale=10.0, delta=0.2),
            (images[0].requires_grad_(),),
        )

    def test_it_does_not_depend_on_the_unit_of_length(self) -> None:
        depth, alpha, target = depths(4)
        one = plain_huber(depth, alpha, target, 10.0, 0.2)
        scaled = (torch.from_numpy(image) for image in (25.4 * depth, alpha, 25.4 * target))
        assert float(huber_depth_loss(*scaled, scale=254.0, delta=0.2)) == pytest.approx(one, rel=1e-12)

    def test_nothing_to_compare(self) -> None:
        depth, alpha, target = depths(4)
        nothing = np.zeros_like(target)
        filled = np.full_like(depth, np.nan)
        found = huber_depth_gradient(depth, alpha, nothing, filled, scale=1.0, delta=1.0, weight=1.0)
        assert found == (0.0, 0)
        assert not filled.any()
        images = map(torch.from_numpy, depths(4)[:2])
        assert float(huber_depth_loss(*images, torch.zeros(7, 9), scale=1.0, delta=1.0)) == 0


@pytest.mark.skipif(native.native_isa() is None, reason="the native kernels are not built")
def test_both_steps_take_both_terms(tube_sequence: EndoscopicSequence) -> None:
    scene = shaken_scene(lit=False)
    view = real_views(tube_sequence, tube_sequence.train)[1]
    points = scene.gaussians.means.detach().numpy()
    config = CoarseConfig(normal_weight=0.2, normal_start_share=0.0, iterations=30)
    with_terms = step_schedule(
        densify=DensifyConfig(enabled=False),
        depth_huber_delta=0.2,
        depth_weight=0.2,
        normals=NormalTerm.at(points, config, config.iterations),
    )
    without = replace(with_terms, depth_weight=0.0, normals=None)
    losses = {}
    for name, schedule in (("with", with_terms), ("without", without)):
        own, other = NativeStep(scene, schedule), AutogradStep(scene, schedule)
        density = density_strategy(schedule.densify, 20.0, 30, len(points), seed=0)
        seen, expected = (step.differentiate(view, 7, density) for step in (own, other))
        assert seen.loss == pytest.approx(expected.loss, rel=1e-5)
        assert own.direct is not None
        for parameter in ("means", "quats", "scales", "opacities"):
            wanted = other.adam.parameters[parameter].grad
            assert wanted is not None
            assert relative_error(own.direct.gradients[parameter], wanted) < 1e-4, parameter
        losses[name] = seen.loss
    depth = seen.rendering.depth[0].double().numpy(), seen.rendering.alpha[0].numpy()
    assert view.depth_mm is not None
    huber = plain_huber(*depth, view.depth_mm.numpy(), with_terms.depth_scale, 0.2)
    quats, scales = (scene.gaussians.parameters()[name].double().numpy() for name in ("quats", "scales"))
    normals = with_terms.normals._normals_for(scene.gaussians.means, 7)  # type: ignore[union-attr]
    aligned = plain_normal_loss(quats, scales, normals.double().numpy())
    expected_rise = with_terms.depth_weight_at(7) * huber + 0.2 * aligned
    assert losses["with"] - losses["without"] == pytest.approx(expected_rise, rel=1e-3)


def test_reconstruction_aligns_gaussians(tube_sequence: EndoscopicSequence) -> None:
    """From round Gaussians, the term alone decides which axis is short and where it points."""
    settings = {"iterations": 60, "max_points": 800, "thickness": 0.3, "depth_loss": "huber"}
    plain = CoarseConfig.model_validate(settings | {"optimiser": {"quats": 1e-2}})
    held = plain.model_copy(update={"normal_weight": 5.0})
    losses = []
    for config in (plain, held):
        found = reconstruct(tube_sequence, config).scene.gaussians
        start = reconstruct(tube_sequence, config.model_copy(update={"iterations": 1})).scene.gaussians
        term = NormalTerm.at(start.means.numpy(), held, held.iterations)
        normals = term._normals_for(found.means, 0)
        losses.append(float(normal_loss(found.quats, found.scales, normals)))
    assert losses[1] < 0.8 * losses[0]


def test_its_start_is_a_share_of_the_iterations_that_are_made() -> None:
    """A scene that is continued has fewer than its settings say."""
    config = CoarseConfig(iterations=3000, normal_weight=1.0, normal_start_share=0.2, normal_every=10)
    points = np.random.default_rng(0).normal(size=(20, 3))
    parameters = {
        "means": torch.from_numpy(points).float(),
        "quats": torch.tensor([[1.0, 0, 0, 0]]).expand(20, 4),
        "scales": torch.zeros(20, 3),
    }
    term = NormalTerm.at(points, config, 450)
    active = [done for done in range(1, 451) if term.penalty(parameters, done - 1) is not None]
    assert active == list(range(100, 451, 10))
