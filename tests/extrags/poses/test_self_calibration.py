"""An unknown lens is found with the poses, where the motion determines it; else the guess stays one."""

from __future__ import annotations

import json
from dataclasses import replace

import cv2
import numpy as np
import pytest

from extrags.cameras import Cameras, look_at
from extrags.config import IngestConfig, PosesConfig
from extrags.errors import ConfigError, ShapeError
from extrags.events import Event, Progress, subscribed
from extrags.lens import Lens
from extrags.poses import LensCalibration, estimate_poses, with_calibration, with_estimated_poses
from extrags.poses.colmap import FITTED_STEPS, USUAL_FITS
from extrags.poses.estimate import PoseEstimate
from extrags.sequence import EndoscopicSequence, Split
from tests.extrags.poses.textured_room import render_room, room_sequence, turning_room

WIDTH, HEIGHT = 200, 150
TRUE_FOCAL_PX = 0.7 * WIDTH
CONFIG = PosesConfig(n_features=600, fallback="never")
WIDE = Lens("RADIAL_FISHEYE", (115.0, WIDTH / 2, HEIGHT / 2, -0.2, 0.05), WIDTH, HEIGHT)
BENT = Lens("SIMPLE_RADIAL", (TRUE_FOCAL_PX, WIDTH / 2, HEIGHT / 2, -0.25), WIDTH, HEIGHT)


def guessed(sequence: EndoscopicSequence) -> EndoscopicSequence:
    """The frames alone, with a field of view of 90 degrees."""
    K = np.array([[WIDTH / 2, 0, WIDTH / 2], [0, WIDTH / 2, HEIGHT / 2], [0, 0, 1.0]])
    return replace(
        sequence,
        K=np.tile(K, (len(sequence), 1, 1)),
        depth_mm=None,
        metric=False,
        intrinsics="guessed",
    )


@pytest.fixture(scope="module")
def room() -> EndoscopicSequence:
    return room_sequence(9, width=WIDTH, height=HEIGHT)


@pytest.fixture(scope="module")
def found_with_events(room: EndoscopicSequence) -> tuple[PoseEstimate, list[Event]]:
    events: list[Event] = []
    with subscribed(events.append):
        return estimate_poses(guessed(room), CONFIG), events


@pytest.fixture(scope="module")
def found(found_with_events: tuple[PoseEstimate, list[Event]]) -> PoseEstimate:
    return found_with_events[0]


def seen_through(lens: Lens, room: EndoscopicSequence) -> EndoscopicSequence:
    """The room's frames as a distorted lens of the same size shows them."""
    K = np.array([[1.2 * TRUE_FOCAL_PX, 0, WIDTH], [0, 1.2 * TRUE_FOCAL_PX, HEIGHT], [0, 0, 1.0]])
    assert room.world_from_camera is not None
    cameras = Cameras(np.tile(K, (len(room), 1, 1)), room.world_from_camera, 2 * WIDTH, 2 * HEIGHT)
    rgb, _ = render_room(cameras)
    radius = np.linspace(0, 1.3, 4000)
    bent, _ = lens.distorted(radius, np.zeros_like(radius))
    u, v = np.meshgrid(np.arange(WIDTH) + 0.5, np.arange(HEIGHT) + 0.5)
    x, y = (u - lens.K[0, 2]) / lens.K[0, 0], (v - lens.K[1, 2]) / lens.K[1, 1]
    longer = np.interp(np.hypot(x, y), bent, radius) / np.maximum(np.hypot(x, y), 1e-9)
    maps = [(K[k, k] * axis * longer + K[k, 2] - 0.5).astype(np.float32) for k, axis in enumerate((x, y))]
    return replace(room, rgb=np.stack([cv2.remap(image, *maps, cv2.INTER_LINEAR) for image in rgb]))


