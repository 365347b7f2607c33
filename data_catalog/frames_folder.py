"""Reader of plain frames: a folder of images and nothing else; the poses stage finds the rest.

Images lie in the folder itself, or in `images/` or `rgb/` below it, and are taken in natural order (9 before
10). Optional beside them: `intrinsics.json` with `K` (3 x 3), or `fx`, `fy`, `cx`, `cy`, or
`field_of_view_deg` (horizontal), in pixels of the files with centres at +0.5; and `mask.png` (white is
tissue). Without intrinsics a horizontal field of view of 90 degrees is assumed, and said so in the log; lens
distortion is not undone here. Without a mask, the dark frame round the picture is found from all frames: dark
everywhere, always, and joined to the image border; so are a round picture and burnt-in text
(`data_catalog.content`).
"""

from __future__ import annotations

import json
import logging
from pathlib import Path

import numpy as np
from jaxtyping import Float

from data_catalog.checks import check_intrinsics
from data_catalog.content import content_mask
from data_catalog.formats import FolderFormat
from data_catalog.images import Resampling, colour_files, read_colour, read_mask, spread
from data_catalog.splits import every_nth
from extrags.config import IngestConfig
from extrags.errors import SourceError, SourceNotFoundError
from extrags.sequence import EndoscopicSequence

__all__ = ["ASSUMED_FIELD_OF_VIEW_DEG", "FORMAT", "read_intrinsics"]

logger = logging.getLogger(__name__)

ASSUMED_FIELD_OF_VIEW_DEG = 90.0
_NOT_FRAMES = ("mask.png",)


def _frames(folder: Path) -> list[Path]:
    for place in (folder, folder / "images", folder / "rgb"):
        if place.is_dir():
            found = [file for file in colour_files(place) if file.name not in _NOT_FRAMES]
            if found:
                return found
    return []


def _recognises(folder: Path) -> bool:
    return bool(_frames(folder))


def _files(folder: Path) -> list[Path]:
    extra = [folder / "intrinsics.json", folder / "mask.png"]
    return sorted([*_frames(folder), *(file for file in extra if file.is_file())])


def _read(folder: Path, config: IngestConfig, name: str) -> EndoscopicSequence:
    files = _frames(folder)
    if not files:
        raise SourceNotFoundError("no image in this folder", file=folder)
    kept = [files[index] for index in spread(len(files), config.max_frames)]
    first = read_colour(kept[0], frame=kept[0].name)
    resampling = Resampling.planned(first.shape[1], first.shape[0], config)
    K = read_intrinsics(folder, first.shape[1], first.shape[0])
    # Shrunk before they are stacked: a long video at full size would not fit into memory.
    colours = np.stack(
        [resampling.colour(read_colour(file, frame=file.name), file=file, frame=file.name) for file in kept]
    )
    mask_file = folder / "mask.png"
    mask = (
        resampling.mask(read_mask(mask_file), file=mask_file)
        if mask_file.is_file()
        else content_mask(colours)
    )
    return EndoscopicSequence(
        name=name,
        rgb=colours,
        K=np.repeat(resampling.intrinsics(K)[None], len(kept), axis=0),
        mask=np.repeat(mask[None], len(kept), axis=0),
        split=every_nth(len(kept), config.holdout_every, file=folder),
        recording=np.zeros(len(kept), dtype=np.int64),
        frame_names=tuple(file.stem for file in kept),
        metric=False,
    )


FORMAT = FolderFormat(
    name="frames",
    version=2,
    summary="plain images in the folder, in images/ or in rgb/, optionally with intrinsics.json and mask.png",
    recognises=_recognises,
    files=_files,
    read=_read,
    conventions="no poses and no depth; the poses stage finds them, in an arbitrary unit",
)


def read_intrinsics(folder: Path, width: int, height: int) -> Float[np.ndarray, "3 3"]:
    """K from `intrinsics.json` in a folder, or of the assumed field of view where there is none.

    Args:
        folder: where the file is looked for.
        width: of the images it belongs to, in pixels.
        height: of the images it belongs to, in pixels.

    Raises:
        SourceError: the file is damaged or describes no pinhole.
    """
    file = folder / "intrinsics.json"
    if not file.is_file():
        logger.warning(
            "%s has no intrinsics.json: assuming a horizontal field of view of %g degrees",
            folder.name,
            ASSUMED_FIELD_OF_VIEW_DEG,
        )
        return _from_field_of_view(ASSUMED_FIELD_OF_VIEW_DEG, width, height)
    try:
        content = json.loads(file.read_text())
        if "K" in content:
            K = np.asarray(content["K"], dtype=np.float64)
        elif "field_of_view_deg" in content:
            angle = float(content["field_of_view_deg"])
            if not 1 < angle < 179:
                raise SourceError(
                    f"{angle:g} degrees; expected 1 to 179 for a pinhole",
                    file=file,
                    field="field_of_view_deg",
                )
            K = _from_field_of_view(angle, width, height)
        else:
            fx, fy, cx, cy = (float(content[key]) for key in ("fx", "fy", "cx", "cy"))
            K = np.array([[fx, 0, cx], [0, fy, cy], [0, 0, 1.0]])
    except (json.JSONDecodeError, KeyError, TypeError) as error:
        raise SourceError(
            f"expected K, or fx, fy, cx, cy, or field_of_view_deg: {error!r}", file=file, field="K"
        ) from error
    if K.shape != (3, 3):
        raise SourceError(f"found shape {K.shape}; expected 3 x 3 numbers", file=file, field="K")
    check_intrinsics(K, width, height, file=file)
    return K


def _from_field_of_view(angle_deg: float, width: int, height: int) -> Float[np.ndarray, "3 3"]:
    focal = width / 2 / np.tan(np.radians(angle_deg) / 2)
    return np.array([[focal, 0, width / 2], [0, focal, height / 2], [0, 0, 1.0]])
