"""Renders of other programs: reads a folder of images as `RenderedViews`.

The images show the held-out frames of a sequence. They are matched by name (`b_0010.png` for the frame
`b_0010`) if every file name is that of a frame; otherwise by number: as many files as held-out frames, sorted
by the numbers in their names, for the frames in the order of the split. Frames named with their folders may
stand in folders of these names (`left/0010.png`), those of several recordings in folders of these, as
exporters write them (`recording_1/0010.png`); they must where held-out frames share a name. Files and folders
whose names begin with a dot are none of them.
"""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Collection, Sequence
from pathlib import Path, PurePosixPath

import numpy as np
from jaxtyping import Float

from extrags.array_files import COLORED_PALETTE, MOST_PIXELS, TOO_MANY_PIXELS, image_numbers, load_npy
from extrags.errors import (
    ConfigError,
    NonFiniteError,
    ShapeError,
    SourceError,
    SourceNotFoundError,
    reason_of,
)
from extrags.frame_names import COLOR_SUFFIXES, NameOrder, names_in_folders, tell_about_order
from extrags.frame_stacks import stacked
from extrags.metrics.protocol import RenderedViews
from extrags.sequence import EndoscopicSequence

__all__ = ["read_renders"]

DEPTH_SUFFIXES = frozenset({".npy", ".png", ".tif", ".tiff"})
_MAX_LISTED_NAMES = 5


def read_renders(
    folder: Path,
    sequence: EndoscopicSequence,
    *,
    depth_folder: Path | None = None,
    depth_step_mm: float | None = None,
    not_measured: Sequence[str] = (),
) -> RenderedViews:
    """Read renders of a sequence's held-out frames.

    Args:
        folder: images of the sequence's size, 8 bits a channel.
        sequence: defines the held-out frames, their order and the image size.
        depth_folder: z-depth maps of the same frames, 0 where there is no surface: `.npy` or floating-point
            TIFF in the unit of the sequence, or 16-bit PNG or TIFF in steps of `depth_step_mm`.
        depth_step_mm: unit of integer depth images; not needed for floating-point ones.
        not_measured: names of frames that the sequence lacks, of which there may be images all the same.

    Returns:
        The renders in the order of `sequence.test`. Alpha is 1; without depth maps they have no depth.

    Raises:
        SourceNotFoundError: for a folder that does not exist or holds no images, and for held-out frames
            without an image; names them.
        SourceError: for a file that cannot be read or matches no held-out frame, or could be of several.
        ShapeError: for an image of another size; names the file and both sizes.
        NonFiniteError: for depth that holds NaN or infinity.
        ConfigError: for integer depth without its step, or a step that is not positive.
    """
    if depth_step_mm is not None and not 0 < depth_step_mm < math.inf:
        raise ConfigError(f"a step of depth of {depth_step_mm} mm; expected a length above zero")
    shape = (sequence.height, sequence.width)
    # One view at a time: held-out views may be hundreds, of full size.
    files = _files_of(folder, sequence, COLOR_SUFFIXES, "image", not_measured)
    rgb = stacked((_color(file, shape) for file in files), len(files))
    everywhere = (len(files), *shape)
    depth = np.broadcast_to(np.float32(0), everywhere)
    if depth_folder is not None:
        maps = _files_of(depth_folder, sequence, DEPTH_SUFFIXES, "depth map", not_measured)
        depth = stacked((_depth(file, shape, depth_step_mm) for file in maps), len(maps))
    return RenderedViews(
        rgb,
        np.broadcast_to(np.float32(1), everywhere),
        depth,
        None,
        has_depth=depth_folder is not None,
    )


