"""Reading of image files, and one crop and resize applied to everything that belongs to a frame."""

from __future__ import annotations

import re
import struct
import warnings
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from jaxtyping import Bool, Float, UInt8

from data_catalog.inside import inside
from extrags.array_files import load_npy
from extrags.config import IngestConfig
from extrags.errors import ConfigError, SourceError, SourceNotFoundError
from extrags.events import Progress, emit
from extrags.sequence import EndoscopicSequence

__all__ = [
    "COLOUR_SUFFIXES",
    "UPRIGHT",
    "Resampling",
    "bits_per_value",
    "check_links",
    "colour_files",
    "image_entries",
    "image_size",
    "natural_key",
    "orientation",
    "read_colour",
    "read_depth",
    "read_mask",
    "save_images",
    "spread",
]

BITS_PER_SAMPLE = 258
"""Tag of TIFF."""
_ORIENTATION = 274
"""Tag of EXIF."""
UPRIGHT = 1
"""Orientation of images whose pixels lie as they are shown."""
_TIFF_SIGNATURES = (b"II*\0", b"MM\0*", b"II+\0", b"MM\0+")
COLOUR_SUFFIXES = (".png", ".jpg", ".jpeg", ".bmp", ".tif", ".tiff")
_MASK_THRESHOLD = 127
_LOSSY_SUFFIXES = (".jpg", ".jpeg")
"""Their black is not all of one value: they hold no labels."""
# Neighbouring depths that differ by more than this share lie on different surfaces.
_FOLD_STEP = 0.05


def natural_key(name: str) -> tuple[tuple[int, int, str], ...]:
    """Sort key that reads runs of digits as numbers: `9_color.png` comes before `10_color.png`."""
    parts = re.split(r"(\d+)", name)
    # Digits are compared as text of their length: numbers of any length, and of any script, have a place.
    digits = [part.lstrip("0") if part.isdecimal() else None for part in parts]
    return tuple(
        (0, 0, part) if number is None else (1, len(number), number)
        for part, number in zip(parts, digits, strict=True)
        if part
    )


def colour_files(folder: Path) -> list[Path]:
    """Image files directly in a folder that is read, in natural order.

    Raises:
        SourceNotFoundError: one of them is a link to a file that is not there.
    """
    found = image_entries(folder)
    check_links(found)
    return found


def image_entries(folder: Path) -> list[Path]:
    """What is called like an image directly in a folder, links to nothing among them, in natural order.

    Hidden ones are none: macOS leaves `._NAME` with attributes beside each file on disks of others.
    """
    named = [
        file
        for file in folder.iterdir()
        if file.suffix.lower() in COLOUR_SUFFIXES
        and not file.name.startswith(".")
        and (file.is_file() or _leads_nowhere(file))
    ]
    return sorted(named, key=lambda file: natural_key(file.name))


def check_links(files: Iterable[Path]) -> None:
    """Refuse links to nothing: left out, each would be a frame that nobody misses.

    Raises:
        SourceNotFoundError: one of the files is a link to a file that is not there.
    """
    for file in files:
        if _leads_nowhere(file):
            raise SourceNotFoundError(f"a link to {file.readlink()}, which is not there", file=file)


def _leads_nowhere(file: Path) -> bool:
    return file.is_symlink() and not file.exists()


def read_colour(file: Path, *, frame: object = None) -> UInt8[np.ndarray, "h w 3"]:
    """Read an image as 8-bit RGB; of files with more bits the high ones, alpha is dropped.

    Pixels are those of the file, whatever its EXIF orientation says (`orientation`).

    Raises:
        SourceNotFoundError: there is no such file.
        SourceError: the file is truncated, no image, or has floating-point, signed or 32-bit values, of
            which nothing says what is white.
    """
    from PIL import Image

    with _image_errors(file, frame, "rgb"), Image.open(file) as image:
        image.load()
        mode = image.mode
        # Pillow would clip 16-bit grey at 255: all white. A TIFF tells how many bits of these it uses.
        bits = int(getattr(image, "tag_v2", {}).get(BITS_PER_SAMPLE, (16,))[0])
        grey = (np.asarray(image) >> (bits - 8)).astype(np.uint8) if mode.startswith("I;16") else None
        found = None if mode in ("I", "F") or grey is not None else np.array(image.convert("RGB"), np.uint8)
    if grey is not None:
        return np.repeat(grey[..., None], 3, axis=2)
    if found is None:
        kind = "floating-point" if mode == "F" else "signed or 32-bit"
        raise SourceError(
            f"{kind} values; expected colours or grey of 8 or 16 bits", file=file, frame=frame, field="rgb"
        )
    return found


