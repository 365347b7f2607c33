"""Settings of surface, free space, and of the search for virtual views."""

from __future__ import annotations

from typing import Any, Literal

from pydantic import Field

from extrags.config.base import Seed, StageConfig

__all__ = ["CoverageConfig", "ExploreConfig", "FreespaceConfig", "SurfaceConfig", "Visibility"]


class SurfaceConfig(StageConfig):
    """TSDF fusion of rendered depth."""

    voxel_share: float = Field(
        1 / 96, gt=0, lt=1, description="voxel edge as a share of the 95 % depth quantile"
    )
    truncation_voxels: float = Field(5.0, gt=1, description="truncation in voxels")
    min_alpha: float = Field(0.5, gt=0, lt=1, description="depth counts only above this alpha")
    depth_quantile: float = Field(0.98, gt=0.5, le=1, description="farther depth is not fused")
    min_cluster_triangles: int = Field(50, ge=1, description="smaller pieces are removed")
    max_width: int = Field(320, ge=16, description="wider images are rendered at this width")


class FreespaceConfig(StageConfig):
    """Occupancy and clearance."""

    grid_size: int = Field(64, ge=8, le=256, description="S: voxels per axis")
    top_views: int = Field(3, ge=1, description="visibility = mean of so many best views")
    occupied_below: float = Field(0.5, gt=0, lt=1, description="tau of the paper")
    margin_share: float = Field(
        0.05, ge=0, description="padding of the bounding volume, as a share of its largest side"
    )
    min_alpha: float = Field(
        0.5, gt=0, lt=1, description="a ray that ends below this alpha hit nothing and proves nothing"
    )
    wall_voxels: float = Field(
        2.0, gt=0, description="unseen voxels this near to the mesh are occupied, farther ones unknown"
    )
    render_width: int = Field(160, ge=16, description="width of the renders in pixels")
    max_views: int = Field(
        64,
        ge=1,
        le=64,
        description="training views that are rendered; of more, the most different ones",
    )
    passage_share: float = Field(
        0.15,
        ge=0,
        description="free space that a ball of this radius, in median rendered depths, cannot reach from the "
        "training cameras is unknown: it lies behind a hole in the wall; 0 asks for a connection alone",
    )


Visibility = Literal["blending", "frustum"]
"""When a view sees a Gaussian."""


class CoverageConfig(StageConfig):
    """Coverage: which Gaussians were seen from which directions."""

    directions: int = Field(32, ge=4, le=32, description="D: equal-area direction bins")
    visible_weight: float = Field(
        0.02, gt=0, lt=1, description="a Gaussian is seen when its largest T * alpha exceeds this"
    )
    visibility: Visibility = Field(
        "blending", description="blending: by visible_weight; frustum: every Gaussian inside the image"
    )
    render_width: int = Field(80, ge=16, description="width of the renders in pixels")

    @property
    def options(self) -> dict[str, Any]:
        """The arguments of `extrags.exploration.coverage.rendered_pairs`."""
        return {
            "visible_weight": self.visible_weight,
            "n_directions": self.directions,
            "visibility": self.visibility,
        }


