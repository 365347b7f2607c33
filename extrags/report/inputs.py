"""Inputs of a report: plain data; the report opens no files and computes no results."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, Protocol, runtime_checkable

import numpy as np
from jaxtyping import Float, Int

from extrags.cameras import Cameras
from extrags.config import PipelineConfig
from extrags.errors import ShapeError
from extrags.scene import Scene
from extrags.sequence import EndoscopicSequence

__all__ = ["DepthLike", "GridLike", "MeshLike", "PseudoLike", "RendersLike", "ReportInputs"]


@runtime_checkable
class RendersLike(Protocol):
    """Held-out views as rendered: `extrags.metrics.protocol.RenderedViews` or the like."""

    @property
    def rgb(self) -> np.ndarray:
        """Colours, uint8 or float in [0, 1], [T, H, W, 3]."""
        ...

    @property
    def depth_mm(self) -> np.ndarray:
        """Expected z-depth, [T, H, W]."""
        ...

    @property
    def alpha(self) -> np.ndarray:
        """Opacity, [T, H, W]."""
        ...


@runtime_checkable
class DepthLike(Protocol):
    """Estimated depth of the training frames: `extrags.depth.estimate.DepthEstimate`."""

    @property
    def depth(self) -> np.ndarray:
        """z-depth, 0 outside the mask, [M, H, W]."""
        ...

    @property
    def expected_error(self) -> np.ndarray:
        """Expected relative error of it, [M, H, W]."""
        ...

    @property
    def report(self) -> Mapping[str, Any]:
        """Facts on each cue."""
        ...


@runtime_checkable
class PseudoLike(Protocol):
    """Virtual views before and after restoration: `extrags.pseudo_views.PseudoViews`."""

    @property
    def rendered(self) -> np.ndarray:
        """Renders of the coarse scene, uint8 or float in [0, 1], [V, H, W, 3]."""
        ...

    @property
    def restored(self) -> np.ndarray:
        """What the enhancer made of them, [V, H, W, 3]."""
        ...

    @property
    def target(self) -> np.ndarray:
        """What the fine-tuning sees: restored where unknown, rendered where known, [V, H, W, 3]."""
        ...

    @property
    def uncertainty(self) -> np.ndarray:
        """0 known, 1 unknown, [V, H, W]."""
        ...

    @property
    def expected_error(self) -> np.ndarray | None:
        """Absolute error of the restored colours as the enhancer expects it, [V, H, W]; None without."""
        ...

    @property
    def image_confidence(self) -> np.ndarray:
        """Weight of each view, [V]."""
        ...

    @property
    def reference(self) -> np.ndarray:
        """Frame of the sequence each view was restored with, [V]."""
        ...

    @property
    def clip(self) -> np.ndarray:
        """Index of the clip each view belongs to, [V]."""
        ...

    @property
    def provenance(self) -> Mapping[str, Any]:
        """Backend, steps, and how it was judged on left-out frames; JSON types."""
        ...


@runtime_checkable
class GridLike(Protocol):
    """The occupancy grid: `extrags.freespace.FreeSpace`."""

    @property
    def occupancy(self) -> np.ndarray:
        """0 free, 1 occupied, 2 unknown, uint8, [S, S, S]."""
        ...

    @property
    def clearance(self) -> np.ndarray:
        """Distance of each voxel's centre from what is not free, negative inside it, [S, S, S]."""
        ...

    @property
    def origin_mm(self) -> np.ndarray:
        """Corner of voxel (0, 0, 0), [3]."""
        ...

    @property
    def axes(self) -> np.ndarray:
        """Rows are the grid's unit axes in world coordinates, [3, 3]."""
        ...

    @property
    def voxel_mm(self) -> float:
        """Edge of a voxel."""
        ...


@runtime_checkable
class MeshLike(Protocol):
    """A triangle mesh: `extrags.surface.Mesh`."""

    @property
    def vertices(self) -> np.ndarray:
        """Positions, [V, 3]."""
        ...

    @property
    def triangles(self) -> np.ndarray:
        """Vertex indices, [T, 3]."""
        ...


