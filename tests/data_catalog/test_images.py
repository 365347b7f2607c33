"""Single images: what kinds of pixels become colours."""

from __future__ import annotations

import struct
import zlib
from pathlib import Path

import cv2
import numpy as np
import pytest
from PIL import Image, ImageOps

from data_catalog.image_pages import pages_in
from data_catalog.images import (
    UPRIGHT,
    color_files,
    orientation,
    read_color,
    read_depth,
    read_mask,
    read_upright,
    spread,
    upright_size,
)
from extrags.errors import SourceError

GREY = np.random.default_rng(0).integers(0, 2**16, (20, 30), dtype=np.uint16)


def written(file: Path, pixels: np.ndarray) -> Path:
    assert cv2.imwrite(str(file), pixels)
    return file


@pytest.mark.parametrize("name", ["a.png", "a.tif"])
class TestSixteenBits:
    def test_grey_is_the_high_byte(self, tmp_path: Path, name: str) -> None:
        found = read_color(written(tmp_path / name, GREY))
        assert found.dtype == np.uint8
        np.testing.assert_array_equal(found, np.repeat((GREY >> 8)[..., None], 3, axis=2))

    def test_a_mask_is_white_where_it_is_not_black(self, tmp_path: Path, name: str) -> None:
        """Of labels in 16 bits, 255 is white as well."""
        labels = np.where(GREY > 2**15, np.uint16(255), np.uint16(0))
        np.testing.assert_array_equal(read_mask(written(tmp_path / name, labels)), labels > 0)


def test_colours_of_sixteen_bits_are_the_high_byte(tmp_path: Path) -> None:
    colors = np.stack([GREY, GREY[::-1], GREY[:, ::-1]], axis=-1)
    found = read_color(written(tmp_path / "a.png", colors[..., ::-1]))
    np.testing.assert_array_equal(found, (colors >> 8).astype(np.uint8))


def test_alpha_is_dropped(tmp_path: Path) -> None:
    colors = np.random.default_rng(1).integers(0, 256, (20, 30, 4), dtype=np.uint8)
    found = read_color(written(tmp_path / "a.png", colors))
    np.testing.assert_array_equal(found, colors[..., 2::-1])


class TestOrientation:
    @pytest.mark.parametrize("name", ["a.jpg", "a.png"])
    def test_pixels_are_as_they_are_stored(self, tmp_path: Path, name: str) -> None:
        file = self.tagged(tmp_path / name)
        assert orientation(file) == 6
        assert read_color(file).shape == (20, 30, 3)

    def test_a_tiff_is_upright_once_it_is_read(self, tmp_path: Path) -> None:
        file = self.tagged(tmp_path / "a.tif")
        assert orientation(file) == UPRIGHT
        assert read_color(file).shape == (30, 20, 3)

    @pytest.mark.parametrize("tag", [1, 0, 9, None])
    def test_upright(self, tmp_path: Path, tag: int | None) -> None:
        assert orientation(self.tagged(tmp_path / "a.jpg", tag)) == UPRIGHT

    def test_damaged_exif_says_nothing(self, tmp_path: Path) -> None:
        file = self.tagged(tmp_path / "a.jpg")
        file.write_bytes(file.read_bytes().replace(b"Exif\0\0MM\0*", b"Exif\0\0MM\0?"))
        assert orientation(file) == UPRIGHT
        (tmp_path / "a.mp4").write_bytes(b"no image")
        assert orientation(tmp_path / "a.mp4") == UPRIGHT

    @pytest.mark.parametrize("tag", range(1, 9))
    def test_upright_is_what_viewers_show(self, tmp_path: Path, tag: int) -> None:
        file = self.tagged(tmp_path / "a.png", tag)
        with Image.open(file) as image:
            shown = ImageOps.exif_transpose(image)
        np.testing.assert_array_equal(read_upright(file), np.asarray(shown))
        np.testing.assert_array_equal(read_upright(file), cv2.imread(str(file))[..., ::-1])
        assert upright_size(file) == shown.size

    def test_a_tiff_is_not_turned_twice(self, tmp_path: Path) -> None:
        file = self.tagged(tmp_path / "a.tif")
        np.testing.assert_array_equal(read_upright(file), read_color(file))
        assert upright_size(file) == (20, 30)

    @staticmethod
    def tagged(file: Path, tag: int | None = 6) -> Path:
        exif = Image.Exif()
        if tag is not None:
            exif[274] = tag
        Image.fromarray((GREY >> 8).astype(np.uint8)).convert("RGB").save(file, exif=exif)
        return file


