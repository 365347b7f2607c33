"""The whole pipeline of a sequence as plain calls of the library, its results in memory.

`run_pipeline` is the same run as the flows', without a store: surface metrics need the true surface, which it
takes as an argument, since the library does not import the catalogue.
"""

from __future__ import annotations

import logging
import time
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING, TypeVar

from extrags.config import DEFAULT_PROFILE, PROFILES, PipelineConfig
from extrags.errors import CaptureError, ConfigError
from extrags.pipeline import Pipeline
from extrags.stages import StageName, stages_until
from extrags.user_paths import expanded

if TYPE_CHECKING:
    from extrags.baselines.uc_nerf.training import UcNerfResult
    from extrags.confidence import PerceptualDifference
    from extrags.depth.estimate import DepthEstimate
    from extrags.exploration import Exploration
    from extrags.finetuning_judgement import Judgement
    from extrags.freespace import FreeSpace
    from extrags.metrics.protocol import EvaluationResult, RenderedViews
    from extrags.metrics.surface import TrueSurface
    from extrags.pseudo_views import PseudoViews
    from extrags.restoration.protocol import Enhancer
    from extrags.scene import Scene
    from extrags.scene_plan import ScenePlan
    from extrags.sequence import EndoscopicSequence
    from extrags.surface import Mesh
    from extrags.training import TrainingResult

__all__ = ["InMemoryPipeline", "Result", "run_pipeline"]

log = logging.getLogger(__name__)

T = TypeVar("T")


@dataclass
class Result:
    """Results of `run_pipeline` for a sequence; None for the results of skipped stages.

    Args:
        sequence: all frames, with the poses the scene belongs to; without estimated depth, since the
            evaluation would take it for the truth.
        depth: estimated depth of the training frames, where the source has none.
        reconstruction: the coarse scene and its training history.
        uc_nerf: the radiance field and its training history, instead of `reconstruction`, where
            `uc_nerf.enabled` is set.
        plan: measurements of the coarse scene, and the decisions on later stages.
        mesh: the surface mesh.
        freespace: occupancy and clearance for virtual cameras.
        exploration: the virtual trajectories.
        pseudo_views: restored virtual views.
        judgement: how much of the fine-tuning is kept, and why.
        finetuning: the fine-tuned scene and its training history; None where the coarse scene is kept.
        renders: held-out views of `coarse` and, if it was fine-tuned, of `final`; `restored` are those of the
            final scene restored in the image, where there is a restorer (`evaluate.restored`).
        evaluations: metrics of the same; without fine-tuning `final` are the coarse scene's.
        skipped: why stages were skipped, by name.
        seconds: wall-clock time by stage.
    """

    sequence: EndoscopicSequence
    depth: DepthEstimate | None = None
    reconstruction: TrainingResult | None = None
    uc_nerf: UcNerfResult | None = None
    plan: ScenePlan | None = None
    mesh: Mesh | None = None
    freespace: FreeSpace | None = None
    exploration: Exploration | None = None
    pseudo_views: PseudoViews | None = None
    judgement: Judgement | None = None
    finetuning: TrainingResult | None = None
    renders: dict[str, RenderedViews] = field(default_factory=dict)
    evaluations: dict[str, EvaluationResult] = field(default_factory=dict)
    skipped: dict[str, str] = field(default_factory=dict)
    seconds: dict[str, float] = field(default_factory=dict)

    @property
    def coarse(self) -> Scene:
        """The coarse scene.

        Raises:
            CaptureError: when the run ended before the stage `coarse`, or the scene is a radiance field.
        """
        if self.uc_nerf is not None:
            raise CaptureError(f"{self.sequence.name}: there are no Gaussians; the scene is `uc_nerf`")
        if self.reconstruction is None:
            raise CaptureError(f"{self.sequence.name}: the run ended before the scene was reconstructed")
        return self.reconstruction.scene

    @property
    def scene(self) -> Scene:
        """The final scene: the fine-tuned one, or the coarse one if fine-tuning was skipped.

        Raises:
            CaptureError: as `coarse`.
        """
        return self.coarse if self.finetuning is None else self.finetuning.scene


