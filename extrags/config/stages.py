"""Settings of the stages: one frozen model each, and `PipelineConfig` that joins them.

Lengths that depend on the scene are given relative to it (to a depth quantile, say), so that the same
settings serve a colon in millimetres and a COLMAP model in arbitrary units. Budgets are counted in
iterations, never in seconds: a result must not depend on how busy the machine was.
"""

from __future__ import annotations

from collections.abc import Mapping
from operator import attrgetter
from typing import Any, ClassVar, Literal

from pydantic import Field, ValidationError, field_validator

from extrags.config.base import Seed, StageConfig
from extrags.config.baselines import UcNerfConfig
from extrags.config.coarse import CoarseConfig
from extrags.config.continuation import ContinuationConfig
from extrags.config.depth import DepthConfig
from extrags.config.exploration import ExploreConfig, FreespaceConfig, SurfaceConfig
from extrags.config.finetuning import FinetuneConfig
from extrags.config.imported import ImportedConfig
from extrags.config.poses import PosesConfig
from extrags.config.restorer import EnhanceConfig
from extrags.config.settings import refused_settings, settings_of, unknown_setting
from extrags.errors import ConfigError, PoseError
from extrags.provenance import StereoCamera
from extrags.thresholds import HOLE_ALPHA

__all__ = [
    "AssessConfig",
    "EvaluateConfig",
    "IngestConfig",
    "LpipsNet",
    "PipelineConfig",
    "ReportConfig",
]


LARGEST_DEPTH_ERROR = 0.5
"""Relative error of depth that a source may be said to have."""


