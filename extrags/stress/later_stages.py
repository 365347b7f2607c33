"""Rows of the stages after carving: assessment, exploration, fine-tuning and its judge."""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import replace
from functools import partial
from typing import Any

import numpy as np
import torch

from extrags.assessment import assess
from extrags.config import AssessConfig, EnhanceConfig, PipelineConfig
from extrags.exploration import explore
from extrags.finetuning_judge import judge_finetuning
from extrags.freespace import FreeSpace, carve
from extrags.pseudo_views import PseudoViews
from extrags.scene import Scene
from extrags.scene_plan import ScenePlan
from extrags.stress.faulty_recordings import displaced, faulty_poses
from extrags.stress.inputs import FARTHEST_OFFSET_MM, IMAGES, SCALES, TURN, image
from extrags.stress.repeats import COARSE, EXPLORE, FINETUNE, FREESPACE
from extrags.stress.rows import EPS, FINITE, Effort, Row, Trial, all_finite, finite_or_refused, only_refused
from extrags.stress.training import LEVELS
from extrags.stress.tube import FOCAL_SHARE, Tube, tube
from extrags.training import finetune

__all__ = ["ROWS"]

PLAN = PipelineConfig(assess=AssessConfig(probe_views=24), explore=EXPLORE)
FLIPPED = 1e-3
"""Share of pixels that may come to lie on the other side of a threshold by rounding."""
UNIT_MM = 20.0
WITHOUT_ENHANCER = EnhanceConfig(backend="classical")


def _worlds() -> Iterator[tuple[str, float, Tube]]:
    """The tube in other units, places and directions, and by how many pixels its points are rounded there."""
    for unit in SCALES:
        yield f"times {unit:g}", 0.0, tube(unit=unit)
    for offset in (1e2, 1e4, FARTHEST_OFFSET_MM):
        # Half a unit in the last place of each coordinate, seen from a radius away.
        rounding = math.sqrt(3) * 0.5 * EPS * offset / UNIT_MM * FOCAL_SHARE * EXPLORE.render_width
        yield f"{offset:g} from the origin", rounding, tube(unit=UNIT_MM, offset_mm=offset)
    yield "turned", 0.0, tube(turn=TURN)


def _carved_like(space: FreeSpace, room: Tube) -> FreeSpace:
    """Free space of the tube at the origin, moved to where another is: its voxels cut the wall as there."""
    here, there = (each.cameras.world_from_camera for each in (tube(), room))
    unit = _way(there) / _way(here)
    turn = there[0, :3, :3] @ here[0, :3, :3].T
    return replace(
        space,
        origin_mm=there[0, :3, 3] + unit * turn @ (space.origin_mm - here[0, :3, 3]),
        axes=space.axes @ turn.T,
        voxel_mm=unit * space.voxel_mm,
        clearance=(unit * space.clearance).astype(np.float32),
    )


def _way(poses: np.ndarray) -> float:
    return float(np.linalg.norm(poses[-1, :3, 3] - poses[0, :3, 3]))


def _explored(effort: Effort) -> Iterator[Trial]:
    """Change of the removable error, and of what trajectories take of it, over what pixels may change."""
    here = tube()
    space = carve(here.scene, here.mesh, here.cameras, FREESPACE)
    base = explore(here.scene, here.sequence, EXPLORE, freespace=space)
    for place, rounding_px, room in _worlds():
        found = explore(room.scene, room.sequence, EXPLORE, freespace=_carved_like(space, room))
        allowed = FLIPPED + rounding_px
        yield f"{place}, to be removed", abs(found.removable_error / base.removable_error - 1) / allowed
        yield f"{place}, removed", abs(found.values.sum() / base.values.sum() - 1) / allowed


def _explored_extremes(effort: Effort) -> Iterator[Trial]:
    room = tube()
    space = carve(room.scene, room.mesh, room.cameras, FREESPACE)
    for name, scene in _extreme_scenes(room).items():
        yield name, finite_or_refused(partial(explore, scene, room.sequence, EXPLORE, freespace=space))
    for name, other in _extreme_recordings(room).items():
        yield (
            name,
            finite_or_refused(partial(explore, room.scene, other.sequence, EXPLORE, freespace=space)),
        )


