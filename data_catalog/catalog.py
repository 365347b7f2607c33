"""The catalogue: names to sources, sources to sequences, and what a source is to a cache.

A sequence is named `DATASET/SEQUENCE[@SETTING]` or is a path to a folder, a video or a DICOM file. The
datasets are asked in order; what each of them knows stands in its own module.
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from difflib import get_close_matches
from os import PathLike, fspath
from pathlib import Path
from typing import Any

from data_catalog.c3vd.dataset import C3vdDataset
from data_catalog.calibration_files import CALIBRATION_VERSION
from data_catalog.caverns.dataset import CAVERNS
from data_catalog.checks import check_sequence
from data_catalog.ct_colon.dataset import CT_COLON
from data_catalog.dataset import Dataset, Descriptor, Source, file_digests
from data_catalog.detail import DetailSize, source_detail
from data_catalog.folder_reader import Glance
from data_catalog.folders import FolderDataset, find_reader, readers
from data_catalog.footage import DICOM_SUFFIXES, VIDEO_SUFFIXES
from data_catalog.mask_findings import tell_of_inverted_masks
from data_catalog.phantom.dataset import PHANTOM
from data_catalog.picture_crop import cropped_to_picture
from data_catalog.pose_conventions import OPENCV
from data_catalog.rendered_dataset import RenderedDataset
from data_catalog.specular import with_specular
from data_catalog.stereo import check_one_camera
from extrags.arguments import check_settings_argument
from extrags.config import DEFAULT_PROFILE, PROFILES, IngestConfig
from extrags.errors import ConfigError, SourceError, SourceNotFoundError, UnknownSequenceError
from extrags.reading_corrections import with_corrections
from extrags.redaction import without_credentials
from extrags.sequence import EndoscopicSequence
from extrags.user_paths import expanded

__all__ = [
    "DATASETS",
    "describe",
    "drawn_formats",
    "footage_formats",
    "footage_glance",
    "glance",
    "list_sequences",
    "measured_detail",
    "read",
    "resolve",
    "source_fingerprint",
]

DATASETS: tuple[Dataset, ...] = (
    FolderDataset(),
    PHANTOM,
    CAVERNS,
    CT_COLON,
    C3vdDataset(),
)
"""Folders first: a path that exists wins over a name spelled the same."""


_UNCUT = {name: IngestConfig.model_fields[name].default for name in ("start_s", "end_s")}
"""What the settings of a part of a recording are where all of it is read."""


def list_sequences() -> tuple[Descriptor, ...]:
    """Every named sequence; of endless families (phantom, caverns, ct_colon), the first few scenes."""
    return tuple(item for dataset in DATASETS for item in dataset.entries())


def describe(name: str) -> Descriptor:
    """The descriptor of a named sequence.

    Raises:
        UnknownSequenceError: for a name that is not in the catalogue; suggests the nearest.
    """
    for dataset in DATASETS:
        found = dataset.describe(name)
        if found is not None:
            return found
    raise _unknown(name)


def resolve(name_or_path: str | Path) -> Source:
    """Find what a user named.

    Args:
        name_or_path: `phantom/3@sparse` (without a setting: `sparse`), `caverns/0@distanced`,
            `sinus/hopkins`, `simcol3d/s1`, `c3vdv2/c1_cecum_t1@sparse`, `FOLDER/SCENE@sparse` for videos in
            a folder of their own (`SCENE_v1`, `SCENE_v2`; registered or not), or a path to a folder, a video
            or a DICOM file. A path that exists wins over a name spelled the same.

    Raises:
        UnknownSequenceError: neither a known name nor an existing path; suggests the nearest name.
            Nor is an empty text.
        SourceNotFoundError: a known name whose files are not on this machine.
        SourceError: a folder that holds no sequence, a file where a folder is needed, or one that this user
            may not read.
        ConfigError: neither a text nor a path, such as a sequence that was read before.
    """
    if not isinstance(name_or_path, str | PathLike):
        raise _no_name(name_or_path)
    text = fspath(name_or_path)
    if not text.strip():
        raise UnknownSequenceError("the name is empty; expected a sequence's name or a path")
    with _permission_named():
        for dataset in DATASETS:
            found = dataset.resolve(text)
            if found is not None:
                return found
        raise _unknown(text)


def drawn_formats() -> frozenset[str]:
    """Formats of sequences whose frames are drawn when they are asked for (`Source.format`)."""
    return frozenset(dataset.name for dataset in DATASETS if isinstance(dataset, RenderedDataset))


def footage_formats() -> frozenset[str]:
    """Formats of videos and DICOM files, of which frames are chosen (`Source.format`)."""
    return frozenset(reader.name for reader in readers() if reader.is_footage)


def footage_glance(source: Source, config: IngestConfig) -> Glance | None:
    """What the header of a video or a DICOM file tells (`glance`).

    Args:
        source: what `resolve` returns.
        config: settings that it is read with.

    Returns:
        None for other sources, and where the reader would have to decode all of it.

    Raises:
        SourceError: as `read` does.
    """
    reader, dataset = find_reader(source.format), _dataset(source)
    if reader is None or not reader.is_footage or reader.outline is None:
        return None
    return dataset.glance(source, config) if isinstance(dataset, FolderDataset) else None


def glance(name_or_path: str | Path, config: IngestConfig | None = None) -> Glance | None:
    """What a folder, a video or a DICOM file holds, from names and headers: quick, and no picture is read.

    Args:
        name_or_path: what `resolve` takes.
        config: settings it would be read with; None takes those of the profile `balanced`.

    Returns:
        None for a sequence that another dataset knows: its `Descriptor` tells. With `ingest.size` = detail
        the size before frames are shrunk to their detail, which only pictures tell.

    Raises:
        UnknownSequenceError: from `resolve`.
        SourceError: what can be seen to be wrong without reading pictures; `read` would raise it as well.
        ConfigError: settings that this source cannot be read with.
    """
    config = _settings(config, "glance")
    source = resolve(name_or_path)
    dataset = _dataset(source)
    _check_own(dataset, source, config)
    _check_time_span(source, config)
    with _permission_named():
        seen = dataset.glance(source, config) if isinstance(dataset, FolderDataset) else None
    if seen is not None and not seen.has_poses and config.scale_mm_per_unit is not None:
        raise _no_unit(source.name)
    return seen


def read(
    source: Source | str | Path, config: IngestConfig | None = None, *, detail: DetailSize | None = None
) -> EndoscopicSequence:
    """Read a source into a checked `EndoscopicSequence` with its specular highlights marked.

    Args:
        source: what `resolve` returns, or takes.
        config: size, frames and split; None takes those of the profile `balanced`.
        detail: what `measured_detail` has found with the same settings; None measures where they ask for it.

    Raises:
        SourceError: a file is wrong; names file, frame and field. `SourceNotFoundError` and `PoseError`
            are kinds of it.
        UnknownSequenceError: from `resolve`.
        ConfigError: settings that this source cannot be read with, or `source` is no name and no path, or
            `config` other settings, such as those of all stages.
    """
    source = source if isinstance(source, Source) else resolve(source)
    dataset, config = _dataset(source), _settings(config, "read")
    _check_own(dataset, source, config)
    _check_time_span(source, config)
    detail = source_detail(dataset, source, config) if detail is None else detail
    sequence = dataset.read(source, config if detail is None else detail.applied_to(config))
    reader = find_reader(source.format)
    stored = OPENCV if reader is None else reader.poses
    depth_unit = "" if reader is None else reader.depth_unit
    check_sequence(sequence, file=source.path or source.name, stored=stored, depth_unit=depth_unit)
    tell_of_inverted_masks(sequence)
    sequence = cropped_to_picture(sequence, config)
    if config.scale_mm_per_unit is not None:
        sequence = _scaled(sequence, config.scale_mm_per_unit)
    # After the checks, which hold poses against all depth there is; what was observed is known by now.
    if config.withhold_depth:
        sequence = sequence.without_training_depth()
    sequence = with_corrections(sequence, config)
    return with_specular(sequence)


def measured_detail(source: Source | str | Path, config: IngestConfig) -> DetailSize | None:
    """The size that `read` shrinks the frames of a source to, where the settings ask for it.

    Args:
        source: what `resolve` returns, or takes.
        config: the settings it will be read with.

    Returns:
        None unless `ingest.size` is detail and decides.

    Raises:
        SourceError: as `read` does.
        ConfigError: as `read` does.
    """
    config = _settings(config, "measured_detail")
    source = source if isinstance(source, Source) else resolve(source)
    return source_detail(_dataset(source), source, config)


def source_fingerprint(source: Source | str | Path, config: IngestConfig | None = None) -> dict[str, Any]:
    """What the source contributes to a cache key: its content, never where it lies.

    Args:
        source: what `resolve` returns, or takes.
        config: the settings it will be read with.

    Returns:
        Plain JSON: for phantom and caverns their settings and generator version; for a folder the reader's
        name and version, name, size and BLAKE2b digest of each file the reader looks at, and what it chooses
        that is in no file; for two videos under a split manifest the files of both, and the manifest's line.
        Where the settings name a calibration file, size and digest of it, and the version of what reads it;
        the camera of a stereo endoscope where it is not the left one.

    Raises:
        SourceError: the folder is not readable as a sequence.
        SourceNotFoundError: there is no such calibration file.
        ConfigError: `config` is other settings.
    """
    config = _settings(config, "source_fingerprint")
    source = source if isinstance(source, Source) else resolve(source)
    with _permission_named():
        found = _dataset(source).fingerprint(source, config)
    if config.stereo_camera != "left":
        found = {**found, "stereo_camera": config.stereo_camera}
    if config.calibration is None:
        return found
    file = expanded(config.calibration)
    if not file.is_file():
        raise SourceNotFoundError("no such calibration file", file=file, field="ingest.calibration")
    told = {"calibration": file_digests([("calibration", file)]), "calibration_version": CALIBRATION_VERSION}
    return found | told


@contextmanager
def _permission_named() -> Iterator[None]:
    """What this user may not read is wrong with its source, not with the program."""
    try:
        yield
    except PermissionError as error:
        raise SourceError(f"it cannot be read: {error.strerror}", file=error.filename) from error


def _settings(config: IngestConfig | None, function: str) -> IngestConfig:
    """What a function was given, or the settings of the profile `balanced`.

    Raises:
        ConfigError: other settings, such as those of all stages, or a size that is given twice.
    """
    config = PROFILES[DEFAULT_PROFILE].ingest if config is None else config
    check_settings_argument(config, IngestConfig, function, 'extrags.PROFILES["quick"].ingest')
    if config.width is not None and config.downscale is not None:
        raise ConfigError(
            f"ingest.width = {config.width} and ingest.downscale = {config.downscale} both set the size of "
            "frames; give one of the two (ingest.downscale none takes back one from a file of settings)"
        )
    return config


def _check_own(dataset: Dataset, source: Source, config: IngestConfig) -> None:
    """Refuse what a sequence of the catalogue's own does not have: another calibration, a second camera."""
    if isinstance(dataset, FolderDataset):
        return
    check_one_camera(config, source.name)
    if config.calibration is not None:
        raise ConfigError(
            f"ingest.calibration is given, but {source.name} states its intrinsics itself: its frames are "
            "rendered or published with them. The camera of scenes of your own in C3VD's layout stands in a "
            "calibration.json beside the frames"
        )


