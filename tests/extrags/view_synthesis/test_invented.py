from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch
from torch import Tensor

from extrags.cameras import Cameras
from extrags.errors import ShapeError
from extrags.view_synthesis.conditioning import (
    CONDITION_CHANNELS,
    INVENTED_CHANNELS,
    Layers,
    condition,
    filled_depth,
    known_share,
    observe_views,
)
from extrags.view_synthesis.invented import InventedViews, evidence, with_invented
from extrags.view_synthesis.references import LightTransfer
from tests.extrags.lit_tube import HEIGHT, WIDTH, Tube, cast_tube, tube_cameras

VIEWS = tube_cameras(4, offset_mm=4.0, start_mm=16.0)
"""They look at the gap in the wall."""


def true_views(tube: Tube, cameras: Cameras) -> tuple[Tensor, Tensor]:
    rgb, depth = cast_tube(cameras, tube.references.transfer.light)
    return (
        torch.from_numpy(rgb.astype(np.float32)).permute(0, 3, 1, 2).contiguous(),
        torch.from_numpy(depth.astype(np.float32))[:, None],
    )


def invented_views(tube: Tube, *, gain: float = 1.0, depth_factor: float = 1.0) -> InventedViews:
    """The first two views of `VIEWS`, restored to what is really there, up to these factors."""
    cameras = VIEWS[:2]
    rgb, depth = true_views(tube, cameras)
    own = observe_views(tube.scene, tube.references, cameras, count=4).layers
    return InventedViews.of_views(
        cameras,
        rgb * gain,
        depth * depth_factor,
        (1 - known_share(own)).clamp(0, 1),
        torch.ones(2),
        tube.references.transfer,
    )


@pytest.fixture(scope="module")
def layers(tube: Tube) -> Layers:
    return observe_views(tube.scene, tube.references, VIEWS, count=4).layers


@pytest.fixture(scope="module")
def followed(tube: Tube, layers: Layers) -> Layers:
    return with_invented(layers, invented_views(tube), VIEWS)