def _files_of(
    folder: Path,
    sequence: EndoscopicSequence,
    suffixes: Collection[str],
    kind: str,
    not_measured: Sequence[str],
) -> list[Path]:
    """One file per held-out frame, in their order."""
    if not folder.is_dir():
        raise SourceNotFoundError(f"there is no such folder of {kind}s", file=folder)
    frames = [sequence.frame_name(frame) for frame in range(len(sequence))]
    placed = names_in_folders(frames, sequence.recording, sequence.split.frames)
    paths = [_bare(placed[int(frame)]) for frame in sequence.test]
    in_folders = _files_at(paths, folder, suffixes)
    if in_folders:
        return _named(paths, _by_name(in_folders, kind), folder, sequence, kind)
    files = sorted(file for file in folder.iterdir() if _is_meant(file, folder, suffixes))
    if not files:
        kinds = ", ".join(sorted(suffixes))
        raise SourceNotFoundError(f"the folder holds no {kind} ({kinds})", file=folder)
    wanted = [_stem(path) for path in paths]
    every = {_stem(_bare(name)) for name in (*frames, *not_measured)}
    by_stem = _by_name({file: file.stem for file in files}, kind)
    named = [stem for stem in by_stem if stem in every]
    if named and (len(named) == len(by_stem) or len(set(wanted)) < len(wanted)):
        return _named(wanted, by_stem, folder, sequence, kind)
    if any(stem in wanted for stem in named):
        strange = [file.name for stem, file in by_stem.items() if stem not in every]
        raise SourceError(
            f"some {kind}s are named after frames of {sequence.name} and some are not: {_some(strange)}",
            file=folder,
        )
    return _by_number(files, folder, sequence, kind, wanted)


def _by_number(
    files: list[Path], folder: Path, sequence: EndoscopicSequence, kind: str, wanted: list[str]
) -> list[Path]:
    if len(files) != len(wanted):
        raise SourceNotFoundError(
            f"{len(files)} {kind}s for {len(wanted)} held-out frames of {sequence.name}, and their names are "
            f"not those of the frames ({_some(wanted)})",
            file=folder,
        )
    order = NameOrder(file.stem for file in files)
    keys = [order.numbers(file.stem) for file in files]
    bare = [file.name for file, found in zip(files, keys, strict=True) if not found]
    if bare:
        raise SourceError(
            f"{kind}s without a number in their names have no place: {_some(bare)}; name them after their "
            f"frames ({_some(wanted)})",
            file=folder,
        )
    if len(set(keys)) != len(keys):
        twice = [file.name for file, key in zip(files, keys, strict=True) if keys.count(key) > 1]
        raise SourceError(f"{kind}s with the same number: {_some(twice)}", file=folder)
    tell_about_order(folder, order)
    return [file for _, file in sorted(zip(keys, files, strict=True))]


def _files_at(paths: list[str], folder: Path, suffixes: Collection[str]) -> dict[Path, str]:
    """Files that stand where frames named with their folders say, and which frame each shows."""
    wanted = {path for path in paths if "/" in path}
    if not wanted:
        return {}
    # Looked for among what is there: joined to the folder, a frame's absolute path would lead out of it.
    files = (file for file in sorted(folder.rglob("*")) if _is_meant(file, folder, suffixes))
    places = {file: file.relative_to(folder).with_suffix("").as_posix() for file in files}
    return {file: place for file, place in places.items() if place in wanted}


def _is_meant(file: Path, folder: Path, suffixes: Collection[str]) -> bool:
    """Whether a file below a folder is one of its images: not one that macOS has put beside each."""
    hidden = any(part.startswith(".") for part in file.relative_to(folder).parts)
    return not hidden and file.suffix.lower() in suffixes and file.is_file()


def _by_name(names: dict[Path, str], kind: str) -> dict[str, Path]:
    found: dict[str, Path] = {}
    for file, name in names.items():
        if name in found:
            raise SourceError(f"two {kind}s of one name: {found[name].name} and {file.name}", file=file)
        found[name] = file
    return found


