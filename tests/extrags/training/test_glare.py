"""Veiling glare, learned with the light where there is enough of it."""

from __future__ import annotations

import logging
from dataclasses import replace

import numpy as np
import pytest

from extrags.config import CoarseConfig, DensifyConfig, LightConfig
from extrags.illumination import NearFieldLight
from extrags.sequence import EndoscopicSequence
from extrags.training import reconstruct

GLARE = np.array([0.2, 0.12, 0.14])


@pytest.fixture(scope="module")
def veiled(tube_sequence: EndoscopicSequence) -> EndoscopicSequence:
    """The tube through a lens that scatters; images show about the square root of the light."""
    linear = np.square(tube_sequence.rgb / 255.0) + np.square(GLARE)
    return replace(tube_sequence, rgb=np.rint(255 * np.sqrt(linear).clip(0, 1)).astype(np.uint8))


def learned(sequence: EndoscopicSequence, light: LightConfig) -> NearFieldLight:
    config = CoarseConfig(iterations=400, max_points=1500, densify=DensifyConfig(enabled=False), light=light)
    found = reconstruct(sequence, config).scene.light
    assert found is not None
    return found


def test_glare_is_found(veiled: EndoscopicSequence, caplog: pytest.LogCaptureFixture) -> None:
    with caplog.at_level(logging.INFO, "extrags.training.reconstruction"):
        light = learned(veiled, LightConfig())
    # Frames as dark as the glare are few in a short tube.
    np.testing.assert_allclose(light.log_glare.exp().numpy(), GLARE, rtol=0.2)
    assert "veiling glare; black shows as 0." in caplog.text


@pytest.mark.parametrize("settings", [LightConfig(glare_kept_from=0.5), LightConfig(glare=False)])
def test_too_little_of_it_is_none(
    veiled: EndoscopicSequence, settings: LightConfig, caplog: pytest.LogCaptureFixture
) -> None:
    with caplog.at_level(logging.INFO, "extrags.training.reconstruction"):
        light = learned(veiled, settings)
    assert bool((light.log_glare == -np.inf).all())
    assert "glare" not in caplog.text
