"""What views show of the true surface: of what training never saw, and of what it saw badly.

The measure of a search for virtual views. It knows the true surface and is for evaluation alone: no stage of
the pipeline may look at it.

**Denominator.** Samples spread evenly by area over the true surface (`extrags.metrics.surface`), as far as a
camera near the recording could see them: a sample counts when at least one *viewpoint* has it in free sight,
at less than `MAX_INCIDENCE_DEG` from its normal and no farther away than the `FAR_QUANTILE` of all true
distances in the sequence. Viewpoints are the camera centres of all frames, held-out ones included, and
points of the lumen within one median depth of them, which a camera reaches on a straight way and with the
clearance `VIEWPOINT_CLEARANCE_SHARE`. They look in all directions.

**Never seen.** No training camera has the sample in its image, inside the frame's mask, in free sight and at
less than `MAX_INCIDENCE_DEG`.

**Badly seen.** Seen, but not well (`WellSeen`).

Free sight is a ray against the true surface. Nothing depends on a reconstruction.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, fields
from typing import Literal

import numpy as np
from jaxtyping import Bool, Float, Int

from data_catalog.ray_casting import RayCaster
from data_catalog.true_surface import true_surface
from extrags.cameras import Cameras, pixel_rays
from extrags.errors import CaptureError
from extrags.metrics.surface import TrueSurface, sample_triangles
from extrags.observed_surface import never_observed
from extrags.sequence import EndoscopicSequence
from extrags.surface import Mesh

__all__ = ["Seen", "SurfaceCoverage", "SurfaceTruth", "Visible", "WellSeen", "sight_of"]

MAX_INCIDENCE_DEG = 85.0
"""Surface seen under a larger angle from its normal counts as not seen."""
FAR_QUANTILE = 0.98
"""Quantile of the true distances beyond which surface is out of reach; that of the surface metrics."""
VIEWPOINT_CLEARANCE_SHARE = 0.15
"""Smallest clearance of a viewpoint, in median true depths: that of virtual cameras by default."""
VIEWPOINTS_PER_FRAME = 6
MAX_VIEWPOINT_FRAMES = 60
N_SAMPLES = 40_000
MAX_HELD_OUT_PIXELS = 20_000
_SAME_SURFACE_SHARE = 0.05
"""A pixel's ray hits the true surface where the true depth says, up to this share of it."""


@dataclass(frozen=True, slots=True)
class WellSeen:
    """When surface counts as well seen: by two good views from different directions.

    The rule keeps what went with a larger error of a reconstruction, on 67,000 held-out pixels of
    phantom/11@sparse, phantom/11@distanced and phantom/12@distanced (profile quick, one seed): squared error
    against the mean of pixels at the same distance and incidence in the held-out view. The thresholds were
    chosen on these scenes and checked on no others.

    * One training view alone (7 % of the pixels): 3.3 dB worse than the mean; two to six views: 1.0 to 1.6 dB
      better.
    * With two views or more, steepest view under 60 to 70 degrees (2.2 %): 1.5 dB worse; under 70 to 78
      (0.7 %): 3.9 dB. Beyond, there are too few pixels (0.1 %) for a figure.
    * Distance of the nearest view: 3.1 dB worse below 0.8 median depths, which no rule for views could mend;
      from there to 2.5 between 0.2 dB worse and 1.9 dB better. Number of direction cells: 0.4 dB.
    * A wider angle between the views brought nothing once there were two; below 3 degrees are too few pixels
      (1 %) to tell. `min_separation_deg` is therefore a matter of definition, not of measurement.

    Args:
        max_incidence_deg: a view is good up to this angle from the normal.
        max_distance_share: and up to this distance, in median true depths of training frames: beyond, hardly
            any pixel was measured.
        min_separation_deg: the directions to two good views differ by at least so much, so that a camera that
            turns on its place does not count twice.
    """

    max_incidence_deg: float = 65.0
    max_distance_share: float = 3.0
    min_separation_deg: float = 3.0