@dataclass(frozen=True)
class ReportInputs:
    """Everything a page can show of one sequence; what is None is left out, with a sentence saying why.

    Args:
        name: of the sequence, e.g. `phantom/3@sparse`; of a path its last part.
        sequence: frames, poses, masks, split.
        held_out: frames that were rendered, in that order; None means the test split.
        coarse: held-out views rendered from the coarse scene.
        final: the same from the fine-tuned scene.
        restored: the final scene's views, restored in the image.
        coarse_metrics: `EvaluationResult.to_json()` of the coarse scene: `metrics`, `per_view`,
            `reasons`, `protocol`.
        final_metrics: the same of the fine-tuned scene.
        restored_metrics: the same of its views restored in the image.
        depth: depth of the training frames that was estimated from images.
        pseudo: virtual views before and after restoration.
        virtual_cameras: of `pseudo`, in its order.
        coarse_scene: Gaussians of the coarse scene, for the viewer.
        final_scene: the same of the fine-tuned scene.
        trajectories: camera-to-world poses of each virtual trajectory, its real start first, [L, 4, 4].
        exploration: `Exploration.summary()`.
        grid: occupancy.
        mesh: surface.
        plan: `ScenePlan.model_dump()`: `measurements` and `decisions`.
        stages: `{stage, state, seconds, reason}` in the order they ran; state is ran, cached, skipped or
            failed. A cached stage may say in `made_seconds` what it took when it ran.
        history: training curves by stage, each a list of `{iteration, loss, psnr, n_gaussians}`.
        environment: machine and software versions, by name.
        config: the settings of the run.
        profile: name of the profile they started from.
        made: when the report was made, in words; nothing is said when empty.
        absent: why a part is missing, by name (`final`, `pseudo`, `trajectories`, `grid`, `mesh`, ...);
            overrides what the plan and the stages say.
        without_pose: numbers of training and of held-out frames that left the sequence for want of a pose.

    Raises:
        ShapeError: when renders and held-out frames do not fit each other.
    """

    name: str
    sequence: EndoscopicSequence
    held_out: Int[np.ndarray, "t"] | None = None
    coarse: RendersLike | None = None
    final: RendersLike | None = None
    restored: RendersLike | None = None
    coarse_metrics: Mapping[str, Any] | None = None
    final_metrics: Mapping[str, Any] | None = None
    restored_metrics: Mapping[str, Any] | None = None
    depth: DepthLike | None = None
    pseudo: PseudoLike | None = None
    virtual_cameras: Cameras | None = None
    coarse_scene: Scene | None = None
    final_scene: Scene | None = None
    trajectories: Sequence[Float[np.ndarray, "_ 4 4"]] = ()
    exploration: Mapping[str, Any] | None = None
    grid: GridLike | None = None
    mesh: MeshLike | None = None
    plan: Mapping[str, Any] | None = None
    stages: Sequence[Mapping[str, Any]] = ()
    history: Mapping[str, Sequence[Mapping[str, Any]]] = field(default_factory=dict)
    environment: Mapping[str, str] = field(default_factory=dict)
    config: PipelineConfig | None = None
    profile: str = ""
    made: str = ""
    absent: Mapping[str, str] = field(default_factory=dict)
    without_pose: tuple[int, int] = (0, 0)

    def __post_init__(self) -> None:
        frames = self.frames
        expected = (len(frames), self.sequence.height, self.sequence.width, 3)
        for name, renders in (
            ("coarse", self.coarse),
            ("final", self.final),
            ("restored", self.restored),
        ):
            if renders is not None and renders.rgb.shape != expected:
                raise ShapeError(
                    f"{self.name}: {name} renders have shape {renders.rgb.shape}, expected {expected} "
                    f"for {len(frames)} held-out frames"
                )
        shape = (len(self.sequence.train), self.sequence.height, self.sequence.width)
        if self.depth is not None and self.depth.depth.shape != shape:
            raise ShapeError(
                f"{self.name}: estimated depth has shape {self.depth.depth.shape}, expected {shape} for "
                f"{shape[0]} training frames"
            )
        for name, metrics in (
            ("coarse", self.coarse_metrics),
            ("final", self.final_metrics),
            ("restored", self.restored_metrics),
        ):
            if metrics is not None and len(metrics["per_view"]) != len(frames):
                raise ShapeError(
                    f"{self.name}: {name} metrics hold {len(metrics['per_view'])} views, "
                    f"expected {len(frames)}"
                )

    @property
    def frames(self) -> Int[np.ndarray, "t"]:
        """The frames that were rendered."""
        return self.sequence.test if self.held_out is None else self.held_out

    def why_absent(self, part: str, stage: str) -> str:
        """Why a part is missing, as a sentence.

        Args:
            part: name of the part, a key of `absent`.
            stage: the stage that would have made it.
        """
        if part in self.absent:
            return _sentence(self.absent[part])
        for row in self.stages:
            if row["stage"] == stage and row["state"] in ("skipped", "failed"):
                said = row.get("reason") or "no reason was recorded"
                return _sentence(f"The stage {stage} {_STATE_VERB[row['state']]}: {said}")
        if self.plan is not None:
            for line in self.plan["decisions"]:
                if line["stage"] == stage and not line["run"]:
                    return _sentence(f"The scene plan leaves out {stage}: {line['reason']}")
        return f"Nothing from the stage {stage} was handed to this report."


_STATE_VERB = {"skipped": "was skipped", "failed": "failed"}


def _sentence(text: str) -> str:
    text = text.strip()
    text = text[:1].upper() + text[1:]
    return text if text.endswith((".", "!", "?")) else f"{text}."
