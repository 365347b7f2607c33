"""Reader of the EndoNeRF layout, which StereoMIS, SCARED and Hamlyn clips are handed round in too.

::

    my_clip/
        poses_bounds.npy        [F, 17]: 3 x 5 matrix row by row, then the nearest and farthest depth
        images/*.png            or rgb/; also images_left/
        depth/*.png             optional: z-depth in the unit of the poses, 8 or 16 bit; 0 = unknown
        masks/*.png             optional, also gt_masks/; of either polarity

Other files in these folders, such as `depth/*.npy`, are not read, which a warning says where there are no
images beside them. Images, rows, depth and masks belong together in the order of their names; where the
numbers in the names contradict that, the clip is refused.

The matrix is LLFF's: columns are the camera's down, right and backward axes, its centre, and (height, width,
focal length). They become OpenCV's (right, down, forward) on reading; the principal point is the image's
centre. Lengths are those of the stereo reconstruction, millimetres in the published clips. EndoNeRF's own
clips have a camera that stands still before moving tissue.

Mask polarity differs between the sets: EndoNeRF paints tools white, StereoMIS and Hamlyn clips paint tissue
white. It is detected from the images (`mask_polarity`) and stated in the log and by `data check`; masks that
tell neither are refused.

Source: Wang et al., "Neural rendering for stereo 3D reconstruction of deformable tissues in robotic surgery"
(EndoNeRF), MICCAI 2022; Mildenhall et al., "Local light field fusion", SIGGRAPH 2019 (pose format).
"""

from __future__ import annotations

import logging
import re
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Bool, Float, UInt8

from data_catalog.calibration_files import LENS_OF_POSES
from data_catalog.folder_reader import FolderReader
from data_catalog.images import color_files, read_color, read_mask, spread
from data_catalog.pose_conventions import LLFF
from data_catalog.posed_frames import PosedFrame, SourceFrames
from extrags.array_files import load_npy
from extrags.config import IngestConfig
from extrags.errors import PoseError, SourceError, SourceNotFoundError, reason_of
from extrags.frame_names import NameOrder, order_for_fingerprint, tell_about_order
from extrags.lens import Lens

__all__ = ["POSES_FILE", "READER", "MaskPolarity", "mask_polarity", "polarity_of_images", "read_llff"]

logger = logging.getLogger(__name__)

POSES_FILE = "poses_bounds.npy"
_IMAGE_FOLDERS = ("images", "rgb", "images_left")
_MASK_FOLDERS = ("masks", "mask", "gt_masks")
_DEPTH_FOLDERS = ("depth", "depths", "gt_depth")
_LOOKED_AT = 8
"""Frames whose masks are compared with their colours."""
_CLEAR_REDNESS = 0.05
_MINORITY = 0.35


@dataclass(frozen=True)
class MaskPolarity:
    """What white means in a set's masks, and how that was found.

    Args:
        white_is_tissue: the answer.
        because: the numbers behind it, as a sentence.
    """

    white_is_tissue: bool
    because: str


def _part(folder: Path, names: tuple[str, ...]) -> list[Path]:
    found = next((folder / name for name in names if (folder / name).is_dir()), None)
    return [] if found is None else color_files(found)


def _not_read(folder: Path) -> list[str]:
    """Folders of masks or depth that are not read, or hold files of which none is an image, as sentences."""
    said = []
    for field, names in (("masks", _MASK_FOLDERS), ("depth", _DEPTH_FOLDERS)):
        there = [folder / name for name in names if (folder / name).is_dir()]
        said += [f"{other.name}/ is not read, only {there[0].name}/" for other in there[1:]]
        place = next(iter(there), None)
        if place is None or color_files(place):
            continue
        others = sorted(file.name for file in place.iterdir() if file.is_file() and file.name[0] != ".")
        if others:
            said.append(
                f"{place.name}/ holds no images, and what it holds is not read ({len(others)} files, the "
                f"first is {others[0]}); expected {field} as one image for each frame"
            )
    return said


def _recognises(folder: Path) -> bool:
    return (folder / POSES_FILE).is_file() and bool(_part(folder, _IMAGE_FOLDERS))


def _files(folder: Path) -> list[Path]:
    images = _part(folder, _IMAGE_FOLDERS)
    # Here as well: what an earlier version paired wrongly must not be found in a store.
    masks = _matching(_part(folder, _MASK_FOLDERS), images, "mask")
    depths = _matching(_part(folder, _DEPTH_FOLDERS), images, "depth")
    return sorted([folder / POSES_FILE, *images, *masks, *depths])


