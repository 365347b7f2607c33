"""The coarse scene that goes on from an earlier one, and which of those in the store that is."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import PurePath

from data_catalog.names import comparable_name
from extrags.config import CoarseConfig
from extrags.errors import ConfigError, DamagedArtefactError
from extrags.store import Manifest, Ref, Slot, Store
from tasks.coarse import COARSE_VERSION, coarse, save_reconstruction
from tasks.divergence import keep_last_finite_scene
from tasks.stage import stage

__all__ = ["Earlier", "Search", "continued_coarse", "found_whole", "made_before", "nearest_scene"]

CONTINUED_VERSION = 4
"""Raised for what differs in continuing alone: another reconstruction is another version of it anyway."""
STAGES = ("coarse", "continued-coarse")
"""Stages whose scenes can be gone on from."""


@dataclass(frozen=True)
class Earlier:
    """A coarse scene of some of a run's training frames.

    Args:
        scene: its artefact.
        key: of it.
        frames: the run's index of each of its training frames, in their order.
    """

    scene: Ref
    key: str
    frames: list[int]


@dataclass(frozen=True)
class Search:
    """What `nearest_scene` found.

    Args:
        found: the scene to go on from; None where there is none.
        refusals: why others were not taken, by key, in the order they were looked at.
    """

    found: Earlier | None
    refusals: dict[str, str]

    def told(self) -> str:
        """Why there is none, in a line: the first refusals."""
        if not self.refusals:
            return "the store has no other coarse scene of that name or path"
        first = [f"{key}: {why}" for key, why in list(self.refusals.items())[:3]]
        more = len(self.refusals) - len(first)
        return "; ".join([*first, *([f"and {more} more"] if more > 0 else [])])


@stage("continued-coarse", version=100 * COARSE_VERSION + CONTINUED_VERSION)
def continued_coarse(
    slot: Slot,
    sequence: Ref,
    earlier: Ref,
    frames: list[int],
    config: CoarseConfig,
    iterations: int,
    device: str = "cpu",
) -> None:
    """Go on from an earlier coarse scene; writes what `coarse` writes.

    Args:
        slot: to write into.
        sequence: the training frames.
        earlier: the scene to go on from.
        frames: index of each of the earlier scene's training frames, in their order.
        config: settings of the reconstruction.
        iterations: how many there are, in place of `config.iterations`.
        device: where it is optimised.
    """
    import numpy as np

    from extrags.devices import chosen_device
    from extrags.scene import Scene
    from extrags.sequence import EndoscopicSequence
    from extrags.training import EarlierScene, reconstruct

    posed = slot.load(EndoscopicSequence, sequence)
    start = EarlierScene(slot.load(Scene, earlier), np.asarray(frames, dtype=np.int64), iterations)
    with keep_last_finite_scene(slot):
        result = reconstruct(posed, config, device=chosen_device(device, "device"), earlier=start)
    save_reconstruction(slot, posed, result)
    key = slot.store.manifest(earlier).key
    slot.counts.update(
        continued_from=key,
        continued_frames=len(frames),
        iterations=iterations,
        summary=f"continued from {key}, {len(frames)} of {len(posed.train)} training frames, "
        f"{iterations} of {config.iterations} iterations",
    )


def made_before(
    store: Store, frames: Ref, config: CoarseConfig, device: str, *, refresh: bool = False
) -> Iterator[tuple[Earlier, int]]:
    """Scenes that went on from an earlier one with these very frames and settings, the first made first.

    A run that is repeated takes the same start as before, whatever has come to the store since, or has gone.

    Args:
        store: where to look.
        frames: the run's training frames.
        config: settings of the reconstruction.
        device: where it is optimised.
        refresh: whether they will be made anew, which those cannot be whose start has been removed, or is
            another one since it was made anew itself.

    Yields:
        The scene each went on from, and the number of iterations.
    """
    for manifest in store.ls("continued-coarse"):
        if manifest.inputs.get("sequence") != frames.digest or not _current(manifest):
            continue
        given = manifest.config
        if _settings(manifest) != config or given.get("device") != device:
            continue
        key = manifest.input_keys["earlier"]
        if refresh:
            start = found_whole(store, key)
            if start is None or start.digest != manifest.inputs["earlier"]:
                continue
        scene = Ref(uri=store.backend.uri(key), digest=manifest.inputs["earlier"])
        yield Earlier(scene, key, [int(place) for place in given["frames"]]), int(given["iterations"])


def nearest_scene(store: Store, label: str, frames: Ref, config: CoarseConfig) -> Search:
    """The coarse scene of the same source that was made from the most of a run's training frames.

    Args:
        store: where to look.
        label: display name of the sequence; scenes of the same source have it too, but for the setting, or
            are of the same path.
        frames: the run's training frames.
        config: settings of the reconstruction.

    Returns:
        The scene, of two with as many frames the one that was made last, else the one whose key comes first;
        and why others are not taken (`extrags.continuation`).
    """
    from extrags.continuation import compared_frames
    from extrags.sequence import EndoscopicSequence

    refusals: dict[str, str] = {}
    candidates: list[tuple[int, Manifest, Ref]] = []
    for manifest in [item for kind in STAGES for item in store.ls(kind)]:
        if manifest.stage not in STAGES or _source(manifest.label) != _source(label):
            continue
        if manifest.inputs.get("sequence") == frames.digest:
            continue
        refusal = _refusal(manifest, config)
        given = None if refusal else found_whole(store, manifest.input_keys["sequence"])
        if given is None:
            refusals[manifest.key] = refusal or "its training frames are not in the store any more"
            continue
        candidates.append((int(store.manifest(given).counts.get("frames") or 0), manifest, given))
    # Stable sorts, the least significant first.
    candidates.sort(key=lambda item: item[1].key)
    candidates.sort(key=lambda item: item[1].started, reverse=True)
    candidates.sort(key=lambda item: item[0], reverse=True)
    sequence = store.load(EndoscopicSequence, frames) if candidates else None
    for _, manifest, given in candidates:
        scene = found_whole(store, manifest.key)
        if scene is None or sequence is None:
            refusals[manifest.key] = "it is not in the store any more, or damaged"
            continue
        try:
            comparison = compared_frames(store.load(EndoscopicSequence, given), sequence)
        except DamagedArtefactError as error:
            refusals[manifest.key] = f"its training frames are damaged: {error}"
            continue
        if not comparison.refusal:
            return Search(Earlier(scene, manifest.key, comparison.frames.tolist()), refusals)
        refusals[manifest.key] = comparison.refusal
    return Search(None, refusals)


def _refusal(manifest: Manifest, config: CoarseConfig) -> str:
    """Why a scene is not taken, from its manifest alone; empty where that tells of no reason."""
    from extrags.continuation import other_settings

    if not _current(manifest):
        return f"it was made by another version of the stage, {manifest.version}"
    if manifest.counts.get("refined_poses"):
        return "its poses were refined"
    if manifest.counts.get("corrected_colors"):
        return "the colours of its frames were corrected"
    settings = _settings(manifest)
    return "its settings cannot be read" if settings is None else other_settings(settings, config)


def _current(manifest: Manifest) -> bool:
    current = {"coarse": coarse.version, "continued-coarse": continued_coarse.version}
    return str(manifest.version) == current.get(manifest.stage)


def _settings(manifest: Manifest) -> CoarseConfig | None:
    """None where another version of the program has written them."""
    try:
        return CoarseConfig.model_validate(manifest.config.get("config"))
    except (ConfigError, ValueError):
        return None


def found_whole(store: Store, key: str) -> Ref | None:
    """The artefact of a key; None where it is damaged: who only looks leaves it where it is."""
    try:
        return store.find(key)
    except DamagedArtefactError:
        return None


def _source(label: str) -> str:
    """The name of a sequence without its setting: training frames are shared by settings."""
    path = PurePath(label)
    # Of a path, the last part alone has a setting.
    return comparable_name(str(path.parent / path.name.partition("@")[0]))
