"""The two cameras of a stereo endoscope: told by names, by sizes, and by what the pictures show.

Names make pairs where one word alone differs, `left` from `right` or `l` from `r`: `left_0001` and
`right_0001`, `0001_L` and `0001_R`, folders `left/` and `right/`. A picture holds both views where its name
or its size says so. Either is believed only where the pictures agree: `left_0001` and `right_0001` may as
well be two parts of a colon. That two views show the same place is told as it is of neighbouring frames of a
video (`data_catalog.shots`).
"""

from __future__ import annotations

import logging
import re
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from jaxtyping import UInt8

from data_catalog.footage import DICOM_SUFFIXES, VIDEO_SUFFIXES
from data_catalog.images import COLOR_SUFFIXES
from data_catalog.shots import show_the_same
from extrags.config import IngestConfig
from extrags.dense_flow import DenseFlow
from extrags.errors import ConfigError
from extrags.provenance import StereoCamera

__all__ = [
    "AGREES",
    "BothViews",
    "StereoPairs",
    "agreeing_share",
    "check_one_camera",
    "pairs_by_name",
    "possible_views",
    "tell_camera",
]

logger = logging.getLogger(__name__)

AGREES = 0.5
"""Of the pairs that are looked at, so many have to show the same place. Of pairs 2 to 6 mm apart in phantoms
4 to 6 of 6 do, and of the halves of 40 frames of one camera none."""

_OPPOSITE = {"left": "right", "l": "r"}
_WORDS = re.compile(r"[A-Z]?[^\W\d_A-Z]+|[A-Z]+(?![^\W\d_A-Z])")
_SUFFIXES = (*COLOR_SUFFIXES, *VIDEO_SUFFIXES, *DICOM_SUFFIXES)

_SIDE_BY_SIDE = re.compile(r"(?<![a-z])h?sbs(?![a-z])|side[-_ ]?by[-_ ]?side|left[-_ ]?right")
_ABOVE_EACH_OTHER = re.compile(r"top[-_ ]?(and[-_ ]?)?bottom|over[-_ ]?under")
_WIDE, _HIGH = 1.9, 1.1
"""Width over height, and height over width, from which on a picture may hold two views, 5:4 to 16:9 each."""
_SQUEEZED_WIDTH, _SQUEEZED_HEIGHT = 1.0, 2.2
"""Width over height of a view that was squeezed to half its width, at most; to half its height, at least."""
_LOOKED_AT_WIDTH = 192
_FLAT_GREY = 6.0


def check_one_camera(config: IngestConfig, source: str) -> None:
    """Refuse the right camera of a source that nothing tells to have two: it would be passed over.

    Args:
        config: settings the source is read with.
        source: named in the error.

    Raises:
        ConfigError: it is asked for.
    """
    if config.stereo_camera != "left":
        raise ConfigError(
            f"ingest.stereo_camera is {config.stereo_camera}, but nothing tells that {source} holds the "
            "frames of two cameras (docs/sources.md says what does); give the path of the frames to read"
        )


def tell_camera(source: Path, told: str, camera: StereoCamera, taken: str) -> None:
    """Say whose frames are read: a finding of `data check`.

    Args:
        source: that holds those of both cameras.
        told: what tells so.
        camera: whose are read.
        taken: which these are.
    """
    other = "right" if camera == "left" else "left"
    logger.warning(
        "%s: frames of both cameras of a stereo endoscope, %s; those of the %s camera are read, %s, and not "
        "those of the %s one (ingest.stereo_camera takes them)",
        source,
        told,
        camera,
        taken,
        other,
        extra={"topic": "stereo", "field": "ingest.stereo_camera"},
    )


@dataclass(frozen=True)
class StereoPairs:
    """Files or folders of two cameras, each in the order given.

    Args:
        left: of the left camera, also those whose counterpart is absent.
        right: of the right camera.
        others: of neither.
        pairs: that differ in the word for their camera alone, the left one first.
        contradictory: one that its name gives to both; None where there is none.
    """

    left: tuple[Path, ...]
    right: tuple[Path, ...]
    others: tuple[Path, ...]
    pairs: tuple[tuple[Path, Path], ...]
    contradictory: Path | None = None

    def of(self, camera: StereoCamera) -> tuple[Path, ...]:
        """What belongs to a camera."""
        return self.left if camera == "left" else self.right


def pairs_by_name(paths: Sequence[Path]) -> StereoPairs | None:
    """Parts files or folders by the cameras that their names tell; None where there is no pair.

    Args:
        paths: in one folder.
    """
    stems = {path: path.stem if path.suffix.lower() in _SUFFIXES else path.name for path in paths}
    by_stem = {stem.lower(): path for path, stem in stems.items()}
    pairs: list[tuple[Path, Path]] = []
    families: set[tuple[str, str]] = set()
    for path, stem in stems.items():
        for word in _WORDS.finditer(stem):
            opposite = _OPPOSITE.get(word[0].lower())
            other = None if opposite is None else by_stem.get(_with(stem, word, opposite).lower())
            if other is not None:
                pairs.append((path, other))
                families.add(_family(stem, word))
    if not pairs:
        return None
    sides: dict[Path, set[StereoCamera]] = {path: set() for path in paths}
    for path, stem in stems.items():
        for word in _WORDS.finditer(stem):
            if _family(stem, word) in families:
                sides[path].add("left" if word[0].lower() in _OPPOSITE else "right")
    both = next((path for path in paths if len(sides[path]) > 1), None)
    left, right, others = (
        tuple(path for path in paths if sides[path] == wanted) for wanted in ({"left"}, {"right"}, set())
    )
    return StereoPairs(left, right, others, tuple(pairs), both)


