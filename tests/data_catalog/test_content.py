"""The round picture, the dark frame and burnt-in text."""

from __future__ import annotations

import cv2
import numpy as np
import pytest
from PIL import Image

from data_catalog.content import Circle, content_circle, content_mask, overlay_mask, view_mask


def rim(x: float, y: float, radius: float) -> Circle:
    return Circle(float(x), float(y), float(radius), 1.0)


def moving_scene(frames: int, width: int = 320, height: int = 180, speed: int = 7) -> np.ndarray:
    """A textured picture that slides under the image."""
    rng = np.random.default_rng(0)
    small = rng.integers(60, 190, (height // 6, (width + speed * frames) // 6 + 2, 3)).astype(np.uint8)
    large = cv2.resize(small, None, fx=6, fy=6, interpolation=cv2.INTER_CUBIC)
    return np.stack([large[:height, k * speed : k * speed + width] for k in range(frames)])


def in_a_circle(scene: np.ndarray, circle: Circle) -> np.ndarray:
    inside = circle.mask(scene.shape[2], scene.shape[1])
    noise = np.random.default_rng(1).integers(0, 8, scene.shape)
    return np.where(inside[None, ..., None], scene, noise).astype(np.uint8)


def signed(scene: np.ndarray) -> np.ndarray:
    for k, image in enumerate(scene):
        cv2.putText(image, "PATIENT 14", (70, 150), cv2.FONT_HERSHEY_SIMPLEX, 0.5, (255, 255, 255), 1)
        cv2.putText(image, f"{k % 10}", (190, 150), cv2.FONT_HERSHEY_SIMPLEX, 0.5, (80, 255, 80), 1)
    return scene


class TestCircle:
    @pytest.mark.parametrize(
        "circle",
        [
            rim(160, 90, 80),
            rim(150.3, 95.7, 110),
            rim(200, 60, 140),
            rim(100, 90, 70),
        ],
        ids=["whole", "cut above and below", "cut on three sides", "left"],
    )
    def test_found_to_a_pixel(self, circle) -> None:
        found = content_circle(in_a_circle(moving_scene(6), circle))
        assert found is not None
        assert abs(found.center_x - circle.center_x) < 1.5
        assert abs(found.center_y - circle.center_y) < 1.5
        assert abs(found.radius_px - circle.radius_px) < 1.5

    def test_a_dark_side_does_not_move_it(self) -> None:
        """Half the picture is unlit in every frame: the lit rim still tells the circle."""
        circle = rim(160, 90, 84)
        scene = in_a_circle(moving_scene(6), circle)
        scene[:, 110:, 60:110] = 4
        found = content_circle(scene)
        assert found is not None
        assert abs(found.radius_px - 84) < 2

    @pytest.mark.parametrize("middle", [(310, 90), (160, 172), (12, 10)], ids=["right", "below", "corner"])
    def test_a_round_lumen_at_the_border_is_no_picture(self, middle) -> None:
        """Its rim is a circle, too: the mask would keep the lumen and leave the tissue out."""
        scene = moving_scene(6)
        lumen = rim(*middle, 60).mask(320, 180)
        scene[:, lumen] = 5
        assert content_circle(scene) is None
        kept = content_mask(scene)
        assert kept[~lumen].mean() > 0.97

    @pytest.mark.parametrize(
        ("middle_x", "columns"), [(160, 60), (160, 75), (210, 120)], ids=["narrow", "to the border", "wide"]
    )
    def test_a_lit_panel_that_touches_the_picture_stays_outside(self, middle_x, columns) -> None:
        """The processor's menu: more than a tenth of all that is lit is no part of the round picture."""
        circle = rim(middle_x, 90, 80)
        scene = in_a_circle(moving_scene(6), circle)
        panel = np.zeros((180, 320), bool)
        panel[70:112, middle_x - 75 - columns : middle_x - 75] = True
        panel &= ~circle.mask(320, 180)
        assert panel.sum() > 0.1 * circle.mask(320, 180).sum()
        scene[:, panel] = 90
        found = content_circle(scene)
        assert found is not None
        assert abs(found.radius_px - 80) < 1.5
        mask = content_mask(scene)
        assert not mask[~circle.mask(320, 180)].any()
        assert mask[circle.mask(320, 180, 4.0)].all()

    @pytest.mark.parametrize("level", [16, 30])
    def test_a_surround_that_is_not_quite_black(self, level) -> None:
        """As of a video whose black level was left at 16."""
        circle = rim(160, 90, 84)
        scene = moving_scene(6)
        noise = np.random.default_rng(2).integers(level - 1, level + 2, scene.shape)
        scene = np.where(circle.mask(320, 180)[None, ..., None], scene, noise).astype(np.uint8)
        found = content_circle(scene)
        assert found is not None
        assert abs(found.radius_px - 84) < 1.5
        mask = content_mask(scene)
        assert not mask[~circle.mask(320, 180)].any()
        assert mask[circle.mask(320, 180, 4.0)].all()

    def test_dark_corners_of_a_full_picture_are_no_surround(self) -> None:
        """They differ from each other, and from frame to frame."""
        scene = moving_scene(6)
        scene[:, :12, :20] = scene[:, :12, :20] // 8
        scene[:, -12:, -20:] = scene[:, -12:, -20:] // 8
        scene[:, :12, -20:] = scene[:, :12, -20:] // 9
        scene[:, -12:, :20] = scene[:, -12:, :20] // 9
        assert content_mask(scene).mean() > 0.97

    def test_corners_of_a_full_picture_that_are_all_dim_are_no_surround(self) -> None:
        """They are bright enough to be told from black, and of many values."""
        scene = moving_scene(6)
        for rows in (slice(40), slice(-40, None)):
            for columns in (slice(60), slice(-60, None)):
                scene[:, rows, columns] = 14 + scene[:, rows, columns] // 10
        corners = scene[:, :12, :20].max(axis=-1)
        assert corners.min() > 14
        assert 18 < corners.max() < 40
        mask = content_mask(scene)
        # The steady edges round the dim corners are taken for burnt-in signs.
        assert mask[:30, :50].all()
        assert mask[:30, -50:].all()
        assert mask[-30:, :50].all()
        assert mask[-30:, -50:].all()

    def test_a_dim_picture_is_no_surround(self) -> None:
        """Its corners are of one value; the rest is hardly brighter."""
        scene = moving_scene(6) // 8 + 16
        scene[:, :60] = 16
        scene[:, -20:] = 16
        assert content_mask(scene).all()

    def test_few_frames_do_not_tell_a_surround_that_is_not_black(self) -> None:
        """What is of one value in three frames may be tissue that the scope did not move across."""
        scene = moving_scene(4)
        scene[:, :20] = scene[:, -20:] = 20
        assert content_mask(scene[:3]).all()
        assert not content_mask(scene)[:20].any()

    @pytest.mark.parametrize("shape", ["full", "rectangle"])
    def test_no_circle_where_there_is_none(self, shape) -> None:
        scene = moving_scene(6)
        if shape == "rectangle":
            scene[:, :20] = scene[:, -20:] = 3
            scene[:, :, :40] = scene[:, :, -40:] = 3
        assert content_circle(scene) is None
        mask, seen = content_mask(scene), view_mask(scene)
        if shape == "full":
            assert mask.all()
        else:
            # Less a rim of two pixels.
            assert not (mask & ~seen).any()
            np.testing.assert_array_equal(mask[22:-22, 42:-42], seen[22:-22, 42:-42])
            assert mask[22:-22, 42:-42].all()

    def test_real_pictures(self, shared_data) -> None:
        """Laparoscopes of 15 operations: text and logos beside the picture stay outside."""
        files = sorted((shared_data / "laparoscopy_frames_40").glob("*.jpg"))[::4]
        for file in files:
            image = np.array(Image.open(file).resize((640, 360), Image.Resampling.BOX))
            found = content_circle(image[None])
            assert found is not None, file.name
            assert 225 < found.radius_px < 330
            inside = found.mask(640, 360)
            assert image[~inside].max(axis=-1).mean() < 12
            assert not inside[:, :8].any()


class TestOutline:
    @staticmethod
    def octagon(width: int = 320, height: int = 180, cut: int = 40) -> np.ndarray:
        """A picture with cut corners, as most gastroscopes show it."""
        corners = [(130, 10), (310, 10), (310, 170), (130, 170)]
        mask = np.zeros((height, width), np.uint8)
        cv2.fillConvexPoly(mask, np.array(corners), 1)
        x, y = np.meshgrid(np.arange(width), np.arange(height))
        for corner_x, corner_y in corners:
            mask[np.abs(x - corner_x) + np.abs(y - corner_y) < cut] = 0
        return mask > 0

    def test_an_octagon_with_text_beside_it(self) -> None:
        shape = self.octagon()
        scene = np.where(shape[None, ..., None], moving_scene(12), 0).astype(np.uint8)
        for image in scene:
            cv2.putText(image, "A. PATIENT", (4, 60), cv2.FONT_HERSHEY_SIMPLEX, 0.5, (255, 255, 255), 2)
            cv2.rectangle(image, (10, 100), (100, 160), (90, 90, 90), -1)
        mask = content_mask(scene)
        assert not (mask & ~shape).any()
        kept = cv2.erode(shape.astype(np.uint8), np.ones((7, 7), np.uint8)) > 0
        assert mask[kept].all()

    def test_text_inside_an_octagon(self) -> None:
        shape = self.octagon()
        scene = np.where(shape[None, ..., None], moving_scene(12), 0).astype(np.uint8)
        for image in scene:
            cv2.putText(image, "12:30", (180, 150), cv2.FONT_HERSHEY_SIMPLEX, 0.5, (255, 255, 255), 1)
        mask = content_mask(scene)
        assert mask[140:150, 182:220].mean() < 0.2
        assert mask[40:120, 150:290].all()

    def test_a_dark_lumen_at_the_rim_belongs_to_the_picture(self) -> None:
        shape = self.octagon()
        scene = np.where(shape[None, ..., None], moving_scene(12), 0).astype(np.uint8)
        x, y = np.meshgrid(np.arange(320), np.arange(180))
        light = 1 - np.exp(-((x - 312) ** 2 + (y - 95) ** 2) / (2 * 30.0**2))
        scene = (scene * light[None, ..., None]).astype(np.uint8)
        assert not view_mask(scene)[95, 305]
        assert content_mask(scene)[80:110, 290:305].all()

    def test_all_black(self) -> None:
        assert not content_mask(np.zeros((5, 90, 160, 3), np.uint8)).any()


class TestOverlay:
    def test_text_over_a_moving_scene(self) -> None:
        scene = moving_scene(12)
        plain = scene.copy()
        found = overlay_mask(signed(scene), np.ones(scene.shape[1:3], bool))
        letters = (scene != plain).any(axis=-1)
        always = letters.all(axis=0)
        assert found[always].mean() > 0.97
        assert found.sum() < 5 * always.sum()
        assert not overlay_mask(plain, np.ones(scene.shape[1:3], bool)).any()

    def test_a_scene_that_stands_still_has_no_text(self) -> None:
        scene = np.repeat(moving_scene(1), 10, axis=0)
        assert not overlay_mask(signed(scene), np.ones(scene.shape[1:3], bool)).any()

    def test_too_few_frames_tell_nothing(self) -> None:
        scene = signed(moving_scene(3))
        assert not overlay_mask(scene, np.ones(scene.shape[1:3], bool)).any()

    def test_real_text(self, shared_data) -> None:
        """Gas flow and pressure in the lower left corner, over forty frames of fifteen operations."""
        files = sorted((shared_data / "laparoscopy_frames_40").glob("*.jpg"))
        frames = np.stack(
            [np.array(Image.open(file).resize((640, 360), Image.Resampling.BOX)) for file in files]
        )
        found = overlay_mask(frames, np.ones((360, 640), bool))
        rows, columns = np.nonzero(found[:355])
        assert found[325:352, 40:110].mean() > 0.3
        assert columns.max() < 140
        assert rows.min() > 320


def test_everything_together() -> None:
    circle = rim(160, 90, 84)
    scene = signed(in_a_circle(moving_scene(40), circle))
    mask = content_mask(scene)
    expected = circle.mask(320, 180, 2.0)
    assert not mask[~circle.mask(320, 180)].any()
    assert (expected & ~mask).mean() < 0.08
    assert not mask[144:148, 120:160].all()


def test_large_frames_are_looked_at_small() -> None:
    circle = rim(640, 360, 330)
    scene = in_a_circle(moving_scene(4, 1280, 720), circle)
    mask = content_mask(scene)
    assert mask.shape == (720, 1280)
    assert (mask != circle.mask(1280, 720, 8.0)).mean() < 0.01
