"""A recording to practise on: the colon of a phantom as a video, as an endoscope would have filmed it.

    python examples/video_of_a_phantom.py recordings/exam.mp4
    python examples/video_of_a_phantom.py recordings/other.mp4 3

The number is that of the phantom (`extrags run phantom/3@sparse` is the same colon, with its truth).
"""

from __future__ import annotations

import sys
from collections.abc import Iterator
from pathlib import Path

import numpy as np
from jaxtyping import UInt8

from data_catalog.phantom.config import PhantomConfig
from data_catalog.phantom.imaging import recording_sensor
from data_catalog.phantom.recording import TRAINS, Phantom
from extrags.export.video import write_video

FRAMES_PER_SECOND = 10.0
HARDLY_COMPRESSED = "12"


def filmed(config: PhantomConfig) -> Iterator[UInt8[np.ndarray, "h w 3"]]:
    """The frames of the recording that trains, in the order of time.

    Args:
        config: which colon, the size of its pictures, and how many of them (`video_frames`).
    """
    phantom = Phantom(config)
    sensor = recording_sensor(config, TRAINS, phantom.scene_gain())
    cameras = phantom.cameras("b", np.linspace(0, 1, config.video_frames))
    for number in range(len(cameras)):
        yield phantom.photograph(cameras[number], sensor, TRAINS, number)[0]


def main(file: Path, scene: int = 11, config: PhantomConfig | None = None) -> None:
    """Write the video.

    Args:
        file: `.mp4`; its folder is made.
        scene: number of the phantom.
        config: another size, length or light; None takes 67 frames of 320 x 256 pixels.
    """
    file.parent.mkdir(parents=True, exist_ok=True)
    config = PhantomConfig(width=320, height=256, video_frames=67) if config is None else config
    config = config.model_copy(update={"scene": scene})
    count = write_video(filmed(config), file, fps=FRAMES_PER_SECOND, quality=HARDLY_COMPRESSED)
    print(f"{file}: {count} frames, {count / FRAMES_PER_SECOND:.1f} s")


if __name__ == "__main__":
    if len(sys.argv) not in (2, 3) or not all(number.isdecimal() for number in sys.argv[2:]):
        sys.exit(__doc__)
    main(Path(sys.argv[1]), *map(int, sys.argv[2:3]))
