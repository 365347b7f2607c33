"""Errors of the reconstructed surface against the true one: accuracy, completeness, F-score, coverage.

A scene of Gaussians has no mesh of its own. The protocol makes one from any scene in the same way
(`scene_surface`): TSDF fusion of the rendered median depth, at the training and the held-out cameras, with
fixed settings. The true surface is a mesh where the source has geometry, else the fusion of the true depth
of all frames with the same settings (`surface_from_depth`).

Both surfaces are sampled uniformly by area. A part of the true surface counts as *observed* when at least
one training camera sees it, as *unobserved* when held-out cameras alone do; what no camera sees does not
count. A sample of the reconstruction belongs to the part its nearest true point belongs to.

Source: Knapitsch, Park, Zhou, Koltun: Tanks and Temples, ACM TOG 2017, section 4 (precision, recall,
F-score); Seitz et al.: A Comparison and Evaluation of Multi-View Stereo Reconstruction Algorithms, CVPR
2006 (accuracy and completeness).
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import asdict, dataclass
from typing import Any, Literal

import numpy as np
from jaxtyping import Bool, Float, Int
from scipy.spatial import KDTree

from extrags.cameras import Cameras
from extrags.config import SurfaceConfig
from extrags.errors import CaptureError, ConfigError, SourceError
from extrags.frame_quantiles import median_of_frames, quantile_of_frames
from extrags.frame_stacks import frames_of, stacked
from extrags.radial_lens import WIDE_FIELD_DEG
from extrags.scene import Scene
from extrags.sequence import EndoscopicSequence
from extrags.surface import Mesh, fuse_depth, rendered_depth

__all__ = [
    "PROTOCOL_FUSION",
    "SurfaceErrors",
    "SurfaceResult",
    "TrueSurface",
    "distance_to_surface",
    "evaluate_surface",
    "sample_surface",
    "sample_triangles",
    "scene_surface",
    "seen_by",
    "surface_errors",
    "surface_from_depth",
    "surface_from_renders",
]

PROTOCOL_FUSION = SurfaceConfig(
    voxel_share=1 / 96,
    truncation_voxels=5.0,
    min_alpha=0.5,
    depth_quantile=0.98,
    min_cluster_triangles=50,
    max_width=320,
)
"""All values are explicit, so that changed defaults of the surface stage do not change the metrics."""
N_SAMPLES = 30_000
"""Samples of each surface."""
THRESHOLD_MM = 1.0
"""Distance below which a sample counts as correct: about one voxel of the fusion at a distance of 60 mm."""
THRESHOLD_SHARE = 0.05
"""The same where lengths are not millimetres, as a share of the median true depth of training frames; of all
frames where these have none; without any, of the median distance of what is seen from the nearest camera."""
_HIDDEN_SHARE = 0.005
"""Tolerance of the occlusion test, as a share of the distance between camera and point."""
_SEED = 20_260


@dataclass(frozen=True, slots=True)
class SurfaceErrors:
    """Errors of a reconstructed surface against the true one; None where there are no samples.

    Args:
        accuracy_mm: mean distance of reconstructed samples from the true surface.
        accuracy_median_mm: median of that distance, robust to floaters.
        completeness_mm: mean distance of true samples from the reconstructed surface.
        completeness_median_mm: median of that distance, robust to holes.
        precision: share of reconstructed samples closer than the threshold.
        recall: share of true samples closer than the threshold.
        fscore: harmonic mean of precision and recall.
    """

    accuracy_mm: float | None
    accuracy_median_mm: float | None
    completeness_mm: float | None
    completeness_median_mm: float | None
    precision: float | None
    recall: float | None
    fscore: float | None


@dataclass(frozen=True, slots=True)
class TrueSurface:
    """Ground truth of the surface.

    Args:
        mesh: in the world of the sequence.
        kind: `mesh` for the source's own geometry, `depth` for the fusion of its true depth.
    """

    mesh: Mesh
    kind: Literal["mesh", "depth"]


@dataclass(frozen=True, slots=True)
class SurfaceResult:
    """Surface metrics of a scene.

    Args:
        observed: errors on surface that training cameras saw.
        unobserved: errors on surface that held-out cameras alone see.
        coverage: share of all that surface, observed or not, closer than the threshold to the
            reconstruction.
        observed_share: how much of it is observed.
        threshold_mm: the distance threshold.
        kind: kind of the true surface, `mesh` or `depth`.
    """

    observed: SurfaceErrors
    unobserved: SurfaceErrors
    coverage: float | None
    observed_share: float
    threshold_mm: float
    kind: Literal["mesh", "depth"]

    def to_json(self) -> dict[str, Any]:
        """The `surface` group of the metrics: the observed figures, and `unobserved` within."""
        return {
            **asdict(self.observed),
            "coverage": self.coverage,
            "observed_share": self.observed_share,
            "threshold_mm": self.threshold_mm,
            "unobserved": asdict(self.unobserved),
        }


def scene_surface(scene: Scene, sequence: EndoscopicSequence) -> Mesh | None:
    """The surface of a scene, extracted by the rules of the protocol; None when no camera sees a surface.

    Args:
        scene: the reconstruction.
        sequence: provides the training and held-out cameras.
    """
    cameras = sequence.cameras[_all_frames(sequence)]
    return surface_from_renders(*rendered_depth(scene, cameras, PROTOCOL_FUSION))


def surface_from_renders(cameras: Cameras, depth_mm: Float[np.ndarray, "c h w"]) -> Mesh | None:
    """The surface by the rules of the protocol from depth rendered by any representation; None when empty.

    Args:
        cameras: of the training and held-out frames, at the size of the renders.
        depth_mm: median z-depth, 0 where nothing was hit.
    """
    try:
        return _fused(cameras, depth_mm)
    except CaptureError:
        # An empty scene is a result, not a fault of the evaluation: its recall is zero.
        return None


def surface_from_depth(sequence: EndoscopicSequence) -> TrueSurface | None:
    """The true surface from the true depth of all frames; None without poses, depth or surface."""
    if sequence.true_depth_mm is None or sequence.world_from_camera is None:
        return None
    # Fused as reconstructions are: see `extrags.surface.rendered_depth`.
    sequence = sequence.as_pinhole(WIDE_FIELD_DEG)
    frames = _all_frames(sequence)
    true_depth_mm = sequence.true_depth_mm
    if true_depth_mm is None:
        return None
    # Frame by frame: of hundreds of full size, arrays of all at once would be the largest of the run.
    far = _max_fused_depth(sequence)
    depth = stacked(
        (
            np.where(sequence.mask[frame] & (shown <= far) & np.isfinite(shown), shown, 0).astype(np.float32)
            for frame, shown in ((frame, true_depth_mm[frame]) for frame in frames)
        ),
        len(frames),
    )
    try:
        return TrueSurface(fuse_depth(sequence.cameras[frames], depth, FUSED_WHOLE), "depth")
    except CaptureError:
        return None


def evaluate_surface(mesh: Mesh | None, truth: TrueSurface, sequence: EndoscopicSequence) -> SurfaceResult:
    """Surface metrics of a reconstruction, separately for observed and unobserved surface.

    Args:
        mesh: from `scene_surface`, or any mesh in the same world; None for an empty reconstruction, and one
            without area is such.
        truth: the true surface.
        sequence: its cameras and masks define which surface is observed.

    Raises:
        SourceError: for a true surface without area.
        ShapeError: while the poses are unknown.
    """
    points = sample_surface(truth.mesh, N_SAMPLES, seed=_SEED)
    # Its tree is most of what looking at a few thousand points costs.
    true_scene = _ray_scene(truth.mesh)
    # It takes two passes over all depth, which of a long recording is gigabytes.
    far = _max_fused_depth(sequence)
    observed, unobserved = _parts(points, true_scene, sequence, far)
    found = np.zeros((0, 3))
    found_observed = found_unobserved = np.zeros(0, dtype=bool)
    to_truth = np.zeros(0)
    to_mesh = np.full(len(points), np.inf)
    if mesh is not None and _areas(mesh).sum() > 0:
        found = sample_surface(mesh, N_SAMPLES, seed=_SEED + 1)
        to_truth, nearest = _nearest(found, true_scene)
        found_observed, found_unobserved = _parts(nearest, true_scene, sequence, far)
        to_mesh, _ = distance_to_surface(points, mesh)
    threshold = _threshold(sequence, points, observed | unobserved)
    counted = observed | unobserved
    return SurfaceResult(
        observed=_errors(to_truth[found_observed], to_mesh[observed], threshold),
        unobserved=_errors(to_truth[found_unobserved], to_mesh[unobserved], threshold),
        coverage=_share(to_mesh[counted] <= threshold),
        observed_share=_share(observed[counted]) or 0.0,
        threshold_mm=threshold,
        kind=truth.kind,
    )


def surface_errors(
    reconstructed: Mesh, true: Mesh, threshold_mm: float, *, n_samples: int = N_SAMPLES, seed: int = _SEED
) -> SurfaceErrors:
    """Errors of a whole surface against another, regardless of which parts were observed.

    Args:
        reconstructed: the mesh to evaluate; one without area is empty.
        true: the ground-truth mesh; without area nothing is measured.
        threshold_mm: distance below which a sample counts as correct.
        n_samples: samples per mesh.
        seed: seed of the sampling.

    Raises:
        ConfigError: for a threshold or a number of samples that is not positive.
    """
    if not threshold_mm > 0:
        raise ConfigError(f"the threshold is {threshold_mm}; expected a length above zero")
    to_truth = to_mesh = np.zeros(0)
    if _areas(true).sum() > 0 and _areas(reconstructed).sum() > 0:
        to_truth, _ = distance_to_surface(sample_surface(reconstructed, n_samples, seed=seed + 1), true)
        to_mesh, _ = distance_to_surface(sample_surface(true, n_samples, seed=seed), reconstructed)
    elif _areas(true).sum() > 0:
        to_mesh = np.full(n_samples, np.inf)
    return _errors(to_truth, to_mesh, threshold_mm)


def sample_surface(mesh: Mesh, n_samples: int, *, seed: int) -> Float[np.ndarray, "n 3"]:
    """Stratified uniform samples of a mesh: one in each of `n_samples` equal parts of its area.

    Args:
        mesh: with at least one triangle of some area.
        n_samples: number of points.
        seed: seed of the sampling.

    Raises:
        SourceError: for a mesh without area.
        ConfigError: for no samples.
    """
    return sample_triangles(mesh, n_samples, seed=seed)[0]


def sample_triangles(
    mesh: Mesh, n_samples: int, *, seed: int
) -> tuple[Float[np.ndarray, "n 3"], Int[np.ndarray, "n"]]:
    """As `sample_surface`; also the triangle that each point lies in.

    Raises:
        SourceError: as `sample_surface`.
        ConfigError: as `sample_surface`.
    """
    if n_samples < 1:
        raise ConfigError(f"{n_samples} samples of a surface; expected 1 or more")
    area = _areas(mesh)
    total = area.sum()
    if not total > 0:
        raise SourceError(
            f"a surface of {len(mesh.triangles)} triangles without any area cannot be sampled; expected at "
            "least one of some area",
            field="triangles",
        )
    rng = np.random.default_rng(seed)
    place = (np.arange(n_samples) + rng.random(n_samples)) * (total / n_samples)
    triangle = np.minimum(np.searchsorted(np.cumsum(area), place, side="right"), len(area) - 1)
    # Square root: uniform in the triangle, not in the parallelogram's skew (Osada et al. 2002).
    root, along = np.sqrt(rng.random(n_samples)), rng.random(n_samples)
    weights = np.stack([1 - root, root * (1 - along), root * along], axis=1)
    corners = mesh.vertices[mesh.triangles[triangle]].astype(np.float64)
    return np.asarray(np.einsum("nk,nkx->nx", weights, corners)), triangle


def _areas(mesh: Mesh) -> Float[np.ndarray, "t"]:
    """Area of each triangle."""
    corners = mesh.vertices[mesh.triangles].astype(np.float64)
    edges = corners[:, 1:] - corners[:, :1]
    return np.asarray(0.5 * np.linalg.norm(np.cross(edges[:, 0], edges[:, 1]), axis=1))


def distance_to_surface(
    points: Float[np.ndarray, "n 3"], mesh: Mesh
) -> tuple[Float[np.ndarray, "n"], Float[np.ndarray, "n 3"]]:
    """Distance of each point from the nearest triangle, and the nearest point on it."""
    return _nearest(points, _ray_scene(mesh))


def _nearest(
    points: Float[np.ndarray, "n 3"], scene: Any
) -> tuple[Float[np.ndarray, "n"], Float[np.ndarray, "n 3"]]:
    closest = scene.compute_closest_points(_tensor(points.astype(np.float32)))
    nearest = closest["points"].numpy().astype(np.float64)
    return np.linalg.norm(points - nearest, axis=1), nearest


def seen_by(
    points: Float[np.ndarray, "n 3"],
    mesh: Mesh,
    cameras: Cameras,
    mask: Bool[np.ndarray, "c h w"],
    far_mm: float,
) -> Bool[np.ndarray, "n"]:
    """Which points on a mesh are visible in at least one camera.

    Args:
        points: on the mesh.
        mesh: the possible occluder.
        cameras: the views.
        mask: pixels that show tissue.
        far_mm: z-depth beyond which nothing counts as seen.
    """
    return _seen(points, _ray_scene(mesh), cameras, mask, far_mm)


def _seen(
    points: Float[np.ndarray, "n 3"],
    scene: Any,
    cameras: Cameras,
    mask: Bool[np.ndarray, "c h w"],
    far_mm: float,
) -> Bool[np.ndarray, "n"]:
    seen = np.zeros(len(points), dtype=bool)
    for index in range(len(cameras)):
        left = np.flatnonzero(~seen)
        (pixels,), (z,) = cameras[index].project(points[left])
        inside = cameras.contains(pixels) & (z <= far_mm)
        column, row = pixels[inside].astype(np.int64).T
        inside[inside] = mask[index][row, column]
        candidates = left[inside]
        if not candidates.size:
            continue
        rays = np.empty((len(candidates), 6), dtype=np.float32)
        rays[:, :3] = cameras.centers[index]
        rays[:, 3:] = points[candidates] - cameras.centers[index]
        hit = scene.cast_rays(_tensor(rays))["t_hit"].numpy()
        seen[candidates[hit >= 1 - _HIDDEN_SHARE]] = True
    return seen


FUSED_WHOLE = PROTOCOL_FUSION.model_copy(update={"depth_quantile": 1.0})
"""For depth that is cut already: the fusion, which would cut it as well, cannot do with a view that has
nothing near."""


def _fused(cameras: Cameras, depth_mm: Float[np.ndarray, "c h w"]) -> Mesh:
    """Fusion with the protocol's settings."""
    far = quantile_of_frames(lambda: (view[view > 0] for view in depth_mm), PROTOCOL_FUSION.depth_quantile)
    if far is not None:
        depth_mm = stacked((np.where(view > far, np.float32(0), view) for view in depth_mm), len(depth_mm))
    return fuse_depth(cameras, depth_mm, FUSED_WHOLE)