class IngestConfig(StageConfig):
    """Reading of a source into an `EndoscopicSequence`."""

    not_in_keys_where: ClassVar[dict[str, str]] = {"stereo_camera": "left"}
    """A setting that came later, at the value that changes nothing: older artefacts stay."""

    width: int | None = Field(
        None, ge=16, le=4096, description="image width in pixels; None keeps the source's own"
    )
    height: int | None = Field(None, ge=16, le=4096, description="image height in pixels")
    downscale: int | None = Field(
        None,
        ge=1,
        le=16,
        description="divide the source's size by this; None: as ingest.size says; not together with width",
    )
    size: Literal["thumbnail", "source", "central", "detail"] = Field(
        "thumbnail",
        description="where neither width nor downscale is set. thumbnail: the source's usual divisor (sinus "
        "4, simcol3d 2, C3VD to a width of 225, others 1); source: as large as the source; central: as "
        "source, but where field_of_view_deg (of C3VD: 100) widens the pinhole of a distorted source, the "
        "image grows with it, so that the source's central resolution is kept; detail: the smallest size "
        "that keeps the detail of the frames (detail_psnr_db), for footage that is larger than what it shows",
    )
    detail_psnr_db: float = Field(
        48.0,
        ge=20,
        le=80,
        description="what frames that are shrunk and enlarged again must keep, as the PSNR against "
        "themselves; sets the size where size is detail, and what it would give is reported for every source",
    )
    holdout_every: int = Field(
        8, ge=2, description="hold out every n-th frame where the source defines no split"
    )
    max_frames: int | None = Field(None, ge=2, description="read at most so many frames")
    max_absent_share: float = Field(
        0.5,
        ge=0,
        lt=1,
        description="frames that a list of poses names and that are absent, and frames of which a mask file "
        "leaves no pixel, are left out with a warning; the source is refused where either are more than this "
        "share",
    )
    withhold_depth: bool = Field(
        False,
        description="training frames keep no depth; held-out frames keep theirs for the evaluation alone. "
        "Points of a source that has depth go with it",
    )
    depth_error: float | Literal["auto"] = Field(
        "auto",
        description="relative error of depth that the source has. auto: none, unless training frames "
        "disagree about their depth by more than poses that are off explain; a number from 0 to 0.5: so "
        "much; 0: depth is taken as it is. Depth with an error is corrected and combined with what the depth "
        "stage estimates",
    )
    correct_calibration: bool = Field(
        True,
        description="of sources with poses and depth: correct what all frames have in common, where their "
        "depth tells it clearly: depth along the ray, its unit and offset, focal lengths and principal "
        "point, or the place of the camera on what is tracked",
    )
    mask_foreground: bool = Field(
        True,
        description="of sources with poses and depth: mask what training frames show in front of the "
        "surface and other frames look through, such as instruments",
    )
    crop_surround: bool = Field(
        True,
        description="of sources without poses, where no width is set: cut frames to the picture, where it "
        "takes at most three quarters of them, as a round one in a wide frame does",
    )
    match_light: bool = Field(
        True,
        description="where some training frames were recorded under another light, such as narrow-band "
        "imaging, and features show how colours of both differ: give them the colours of the others",
    )
    scale_mm_per_unit: float | None = Field(
        None,
        gt=0,
        le=1e6,
        description="millimetres per unit of the source's poses, where their unit is arbitrary; None: it "
        "stays arbitrary",
    )
    start_s: float = Field(
        0.0, ge=0, description="of a video or DICOM file: read from here on, in seconds by its timestamps"
    )
    end_s: float | None = Field(
        None, gt=0, description="of a video or DICOM file: read up to here, in seconds; None: to its end"
    )
    stereo_camera: StereoCamera = Field(
        "left",
        description="which camera's frames are read of a stereo endoscope. right is refused where nothing "
        "indicates two cameras, and is part of cache keys",
    )
    field_of_view_deg: float | None = Field(
        None,
        ge=20,
        le=150,
        description="horizontal field of view of the pinhole that distorted sources are resampled to; None: "
        "the source's usual one (C3VD and C3VDv2 100; others: that of their central resolution)",
    )
    lens: Literal["pinhole", "native"] = Field(
        "pinhole",
        description="of sources with distortion. pinhole: frames are resampled to one, and what it does not "
        "show is left out; native: frames keep their original pixels, and Gaussians are projected through "
        "the lens itself (a radial model fitted to the source's; the log states its error and the share of "
        "pixels used). Virtual views are pinholes either way; on a GPU with gsplat native is refused",
    )
    calibration: str | None = Field(
        None,
        min_length=1,
        description="calibration file of the endoscope: OpenCV (YAML or XML), Kalibr (camchain), Scaramuzza "
        "(calib_results.txt). It takes the place of intrinsics that are guessed or stated beside frames, and "
        "is refused where poses were solved with others; its content counts in cache keys, not its path",
    )

    @field_validator("depth_error")
    @classmethod
    def _is_a_share(cls, error: float | str) -> float | str:
        if isinstance(error, float) and not 0 <= error <= LARGEST_DEPTH_ERROR:
            raise ValueError(f"expected auto or a number from 0 to {LARGEST_DEPTH_ERROR}")
        return error


class AssessConfig(StageConfig):
    """Assessment of the coarse scene, and the plan of the later stages."""

    probe_views: int = Field(
        192,
        ge=1,
        description="views in the fan round the training views; with few of them what is found lacking, and "
        "with it the plan, depends on the seed",
    )
    probe_offset: float = Field(0.35, gt=0, description="sideways offset of a probe, in median depths")
    probe_turn_deg: float = Field(35.0, ge=0, description="turn of a probe")
    hole_alpha: float = Field(HOLE_ALPHA, gt=0, lt=1, description="a pixel below this alpha is a hole")
    sufficient_resolution: float = Field(
        0.4,
        gt=0,
        description="surface is resolved where a training view has this share of the pixels that a probe has "
        "of it; as explore.sufficient_resolution",
    )
    unresolved_weight: float = Field(
        1 / 3,
        ge=0,
        le=1,
        description="what a pixel of unresolved surface counts beside a hole; as explore.unresolved_error "
        "beside explore.hole_error",
    )
    min_hole_share: float = Field(
        0.015,
        ge=0,
        le=1,
        description="explore, restore and judge only when holes and unresolved pixels, these by their "
        "weight, exceed this share; a scene that lacks less is fine-tuned on its real views alone",
    )
    full_budget_share: float = Field(
        0.075, gt=0, le=1, description="share of lacking pixels from which the whole budget is used"
    )
    force: bool = Field(False, description="run every stage whatever the measurements say")
    seed: Seed = Field(0, description="seed of all random sampling")