@dataclass(frozen=True, slots=True)
class Visible:
    """What one camera sees of a set of surface points.

    Args:
        index: of the points it sees, rising, [M].
        distance_mm: of each from the camera, [M].
        incidence_cos: cosine of the angle between the normal and the way to the camera, [M].
        toward: unit vectors from the points to the camera, [M, 3].
    """

    index: Int[np.ndarray, "m"]
    distance_mm: Float[np.ndarray, "m"]
    incidence_cos: Float[np.ndarray, "m"]
    toward: Float[np.ndarray, "m 3"]


@dataclass
class Seen:
    """What a growing set of views has seen of the samples.

    Args:
        rule: when surface counts as well seen.
        unit_mm: unit of its distance.
        seen: by any view, [P].
        good_from: direction to the first good view; zero while there is none, [P, 3].
        well: seen well, [P].
    """

    rule: WellSeen
    unit_mm: float
    seen: Bool[np.ndarray, "p"]
    good_from: Float[np.ndarray, "p 3"]
    well: Bool[np.ndarray, "p"]

    @classmethod
    def nothing(cls, count: int, rule: WellSeen, unit_mm: float) -> Seen:
        """Before the first view."""
        none = np.zeros(count, dtype=bool)
        return cls(rule, unit_mm, none, np.zeros((count, 3)), none.copy())

    def copy(self) -> Seen:
        """An independent copy."""
        return Seen(self.rule, self.unit_mm, self.seen.copy(), self.good_from.copy(), self.well.copy())

    def good(self, visible: Visible) -> Bool[np.ndarray, "m"]:
        """Which of the samples a view sees it sees well enough to count."""
        return np.asarray(
            (visible.distance_mm <= self.rule.max_distance_share * self.unit_mm)
            & (visible.incidence_cos >= np.cos(np.radians(self.rule.max_incidence_deg)))
        )

    def news(self, visible: Visible) -> tuple[Bool[np.ndarray, "m"], Bool[np.ndarray, "m"]]:
        """Which samples a further view would be the first good one of, and which it would make well seen."""
        before = self.good_from[visible.index]
        good, first = self.good(visible), ~before.any(axis=1)
        # Against the first good view alone, not all pairs: of three views the angle may be missed by a factor
        # of two, which is nothing beside the arbitrariness of the threshold.
        apart = np.einsum("mk,mk->m", before, visible.toward) <= np.cos(
            np.radians(self.rule.min_separation_deg)
        )
        return good & first, good & ~first & apart & ~self.well[visible.index]

    def add(self, visible: Visible) -> None:
        """Count one more view."""
        first, second = self.news(visible)
        self.seen[visible.index] = True
        self.well[visible.index[second]] = True
        self.good_from[visible.index[first]] = visible.toward[first]


@dataclass(frozen=True)
class SurfaceCoverage:
    """What a list of views adds, cumulative: entry v is after the first v views, entry 0 without any.

    All are shares of 0 to 1; NaN where there is nothing that could be seen.

    Args:
        never_seen: share of the never-seen area that the views see, [V + 1].
        never_seen_well: share of it that they see well, [V + 1].
        badly_seen: share of the badly-seen area that is well seen from training and virtual views together,
            [V + 1].
        held_out: share of the never-observed pixels of held-out frames whose surface the views see, [V + 1].
    """

    never_seen: Float[np.ndarray, "v"]
    never_seen_well: Float[np.ndarray, "v"]
    badly_seen: Float[np.ndarray, "v"]
    held_out: Float[np.ndarray, "v"]

    def __len__(self) -> int:
        """V, the number of views."""
        return len(self.never_seen) - 1

    def after(self, n_views: int) -> dict[str, float]:
        """The shares after so many views, by name; after all where there are fewer."""
        row = min(n_views, len(self))
        return {item.name: float(getattr(self, item.name)[row]) for item in fields(self)}