class TestFocalLength:
    def test_it_is_found(self, found: PoseEstimate) -> None:
        calibration = found.calibration
        assert calibration is not None
        assert calibration.determined
        assert calibration.lens.is_pinhole
        assert calibration.focal_px == pytest.approx(TRUE_FOCAL_PX, rel=0.03)
        assert calibration.focal_std_px is not None
        assert 0 < calibration.focal_std_px < 0.04 * TRUE_FOCAL_PX
        assert abs(calibration.focal_px - TRUE_FOCAL_PX) < 4 * calibration.focal_std_px
        assert found.registered.all()

    def test_progress_goes_on_while_lenses_are_fitted(
        self, room: EndoscopicSequence, found_with_events: tuple[PoseEstimate, list[Event]]
    ) -> None:
        """On long recordings that takes minutes, in which nothing else would be heard."""
        steps = [event for event in found_with_events[1] if isinstance(event, Progress)]
        fit = FITTED_STEPS * len(room.train)
        jumps = np.diff([step.done for step in steps])
        assert (jumps == fit).sum() >= USUAL_FITS - 1
        assert jumps.max() <= max(fit, 8 * 16, 100)

    def test_it_is_said(self, found: PoseEstimate, room: EndoscopicSequence) -> None:
        assert found.summary.endswith("), estimated")
        assert "; focal length 1" in found.summary
        assert "field of view 7" in found.summary
        told = found.to_json(guessed(room))
        assert LensCalibration.from_json(told["calibration"]) == found.calibration
        json.dumps(told, allow_nan=False)

    def test_the_sequence_has_it(self, found: PoseEstimate, room: EndoscopicSequence) -> None:
        posed = with_estimated_poses(guessed(room), found)
        assert found.calibration is not None
        assert posed.intrinsics == "estimated"
        assert posed.focal_std_px == found.calibration.focal_std_px
        np.testing.assert_array_equal(posed.K[:, 0, 0], np.full(9, found.calibration.focal_px))
        # Nothing was bent: the frames, held-out ones too, are the very same.
        np.testing.assert_array_equal(posed.rgb, room.rgb)

    def test_of_smaller_frames_it_is_told_in_pixels_of_the_given_ones(
        self, found: PoseEstimate, room: EndoscopicSequence
    ) -> None:
        smaller = estimate_poses(guessed(room), CONFIG.model_copy(update={"max_width": 160}))
        assert smaller.calibration is not None
        assert found.calibration is not None
        lens = smaller.calibration.lens
        assert (lens.width, lens.height) == (WIDTH, HEIGHT)
        np.testing.assert_allclose(lens.K[:2, 2], [WIDTH / 2, HEIGHT / 2])
        assert smaller.calibration.focal_px == pytest.approx(TRUE_FOCAL_PX, rel=0.03)
        assert smaller.report["calibration"] == smaller.calibration.to_json()
        # Of other features: not the same, and told in the same unit.
        assert smaller.calibration.focal_px != found.calibration.focal_px
        for part, whole in (
            (smaller.calibration.focal_std_px, found.calibration.focal_std_px),
            (smaller.calibration.residual_px, found.calibration.residual_px),
            (smaller.mean_reprojection_px, found.mean_reprojection_px),
        ):
            assert part == pytest.approx(whole, rel=0.7)
        assert smaller.registered.all()
        posed = with_estimated_poses(guessed(room), smaller)
        assert posed.rgb.shape == room.rgb.shape

    @pytest.mark.slow
    def test_same_bits(self, found: PoseEstimate, room: EndoscopicSequence) -> None:
        again = estimate_poses(guessed(room), CONFIG)
        assert again.calibration == found.calibration
        np.testing.assert_array_equal(again.world_from_camera, found.world_from_camera, strict=True)

    def test_known_ones_stay(self, room: EndoscopicSequence) -> None:
        given = replace(guessed(room), K=room.K, intrinsics="given")
        kept = estimate_poses(given, CONFIG)
        assert kept.calibration is None
        assert "calibration" not in kept.report
        np.testing.assert_array_equal(with_estimated_poses(given, kept).K, room.K)


@pytest.fixture(scope="module")
def wide(room: EndoscopicSequence) -> EndoscopicSequence:
    """Pixels 1.25 times as wide as high."""
    size = (WIDTH, round(1.25 * HEIGHT))
    taller = np.stack([cv2.resize(image, size, interpolation=cv2.INTER_CUBIC) for image in room.rgb])
    K = guessed(room).K.copy()
    K[:, 1] *= size[1] / HEIGHT
    mask = np.ones(taller.shape[:3], dtype=bool)
    return replace(guessed(room), rgb=taller, K=K, mask=mask, observed=None, specular=None)