def test_floating_point_has_no_white(tmp_path: Path) -> None:
    file = written(tmp_path / "a.tif", GREY.astype(np.float32))
    with pytest.raises(SourceError, match=r"a\.tif, frame 7, field rgb: floating-point values; expected"):
        read_color(file, frame=7)


@pytest.mark.parametrize(
    ("pixels", "told"),
    [
        (np.zeros((8, 9, 3), np.float32), "colours in floating-point numbers of 32 bits, which are not read"),
        (np.zeros((8, 9), np.float64), "grey in floating-point numbers of 64 bits, which are not read"),
        (np.zeros((8, 9, 3), np.int16), "colours in signed integers of 16 bits, which are not read"),
        (np.zeros((8, 9, 3), np.uint32), "colours in integers of 32 bits, which are not read"),
    ],
)
def test_colours_that_are_not_read_are_said_to_be_of_their_kind(tmp_path: Path, pixels, told: str) -> None:
    """Floating-point colours of 32 bits were refused as numbers of more than 32."""
    file = written(tmp_path / "a.tif", pixels)
    with pytest.raises(
        SourceError, match=f"field rgb: {told}; expected integers of 8 or 16 bits without a s"
    ):
        read_color(file)
    if pixels.ndim == 3:
        with pytest.raises(
            SourceError, match=r"field depth: 3 channels of .*; expected one number per pixel"
        ):
            read_depth(file)


@pytest.mark.filterwarnings("ignore:Corrupt EXIF data")
def test_a_tiff_whose_description_is_damaged_is_said_to_be_damaged(tmp_path: Path) -> None:
    file = written(tmp_path / "a.tif", np.zeros((8, 9, 3), np.float32))
    file.write_bytes(file.read_bytes()[:60])
    with pytest.raises(SourceError, match=r"field rgb: .*damaged.* \(60 bytes\)"):
        read_color(file)


def test_a_tiff_that_is_not_read_is_not_said_to_be_no_image(tmp_path: Path) -> None:
    file = written(tmp_path / "a.tif", GREY.astype(np.float64))
    with pytest.raises(SourceError, match=r"field depth: a TIFF of a kind .* at most 32 bits, or damaged"):
        read_depth(file)
    file.write_bytes(b"no image")
    with pytest.raises(SourceError, match=r"field depth: not an image, or damaged from its first bytes"):
        read_depth(file)


@pytest.mark.parametrize("name", ["a.exr", "a.npz"])
def test_depth_of_another_format_is_said_to_be_that(tmp_path: Path, name: str) -> None:
    """It was said to be no image, or damaged."""
    (tmp_path / name).write_bytes(b"\x76\x2f\x31\x01" + bytes(100))
    expected = r"field depth: depth of this format is not read; expected \.npy, \.tiff, \.tif or \.png with"
    with pytest.raises(SourceError, match=expected):
        read_depth(tmp_path / name)


def test_webp_is_read(tmp_path: Path) -> None:
    colors = np.random.default_rng(1).integers(0, 256, (20, 30, 3), dtype=np.uint8)
    Image.fromarray(colors).save(tmp_path / "a.webp", lossless=True)
    np.testing.assert_array_equal(read_color(tmp_path / "a.webp"), colors)
    assert [file.name for file in color_files(tmp_path)] == ["a.webp"]
    Image.fromarray(np.full((20, 30, 3), 90, np.uint8)).save(tmp_path / "b.webp", quality=80)
    assert np.abs(read_color(tmp_path / "b.webp").astype(int) - 90).max() < 4


@pytest.mark.parametrize("name", ["a.tif", "a.webp", "a.png"])
def test_several_pictures_in_a_file_are_counted(tmp_path: Path, name: str) -> None:
    first, second = (Image.new("RGB", (20, 30), (value, 0, 0)) for value in (10, 200))
    first.save(tmp_path / name, save_all=True, append_images=[second])
    assert pages_in(tmp_path / name) == 2
    first.save(tmp_path / name)
    assert pages_in(tmp_path / name) == 1
    (tmp_path / name).write_bytes(b"damaged")
    assert pages_in(tmp_path / name) == 1