@dataclass(frozen=True)
class SurfaceTruth:
    """The true surface of a sequence, in samples of equal area, and what training saw of it.

    Args:
        points: the samples that a camera near the recording could see, [P, 3].
        normals: unit normals into the lumen, [P, 3].
        area_mm2: area that one sample stands for.
        reachable_share: share of all of the true surface that the samples stand for.
        training: what the training cameras see of them.
        held_out_points: surface at never-observed pixels of held-out frames, [Q, 3].
        held_out_normals: its unit normals, [Q, 3].
        unit_mm: median true depth of the training frames.
        kind: `mesh` for the source's own geometry, `depth` for the fusion of its true depth.
        rays: rays against the surface.
        mesh: the surface.
    """

    points: Float[np.ndarray, "p 3"]
    normals: Float[np.ndarray, "p 3"]
    area_mm2: float
    reachable_share: float
    training: Seen
    held_out_points: Float[np.ndarray, "q 3"]
    held_out_normals: Float[np.ndarray, "q 3"]
    unit_mm: float
    kind: Literal["mesh", "depth"]
    rays: RayCaster
    mesh: Mesh

    @property
    def never_seen(self) -> Bool[np.ndarray, "p"]:
        """Samples that no training camera sees."""
        return np.asarray(~self.training.seen)

    @property
    def badly_seen(self) -> Bool[np.ndarray, "p"]:
        """Samples that training cameras see, but not well."""
        return np.asarray(self.training.seen & ~self.training.well)

    @classmethod
    def of(
        cls,
        sequence: EndoscopicSequence,
        seed: int = 0,
        *,
        rule: WellSeen | None = None,
        n_samples: int = N_SAMPLES,
        surface: TrueSurface | None = None,
    ) -> SurfaceTruth:
        """Sample the true surface of a sequence and look at it through the training cameras.

        Args:
            sequence: all frames, held-out ones included, as the source has them.
            seed: of the samples and the viewpoints.
            rule: when surface counts as well seen; None takes the defaults.
            n_samples: samples of all of the surface, out of reach or not.
            surface: the true surface; None takes `true_surface`.

        Raises:
            CaptureError: where the sequence has no true surface or no true depth, or none of it can be seen.
            ShapeError: while the poses are unknown.
        """
        rule = WellSeen() if rule is None else rule
        truth = true_surface(sequence) if surface is None else surface
        depth = sequence.true_depth_mm
        if truth is None or depth is None:
            raise CaptureError(
                f"{sequence.name} has no true surface: neither geometry nor true depth of its frames"
            )
        rng = np.random.default_rng([seed, 0x5EE])
        rays = RayCaster(truth.mesh.vertices, truth.mesh.triangles)
        unit_mm = float(np.median(_known(depth, sequence.mask, sequence.train)))
        frames = np.concatenate([sequence.train, sequence.test])
        # Along the rays, as what is compared with it: towards the corners of an image z-depth is shorter.
        distance = np.zeros_like(depth)
        for frame in frames:
            distance[frame] = depth[frame] * np.linalg.norm(
                pixel_rays(sequence.cameras[int(frame)])[0], axis=-1
            )
        far_mm = float(np.quantile(_known(distance, sequence.mask, frames), FAR_QUANTILE))
        normals = _triangle_normals(truth.mesh)

        points, triangle = sample_triangles(truth.mesh, n_samples, seed=seed)
        eyes = _viewpoints(rays, sequence.cameras[frames].centers, unit_mm, rng)
        reachable = _in_sight_of(rays, points, normals[triangle], eyes, far_mm)
        if not reachable.any():
            raise CaptureError(f"{sequence.name}: no camera near the recording sees any true surface")
        held_out_points, held_out_triangle = _unobserved_surface(rays, sequence, depth, rng)
        self = cls(
            points=points[reachable],
            normals=normals[triangle[reachable]],
            area_mm2=_area_mm2(truth.mesh) / n_samples,
            reachable_share=float(reachable.mean()),
            training=Seen.nothing(int(reachable.sum()), rule, unit_mm),
            held_out_points=held_out_points,
            held_out_normals=normals[held_out_triangle],
            unit_mm=unit_mm,
            kind=truth.kind,
            rays=rays,
            mesh=truth.mesh,
        )
        for frame in sequence.train:
            self.training.add(self.visible(sequence.cameras[int(frame)], sequence.mask[frame]))
        return self

    def visible(self, camera: Cameras, mask: Bool[np.ndarray, "h w"] | None = None) -> Visible:
        """What a camera sees of the samples.

        Args:
            camera: the view, a batch of one.
            mask: its valid pixels; None is all of the image.
        """
        return sight_of(self.rays, self.points, self.normals, camera, mask)

    def measure(self, cameras: Cameras | Sequence[Cameras]) -> SurfaceCoverage:
        """What virtual views add to the training views, view by view.

        Args:
            cameras: the views in order, or batches of them (e.g. one per trajectory), without real ones.
        """
        batches = [cameras] if isinstance(cameras, Cameras) else list(cameras)
        never, badly = self.never_seen, self.badly_seen
        seen = self.training.copy()
        served = np.zeros(len(self.held_out_points), dtype=bool)
        rows = [[0.0, 0.0, 0.0, 0.0]]
        for camera in (batch[index] for batch in batches for index in range(len(batch))):
            seen.add(self.visible(camera))
            left = np.flatnonzero(~served)
            points, normals = self.held_out_points[left], self.held_out_normals[left]
            served[left[sight_of(self.rays, points, normals, camera).index]] = True
            found = (seen.seen[never], seen.well[never], seen.well[badly], served)
            rows.append([float(np.count_nonzero(part)) for part in found])
        total = np.array([never.sum(), never.sum(), badly.sum(), len(served)], dtype=np.float64)
        shares = np.array(rows) / np.where(total > 0, total, np.nan)
        return SurfaceCoverage(*np.ascontiguousarray(shares.T))


