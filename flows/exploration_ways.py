"""Ways to choose virtual views, measured against the true surface: `extrags bench explore`."""

from __future__ import annotations

import logging
import math
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from data_catalog.clairvoyant import clairvoyant_clips, free_viewpoint_poses
from data_catalog.surface_views import SurfaceCoverage, SurfaceTruth
from extrags.cameras import Cameras
from extrags.config import ExploreConfig, PipelineConfig
from extrags.errors import CaptureError, ConfigError
from extrags.exploration import explore, prepare_search
from extrags.exploration.ways import Clip, Moves, frontier_clips, perturbed_views, random_walk
from extrags.freespace import FreeSpace
from extrags.metrics.lpips import LpipsByNet
from extrags.raster.bench import machine
from extrags.scene import Scene
from extrags.sequence import EndoscopicSequence
from flows.methods import method_config
from flows.runners import DirectRunner
from flows.wiring import SequenceRun

__all__ = ["WAYS", "Chosen", "ReconstructedScene", "Way", "bench_explore", "check_ways"]

log = logging.getLogger(__name__)


@dataclass(frozen=True)
class ReconstructedScene:
    """What all ways of one sequence and seed share.

    Args:
        sequence: all frames, held-out ones included.
        training: the training frames alone.
        scene: the coarse scene.
        space: where cameras may go.
        truth: the true surface.
        config: settings of all stages.
        profile: name of the profile the settings come from.
        settings: overrides on the command line.
        seed: of all stages and of the ways.
    """

    sequence: EndoscopicSequence
    training: EndoscopicSequence
    scene: Scene
    space: FreeSpace
    truth: SurfaceTruth
    config: PipelineConfig
    profile: str
    settings: Mapping[str, Any]
    seed: int

    def method_settings(self, method: str, n_views: int, **changes: Any) -> ExploreConfig:
        """The search's settings of a method, with trajectories enough for so many views."""
        config = method_config(method, self.profile, dict(self.settings), self.seed).explore
        return config.model_copy(update={"trajectories": _trajectories(config, n_views), **changes})

    def moves(self, n_views: int) -> Moves:
        """Where a virtual camera can go."""
        config = self.config.explore
        config = config.model_copy(update={"trajectories": _trajectories(config, n_views)})
        context = prepare_search(
            self.scene,
            self.training.training_cameras,
            self.space,
            config,
            masks=self.training.training_masks,
        )
        return Moves(self.space, context.depth_unit_mm, config)

    def cameras(self, poses: np.ndarray) -> Cameras:
        """Virtual views at the size and with the intrinsics of the training views."""
        cameras = self.training.training_cameras.as_pinholes()
        K = np.broadcast_to(np.median(cameras.K, axis=0), (len(poses), 3, 3)).copy()
        return Cameras(K, poses, cameras.width, cameras.height)


@dataclass(frozen=True)
class Chosen:
    """The virtual views of one way.

    Args:
        clips: in the order of choice.
        renders: images that were rendered to choose them.
    """

    clips: Sequence[Clip]
    renders: int = 0


@dataclass(frozen=True)
class Way:
    """A way to choose virtual views.

    Args:
        summary: what it is, in words.
        choose: clips with so many views, real starts not counted; fewer where nothing more is worth a view.
    """

    summary: str
    choose: Callable[[ReconstructedScene, int], Chosen]


def _search(method: str, **changes: Any) -> Callable[[ReconstructedScene, int], Chosen]:
    def choose(given: ReconstructedScene, n_views: int) -> Chosen:
        config = given.method_settings(method, n_views, **changes)
        found = explore(given.scene, given.training, config, freespace=given.space)
        anchors = np.searchsorted(given.training.train, found.anchors)
        clips = [
            Clip(int(anchor), cameras.world_from_camera)
            for anchor, cameras in zip(anchors, found.trajectories, strict=True)
        ]
        return Chosen(clips, found.renders)

    return choose


def _by_moves(
    way: Callable[[Moves, Cameras, int, int], list[Clip]],
) -> Callable[[ReconstructedScene, int], Chosen]:
    def choose(given: ReconstructedScene, n_views: int) -> Chosen:
        cameras = given.training.training_cameras.as_pinholes()
        return Chosen(way(given.moves(n_views), cameras, n_views, given.seed))

    return choose


def _by_truth(
    way: Callable[[SurfaceTruth, Moves, Cameras, int, int], list[Clip]],
) -> Callable[[ReconstructedScene, int], Chosen]:
    def choose(given: ReconstructedScene, n_views: int) -> Chosen:
        cameras = given.training.training_cameras.as_pinholes()
        return Chosen(way(given.truth, given.moves(n_views), cameras, n_views, given.seed))

    return choose