def _named(
    wanted: list[str], files: dict[str, Path], folder: Path, sequence: EndoscopicSequence, kind: str
) -> list[Path]:
    shared = [name for name, count in Counter(wanted).items() if count > 1]
    if shared:
        raise SourceError(
            f"{len(shared)} names are those of several held-out frames of {sequence.name} ({_some(shared)}); "
            f"put the {kind}s in the frames' folders, those of several recordings in recording_0, "
            f"recording_1, ..., as extrags export does, or give them names that are none of a frame and "
            f"have a number",
            file=folder,
        )
    missing = [name for name in wanted if name not in files]
    if missing:
        raise SourceNotFoundError(
            f"{len(missing)} of the {len(wanted)} held-out frames of {sequence.name} have no {kind}: "
            f"{_some(missing)}",
            file=folder,
        )
    return [files[name] for name in wanted]


def _bare(frame_name: str) -> str:
    """Frame names may be file names or paths of the source."""
    path = PurePosixPath(frame_name)
    return (path.with_suffix("") if path.suffix.lower() in COLOR_SUFFIXES else path).as_posix()


def _stem(path: str) -> str:
    return path.rpartition("/")[2]


def _color(file: Path, shape: tuple[int, int]) -> Float[np.ndarray, "h w 3"]:
    from PIL import Image, UnidentifiedImageError

    try:
        with Image.open(file) as image:
            # Pillow opens files of 16 bits a channel as RGB, and drops the lower eight.
            raw = " ".join(str(tile[-1]) for tile in getattr(image, "tile", ()))
            stored = f"{image.mode} of 16 bits" if ";16" in raw else image.mode
            if stored not in ("RGB", "RGBA", "P"):
                raise SourceError(
                    f"expected an 8-bit colour image, found the mode {stored}", file=file, field="mode"
                )
            levels = np.asarray(image.convert("RGB"))
    except Image.DecompressionBombError as error:
        raise SourceError(TOO_MANY_PIXELS, file=file) from error
    except (UnidentifiedImageError, OSError, SyntaxError) as error:
        raise SourceError(f"this is no image that can be read: {reason_of(error)}", file=file) from error
    _check_size(file, levels.shape[:2], shape)
    return levels.astype(np.float32) / 255


def _depth(file: Path, shape: tuple[int, int], step_mm: float | None) -> Float[np.ndarray, "h w"]:
    from PIL import Image, UnidentifiedImageError

    values: np.ndarray | None
    try:
        if file.suffix.lower() == ".npy":
            values = load_npy(file, most=MOST_PIXELS)
        else:
            with Image.open(file) as image:
                values = image_numbers(image)
    except Image.DecompressionBombError as error:
        raise SourceError(TOO_MANY_PIXELS, file=file) from error
    except (UnidentifiedImageError, OSError, SyntaxError, ValueError) as error:
        raise SourceError(f"this is no depth map that can be read: {reason_of(error)}", file=file) from error
    if values is None:
        raise SourceError(COLORED_PALETTE, file=file, field="mode")
    values = values[..., 0] if values.ndim == 3 and values.shape[-1] == 1 else values
    if values.ndim != 2:
        raise ShapeError(f"{file}: a depth map has shape {values.shape}, expected two dimensions")
    _check_size(file, values.shape, shape)
    if not np.issubdtype(values.dtype, np.floating):
        if step_mm is None:
            raise ConfigError(f"{file} holds integers; say what a step of depth is (depth step in mm)")
        values = values * step_mm
    if not np.isfinite(values).all():
        raise NonFiniteError(f"{file}: depth holds NaN or infinity; 0 means that there is no surface")
    return np.asarray(values.astype(np.float32))


def _check_size(file: Path, found: tuple[int, ...], expected: tuple[int, int]) -> None:
    if tuple(found) != expected:
        raise ShapeError(
            f"{file}: {found[1]} x {found[0]} pixels, but the held-out frames are "
            f"{expected[1]} x {expected[0]}; renders are never resized"
        )


def _some(names: list[str]) -> str:
    more = len(names) - _MAX_LISTED_NAMES
    return ", ".join(names[:_MAX_LISTED_NAMES]) + (f" and {more} more" if more > 0 else "")
