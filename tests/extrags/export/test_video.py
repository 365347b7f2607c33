"""Fly-throughs, decoded again by FFmpeg."""

from __future__ import annotations

import json
import shutil
import subprocess
from collections.abc import Iterator
from pathlib import Path

import av
import numpy as np
import pytest
import torch

from extrags.errors import ConfigError, ShapeError, SourceError, StoreError
from extrags.export import fly_through, write_video
from extrags.export.video import unobserved
from extrags.facing import one_sided_attributes, one_sided_rendering
from extrags.scene import Scene
from tests.extrags.lit_tube import Tube, from_outside, seen_from_inside


def decoded(file: Path) -> list[np.ndarray]:
    with av.open(str(file)) as container:
        return [frame.to_ndarray(format="rgb24") for frame in container.decode(video=0)]


def flat(count: int, height: int = 48, width: int = 64) -> Iterator[np.ndarray]:
    for index in range(count):
        yield np.full((height, width, 3), 20 * index, dtype=np.uint8)


def test_pictures_survive_the_encoding(tube: Tube, tmp_path: Path) -> None:
    path = tube.sequence.cameras[:3]
    frames = list(fly_through([tube.scene, tube.scene], path, train=tube.sequence.training_cameras))
    assert frames[0].shape == (48, 3 * 64, 3)
    np.testing.assert_array_equal(frames[0][:, :64], frames[0][:, 64:128])
    with torch.no_grad():
        expected = tube.scene.render(path).rgb.clamp(0, 1).numpy()
    np.testing.assert_allclose(frames[1][:, :64] / 255, expected[1], atol=0.5 / 255 + 1e-6)
    assert write_video(iter(frames), tmp_path / "a.mp4", fps=12.0) == 3
    back = decoded(tmp_path / "a.mp4")
    assert len(back) == 3
    for given, shown in zip(frames, back, strict=True):
        error = ((given[:, :128].astype(float) - shown[:, :128]) ** 2).mean()
        # Half of the resolution of colour is gone (4:2:0); brightness is nearly exact.
        assert -10 * np.log10(error / 255**2) > 30


def test_the_container(tmp_path: Path) -> None:
    """Odd sizes become even; the picture stays in its upper left corner."""
    write_video(flat(5, 47, 63), tmp_path / "a.mp4", fps=29.97)
    with av.open(str(tmp_path / "a.mp4")) as container:
        stream = container.streams.video[0]
        assert stream.codec_context.name == "h264"
        assert stream.codec_context.pix_fmt == "yuv420p"
        assert (stream.width, stream.height) == (64, 48)
        assert float(stream.average_rate or 0) == pytest.approx(29.97, rel=1e-3)
    # The index stands before the frames: a browser begins to play at once.
    content = (tmp_path / "a.mp4").read_bytes()
    assert content.index(b"moov") < content.index(b"mdat")


@pytest.mark.skipif(shutil.which("ffprobe") is None, reason="ffprobe is not on the path")
def test_ffprobe(tmp_path: Path) -> None:
    write_video(flat(5), tmp_path / "a.mp4")
    said = subprocess.run(
        ["ffprobe", "-v", "error", "-show_streams", "-count_frames", "-of", "json", str(tmp_path / "a.mp4")],
        capture_output=True,
        check=True,
    )
    (stream,) = json.loads(said.stdout)["streams"]
    assert (stream["codec_name"], stream["nb_read_frames"], stream["width"]) == ("h264", "5", 64)


def test_what_training_views_have_not_seen(tube: Tube) -> None:
    """Behind the first camera nothing is known; on the way that all have seen most is."""
    lacking = unobserved(tube.scene, tube.sequence.training_cameras)
    along = tube.scene.gaussians.means[:, 2]
    assert float(lacking[along < -1].min()) == 1.0
    assert float(lacking[(along > 20) & (along < 25)].mean()) < 0.7
    path = tube.sequence.cameras[4:5]
    (known,) = fly_through([tube.scene], path, train=tube.sequence.training_cameras, colors=False)
    (unknown,) = fly_through([tube.scene], path, train=tube.sequence.training_cameras[:1], colors=False)
    assert known.shape == (48, 64, 3)
    assert unknown.mean() > known.mean() + 20


def test_beyond_the_edge_of_the_picture_nothing_was_seen(tube: Tube) -> None:
    train = tube.sequence.training_cameras
    none = np.zeros((train.height, train.width), dtype=bool)
    none[:2, :2] = True
    everything = unobserved(tube.scene, train, [np.ones_like(none)] * len(train))
    assert torch.equal(everything, unobserved(tube.scene, train))
    assert float(unobserved(tube.scene, train, [none] * len(train)).mean()) > 0.95
    path = tube.sequence.cameras[4:5]
    (masked,) = fly_through([tube.scene], path, train=train, masks=[none] * len(train), colors=False)
    (known,) = fly_through([tube.scene], path, train=train, colors=False)
    assert masked.mean() > known.mean() + 20


