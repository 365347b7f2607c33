"""Reader of plain frames: a folder of images and nothing else; the poses stage finds the rest.

Images lie in the folder itself, or in `images/` or `rgb/` below it, and are taken in the order of the
numbers in their names: 9 before 10, decimals by their values (`extrags.frame_names`). Where several of
these hold images, those of the one with at least twice as many as any other are taken, and the others named
in a warning; without such a one the source is refused. Woven (interlaced) images are read as they are, with
a warning. Images with an EXIF orientation are turned upright, as viewers show them, with a warning: nothing
that is read beside them, such as poses, holds for stored pixels. Of a stereo endoscope the frames of one
camera are read (`data_catalog.readers.stereo_frames`).
What is depth or a mask of a frame by its name is left out, and what tells of poses is not read, both with a
warning (`data_catalog.readers.beside_frames`).

Optional in the folder: `intrinsics.json` with `K` (3 x 3), or `fx`, `fy`, `cx`, `cy`, or `field_of_view_deg`
(horizontal, over the width of the picture where that is narrower than the image), in pixels of the upright
images with centres at +0.5, of a pinhole, and the size of the images (`width` and `height`, or the names that
calibration files have for it), which is checked; what is told in several ways has to agree within 1 %. And
`mask.png` (white is tissue), of upright images too.
Without intrinsics a horizontal field of view of 90 degrees is assumed, and said so in the log: the sequence's
intrinsics are `guessed`, and the poses stage estimates them, lens distortion included. A calibration file
(`ingest.calibration`) takes the place of both, and `intrinsics.json` is then not read. Without a mask, the
dark frame round the picture is found from all frames: dark everywhere, always, and joined to the image
border; so are a round picture and burnt-in text (`data_catalog.content`).
"""

from __future__ import annotations

import json
import logging
from pathlib import Path
from typing import Any, Literal

import numpy as np
from jaxtyping import Bool, Float, UInt8

from data_catalog.checks import check_intrinsics
from data_catalog.content import content_mask, looked_at
from data_catalog.folder_reader import FolderReader
from data_catalog.footage import DICOM_SUFFIXES, VIDEO_SUFFIXES, files_of_kind
from data_catalog.guessed_intrinsics import ASSUMED_FIELD_OF_VIEW_DEG, intrinsics_of_field_of_view
from data_catalog.images import (
    UPRIGHT,
    check_links,
    image_entries,
    orientation,
    read_upright,
    spread,
    upright_size,
)
from data_catalog.interlacing import is_combed, is_interlaced
from data_catalog.posed_frames import PosedFrame, SourceFrames
from data_catalog.readers.beside_frames import (
    check_one_format,
    frames_among,
    listed_files,
    tell_about_other_names,
    tell_about_pictures,
    tell_what_is_not_read,
)
from data_catalog.readers.intrinsics_entries import (
    ANGLE,
    EXPECTED,
    PINHOLE_KEYS,
    check_complete,
    check_described,
    check_is_degrees,
    number_of,
    of_angle,
)
from data_catalog.readers.stereo_frames import (
    FramesOfCamera,
    StereoFolders,
    frames_of_camera,
    stereo_folders,
    views_in_pictures,
)
from data_catalog.readers.transforms_files import tell_about_lists_above
from data_catalog.sampling import Sampling
from data_catalog.stereo import BothViews
from extrags.config import IngestConfig
from extrags.errors import SourceError, SourceNotFoundError
from extrags.frame_names import NameOrder, order_for_fingerprint, tell_about_order
from extrags.lens import Lens
from extrags.provenance import StereoCamera

__all__ = [
    "FEWEST_FRAMES",
    "INTRINSICS_FILE",
    "MASK_FILE",
    "READER",
    "is_mask",
    "mask_beside",
    "places_with_frames",
    "read_intrinsics",
    "stated_intrinsics",
    "states_angle_alone",
]

logger = logging.getLogger(__name__)