class InMemoryPipeline(Pipeline):
    """The stages as plain calls of the library; their results are kept in `result`.

    Args:
        sequence: the frames, from `data_catalog.read`.
        config: settings of all stages.
        leave_out: see `Pipeline`.
        true_surface: ground truth of the surface for the evaluation; None omits the surface metrics.
    """

    def __init__(
        self,
        sequence: EndoscopicSequence,
        config: PipelineConfig,
        leave_out: Mapping[str, str] | None = None,
        *,
        true_surface: TrueSurface | None = None,
    ) -> None:
        super().__init__(config, leave_out)
        # The oracle's frames are those of no other scene: it starts anew anyway. A radiance field has none.
        begins_anew = config.coarse.train_on == "all" or config.uc_nerf.enabled
        if config.continuation.scene == "nearest" and not begins_anew:
            raise ConfigError(
                "continuation.scene=nearest looks for a scene in a store, and a run in memory has none; "
                "give extrags.training.reconstruct the earlier scene"
            )
        self.result = Result(sequence)
        self._given = len(sequence.train), len(sequence.test)
        self.true_surface = true_surface
        self._training = sequence
        """The frames that the reconstruction uses: from `coarse` on, the training frames alone."""
        self._device = "cpu"
        """Where Gaussians are optimised and rendered; results are kept on the processor."""
        self._enhancer: Enhancer | None = None
        """The scene's restorer, which the judge of the fine-tuning uses as well."""

    def skip(self, stage: StageName, reason: str) -> None:
        """Record and log the reason."""
        log.info("%s: %s skipped: %s", self.result.sequence.name, stage, reason)
        self.result.skipped[stage] = reason

    def has_poses(self) -> bool:
        """Whether the sequence has camera poses."""
        return self.result.sequence.world_from_camera is not None

    def has_depth(self) -> bool:
        """Whether training frames have depth that is taken as it is, in the unit of the poses."""
        return self.result.sequence.training_depth_known and self.result.sequence.depth_error is None

    def training_frame_count(self) -> int:
        """Number of training frames."""
        return len(self.result.sequence.train)

    def held_out_frames(self) -> int:
        """Number of held-out frames."""
        return len(self.result.sequence.test)

    def frames_without_pose(self) -> tuple[int, int]:
        """Numbers of training and of held-out frames that have left the sequence for want of a pose."""
        left = self.result.sequence
        return self._given[0] - len(left.train), self._given[1] - len(left.test)

    def virtual_views(self) -> int:
        """Number of virtual views the exploration found."""
        return 0 if self.result.exploration is None else self.result.exploration.n_virtual

    def ingest(self) -> None:
        """The sequence was read by the caller; what is wrong elsewhere is said before anything is made."""
        from extrags.placement import check_device, run_device
        from extrags.raster import native_isa

        native_isa()  # refuses an EXTRAGS_ISA that is not usable
        check_device(self.config)
        self._device = run_device(self.config)

    def poses(self) -> None:
        """`extrags.poses.estimate_poses`; frames that cannot be registered are dropped."""
        from extrags.poses import (
            check_lens_use,
            estimate_poses,
            observed_by_those_left,
            with_estimated_poses,
        )

        with self._timed("poses"):
            self.config.check_imported_has_cameras()
            sequence = self.result.sequence
            if sequence.intrinsics == "guessed":
                check_lens_use(self.config.ingest)
            estimate = estimate_poses(sequence, self.config.poses)
            sequence = replace(sequence, observed=observed_by_those_left(sequence, estimate.registered))
            self.result.sequence = with_estimated_poses(sequence, estimate, self.config.ingest)

    def depth(self) -> None:
        """`extrags.depth.estimate.estimate_depth` of the training frames alone."""
        from extrags.depth.estimate import estimate_depth

        with self._timed("depth"):
            frames = self.result.sequence.training_part()
            self.result.depth = estimate_depth(frames, self.config.depth, self.config.poses)

    def coarse(self) -> None:
        """`extrags.training.reconstruct` on the training frames alone, or an imported scene."""
        from extrags.training import reconstruct
        from extrags.training.reconstruction import as_reconstructed

        with self._timed("coarse"):
            self._training = self._with_depth(self.result.sequence.training_part())
            if self.config.uc_nerf.enabled:
                self.result.uc_nerf = self._train_uc_nerf()
                return
            if self.config.imported.scene is not None:
                self.result.reconstruction = self._imported(self.config.imported.scene)
                return
            # The oracle alone is shown held-out frames, and no later stage sees what it made.
            oracle = self.config.coarse.train_on == "all"
            frames = self._with_depth(self.result.sequence) if oracle else self._training
            found = reconstruct(frames, self.config.coarse, device=self._device)
            found = replace(found, scene=found.scene.to("cpu"))
            if found.corrects_frames:
                # The scene was optimised with the corrected poses and colours: later stages need them.
                self.result.sequence = as_reconstructed(self.result.sequence, found)
                self._training = self._with_depth(self.result.sequence.training_part())
            self.result.reconstruction = found

    def assess(self) -> None:
        """`extrags.assessment.assess`."""
        from extrags.assessment import assess

        with self._timed("assess"):
            self.plan = self.result.plan = assess(
                self.result.coarse.to(self._device), self._training, self.config
            )

    def surface(self) -> None:
        """`extrags.surface.fuse_surface`."""
        from extrags.surface import fuse_surface

        with self._timed("surface"):
            self.result.mesh = fuse_surface(
                self.result.coarse,
                self._training.training_cameras,
                self.config.surface,
                masks=self._training.training_masks,
            )

    def freespace(self) -> None:
        """`extrags.freespace.carve`."""
        from extrags.freespace import carve
        from extrags.surface_error import surface_error_mm

        mesh = _made(self.result.mesh, "surface")
        with self._timed("freespace"):
            self.result.freespace = carve(
                self.result.coarse,
                mesh,
                self._training.training_cameras,
                self.config.freespace,
                surface_error_mm=surface_error_mm(mesh, self._training),
                masks=self._training.training_masks,
            )

    def explore(self) -> None:
        """`extrags.exploration.explore`."""
        from extrags.exploration import explore

        with self._timed("explore"):
            self.result.exploration = explore(
                self.result.coarse, self._training, self.config.explore, freespace=self.result.freespace
            )

    def enhance(self) -> None:
        """`extrags.restoration.trajectories.restore`."""
        from extrags.restoration.backends import train_enhancer
        from extrags.restoration.trajectories import restore

        exploration = _made(self.result.exploration, "explore")
        scene, frames, settings = self.result.coarse, self._training, self.config.enhance
        with self._timed("enhance"):
            self._enhancer = train_enhancer(scene.to(self._device), frames, settings, self.config.coarse)
            self.result.pseudo_views = restore(
                scene,
                frames,
                exploration.trajectories,
                settings,
                self.config.coarse,
                measure=self._perceptual_difference(),
                enhancer=self._enhancer,
            )

    def finetune(self) -> None:
        """`extrags.training.finetune`, as much of it as `extrags.finetuning_judge` keeps."""
        from extrags.finetuning_judge import judge_finetuning
        from extrags.training import finetune

        exploration = self.result.exploration
        with self._timed("finetune"):
            scene = self.result.coarse.to(self._device)
            judgement = self.result.judgement = judge_finetuning(
                scene,
                self._training,
                () if exploration is None else exploration.trajectories,
                self._enhancer,
                self.config.finetune,
                self.config.enhance,
                self.config.coarse,
                measure=self._perceptual_difference(),
            )
            if judgement.amount is not None:
                made = self.result.reconstruction
                found = finetune(
                    scene,
                    self._training,
                    self.result.pseudo_views if judgement.amount > 0 else None,
                    judgement.applied_to(self.config.finetune),
                    self.config.coarse,
                    # Frames that were corrected are compared anew.
                    frame_weights=None if made is None or made.corrects_frames else made.frame_weights,
                )
                self.result.finetuning = replace(found, scene=found.scene.to("cpu"))

    def evaluate(self) -> None:
        """`extrags.evaluation` of the coarse and the final scene."""
        from extrags.evaluation import evaluate_renders, render
        from extrags.metrics.lpips import available_lpips
        from extrags.metrics.protocol import figures_per_view
        from extrags.metrics.surface import scene_surface

        lpips = available_lpips(self.config.evaluate)
        sequence = self.result.sequence
        with self._timed("evaluate"):
            meshes: dict[str, Mesh | None] = {}
            if self.result.uc_nerf is not None:
                from extrags.baselines.uc_nerf import rendering

                field = self.result.uc_nerf.scene
                self.result.renders["coarse"] = rendering.render(field, sequence)
                if self.true_surface is not None:
                    meshes["coarse"] = rendering.surface(field, sequence)
            else:
                scenes = {"coarse": self.result.coarse}
                if self.result.finetuning is not None:
                    scenes["final"] = self.result.finetuning.scene
                for which, scene in scenes.items():
                    self.result.renders[which] = render(
                        scene.to(self._device), sequence, train_on=self.config.coarse.train_on
                    )
                    if self.true_surface is not None:
                        meshes[which] = scene_surface(scene, sequence)
            restored = self._restored_renders()
            if restored is not None:
                self.result.renders["restored"] = restored
                # The surface is the scene's.
                meshes["restored"] = meshes.get("final", meshes.get("coarse"))
            renders = self.result.renders
            found = figures_per_view(
                list(renders.values()), sequence, sequence.test, lpips, device=self._device
            )
            for which, per_view in zip(renders, found, strict=True):
                self.result.evaluations[which] = evaluate_renders(
                    renders[which],
                    sequence,
                    mesh=meshes.get(which),
                    true_surface=self.true_surface,
                    lpips=lpips,
                    per_view=per_view,
                )
        # Where nothing was fine-tuned, the coarse scene is the final one.
        self.result.evaluations.setdefault("final", self.result.evaluations["coarse"])

    def _restored_renders(self) -> RenderedViews | None:
        """The final scene's views once more, restored (`evaluate.restored`)."""
        from extrags.restoration.restored_renders import restored_renders

        if self._enhancer is None or self.config.evaluate.restored == "none":
            return None
        return restored_renders(
            self.result.coarse,
            self.result.renders.get("final", self.result.renders["coarse"]),
            self.result.sequence,
            self._training,
            self._enhancer,
            self.config.enhance,
            finish=self.config.evaluate.restored,
            shares=None if self.result.judgement is None else self.result.judgement.restored_shares,
        )

    def report(self) -> None:
        """Nothing: the HTML report is built from artefacts, which a run in memory does not have."""

    def _with_depth(self, frames: EndoscopicSequence) -> EndoscopicSequence:
        """The frames with the depth that was estimated of the training frames, if any was."""
        from extrags.depth.training_depth import with_training_depth

        return frames if self.result.depth is None else with_training_depth(frames, self.result.depth)

    def _imported(self, file: str) -> TrainingResult:
        from extrags.splat_files.importing import import_scene
        from extrags.training import TrainingResult

        found = import_scene(expanded(file), self._training, self.config.imported)
        gaussians = found.scene.gaussians
        self.config = self.config.of_imported_scene(
            count=len(gaussians), sh_degree=gaussians.sh_degree, lit=found.scene.light is not None
        )
        return TrainingResult(found.scene, [])

    def _train_uc_nerf(self) -> UcNerfResult:
        from extrags.baselines.uc_nerf.training import train

        return train(self._training, self.config.uc_nerf)

    def _perceptual_difference(self) -> PerceptualDifference:
        from extrags.confidence import PerceptualDifference

        return PerceptualDifference.available(self.config.evaluate)

    @contextmanager
    def _timed(self, stage: StageName) -> Iterator[None]:
        # As in the flows: what both make has the same bits, whatever the number of torch's threads.
        from extrags.threads import one_torch_thread

        begun = time.perf_counter()
        with one_torch_thread():
            yield
        self.result.seconds[stage] = time.perf_counter() - begun


