"""Reading and writing of image files: colour, masks, depth."""

from __future__ import annotations

import struct
import warnings
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from pathlib import Path

import numpy as np
from jaxtyping import Bool, Float, UInt8

from data_catalog.inside import inside
from extrags.array_files import COLORED_PALETTE, MOST_PIXELS, TOO_MANY_PIXELS, image_numbers, load_npy
from extrags.errors import SourceError, SourceNotFoundError, reason_of
from extrags.events import Progress, emit
from extrags.frame_names import COLOR_SUFFIXES, NameOrder, names_in_folders
from extrags.sequence import EndoscopicSequence

__all__ = [
    "COLOR_SUFFIXES",
    "DEPTH_SUFFIXES",
    "UPRIGHT",
    "bits_per_value",
    "check_links",
    "color_files",
    "depth_suffixes_in_words",
    "image_entries",
    "image_size",
    "is_transparent",
    "orientation",
    "read_color",
    "read_depth",
    "read_mask",
    "read_upright",
    "save_images",
    "spread",
    "upright_size",
]

BITS_PER_SAMPLE = 258
"""Tag of TIFF."""
_SAMPLES_PER_PIXEL = 277
_SAMPLE_FORMAT = 339
_SAMPLE_FORMATS = {1: "integers", 2: "signed integers", 3: "floating-point numbers"}
_ORIENTATION = 274
"""Tag of EXIF."""
UPRIGHT = 1
"""Orientation of images whose pixels lie as they are shown."""
_ON_THEIR_SIDES = (5, 6, 7, 8)
"""Orientations whose rows are shown as columns; of what that makes of them, the next two are turned round."""
_LEFT_IS_RIGHT = (2, 3, 6, 7)
_TOP_IS_BOTTOM = (3, 4, 7, 8)
_TIFF_SIGNATURES = (b"II*\0", b"MM\0*", b"II+\0", b"MM\0+")
DEPTH_SUFFIXES = (".npy", ".tiff", ".tif", ".png")
_MASK_THRESHOLD = 127
_COLORED_MODES = ("RGB", "RGBA", "P", "PA")
_LEAST_CHROMA = 64
"""Of 255: what a pixel of colour differs by between its channels at least."""
_SAME_COLOR = 0.95
"""Cosine of the angle between colours, from which on one is a shade of the other."""
_BRIGHT_LABEL = 96
"""Of 255: the largest channel of a label that is not black."""
_OTHER_SHARE = 0.01
"""Of the pixels of labels: what other colours have at most where a mask has one."""
_NAMED_COLORS = 4
_LEAST_OPACITY = 128
"""Of 255: pixels below are more transparent than opaque."""
_LOSSY_SUFFIXES = (".jpg", ".jpeg")
_LOSSLESS_WEBP = b"VP8L"
"""Of the part that holds the pixels; of lossy ones it has a blank."""


def color_files(folder: Path) -> list[Path]:
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
        if file.suffix.lower() in COLOR_SUFFIXES
        and not file.name.startswith(".")
        and (file.is_file() or _leads_nowhere(file))
    ]
    order = NameOrder(file.name for file in named)
    return sorted(named, key=lambda file: order.key(file.name))


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


def read_color(file: Path, *, frame: object = None) -> UInt8[np.ndarray, "h w 3"]:
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


def read_upright(file: Path, *, frame: object = None) -> UInt8[np.ndarray, "h w 3"]:
    """As `read_color`, turned and mirrored as viewers show the image (`orientation`), [H, W, 3].

    Raises:
        SourceNotFoundError: there is no such file.
        SourceError: as of `read_color`.
    """
    image = read_color(file, frame=frame)
    stored = orientation(file)
    if stored in _ON_THEIR_SIDES:
        image = image.transpose(1, 0, 2)
    if stored in _LEFT_IS_RIGHT:
        image = image[:, ::-1]
    if stored in _TOP_IS_BOTTOM:
        image = image[::-1]
    return np.ascontiguousarray(image)


def upright_size(file: Path, *, frame: object = None) -> tuple[int, int]:
    """Width and height in pixels of what `read_upright` gives, from the first bytes.

    Raises:
        SourceNotFoundError: there is no such file.
        SourceError: the file is no image.
    """
    width, height = image_size(file, frame=frame)
    return (height, width) if orientation(file) in _ON_THEIR_SIDES else (width, height)