INTRINSICS_FILE = "intrinsics.json"
MASK_FILE = "mask.png"
FEWEST_FRAMES = 4
"""Fewer stills beside a video are pictures about it: poses could not be estimated from them."""
_CLEARLY_MORE = 2
_LOOKED_AT_FOR_COMBS = 12
_AGREEING = 0.01
"""So far apart, relatively, may be what an `intrinsics.json` tells twice: angles are rounded."""


def is_mask(file: Path) -> bool:
    """Whether an image is a mask by its name, and no frame."""
    return file.stem.lower() == "mask"


def mask_beside(folder: Path, images: Path | None = None) -> Path | None:
    """The mask of all frames, or None; of others it is said that they are not read.

    Args:
        folder: that should hold it.
        images: folder of the images; None for the same.

    Raises:
        SourceNotFoundError: the mask is a link to a file that is not there.
    """
    found = folder / MASK_FILE
    check_links([found])
    for file in (file for place in {folder, images or folder} for file in image_entries(place)):
        if is_mask(file) and file != found:
            logger.warning(
                "%s is not read; the mask of all frames is %s",
                file,
                found,
                extra={"topic": "not read", "field": "files"},
            )
    return found if found.is_file() else None


def places_with_frames(folder: Path) -> dict[Path, list[Path]]:
    """The frames in a folder itself, in `images/` and in `rgb/`, where there are any; the most first.

    Links to nothing are among them: which place is meant does not depend on whether its files are there.
    """
    found = {place: frames_among(_pictures(place))[0] for place in _places(folder)}
    return {place: found[place] for place in sorted(found, key=lambda at: -len(found[at])) if found[place]}


def _places(folder: Path) -> list[Path]:
    return [place for place in (folder, folder / "images", folder / "rgb") if place.is_dir()]


def _pictures(place: Path) -> list[Path]:
    found = [file for file in image_entries(place) if not is_mask(file)]
    # The name of a mask tells nothing of how frames are numbered.
    order = NameOrder(file.name for file in found)
    return sorted(found, key=lambda file: order.key(file.name))


def _images(folder: Path, camera: StereoCamera = "left") -> FramesOfCamera | None:
    """The frames to read; None where there are none.

    Raises:
        SourceError: several places hold about as many, one frame is there in two formats, or nothing tells
            which frames belong to which camera.
        SourceNotFoundError: one of the frames is a link to a file that is not there.
    """
    found = _all_places(folder)
    if not found:
        return None
    place, *others = found
    most, *fewer = (_of_one_camera(at, there) for at, there in found.items())
    if others and most < _CLEARLY_MORE * fewer[0]:
        told = " and ".join(f"{len(there)} images {_said(at, folder)}" for at, there in found.items())
        raise SourceError(
            f"{told}; give the path of the folder to read, or move away what is not to be read", file=folder
        )
    read = frames_of_camera(place, found[place], camera)
    check_links(read.all_files)
    check_one_format(read.files)
    return read


def _all_places(folder: Path) -> dict[Path | StereoFolders, list[Path]]:
    """As `places_with_frames`, and folders of a left and a right camera with the frames of both."""
    found: dict[Path | StereoFolders, list[Path]] = {}
    found.update(places_with_frames(folder).items())
    for place in _places(folder):
        for pair in stereo_folders(place):
            found[pair] = [file for at in (pair.left, pair.right) for file in frames_among(_pictures(at))[0]]
    return {at: found[at] for at in sorted(found, key=lambda place: -_of_one_camera(place, found[place]))}


def _of_one_camera(place: Path | StereoFolders, files: list[Path]) -> int:
    """Number of frames of the camera of which there are more."""
    if isinstance(place, Path):
        return len(files)
    return max(sum(file.parent == at for file in files) for at in (place.left, place.right))


def _said(place: Path | StereoFolders, folder: Path) -> str:
    if isinstance(place, StereoFolders):
        return f"in {place}"
    return "in the folder itself" if place == folder else f"in {place.name}/"