def _made(product: T | None, stage: StageName) -> T:
    """The product of an earlier stage, which `Pipeline.reason_to_skip` makes sure of.

    Raises:
        ConfigError: for stages called by hand in another order.
    """
    if product is None:
        raise ConfigError(f"the stage {stage} has to run first")
    return product


def run_pipeline(
    sequence: EndoscopicSequence,
    config: PipelineConfig | None = None,
    *,
    until: StageName = "evaluate",
    leave_out: Mapping[str, str] | None = None,
    true_surface: TrueSurface | None = None,
) -> Result:
    """Reconstruct, explore, restore, fine-tune and evaluate a sequence, in memory.

    Nothing is cached; `extrags run` and the flows compute the same results as cached artefacts. Progress
    events go to the subscriber of `extrags.events.subscribed`.

    Args:
        sequence: the frames, from `extrags.read` or `extrags.sequence_from_arrays`.
        config: settings of all stages, e.g. `extrags.PROFILES["quick"]`; None takes the profile
            `balanced`, as `extrags run` does.
        until: last stage to run.
        leave_out: stages to skip regardless of the plan, with the reason.
        true_surface: ground truth of the surface (`data_catalog.true_surface`); None omits its metrics.

    Returns:
        The results of all stages that ran.

    Raises:
        CaptureError: when the frames are not sufficient for a reconstruction.
        DivergedError: when an optimisation produces NaN or infinity.
        WeightsError: when a model that the settings name does not exist.
        ConfigError: when settings are incompatible with each other, or are none of a pipeline.
        TypeError: when `sequence` is none, such as a name.
        SourceError: when its arrays cannot be those of a recording (`extrags.sequence_checks.check_arrays`).
    """
    from extrags.arguments import check_sequence_argument, check_settings_argument

    check_sequence_argument(sequence, "run_pipeline")
    config = PROFILES[DEFAULT_PROFILE] if config is None else config
    check_settings_argument(config, PipelineConfig, "run_pipeline", 'extrags.PROFILES["quick"]')
    pipeline = InMemoryPipeline(sequence, config, leave_out, true_surface=true_surface)
    if "evaluate" in stages_until(until) and "evaluate" not in pipeline.leave_out:
        from extrags.metrics.photometric import try_added_metrics
        from extrags.placement import check_device, run_device

        check_device(config)
        try_added_metrics(run_device(config))
    pipeline.run_stages(until)
    return pipeline.result