def _check_time_span(source: Source, config: IngestConfig) -> None:
    """Refuse a part of a recording of a source whose frames have no times: it would be passed over."""
    given = [name for name in ("start_s", "end_s") if getattr(config, name) != _UNCUT[name]]
    reader = find_reader(source.format)
    if given and not (reader is not None and reader.is_footage):
        settings = " and ".join(f"ingest.{name} = {getattr(config, name):g}" for name in given)
        raise ConfigError(
            f"{source.name}: {settings} cut a video or a DICOM file by its times, and this source's frames "
            "have none; ingest.max_frames thins them evenly, and a part of them is taken by removing the "
            "others"
        )


def _no_name(given: object) -> ConfigError:
    if isinstance(given, EndoscopicSequence):
        return ConfigError(
            f"{given.name} is a sequence that has been read already, and needs no reading; expected the name "
            "of a sequence or a path"
        )
    return ConfigError(f"expected the name of a sequence or a path, found {type(given).__name__}")


def _scaled(sequence: EndoscopicSequence, mm_per_unit: float) -> EndoscopicSequence:
    if sequence.world_from_camera is None:
        raise _no_unit(sequence.name)
    if sequence.metric:
        raise ConfigError(
            f"{sequence.name}: the source's lengths are millimetres; ingest.scale_mm_per_unit is for sources "
            "whose unit is arbitrary"
        )
    return sequence.in_millimetres(mm_per_unit, "setting")