def test_walls_seen_from_behind_stand_back(tube: Tube) -> None:
    """From outside, the picture is that of the evaluation, and what is not known that of the same walls."""
    scene, path, train = seen_from_inside(tube.scene), from_outside(), tube.sequence.training_cameras
    (shown,) = fly_through([scene], path, exposure=4.0, train=train)
    with torch.no_grad():
        expected = one_sided_rendering(scene, path, exposure=torch.tensor([4.0]))
    color = expected.rgb[0].clamp(0, 1).numpy()
    np.testing.assert_allclose(shown[:, :64] / 255, color, atol=0.5 / 255 + 1e-6)
    (plain,) = fly_through([tube.scene], path, exposure=4.0, train=train)
    for column in (slice(0, 64), slice(64, 128)):
        assert np.abs(shown[:, column].astype(float) - plain[:, column]).mean() > 5
    depth = scene.gaussians.means.matmul(torch.from_numpy(path.viewmats[0, 2, :3]).float())
    depth = depth + float(path.viewmats[0, 2, 3])
    sums, alpha = one_sided_attributes(scene, path, depth[:, None])
    torch.testing.assert_close(alpha, expected.alpha)
    torch.testing.assert_close(sums[..., 0], expected.alpha * expected.depth, rtol=1e-3, atol=1e-2)


@pytest.mark.usefixtures("without_kernels")
def test_a_scene_elsewhere(tube: Tube, elsewhere: torch.device) -> None:
    few = Scene(tube.scene.gaussians.subset(torch.arange(0, 4600, 20)), tube.scene.light)
    train, path = (
        tube.sequence.training_cameras[:2].resized(32, 24),
        tube.sequence.cameras[:1].resized(32, 24),
    )
    (here,), (there,) = (
        list(fly_through([few.to(device)], path, train=train)) for device in ("cpu", elsewhere)
    )
    assert here.shape == there.shape == (24, 2 * 32, 3)
    assert np.abs(here.astype(int) - there.astype(int)).max() <= 1


class TestRefused:
    def test_nothing_to_show(self, tube: Tube) -> None:
        for scenes, colors in (([], True), ([tube.scene], False)):
            with pytest.raises(ConfigError, match="something of it to show"):
                next(fly_through(scenes, tube.sequence.cameras, colors=colors))

    def test_no_frames(self, tmp_path: Path) -> None:
        with pytest.raises(ConfigError, match="at least one frame"):
            write_video(flat(0), tmp_path / "a.mp4")

    @pytest.mark.parametrize("fps", [0.0, -1.0, float("nan"), 1e6])
    def test_rates(self, fps: float, tmp_path: Path) -> None:
        with pytest.raises(ConfigError, match="frames per second"):
            write_video(flat(2), tmp_path / "a.mp4", fps=fps)

    def test_sizes_that_differ(self, tmp_path: Path) -> None:
        with pytest.raises(ShapeError, match="frame 1 has size"):
            write_video(iter([*flat(1), *flat(1, 32, 32)]), tmp_path / "a.mp4")

    @pytest.mark.parametrize("error", [ValueError("no scene"), OSError("no disk"), SourceError("no frame")])
    def test_what_goes_wrong_with_a_frame_is_not_the_file_s(self, error: Exception, tmp_path: Path) -> None:
        def frames() -> Iterator[np.ndarray]:
            yield from flat(2)
            raise error

        with pytest.raises(type(error)) as found:
            write_video(frames(), tmp_path / "a.mp4")
        assert found.value is error

    def test_a_folder_that_is_not_there(self, tmp_path: Path) -> None:
        with pytest.raises(StoreError, match=r"none/a\.mp4"):
            write_video(flat(2), tmp_path / "none" / "a.mp4")


def test_players_are_told_the_colours(tmp_path: Path) -> None:
    """Of what is not said they guess by the size: red would be another red from 720 rows on."""
    picture = np.full((720, 1280, 3), (200, 80, 60), np.uint8)
    write_video(iter([picture]), tmp_path / "a.mp4")
    with av.open(str(tmp_path / "a.mp4")) as container:
        (frame,) = container.decode(video=0)
        # BT.709 of limited range.
        assert (frame.colorspace, frame.color_range) == (1, 1)
        luminance = frame.to_ndarray()[:720]
    expected = 16 + 219 / 255 * (np.array((0.2126, 0.7152, 0.0722)) @ (200, 80, 60))
    assert np.abs(luminance - expected).max() < 1.5
