"""C3VD and C3VDv2 as a dataset: one video, or two of a scene under a split manifest.

`c3vdv2/c1_cecum_t1_v2` and `c3vdv2/c1_cecum_t1@sparse` are found below a data root,
`FOLDER/c1_cecum_t1@sparse` in a folder that holds the videos, and so are scenes that are not in the catalogue
(`data_catalog.c3vd.unregistered`).
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

from data_catalog.c3vd.published import Recording, RecordingPair, find, find_scene, published_sets
from data_catalog.c3vd.reader import READER, pair_files, pair_frames
from data_catalog.c3vd.unregistered import folders_of_scene, unregistered_pair
from data_catalog.dataset import Descriptor, Source, file_digests
from data_catalog.named_folders import find_folder, not_on_this_machine
from data_catalog.posed_frames import assembled
from extrags.config import IngestConfig
from extrags.errors import SourceError
from extrags.sequence import EndoscopicSequence
from extrags.user_paths import expanded

__all__ = ["C3vdDataset"]


class C3vdDataset:
    """Every published video, and every pair of the split manifests."""

    name = READER.name

    @property
    def spelling(self) -> str:
        """How its sequences are called."""
        return ", ".join(f"{name}/..." for name in published_sets())

    def entries(self) -> Iterator[Descriptor]:
        """Pairs and single videos, set by set."""
        for published in published_sets().values():
            yield from (_described(item) for item in published.pairs())
            yield from (_described(item) for item in published.recordings)

    def describe(self, name: str) -> Descriptor | None:
        """The descriptor of a video or a pair; `UnknownSequenceError` for a scene that there is not."""
        item = find(name)
        return None if item is None else _described(item)

    def resolve(self, name_or_path: str) -> Source | None:
        """A video or a pair by name, or a pair in a folder of its own, registered or not."""
        path = expanded(name_or_path)
        item = find(name_or_path)
        if item is not None:
            return self._source(item, None)
        if len(path.parts) < 2 or not path.parent.is_dir():
            return None
        pair = find_scene(path.name)
        if pair is not None:
            return self._source(pair, [path.parent])
        folders = folders_of_scene(path.parent, path.name)
        return None if folders is None else _read_from(path.name, folders)

    def fingerprint(self, source: Source, config: IngestConfig) -> dict[str, Any]:
        """Reader, content of both videos' files, and the manifest's line."""
        pair = _pair(source)
        if pair is None:
            return READER.fingerprint(Path(source.paths[0]))
        train, test = (Path(path) for path in source.paths)
        return {
            "format": READER.name,
            "version": READER.version,
            "split": pair.model_dump(mode="json"),
            "files": file_digests(pair_files(train, test, pair)),
        }

    def read(self, source: Source, config: IngestConfig) -> EndoscopicSequence:
        """One video, or both of a pair in the world of the one that trains."""
        pair = _pair(source)
        if pair is None:
            return READER.read(Path(source.paths[0]), config, source.name)
        train, test = (Path(path) for path in source.paths)
        return assembled(pair_frames(train, test, pair, config), config, source.name)

    def _source(self, item: Recording | RecordingPair, roots: Sequence[Path] | None) -> Source:
        folders = []
        for video in _videos(item):
            names = published_sets()[video.dataset].folder_names(video)
            folder = find_folder(names, roots)
            if folder is None:
                instead = f"FOLDER/{item.name.partition('/')[2]} with the folder that the videos lie in"
                raise not_on_this_machine(item.name, names[0], instead, roots)
            folders.append(folder)
        return _read_from(item.name, folders)


def _read_from(name: str, folders: Sequence[Path]) -> Source:
    paths = tuple(str(folder.resolve()) for folder in folders)
    return Source(name=name, dataset=C3vdDataset.name, format=READER.name, paths=paths)


def _videos(item: Recording | RecordingPair) -> tuple[Recording, ...]:
    """The one that trains first."""
    return (item.train, item.test) if isinstance(item, RecordingPair) else (item,)


def _pair(source: Source) -> RecordingPair | None:
    """The pair that a source's name stands for; None for a single video."""
    item = find(source.name)
    if item is None and len(source.paths) == 2:
        train, test = (Path(path) for path in source.paths)
        return unregistered_pair(source.name, train, test)
    expected = 1 if item is None else len(_videos(item))
    if len(source.paths) != expected:
        raise SourceError(f"{source.name} has {len(source.paths)} folders; expected {expected}")
    return item if isinstance(item, RecordingPair) else None


def _described(item: Recording | RecordingPair) -> Descriptor:
    used = _videos(item)
    if isinstance(item, RecordingPair):
        folder = None
        taken = "all" if item.train_every == 1 else f"every {item.train_every}th frame"
        split = (
            f"{taken} of {item.train.video} trains ({len(item.train_frames)} frames), all of "
            f"{item.test.video} evaluates ({item.test.frames}); "
            f"manifest {item.setting}, version {item.version}"
        )
    else:
        folder = item.stem
        split = "every n-th frame held out (ingest.holdout_every)"
    published = published_sets()[used[0].dataset]
    remarks = [
        f"{video.video}: {published.remarks[video.video]}"
        for video in used
        if video.video in published.remarks
    ]
    title = f"{published.title}: {used[0].segment}, texture {used[0].texture}"
    return Descriptor(
        name=item.name,
        description="; ".join([title, *remarks]),
        frames=item.frames,
        width=published.width,
        height=published.height,
        length_unit="mm",
        axes="OpenCV camera axes, camera-to-world; fisheye resampled to a pinhole. Each video has a world of "
        "its own: the one that trains keeps it",
        has_depth=True,
        has_poses=True,
        split=split,
        licence=published.licence,
        format=READER.name,
        segment=used[0].segment,
        texture=used[0].texture,
        videos=tuple(video.video for video in used),
        folder=None if folder is None else f"{published.folders[0]}/{folder}",
        available=all(find_folder(published.folder_names(video)) is not None for video in used),
    )