def _no_unit(name: str) -> ConfigError:
    return ConfigError(
        f"{name}: ingest.scale_mm_per_unit is the unit of the source's poses, and there are none; "
        "poses.working_distance_mm makes estimated poses metric"
    )


def _dataset(source: Source) -> Dataset:
    for dataset in DATASETS:
        if dataset.name == source.dataset:
            return dataset
    known = ", ".join(dataset.name for dataset in DATASETS)
    raise ConfigError(f"{source.name}: no dataset {source.dataset!r}; known: {known}")


def _unknown(name: str) -> UnknownSequenceError:
    if "://" in name:
        # Before it is taken for a path: one slash less, and its password would be no credential any more.
        return UnknownSequenceError(f"{without_credentials(name)} is a URL; sequences are files or folders")
    place = expanded(name)
    if place.exists():
        return UnknownSequenceError(f"{name} is a file or folder, and no name of the catalogue")
    if place.suffix.lower() in (*VIDEO_SUFFIXES, *DICOM_SUFFIXES) or name.startswith((".", "/", "~")):
        return UnknownSequenceError(f"no such file or folder: {place.absolute()}")
    listed = list_sequences()
    known = [item.name for item in listed] + [item.folder for item in listed if item.folder is not None]
    near = get_close_matches(name, known, n=1, cutoff=0.5)
    hint = f" Did you mean {near[0]}?" if near else ""
    return UnknownSequenceError(
        f"no sequence {name!r} in the catalogue and no such file or folder.{hint} "
        f"Known: {', '.join(dataset.spelling for dataset in DATASETS)} (extrags data list), "
        "or the path of a folder or a video"
    )
