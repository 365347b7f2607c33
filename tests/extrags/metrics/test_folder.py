"""Renders made elsewhere: matched to frames, measured as our own, refused by file and reason."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
from PIL import Image

from data_catalog.images import save_images
from extrags import frame_stacks
from extrags.errors import ConfigError, NonFiniteError, ShapeError, SourceError, SourceNotFoundError
from extrags.frame_names import COLOR_SUFFIXES
from extrags.metrics.folder import _color, read_renders
from extrags.metrics.protocol import RenderedViews, evaluate_views
from extrags.sequence import EndoscopicSequence, Split
from tests.data_catalog.test_images import write_png_header

FRAMES, HEIGHT, WIDTH = 5, 24, 32
TEST = np.array([3, 1, 4])
LEVELS = np.random.default_rng(0).integers(0, 256, (FRAMES, HEIGHT, WIDTH, 3), dtype=np.uint8)


@pytest.fixture
def sequence() -> EndoscopicSequence:
    return EndoscopicSequence(
        name="made/up",
        rgb=LEVELS,
        K=np.tile(np.eye(3), (FRAMES, 1, 1)),
        mask=np.ones((FRAMES, HEIGHT, WIDTH), dtype=bool),
        split=Split("here", np.array([0, 2]), TEST),
        depth_mm=np.full((FRAMES, HEIGHT, WIDTH), 20.0, dtype=np.float32),
        frame_names=tuple(f"b_{index:04d}" for index in range(FRAMES)),
    )


def write(folder: Path, images: dict[str, np.ndarray]) -> Path:
    folder.mkdir(exist_ok=True)
    for name, image in images.items():
        Image.fromarray(image).save(folder / name)
    return folder


def test_names_decide_whatever_the_order(sequence: EndoscopicSequence, tmp_path: Path) -> None:
    folder = write(tmp_path / "renders", {f"b_{index:04d}.png": LEVELS[index] for index in range(FRAMES)})
    renders = read_renders(folder, sequence)
    np.testing.assert_array_equal(np.rint(renders.rgb * 255), LEVELS[TEST])
    assert evaluate_views(renders, sequence, TEST, None).metrics["psnr"] == 100
    assert renders.n_gaussians is None


def test_many_large_views_are_not_held_in_memory(
    sequence: EndoscopicSequence, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    folder = write(tmp_path / "renders", {f"b_{index:04d}.png": LEVELS[index] for index in TEST})
    (tmp_path / "depth").mkdir()
    for index in TEST:
        np.save(tmp_path / "depth" / f"b_{index:04d}.npy", np.full((HEIGHT, WIDTH), 20, np.float32))
    monkeypatch.setattr(frame_stacks, "MAPPED_BYTES", 0)
    renders = read_renders(folder, sequence, depth_folder=tmp_path / "depth")
    assert isinstance(renders.rgb.base, np.memmap)
    assert isinstance(renders.depth_mm.base, np.memmap)
    # What is the same everywhere takes no room.
    bare = read_renders(folder, sequence)
    assert renders.alpha.strides == bare.alpha.strides == bare.depth_mm.strides == (0, 0, 0)
    for found, error in ((renders, 0.0), (bare, None)):
        assert evaluate_views(found, sequence, TEST, None).metrics["depth_absrel"] == error


def test_hidden_files_are_none_of_them(sequence: EndoscopicSequence, tmp_path: Path) -> None:
    """macOS writes `._NAME` beside each file on drives of others, which is no image."""
    names = ("left/0", "left/1", "left/2", "left/3", "left/4")
    in_folders = replace(sequence, frame_names=names)
    folder = write(tmp_path / "renders", {f"b_{index:04d}.png": LEVELS[index] for index in TEST})
    write(folder / "left", {f"{index}.png": LEVELS[index] for index in TEST})
    for index in TEST:
        (folder / f"._b_{index:04d}.png").write_bytes(b"\0")
        (folder / "left" / f"._{index}.png").write_bytes(b"\0")
    write(folder / ".trash", {"b_0009.png": LEVELS[0]})
    for given in (sequence, in_folders):
        np.testing.assert_array_equal(np.rint(read_renders(folder, given).rgb * 255), LEVELS[TEST])


@pytest.mark.parametrize("suffix", COLOR_SUFFIXES)
def test_frames_named_like_files(sequence: EndoscopicSequence, tmp_path: Path, suffix: str) -> None:
    names = ("front", "left", "right", "above", "below")
    named = replace(sequence, frame_names=tuple(f"rgb/{name}{suffix}" for name in names))
    folder = write(tmp_path / "renders", {f"{names[index]}.png": LEVELS[index] for index in TEST})
    np.testing.assert_array_equal(np.rint(read_renders(folder, named).rgb * 255), LEVELS[TEST])


def test_webp_images_are_read(sequence: EndoscopicSequence, tmp_path: Path) -> None:
    folder = tmp_path / "renders"
    folder.mkdir()
    for index in TEST:
        Image.fromarray(LEVELS[index]).save(folder / f"b_{index:04d}.webp", lossless=True)
    np.testing.assert_array_equal(np.rint(read_renders(folder, sequence).rgb * 255), LEVELS[TEST])


class TestFramesOfSeveralRecordings:
    """As `extrags export` writes them; the numbers of each recording begin anew."""

    @pytest.fixture
    def several(self, sequence: EndoscopicSequence) -> EndoscopicSequence:
        names = ("0000", "0001", "0000", "0001", "0002")
        return replace(sequence, frame_names=names, recording=np.array([0, 0, 1, 1, 1]))

    def test_in_the_folders_of_an_export(self, several: EndoscopicSequence, tmp_path: Path) -> None:
        names = save_images(several, tmp_path)
        assert names[3] == "recording_1/0001.png"
        renders = read_renders(tmp_path / "images", several)
        np.testing.assert_array_equal(np.rint(renders.rgb * 255), LEVELS[TEST])
        (tmp_path / "images" / "recording_1" / "0002.png").unlink()
        with pytest.raises(SourceNotFoundError, match=r"no image: recording_1/0002$"):
            read_renders(tmp_path / "images", several)

    def test_bare_names_are_told_where_to_be(self, several: EndoscopicSequence, tmp_path: Path) -> None:
        folder = write(tmp_path / "bare", {f"{name}.png": LEVELS[0] for name in ("0000", "0001", "0002")})
        with pytest.raises(SourceError, match=r"\(0001\); put the images in .*recording_0, recording_1"):
            read_renders(folder, several)
        told_apart = replace(several, frame_names=("a0", "a1", "b0", "b1", "b2"))
        names = {f"{told_apart.frame_name(index)}.png": LEVELS[index] for index in TEST}
        renders = read_renders(write(tmp_path / "told_apart", names), told_apart)
        np.testing.assert_array_equal(np.rint(renders.rgb * 255), LEVELS[TEST])


class TestFramesOfDifferentFolders:
    """Two of the held-out frames, `left/0001` and `right/0001`, share a name."""

    NAMES = ("left/0000", "left/0001", "right/0000", "right/0001", "right/0002")

    @pytest.fixture
    def stereo(self, sequence: EndoscopicSequence) -> EndoscopicSequence:
        return replace(sequence, frame_names=self.NAMES)

    def write_in_folders(self, folder: Path, frames: tuple[int, ...]) -> Path:
        for index in frames:
            file = folder / f"{self.NAMES[index]}.png"
            file.parent.mkdir(parents=True, exist_ok=True)
            Image.fromarray(LEVELS[index]).save(file)
        return folder

    def test_folders_decide(self, stereo: EndoscopicSequence, tmp_path: Path) -> None:
        folder = self.write_in_folders(tmp_path / "renders", (0, 1, 2, 3, 4))
        np.testing.assert_array_equal(np.rint(read_renders(folder, stereo).rgb * 255), LEVELS[TEST])

    def test_one_is_missing(self, stereo: EndoscopicSequence, tmp_path: Path) -> None:
        folder = self.write_in_folders(tmp_path / "renders", (1, 4))
        with pytest.raises(SourceNotFoundError, match=r"1 of the 3 held-out frames .* no image: right/0001$"):
            read_renders(folder, stereo)

    def test_bare_names_could_be_of_several(self, stereo: EndoscopicSequence, tmp_path: Path) -> None:
        for names in (("0001", "0002"), ("0001", "0002", "0003")):
            folder = write(tmp_path / str(len(names)), {f"{name}.png": LEVELS[0] for name in names})
            with pytest.raises(SourceError, match=r"several held-out frames of made/up \(0001\)"):
                read_renders(folder, stereo)

    def test_other_names_go_by_number(self, stereo: EndoscopicSequence, tmp_path: Path) -> None:
        images = {f"view{place}.png": LEVELS[index] for place, index in enumerate(TEST)}
        renders = read_renders(write(tmp_path / "renders", images), stereo)
        np.testing.assert_array_equal(np.rint(renders.rgb * 255), LEVELS[TEST])

    def test_a_training_frame_of_that_name(self, stereo: EndoscopicSequence, tmp_path: Path) -> None:
        split = Split("here", np.array([0, 1]), np.array([2, 3]))
        images = {"0000.png": LEVELS[2], "0001.png": LEVELS[3]}
        renders = read_renders(write(tmp_path / "renders", images), replace(stereo, split=split))
        np.testing.assert_array_equal(np.rint(renders.rgb * 255), LEVELS[[2, 3]])


def test_images_of_frames_that_are_not_measured(sequence: EndoscopicSequence, tmp_path: Path) -> None:
    """As of frames that the estimate of poses left out: there may be some or none, by name."""
    folder = write(tmp_path / "renders", {f"b_{index:04d}.png": LEVELS[index] for index in (*TEST, 0)})
    Image.fromarray(LEVELS[2]).save(folder / "b_0007.png")
    with pytest.raises(SourceError, match=r"some are not: b_0007\.png"):
        read_renders(folder, sequence)
    views = read_renders(folder, sequence, not_measured=("b_0007", "b_0008"))
    np.testing.assert_array_equal(views.rgb, LEVELS[TEST].astype(np.float32) / 255)


def test_else_numbers_decide_and_nine_comes_before_ten(sequence: EndoscopicSequence, tmp_path: Path) -> None:
    folder = write(
        tmp_path / "renders",
        {"view9.png": LEVELS[3], "view10.png": LEVELS[1], "view100.png": LEVELS[4]},
    )
    np.testing.assert_array_equal(np.rint(read_renders(folder, sequence).rgb * 255), LEVELS[TEST])


def test_decimal_numbers_go_by_their_value(sequence: EndoscopicSequence, tmp_path: Path) -> None:
    """Times in seconds, as a renderer names its views by."""
    folder = write(tmp_path / "renders", {"0.05.png": LEVELS[3], "0.1.png": LEVELS[1], "0.15.png": LEVELS[4]})
    np.testing.assert_array_equal(np.rint(read_renders(folder, sequence).rgb * 255), LEVELS[TEST])


def test_where_the_order_of_numbers_is_open_it_is_told(
    sequence: EndoscopicSequence, tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    folder = write(tmp_path / "renders", {"1.9.png": LEVELS[3], "1.11.png": LEVELS[1], "1.12.png": LEVELS[4]})
    np.testing.assert_array_equal(np.rint(read_renders(folder, sequence).rgb * 255), LEVELS[TEST])
    assert "1.9 is read before 1.11" in caplog.text


def test_the_same_figures_as_our_own_renders(sequence: EndoscopicSequence, tmp_path: Path) -> None:
    rng = np.random.default_rng(1)
    rgb = (LEVELS[TEST] / 255 + rng.normal(0, 0.1, (3, HEIGHT, WIDTH, 3))).astype(np.float32)
    depth = rng.uniform(18, 25, (3, HEIGHT, WIDTH)).astype(np.float32)
    own = RenderedViews(rgb, np.ones_like(depth), depth, 9)
    levels = np.rint(np.clip(rgb, 0, 1) * 255).astype(np.uint8)
    folder = write(tmp_path / "renders", {f"{index}.png": image for index, image in enumerate(levels)})
    (tmp_path / "depth").mkdir()
    for index, image in enumerate(depth):
        np.save(tmp_path / "depth" / f"{index}.npy", image)
    there = read_renders(folder, sequence, depth_folder=tmp_path / "depth")
    ours = evaluate_views(own, sequence, TEST, None)
    theirs = evaluate_views(there, sequence, TEST, None)
    assert theirs.per_view == ours.per_view
    assert theirs.metrics == ours.metrics | {"n_gaussians": None}
    assert theirs.reasons["n_gaussians"] == "the renders were made elsewhere, or are not of Gaussians"


def test_without_depth_there_are_no_depth_figures(sequence: EndoscopicSequence, tmp_path: Path) -> None:
    folder = write(tmp_path / "renders", {f"{index}.png": LEVELS[index] for index in range(3)})
    result = evaluate_views(read_renders(folder, sequence), sequence, TEST, None)
    assert sequence.true_depth_mm is not None
    for group in (result.metrics, result.per_view[0]):
        assert {value for name, value in group.items() if name.startswith("depth_")} == {None}
    assert result.reasons["depth_absrel"] == "the renders came without depth"
    assert result.metrics["psnr"] is not None


def test_renders_without_depth_are_stored_as_such(sequence: EndoscopicSequence, tmp_path: Path) -> None:
    folder = write(tmp_path / "renders", {f"{index}.png": LEVELS[index] for index in range(3)})
    renders = read_renders(folder, sequence)
    renders.save(tmp_path / "stored")
    assert not RenderedViews.load(tmp_path / "stored").has_depth
    replace(renders, has_depth=True).save(tmp_path / "with")
    assert RenderedViews.load(tmp_path / "with").has_depth


def test_integer_depth_needs_its_step(sequence: EndoscopicSequence, tmp_path: Path) -> None:
    folder = write(tmp_path / "renders", {f"{index}.png": LEVELS[index] for index in range(3)})
    steps = np.full((HEIGHT, WIDTH), 2200, dtype=np.uint16)
    depth = write(tmp_path / "depth", {f"{index}.png": steps for index in range(3)})
    with pytest.raises(ConfigError, match="holds integers"):
        read_renders(folder, sequence, depth_folder=depth)
    for wrong in (0.0, -0.01, float("nan")):
        with pytest.raises(ConfigError, match="expected a length above zero"):
            read_renders(folder, sequence, depth_folder=depth, depth_step_mm=wrong)
    renders = read_renders(folder, sequence, depth_folder=depth, depth_step_mm=0.01)
    np.testing.assert_allclose(renders.depth_mm, 22.0, rtol=1e-6)


class TestRefused:
    def test_no_folder(self, sequence: EndoscopicSequence, tmp_path: Path) -> None:
        with pytest.raises(SourceNotFoundError, match="no such folder"):
            read_renders(tmp_path / "nowhere", sequence)
        with pytest.raises(SourceNotFoundError, match="holds no image"):
            read_renders(write(tmp_path / "empty", {}), sequence)

    def test_missing_frames_are_named(self, sequence: EndoscopicSequence, tmp_path: Path) -> None:
        folder = write(tmp_path / "renders", {"b_0001.png": LEVELS[1]})
        with pytest.raises(SourceNotFoundError, match=r"2 of the 3 held-out frames .*: b_0003, b_0004"):
            read_renders(folder, sequence)

    def test_strangers_among_frames(self, sequence: EndoscopicSequence, tmp_path: Path) -> None:
        folder = write(tmp_path / "renders", {"b_0001.png": LEVELS[1], "b_0077.png": LEVELS[2]})
        with pytest.raises(SourceError, match=r"some are not: b_0077\.png"):
            read_renders(folder, sequence)

    def test_another_count(self, sequence: EndoscopicSequence, tmp_path: Path) -> None:
        folder = write(tmp_path / "renders", {f"{index}.png": LEVELS[0] for index in range(4)})
        with pytest.raises(SourceNotFoundError, match="4 images for 3 held-out frames"):
            read_renders(folder, sequence)

    def test_no_number_or_the_same(self, sequence: EndoscopicSequence, tmp_path: Path) -> None:
        first = write(tmp_path / "first", {f"{name}.png": LEVELS[0] for name in ("a", "b1", "c2")})
        with pytest.raises(
            SourceError, match=r"images without a number in their names have no place: a\.png"
        ):
            read_renders(first, sequence)
        second = write(tmp_path / "second", {f"{name}.png": LEVELS[0] for name in ("a1", "b1", "c2")})
        with pytest.raises(SourceError, match=r"same number: a1\.png, b1\.png"):
            read_renders(second, sequence)

    def test_another_size_names_the_file(self, sequence: EndoscopicSequence, tmp_path: Path) -> None:
        images = {f"{index}.png": LEVELS[index] for index in range(3)} | {"1.png": LEVELS[1, :20]}
        with pytest.raises(ShapeError, match=r"1\.png: 32 x 20 pixels, but .* 32 x 24"):
            read_renders(write(tmp_path / "renders", images), sequence)

    def test_no_colours_or_no_image(self, sequence: EndoscopicSequence, tmp_path: Path) -> None:
        images = {f"{index}.png": LEVELS[index] for index in range(3)}
        folder = write(tmp_path / "renders", images | {"2.png": LEVELS[2, ..., 0]})
        with pytest.raises(SourceError, match="8-bit colour image, found the mode L") as refused:
            read_renders(folder, sequence)
        assert refused.value.file == str(folder / "2.png")
        (folder / "2.png").write_bytes(b"no image")
        with pytest.raises(SourceError, match="no image that can be read"):
            read_renders(folder, sequence)

    @pytest.mark.parametrize("suffix", ["png", "jpg", "tif", "bmp", "webp"])
    @pytest.mark.parametrize("size", [(160, 128), (216, 16)])
    def test_eight_bits_of_any_size_are_read(
        self, tmp_path: Path, suffix: str, size: tuple[int, int]
    ) -> None:
        Image.new("RGB", size, (200, 100, 50)).save(tmp_path / f"a.{suffix}")
        found = _color(tmp_path / f"a.{suffix}", (size[1], size[0]))
        np.testing.assert_allclose(found[0, 0], np.array([200, 100, 50]) / 255, atol=0.02)

    def test_sixteen_bits_are_not_cut_to_eight(self, sequence: EndoscopicSequence, tmp_path: Path) -> None:
        folder = write(tmp_path / "renders", {f"{index}.png": LEVELS[index] for index in range(3)})
        cv2.imwrite(str(folder / "1.png"), LEVELS[1].astype(np.uint16) * 257)
        with pytest.raises(SourceError, match="8-bit colour image, found the mode RGB of 16 bits") as refused:
            read_renders(folder, sequence)
        assert refused.value.file == str(folder / "1.png")

    def test_bad_depth(self, sequence: EndoscopicSequence, tmp_path: Path) -> None:
        folder = write(tmp_path / "renders", {f"{index}.png": LEVELS[index] for index in range(3)})
        depth = tmp_path / "depth"
        depth.mkdir()
        for index in range(3):
            np.save(depth / f"{index}.npy", np.full((HEIGHT, WIDTH), np.nan, dtype=np.float32))
        with pytest.raises(NonFiniteError, match=r"0\.npy"):
            read_renders(folder, sequence, depth_folder=depth)
        np.save(depth / "0.npy", np.ones((3, HEIGHT, WIDTH), dtype=np.float32))
        with pytest.raises(ShapeError, match="expected two dimensions"):
            read_renders(folder, sequence, depth_folder=depth)

    def test_places_in_a_palette_are_no_depth(self, sequence: EndoscopicSequence, tmp_path: Path) -> None:
        folder = write(tmp_path / "renders", {f"{index}.png": LEVELS[index] for index in range(3)})
        (tmp_path / "depth").mkdir()
        places = np.tile(np.arange(WIDTH, dtype=np.uint8), (HEIGHT, 1))
        for index in range(3):
            image = Image.fromarray(places)
            # Greys from bright to dark: the number of a pixel is not its place.
            image.putpalette([level for place in range(256) for level in [255 - place] * 3])
            image.save(tmp_path / "depth" / f"{index}.png")
        found = read_renders(folder, sequence, depth_folder=tmp_path / "depth", depth_step_mm=0.5)
        np.testing.assert_allclose(found.depth_mm[0], (255.0 - places) / 2)
        image.putpalette([level for place in range(256) for level in (place, 0, 255 - place)])
        image.save(tmp_path / "depth" / "1.png")
        with pytest.raises(SourceError, match=r"1\.png.*: colours of a palette") as refused:
            read_renders(folder, sequence, depth_folder=tmp_path / "depth", depth_step_mm=0.5)
        assert refused.value.file == str(tmp_path / "depth" / "1.png")

    def test_larger_than_the_memory(self, sequence: EndoscopicSequence, tmp_path: Path) -> None:
        folder = write(tmp_path / "r", {f"b_{index:04d}.png": LEVELS[index] for index in TEST})
        write_png_header(folder / "b_0003.png", 100_000, 100_000)
        with pytest.raises(SourceError, match=r"b_0003\.png: too large: more than the 178956970 pixels"):
            read_renders(folder, sequence)