def _recognises(folder: Path) -> bool:
    if not folder.is_dir():
        return False
    most = max((len(files) for files in _all_places(folder).values()), default=0)
    # A few pictures beside several videos are not what is meant.
    return most >= FEWEST_FRAMES or (most > 0 and not _footage(folder))


def _footage(folder: Path) -> list[Path]:
    return files_of_kind(folder, (*VIDEO_SUFFIXES, *DICOM_SUFFIXES))


def _tell_what_is_passed_over(folder: Path, read: FramesOfCamera) -> None:
    """Warn of images elsewhere in a folder, of pictures that are no frames, and of what else lies there."""
    files = read.files
    for place, others in _all_places(folder).items():
        if place != read.place:
            logger.warning(
                "%s: images %s are not read (%s), only the %d %s",
                folder,
                _said(place, folder),
                listed_files(others),
                len(files),
                _said(read.place, folder),
            )
    tell_about_pictures(folder, frames_among(_pictures(files[0].parent))[1])
    tell_what_is_not_read(folder)
    tell_about_lists_above(folder)
    if footage := _footage(folder):
        logger.warning(
            "%s: %d images are read, and not %s; give its path to read that instead",
            folder,
            len(files),
            listed_files(footage),
        )


def _files(folder: Path) -> list[Path]:
    extra = [folder / INTRINSICS_FILE, folder / MASK_FILE]
    read = _images(folder)
    frames = [] if read is None else read.all_files
    return sorted([*frames, *(file for file in extra if file.is_file())])


def _frames(folder: Path, config: IngestConfig) -> SourceFrames:
    read = _images(folder, config.stereo_camera)
    if read is None:
        raise SourceNotFoundError("no image in this folder", file=folder)
    _tell_what_is_passed_over(folder, read)
    read.check_and_tell()
    files = read.files
    tell_about_order(files[0].parent, NameOrder(file.name for file in files))
    tell_about_other_names(files)
    views = None if read.pairs else views_in_pictures(files, config.stereo_camera)
    width, height = upright_size(files[0], frame=files[0].name)
    pixel_aspect = 1.0
    if views is not None:
        pixel_aspect = views.pixel_aspect(width, height)
        width, height = views.size(width, height)
    K = read_intrinsics(
        folder,
        width,
        height,
        pixel_aspect=pixel_aspect,
        is_used=config.calibration is None,
        are_turned=orientation(files[0]) != UPRIGHT,
        images=files[0].parent,
    )
    lens = Lens.pinhole(K, width, height)
    mask_file = mask_beside(folder, files[0].parent)
    return SourceFrames(
        frames=[PosedFrame(file.name, file, lens, mask_file=mask_file) for file in files],
        pose_file=folder,
        metric=False,
        read_color=_Images(folder, [files[k] for k in spread(len(files), config.max_frames)], views).image,
        masks=_ContentMask(),
        intrinsics=stated_intrinsics(folder, config),
        angle_alone=states_angle_alone(folder, config),
        stereo_camera=config.stereo_camera if read.pairs or views is not None else None,
        upright=True,
    )


class _Images:
    """Reads the frames that are kept, and warns with the last one where they show two moments each.

    Args:
        folder: named in the warning.
        files: that will be read, in order.
        views: where the view that is taken lies in each; None takes the whole picture.
    """

    def __init__(self, folder: Path, files: list[Path], views: BothViews | None) -> None:
        self._folder = folder
        self._views = views
        self._last = files[-1]
        self._looked_at = {files[k] for k in spread(len(files), _LOOKED_AT_FOR_COMBS)}
        self._combed: list[bool] = []

    def image(self, frame: PosedFrame) -> UInt8[np.ndarray, "h w 3"]:
        """The image of the next frame, as viewers show it."""
        image = read_upright(frame.file, frame=frame.label)
        if self._views is not None:
            image = self._views.view(image)
        if frame.file in self._looked_at:
            self._combed.append(is_combed(image))
        if frame.file == self._last and is_interlaced(self._combed):
            logger.warning(
                "%s: interlaced: each image shows two moments, woven line by line, and is read as it is; "
                "give the video they were taken from, of which single moments are read, or deinterlace them",
                self._folder,
            )
        return image