class TestDepthOfAPalette:
    """Programs that make files smaller store grey of few values so; false colours are stored the same."""

    VALUES = np.array([[0, 40, 200], [200, 7, 40]], np.uint8)

    def written(self, file: Path, colors: np.ndarray) -> Path:
        places = np.searchsorted(np.unique(self.VALUES), self.VALUES).astype(np.uint8)
        image = Image.fromarray(places, mode="P")
        image.putpalette(colors.astype(np.uint8).tobytes())
        image.save(file)
        return file

    def test_greys_are_what_they_stand_for(self, tmp_path: Path) -> None:
        greys = np.repeat(np.unique(self.VALUES)[:, None], 3, axis=1)
        found = read_depth(self.written(tmp_path / "a.png", greys))
        assert found.dtype == np.float32
        np.testing.assert_array_equal(found, self.VALUES)

    def test_colours_are_refused(self, tmp_path: Path) -> None:
        colors = np.array([[0, 0, 0], [255, 0, 0], [0, 255, 0], [0, 0, 255]])
        file = self.written(tmp_path / "a.png", colors)
        with pytest.raises(SourceError, match=r"a\.png, frame 3, field depth: colours of a palette"):
            read_depth(file, frame=3)


def test_a_tiff_tells_how_many_of_sixteen_bits_it_uses(tmp_path: Path) -> None:
    """Of 12 bits, packed, white is 4095."""
    values = np.array([[0, 2048, 4095, 16]], dtype=np.uint16)
    packed = b"".join(
        bytes([int(a) >> 4, (int(a) & 15) << 4 | int(b) >> 8, int(b) & 255]) for a, b in values.reshape(-1, 2)
    )
    entries = [(256, 4, 4), (257, 4, 1), (258, 3, 12), (259, 3, 1), (262, 3, 1), (273, 4, 8), (277, 3, 1)]
    entries += [(278, 4, 1), (279, 4, len(packed))]
    directory = struct.pack("<H", len(entries))
    for tag, kind, value in entries:
        directory += struct.pack("<HHI", tag, kind, 1) + struct.pack(
            "<HH" if kind == 3 else "<I", value, *[0] * (kind == 3)
        )
    file = tmp_path / "a.tif"
    file.write_bytes(b"II*\0" + struct.pack("<I", 8 + len(packed)) + packed + directory + bytes(4))
    np.testing.assert_array_equal(read_color(file)[0, :, 0], [0, 128, 255, 1])