def _parts(
    points: Float[np.ndarray, "n 3"], true_scene: Any, sequence: EndoscopicSequence, far: float
) -> tuple[Bool[np.ndarray, "n"], Bool[np.ndarray, "n"]]:
    """Which true points training cameras see no farther than `far`, and which held-out cameras alone."""

    def by(frames: np.ndarray) -> Bool[np.ndarray, "n"]:
        return _seen(points, true_scene, sequence.cameras[frames], frames_of(sequence.mask, frames), far)

    observed = by(sequence.train)
    return observed, by(sequence.test) & ~observed


def _max_fused_depth(sequence: EndoscopicSequence) -> float:
    """Largest depth that is fused; surface that is only seen from farther away is not evaluated."""
    if sequence.true_depth_mm is None:
        return float("inf")
    depths = _true_depths(sequence, _all_frames(sequence))
    found = quantile_of_frames(depths, PROTOCOL_FUSION.depth_quantile)
    return float("inf") if found is None else found


def _threshold(
    sequence: EndoscopicSequence, points: Float[np.ndarray, "n 3"], seen: Bool[np.ndarray, "n"]
) -> float:
    """Distance below which a sample counts as correct, with true points and which of them cameras see."""
    if sequence.metric:
        return THRESHOLD_MM
    if sequence.true_depth_mm is not None:
        # Held-out frames alone may have depth.
        for frames in (sequence.train, _all_frames(sequence)):
            found = median_of_frames(_true_depths(sequence, frames))
            if found is not None:
                return THRESHOLD_SHARE * found
    # A mesh alone; where no camera sees it, no sample is held against this.
    centers = sequence.cameras[_all_frames(sequence)].centers
    away = KDTree(centers).query(points[seen] if seen.any() else points)[0]
    return THRESHOLD_SHARE * float(np.median(away))