class _ContentMask:
    """What is tissue, found from all frames as the sequence holds them."""

    def __init__(self) -> None:
        self._seen: list[UInt8[np.ndarray, "h w 3"]] = []

    def see(
        self, frame: PosedFrame, image: UInt8[np.ndarray, "h w 3"], sampled: UInt8[np.ndarray, "h2 w2 3"]
    ) -> None:
        """Keep the small image; long recordings would not fit into memory at full size."""
        self._seen.append(sampled)

    def mask(self, frame: PosedFrame, sampling: Sampling) -> Bool[np.ndarray, "h2 w2"]:
        """The picture inside its dark frame, less burnt-in text."""
        seen = sampling.mask(np.ones((frame.lens.height, frame.lens.width), dtype=bool), file=frame.file)
        return np.asarray(
            content_mask(np.stack([self._seen[index] for index in looked_at(len(self._seen))])) & seen
        )


def _order(folder: Path) -> dict[str, Any]:
    read = _images(folder)
    if read is None:
        return {}
    # Of two cameras each has a folder of its own, or both have one.
    of_folders: dict[Path, list[str]] = {}
    for file in read.all_files:
        of_folders.setdefault(file.parent, []).append(file.name)
    orders = [order_for_fingerprint(names) for names in of_folders.values()]
    return next((order for order in orders if order), {})


READER = FolderReader(
    name="frames",
    version=11,
    summary="plain images in the folder, in images/ or in rgb/, optionally with intrinsics.json and mask.png",
    recognises=_recognises,
    files=_files,
    frames=_frames,
    conventions="no poses and no depth; the poses stage finds them, in an arbitrary unit",
    chosen=_order,
)


def stated_intrinsics(folder: Path, config: IngestConfig) -> Literal["given", "guessed"]:
    """Whether `intrinsics.json` tells the lens of frames beside it; a calibration file comes before it."""
    is_read = config.calibration is None and (folder / INTRINSICS_FILE).is_file()
    return "given" if is_read else "guessed"


def states_angle_alone(folder: Path, config: IngestConfig) -> bool:
    """Whether `intrinsics.json`, where it is read, tells a field of view and no more of the lens.

    Raises:
        SourceError: the file is damaged.
    """
    if stated_intrinsics(folder, config) == "guessed":
        return False
    content = _content(folder / INTRINSICS_FILE)
    return ANGLE in content and not any(key in content for key in ("K", *PINHOLE_KEYS))