WAYS: dict[str, Way] = {
    "extrags": Way("the search with the settings of the profile", _search("extrags")),
    "paper": Way("the paper's search", _search("paper")),
    "paper-no-illumination": Way(
        "the paper's search without the illumination weight", _search("paper", darkness_weight=0.0)
    ),
    "paper-no-fold": Way("the paper's search without the fold penalty", _search("paper", fold_penalty=1.0)),
    "exploregs": Way("frustum coverage, no illumination or fold term", _search("exploregs")),
    "frontier": Way("greedy by the border of unknown space alone", _by_moves(frontier_clips)),
    "random": Way("random moves that are possible", _by_moves(random_walk)),
    "perturbed": Way("training poses shifted and turned at random", _by_moves(perturbed_views)),
    "clairvoyant": Way(
        "same starts and moves, chosen by what the true surface shows", _by_truth(clairvoyant_clips)
    ),
    "free-viewpoint": Way(
        "single poses anywhere in free space, chosen by the true surface", _by_truth(free_viewpoint_poses)
    ),
}
"""By name, in the order of the table. The last two know the true surface: upper references, no methods."""


def check_ways(names: Sequence[str]) -> list[str]:
    """The names themselves, each once.

    Raises:
        ConfigError: for an unknown one.
    """
    unknown = [name for name in names if name not in WAYS]
    if unknown:
        raise ConfigError(f"unknown ways {', '.join(unknown)}; expected {', '.join(WAYS)}")
    return list(dict.fromkeys(names))


def bench_explore(
    sequences: Sequence[str],
    profile: str,
    settings: Mapping[str, Any],
    store: str,
    *,
    ways: Sequence[str],
    views: Sequence[int],
    seeds: Sequence[int],
    end_use: Sequence[int] = (),
    lpips: LpipsByNet | None = None,
    report: Callable[[str], None] = log.info,
) -> dict[str, Any]:
    """Choose virtual views in each way and measure what they show of the true surface.

    The coarse scene, its surface and its free space are made once per sequence and seed, in the store; the
    plan is left out. Every way looks for the largest number of views, and the figures of smaller numbers are
    those of its first views.

    Args:
        sequences: names or paths.
        profile: name of the profile.
        settings: overrides.
        store: root of the store.
        ways: names in `WAYS`.
        views: numbers of views to give figures for.
        seeds: of all stages, one case each.
        end_use: numbers of views to restore and fine-tune with; none by default.
        lpips: for the figures of the end use and the confidence of restored views.
        report: is told what is being done.

    Returns:
        A dictionary ready for JSON.

    Raises:
        ConfigError: for numbers of views that are not positive or a sequence without true surface.
        ExtragsError: what made a stage fail.
    """
    ways = check_ways(ways)
    if not views or min([*views, *end_use]) < 1:
        raise ConfigError(f"numbers of views {[*views, *end_use]}; expected 1 or more")
    cases: list[dict[str, Any]] = []
    for name in sequences:
        _check_truth(name, profile, settings, store, seeds[0])
    for name in sequences:
        for seed in seeds:
            given = _reconstructed(name, profile, settings, store, seed, report)
            cases += _cases(name, given, ways, sorted({*views}), sorted({*end_use}), lpips, report)
    return {
        "machine": machine(),
        "profile": profile,
        "settings": dict(settings),
        "config": method_config("extrags", profile, dict(settings)).model_dump(mode="json"),
        "ways": {name: WAYS[name].summary for name in ways},
        "views": sorted({*views}),
        "cases": cases,
    }


def _cases(
    name: str,
    given: ReconstructedScene,
    ways: Sequence[str],
    views: Sequence[int],
    end_use: Sequence[int],
    lpips: LpipsByNet | None,
    report: Callable[[str], None],
) -> Iterator[dict[str, Any]]:
    truth = given.truth
    shared = {
        "sequence": name,
        "seed": given.seed,
        "truth": {
            "kind": truth.kind,
            "area_mm2": truth.area_mm2 * len(truth.points),
            "reachable_share": truth.reachable_share,
            "never_seen_share": float(truth.never_seen.mean()),
            "badly_seen_share": float(truth.badly_seen.mean()),
            "held_out_pixels": len(truth.held_out_points),
        },
    }
    tuning = _EndUse(given, lpips) if end_use else None
    for way in ways:
        report(f"{name}, seed {given.seed}: {way}")
        begun = time.perf_counter()
        chosen = WAYS[way].choose(given, max([*views, *end_use]))
        seconds = time.perf_counter() - begun
        poses = [clip.views for clip in chosen.clips]
        coverage = truth.measure(given.cameras(np.concatenate(poses) if poses else np.zeros((0, 4, 4))))
        case: dict[str, Any] = {
            **shared,
            "way": way,
            "seconds": seconds,
            "renders": chosen.renders,
            "n_views": len(coverage),
            "clips": [
                {"anchor": clip.anchor, "world_from_camera": clip.poses.tolist()} for clip in chosen.clips
            ],
            "after": {str(count): _finite(coverage.after(count)) for count in views},
            "after_each": _by_view(coverage),
        }
        if tuning is not None:
            case["end_use"] = {"0": tuning.before}
            for count in end_use:
                report(f"{name}, seed {given.seed}: {way}, fine-tuned with {count} views")
                case["end_use"][str(count)] = tuning.measured(_first_views(chosen.clips, count))
        yield case