class TestMasks:
    LABELS = np.zeros((20, 30), np.uint8)
    LABELS[5:, 8:] = 1

    @pytest.mark.parametrize("kind", [np.uint8, np.uint16, np.float32])
    def test_labels_of_nought_and_one(self, tmp_path: Path, kind: type) -> None:
        labels = self.LABELS.astype(kind)
        np.testing.assert_array_equal(read_mask(written(tmp_path / "a.tif", labels)), labels > 0)

    def test_all_of_one_label(self, tmp_path: Path) -> None:
        assert read_mask(written(tmp_path / "a.png", np.ones((20, 30), np.uint8))).all()
        assert not read_mask(written(tmp_path / "b.png", np.zeros((20, 30), np.uint8))).any()

    def test_a_palette_of_two_colours(self, tmp_path: Path) -> None:
        image = Image.fromarray(self.LABELS, mode="P")
        image.putpalette([0, 0, 0, 128, 0, 0])
        image.save(tmp_path / "a.png")
        np.testing.assert_array_equal(read_mask(tmp_path / "a.png"), self.LABELS > 0)

    def test_several_labels_are_refused(self, tmp_path: Path) -> None:
        labels = self.LABELS.copy()
        labels[15:] = 2
        with pytest.raises(SourceError, match=r"field mask: 3 values, of which 2 of 255 is the largest"):
            read_mask(written(tmp_path / "a.png", labels))

    @pytest.mark.parametrize("palette", [False, True])
    def test_labels_in_colours_are_refused(self, tmp_path: Path, palette: bool) -> None:
        """Tissue and instrument were both bright, so that nothing was masked."""
        image = Image.fromarray(self.LABELS, mode="P")
        image.putpalette([255, 114, 114, 170, 255, 0])
        (image if palette else image.convert("RGB")).save(tmp_path / "a.png")
        with pytest.raises(
            SourceError, match=r"a\.png, frame 7, field mask: labels in several colours .*\(170, 255, 0\)"
        ):
            read_mask(tmp_path / "a.png", frame=7)

    @pytest.mark.parametrize("color", [(255, 255, 0), (0, 0, 255), (255, 150, 0), (255, 255, 255)])
    def test_one_colour_on_black(self, tmp_path: Path, color: tuple[int, int, int]) -> None:
        labelled = Image.fromarray(self.LABELS[..., None] * np.array(color, np.uint8))
        labelled.save(tmp_path / "a.png")
        np.testing.assert_array_equal(read_mask(tmp_path / "a.png"), self.LABELS > 0)
        if color[0] == 255:
            # Shades between the two are no third label.
            labelled.resize((60, 40), Image.Resampling.BILINEAR).save(tmp_path / "b.png")
            assert 0.1 < read_mask(tmp_path / "b.png").mean() < 0.9

    @pytest.mark.parametrize("color", [(0, 255, 0), (255, 165, 0)])
    def test_one_colour_that_was_compressed(self, tmp_path: Path, color: tuple[int, int, int]) -> None:
        """Chroma of half the size bleeds over the edges."""
        large = np.kron(self.LABELS, np.ones((8, 8), np.uint8))
        Image.fromarray(large[..., None] * np.array(color, np.uint8)).save(tmp_path / "a.jpg", quality=90)
        Image.open(tmp_path / "a.jpg").save(tmp_path / "a.png")
        assert (read_mask(tmp_path / "a.png") == (large > 0)).mean() > 0.98

    def test_colours_of_what_is_transparent_are_no_labels(self, tmp_path: Path) -> None:
        image = np.zeros((20, 30, 4), np.uint8)
        image[..., 0] = 255
        image[self.LABELS > 0] = 255
        Image.fromarray(image).save(tmp_path / "a.png")
        read_mask(tmp_path / "a.png")

    def test_opacity_is_no_mask(self, tmp_path: Path) -> None:
        image = np.full((20, 30, 4), 255, np.uint8)
        image[..., 3] = 255 * self.LABELS
        with pytest.raises(SourceError, match="one colour throughout, and opaque in parts"):
            read_mask(written(tmp_path / "a.png", image))

    @pytest.mark.parametrize("extended", [False, True])
    def test_webp_holds_labels_where_it_is_lossless(self, tmp_path: Path, extended: bool) -> None:
        described = {"exif": Image.Exif()} if extended else {}
        image = Image.fromarray(self.LABELS)
        image.save(tmp_path / "a.webp", lossless=True, exact=True, **described)
        np.testing.assert_array_equal(read_mask(tmp_path / "a.webp"), self.LABELS > 0)
        noise = np.random.default_rng(0).integers(0, 9, (20, 30), dtype=np.uint8)
        Image.fromarray(noise).save(tmp_path / "b.webp", quality=90, **described)
        assert not read_mask(tmp_path / "b.webp").any()
        Image.fromarray(self.LABELS * 255).save(tmp_path / "c.webp", quality=90, **described)
        assert (read_mask(tmp_path / "c.webp") == self.LABELS).mean() > 0.95

    def test_black_of_a_jpeg_is_not_all_of_one_value(self, tmp_path: Path) -> None:
        noise = np.random.default_rng(0).integers(0, 6, (20, 30), dtype=np.uint8)
        assert not read_mask(written(tmp_path / "a.jpg", noise)).any()


def test_spread_keeps_both_ends() -> None:
    assert spread(5, None) == [0, 1, 2, 3, 4]
    assert spread(100, 3) == [0, 50, 99]


def write_png_header(file: Path, width: int, height: int, *, bits: int = 8) -> Path:
    """An image of any size in a few bytes, as far as its header says."""
    chunks = ((b"IHDR", struct.pack(">IIBBBBB", width, height, bits, 0, 0, 0, 0)), (b"IDAT", b""))
    parts = [
        struct.pack(">I", len(body)) + kind + body + struct.pack(">I", zlib.crc32(kind + body))
        for kind, body in chunks
    ]
    file.write_bytes(b"\x89PNG\r\n\x1a\n" + b"".join(parts))
    return file


class TestTooLarge:
    """What would fill the memory is not called damaged, and nothing of it is unpacked."""

    def test_a_picture(self, tmp_path: Path) -> None:
        file = write_png_header(tmp_path / "a.png", 100_000, 100_000)
        for read in (read_color, read_mask, read_depth):
            with pytest.raises(SourceError, match=r"a\.png.*: too large: more than the 178956970 pixels"):
                read(file)

    def test_an_array(self, tmp_path: Path) -> None:
        file = tmp_path / "a.npy"
        with file.open("wb") as stream:
            header = {"descr": "<f4", "fortran_order": False, "shape": (100_000, 100_000)}
            np.lib.format.write_array_header_1_0(stream, header)
            stream.truncate(stream.tell() + 4 * 100_000**2)
        with pytest.raises(SourceError, match=r"a\.npy.* 100000 x 100000 numbers, more than the 178956970"):
            read_depth(file)