def read_intrinsics(
    folder: Path,
    width: int,
    height: int,
    *,
    pixel_aspect: float = 1.0,
    is_used: bool = True,
    are_turned: bool = False,
    images: Path | None = None,
) -> Float[np.ndarray, "3 3"]:
    """K from `intrinsics.json` in a folder, or of the assumed field of view where there is none.

    Args:
        folder: where the file is looked for.
        width: of the images it belongs to, in pixels.
        height: of the images it belongs to, in pixels.
        pixel_aspect: width of a pixel over its height, for intrinsics from a field of view.
        is_used: false where a calibration file takes the place of the result: nothing is read then, nor
            warned of.
        are_turned: whether width and height are those of images that lie otherwise in their files.
        images: folder of the images; a file there is not read, which a warning says. None for the same.

    Raises:
        SourceError: the file is damaged or describes no pinhole.
    """
    file = folder / INTRINSICS_FILE
    beside = (images or folder) / INTRINSICS_FILE
    if is_used and beside != file and beside.is_file():
        logger.warning(
            "%s is not read; intrinsics are read from %s",
            beside,
            file,
            extra={"topic": "not read", "field": "files"},
        )
    if not is_used and file.is_file():
        logger.info("%s is not read: ingest.calibration takes its place", file)
    if not is_used or not file.is_file():
        logger.log(
            logging.WARNING if is_used else logging.DEBUG,
            "%s has no intrinsics.json: assuming a horizontal field of view of %g degrees, until the poses "
            "stage estimates it",
            folder.name,
            ASSUMED_FIELD_OF_VIEW_DEG,
        )
        return intrinsics_of_field_of_view(
            ASSUMED_FIELD_OF_VIEW_DEG, width, height, pixel_aspect=pixel_aspect
        )
    content = _content(file)
    try:
        check_described(content, width, height, file, are_turned=are_turned)
        if "K" in content:
            K = np.asarray(content["K"], dtype=np.float64)
        elif ANGLE in content and not any(key in content for key in PINHOLE_KEYS):
            check_is_degrees(content, file)
            K = of_angle(content, width, height, pixel_aspect, file)
        else:
            check_complete(content, file)
            fx, fy, cx, cy = (number_of(content, key, file) for key in PINHOLE_KEYS)
            K = np.array([[fx, 0, cx], [0, fy, cy], [0, 0, 1.0]])
        if K.shape != (3, 3):
            raise SourceError(f"found shape {K.shape}; expected 3 x 3 numbers", file=file, field="K")
        check_intrinsics(K, width, height, file=file)
        _check_agreement(content, K, width, height, file)
    except SourceError:
        raise
    except (OverflowError, RecursionError, TypeError, ValueError) as error:
        raise SourceError(f"{EXPECTED}: {error}", file=file, field="K") from error
    return K


def _content(file: Path) -> dict[str, Any]:
    """The entries of `intrinsics.json`.

    Raises:
        SourceError: it holds none.
    """
    try:
        content = json.loads(file.read_text(encoding="utf-8-sig"))
    except (RecursionError, ValueError) as error:
        raise SourceError(f"{EXPECTED}: {error}", file=file, field="K") from error
    if not isinstance(content, dict):
        raise SourceError(f"{EXPECTED}: found {type(content).__name__}, not an object", file=file, field="K")
    return content


def _check_agreement(
    content: dict[str, Any], K: Float[np.ndarray, "3 3"], width: int, height: int, file: Path
) -> None:
    """Refuse a lens that is told in several ways which differ: none of them is known to be the right one.

    Args:
        content: of the file.
        K: that would be taken.
        width: of the images, in pixels.
        height: of the images, in pixels.
        file: named in messages.

    Raises:
        SourceError: names two entries that contradict each other.
    """
    taken = "K" if "K" in content else "fx"
    told = dict(zip(PINHOLE_KEYS, (K[0, 0], K[1, 1], K[0, 2], K[1, 2]), strict=True))
    sizes = dict(zip(PINHOLE_KEYS, (K[0, 0], K[1, 1], width, height), strict=True))
    for key in (key for key in PINHOLE_KEYS if key in content):
        value = number_of(content, key, file)
        if not abs(value - told[key]) <= _AGREEING * sizes[key]:
            raise SourceError(
                f"{value:g} px, and {told[key]:g} px by {taken}; expected one of the two, or the same twice",
                file=file,
                field=f"{key}, {taken}",
            )
    if ANGLE in content:
        focal_px = of_angle(content, width, height, 1.0, file)[0, 0]
        if not abs(focal_px - K[0, 0]) <= _AGREEING * K[0, 0]:
            raise SourceError(
                f"{number_of(content, ANGLE, file):g} degrees over {width} pixels are a focal length of "
                f"{focal_px:.4g} px, and {taken} makes it {K[0, 0]:.4g}; expected one of the two, or the "
                "same twice",
                file=file,
                field=f"{ANGLE}, {taken}",
            )