def _chosen(folder: Path) -> dict[str, Any]:
    orders = [
        order_for_fingerprint(file.name for file in _part(folder, names))
        for names in (_IMAGE_FOLDERS, _MASK_FOLDERS, _DEPTH_FOLDERS)
    ]
    return next((order for order in orders if order), {})


def _frames(folder: Path, config: IngestConfig) -> SourceFrames:
    file = folder / POSES_FILE
    images = _part(folder, _IMAGE_FOLDERS)
    tell_about_order(images[0].parent, NameOrder(image.name for image in images))
    poses, sizes, _ = read_llff(file)
    if len(poses) != len(images):
        raise PoseError(
            f"{len(poses)} poses for {len(images)} images in {images[0].parent.name}/",
            file=file,
            frame=images[min(len(poses), len(images) - 1)].name,
            field="world_from_camera",
        )
    masks = _matching(_part(folder, _MASK_FOLDERS), images, "mask")
    depths = _matching(_part(folder, _DEPTH_FOLDERS), images, "depth")
    for sentence in _not_read(folder):
        logger.warning("%s: %s", folder, sentence)
    white_is_tissue = True
    if masks:
        polarity = mask_polarity(folder)
        white_is_tissue = polarity.white_is_tissue
        logger.info("%s: masks: %s", folder.name, polarity.because)
    frames = []
    for index, image in enumerate(images):
        height, width, focal = (float(value) for value in sizes[index])
        frames.append(
            PosedFrame(
                name=image.name,
                file=image,
                lens=Lens("SIMPLE_PINHOLE", (focal, width / 2, height / 2), round(width), round(height)),
                world_from_camera=poses[index],
                mask_file=masks[index] if masks else None,
                depth_file=depths[index] if depths else None,
            )
        )
    return SourceFrames(
        frames,
        pose_file=file,
        metric=True,
        intrinsics_file=file,
        white_is_tissue=white_is_tissue,
        lens_stays=LENS_OF_POSES,
    )


def _notes(folder: Path) -> tuple[str, ...]:
    return (f"masks: {mask_polarity(folder).because}",) if _part(folder, _MASK_FOLDERS) else ()


READER = FolderReader(
    name="endonerf",
    version=4,
    summary=f"{POSES_FILE} with images/ (and depth/, masks/) as EndoNeRF and StereoMIS have them",
    recognises=_recognises,
    files=_files,
    frames=_frames,
    conventions="LLFF camera axes (down, right, backward), camera to world; mm; masks of detected polarity",
    notes=_notes,
    chosen=_chosen,
    poses=LLFF,
)


def read_llff(
    file: Path,
) -> tuple[Float[np.ndarray, "f 4 4"], Float[np.ndarray, "f 3"], Float[np.ndarray, "f 2"]]:
    """Poses in OpenCV axes, sizes (height, width, focal length in pixels), and depth bounds.

    Raises:
        SourceError: the file is damaged or of another shape.
        PoseError: a row that is not finite.
    """
    try:
        rows = load_npy(file)
    except (ValueError, EOFError, OSError) as error:
        raise SourceError(f"cannot be read: {reason_of(error)}", file=file, field="poses") from error
    if rows.ndim != 2 or rows.shape[1] != 17 or rows.dtype.kind != "f":
        raise SourceError(
            f"found an array {rows.shape} of {rows.dtype}; expected [frames, 17] numbers",
            file=file,
            field="poses",
        )
    rows = rows.astype(np.float64)
    broken = np.flatnonzero(~np.isfinite(rows).all(axis=1))
    if broken.size:
        raise PoseError(
            f"{int((~np.isfinite(rows[broken[0]])).sum())} of 17 numbers are NaN or infinite",
            file=file,
            frame=int(broken[0]),
            field="world_from_camera",
        )
    matrices = rows[:, :15].reshape(-1, 3, 5)
    poses = np.tile(np.eye(4), (len(rows), 1, 1))
    down, right, backward = (matrices[:, :, axis] for axis in range(3))
    poses[:, :3, :3] = np.stack([right, down, -backward], axis=2)
    poses[:, :3, 3] = matrices[:, :, 3]
    return poses, matrices[:, :, 4], rows[:, 15:]