def _extreme_scenes(room: Tube) -> dict[str, Scene]:
    gaussians, light = room.scene.gaussians, room.scene.light
    first = torch.arange(len(gaussians)) < 1
    faint, solid, needles = (gaussians.subset(~first) for _ in range(3))
    faint.opacities.fill_(-12.0)
    solid.opacities.fill_(15.0)
    needles.scales[:, 0] += math.log(1e3)
    return {
        "no Gaussians": Scene(gaussians.subset(first & ~first), light),
        "one Gaussian": Scene(gaussians.subset(first), light),
        "invisible": Scene(faint, light),
        "opaque": Scene(solid, light),
        "needles": Scene(needles, light),
        "no light": Scene(gaussians, None),
    }


def _extreme_recordings(room: Tube) -> dict[str, Tube]:
    poses = room.sequence.cameras.world_from_camera
    found = {name: room.with_poses(said) for name, said in faulty_poses(poses, 1.0).items()}
    found |= {
        f"poses off by {error:g}": room.with_poses(displaced(poses, error, 1.0)) for error in (1e-2, 0.3)
    }
    empty = replace(room.sequence, mask=np.zeros_like(room.sequence.mask))
    found["empty masks"] = replace(room, sequence=empty)
    for size in ((1, 1), (1, 9), (9, 1)):
        found[f"{size[0]}x{size[1]} pixels"] = tube(size=size)
    found["one frame"] = tube(frames=1)
    return found


def _assessed(effort: Effort) -> Iterator[Trial]:
    """Change of shares of pixels over what may change; infinite where the plan is another."""
    here = tube()
    base = assess(here.scene, here.sequence, PLAN)
    for place, rounding_px, room in _worlds():
        found = assess(room.scene, room.sequence, PLAN)
        for name in ("lacking_share", "hole_share", "unresolved_share", "training_hole_share"):
            change = abs(found.measurements[name] - base.measurements[name])
            yield f"{place}, {name}", change / (FLIPPED + rounding_px)
        yield f"{place}, plan", 0.0 if _decided(found) == _decided(base) else math.inf


def _decided(plan: ScenePlan) -> list[Any]:
    return [(line.stage, line.run, line.budget) for line in plan.decisions]


def _assessed_extremes(effort: Effort) -> Iterator[Trial]:
    room = tube()
    for name, scene in _extreme_scenes(room).items():
        yield name, finite_or_refused(partial(_measurements, scene, room))
    for name, other in _extreme_recordings(room).items():
        yield name, finite_or_refused(partial(_measurements, room.scene, other))
    empty = _extreme_scenes(room)["no Gaussians"]
    yield "no Gaussians, refused", only_refused(partial(_measurements, empty, room))


def _measurements(scene: Scene, room: Tube) -> dict[str, float]:
    return assess(scene, room.sequence, PLAN).measurements


def _torn(room: Tube) -> Scene:
    """The scene without a part of its wall."""
    gaussians = room.scene.gaussians
    count = round(math.sqrt(len(gaussians)))
    along, around = np.divmod(np.arange(len(gaussians)), count)
    torn = (along > 0.45 * count) & (along < 0.75 * count) & (around < 0.3 * count)
    return Scene(gaussians.subset(torch.from_numpy(~torn)), room.scene.light)


def _exact_views(room: Tube, scene: Scene) -> PseudoViews:
    """Virtual views of a torn scene, restored to what the whole one shows."""
    cameras = room.cameras
    with torch.no_grad():
        now, whole = (each.render(cameras) for each in (scene, room.scene))
    rendered, restored = (each.rgb.clamp(0, 1).numpy() for each in (now, whole))
    alpha = now.alpha.numpy()
    return PseudoViews(
        cameras=cameras,
        rendered=rendered,
        restored=restored,
        target=restored,
        alpha=alpha,
        depth_mm=whole.depth.numpy(),
        uncertainty=1 - alpha.clip(0, 1),
        pixel_confidence=np.ones_like(alpha),
        image_confidence=np.ones(len(cameras), np.float32),
        reference=np.zeros(len(cameras), np.int64),
        clip=np.zeros(len(cameras), np.int64),
    ).quantised()


def _filled_error(room: Tube) -> tuple[float, int]:
    """Error of the fine-tuned scene in its virtual views, in levels, and how many Gaussians it has."""
    torn = _torn(room)
    views = _exact_views(room, torn)
    found = finetune(torn, room.sequence, views, FINETUNE.model_copy(update={"iterations": 60}), COARSE).scene
    with torch.no_grad():
        shown = found.render(views.cameras).rgb.clamp(0, 1).numpy()
    return LEVELS * float(np.sqrt(np.square(shown - views.target).mean())), len(found.gaussians)


