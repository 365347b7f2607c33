from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
import torch

from extrags.config import LightConfig
from extrags.illumination import NearFieldLight
from extrags.raster.light import ROW_LENGTH
from extrags.training.light_fit import (
    COMMON,
    LOG_ROUGHNESS_BOUNDS,
    DenseAdam,
    LightFit,
    drop_faint_glare,
    lamp_distance,
)

EVERYTHING = LightConfig(offset=True)


def _light() -> NearFieldLight:
    generator = torch.Generator().manual_seed(2)
    values = {k: v.clone() for k, v in NearFieldLight.initial(5, 12.0, EVERYTHING).parameters().items()}
    values["log_exposure"] = 0.2 * torch.randn(5, generator=generator)
    values["offset"] = 0.1 * torch.randn(3, generator=generator)
    return NearFieldLight(**values, reference_distance=12.0)


def _gradient() -> np.ndarray:
    return np.random.default_rng(4).normal(size=ROW_LENGTH).astype(np.float32)


@pytest.mark.parametrize("frame", [None, 0, 3])
def test_row_is_what_the_light_packs(frame: int | None) -> None:
    light = _light()
    expected = light.camera_light(light.exposure(frame)[None]).packed()[0].numpy()
    np.testing.assert_allclose(LightFit(light, EVERYTHING).row(frame), expected, rtol=1e-6)


def test_gradients_are_those_of_autograd() -> None:
    light, gradient = _light(), _gradient()
    values = {k: v.requires_grad_() for k, v in light.parameters().items()}
    fit = LightFit(light, EVERYTHING)
    fit.row(3)
    row = light.camera_light(light.exposure(3)[None]).packed()[0]
    prior = EVERYTHING.exposure_prior * light.log_exposure.square().mean()
    prior = prior + EVERYTHING.offset_prior * lamp_distance(light.offset)
    (row @ torch.from_numpy(gradient) + prior).backward()
    assert fit.prior() == pytest.approx(float(prior.detach()), rel=1e-6)
    found = [values[name].grad for name in COMMON]
    expected = torch.cat([value.reshape(-1) for value in found if value is not None]).numpy()
    # The lamp does not leave the plane of the lens.
    expected[COMMON.index("offset") + 2] = 0
    assert np.all(expected[-3:] != 0)
    np.testing.assert_allclose(fit.common_gradient(gradient), expected, rtol=1e-5)
    exposure = values["log_exposure"].grad
    assert exposure is not None
    np.testing.assert_allclose(fit.exposure_gradient(gradient), exposure.numpy(), rtol=1e-5, atol=1e-7)


def test_what_is_not_learned_stays() -> None:
    config = LightConfig(
        falloff=False, response=False, specular=False, exposure=False, offset=False, glare=False
    )
    light = NearFieldLight.initial(4, 10.0, config)
    fit = LightFit(light, config)
    for _ in range(3):
        fit.row(1)
        fit.step(_gradient())
    after = fit.light.parameters()
    for name, value in light.parameters().items():
        moved = name in ("spread", "cosine")
        assert torch.equal(after[name], value) != moved, name


def test_the_lamp_moves_beside_the_lens_at_a_rate_of_its_own() -> None:
    config = LightConfig(offset_learning_rate=0.002)
    fit = LightFit(NearFieldLight.initial(2, 10.0, config), config)
    fit.row(0)
    fit.step(np.where(np.arange(ROW_LENGTH) == 8, -1, 1).astype(np.float32))
    np.testing.assert_allclose(fit.light.offset, [-0.002, 0.002, 0], rtol=1e-5)
    assert float(lamp_distance(fit.light.offset)) == pytest.approx(
        math.hypot(0.002, 0.002, 0.003) - 0.003, rel=1e-3
    )
    assert float(fit.light.spread) == pytest.approx(0.5 - config.learning_rate)


def test_a_lamp_that_nothing_holds_beside_the_lens_comes_back() -> None:
    fit = LightFit(_light(), EVERYTHING)
    start = fit.light.offset[:2].clone()
    for _ in range(300):
        fit.row(0)
        fit.step(np.zeros(ROW_LENGTH, dtype=np.float32))
    assert float(start.norm()) > 0.05
    assert float(fit.light.offset[:2].norm()) < 0.005
    free = LightFit(_light(), LightConfig(offset_prior=0))
    free.row(0)
    free.step(np.zeros(ROW_LENGTH, dtype=np.float32))
    assert torch.equal(free.light.offset[:2], start)


@pytest.mark.parametrize(("glare", "kept"), [((0.09, 0.06, 0.06), True), ((0.07, 0.05, 0.05), False)])
def test_faint_glare_is_dropped_for_good(glare: tuple[float, ...], kept: bool) -> None:
    fit = LightFit(replace(_light(), log_glare=torch.tensor(glare).log()), LightConfig(glare_kept_from=0.06))
    fit.row(0)
    fit.step(_gradient())
    drop_faint_glare(fit.light, LightConfig(glare_kept_from=0.06))
    assert bool(fit.light.log_glare.isfinite().all()) is kept
    row = fit.row(0)
    fit.step(_gradient())
    assert bool((row[13:16] > 0).all()) is kept
    assert bool(np.isfinite(row).all())
    assert bool(fit.light.log_glare.isfinite().all()) is kept


def test_a_virtual_view_teaches_no_exposure() -> None:
    fit = LightFit(_light(), EVERYTHING)
    fit.row(None)
    assert fit.prior() == pytest.approx(EVERYTHING.offset_prior * float(lamp_distance(fit.light.offset)))
    before = fit.light.detached()
    fit.step(_gradient())
    assert torch.equal(fit.light.log_exposure, before.log_exposure)
    assert not torch.equal(fit.light.spread, before.spread)


def test_the_light_given_is_copied() -> None:
    light = _light()
    before = light.detached()
    fit = LightFit(light, EVERYTHING)
    fit.row(2)
    fit.step(_gradient())
    for name, value in before.parameters().items():
        assert torch.equal(light.parameters()[name], value)


def test_dense_adam_is_that_of_torch() -> None:
    generator = np.random.default_rng(0)
    values = generator.normal(size=7).astype(np.float32)
    leaf = torch.from_numpy(values.copy()).requires_grad_()
    own, expected = DenseAdam(values, 0.01), torch.optim.Adam([leaf], lr=0.01, eps=1e-15)
    for _ in range(60):
        gradient = generator.normal(size=7).astype(np.float32)
        leaf.grad = torch.from_numpy(gradient)
        own.step(gradient)
        expected.step()
    np.testing.assert_allclose(values, leaf.detach().numpy(), rtol=1e-5, atol=1e-6)


def test_a_roughness_that_is_not_learned_stays_where_it_is() -> None:
    light = replace(_light(), log_roughness=torch.tensor(0.5))
    fit = LightFit(light, LightConfig(specular=False))
    fit.row(0)
    fit.step(_gradient())
    assert float(fit.light.log_roughness) == 0.5


def test_a_roughness_does_not_leave_its_bounds() -> None:
    """Beyond them it would have no gradient that brings it back."""
    for slope, bound in zip((1.0, -1.0), LOG_ROUGHNESS_BOUNDS, strict=True):
        fit = LightFit(_light(), LightConfig(specular_learning_rate=0.5))
        for _ in range(20):
            fit.row(0)
            fit.step(np.full(ROW_LENGTH, slope, dtype=np.float32))
        assert float(fit.light.log_roughness) == pytest.approx(bound)