class TestInvented:
    def test_holes_show_what_the_keyframes_show(self, tube: Tube, layers: Layers, followed: Layers) -> None:
        truth, _ = true_views(tube, VIEWS)
        weight = followed.get("invented_weight")
        hole = known_share(layers) < 0.2
        assert hole.float().mean() > 0.03
        assert weight[hole].mean() > 0.5
        shown = (weight > 0.5).expand_as(truth)
        assert (followed.get("invented") - truth).abs()[shown].mean() < 0.03
        transfer = tube.references.transfer
        before, after = (condition(one, transfer).base for one in (layers, followed))
        inside = hole.expand_as(truth)
        assert (after - truth).abs()[inside].mean() < 0.6 * (before - truth).abs()[inside].mean()

    def test_depth_of_holes_is_that_of_the_keyframes(
        self, tube: Tube, layers: Layers, followed: Layers
    ) -> None:
        _, truth = true_views(tube, VIEWS)
        scale = tube.references.transfer.scale_mm
        inside = followed.get("invented_weight") > 0.5
        before, after = (
            (filled_depth(one, scale) / truth).log().abs()[inside].mean() for one in (layers, followed)
        )
        assert after < 0.5 * before

    def test_it_is_the_same_in_another_unit(self, tube: Tube, layers: Layers, followed: Layers) -> None:
        """Of which a whole scene may be less than the distance where rendering begins in millimetres."""
        unit = 1e-4
        poses = VIEWS.world_from_camera.copy()
        poses[:, :3, 3] *= unit
        views = replace(VIEWS, world_from_camera=poses)
        given = tube.references.transfer
        assert given.light is not None
        light = replace(given.light, reference_distance=unit * given.light.reference_distance)
        rgb, depth = true_views(tube, VIEWS[:2])
        missing = (1 - known_share(layers[:2])).clamp(0, 1)
        transfer = LightTransfer(light, given.exponent, unit * given.scale_mm)
        invented = InventedViews.of_views(views[:2], rgb, unit * depth, missing, torch.ones(2), transfer)
        small = Layers(layers.data.clone())
        small.get("depth_mm").mul_(unit)
        found = with_invented(small, invented, views)
        for name in ("invented", "invented_weight"):
            off = (found.get(name) - followed.get(name)).abs()
            assert off.mean() < 1e-4, name

    def test_what_is_known_stays(self, layers: Layers, followed: Layers) -> None:
        known = known_share(layers)
        assert (followed.get("invented_weight") <= 1 - known + 1e-6).all()
        for name in ("rendered", "alpha", "uncertainty", "nearest", "blend", "blend_weight"):
            assert torch.equal(layers.get(name), followed.get(name)), name
        solid = layers.get("alpha") > 0.5
        assert torch.equal(layers.get("depth_mm")[solid], followed.get("depth_mm")[solid])
        nothing = followed.get("invented_weight") == 0
        assert followed.get("invented")[nothing.expand(-1, 3, -1, -1)].abs().max() == 0

    def test_brightness_follows_what_is_known_around(self, tube: Tube, layers: Layers) -> None:
        truth, _ = true_views(tube, VIEWS)
        dark = with_invented(layers, invented_views(tube, gain=0.6), VIEWS)
        shown = dark.get("invented_weight")[:, 0] > 0.5
        ratio = dark.get("invented").mean(dim=1)[shown] / truth.mean(dim=1)[shown]
        assert 0.85 < float(ratio.median()) < 1.1

    def test_a_surface_before_what_the_scene_shows_is_not_followed(self, tube: Tube, layers: Layers) -> None:
        near = with_invented(layers, invented_views(tube, depth_factor=0.4), VIEWS)
        solid = layers.get("alpha") > 0.9
        assert near.get("invented_weight")[solid].max() < 0.11
        assert torch.equal(layers.get("depth_mm")[solid], near.get("depth_mm")[solid])

    def test_a_curtain_between_two_depths_is_not_trusted(self, tube: Tube) -> None:
        # A smooth ramp from 10 to 60 mm over a few pixels: what filling makes of the rim of a fold.
        ramp = torch.linspace(-30, 30, WIDTH).sigmoid().mul(50).add(10).expand(1, 1, HEIGHT, WIDTH)
        views = InventedViews.of_views(
            VIEWS[:1],
            torch.full((1, 3, HEIGHT, WIDTH), 0.5),
            ramp.contiguous(),
            torch.zeros(1, 1, HEIGHT, WIDTH),
            torch.ones(1),
            tube.references.transfer,
        )
        trust = views.views.packed[0, 3]
        assert len(views.surface.gaussians) == 0
        middle = slice(HEIGHT // 2 - 4, HEIGHT // 2 + 4)
        assert trust[middle, WIDTH // 2 - 2 : WIDTH // 2 + 2].max() < 0.3 * trust[middle, 5:9].min()

    def test_evidence_falls_with_the_distance_from_what_is_known(self) -> None:
        unknown = torch.zeros(1, 1, 8, 40)
        unknown[..., 10:] = 1
        found = evidence(unknown)[0, 0, 0]
        assert (found[:10] == 1).all()
        assert (found[10:].diff() <= 0).all()
        assert found[-1] < 0.2
        assert (evidence(torch.ones(1, 1, 8, 40)) == evidence(torch.ones(1, 1, 4, 4)).max()).all()

    def test_without_keyframes_the_layers_are_those_given(self, layers: Layers) -> None:
        assert with_invented(layers, None, VIEWS) is layers

    def test_numbers_of_views_must_agree(self, tube: Tube, layers: Layers) -> None:
        with pytest.raises(ShapeError, match="cameras"):
            with_invented(layers, None, VIEWS[:2])
        rgb, depth = true_views(tube, VIEWS[:2])
        with pytest.raises(ShapeError, match="lengths"):
            InventedViews.of_views(VIEWS[:1], rgb, depth, depth, torch.ones(2), tube.references.transfer)


class TestFoldedChannels:
    def test_nothing_invented_changes_no_bit(self, tube: Tube, layers: Layers) -> None:
        transfer = tube.references.transfer
        plain = condition(layers, transfer)
        colored = Layers(layers.data.clone())
        colored.get("invented").fill_(0.7)
        for one in (condition(colored, transfer), condition(layers, transfer, folded=False)):
            assert torch.equal(one.channels[:, :CONDITION_CHANNELS], plain.channels)
            assert torch.equal(one.base, plain.base)
            assert torch.equal(one.depth_mm, plain.depth_mm)

    def test_the_switch_moves_what_was_invented(self, tube: Tube, followed: Layers) -> None:
        transfer = tube.references.transfer
        folded, apart = condition(followed, transfer), condition(followed, transfer, folded=False)
        assert folded.channels.shape[1] == CONDITION_CHANNELS
        assert apart.channels.shape[1] == CONDITION_CHANNELS + INVENTED_CHANNELS
        own = apart.channels[:, CONDITION_CHANNELS:]
        assert torch.equal(own[:, 3:], followed.get("invented_weight"))
        moved = folded.channels - apart.channels[:, :CONDITION_CHANNELS]
        changed = [channel for channel in range(CONDITION_CHANNELS) if bool(moved[:, channel].any())]
        assert changed == [11, 12, 13, 14]
        torch.testing.assert_close(moved[:, 11:15], own)
        assert torch.equal(folded.base, apart.base)