def mask_polarity(folder: Path) -> MaskPolarity:
    """What white means in the masks of a folder; see `polarity_of_images`.

    Raises:
        SourceError: the masks tell neither.
    """
    images = _part(folder, _IMAGE_FOLDERS)
    masks = _matching(_part(folder, _MASK_FOLDERS), images, "mask")
    looked_at = spread(len(images), _LOOKED_AT)
    colors = [read_color(images[k], frame=images[k].name) for k in looked_at]
    white = [read_mask(masks[k], frame=images[k].name) for k in looked_at]
    for k, color, mask in zip(looked_at, colors, white, strict=True):
        if mask.shape != color.shape[:2]:
            raise SourceError(
                f"{mask.shape[1]} x {mask.shape[0]} pixels; expected {color.shape[1]} x {color.shape[0]} "
                "as the image",
                file=masks[k],
                frame=images[k].name,
                field="mask",
            )
    return polarity_of_images(np.stack(colors), np.stack(white), file=masks[0].parent)


def polarity_of_images(
    rgb: UInt8[np.ndarray, "f h w 3"], white: Bool[np.ndarray, "f h w"], *, file: object = None
) -> MaskPolarity:
    """Whether white marks tissue or tools.

    Tissue is red and tools are grey: the side whose redness (R - (G + B) / 2) / (R + G + B) is clearly higher
    is tissue. Where colours do not tell (little of one side, or both alike), tools are the clear minority.

    Args:
        rgb: images.
        white: their masks.
        file: named in errors.

    Raises:
        SourceError: neither colours nor areas tell.
    """
    share = float(white.mean())
    if share in (0.0, 1.0):
        # All of it is tissue, else there would be nothing to reconstruct.
        return MaskPolarity(share == 1.0, f"one value throughout; {'white' if share else 'black'} is tissue")
    values = rgb.astype(np.float32)
    lit = values.max(axis=-1) > 25
    redness = (values[..., 0] - values[..., 1:].mean(axis=-1)) / np.maximum(values.sum(axis=-1), 1)
    on_white, on_black = (
        float(redness[side & lit].mean()) if (side & lit).any() else 0.0 for side in (white, ~white)
    )
    numbers = f"redness {on_white:.3f} on white, {on_black:.3f} on black; {share:.1%} of pixels are white"
    if abs(on_white - on_black) >= _CLEAR_REDNESS and min(share, 1 - share) > 0.002:
        tissue = on_white > on_black
        return MaskPolarity(tissue, f"white is {'tissue' if tissue else 'tool'}, by colour ({numbers})")
    if min(share, 1 - share) < _MINORITY:
        tissue = share > 0.5
        return MaskPolarity(tissue, f"white is {'tissue' if tissue else 'tool'}, by area ({numbers})")
    raise SourceError(
        f"what white means in the masks cannot be told ({numbers}); expected tissue and tools to differ in "
        "colour or area. Leave the masks out or repaint them",
        file=file,
        field="mask",
    )


def _matching(files: list[Path], images: list[Path], field: str) -> list[Path]:
    """Files of the images, in their order; none at all is allowed.

    Raises:
        SourceNotFoundError: not one for each image.
        SourceError: the numbers in the names say that a file belongs to another image.
    """
    if files and len(files) != len(images):
        raise SourceNotFoundError(
            f"{len(files)} files for {len(images)} images; expected one for each image, or no folder",
            file=files[0].parent,
            frame=images[min(len(files), len(images) - 1)].name,
            field=field,
        )
    steps = [file - image for file, image in zip(_numbers(files), _numbers(images), strict=False)]
    apart = next((k for k in range(1, len(steps)) if steps[k] != steps[0]), None)
    if apart is not None:
        raise SourceError(
            f"in the order of names this file would belong to {_below(images[apart])}, and the one before "
            f"it, {files[apart - 1].name}, to {_below(images[apart - 1])}: their numbers go apart, as where "
            "a file is missing on either side. Expected numbers that are those of the images, or differ from "
            "them by a constant",
            file=files[apart],
            frame=images[apart].name,
            field=field,
        )
    return files


def _numbers(files: list[Path]) -> list[int]:
    """The last number in each name; none where a name has none, or all have one, as a size in pixels."""
    runs = [re.findall(r"\d+", file.stem) for file in files]
    numbers = [int(run[-1]) for run in runs if run]
    return numbers if len(numbers) == len(files) and len(set(numbers)) > 1 else []


def _below(file: Path) -> str:
    return f"{file.parent.name}/{file.name}"
