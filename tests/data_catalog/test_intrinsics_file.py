"""`intrinsics.json` beside plain frames, videos and lists: what it says is not passed over."""

from __future__ import annotations

import json
import logging

import numpy as np
import pytest
from PIL import Image

from data_catalog.catalog import read
from data_catalog.inspection import inspect
from data_catalog.readers.frames_folder import read_intrinsics
from extrags.config import IngestConfig
from extrags.errors import SourceError

WIDTH, HEIGHT = 48, 32
K = [[40.0, 0, 24], [0, 40.0, 16], [0, 0, 1]]
PINHOLE = {"fx": 40, "fy": 40, "cx": 24, "cy": 16}

WHOLE = IngestConfig(crop_surround=False)


@pytest.fixture
def stated(tmp_path):
    """K from a file with other entries."""

    def found(**entries) -> np.ndarray:
        (tmp_path / "intrinsics.json").write_text(json.dumps({"K": K, **entries}))
        return read_intrinsics(tmp_path, WIDTH, HEIGHT)

    return found


SIZES = [
    *({first: WIDTH, second: HEIGHT} for first, second in (("width", "height"), ("w", "h"))),
    *(
        {first: WIDTH, second: HEIGHT}
        for first, second in (("Width", "Height"), ("imageWidth", "imageHeight"))
    ),
    {"image_width": WIDTH, "image_height": HEIGHT},
    *({name: [WIDTH, HEIGHT]} for name in ("image_size", "imageSize", "img_size", "resolution")),
    {"resolution": f"{WIDTH}x{HEIGHT}"},
]


class TestSizes:
    @pytest.mark.parametrize("told", SIZES, ids=str)
    def test_the_same(self, stated, caplog, told) -> None:
        np.testing.assert_array_equal(stated(**told), K)
        assert not caplog.messages

    @pytest.mark.parametrize("told", SIZES, ids=str)
    def test_another_is_refused(self, stated, told) -> None:
        def twice(value):
            if isinstance(value, str):
                return f"{2 * WIDTH}x{2 * HEIGHT}"
            return [2 * size for size in value] if isinstance(value, list) else 2 * value

        with pytest.raises(SourceError, match="for images of 96 x 64 pixels; found 48 x 32") as caught:
            stated(**{name: twice(value) for name, value in told.items()})
        assert caught.value.field == next(iter(told))

    def test_one_of_the_two(self, stated) -> None:
        stated(width=WIDTH)
        with pytest.raises(SourceError, match=r"field image_height: for images of \? x 31 pixels"):
            stated(image_height=31)

    def test_programs_that_do_not_know_it(self, stated) -> None:
        np.testing.assert_array_equal(stated(width=0, height=0, image_size=[0, 0], w=None), K)

    @pytest.mark.parametrize("told", [{"resolution": "full"}, {"image_size": 48}, {"width": "wide"}], ids=str)
    def test_no_size(self, stated, told) -> None:
        with pytest.raises(SourceError, match="expected") as caught:
            stated(**told)
        assert caught.value.field == next(iter(told))


class TestOtherEntries:
    def test_skew(self, stated) -> None:
        np.testing.assert_array_equal(stated(skew=0.0), K)
        with pytest.raises(SourceError, match=r"field skew: 3\.0; expected 0"):
            stated(skew=3.0)

    def test_unknown_keys_are_told_of(self, stated, caplog) -> None:
        with caplog.at_level(logging.WARNING):
            stated(unit="normalized", _note="of Monday", distortion=[0, 0])
        (said,) = caplog.messages
        assert said.endswith("unknown keys are ignored: 'unit'")

    def test_what_is_misspelt_is_a_finding(self, tmp_path) -> None:
        texture = np.random.default_rng(0).integers(40, 255, (HEIGHT, WIDTH + 8, 3)).astype(np.uint8)
        for number in range(4):
            Image.fromarray(texture[:, number : number + WIDTH]).save(tmp_path / f"{number}.png")
        (tmp_path / "intrinsics.json").write_text(json.dumps({"K": K, "feild_of_view_deg": 60}))
        (found,) = (item for item in inspect(tmp_path).findings if item.topic == "unknown key")
        assert found.field == "feild_of_view_deg"

    def test_frames_are_no_entry_of_it(self, stated) -> None:
        np.testing.assert_array_equal(stated(frames=3), K)


