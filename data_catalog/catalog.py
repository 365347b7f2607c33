"""The catalogue: names to sources, sources to sequences, and what a source is to a cache.

A sequence is named `DATASET/SEQUENCE[@SETTING]` or is a path to a folder, whose format is recognised by
what lies in it. `phantom/N@sparse` and `phantom/N@distanced` exist for every N and need no files. Scenes of
C3VD and C3VDv2 are made of several videos, one folder each: `c3vdv2/c1_cecum_t1@sparse` finds them below a
data root, `FOLDER/c1_cecum_t1@sparse` in a folder that holds them.

Named sets on disk are looked for in `$EXTRAGS_DATA`, then in the user's data and cache directories
(`extrags.data_directories`).
"""

from __future__ import annotations

import hashlib
import logging
import re
from difflib import get_close_matches
from pathlib import Path
from typing import Any, Literal, get_args

from pydantic import BaseModel, ConfigDict

from data_catalog.c3vd.datasets import Recording, RecordingPair, datasets, find, find_recording, find_scene
from data_catalog.formats import FolderFormat, folder_formats
from data_catalog.phantom.config import GENERATOR_VERSION, PhantomConfig, Setting
from extrags.config import IngestConfig
from extrags.data_directories import DATA_VARIABLE, data_roots
from extrags.errors import ConfigError, SourceError, SourceNotFoundError, UnknownSequenceError
from extrags.sequence import EndoscopicSequence

__all__ = [
    "Descriptor",
    "Source",
    "describe",
    "list_sequences",
    "phantom_config",
    "read",
    "resolve",
    "source_fingerprint",
]

logger = logging.getLogger(__name__)

_PHANTOM = re.compile(r"phantom/(?P<scene>\d+)(?:@(?P<setting>\w+))?")
_LISTED_SCENES = 4


class Descriptor(BaseModel):
    """What there is to know about a sequence before it is read."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    name: str
    """`DATASET/SEQUENCE[@SETTING]`."""
    description: str
    frames: int
    """Number of frames, all recordings together."""
    width: int
    """Of the source, in pixels, before any downscaling."""
    height: int
    length_unit: str
    """What a length of 1 in the `EndoscopicSequence` means."""
    axes: str
    """Camera and world axes on disk, and what is done to them."""
    has_depth: bool
    has_poses: bool
    split: str
    """Which frames are held out."""
    licence: str
    format: str
    """Reader: `phantom` or the name of a folder format."""
    segment: str | None = None
    """Part of the colon, where the dataset has parts."""
    texture: str | None = None
    """Texture of the segment, where there are several."""
    videos: tuple[str, ...] = ()
    """Which videos of the scene are used; the one that trains comes first."""
    folder: str | None = None
    """Folder below a data root; None where no files are needed."""
    available: bool = True
    """Whether it can be read on this machine now."""


class Source(BaseModel):
    """A sequence that can be read."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    name: str
    """As in messages, reports and tables."""
    format: str
    """`phantom`, or the name of a folder format."""
    path: str | None = None
    """Folder on disk."""
    scene: int | None = None
    """Scene of the phantom."""
    setting: Setting | None = None
    """Setting of the phantom."""
    pair: RecordingPair | None = None
    """Two videos under a split manifest: `path` trains, `test_path` evaluates."""
    test_path: str | None = None
    """Folder of the video that evaluates."""


_ON_DISK = (
    Descriptor(
        name="sinus/hopkins",
        description="Human sinus endoscopy, 35 undistorted frames with COLMAP-like poses and 570 points",
        frames=35,
        width=1920,
        height=1080,
        length_unit="arbitrary (structure from motion)",
        axes="OpenCV camera axes, camera-to-world; used as they are",
        has_depth=False,
        has_poses=True,
        split="every n-th frame held out (ingest.holdout_every)",
        licence="GPL-3.0",
        format="sinus",
        folder="sinus_hopkins",
    ),
    Descriptor(
        name="simcol3d/s1",
        description="SimCol3D synthetic colon, first ten frames of S1, with depth and exact poses",
        frames=10,
        width=475,
        height=475,
        length_unit="mm (source: cm)",
        axes="Unity (left-handed, y up); turned into OpenCV's on reading",
        has_depth=True,
        has_poses=True,
        split="every n-th frame held out (ingest.holdout_every)",
        licence="CC BY-NC-SA 4.0",
        format="simcol3d",
        folder="simcol3d_s1",
    ),
)


