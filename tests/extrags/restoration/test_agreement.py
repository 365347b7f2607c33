from __future__ import annotations

import numpy as np
import pytest
import torch

from extrags.cameras import Cameras
from extrags.errors import ShapeError
from extrags.restoration.agreement import agreed_views, feathered_invented_share
from extrags.restoration.benchmark.evaluation import held_out_clips
from extrags.restoration.benchmark.variants import Agreed, AsRendered
from extrags.restoration.protocol import Clip, Restoration
from extrags.view_synthesis.references import LightTransfer
from tests.extrags.lit_tube import Tube

SIZE = (1, 32, 48)
DEPTH_MM = 10.0
FLAT = LightTransfer(None, 0.0, DEPTH_MM)
NOT_FLAT = LightTransfer(None, 2.0, DEPTH_MM)


def plane_views(places_mm: list[float], along: int = 0) -> Cameras:
    """Views of a plane 10 mm before the first, displaced; 3 pixels a millimetre."""
    poses = np.tile(np.eye(4), (len(places_mm), 1, 1))
    poses[:, along, 3] = places_mm
    K = np.array([[30.0, 0, 24], [0, 30.0, 16], [0, 0, 1]])
    return Cameras(np.tile(K, (len(places_mm), 1, 1)), poses, SIZE[2], SIZE[1])


def painted(values: list[float]) -> torch.Tensor:
    return torch.tensor(values)[:, None, None, None].expand(-1, 3, *SIZE[1:]).clone()


def agreed(
    rgb: torch.Tensor,
    cameras: Cameras,
    *,
    depth_mm: torch.Tensor | None = None,
    unconfirmed: torch.Tensor | None = None,
    exposure: np.ndarray | None = None,
    transfer: LightTransfer = FLAT,
) -> torch.Tensor:
    count = len(rgb)
    depth = torch.full((count, *SIZE), DEPTH_MM) if depth_mm is None else depth_mm
    unknown = torch.ones(count, *SIZE) if unconfirmed is None else unconfirmed
    return agreed_views(rgb, depth, unknown, cameras, exposure, transfer)


