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


class TestFramesMaskedThroughout:
    @staticmethod
    def covered(folder: Path, count: int) -> SourceFrames:
        """Six frames, the first few under a mask of their own that leaves nothing."""
        poses = np.tile(np.eye(4), (6, 1, 1))
        poses[:, 0, 3] = np.arange(6)
        found = source(folder, [PLAIN] * 6, poses)
        Image.fromarray(np.zeros((HEIGHT, WIDTH), np.uint8)).save(folder / "black.png")
        depth_file = folder / "depth.npy"
        np.save(depth_file, np.full((HEIGHT, WIDTH), 9.0, np.float32))
        frames = [
            replace(
                frame,
                depth_file=depth_file,
                mask_file=folder / "black.png" if index in (1, 4, 0)[:count] else frame.mask_file,
            )
            for index, frame in enumerate(found.frames)
        ]
        return replace(found, frames=frames)

    def test_they_are_left_out_with_a_warning(self, tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
        whole = assembled(self.covered(tmp_path, 0), CONFIG, "made/up")
        found = assembled(self.covered(tmp_path, 2), CONFIG, "made/up")
        assert "black.png: the masks of 2 of 6 frames, this one first, leave no pixel" in caplog.text
        kept = [0, 2, 3, 5]
        assert found.frame_names == ("0", "2", "3", "5")
        assert found.world_from_camera is not None
        assert found.world_from_camera[:, 0, 3].tolist() == kept
        for one, all_of_them in ((found.rgb, whole.rgb), (found.mask, whole.mask), (found.K, whole.K)):
            np.testing.assert_array_equal(one, all_of_them[kept])
        assert found.depth_mm is not None
        assert found.depth_mm.shape == found.mask.shape
        assert sorted([*found.split.train, *found.split.test]) == [0, 1, 2, 3]

    @pytest.mark.parametrize(("count", "share"), [(2, 0.3), (3, 0.4)])
    def test_too_many_are_refused(self, tmp_path: Path, count: int, share: float) -> None:
        config = CONFIG.model_copy(update={"max_absent_share": share})
        with pytest.raises(SourceError, match=f"masks of {count} of 6 frames.*leave no pixel") as caught:
            assembled(self.covered(tmp_path, count), config, "made/up")
        assert caught.value.field == "mask"