def list_sequences() -> tuple[Descriptor, ...]:
    """Every named sequence; of the phantom's endless scenes, the first few."""
    phantoms = (
        _describe_phantom(scene, setting) for scene in range(_LISTED_SCENES) for setting in get_args(Setting)
    )
    videos: list[Recording | RecordingPair] = []
    for dataset in datasets().values():
        videos += [*dataset.pairs(), *dataset.recordings]
    return (
        *phantoms,
        *(_with_availability(descriptor) for descriptor in _ON_DISK),
        *(_describe_videos(item) for item in videos),
    )


def describe(name: str) -> Descriptor:
    """The descriptor of a named sequence.

    Raises:
        UnknownSequenceError: for a name that is not in the catalogue; suggests the nearest.
    """
    phantom = _as_phantom(name)
    if phantom is not None:
        return _describe_phantom(*phantom)
    for descriptor in _ON_DISK:
        if name in (descriptor.name, descriptor.folder):
            return _with_availability(descriptor)
    video = find(name)
    if video is not None:
        return _describe_videos(video)
    raise _unknown(name)


def resolve(name_or_path: str | Path) -> Source:
    """Find what a user named.

    Args:
        name_or_path: `phantom/3@sparse` (without a setting: `sparse`), `sinus/hopkins`, `simcol3d/s1`,
            `c3vdv2/c1_cecum_t1@sparse`, `FOLDER/c1_cecum_t1@sparse` for videos in a folder of their own, or
            a path to a folder or a video. A path that exists wins over a name spelled the same.

    Raises:
        UnknownSequenceError: neither a known name nor an existing path; suggests the nearest name.
        SourceNotFoundError: a known name whose files are not on this machine.
        SourceError: a folder that holds no sequence, or a file where a folder is needed.
    """
    text = str(name_or_path)
    path = Path(text).expanduser()
    if path.is_dir():
        return _resolve_folder(path)
    if path.exists():
        return _resolve_file(path)
    phantom = _as_phantom(text)
    if phantom is not None:
        scene, setting = phantom
        return Source(name=f"phantom/{scene}@{setting}", format="phantom", scene=scene, setting=setting)
    for descriptor in _ON_DISK:
        if text in (descriptor.name, descriptor.folder):
            folder = _find_folder(str(descriptor.folder))
            if folder is None:
                raise SourceNotFoundError(
                    f"{descriptor.name} is not on this machine: no folder {descriptor.folder} in "
                    f"{', '.join(str(root) for root in data_roots())}. Put it there, set "
                    f"{DATA_VARIABLE} to the folder that holds it, or give its path",
                    file=descriptor.folder,
                )
            return Source(name=descriptor.name, format=descriptor.format, path=str(folder))
    videos = find(text)
    if videos is not None:
        return _resolve_videos(videos, data_roots())
    scene_there = find_scene(path.name) if len(path.parts) > 1 and path.parent.is_dir() else None
    if scene_there is not None:
        return _resolve_videos(scene_there, [path.parent])
    raise _unknown(text)


def read(source: Source | str | Path, config: IngestConfig | None = None) -> EndoscopicSequence:
    """Read a source into a checked `EndoscopicSequence`.

    Args:
        source: what `resolve` returns, or takes.
        config: size, frames and split; defaults where None.

    Raises:
        SourceError: a file is wrong; names file, frame and field. `SourceNotFoundError` and `PoseError`
            are kinds of it.
        UnknownSequenceError: from `resolve`.
        ConfigError: settings that this source cannot be read with.
    """
    from data_catalog.checks import check_sequence

    source = source if isinstance(source, Source) else resolve(source)
    config = config or IngestConfig()
    if source.format == "phantom":
        from data_catalog.phantom.recording import record

        sequence = record(phantom_config(source, config), source.name)
        check_sequence(sequence, file=source.name)
        return sequence
    folder = Path(str(source.path))
    if source.pair is not None:
        from data_catalog.c3vd.reader import read_pair

        sequence = read_pair(folder, Path(str(source.test_path)), source.pair, config)
    else:
        sequence = _format(source).read(folder, config, source.name)
    check_sequence(sequence, file=folder)
    return sequence