class _EndUse:
    """Restores views and fine-tunes with them; the restorer is prepared once for all ways.

    The judge, which may keep less of the fine-tuning, is left out: what is compared are the views.
    """

    def __init__(self, given: ReconstructedScene, lpips: LpipsByNet | None) -> None:
        from extrags.confidence import PerceptualDifference
        from extrags.restoration.backends import train_enhancer

        self.given, self.lpips = given, lpips
        config = given.config
        self.difference = PerceptualDifference.available(config.evaluate)
        self.enhancer = train_enhancer(given.scene, given.training, config.enhance, config.coarse)
        self.before = self._figures(given.scene)

    def measured(self, clips: Sequence[Clip]) -> dict[str, Any]:
        """Figures of the scene fine-tuned with these clips."""
        from extrags.restoration.trajectories import restore
        from extrags.training import finetune

        given, config = self.given, self.given.config
        begun = time.perf_counter()
        n_views = sum(len(clip.views) for clip in clips)
        pseudo = None
        if n_views:
            pseudo = restore(
                given.scene,
                given.training,
                [given.cameras(clip.poses) for clip in clips],
                # All that were chosen: the profile's limit is that of its own number.
                config.enhance.model_copy(update={"max_views": n_views}),
                config.coarse,
                measure=self.difference,
                enhancer=self.enhancer,
            )
        tuned = finetune(given.scene, given.training, pseudo, config.finetune, config.coarse)
        return {**self._figures(tuned.scene), "n_views": n_views, "seconds": time.perf_counter() - begun}

    def _figures(self, scene: Scene) -> dict[str, Any]:
        from extrags.evaluation import evaluate

        metrics = evaluate(scene, self.given.sequence, lpips=self.lpips).to_json()["metrics"]
        groups = ("whole", "observed", "unobserved")
        return {group: {"psnr": (metrics.get(group) or {}).get("psnr")} for group in groups}


def _first_views(clips: Sequence[Clip], count: int) -> list[Clip]:
    """Clips with the first so many views, the last one cut off."""
    kept, left = [], count
    for clip in clips:
        if left > 0:
            kept.append(Clip(clip.anchor, clip.poses[: left + 1]))
            left -= len(kept[-1].views)
    return kept


def _check_truth(name: str, profile: str, settings: Mapping[str, Any], store: str, seed: int) -> None:
    """Said before the first sequence takes its minutes."""
    run = _run(name, profile, settings, store, seed, "ingest")
    sequence = run.store.load(EndoscopicSequence, run.refs["sequence"])
    if sequence.true_depth_mm is None:
        raise ConfigError(
            f"{name} has no true surface: neither geometry nor true depth of its frames; what views show can "
            "be measured on phantoms and simulated or registered recordings only"
        )


def _reconstructed(
    name: str,
    profile: str,
    settings: Mapping[str, Any],
    store: str,
    seed: int,
    report: Callable[[str], None],
) -> ReconstructedScene:
    report(f"{name}, seed {seed}: reconstruction")
    run = _run(name, profile, settings, store, seed, "freespace")
    if "freespace" not in run.refs:
        raise CaptureError(f"{name}: no free space was made; the scene has no Gaussians")
    sequence = run.store.load(EndoscopicSequence, run.refs["sequence"])
    return ReconstructedScene(
        sequence=sequence,
        training=run.store.load(EndoscopicSequence, run.refs["training"]),
        scene=run.store.load(Scene, run.refs["coarse"]),
        space=run.store.load(FreeSpace, run.refs["freespace"]),
        truth=SurfaceTruth.of(sequence, seed),
        config=run.config,
        profile=profile,
        settings=settings,
        seed=seed,
    )


def _run(
    name: str, profile: str, settings: Mapping[str, Any], store: str, seed: int, until: Any
) -> SequenceRun:
    """The stages up to one, from the store where it has them."""
    config = method_config("extrags", profile, dict(settings), seed)
    left_out = {"assess": "all ways have the same number of views"}
    run = SequenceRun(name, config, store, DirectRunner(store), profile, leave_out=left_out)
    outcome = run.run(until)
    if outcome.error is not None:
        raise outcome.error
    return run


def _trajectories(config: ExploreConfig, n_views: int) -> int:
    return math.ceil(n_views / (config.length - 1))


def _finite(shares: Mapping[str, float]) -> dict[str, float | None]:
    """For JSON, which has no NaN: None where there is nothing that could be seen."""
    return {name: share if math.isfinite(share) else None for name, share in shares.items()}


def _by_view(coverage: SurfaceCoverage) -> dict[str, list[float | None]]:
    rows = [_finite(coverage.after(count)) for count in range(len(coverage) + 1)]
    return {name: [row[name] for row in rows] for name in rows[0]}