def _with(stem: str, word: re.Match[str], other: str) -> str:
    return stem[: word.start()] + other + stem[word.end() :]


def _family(stem: str, word: re.Match[str]) -> tuple[str, str]:
    """What names of both cameras share, whatever the number: the rest of the name, and the kind of word.

    Nothing for a word that tells of no camera.
    """
    if word[0].lower() not in (*_OPPOSITE, *_OPPOSITE.values()):
        return "", ""
    rest = re.sub(r"\d+", "0", _with(stem, word, "\0").lower())
    return rest, "letter" if len(word[0]) == 1 else "word"


@dataclass(frozen=True)
class BothViews:
    """Where the view of a camera lies in a picture that holds those of both.

    Args:
        beside: the views lie side by side, the left camera's on the left; otherwise one above the other, the
            left camera's on top.
        camera: whose view is taken.
        named: whether the name of the file says so.
    """

    beside: bool
    camera: StereoCamera
    named: bool

    def size(self, width: int, height: int) -> tuple[int, int]:
        """Width and height of one view, in pixels of the whole picture."""
        return (width // 2, height) if self.beside else (width, height // 2)

    def view(self, picture: UInt8[np.ndarray, "h w 3"], camera: StereoCamera | None = None) -> np.ndarray:
        """The pixels of one camera.

        Args:
            picture: that holds both.
            camera: None for the one that is taken.
        """
        width, height = self.size(picture.shape[1], picture.shape[0])
        first = (camera or self.camera) == "left"
        if self.beside:
            return picture[:, :width] if first else picture[:, picture.shape[1] - width :]
        return picture[:height] if first else picture[picture.shape[0] - height :]

    def both(self, pictures: Iterable[np.ndarray]) -> Iterator[tuple[np.ndarray, np.ndarray]]:
        """The views of the left and of the right camera in each of some pictures."""
        return ((self.view(picture, "left"), self.view(picture, "right")) for picture in pictures)

    def pixel_aspect(self, width: int, height: int) -> float:
        """Width of a pixel over its height, where the picture as a whole has square ones.

        Views that were squeezed to fit into a picture of the usual size are told by their proportion.
        """
        one_width, one_height = self.size(width, height)
        if self.named and self.beside and one_width <= _SQUEEZED_WIDTH * one_height:
            return 2.0
        if self.named and not self.beside and one_width >= _SQUEEZED_HEIGHT * one_height:
            return 0.5
        return 1.0

    def is_told(self, source: Path, share: float) -> bool:
        """Whether the halves are two views by what they show, which is said; and what only the name says.

        Args:
            source: that was looked at.
            share: of `agreeing_share`, of the halves.
        """
        if share >= AGREES:
            name = "name" if self.named else "size"
            told = f"in one picture, told by its {name} and by halves that show the same place"
            tell_camera(source, told, self.camera, str(self))
            return True
        if self.named:
            logger.warning(
                "%s: by its name pictures with the views of two cameras, but their halves do not show the "
                "same place; they are read whole",
                source,
                extra={"topic": "stereo", "field": "rgb"},
            )
        return False

    def __str__(self) -> str:
        halves = ("left", "right") if self.beside else ("upper", "lower")
        return f"the {halves[0] if self.camera == 'left' else halves[1]} half"


def possible_views(name: str, width: int, height: int, camera: StereoCamera) -> BothViews | None:
    """How a picture may hold two views, by its name, else by its size; None where nothing says so.

    Args:
        name: of the file, without suffix.
        width: of the picture, in pixels.
        height: of the picture, in pixels.
        camera: whose view is to be taken.
    """
    for pattern, beside in ((_SIDE_BY_SIDE, True), (_ABOVE_EACH_OTHER, False)):
        if pattern.search(name.lower()):
            return BothViews(beside, camera, named=True)
    if width >= _WIDE * height:
        return BothViews(beside=True, camera=camera, named=False)
    return BothViews(beside=False, camera=camera, named=False) if height >= _HIGH * width else None


def agreeing_share(pairs: Iterable[tuple[np.ndarray, np.ndarray]]) -> float:
    """Share of the pairs of pictures that show the same place; of pairs that show something, 0 without any.

    Args:
        pairs: views of two cameras at one moment, RGB.
    """
    flow = DenseFlow()
    agrees = [show_the_same(first, second, flow) for first, second in _telling(pairs)]
    return float(np.mean(agrees)) if agrees else 0.0


def _telling(pairs: Iterable[tuple[np.ndarray, np.ndarray]]) -> Iterator[tuple[np.ndarray, np.ndarray]]:
    """Pairs as small grey pictures, less those that are dark or flat: they look like any other."""
    for pair in pairs:
        first, second = (_small(picture) for picture in pair)
        if second.shape != first.shape or min(first.std(), second.std()) < _FLAT_GREY:
            continue
        yield first, second


def _small(rgb: UInt8[np.ndarray, "h w 3"]) -> UInt8[np.ndarray, "h2 w2"]:
    import cv2

    height, width = rgb.shape[:2]
    size = (_LOOKED_AT_WIDTH, max(16, round(_LOOKED_AT_WIDTH * height / width)))
    return np.asarray(cv2.cvtColor(cv2.resize(rgb, size, interpolation=cv2.INTER_AREA), cv2.COLOR_RGB2GRAY))