LpipsNet = Literal["alex", "vgg", "squeeze"]
"""Backbones of LPIPS."""
Finish = Literal["smooth", "textured", "refined"]
"""What is done to the invented parts of restored views."""


class EvaluateConfig(StageConfig):
    """Held-out views and their metrics."""

    lpips_nets: tuple[LpipsNet, ...] = Field(
        ("alex",),
        min_length=1,
        description="backbones LPIPS is measured with; the first also gives the pixel confidence of restored "
        "views. VGG, the backbone papers report, takes sixteen times as long as AlexNet",
    )
    lpips_weights: str | None = Field(
        None,
        description="npz file with LPIPS weights, or the folder that holds one for each backbone; None looks "
        "in the usual places",
    )
    restored: Literal["none", "smooth", "textured", "refined"] = Field(
        "refined",
        description="held-out views of the final scene are also measured after restoration in the image. "
        "textured: what is invented gets texture of the scene's own frames, which looks right and costs some "
        "PSNR; refined: a network makes that texture and the shapes agree, unless on leave-out frames "
        "networks do worse than without; smooth: without either; none: not measured. Each held-out view "
        "takes the restorer once, which a large pretrained model makes long",
    )

    @field_validator("lpips_nets")
    @classmethod
    def _once_each(cls, nets: tuple[LpipsNet, ...]) -> tuple[LpipsNet, ...]:
        if len(set(nets)) < len(nets):
            raise ValueError("a backbone is given twice")
        return nets


class ReportConfig(StageConfig):
    """The HTML page."""

    held_out_views: int = Field(6, ge=1, description="held-out views shown")
    virtual_views: int = Field(8, ge=1, description="virtual views shown")
    viewer_mb: float = Field(
        8.0, ge=0, le=100, description="MB of the page that the interactive scene may take; 0 leaves it out"
    )