def _tuned(effort: Effort) -> Iterator[Trial]:
    base, seeded = _filled_error(tube())
    if seeded <= len(_torn(tube()).gaussians):
        yield "no Gaussian for a hole", math.inf
    for place, _, room in _worlds():
        yield place, abs(_filled_error(room)[0] - base)


def _tuned_extremes(effort: Effort) -> Iterator[Trial]:
    room = tube()
    torn = _torn(room)
    exact = _exact_views(room, torn)

    def tuned(views: PseudoViews | None, scene: Scene = torn, other: Tube = room) -> dict[str, torch.Tensor]:
        return finetune(scene, other.sequence, views, FINETUNE, COARSE).scene.gaussians.parameters()

    for kind in IMAGES:
        shown = image(kind, *exact.target.shape).numpy()
        yield kind, finite_or_refused(partial(tuned, replace(exact, restored=shown, target=shown)))
    for name, value in {"zero": 0.0, "tiny": 1e-30, "near": 1e-3, "far": 1e30}.items():
        depth = np.full_like(exact.depth_mm, value)
        yield f"{name} depth", finite_or_refused(partial(tuned, replace(exact, depth_mm=depth)))
    step = np.where(np.arange(exact.depth_mm.shape[-1]) % 2, 1.0, 1e3).astype(np.float32)
    stepped = np.broadcast_to(step, exact.depth_mm.shape).copy()
    yield "steps of depth", finite_or_refused(partial(tuned, replace(exact, depth_mm=stepped)))
    nothing = np.zeros_like(exact.alpha)
    yield "views of nothing", finite_or_refused(partial(tuned, replace(exact, alpha=nothing)))
    without = replace(exact, pixel_confidence=nothing, image_confidence=np.zeros_like(exact.image_confidence))
    yield "no confidence", finite_or_refused(partial(tuned, without))
    yield "no virtual view", finite_or_refused(partial(tuned, None))
    for name, scene in _extreme_scenes(room).items():
        yield name, finite_or_refused(partial(tuned, exact, scene))
    for name, other in _extreme_recordings(room).items():
        yield name, finite_or_refused(partial(tuned, None, room.scene, other))


def _judged_extremes(effort: Effort) -> Iterator[Trial]:
    def judged(room: Tube, scene: Scene | None = None) -> Any:
        scene = room.scene if scene is None else scene
        return judge_finetuning(scene, room.sequence, (), None, FINETUNE, WITHOUT_ENHANCER, COARSE)

    room = tube()
    for kind in IMAGES:
        shown = np.rint(255 * image(kind, *room.sequence.rgb.shape).numpy()).astype(np.uint8)
        other = replace(room, sequence=replace(room.sequence, rgb=shown))
        yield kind, finite_or_refused(partial(judged, other))
    for name, scene in _extreme_scenes(room).items():
        yield name, finite_or_refused(partial(judged, room, scene))
    for name, other in _extreme_recordings(room).items():
        yield name, finite_or_refused(partial(judged, other))
    for frames in (1, 2, 3, 4, 5):
        yield f"{frames} frames", 0.0 if all_finite(judged(tube(frames=frames))) else math.inf


def _rows() -> Iterator[Row]:
    pixels = "relative change, over a thousandth and what rounding moves points"
    yield Row(
        "assessment",
        "scale 1e-3 to 1e4, offset to 1e5, rotation",
        "change of shares of pixels, over a thousandth and what rounding moves points",
        1.0,
        _assessed,
    )
    finite = "measurements not finite"
    yield Row("assessment", "extreme scenes and recordings", finite, FINITE, _assessed_extremes)
    yield Row("exploration", "scale 1e-3 to 1e4, offset to 1e5, rotation", pixels, 1.0, _explored)
    finite = "trajectories not finite"
    yield Row("exploration", "extreme scenes and recordings", finite, FINITE, _explored_extremes)
    yield Row(
        "fine-tuning",
        "scale 1e-3 to 1e4, offset to 1e5, rotation",
        "change of the error, in levels of 8 bits",
        1.0,
        _tuned,
    )
    yield Row(
        "fine-tuning", "extreme views, scenes, recordings", "scenes not finite", FINITE, _tuned_extremes
    )
    yield Row("judge", "extreme images, scenes, recordings", "trials not finite", FINITE, _judged_extremes)


ROWS = tuple(_rows())