def sight_of(
    rays: RayCaster,
    points: Float[np.ndarray, "n 3"],
    normals: Float[np.ndarray, "n 3"],
    camera: Cameras,
    mask: Bool[np.ndarray, "h w"] | None = None,
) -> Visible:
    """What a camera sees of points on a surface: in its image, in free sight and not grazing.

    Args:
        rays: against the surface.
        points: on the surface, [N, 3].
        normals: unit normals on the side of free space, [N, 3].
        camera: the view, a batch of one.
        mask: its valid pixels; None is all of the image.
    """
    center = camera.centers[0]
    toward = center - points
    distance = np.sqrt(np.einsum("nk,nk->n", toward, toward))
    cosine = np.einsum("nk,nk->n", toward, normals) / np.maximum(distance, 1e-12)
    facing = np.flatnonzero(cosine > np.cos(np.radians(MAX_INCIDENCE_DEG)))
    (pixels,), _ = camera.project(points[facing])
    inside = camera.contains(pixels)
    if mask is not None:
        column, row = pixels[inside].astype(np.int64).T
        inside[inside] = mask[row, column]
    index = facing[inside]
    index = index[rays.reaches(center, -toward[index])] if len(index) else index
    return Visible(index, distance[index], cosine[index], toward[index] / distance[index][:, None])


def _in_sight_of(
    rays: RayCaster,
    points: Float[np.ndarray, "n 3"],
    normals: Float[np.ndarray, "n 3"],
    eyes: Float[np.ndarray, "e 3"],
    far_mm: float,
) -> Bool[np.ndarray, "n"]:
    """Which points any of the eyes, looking everywhere, has in free sight."""
    found = np.zeros(len(points), dtype=bool)
    for eye in eyes:
        left = np.flatnonzero(~found)
        toward = eye - points[left]
        distance = np.linalg.norm(toward, axis=1)
        cosine = np.einsum("nk,nk->n", toward, normals[left]) / np.maximum(distance, 1e-12)
        near = (cosine > np.cos(np.radians(MAX_INCIDENCE_DEG))) & (distance <= far_mm)
        if near.any():
            found[left[near]] = rays.reaches(eye, -toward[near])
    return found