def image_size(file: Path, *, frame: object = None) -> tuple[int, int]:
    """Width and height of an image in pixels, from its first bytes.

    Raises:
        SourceNotFoundError: there is no such file.
        SourceError: the file is no image.
    """
    from PIL import Image

    with _image_errors(file, frame, "rgb"), Image.open(file) as image:
        return image.size


def bits_per_value(file: Path) -> int:
    """Bits of each colour or grey value in an image file; 8 for what is no image.

    Raises:
        SourceNotFoundError: there is no such file.
        SourceError: the file is damaged.
    """
    from PIL import Image

    if file.suffix.lower() not in COLOUR_SUFFIXES:
        return 8
    with _image_errors(file, None, "rgb"), Image.open(file) as image:
        told = getattr(image, "tag_v2", {}).get(BITS_PER_SAMPLE)
        if told is not None:
            return int(told[0])
        # Of colours of 16 bits only the description of what is stored tells: their mode is that of 8.
        return 16 if ";16" in f"{image.mode} {image.tile}" else 8


def orientation(file: Path) -> int:
    """How viewers turn an image that `read_colour` has read: EXIF's 1 to 8, `UPRIGHT` where nothing says so.

    COLMAP and instant-ngp take pixels as they are stored, and so does `read_colour`; OpenCV turns them. Of a
    TIFF, the orientation is part of its layout: Pillow has applied it, and nothing is left to turn.
    """
    from PIL import Image

    if file.suffix.lower() not in COLOUR_SUFFIXES:
        return UPRIGHT
    try:
        with warnings.catch_warnings(), _image_errors(file, None, "rgb"), Image.open(file) as image:
            warnings.simplefilter("ignore")
            # Pillow would decode a whole PNG to look for EXIF data behind the pixels.
            if image.format == "TIFF" or (image.format == "PNG" and "exif" not in image.info):
                return UPRIGHT
            found = image.getexif().get(_ORIENTATION, UPRIGHT)
    except SourceError:
        # The pixels were read: what is damaged is what describes them, and that says nothing.
        return UPRIGHT
    return found if found in range(1, 9) else UPRIGHT


def read_mask(file: Path, *, frame: object = None) -> Bool[np.ndarray, "h w"]:
    """Read a mask: white is tissue, or in an image of two labels the one that is not 0.

    Raises:
        SourceNotFoundError: there is no such file.
        SourceError: the file is truncated or no image, has several values of which none is white, or all that
            differs is how opaque it is.
    """
    from PIL import Image

    with _image_errors(file, frame, "mask"), Image.open(file) as image:
        image.load()
        values = np.asarray(image.convert("L"))
        opacity = np.asarray(image.convert("LA"))[..., 1] if image.has_transparency_data else None
    found = np.unique(values)
    if len(found) == 1 and opacity is not None and len(np.unique(opacity)) > 1:
        raise SourceError(
            "one colour throughout, and opaque in parts; expected white where tissue is, and black",
            file=file,
            frame=frame,
            field="mask",
        )
    if found[-1] > _MASK_THRESHOLD or file.suffix.lower() in _LOSSY_SUFFIXES:
        return np.asarray(values > _MASK_THRESHOLD)
    if found[-1] > 1 and (len(found) > 2 or found[0] > 0):
        raise SourceError(
            f"{len(found)} values, of which {found[-1]} of 255 is the largest; expected white where tissue "
            "is, and black, or two labels of which one is 0",
            file=file,
            frame=frame,
            field="mask",
        )
    return np.asarray(values > 0)


def read_depth(file: Path, *, frame: object = None) -> Float[np.ndarray, "h w"]:
    """Read a one-channel depth file (`.npy`, or float or integer TIFF or PNG) as float32, values as stored.

    Raises:
        SourceNotFoundError: there is no such file.
        SourceError: the file is damaged, not one channel, or in colours of a palette.
    """
    if file.suffix.lower() == ".npy":
        if not file.is_file():
            raise SourceNotFoundError("no such file", file=file, frame=frame, field="depth")
        try:
            values = load_npy(file)
        except (ValueError, OSError) as error:
            raise SourceError(f"cannot be read: {error}", file=file, frame=frame, field="depth") from error
    else:
        values = np.array(_stored_numbers(file, frame))
    if values.ndim != 2 or values.dtype.kind not in "fiu":
        raise SourceError(
            f"found an array {values.shape} of {values.dtype}; expected one number per pixel",
            file=file,
            frame=frame,
            field="depth",
        )
    return np.asarray(values, dtype=np.float32)


