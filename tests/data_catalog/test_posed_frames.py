"""What all readers share: frames that become a sequence."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from PIL import Image
from scipy.spatial.transform import Rotation

from data_catalog.posed_frames import PosedFrame, SourceFrames, assembled
from extrags.config import IngestConfig
from extrags.errors import SourceError
from extrags.lens import Lens

WIDTH, HEIGHT = 40, 30
CONFIG = IngestConfig(holdout_every=2)
PLAIN = Lens.pinhole(np.array([[30.0, 0, 20], [0, 30.0, 15], [0, 0, 1]]), WIDTH, HEIGHT)


def source(
    folder: Path, lenses: list[Lens], poses: np.ndarray | None = None, **changes: object
) -> SourceFrames:
    """A frame for each lens; all have one mask."""
    generator = np.random.default_rng(0)
    frames = []
    for index, lens in enumerate(lenses):
        file = folder / f"{index}.png"
        Image.fromarray(generator.integers(0, 255, (HEIGHT, WIDTH, 3), dtype=np.uint8)).save(file)
        pose = np.eye(4) if poses is None else poses[index]
        frames.append(PosedFrame(file.name, file, lens, pose, mask_file=folder / "mask.png"))
    white = np.zeros((HEIGHT, WIDTH), np.uint8)
    white[4:26, 6:33] = 255
    Image.fromarray(white).save(folder / "mask.png")
    return SourceFrames(frames, folder / "poses.txt", metric=True, **changes)  # type: ignore[arg-type]


def test_one_mask_file_is_seen_through_the_lens_of_each_frame(tmp_path: Path) -> None:
    barrel = Lens("OPENCV", (30.0, 30.0, 20.0, 15.0, -0.2, 0.03, 0.0, 0.0), WIDTH, HEIGHT)
    pincushion = Lens("OPENCV", (30.0, 30.0, 20.0, 15.0, 0.15, 0.0, 0.0, 0.0), WIDTH, HEIGHT)
    together = assembled(source(tmp_path, [barrel, pincushion, barrel]), CONFIG, "made/up")
    for index, lens in enumerate((barrel, pincushion, barrel)):
        alone = assembled(source(tmp_path, [lens] * 2), CONFIG, "made/up")
        np.testing.assert_array_equal(together.mask[index], alone.mask[0])
    assert not np.array_equal(together.mask[0], together.mask[1])


def test_rounded_poses_become_rigid_and_rigid_ones_keep_every_digit(tmp_path: Path) -> None:
    exact = np.tile(np.eye(4), (3, 1, 1))
    exact[:, :3, :3] = Rotation.random(3, random_state=np.random.default_rng(0)).as_matrix()
    exact[:, :3, 3] = [[1.0, 2, 3], [4, 5, 6], [7, 8, 9]]
    given = exact.copy()
    given[1, :3, :3] = np.round(given[1, :3, :3], 5)
    found = assembled(source(tmp_path, [PLAIN] * 3, given), CONFIG, "made/up").world_from_camera
    assert found is not None
    np.testing.assert_array_equal(found[[0, 2]], exact[[0, 2]])
    rotation = found[1, :3, :3]
    np.testing.assert_allclose(rotation @ rotation.T, np.eye(3), atol=1e-14)
    np.testing.assert_allclose(rotation, exact[1, :3, :3], atol=1e-5)
    np.testing.assert_array_equal(found[1, :3, 3], exact[1, :3, 3])


@pytest.mark.parametrize(
    ("size", "said"),
    [
        ((80, 60), "belong to images 2 times as large; scale them"),
        ((20, 15), "belong to images 0.5 times as large; scale them"),
        ((80, 40), "the proportions differ too"),
    ],
)
def test_intrinsics_of_another_size_are_told_by_how_much(
    tmp_path: Path, size: tuple[int, int], said: str
) -> None:
    lens = Lens.pinhole(np.array([[9.0, 0, 5], [0, 9.0, 4], [0, 0, 1]]), *size)
    frames = source(tmp_path, [lens] * 2, intrinsics_file=tmp_path / "intrinsics.json")
    with pytest.raises(SourceError, match=said):
        assembled(frames, CONFIG, "made/up")


@pytest.mark.parametrize("field", ["mask", "depth"])
@pytest.mark.parametrize("size", [(30, 40), (80, 60)])
def test_masks_and_depth_have_the_size_of_their_images(
    tmp_path: Path, field: str, size: tuple[int, int]
) -> None:
    width, height = size
    frames = source(tmp_path, [PLAIN] * 2)
    file = tmp_path / f"{field}.png"
    values = np.full((height, width), 200, np.uint8 if field == "mask" else np.uint16)
    Image.fromarray(values).save(file)
    if field == "depth":
        frames = replace(frames, frames=[replace(frame, depth_file=file) for frame in frames.frames])
    said = (
        f"{field}.png, frame 0.png, field {field}: {width} x {height} pixels; expected 40 x 30 as the image"
    )
    with pytest.raises(SourceError, match=said):
        assembled(frames, CONFIG, "made/up")


@pytest.mark.parametrize(
    ("opacity", "masked", "is_told"), [(127, False, True), (128, False, False), (0, True, False)]
)
def test_transparent_pixels_without_a_mask_are_told_once(
    tmp_path: Path, caplog: pytest.LogCaptureFixture, opacity: int, masked: bool, is_told: bool
) -> None:
    found = source(tmp_path, [PLAIN] * 4)
    for frame in found.frames[1:]:
        image = Image.open(frame.file).convert("RGBA")
        alpha = np.full((HEIGHT, WIDTH), 255, np.uint8)
        alpha[:, :20] = opacity
        image.putalpha(Image.fromarray(alpha))
        image.save(frame.file)
    if not masked:
        found = replace(found, frames=[replace(frame, mask_file=None) for frame in found.frames])
    assembled(found, CONFIG, "made/up")
    told = [record for record in caplog.records if "alpha is not read" in record.getMessage()]
    assert len(told) == int(is_told)
    if is_told:
        assert told[0].getMessage().startswith(f"{tmp_path / '1.png'} has transparent pixels")
        assert getattr(told[0], "topic", None) == "not read"