class TestAgreedViews:
    def test_views_of_one_place_come_nearer_to_their_mean(self) -> None:
        rgb = painted([0.3, 0.5])
        found = agreed(rgb, plane_views([0.0, 0.5]))
        middle = (..., slice(8, 24), slice(12, 36))
        before, after = (rgb[0] - rgb[1])[middle].abs().mean(), (found[0] - found[1])[middle].abs().mean()
        assert after < 0.3 * before
        assert found[middle].mean() == pytest.approx(0.4, abs=0.01)

    @pytest.mark.parametrize("unknown", [0.5, 0.7, 1.0])
    def test_a_view_follows_by_the_share_that_is_invented(self, unknown: float) -> None:
        """Two views in one place that know as little: each goes half of the way, times that share."""
        unconfirmed = torch.full((2, *SIZE), unknown)
        share = feathered_invented_share(unconfirmed)
        assert float(share.max() - share.min()) < 1e-6
        assert 0 < float(share.mean()) <= 1
        rgb = painted([0.3, 0.5])
        found = agreed(rgb, plane_views([0.0, 0.0]), unconfirmed=unconfirmed)
        expected = rgb + share * 0.5 * (rgb.flip(0) - rgb)
        middle = (..., slice(14, 18), slice(22, 26))
        torch.testing.assert_close(found[middle], expected[middle], atol=2e-3, rtol=0)

    def test_another_surface_is_not_followed(self) -> None:
        depth = torch.full((2, *SIZE), DEPTH_MM)
        depth[1] = 3 * DEPTH_MM
        rgb = painted([0.3, 0.5])
        torch.testing.assert_close(agreed(rgb, plane_views([0.0, 0.5]), depth_mm=depth), rgb)

    def test_what_is_known_keeps_its_bits(self) -> None:
        unknown = torch.ones(2, *SIZE)
        unknown[..., :20] = 0
        rgb = painted([0.3, 0.5])
        found = agreed(rgb, plane_views([0.0, 0.5]), unconfirmed=unknown)
        assert torch.equal(found[..., :12], rgb[..., :12])
        assert (found[..., 30:40] - rgb[..., 30:40]).abs().min() > 0.01

    def test_a_view_knows_better_near_what_it_knows(self) -> None:
        """The first view knows its left half, the second nothing at all: the second follows."""
        unknown = torch.ones(2, *SIZE)
        unknown[0, ..., :24] = 0
        rgb = painted([0.3, 0.5])
        found = agreed(rgb, plane_views([0.0, 0.0]), unconfirmed=unknown)
        near = (slice(None), slice(8, 24), slice(26, 32))
        first, second = (float((found[view] - rgb[view])[near].abs().mean()) for view in (0, 1))
        assert second > 3 * first

    def test_light_that_falls_off_is_no_disagreement(self) -> None:
        """A view from 8 in place of 10 mm is 1.5625 times as bright, at twice the gain 3.125 times."""
        cameras = plane_views([0.0, 2.0], along=2)
        depth = torch.full((2, *SIZE), DEPTH_MM)
        depth[1] = 8.0
        rgb = painted([0.2, 0.625])
        gain = np.array([1.0, 2.0])
        found = agreed(rgb, cameras, depth_mm=depth, exposure=gain, transfer=NOT_FLAT)
        middle = (..., slice(14, 18), slice(21, 27))
        # Away from the axis the ratio of distances is another, and painted views are not true.
        torch.testing.assert_close(found[middle], rgb[middle], atol=2e-3, rtol=0)
        without = agreed(rgb, cameras, depth_mm=depth, exposure=gain)
        assert (without - rgb)[middle].abs().min() > 0.01

    def test_detail_of_a_pixel_stays(self) -> None:
        noise = 0.1 * torch.rand(2, 3, *SIZE[1:], generator=torch.Generator().manual_seed(0))
        found = agreed(painted([0.3, 0.5]) + noise, plane_views([0.0, 0.5]))

        def steps(images: torch.Tensor) -> float:
            return float(images.diff(dim=-1).abs().mean())

        assert steps(found) > 0.95 * steps(noise)

    def test_a_view_alone_and_views_without_holes_stay(self) -> None:
        rgb = painted([0.3, 0.5])
        assert torch.equal(agreed(rgb[:1], plane_views([0.0])), rgb[:1])
        nothing = torch.zeros(2, *SIZE)
        assert torch.equal(agreed(rgb, plane_views([0.0, 0.5]), unconfirmed=nothing), rgb)

    def test_a_view_without_holes_leads_the_others(self) -> None:
        rgb = painted([0.3, 0.5])
        unconfirmed = torch.ones(2, *SIZE)
        unconfirmed[0] = 0
        found = agreed(rgb, plane_views([0.0, 0.0]), unconfirmed=unconfirmed)
        assert torch.equal(found[0], rgb[0])
        middle = (..., slice(14, 18), slice(22, 26))
        assert found[1][middle].mean() < 0.4

    def test_parts_must_fit(self) -> None:
        with pytest.raises(ShapeError, match="different lengths"):
            agreed(painted([0.3, 0.5]), plane_views([0.0]))


class TestAgreed:
    def test_a_clip_that_is_painted_differently_agrees_better(self, tube: Tube) -> None:
        class Painted(AsRendered):
            def restore(self, clip: Clip) -> Restoration:
                rgb = np.linspace(0.3, 0.7, len(clip), dtype=np.float32)[:, None, None, None]
                return Restoration(np.broadcast_to(rgb, (*clip.layers.data[:, 0].shape, 3)).copy(), None, {})

        (clip, *_) = held_out_clips(tube.scene, tube.references, tube.sequence, tube.sequence.test, count=4)
        plain, found = Painted().restore(clip).rgb, Agreed(Painted()).restore(clip)
        assert found.provenance == {"agreed": True}
        changed = np.abs(found.rgb - plain).max(axis=-1) > 1e-4
        assert changed.any()
        assert not changed.all()
        first, last = found.rgb[0][changed[0]], found.rgb[-1][changed[-1]]
        assert first.mean() > 0.3
        assert last.mean() < 0.7