class TestPixelsThatAreNotSquare:
    def test_the_lens_is_found_and_they_are_square_then(self, wide: EndoscopicSequence) -> None:
        found = estimate_poses(wide, CONFIG)
        assert found.calibration is not None
        assert found.calibration.determined
        assert found.calibration.focal_px == pytest.approx(TRUE_FOCAL_PX, rel=0.03)
        posed = with_estimated_poses(wide, found)
        assert posed.rgb.shape[1:3] == (HEIGHT, WIDTH)
        assert posed.K[0, 0, 0] == posed.K[0, 1, 1] == found.calibration.focal_px

    def test_with_a_guess_they_stay(self, wide: EndoscopicSequence) -> None:
        lens = Lens("SIMPLE_PINHOLE", (WIDTH / 2, WIDTH / 2, HEIGHT / 2), WIDTH, HEIGHT)
        assert with_calibration(wide, LensCalibration(lens, determined=False)) is wide


def test_a_distorted_lens_is_found_and_undone(room: EndoscopicSequence) -> None:
    bent = guessed(seen_through(BENT, room))
    found = estimate_poses(bent, CONFIG)
    assert found.calibration is not None
    assert found.calibration.determined
    assert found.calibration.focal_px == pytest.approx(TRUE_FOCAL_PX, rel=0.03)
    assert found.calibration.lens.model == "SIMPLE_RADIAL"
    assert found.calibration.lens.value("k1") == pytest.approx(-0.25, abs=0.04)
    assert "k1 -0.2" in found.summary
    posed = with_estimated_poses(bent, found)
    assert posed.mask.mean() > 0.95
    # What was bent is as the pinhole shows it, held-out frames too.
    before = np.abs(bent.rgb.astype(float) - room.rgb)[posed.mask].mean()
    after = np.abs(posed.rgb.astype(float) - room.rgb)[posed.mask].mean()
    assert after < 0.45 * before


def test_straight_ahead_the_guess_stays(room: EndoscopicSequence) -> None:
    """Along the axis a longer lens and a deeper room look alike."""
    centres = np.stack([np.zeros(5), np.zeros(5), np.linspace(-10, -5, 5)], axis=1)
    ahead = np.stack([look_at(c, c + np.array([0, 0, 1.0]), np.array([0, -1.0, 0])) for c in centres])
    rgb, _ = render_room(Cameras(room.K[:5], ahead, WIDTH, HEIGHT))
    frames = np.arange(5)
    sequence = replace(
        guessed(room),
        rgb=rgb,
        K=guessed(room).K[:5],
        mask=room.mask[:5],
        world_from_camera=None,
        frame_names=(),
        split=replace(room.split, train=frames[frames != 3], test=frames[frames == 3]),
    )
    found = estimate_poses(sequence, PosesConfig(n_features=300, fallback="never", min_tri_angle_deg=1.0))
    calibration = found.calibration
    assert calibration is not None
    assert not calibration.determined
    assert "guessed: this motion does not determine it" in found.summary
    posed = with_estimated_poses(sequence, found)
    assert posed.intrinsics == "guessed"
    assert posed.focal_std_px is None
    assert posed.K[0, 0, 0] == WIDTH / 2


def test_a_scope_that_only_turns_determines_nothing() -> None:
    """With a wrong focal length turns even pass for a motion; at least the lens is not read off them."""
    found = estimate_poses(guessed(turning_room(5)), PosesConfig(n_features=300, fallback="never"))
    assert found.calibration is not None
    assert not found.calibration.determined
    assert found.calibration.focal_px == WIDTH / 2