def source_fingerprint(source: Source | str | Path, config: IngestConfig | None = None) -> dict[str, Any]:
    """What the source contributes to a cache key: its content, never where it lies.

    Args:
        source: what `resolve` returns, or takes.
        config: the settings it will be read with.

    Returns:
        Plain JSON: for the phantom its settings and generator version; for a folder the reader's name and
        version, and name, size and BLAKE2b digest of each file the reader looks at; for two videos under a
        split manifest the same of both, and the manifest's line.

    Raises:
        SourceError: the folder is not readable as a sequence.
    """
    source = source if isinstance(source, Source) else resolve(source)
    config = config or IngestConfig()
    if source.format == "phantom":
        return {
            "format": "phantom",
            "version": GENERATOR_VERSION,
            "config": phantom_config(source, config).model_dump(mode="json"),
        }
    folder = Path(str(source.path))
    reader = _format(source)
    fingerprint: dict[str, Any] = {"format": reader.name, "version": reader.version}
    if source.pair is None:
        root = folder if folder.is_dir() else folder.parent
        # Of a single file the content counts, not what it is called.
        listed = [
            (f"source{file.suffix}" if file == folder else file.relative_to(root).as_posix(), file)
            for file in reader.files(folder)
        ]
    else:
        from data_catalog.c3vd.reader import pair_files

        listed = pair_files(folder, Path(str(source.test_path)), source.pair)
        fingerprint["split"] = source.pair.model_dump(mode="json")
    files = []
    for name, file in listed:
        digest = hashlib.blake2b(digest_size=16)
        with file.open("rb") as stream:
            while block := stream.read(1 << 20):
                digest.update(block)
        files.append([name, file.stat().st_size, digest.hexdigest()])
    return {**fingerprint, "files": files}


def phantom_config(source: Source, config: IngestConfig) -> PhantomConfig:
    """The phantom's settings that follow from the ingest settings.

    Without a height, the width's own proportion (5 : 4) is kept.

    Raises:
        ConfigError: for a source that is no phantom, or a height without a width.
    """
    if source.scene is None or source.setting is None:
        raise ConfigError(f"{source.name} is not a phantom")
    plain = PhantomConfig()
    if config.width is not None:
        width = config.width
        height = config.height or max(16, round(width * plain.height / plain.width))
    elif config.height is not None:
        raise ConfigError("ingest.height needs ingest.width")
    else:
        downscale = config.downscale or 1
        width, height = plain.width // downscale, plain.height // downscale
    if width < 16 or height < 16:
        raise ConfigError(f"an image of {width} x {height} pixels is too small; expected at least 16 x 16")
    return PhantomConfig(
        scene=source.scene,
        setting=source.setting,
        width=width,
        height=height,
        max_frames=config.max_frames,
    )


def _as_phantom(name: str) -> tuple[int, Setting] | None:
    match = _PHANTOM.fullmatch(name)
    if match is None:
        return None
    setting: Literal["sparse", "distanced"] | str = match["setting"] or "sparse"
    for known in get_args(Setting):
        if setting == known:
            return int(match["scene"]), known
    raise UnknownSequenceError(
        f"the phantom has no setting {setting!r}; known: {', '.join(get_args(Setting))}"
    )


def _describe_phantom(scene: int, setting: Setting) -> Descriptor:
    plain = PhantomConfig()
    train = len(range(0, plain.video_frames, plain.train_every))
    return Descriptor(
        name=f"phantom/{scene}@{setting}",
        description=f"Procedural colon number {scene} with exact ground truth, rendered on request",
        frames=train + plain.test_frames,
        width=plain.width,
        height=plain.height,
        length_unit="mm",
        axes="OpenCV camera axes, camera-to-world",
        has_depth=True,
        has_poses=True,
        split=f"{train} frames of recording B train, all {plain.test_frames} of recording A evaluate",
        licence="Apache-2.0 (generated)",
        format="phantom",
    )