def save_images(sequence: EndoscopicSequence, folder: Path) -> list[str]:
    """Write colour images and masks of a sequence, as exporters do.

    Args:
        sequence: frames of several recordings go to folders of their own, unless their names say folders.
        folder: gets `images/NAME.png`, and `masks/NAME.png.png` (COLMAP's naming; white is tissue) where a
            mask leaves anything out.

    Returns:
        The names of the images below `images/`, one per frame.

    Raises:
        SourceError: a frame's name that leads out of the folder.
    """
    from PIL import Image

    several = sequence.recording is not None and len(np.unique(sequence.recording)) > 1
    names = []
    for index in range(len(sequence)):
        name = sequence.frame_name(index)
        if several and sequence.recording is not None and "/" not in name:
            name = f"recording_{int(sequence.recording[index])}/{name}"
        # Names come from sources; nothing is written beside the folder.
        inside(folder / "images", f"{name}.png", file=folder, frame=index, field="name")
        names.append(f"{name}.png")
    masked = not sequence.mask.all()
    for index, name in enumerate(names):
        places = [(folder / "images" / name, Image.fromarray(sequence.rgb[index]))]
        if masked:
            white = (sequence.mask[index] * 255).astype(np.uint8)
            places.append((folder / "masks" / f"{name}.png", Image.fromarray(white)))
        for place, picture in places:
            place.parent.mkdir(parents=True, exist_ok=True)
            picture.save(place)
        emit(Progress("export", index + 1, len(names)))
    return names


def spread(count: int, at_most: int | None) -> list[int]:
    """Indices of at most so many of `count` frames, evenly spread, first and last included."""
    if at_most is None or count <= at_most:
        return list(range(count))
    return [int(k) for k in np.round(np.linspace(0, count - 1, at_most))]


@dataclass(frozen=True)
class Resampling:
    """Crop a box out of an image, then shrink it; the same for everything that belongs to a frame.

    Args:
        source_width: size of the images on disk.
        source_height: size of the images on disk.
        left: first column kept.
        top: first row kept.
        crop_width: columns kept.
        crop_height: rows kept.
        width: columns of the result.
        height: rows of the result.
    """

    source_width: int
    source_height: int
    left: int
    top: int
    crop_width: int
    crop_height: int
    width: int
    height: int

    @classmethod
    def planned(
        cls,
        source_width: int,
        source_height: int,
        config: IngestConfig,
        usual_downscale: int = 1,
        box: tuple[int, int, int, int] | None = None,
    ) -> Resampling:
        """Decide crop and size from the settings.

        A whole divisor crops the few columns and rows that do not fill a block of pixels, right and bottom.

        Args:
            source_width: size of the images on disk.
            source_height: size of the images on disk.
            config: `width` and `height`, or `downscale`, or `size`.
            usual_downscale: divisor of thumbnails.
            box: left, top, width and height to keep; None keeps all.

        Raises:
            ConfigError: a size that is larger than the source, too small, or of another proportion.
        """
        left, top, crop_width, crop_height = box or (0, 0, source_width, source_height)
        if config.width is None:
            if config.height is not None:
                raise ConfigError("ingest.height needs ingest.width")
            divisor = config.downscale or (usual_downscale if config.size == "thumbnail" else 1)
            width, height = crop_width // divisor, crop_height // divisor
            crop_width, crop_height = width * divisor, height * divisor
        else:
            width = config.width
            proportional = crop_height * width / crop_width
            height = config.height or round(proportional)
            if abs(height - proportional) > max(1.0, 0.02 * proportional):
                raise ConfigError(
                    f"ingest.width = {width} and ingest.height = {height} would squeeze an image of "
                    f"{crop_width} x {crop_height} pixels; give the width alone ({round(proportional)} rows)"
                )
        if width > crop_width or height > crop_height:
            raise ConfigError(
                f"{width} x {height} pixels is larger than the source's {crop_width} x {crop_height}"
            )
        if width < 16 or height < 16:
            raise ConfigError(f"an image of {width} x {height} pixels is too small; expected 16 x 16 or more")
        return cls(source_width, source_height, left, top, crop_width, crop_height, width, height)

    def intrinsics(self, K: Float[np.ndarray, "3 3"]) -> Float[np.ndarray, "3 3"]:
        """K of the result; pixel edges stay where they are (centres at +0.5)."""
        moved = K.copy()
        moved[0, 2] -= self.left
        moved[1, 2] -= self.top
        moved[0] *= self.width / self.crop_width
        moved[1] *= self.height / self.crop_height
        return moved

    def colour(
        self, image: UInt8[np.ndarray, "h w 3"], *, file: object = None, frame: object = None
    ) -> UInt8[np.ndarray, "h2 w2 3"]:
        """Area-averaged colours.

        Raises:
            SourceError: the image is not of the sequence's size.
        """
        import cv2

        crop = self._cropped(image, "rgb", file, frame)
        return np.asarray(cv2.resize(crop, (self.width, self.height), interpolation=cv2.INTER_AREA))

    def mask(
        self, mask: Bool[np.ndarray, "h w"], *, file: object = None, frame: object = None
    ) -> Bool[np.ndarray, "h2 w2"]:
        """True where every source pixel below is true.

        Raises:
            SourceError: the mask is not of the sequence's size.
        """
        import cv2

        crop = self._cropped(mask, "mask", file, frame).astype(np.float32)
        share = cv2.resize(crop, (self.width, self.height), interpolation=cv2.INTER_AREA)
        return np.asarray(share > 0.999)

    def depth(
        self, depth: Float[np.ndarray, "h w"], *, file: object = None, frame: object = None
    ) -> Float[np.ndarray, "h2 w2"]:
        """Depth at the new pixel centres, never mixed across a fold.

        Where the four neighbours are known and close, their inverse depth is interpolated (exact on a
        plane); elsewhere the nearest value is taken. 0 stays unknown.

        Raises:
            SourceError: the depth map is not of the sequence's size.
        """
        crop = self._cropped(depth, "depth", file, frame)
        if (self.width, self.height) == (self.crop_width, self.crop_height):
            # The new pixels are the old ones: the same numbers, in a fortieth of the time.
            return crop.astype(np.float32)
        x = (np.arange(self.width) + 0.5) * self.crop_width / self.width - 0.5
        y = (np.arange(self.height) + 0.5) * self.crop_height / self.height - 0.5
        i = np.clip(np.floor(y).astype(int), 0, max(self.crop_height - 2, 0))
        j = np.clip(np.floor(x).astype(int), 0, max(self.crop_width - 2, 0))
        a = np.clip(y - i, 0, 1)[:, None]
        b = np.clip(x - j, 0, 1)[None, :]
        corners = np.stack([crop[np.ix_(i + down, j + right)] for down in (0, 1) for right in (0, 1)]).astype(
            np.float64
        )
        weights = np.stack([(1 - a) * (1 - b), (1 - a) * b, a * (1 - b), a * b])
        nearest = np.take_along_axis(corners, weights.argmax(axis=0)[None], axis=0)[0]
        low, high = corners.min(axis=0), corners.max(axis=0)
        one_surface = (low > 0) & (high <= low * (1 + _FOLD_STEP))
        inverse = (weights / np.where(corners > 0, corners, 1)).sum(axis=0)
        return np.asarray(np.where(one_surface, 1 / np.maximum(inverse, 1e-12), nearest), dtype=np.float32)

    def _cropped(self, array: np.ndarray, field: str, file: object, frame: object) -> np.ndarray:
        if array.shape[:2] != (self.source_height, self.source_width):
            raise SourceError(
                f"{array.shape[1]} x {array.shape[0]} pixels; "
                f"expected {self.source_width} x {self.source_height} as in the first frame",
                file=file,
                frame=frame,
                field=field,
            )
        return array[self.top : self.top + self.crop_height, self.left : self.left + self.crop_width]