def bits_per_value(file: Path) -> int:
    """Bits of each colour or grey value in an image file; 8 for what is no image.

    Raises:
        SourceNotFoundError: there is no such file.
        SourceError: the file is damaged.
    """
    from PIL import Image

    if file.suffix.lower() not in COLOR_SUFFIXES:
        return 8
    with _image_errors(file, None, "rgb"), Image.open(file) as image:
        told = getattr(image, "tag_v2", {}).get(BITS_PER_SAMPLE)
        if told is not None:
            return int(told[0])
        # Of colours of 16 bits only the description of what is stored tells: their mode is that of 8.
        return 16 if ";16" in f"{image.mode} {image.tile}" else 8


def is_transparent(file: Path) -> bool:
    """Whether an image has pixels that are more transparent than opaque; False for what is no image.

    Raises:
        SourceNotFoundError: there is no such file.
        SourceError: the file is damaged.
    """
    from PIL import Image

    if file.suffix.lower() not in COLOR_SUFFIXES:
        return False
    with _image_errors(file, None, "rgb"), Image.open(file) as image:
        # From the first bytes; only of images that have some are pixels decoded.
        if not image.has_transparency_data:
            return False
        return bool((np.asarray(image.convert("RGBA"))[..., 3] < _LEAST_OPACITY).any())


def orientation(file: Path) -> int:
    """How viewers turn an image that `read_color` has read: EXIF's 1 to 8, `UPRIGHT` where nothing says so.

    COLMAP and instant-ngp take pixels as they are stored, and so does `read_color`; OpenCV turns them, as
    `read_upright` does. Of a TIFF, the orientation is part of its layout: Pillow has applied it, and nothing
    is left to turn.
    """
    from PIL import Image

    if file.suffix.lower() not in COLOR_SUFFIXES:
        return UPRIGHT
    try:
        with warnings.catch_warnings(), _image_errors(file, None, "rgb"), Image.open(file) as image:
            warnings.simplefilter("ignore")
            # Pillow would decode a whole PNG to look for EXIF data behind the pixels.
            if image.format == "TIFF" or (image.format == "PNG" and "exif" not in image.info):
                return UPRIGHT
            found = image.getexif().get(_ORIENTATION, UPRIGHT)
    except SourceError:
        # Reading the pixels tells what is damaged; where only what describes them is, that says nothing.
        return UPRIGHT
    return found if found in range(1, 9) else UPRIGHT


def read_mask(file: Path, *, frame: object = None) -> Bool[np.ndarray, "h w"]:
    """Read a mask: white is tissue, or in an image of two labels the one that is not 0.

    Raises:
        SourceNotFoundError: there is no such file.
        SourceError: the file is truncated or no image, has several values of which none is white, has
            labels in several colours, or all that differs is how opaque it is.
    """
    from PIL import Image

    with _image_errors(file, frame, "mask"), Image.open(file) as image:
        image.load()
        values = np.asarray(image.convert("L"))
        opacity = np.asarray(image.convert("LA"))[..., 1] if image.has_transparency_data else None
        colors = np.asarray(image.convert("RGB")) if image.mode in _COLORED_MODES else None
        if colors is not None and opacity is not None:
            # What is transparent has colours that nobody sees.
            colors = colors * (opacity > 0)[..., None]
    if colors is not None and not _is_lossy(file):
        _check_mask_colors(colors, file, frame)
    found = np.unique(values)
    if len(found) == 1 and opacity is not None and len(np.unique(opacity)) > 1:
        raise SourceError(
            "one colour throughout, and opaque in parts; expected white where tissue is, and black",
            file=file,
            frame=frame,
            field="mask",
        )
    # Of what is lossy, black is not all of one value: it holds no labels.
    if found[-1] > _MASK_THRESHOLD or _is_lossy(file):
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


def _check_mask_colors(colors: UInt8[np.ndarray, "h w 3"], file: Path, frame: object) -> None:
    """Refuse labels in colours, unless they are one colour on black: how bright a label is tells nothing.

    Shades of one colour, which resizing makes at edges, are none of their own.

    Raises:
        SourceError: several colours, or one beside white.
    """
    channels = [colors[..., k] for k in range(3)]
    chroma = np.maximum.reduce(channels) - np.minimum.reduce(channels)
    if not (chroma >= _LEAST_CHROMA).any():
        return
    # As one number each: rows would take ten times as long to sort.
    packed, counts = np.unique(
        colors.astype(np.uint32) @ np.array([1 << 16, 1 << 8, 1], np.uint32), return_counts=True
    )
    several = np.stack([packed >> 16, packed >> 8 & 255, packed & 255], axis=1)
    bright = several.max(1) >= _BRIGHT_LABEL
    if not bright.any():
        return
    labels, counts = several[bright].astype(np.float64), counts[bright]
    color = labels[np.argmax(counts)]
    likeness = labels @ color / (np.linalg.norm(labels, axis=1) * np.linalg.norm(color))
    # What compression leaves at edges is little.
    if counts[likeness < _SAME_COLOR].sum() > _OTHER_SHARE * counts.sum():
        order = np.argsort(-counts, kind="stable")[:_NAMED_COLORS]
        raise SourceError(
            f"labels in several colours (most pixels have, in red, green and blue: "
            f"{', '.join(str(tuple(map(int, labels[place]))) for place in order)}); "
            "expected white where tissue is, and black, or two labels of which one is black",
            file=file,
            frame=frame,
            field="mask",
        )