def _viewpoints(
    rays: RayCaster, centers: Float[np.ndarray, "f 3"], unit_mm: float, rng: np.random.Generator
) -> Float[np.ndarray, "e 3"]:
    """Camera centres, evenly thinned, and points of the lumen within `unit_mm` of them, [E, 3]."""
    kept = np.linspace(0, len(centers) - 1, min(len(centers), MAX_VIEWPOINT_FRAMES)).round().astype(int)
    offset = rng.normal(size=(len(kept), VIEWPOINTS_PER_FRAME, 3))
    # The cube root spreads the points evenly over the ball.
    radius = unit_mm * np.cbrt(rng.random((len(kept), VIEWPOINTS_PER_FRAME, 1)))
    offset *= radius / np.linalg.norm(offset, axis=-1, keepdims=True)
    found = [centers[kept]]
    for center, around in zip(centers[kept], offset, strict=True):
        # `reaches` stops short of its aim: what is cast is a little longer than the way.
        clear = rays.clearance_mm(center + around) >= VIEWPOINT_CLEARANCE_SHARE * unit_mm
        found.append((center + around)[clear & rays.reaches(center, 1.01 * around)])
    return np.concatenate(found)


def _unobserved_surface(
    rays: RayCaster,
    sequence: EndoscopicSequence,
    depth_mm: Float[np.ndarray, "f h w"],
    rng: np.random.Generator,
) -> tuple[Float[np.ndarray, "q 3"], Int[np.ndarray, "q"]]:
    """Points and triangles of the surface at never-observed pixels of held-out frames.

    Pixels whose ray misses the true surface, or hits it elsewhere than the true depth says, are left out.
    At most `MAX_HELD_OUT_PIXELS`, drawn evenly from all.
    """
    points, triangles = [np.zeros((0, 3))], [np.zeros(0, dtype=np.int64)]
    if sequence.observed is not None:
        for frame in sequence.test:
            known = (depth_mm[frame] > 0) & np.isfinite(depth_mm[frame])
            chosen = known & never_observed(sequence, int(frame))
            camera = sequence.cameras[int(frame)]
            along = pixel_rays(camera)[0][chosen]
            hits = rays.cast(camera.centers[0], along)
            true = depth_mm[frame][chosen]
            same = np.abs(hits.distance - true) <= _SAME_SURFACE_SHARE * true
            points.append(camera.centers[0] + along[same] * hits.distance[same][:, None].astype(np.float64))
            triangles.append(hits.triangle[same])
    point, triangle = np.concatenate(points), np.concatenate(triangles)
    if len(point) > MAX_HELD_OUT_PIXELS:
        kept = np.sort(rng.choice(len(point), MAX_HELD_OUT_PIXELS, replace=False))
        point, triangle = point[kept], triangle[kept]
    return point, triangle


def _known(
    depth_mm: Float[np.ndarray, "f h w"], mask: Bool[np.ndarray, "f h w"], frames: Int[np.ndarray, "n"]
) -> Float[np.ndarray, "k"]:
    depth = depth_mm[frames]
    found = depth[(depth > 0) & np.isfinite(depth) & mask[frames]]
    if found.size == 0:
        raise CaptureError("none of the training frames has true depth; there is no scale to measure by")
    return np.asarray(found)


def _triangle_normals(mesh: Mesh) -> Float[np.ndarray, "t 3"]:
    """Unit normals on the side of free space; zero where a triangle has no area."""
    a, b, c = mesh.vertices.astype(np.float64)[mesh.triangles].transpose(1, 0, 2)
    normal = np.cross(b - a, c - a)
    return np.asarray(normal / np.maximum(np.linalg.norm(normal, axis=1, keepdims=True), 1e-12))


def _area_mm2(mesh: Mesh) -> float:
    a, b, c = mesh.vertices.astype(np.float64)[mesh.triangles].transpose(1, 0, 2)
    return float(0.5 * np.linalg.norm(np.cross(b - a, c - a), axis=1).sum())