class ExploreConfig(StageConfig):
    """The search for virtual trajectories."""

    trajectories: int = Field(20, ge=1, description="N_Tr: trajectories at most")
    starts: int = Field(
        12,
        ge=1,
        description="score=error: training views that the search starts from, at least; never fewer than "
        "trajectories. With score=pairs there are as many as trajectories, as in the paper",
    )
    start_spacing: float = Field(
        2.5,
        gt=0,
        description="score=error: more training views are starts until each is within this distance of one, "
        "in median rendered depths plus radians of turn",
    )
    length: int = Field(16, ge=2, description="L: views per trajectory, the start included")
    directions: int = Field(32, ge=4, le=32, description="D: equal-area direction bins")
    step_share: float = Field(0.2, gt=0, description="length of a translation, in median rendered depths")
    rotation_deg: float = Field(10.0, gt=0, le=90, description="angle of a turn about the camera itself")
    orbit_deg: float = Field(10.0, gt=0, le=90, description="angle of a turn about the point in view")
    safety_share: float = Field(0.15, ge=0, description="smallest clearance, in median rendered depths")
    visible_weight: float = Field(
        0.02, gt=0, lt=1, description="a Gaussian is seen when its largest T * alpha exceeds this"
    )
    visibility: Visibility = Field(
        "blending",
        description="blending: a Gaussian is seen by its weight in the image, so not behind a fold; frustum: "
        "wherever it projects into the image, as the published code",
    )
    max_hole_share: float = Field(
        0.75,
        gt=0,
        le=1,
        description="a candidate with a larger share of empty pixels is rejected; one without any surface "
        "always is",
    )
    max_saturated_share: float = Field(
        0.2,
        gt=0,
        le=1,
        description="a candidate is rejected when the light that rides on the camera overexposes more",
    )
    score: Literal["error", "pairs"] = Field(
        "error",
        description="what a view is worth. error: error it takes from views off the trajectory, by the "
        "pixels in which they show surface that is missing or was seen with fewer pixels; pairs: newly "
        "covered (Gaussian, direction) pairs, as in the paper",
    )
    probe_views: int = Field(
        512, ge=1, description="score=error: views off the trajectory by which error is measured"
    )
    probe_shift: float = Field(
        1.5, ge=0, description="score=error: largest shift of a probe, in median rendered depths"
    )
    probe_turn_deg: float = Field(180.0, ge=0, le=180, description="score=error: largest turn of a probe")
    sufficient_resolution: float = Field(
        0.4,
        gt=0,
        description="score=error: surface is seen well enough with this share of the pixels that a view off "
        "the trajectory has of it",
    )
    hole_error: float = Field(
        0.24, ge=0, description="score=error: error of an empty pixel that restoring takes away, of 1"
    )
    unresolved_error: float = Field(
        0.08, ge=0, description="score=error: the same of a pixel of surface that was not resolved at all"
    )
    destinations: bool = Field(
        True, description="score=error: propose straight ways to probes besides the fourteen moves"
    )
    min_view_gain: float = Field(
        4e-5,
        ge=0,
        description="score=error: stop when a trajectory takes less error than this, for each of its views, "
        "from views off the trajectory",
    )
    max_training_views: int = Field(
        256, ge=1, description="coverage is measured at so many training views, spread evenly"
    )
    hole_weight: float = Field(
        4.0,
        ge=0,
        description="score=pairs: worth of a voxel where a view through a hole leaves known space, in voxels "
        "of known surface: missing surface has no Gaussians to be covered; 0 is the paper's rule",
    )
    darkness_weight: float = Field(
        0.0, ge=0, description="lambda_l of the illumination weight; 0.5 in the paper; 0 switches it off"
    )
    fold_angle_deg: float = Field(
        25.0,
        gt=0,
        description="tau_R, on the net rotation over the last fold_steps moves: two turns by 20 degrees in "
        "the same direction exceed 25, three by 10 do",
    )
    fold_steps: int = Field(
        3, ge=1, description="moves the net rotation is taken over; 1 is the paper's inter-step rule"
    )
    fold_penalty: float = Field(1.0, gt=0, le=1, description="eta; 0.6 in the paper; 1 switches the term off")
    top_candidates: int = Field(
        14,
        ge=1,
        le=14,
        description="best candidates of an expansion that are kept: the next view, and the rest for the "
        "queue; the paper's code keeps 3",
    )
    max_expansions: int = Field(
        60, ge=1, description="budget of expansions per trajectory; the paper has none: take a large number"
    )
    wave: int = Field(
        3,
        ge=1,
        description="branches that grow from one coverage snapshot; with 1 each trajectory sees the coverage "
        "of all before it, as in the paper",
    )
    wave_kept_share: float = Field(
        0.8,
        ge=0,
        le=1,
        description="a branch to which the others of its wave leave a smaller share of its worth is not "
        "accepted, and grows again",
    )
    min_gain_share: float = Field(
        0.002,
        ge=0,
        description="score=pairs: stop when what a trajectory adds is worth less than this share of all "
        "pairs; 0: when it adds nothing",
    )
    render_width: int = Field(80, ge=16, description="width of the scoring renders in pixels")
    seed: Seed = Field(0, description="seed of the probes")

    @property
    def coverage(self) -> CoverageConfig:
        """The settings of coverage measurement, which `assess` uses as well."""
        return CoverageConfig(
            directions=self.directions,
            visible_weight=self.visible_weight,
            visibility=self.visibility,
            render_width=self.render_width,
        )