def _is_lossy(file: Path) -> bool:
    suffix = file.suffix.lower()
    return suffix in _LOSSY_SUFFIXES or (suffix == ".webp" and _LOSSLESS_WEBP not in file.read_bytes())


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
            values = load_npy(file, most=MOST_PIXELS)
        except (ValueError, OSError) as error:
            raise SourceError(
                f"cannot be read: {reason_of(error)}", file=file, frame=frame, field="depth"
            ) from error
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
            mask leaves anything out. Outside the mask images are black: what is burnt in there, as a
            patient's name, must not leave with files that are made to be passed on.

    Returns:
        The names of the images below `images/`, one per frame.

    Raises:
        SourceError: a frame's name that leads out of the folder.
    """
    from PIL import Image

    names = []
    told = [sequence.frame_name(index) for index in range(len(sequence))]
    for index, name in enumerate(names_in_folders(told, sequence.recording, sequence.split.frames)):
        # Names come from sources; nothing is written beside the folder.
        inside(folder / "images", f"{name}.png", file=folder, frame=index, field="name")
        names.append(f"{name}.png")
    masked = not sequence.mask.all()
    for index, name in enumerate(names):
        shown = np.where(sequence.mask[index][..., None], sequence.rgb[index], 0).astype(np.uint8)
        places = [(folder / "images" / name, Image.fromarray(shown))]
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


def _stored_numbers(file: Path, frame: object) -> np.ndarray:
    """Pixels of an image that holds numbers; a palette of greys is undone."""
    from PIL import Image

    with _image_errors(file, frame, "depth"), Image.open(file) as image:
        image.load()
        values = image_numbers(image)
    if values is None:
        raise SourceError(COLORED_PALETTE, file=file, frame=frame, field="depth")
    return values


def depth_suffixes_in_words() -> str:
    """The files that hold depth, for messages."""
    return f"{', '.join(DEPTH_SUFFIXES[:-1])} or {DEPTH_SUFFIXES[-1]} with one number per pixel"


def _tiff_values(file: Path, field: str) -> str | None:
    """What of the values in a TIFF is not read, in words; None where they are of a kind that is.

    Args:
        file: that Pillow cannot identify.
        field: what it should hold.
    """
    from PIL.TiffImagePlugin import ImageFileDirectory_v2

    try:
        with file.open("rb") as stream, warnings.catch_warnings():
            warnings.simplefilter("ignore")
            directory = ImageFileDirectory_v2(stream.read(8))
            stream.seek(directory.next)
            directory.load(stream)
        bits = int(np.max(directory.get(BITS_PER_SAMPLE, 1)))
        stored = int(np.max(directory.get(_SAMPLE_FORMAT, 1)))
        channels = int(directory.get(_SAMPLES_PER_PIXEL, 1))
    except Exception:
        # Of a damaged directory nothing is told but that it is damaged; Pillow reports that as anything.
        return None
    values = f"{_SAMPLE_FORMATS.get(stored, 'values')} of {bits} bits"
    if field == "depth":
        return f"{channels} channels of {values}; expected one number per pixel" if channels > 1 else None
    if stored == 1 and bits <= 16:
        return None
    what = "colours" if channels > 1 else "grey"
    return f"{what} in {values}, which are not read; expected integers of 8 or 16 bits without a sign"


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
        told = _tiff_values(file, field) if is_tiff else None
        if field == "depth" and file.suffix.lower() not in DEPTH_SUFFIXES:
            problem = f"depth of this format is not read; expected {depth_suffixes_in_words()}"
        elif told is not None:
            problem = told
        else:
            damage = f"or damaged from its first bytes ({file.stat().st_size} bytes)"
            problem = f"{kind if is_tiff else 'not an image'}, {damage}"
        raise SourceError(
            problem,
            file=file,
            frame=frame,
            field=field,
        ) from error
    except Image.DecompressionBombError as error:
        raise SourceError(TOO_MANY_PIXELS, file=file, frame=frame, field=field) from error
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
    ) as error:
        # Pillow reports damage inside an image as any of these.
        raise SourceError(
            f"damaged or truncated image ({file.stat().st_size} bytes): {reason_of(error)}",
            file=file,
            frame=frame,
            field=field,
        ) from error
