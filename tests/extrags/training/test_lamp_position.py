"""Where the lamp stands beside the lens, learned with the light."""

from __future__ import annotations

import math

import numpy as np
import torch

from extrags.cameras import Cameras, look_at
from extrags.config import CoarseConfig, DensifyConfig, LightConfig
from extrags.illumination import NearFieldLight
from extrags.scene import Scene
from extrags.sequence import EndoscopicSequence, Split
from extrags.training import reconstruct
from tests.extrags.training.test_highlights import held_out_psnr, wavy_wall

WIDTH, HEIGHT, TRAINED, HELD_OUT = 64, 48, 8, 4
BESIDE = (0.15, -0.1, 0.0)


def recorded(offset: tuple[float, float, float]) -> EndoscopicSequence:
    """A row of cameras that roll a little; held out are cameras that look on upside down."""
    light = NearFieldLight(
        torch.tensor(-2.0),
        torch.tensor(0.8).log(),
        torch.zeros(TRAINED + HELD_OUT),
        20.0,
        offset=torch.tensor(offset),
    )
    poses = []
    for frame in range(TRAINED + HELD_OUT):
        row = frame < TRAINED
        center = np.array(
            [2.0 * frame - 7.0 if row else 4.0 * (frame - TRAINED) - 6, 1.5 * math.sin(frame), 0]
        )
        roll = 0.5 * math.sin(1.7 * frame) + (0 if row else math.pi)
        up = np.array([math.sin(roll), -math.cos(roll), 0])
        poses.append(look_at(center, center * [0.6, 0.6, 1] + [0, 0, 20], up))
    count = len(poses)
    K = np.tile([[45.0, 0, WIDTH / 2], [0, 45.0, HEIGHT / 2], [0, 0, 1]], (count, 1, 1))
    cameras = Cameras(K, np.stack(poses), WIDTH, HEIGHT)
    with torch.no_grad():
        shown = Scene(wavy_wall(), light).render(cameras)
    return EndoscopicSequence(
        name="test/lamp@row",
        rgb=(shown.rgb.clamp(0, 1) * 255).round().to(torch.uint8).numpy(),
        K=K,
        mask=np.ones((count, HEIGHT, WIDTH), dtype=bool),
        split=Split("row", np.arange(TRAINED), np.arange(TRAINED, count)),
        world_from_camera=np.stack(poses),
        depth_mm=torch.where(shown.alpha > 0.5, shown.depth, torch.zeros(())).numpy(),
    )


def trained(sequence: EndoscopicSequence, *, offset: bool) -> Scene:
    config = CoarseConfig(
        iterations=600,
        max_points=1500,
        densify=DensifyConfig(enabled=False),
        light=LightConfig(specular=False, exposure=False, offset=offset),
    )
    return reconstruct(sequence, config).scene


def test_a_lamp_beside_the_lens_is_found_and_other_views_gain() -> None:
    sequence = recorded(BESIDE)
    found, at_lens = (trained(sequence, offset=on) for on in (True, False))
    assert found.light is not None
    assert at_lens.light is not None
    np.testing.assert_allclose(found.light.offset, BESIDE, atol=0.05)
    assert float(found.light.offset[2]) == 0
    assert not bool(at_lens.light.offset.any())
    assert held_out_psnr(found, sequence) > held_out_psnr(at_lens, sequence) + 2


def test_a_lamp_at_the_lens_stays_there() -> None:
    sequence = recorded((0.0, 0.0, 0.0))
    found, at_lens = (trained(sequence, offset=on) for on in (True, False))
    assert found.light is not None
    assert float(found.light.offset.norm()) < 0.02
    assert held_out_psnr(found, sequence) > held_out_psnr(at_lens, sequence) - 0.3