def _true_depths(
    sequence: EndoscopicSequence, frames: Int[np.ndarray, "m"]
) -> Callable[[], Iterator[Float[np.ndarray, "n"]]]:
    """Known depths of one frame after the other, in a sequence that has true depth."""

    def found() -> Iterator[Float[np.ndarray, "n"]]:
        for frame in frames:
            depth = true[frame]
            yield depth[(depth > 0) & np.isfinite(depth) & sequence.mask[frame]]

    assert sequence.true_depth_mm is not None
    true = sequence.true_depth_mm
    return found


def _errors(to_truth: np.ndarray, to_mesh: np.ndarray, threshold: float) -> SurfaceErrors:
    precision, recall = _share(to_truth <= threshold), _share(to_mesh <= threshold)
    fscore = None
    if recall is not None and (precision is not None or recall == 0):
        # Without any reconstructed sample there is no precision, yet the harmonic mean is zero.
        total = (precision or 0.0) + recall
        fscore = 2 * (precision or 0.0) * recall / total if total > 0 else 0.0
    reached = to_mesh[np.isfinite(to_mesh)]
    return SurfaceErrors(
        accuracy_mm=_statistic(np.mean, to_truth),
        accuracy_median_mm=_statistic(np.median, to_truth),
        completeness_mm=_statistic(np.mean, reached),
        completeness_median_mm=_statistic(np.median, reached),
        precision=precision,
        recall=recall,
        fscore=fscore,
    )


def _share(flags: np.ndarray) -> float | None:
    return float(flags.mean()) if flags.size else None


def _statistic(of: Any, values: np.ndarray) -> float | None:
    return float(of(values)) if values.size else None


def _all_frames(sequence: EndoscopicSequence) -> np.ndarray:
    return np.unique(np.concatenate([sequence.train, sequence.test]))


def _ray_scene(mesh: Mesh) -> Any:
    import open3d as o3d

    scene = o3d.t.geometry.RaycastingScene()
    scene.add_triangles(_tensor(mesh.vertices.astype(np.float32)), _tensor(mesh.triangles.astype(np.uint32)))
    return scene


def _tensor(array: np.ndarray) -> Any:
    import open3d as o3d

    return o3d.core.Tensor.from_numpy(np.ascontiguousarray(array))
