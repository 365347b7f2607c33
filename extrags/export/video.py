"""Fly-throughs as H.264 video: coarse scene, final scene and what is not known, side by side."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import ExitStack, contextmanager
from fractions import Fraction
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import torch
from jaxtyping import Bool, Float, UInt8
from torch import Tensor

from extrags.cameras import Cameras
from extrags.errors import ConfigError, ExtragsError, ShapeError, StoreError, reason_of
from extrags.events import Progress, emit
from extrags.exploration.coverage import direction_counts, training_coverage
from extrags.facing import one_sided_attributes, one_sided_rendering
from extrags.output_files import whole_file
from extrags.scene import Scene
from extrags.shown_pixels import shown_pixels

if TYPE_CHECKING:
    from av.container import OutputContainer

__all__ = ["fly_through", "unobserved", "write_video"]

_DIRECTIONS = 32
_VISIBLE_WEIGHT = 0.05
_ENOUGH_DIRECTIONS = 3
"""Seen from so many of 32 directions, a Gaussian counts as well known."""
_QUALITY = "18"
"""Constant rate factor of H.264: 18 is visually lossless, 0 lossless."""


def unobserved(
    scene: Scene, train: Cameras, masks: Sequence[Bool[np.ndarray, "h w"]] | None = None
) -> Float[Tensor, "n"]:
    """How little the training views say of each Gaussian: 1 seen by none, 0 from three directions or more.

    Args:
        scene: the scene.
        train: the training views.
        masks: their pixels that show tissue (`EndoscopicSequence.training_masks`); None: all.
    """
    views = train.at_most_width(160)
    # Coverage is counted on the processor.
    covered = training_coverage(
        scene.to("cpu"),
        views,
        visible_weight=_VISIBLE_WEIGHT,
        n_directions=_DIRECTIONS,
        mask=shown_pixels(masks, train, views),
    )
    known = np.minimum(direction_counts(covered), _ENOUGH_DIRECTIONS) / _ENOUGH_DIRECTIONS
    return torch.from_numpy((1 - known).astype(np.float32))


def fly_through(
    scenes: list[Scene],
    path: Cameras,
    *,
    exposure: float = 1.0,
    train: Cameras | None = None,
    masks: Sequence[Bool[np.ndarray, "h w"]] | None = None,
    colors: bool = True,
) -> Iterator[UInt8[np.ndarray, "h w 3"]]:
    """Render every camera of a path, one picture beside the other.

    What a view sees from behind stands behind all else, as in the evaluation
    (`extrags.facing.one_sided_rendering`).

    Args:
        scenes: one column each, from left to right.
        path: the flight.
        exposure: gain of the camera; 1 is the mean of the training frames.
        train: with the training views, one more column: where the last scene rests on few of them. The
            share of a pixel that falls on Gaussians they hardly saw, or on none at all, from black (well
            known) over red to yellow (unknown).
        masks: pixels of the training views that show tissue; None: all.
        colors: False shows that column alone.

    Yields:
        Frames.

    Raises:
        ConfigError: when nothing is to be shown.
    """
    if not scenes or (train is None and not colors):
        raise ConfigError("a fly-through needs at least one scene, and something of it to show")
    lacking = None if train is None else unobserved(scenes[-1], train, masks)
    gain = torch.tensor([float(exposure)])
    for index in range(len(path)):
        camera = path[index]
        columns = []
        with torch.no_grad():
            for scene in scenes if colors else ():
                rgb = one_sided_rendering(scene, camera, exposure=gain).rgb[0].clamp(0, 1).cpu().numpy()
                columns.append(np.rint(rgb * 255).astype(np.uint8))
            if lacking is not None:
                shown, alpha = one_sided_attributes(scenes[-1], camera, lacking[:, None])
                # Where the scene holds nothing, nothing is known.
                unknown = (shown[0, ..., 0] + 1 - alpha[0]).clamp(0, 1).cpu().numpy()
                columns.append(_colored(unknown))
        yield np.concatenate(columns, axis=1)
        emit(Progress("export", index + 1, len(path)))


def write_video(
    frames: Iterator[UInt8[np.ndarray, "h w 3"]], file: Path, *, fps: float = 24.0, quality: str = _QUALITY
) -> int:
    """Encode frames as H.264 in MP4, which browsers and players open.

    Sizes are made even, as 4:2:0 colour needs it, by repeating the last row or column. Colours are BT.709 of
    limited range, and the file says so: of what a file does not say, players guess by its size.

    Args:
        frames: all of one size.
        file: `.mp4`.
        fps: frames per second.
        quality: constant rate factor, `0` to `51`.

    Returns:
        How many frames were written.

    Raises:
        ConfigError: without frames, or for a rate that is none.
        ShapeError: when sizes differ.
        StoreError: when the file cannot be written, or FFmpeg was built without H.264.

    What `frames` raise comes through as it is.
    """
    import av
    from av.video.reformatter import ColorPrimaries, ColorRange, Colorspace, ColorTrc

    if not 0.1 <= fps <= 1000:
        raise ConfigError(f"{fps:g} frames per second; expected 0.1 to 1000")
    rate = Fraction(fps).limit_denominator(1001)
    count = 0
    size: tuple[int, int] | None = None
    with ExitStack() as stack:
        with _told_of(file):
            container = stack.enter_context(_opened(stack.enter_context(whole_file(file)), file))
            stream = container.add_stream("libx264", rate=rate)
            stream.pix_fmt = "yuv420p"
            stream.codec_context.colorspace = Colorspace.ITU709
            stream.codec_context.color_range = ColorRange.MPEG
            stream.codec_context.color_primaries = ColorPrimaries.BT709
            stream.codec_context.color_trc = ColorTrc.BT709
            # x264's threads change nothing but the speed; one keeps a shared machine usable.
            stream.options = {"crf": quality, "preset": "medium", "threads": "1"}
        # What goes wrong while a frame is made says nothing about the file.
        for picture in frames:
            if size is None:
                size = picture.shape[0], picture.shape[1]
                stream.width, stream.height = size[1] + size[1] % 2, size[0] + size[0] % 2
            if picture.shape[:2] != size:
                raise ShapeError(f"frame {count} has size {picture.shape[:2]}, the first has {size}")
            padded = np.pad(picture, ((0, size[0] % 2), (0, size[1] % 2), (0, 0)), mode="edge")
            with _told_of(file):
                coded = av.VideoFrame.from_ndarray(padded, format="rgb24").reformat(
                    format="yuv420p", dst_colorspace=Colorspace.ITU709, dst_color_range=ColorRange.MPEG
                )
                for packet in stream.encode(coded):
                    container.mux(packet)
            count += 1
        if count == 0:
            raise ConfigError("a video needs at least one frame")
        with _told_of(file):
            for packet in stream.encode(None):
                container.mux(packet)
            # Closes the container, and gives the file its name.
            stack.close()
    return count


@contextmanager
def _opened(partial: Path, file: Path) -> Iterator[OutputContainer]:
    """A container that is written to `partial`; errors name `file`."""
    import av

    container = av.open(str(partial), "w", format="mp4", options={"movflags": "+faststart"})
    try:
        yield container
    finally:
        with _told_of(file):
            container.close()


@contextmanager
def _told_of(file: Path) -> Iterator[None]:
    """What FFmpeg raises, as an error that names the file."""
    from av.error import FFmpegError

    try:
        yield
    except ExtragsError:
        # It names the file already.
        raise
    except (OSError, FFmpegError, ValueError) as error:
        raise StoreError(f"{file} cannot be written as H.264: {reason_of(error)}") from error


def _colored(share: Float[np.ndarray, "h w"]) -> UInt8[np.ndarray, "h w 3"]:
    from matplotlib import colormaps

    return np.asarray(np.rint(colormaps["hot"](share * 0.85)[..., :3] * 255).astype(np.uint8))