class PipelineConfig(StageConfig):
    """All stages of one run.

    The defaults of its fields are no profile: what is called without settings takes those of
    `DEFAULT_PROFILE`.
    """

    not_in_keys: ClassVar[frozenset[str]] = frozenset({"device"})
    """Stages count the device they ran on: `auto` would be another on another machine."""

    ingest: IngestConfig = IngestConfig()
    poses: PosesConfig = PosesConfig()
    depth: DepthConfig = DepthConfig()
    coarse: CoarseConfig = CoarseConfig()
    continuation: ContinuationConfig = ContinuationConfig()
    imported: ImportedConfig = ImportedConfig()
    uc_nerf: UcNerfConfig = UcNerfConfig()
    assess: AssessConfig = AssessConfig()
    surface: SurfaceConfig = SurfaceConfig()
    freespace: FreespaceConfig = FreespaceConfig()
    explore: ExploreConfig = ExploreConfig()
    enhance: EnhanceConfig = EnhanceConfig()
    finetune: FinetuneConfig = FinetuneConfig()
    evaluate: EvaluateConfig = EvaluateConfig()
    report: ReportConfig = ReportConfig()
    device: Literal["auto", "cpu", "cuda"] = Field(
        "auto",
        description="where Gaussians are optimised, rendered and measured, and where stages whose own device "
        "is auto run. auto: cuda where there is one, with gsplat and pinholes; cuda: refused where there is "
        "none. Part of cache keys as what it comes to; `extrags devices` shows what runs where, and why",
    )

    def with_seed(self, seed: int) -> PipelineConfig:
        """The same settings with every stage's seed set."""
        seeded = {
            name: value.model_copy(update={"seed": seed})
            for name, value in self
            if isinstance(value, StageConfig) and "seed" in type(value).model_fields
        }
        return self.model_copy(update=seeded)

    def with_run_device(self) -> PipelineConfig:
        """The same settings where stages whose own device is `auto` have the run's."""
        if self.device == "auto":
            return self
        device = {"device": self.device}
        changed: dict[str, Any] = {}
        if self.depth.device == "auto":
            changed["depth"] = self.depth.model_copy(update=device)
        parts = {
            name: part.model_copy(update=device)
            for name, part in (
                ("pretrained", self.enhance.pretrained),
                ("checkpoint", self.enhance.checkpoint),
            )
            if part.device == "auto"
        }
        if parts:
            changed["enhance"] = self.enhance.model_copy(update=parts)
        return self.model_copy(update=changed)

    def check_imported(self) -> None:
        """Refuse settings that an imported scene, or a radiance field, makes meaningless.

        Raises:
            ConfigError: names them.
        """
        against = {
            "uc_nerf.enabled": self.uc_nerf.enabled,
            "coarse.train_on=all": self.coarse.train_on == "all",
            "coarse.refine_poses": self.coarse.refine_poses is True,
            "continuation.scene=nearest": self.continuation.scene == "nearest",
            "poses.replace_given": self.poses.replace_given,
        }
        if self.uc_nerf.enabled and self.ingest.lens == "native":
            raise ConfigError("ingest.lens=native: uc_nerf renders pinholes; take ingest.lens=pinhole")
        wrong = [name for name, is_set in against.items() if is_set]
        if self.imported.scene is not None and wrong:
            raise ConfigError(
                "imported.scene takes the place of the coarse scene, with the source's poses; "
                f"{', '.join(wrong)} cannot be set beside it"
            )

    def check_imported_has_cameras(self) -> None:
        """Refuse to estimate poses for an imported scene: they would have a world of their own.

        Raises:
            PoseError: where a scene is imported.
        """
        if self.imported.scene is not None:
            raise PoseError(
                "the sequence has no poses, and an imported scene needs the cameras it was made with: poses "
                "that are estimated here have a world of their own",
                file=self.imported.scene,
                field="world_from_camera",
            )

    def of_imported_scene(self, *, count: int, sh_degree: int, lit: bool) -> PipelineConfig:
        """The same settings, for later stages that work on an imported scene.

        Folds of the restorer and trials of the judge are reconstructed as the scene is: with or without
        light, with its degree of harmonics; fine-tuning may grow from its number of Gaussians on, and with
        `imported.keep` leaves these as they are.

        Args:
            count: of its Gaussians.
            sh_degree: of its harmonics.
            lit: whether it has a light.
        """
        return self.with_overrides(
            {
                "coarse.light.enabled": lit and self.coarse.light.enabled,
                "coarse.sh_degree": sh_degree,
                "finetune.keep_scene": self.finetune.keep_scene or self.imported.keep,
                "coarse.densify.max_gaussians": max(count, self.coarse.densify.max_gaussians),
            }
        )

    def value(self, name: str) -> Any:
        """The value of a setting by its dotted name.

        Raises:
            ConfigError: for an unknown name (with the nearest known one).
        """
        known = settings_of(PipelineConfig)
        if name not in known:
            raise unknown_setting(name, known)
        return attrgetter(name)(self)

    def with_overrides(self, overrides: Mapping[str, Any]) -> PipelineConfig:
        """Apply `{"coarse.iterations": 500}`-like settings.

        Raises:
            ConfigError: for what is no mapping, an unknown name (with the nearest known one), a value out of
                range, or values that do not go together.
        """
        if not isinstance(overrides, Mapping):
            raise ConfigError(
                f"settings are {type(overrides).__name__}; expected a mapping, e.g. "
                '{"coarse.iterations": 500}'
            )
        known = settings_of(PipelineConfig)
        tree = self.model_dump()
        for name, value in overrides.items():
            if name not in known:
                raise unknown_setting(str(name), known)
            *parents, leaf = name.split(".")
            node = tree
            for parent in parents:
                node = node[parent]
            node[leaf] = value
        try:
            return PipelineConfig.model_validate(tree)
        except ValidationError as error:
            raise refused_settings(error, known, overrides) from error