def _stored_numbers(file: Path, frame: object) -> np.ndarray:
    """Pixels of an image that holds numbers; a palette of greys is undone."""
    from PIL import Image

    with _image_errors(file, frame, "depth"), Image.open(file) as image:
        image.load()
        if image.mode not in ("P", "PA"):
            return np.asarray(image)
        colours = np.asarray(image.convert("RGB"))
    # Programs that make files smaller store grey of few values as places in a palette.
    if (colours != colours[..., :1]).any():
        raise SourceError(
            "colours of a palette; expected one number per pixel, not depth in false colours",
            file=file,
            frame=frame,
            field="depth",
        )
    return colours[..., 0]


@contextmanager
def _image_errors(file: Path, frame: object, field: str) -> Iterator[None]:
    """What Pillow raises for a file, as the errors of a source."""
    from PIL import Image, UnidentifiedImageError

    if not file.is_file():
        raise SourceNotFoundError("no such file", file=file, frame=frame, field=field)
    try:
        yield
    except UnidentifiedImageError as error:
        with file.open("rb") as stream:
            is_tiff = stream.read(4) in _TIFF_SIGNATURES
        # Those of 64-bit numbers, which numpy's are unless somebody asks for others.
        kind = "a TIFF of a kind that is not read, expected are numbers of at most 32 bits"
        raise SourceError(
            f"{kind if is_tiff else 'not an image'}, or damaged from its first bytes "
            f"({file.stat().st_size} bytes)",
            file=file,
            frame=frame,
            field=field,
        ) from error
    except (
        OSError,
        SyntaxError,
        ValueError,
        EOFError,
        IndexError,
        KeyError,
        TypeError,
        AttributeError,
        OverflowError,
        MemoryError,
        NotImplementedError,
        ZeroDivisionError,
        struct.error,
        Image.DecompressionBombError,
    ) as error:
        # Pillow reports damage inside an image as any of these.
        raise SourceError(
            f"damaged or truncated image ({file.stat().st_size} bytes): {error}",
            file=file,
            frame=frame,
            field=field,
        ) from error