class TestWithCalibration:
    def test_other_maps_are_resampled_too(self, room: EndoscopicSequence) -> None:
        spots = np.zeros_like(room.mask)
        spots[:, HEIGHT // 2, WIDTH // 2] = True
        given = replace(
            guessed(room),
            depth_mm=room.depth_mm,
            withheld_depth_mm=room.depth_mm,
            depth_error=np.full(room.mask.shape, 0.1, np.float32),
            observed=room.mask,
            specular=spots,
        )
        calibration = LensCalibration(BENT, determined=True, std={"f": 1.5})
        posed = with_calibration(given, calibration)
        assert posed.depth_mm is not None
        assert posed.observed is not None
        assert posed.specular is not None
        assert posed.K[0, 0, 0] == TRUE_FOCAL_PX
        assert posed.focal_std_px == 1.5
        np.testing.assert_array_equal(posed.observed, posed.mask)
        assert 1 <= posed.specular[0].sum() <= 16
        np.testing.assert_array_equal(posed.withheld_depth_mm, posed.depth_mm)
        assert posed.depth_error is not None
        np.testing.assert_allclose(posed.depth_error[posed.mask], 0.1, rtol=1e-5)
        assert posed.depth_mm[0, HEIGHT // 2, WIDTH // 2] == pytest.approx(
            given.depth_mm[0, HEIGHT // 2, WIDTH // 2],  # type: ignore[index]
            rel=0.02,
        )

    def test_a_lens_of_another_size(self, room: EndoscopicSequence) -> None:
        lens = replace(BENT, width=2 * WIDTH)
        with pytest.raises(ShapeError, match="frames of 200 x 150 pixels, expected 400 x 150"):
            with_calibration(room, LensCalibration(lens, determined=True))

    def test_words_of_a_guess(self) -> None:
        lens = Lens("SIMPLE_PINHOLE", (100.0, 100.0, 75.0), 200, 150)
        kept = LensCalibration(lens, determined=False, reason="no map could be made")
        assert kept.summary == (
            "focal length 100.0 px (field of view 90 degrees), guessed: no map could be made"
        )
        assert LensCalibration.from_json(kept.to_json()) == kept

    def test_words_of_a_wide_lens(self) -> None:
        found = LensCalibration(WIDE, determined=True, std={"f": 1.0})
        assert "(field of view 118 degrees, 82 as a pinhole, fisheye, k1 -0.200, k2 0.050)" in found.summary


class TestWideLens:
    """What becomes of frames of a lens that is estimated to be wide."""

    CALIBRATION = LensCalibration(WIDE, determined=True, std={"f": 1.0})

    def test_what_the_pinhole_leaves_out_is_told(
        self, room: EndoscopicSequence, caplog: pytest.LogCaptureFixture
    ) -> None:
        with_calibration(guessed(room), self.CALIBRATION)
        assert "the pinhole of 82 degrees leaves out 44 %" in caplog.text
        assert "which sees 118 degrees from side to side" in caplog.text
        assert "ingest.field_of_view_deg" in caplog.text
        assert "ingest.lens=native" in caplog.text
        caplog.clear()
        # Dark corners are no picture, and little bent is little lost.
        centre = np.hypot(*np.meshgrid(np.arange(WIDTH) - WIDTH / 2, np.arange(HEIGHT) - HEIGHT / 2)) < 60
        with_calibration(replace(guessed(room), mask=room.mask & centre), self.CALIBRATION)
        little = replace(BENT, parameters=(*BENT.parameters[:3], -0.1))
        with_calibration(guessed(room), LensCalibration(little, determined=True))
        assert caplog.text == ""

    def test_a_larger_field_of_view_shows_more(
        self, room: EndoscopicSequence, caplog: pytest.LogCaptureFixture
    ) -> None:
        wide = IngestConfig(field_of_view_deg=115)
        posed = with_calibration(guessed(room), self.CALIBRATION, wide)
        assert posed.K[0, 0, 0] == pytest.approx(WIDTH / 2 / np.tan(np.radians(57.5)))
        assert posed.rgb.shape == room.rgb.shape
        assert caplog.text == ""
        grown = with_calibration(guessed(room), self.CALIBRATION, wide.model_copy(update={"size": "central"}))
        assert grown.width > 1.7 * WIDTH
        assert grown.K[0, 0, 0] == pytest.approx(115.0, rel=0.01)

    def test_frames_keep_their_pixels(self, room: EndoscopicSequence) -> None:
        given = guessed(room)
        posed = with_calibration(given, self.CALIBRATION, IngestConfig(lens="native"))
        assert posed.rgb is given.rgb
        assert posed.intrinsics == "estimated"
        assert posed.lens is not None
        assert posed.mask.mean() > 0.99
        # Rays fall where the estimated lens puts them.
        poses = np.tile(np.eye(4), (1, 1, 1))
        cameras = Cameras(posed.K[:1], poses, WIDTH, HEIGHT, posed.lens)
        slopes = np.array([[0.0, 0, 1], [0.5, -0.3, 1], [1.2, 0.4, 1], [-1.3, 0.5, 1]])
        (pixels,), _ = cameras.project(slopes)
        np.testing.assert_allclose(
            pixels, np.stack(WIDE.project(slopes[:, 0], slopes[:, 1]), axis=1), atol=0.1
        )

    def test_pixels_beyond_the_lens_are_masked(self, room: EndoscopicSequence) -> None:
        """A polynomial that folds back inside the picture says nothing of its corners."""
        folding = replace(WIDE, model="SIMPLE_RADIAL", parameters=(70.0, WIDTH / 2, HEIGHT / 2, -0.15))
        found = LensCalibration(folding, determined=True)
        posed = with_calibration(guessed(room), found, IngestConfig(lens="native"))
        assert posed.lens is not None
        assert not posed.mask[:, 0, 0].any()
        assert posed.mask[:, HEIGHT // 2, WIDTH // 2].all()

    def test_a_lens_that_no_radial_model_is_near_is_undone(
        self, room: EndoscopicSequence, caplog: pytest.LogCaptureFixture, monkeypatch: pytest.MonkeyPatch
    ) -> None:
        monkeypatch.setattr("extrags.poses.lens_calibration.LARGEST_FIT_ERROR", -1.0)
        found = LensCalibration(WIDE, determined=True)
        posed = with_calibration(guessed(room), found, IngestConfig(lens="native"))
        assert posed.lens is None
        assert "no radial model is near the lens that was estimated" in caplog.text
        assert "of the picture of the lens" in caplog.text
        assert "ingest.lens=native all" not in caplog.text, "that was just refused"

    def test_a_lens_is_near_or_far_at_any_size(self) -> None:
        """The same lens was kept at 640 pixels, and refused at 1280."""
        shares = []
        for size in (1, 4, 8):
            width, height = 160 * size, 128 * size
            K = np.array([[120.0 * size, 0, width / 2], [0, 120.0 * size, height / 2], [0, 0, 1]])
            frames = EndoscopicSequence(
                "test/recording",
                np.zeros((2, height, width, 3), np.uint8),
                np.tile(K, (2, 1, 1)),
                np.ones((2, height, width), bool),
                Split("test", np.arange(2), np.arange(0)),
                metric=False,
                intrinsics="guessed",
            )
            parameters = (100.0 * size, 78.0 * size, 66.0 * size, -0.3, 0.05)
            lens = Lens("RADIAL", parameters, width, height)
            found = LensCalibration(lens, determined=True)
            posed = with_calibration(frames, found, IngestConfig(lens="native"))
            assert posed.lens is not None
            # Corners, where the fit is off by up to 2 % of the width, are no part of the picture.
            u, v = np.meshgrid(np.arange(width) + 0.5, np.arange(height) + 0.5)
            K = posed.K[0]
            x, y = posed.lens.undistorted((u - K[0, 2]) / K[0, 0], (v - K[1, 2]) / K[1, 1])
            seen_u, seen_v = lens.project(x, y)
            assert np.hypot(seen_u - u, seen_v - v)[posed.mask[0]].max() <= 2 / 640 * width
            shares.append(posed.mask.mean())
        np.testing.assert_allclose(shares, shares[0], atol=0.01)
        assert shares[0] > 0.9

    def test_a_pinhole_of_a_lens_that_is_kept_is_refused(self, room: EndoscopicSequence) -> None:
        both = IngestConfig(lens="native", field_of_view_deg=100)
        with pytest.raises(ConfigError, match=r"leave ingest\.field_of_view_deg out"):
            with_calibration(guessed(room), self.CALIBRATION, both)