class TestAFieldOfView:
    """Stated alone, it is that of the picture inside the frame, which endoscopes are sold with."""

    @staticmethod
    def written(folder, shown: np.ndarray) -> None:
        texture = np.random.default_rng(0).integers(60, 255, (120, 208, 3)).astype(np.uint8)
        for number in range(6):
            image = np.where(shown[..., None], texture[:, number : number + 200], 0)
            Image.fromarray(image.astype(np.uint8)).save(folder / f"{number}.png")

    def test_it_belongs_to_the_round_picture(self, tmp_path) -> None:
        u, v = np.meshgrid(np.arange(200) + 0.5, np.arange(120) + 0.5)
        self.written(tmp_path, np.hypot(u - 110, v - 60) < 50)
        (tmp_path / "intrinsics.json").write_text(json.dumps({"field_of_view_deg": 70}))
        found = read(tmp_path, WHOLE)
        assert found.intrinsics == "given"
        np.testing.assert_allclose(found.K[0, :2, 2], [110, 60], atol=1.5)
        assert found.K[0, 0, 0] == pytest.approx(50 / np.tan(np.radians(35)), abs=3)

    def test_a_pinhole_beside_the_same_picture_stays(self, tmp_path) -> None:
        u, v = np.meshgrid(np.arange(200) + 0.5, np.arange(120) + 0.5)
        self.written(tmp_path, np.hypot(u - 110, v - 60) < 50)
        stated = {"fx": 71, "fy": 71, "cx": 112, "cy": 58}
        (tmp_path / "intrinsics.json").write_text(json.dumps(stated))
        np.testing.assert_array_equal(read(tmp_path, WHOLE).K[0], [[71, 0, 112], [0, 71, 58], [0, 0, 1]])

    @pytest.mark.parametrize("name", ["fov", "hfov_deg", "Field_Of_View", "camera_angle_x"])
    def test_under_another_name_it_is_told_how_it_is_called(self, tmp_path, name) -> None:
        (tmp_path / "intrinsics.json").write_text(json.dumps({name: 70}))
        told = rf"no K.*\({name} is not read: write .* in degrees, as field_of_view_deg\); expected K"
        with pytest.raises(SourceError, match=told):
            read_intrinsics(tmp_path, WIDTH, HEIGHT)

    @pytest.mark.parametrize("angle", [0.5, 1.2217, 3.1])
    def test_radians_are_questioned(self, tmp_path, angle) -> None:
        (tmp_path / "intrinsics.json").write_text(json.dumps({"field_of_view_deg": angle}))
        with pytest.raises(SourceError, match=f"radians, write {np.degrees(angle):.4g}, and") as refused:
            read_intrinsics(tmp_path, WIDTH, HEIGHT)
        assert refused.value.field == "field_of_view_deg"
        # What numbers of pixels bear out is an angle in degrees.
        focal_px = WIDTH / 2 / np.tan(np.radians(2) / 2)
        narrow = {"fx": focal_px, "fy": focal_px, "cx": WIDTH / 2, "cy": HEIGHT / 2, "field_of_view_deg": 2}
        (tmp_path / "intrinsics.json").write_text(json.dumps(narrow))
        assert read_intrinsics(tmp_path, WIDTH, HEIGHT)[0, 0] == pytest.approx(focal_px)


class TestToldTwice:
    @pytest.mark.parametrize(
        ("further", "field", "told"),
        [
            ({"fx": 50}, "fx, K", "50 px, and 40 px by K"),
            ({"cx": 30}, "cx, K", "30 px, and 24 px by K"),
            ({"field_of_view_deg": 90}, "field_of_view_deg, K", "90 degrees over 48 pixels .* 24 px"),
        ],
    )
    def test_a_contradiction_is_refused(self, stated, further, field, told) -> None:
        with pytest.raises(SourceError, match=f"{told}.*expected one of the two") as caught:
            stated(**further)
        assert (caught.value.field, caught.value.file.endswith("intrinsics.json")) == (field, True)

    def test_a_pinhole_and_another_angle(self, tmp_path) -> None:
        (tmp_path / "intrinsics.json").write_text(json.dumps({**PINHOLE, "field_of_view_deg": 90}))
        with pytest.raises(SourceError, match="fx makes it 40"):
            read_intrinsics(tmp_path, WIDTH, HEIGHT)

    def test_an_angle_and_half_a_pinhole(self, tmp_path) -> None:
        (tmp_path / "intrinsics.json").write_text(json.dumps({"cx": 24, "cy": 16, "field_of_view_deg": 90}))
        with pytest.raises(SourceError, match="no fx, fy; expected K, or fx"):
            read_intrinsics(tmp_path, WIDTH, HEIGHT)

    def test_the_same_is_let_pass(self, stated) -> None:
        # 61.93 degrees.
        np.testing.assert_array_equal(stated(**PINHOLE, field_of_view_deg=62), K)


class TestBesideTheImages:
    @pytest.mark.parametrize("in_folder", [False, True])
    def test_it_is_not_read_there(self, tmp_path, caplog, in_folder) -> None:
        images = tmp_path / "images"
        images.mkdir()
        texture = np.random.default_rng(0).integers(40, 255, (HEIGHT, WIDTH + 8, 3)).astype(np.uint8)
        for number in range(4):
            Image.fromarray(texture[:, number : number + WIDTH]).save(images / f"{number}.png")
        (images / "intrinsics.json").write_text(json.dumps({"K": K}))
        if in_folder:
            (tmp_path / "intrinsics.json").write_text(json.dumps({"K": K}))
        found = read(tmp_path)
        expected = f"{images / 'intrinsics.json'} is not read; intrinsics are read from {tmp_path}"
        assert any(line.startswith(expected) for line in caplog.messages)
        assert found.intrinsics == ("given" if in_folder else "guessed")
