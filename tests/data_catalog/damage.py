"""What is done to good folders to spoil them; each function returns, or is, a damage to one folder."""

from __future__ import annotations

import json
import shutil
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image

from data_catalog.readers.colmap_files import read_model, write_model
from extrags.cameras import invert_poses

OPENGL = np.diag([1.0, -1.0, -1.0, 1.0])


@dataclass(frozen=True)
class Damage:
    """What is done to a good folder, and what must be said about it."""

    layout: str
    do: Callable[[Path], None]
    sentence: str
    frame: str | None = None
    field: str | None = None
    file: str | None = None


def edited(name: str, how: Callable[[dict[str, Any]], object]) -> Callable[[Path], None]:
    """Damage done to a JSON file."""

    def do(folder: Path) -> None:
        content = json.loads((folder / name).read_text())
        how(content)
        (folder / name).write_text(json.dumps(content))

    return do


def posed(how: Callable[[np.ndarray], np.ndarray], frame: int | None = 3) -> Callable[[Path], None]:
    """Damage done to one pose of `poses.json`, or to all."""

    def change(content: dict[str, Any]) -> None:
        for index, entry in enumerate(content["frames"]):
            if frame is None or index == frame:
                entry["world_from_camera"] = how(np.array(entry["world_from_camera"])).tolist()

    return edited("poses.json", change)


def cut(name: str, share: float = 0.6) -> Callable[[Path], None]:
    """A file that ends too early."""

    def do(folder: Path) -> None:
        content = (folder / name).read_bytes()
        (folder / name).write_bytes(content[: int(share * len(content))])

    return do


def removed(name: str) -> Callable[[Path], None]:
    return lambda folder: (folder / name).unlink()


def image(how: Callable[[np.ndarray], np.ndarray], frames: tuple[int, ...] = (5,)) -> Callable[[Path], None]:
    """Damage done to colour images."""

    def do(folder: Path) -> None:
        for k in frames:
            file = folder / "rgb" / f"{k:04d}.png"
            Image.fromarray(how(np.array(Image.open(file))).astype(np.uint8)).save(file)

    return do


def depth(
    how: Callable[[np.ndarray], np.ndarray], frames: tuple[int, ...] = tuple(range(10))
) -> Callable[[Path], None]:
    """Damage done to depth maps."""

    def do(folder: Path) -> None:
        for k in frames:
            file = folder / "depth" / f"{k:04d}.npy"
            np.save(file, how(np.load(file)).astype(np.float32))

    return do


def with_negative(values: np.ndarray) -> np.ndarray:
    values[7, 3:6] = -1
    return values


def framed(folder: Path) -> None:
    """A dark frame round the picture, and a mask that keeps the frame."""
    (folder / "mask").mkdir()
    white = np.full((77, 96), 255, np.uint8)
    white[12:65, 16:80] = 0
    for k in range(10):
        file = folder / "rgb" / f"{k:04d}.png"
        picture = np.array(Image.open(file))
        picture[white > 0] = 2
        Image.fromarray(picture).save(file)
        Image.fromarray(white).save(folder / "mask" / f"{k:04d}.png")


def same_image(folder: Path) -> None:
    shutil.copyfile(folder / "rgb" / "0004.png", folder / "rgb" / "0005.png")


def out_of_order(content: dict[str, Any]) -> None:
    content["frames"][4], content["frames"][5] = content["frames"][5], content["frames"][4]


def intrinsics(**values: float) -> Callable[[Path], None]:
    def change(content: dict[str, Any]) -> None:
        K = content["K"]
        width, height = K[0][2] * 2, K[1][2] * 2
        K[0][0] *= values.get("fx", 1) * values.get("all", 1)
        K[1][1] *= values.get("fy", 1) * values.get("all", 1)
        K[0][2] = width * values.get("cx", 0.5) * values.get("all", 1)
        K[1][2] = height * values.get("cy", 0.5) * values.get("all", 1)

    return edited("poses.json", change)


def model(how: Callable[[Any], Any]) -> Callable[[Path], None]:
    """Damage done to a binary COLMAP model."""

    def do(folder: Path) -> None:
        place = folder / "sparse" / "0"
        write_model(how(read_model(place)), place)

    return do


def inverted(found: Any) -> Any:
    return replace(
        found,
        images=[
            replace(item, world_from_camera=invert_poses(item.world_from_camera[None])[0])
            for item in found.images
        ],
    )


def unknown_camera_model(folder: Path) -> None:
    file = folder / "sparse" / "0" / "cameras.bin"
    content = bytearray(file.read_bytes())
    content[12:16] = (99).to_bytes(4, "little")
    file.write_bytes(bytes(content))


def panorama(folder: Path) -> None:
    file = folder / "sparse" / "0" / "cameras.bin"
    content = bytearray(file.read_bytes())
    content[12:16] = (17).to_bytes(4, "little")
    file.write_bytes(bytes(content))


def line(name: str, number: int, how: Callable[[str], str]) -> Callable[[Path], None]:
    """Damage done to a line of a text file."""

    def do(folder: Path) -> None:
        lines = (folder / name).read_text().splitlines()
        lines[number] = how(lines[number])
        (folder / name).write_text("\n".join(lines) + "\n")

    return do


def words(changes: dict[int, str]) -> Callable[[str], str]:
    return lambda text: " ".join(changes.get(k, word) for k, word in enumerate(text.split()))


def without_flip(content: dict[str, Any]) -> None:
    for entry in content["frames"]:
        entry["transform_matrix"] = (np.array(entry["transform_matrix"]) @ OPENGL).tolist()


def every_frame(how: Callable[[dict[str, Any]], object]) -> Callable[[Path], None]:
    def change(content: dict[str, Any]) -> None:
        for entry in content["frames"]:
            how(entry)

    return edited("transforms.json", change)


def llff(how: Callable[[np.ndarray], np.ndarray]) -> Callable[[Path], None]:
    def do(folder: Path) -> None:
        file = folder / "poses_bounds.npy"
        np.save(file, how(np.load(file)))

    return do


def telling_nothing(folder: Path) -> None:
    white = np.zeros((77, 96), np.uint8)
    white[:, ::2] = 255
    for file in (folder / "masks").iterdir():
        Image.fromarray(white).save(file)


def nan_at_four(rows: np.ndarray) -> np.ndarray:
    rows[4, 3] = np.nan
    return rows


def emptied(folder: Path) -> None:
    for file in folder.iterdir():
        file.unlink()


def no_video(folder: Path) -> None:
    emptied(folder)
    (folder / "exam.mp4").write_text("this is no video")


def bigger(folder: Path) -> None:
    Image.fromarray(np.full((80, 96, 3), 90, np.uint8)).save(folder / "2.png")


def far_away(pose: np.ndarray) -> np.ndarray:
    pose[:3, 3] += pose[:3, 0] * 900
    return pose