def _describe_videos(item: Recording | RecordingPair) -> Descriptor:
    if isinstance(item, RecordingPair):
        used: tuple[Recording, ...] = (item.train, item.test)
        frames, folder = item.frames, None
        taken = "all" if item.train_every == 1 else f"every {item.train_every}th frame"
        split = (
            f"{taken} of {item.train.video} trains ({len(item.train_frames)} frames), all of "
            f"{item.test.video} evaluates ({item.test.frames}); "
            f"manifest {item.setting}, version {item.version}"
        )
    else:
        used = (item,)
        frames, folder = item.frames, item.stem
        split = "every n-th frame held out (ingest.holdout_every)"
    dataset = datasets()[used[0].dataset]
    remarks = [
        f"{video.video}: {dataset.remarks[video.video]}" for video in used if video.video in dataset.remarks
    ]
    title = f"{dataset.title}: {used[0].segment}, texture {used[0].texture}"
    return Descriptor(
        name=item.name,
        description="; ".join([title, *remarks]),
        frames=frames,
        width=dataset.width,
        height=dataset.height,
        length_unit="mm",
        axes="OpenCV camera axes, camera-to-world; fisheye resampled to a pinhole. Each video has a world of "
        "its own: the one that trains keeps it",
        has_depth=True,
        has_poses=True,
        split=split,
        licence=dataset.licence,
        format="c3vd",
        segment=used[0].segment,
        texture=used[0].texture,
        videos=tuple(video.video for video in used),
        folder=None if folder is None else f"{dataset.folders[0]}/{folder}",
        available=all(_find_video(video, data_roots()) is not None for video in used),
    )


def _find_video(video: Recording, roots: list[Path]) -> Path | None:
    names = datasets()[video.dataset].folder_names(video)
    return next((root / name for root in roots for name in names if (root / name).is_dir()), None)


def _resolve_videos(item: Recording | RecordingPair, roots: list[Path]) -> Source:
    folders = []
    for video in (item.train, item.test) if isinstance(item, RecordingPair) else (item,):
        folder = _find_video(video, roots)
        if folder is None:
            wanted = datasets()[video.dataset].folder_names(video)[0]
            raise SourceNotFoundError(
                f"{item.name} is not on this machine: no folder {wanted} in "
                f"{', '.join(str(root) for root in roots)}. Put it there, set {DATA_VARIABLE} to the "
                f"folder that holds it, or give FOLDER/{item.name.partition('/')[2]} with the folder that "
                "the videos lie in",
                file=wanted,
            )
        folders.append(str(folder.resolve()))
    if isinstance(item, RecordingPair):
        return Source(name=item.name, format="c3vd", path=folders[0], test_path=folders[1], pair=item)
    return Source(name=item.name, format="c3vd", path=folders[0])


def _with_availability(descriptor: Descriptor) -> Descriptor:
    found = _find_folder(str(descriptor.folder)) is not None
    return descriptor.model_copy(update={"available": found})


def _find_folder(folder: str) -> Path | None:
    return next((root / folder for root in data_roots() if (root / folder).is_dir()), None)


def _resolve_folder(path: Path) -> Source:
    for candidate in folder_formats():
        if candidate.recognises(path):
            known = next(
                (
                    item.name
                    for item in _ON_DISK
                    if item.format == candidate.name and item.folder == path.resolve().name
                ),
                None,
            )
            if candidate.name == "c3vd":
                video = find_recording(path.resolve().name)
                known = None if video is None else video.name
            return Source(name=known or path.resolve().name, format=candidate.name, path=str(path.resolve()))
    kinds = "; ".join(f"{candidate.name}: {candidate.summary}" for candidate in folder_formats())
    empty = "the folder is empty" if not any(path.iterdir()) else "no sequence recognised in this folder"
    raise SourceNotFoundError(f"{empty}; expected one of: {kinds}", file=path)


def _resolve_file(path: Path) -> Source:
    from data_catalog import video

    if not video.FORMAT.recognises(path):
        raise SourceError(
            "this is a file; expected a folder that holds a sequence, or a video "
            f"({', '.join(video.VIDEO_SUFFIXES)})",
            file=path,
        )
    return Source(name=path.stem, format=video.FORMAT.name, path=str(path.resolve()))


def _format(source: Source) -> FolderFormat:
    for candidate in folder_formats():
        if candidate.name == source.format:
            return candidate
    known = ", ".join(candidate.name for candidate in folder_formats())
    raise ConfigError(f"no reader for the format {source.format!r}; known: phantom, {known}")


def _unknown(name: str) -> UnknownSequenceError:
    known = [descriptor.name for descriptor in list_sequences()]
    known += [str(descriptor.folder) for descriptor in _ON_DISK]
    near = get_close_matches(name, known, n=1, cutoff=0.5)
    hint = f" Did you mean {near[0]}?" if near else ""
    return UnknownSequenceError(
        f"no sequence {name!r} in the catalogue and no such folder.{hint} "
        f"Known: phantom/N@sparse, phantom/N@distanced, {', '.join(d.name for d in _ON_DISK)}, "
        f"{', '.join(f'{name}/...' for name in datasets())} (all of them: extrags data list), "
        "or the path of a folder"
    )
