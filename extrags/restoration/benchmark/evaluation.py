"""Evaluation of restorers where the truth is known: off-trajectory views of a sequence, restored.

A `RestorerBenchmark` holds one list of clips with the photographs of their views; every restorer gets the
same clips. Figures inside a region are means over the views in which the region is large enough, as in
`extrags.metrics.protocol`. A figure that is not available is None.
"""

from __future__ import annotations

import time
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from extrags.cameras import Cameras
from extrags.errors import CaptureError, ConfigError, ShapeError
from extrags.metrics.exposure import align_exposure
from extrags.metrics.image import mean_of_known
from extrags.metrics.lpips import Lpips, LpipsByNet
from extrags.metrics.photometric import photometric_values
from extrags.metrics.protocol import COLOR_LEVELS, MIN_REGION_SHARE
from extrags.metrics.registry import figures, metric_named
from extrags.restoration.benchmark.inconsistency import (
    SMALLEST_SHARE,
    Motion,
    carried,
    invented_inconsistency,
    motion,
    view_pairs,
)
from extrags.restoration.benchmark.realism import Realism, rims
from extrags.restoration.clips import as_images, as_planes, keep_known, render_clips
from extrags.restoration.protocol import Clip, Enhancer, restore_clip
from extrags.restoration.uncertainty.reliability_diagram import calibration, cell_correlation
from extrags.scene import Scene
from extrags.sequence import EndoscopicSequence
from extrags.thresholds import HOLE_ALPHA
from extrags.view_synthesis.references import ReferenceViews

__all__ = [
    "RestoredViews",
    "RestorerBenchmark",
    "TrueViews",
    "held_out_clips",
    "iterate_held_out_clips",
    "restore_views",
]

CLIP_VIEWS = 8
"""Views of a clip: about the length of an explored trajectory."""
WELL_SEEN_ALPHA, WELL_SEEN_UNCERTAINTY = 0.9, 0.5
CHANGED = 4 / 255
"""A pixel is changed where a channel differs from the rendering by more than this."""


@dataclass(frozen=True)
class TrueViews:
    """Photographs of V views.

    Args:
        rgb: photographs in [0, 1], [V, H, W, 3].
        mask: which pixels count, [V, H, W].
        observed: whose surface some training frame saw, [V, H, W]; None where unknown.
        depth_mm: z-depth, 0 where unknown, [V, H, W]; None without depth.

    Raises:
        ShapeError: when the arrays do not fit each other.
    """

    rgb: Float[np.ndarray, "v h w 3"]
    mask: Bool[np.ndarray, "v h w"]
    observed: Bool[np.ndarray, "v h w"] | None = None
    depth_mm: Float[np.ndarray, "v h w"] | None = None

    def __post_init__(self) -> None:
        for name in ("mask", "observed", "depth_mm"):
            array = getattr(self, name)
            if array is not None and array.shape != self.rgb.shape[:-1]:
                raise ShapeError(f"{name} has shape {array.shape}, expected {self.rgb.shape[:-1]}")

    def __len__(self) -> int:
        return int(self.rgb.shape[0])

    @classmethod
    def of_sequence(cls, sequence: EndoscopicSequence, frames: Int[np.ndarray, "v"]) -> TrueViews:
        """Held-out frames of a sequence."""
        return cls(
            sequence.rgb[frames].astype(np.float32) / 255,
            np.ascontiguousarray(sequence.mask[frames]),
            None if sequence.observed is None else sequence.observed[frames],
            None if sequence.depth_mm is None else sequence.depth_mm[frames].astype(np.float32),
        )


def held_out_clips(
    scene: Scene,
    references: ReferenceViews,
    sequence: EndoscopicSequence,
    frames: Int[np.ndarray, "v"],
    *,
    count: int,
    length: int = CLIP_VIEWS,
) -> list[Clip]:
    """Held-out frames as clips of neighbours, rendered as virtual views are.

    Frames of a recording that was trained on get the exposure interpolated between its training frames,
    those of any other the mean: the rule of the evaluation.

    Args:
        scene: the coarse scene.
        references: its training views.
        sequence: the whole sequence, with the held-out frames.
        frames: which of them; clips follow this order and end with a recording.
        count: references blended per view.
        length: views per clip at most.

    Raises:
        CaptureError: without any frame.
        ConfigError: for clips without a view.
    """
    return list(iterate_held_out_clips(scene, references, sequence, frames, count=count, length=length))


def iterate_held_out_clips(
    scene: Scene,
    references: ReferenceViews,
    sequence: EndoscopicSequence,
    frames: Int[np.ndarray, "v"],
    *,
    count: int,
    length: int = CLIP_VIEWS,
) -> Iterator[Clip]:
    """`held_out_clips` one at a time: the layers of hundreds of views would fill the memory.

    Raises:
        CaptureError: without any frame; when the first clip is asked for, as the other.
        ConfigError: for clips without a view.
    """
    frames = np.asarray(frames, dtype=np.int64)
    if len(frames) == 0:
        raise CaptureError(f"{sequence.name}: no held-out frames to evaluate a restorer on")
    if length < 1:
        raise ConfigError(f"clips of {length} views; expected 1 or more")
    recording = np.zeros(len(sequence), int) if sequence.recording is None else sequence.recording
    gains = torch.ones(len(frames))
    if scene.light is not None:
        gains = scene.light.interpolated_exposures(frames, sequence.train, sequence.recording)
    made = 0
    borders = np.flatnonzero(np.diff(recording[frames])) + 1
    for run in np.split(np.arange(len(frames)), borders):
        for part in np.array_split(run, -(-len(run) // length)):
            gain = gains[torch.from_numpy(part)]
            clips = render_clips(
                scene,
                references,
                [sequence.cameras[frames[part]]],
                count=count,
                first_index=made,
                exposure=[gain if bool((gain != 1).any()) else None],
            )
            made += len(clips)
            yield from clips


@dataclass(frozen=True)
class RestoredViews:
    """Clips after restoration, all views in a row.

    Args:
        rgb: restored images in [0, 1], [V, H, W, 3].
        target: the same with known texture kept: the target of the fine-tuning, [V, H, W, 3].
        predicted_error: `Restoration.expected_error`, [V, H, W]; None where the restorer predicts none.
        seconds_per_frame: median over the clips.
        provenance: of the first clip.
        depth_mm: z-depth without gaps, [V, H, W]; None where the restorer gives none.
    """

    rgb: Float[np.ndarray, "v h w 3"]
    target: Float[np.ndarray, "v h w 3"]
    predicted_error: Float[np.ndarray, "v h w"] | None
    seconds_per_frame: float
    provenance: dict[str, Any]
    depth_mm: Float[np.ndarray, "v h w"] | None = None


def restore_views(enhancer: Enhancer, clips: Sequence[Clip]) -> RestoredViews:
    """Restore clips and measure the time.

    Raises:
        ShapeError: without any clip.
    """
    if not clips:
        raise ShapeError("no clips to restore")
    restorations, targets, seconds = [], [], []
    for clip in clips:
        begun = time.perf_counter()
        restoration = restore_clip(enhancer, clip)
        seconds.append((time.perf_counter() - begun) / len(clip))
        restorations.append(restoration)
        rendered = as_images(clip.layers.get("rendered").clamp(0, 1))
        targets.append(keep_known(rendered, restoration.rgb, as_planes(clip.layers.get("uncertainty")))[0])
    expected = [item.expected_error for item in restorations if item.expected_error is not None]
    depths = [item.depth_mm for item in restorations if item.depth_mm is not None]
    return RestoredViews(
        np.concatenate([item.rgb for item in restorations]),
        np.concatenate(targets),
        np.concatenate(expected) if len(expected) == len(restorations) else None,
        float(np.median(seconds)),
        restorations[0].provenance,
        np.concatenate(depths) if len(depths) == len(restorations) else None,
    )


@dataclass(frozen=True)
class RestorerBenchmark:
    """Clips with their true views, on which any number of restorers is compared.

    Args:
        clips: rendered views.
        truth: of the same views in the same order.
        lpips: LPIPS by backbone; None leaves it out.

    Raises:
        ShapeError: when clips and truth have different numbers of views, or sizes.
    """

    clips: Sequence[Clip]
    truth: TrueViews
    lpips: LpipsByNet | None = None

    def __post_init__(self) -> None:
        views = sum(len(clip) for clip in self.clips)
        sizes = {(clip.cameras.height, clip.cameras.width) for clip in self.clips}
        if views != len(self.truth) or sizes != {tuple(self.truth.mask.shape[1:])}:
            raise ShapeError(
                f"{views} views of {sorted(sizes)} px in the clips, truth of {self.truth.mask.shape}"
            )

    def evaluate(self, enhancer: Enhancer) -> dict[str, Any]:
        """Restore all clips and compare; see `figures`."""
        return self.figures(restore_views(enhancer, self.clips))

    def figures(self, restored: RestoredViews) -> dict[str, Any]:
        """All figures of restored views, ready for JSON.

        Args:
            restored: of this benchmark's clips.

        Returns:
            `{psnr, ssim, lpips_alex, well: {...}, hole: {...}, rim: {...}, ...}` of the raw restoration, the
            same tree of the target of the fine-tuning in `kept`, both with the best gain of each image
            divided out in `aligned` (the exposure of another recording cannot be known), `changed_share` (of
            the target's pixels inside the mask), `flicker`, `error_flicker`,
            `inconsistency: {within, across, of_photographs}` of what was invented (in both views a hole, or
            never observed; see `invented_inconsistency`), `frechet` and `detail` by region (see `Realism`),
            `hole_depth_error: {mean, median}` (absolute difference of log-depths; None without either depth),
            `seconds_per_frame`, `calibration` (see `calibration`; None without prediction; in `aligned` of
            the errors after alignment) with `rank_correlation_of`: the rank correlation of the error with
            what else could predict it.

        Raises:
            ShapeError: when the views are not those of the benchmark.
        """
        if restored.rgb.shape != self.truth.rgb.shape:
            raise ShapeError(f"{restored.rgb.shape} restored, truth {self.truth.rgb.shape}")
        rgb = torch.from_numpy(np.ascontiguousarray(restored.rgb, dtype=np.float32)).clamp(0, 1)
        target = torch.from_numpy(np.ascontiguousarray(restored.target, dtype=np.float32)).clamp(0, 1)
        mask = self.regions["valid"]
        changed = (target - self._rendered).abs().amax(dim=-1) > CHANGED
        aligned = align_exposure(rgb, self._truth, mask)
        error = (rgb - self._truth).abs().mean(dim=-1)
        change = (rgb - self._rendered).abs().mean(dim=-1)
        return {
            **self._compared(rgb),
            "aligned": {
                **self._compared(aligned),
                "kept": self._compared(align_exposure(target, self._truth, mask)),
                "calibration": self._calibration(restored, aligned),
            },
            "kept": self._compared(target),
            "changed_share": float(changed[mask].float().mean()) if bool(mask.any()) else None,
            **self._flicker(rgb),
            "inconsistency": self._inconsistency(rgb),
            **self._realism.figures(rgb),
            "hole_depth_error": self._hole_depth_error(restored.depth_mm),
            "seconds_per_frame": restored.seconds_per_frame,
            "calibration": self._calibration(restored, rgb),
            "rank_correlation_of": {
                name: cell_correlation(np.asarray(values), error.numpy(), self.truth.mask)
                for name, values in (("uncertainty", self._layer("uncertainty")), ("change", change))
            },
        }

    def _hole_depth_error(self, depth_mm: Float[np.ndarray, "v h w"] | None) -> dict[str, float | None]:
        true_mm, nothing = self.truth.depth_mm, dict.fromkeys(("mean", "median"))
        if depth_mm is None or true_mm is None:
            return nothing
        holes = self.regions["hole"].numpy() & (true_mm > 0)
        if not holes.any():
            return nothing
        error = np.abs(np.log(depth_mm[holes] / true_mm[holes]))
        return {"mean": float(error.mean()), "median": float(np.median(error))}

    def _calibration(
        self, restored: RestoredViews, images: Float[Tensor, "v h w 3"]
    ) -> dict[str, Any] | None:
        if restored.predicted_error is None:
            return None
        error = (images - self._truth).abs()
        return calibration(restored.predicted_error, error.numpy(), self.truth.mask)

    @cached_property
    def regions(self) -> dict[str, Bool[Tensor, "v h w"]]:
        """Pixels that count: all, well seen, holes, their rims, and where it is known (un)observed."""
        mask = torch.from_numpy(np.ascontiguousarray(self.truth.mask))
        alpha, uncertainty = self._layer("alpha"), self._layer("uncertainty")
        hole = mask & (alpha < HOLE_ALPHA)
        regions = {
            "valid": mask,
            "well": mask & (alpha > WELL_SEEN_ALPHA) & (uncertainty < WELL_SEEN_UNCERTAINTY),
            "hole": hole,
            "rim": rims(mask, hole),
        }
        if self.truth.observed is not None:
            seen = torch.from_numpy(np.ascontiguousarray(self.truth.observed))
            unseen = mask & ~seen
            if self.truth.depth_mm is not None:
                # Of pixels without depth nothing tells.
                unseen &= torch.from_numpy(self.truth.depth_mm > 0)
            regions |= {"observed": mask & seen, "unobserved": unseen}
        return regions

    @cached_property
    def pixel_share(self) -> dict[str, float]:
        """Share of the mask that each region has."""
        total = max(1, int(self.regions["valid"].sum()))
        return {name: float(region.sum()) / total for name, region in self.regions.items() if name != "valid"}

    @cached_property
    def _realism(self) -> Realism:
        network = None if self.lpips is None else self.lpips.get("alex")
        network = network if isinstance(network, Lpips) else None
        return Realism(self._truth, self.regions, network, self.regions["valid"])

    @cached_property
    def _truth(self) -> Tensor:
        return torch.from_numpy(np.ascontiguousarray(self.truth.rgb, dtype=np.float32))

    @cached_property
    def _rendered(self) -> Tensor:
        parts = [clip.layers.get("rendered").clamp(0, 1) for clip in self.clips]
        return torch.cat(parts).permute(0, 2, 3, 1).contiguous()

    def _layer(self, name: str) -> Tensor:
        return torch.cat([clip.layers.get(name)[:, 0] for clip in self.clips])

    def _compared(self, images: Float[Tensor, "v h w 3"]) -> dict[str, Any]:
        """As the protocol compares: in 8 bits, outside pixels blanked in both images."""
        inside = self.regions["valid"][..., None].to(images.dtype)
        render = (images * COLOR_LEVELS).round() / COLOR_LEVELS * inside
        target = self._truth * inside
        smallest = MIN_REGION_SHARE * render.shape[1] * render.shape[2]
        regions = {
            name: region & (region.sum((1, 2)) >= smallest)[:, None, None]
            for name, region in self.regions.items()
        }
        metrics = [metric_named(figure.key) for figure in figures("restoration")]
        values = photometric_values(render, target, regions, metrics, self.lpips)
        tree = {
            name: {key: mean_of_known(column) for key, column in columns.items()}
            for name, columns in values.items()
        }
        nothing: dict[str, float | None] = dict.fromkeys(tree["valid"])
        for name in ("observed", "unobserved"):
            tree.setdefault(name, nothing)
        return {**tree.pop("valid"), **tree}

    def _flicker(self, images: Float[Tensor, "v h w 3"]) -> dict[str, float | None]:
        r"""Temporal inconsistency along the surface, mean over the pixels that two neighbouring views share.

        `flicker` is :math:`|r_t - W r_{t-1}|` less the same of the photographs, W the warp by true depth:
        0 for images as consistent as the photographs, and negative for blurred ones. `error_flicker` is that
        of the error :math:`r - p`: 0 only where the error is the same in both views.
        """
        if not self._motions:
            return {"flicker": None, "error_flicker": None}
        stacks = {"own": images, "real": self._truth, "error": images - self._truth}
        totals, count = dict.fromkeys(stacks, 0.0), 0
        for pair in self._motions:
            for name, stack in stacks.items():
                difference = (stack[pair.view] - carried(stack[pair.other], pair.grid)).abs()
                totals[name] += float(difference[pair.common].double().mean(dim=-1).sum())
            count += int(pair.common.sum())
        if count == 0:
            return {"flicker": None, "error_flicker": None}
        return {
            "flicker": (totals["own"] - totals["real"]) / count,
            "error_flicker": totals["error"] / count,
        }

    @cached_property
    def _motions(self) -> list[Motion]:
        if self.truth.depth_mm is None:
            return []
        depth, mask = self.truth.depth_mm, self.truth.mask
        neighbours = np.flatnonzero(self._owner[1:] == self._owner[:-1]) + 1
        return [motion(self._cameras, depth, mask, int(view), int(view) - 1) for view in neighbours]

    def _inconsistency(self, images: Float[Tensor, "v h w 3"]) -> dict[str, float | None]:
        """Of what was invented, by the views that are compared, and of the photographs themselves."""
        within, across = self._invented_motions
        return {
            "within": invented_inconsistency(images, self._truth, within),
            "across": invented_inconsistency(images, self._truth, across),
            "of_photographs": invented_inconsistency(self._truth, self._truth, within + across),
        }

    @cached_property
    def _invented_motions(self) -> tuple[list[Motion], list[Motion]]:
        """Pairs of views within clips, and across them, that show the same invented surface."""
        depth = self.truth.depth_mm
        if depth is None:
            return [], []
        invented = self.regions["hole"].numpy()
        if self.truth.observed is not None:
            invented = invented | self.regions["unobserved"].numpy()
        within, across = (
            [motion(self._cameras, depth, invented, view, other) for other, view in pairs]
            for pairs in view_pairs(self._owner)
        )
        smallest = SMALLEST_SHARE * self._cameras.width * self._cameras.height
        return (
            [pair for pair in within if int(pair.common.sum()) >= smallest],
            [pair for pair in across if int(pair.common.sum()) >= smallest],
        )

    @cached_property
    def _cameras(self) -> Cameras:
        return Cameras.concatenated([clip.cameras for clip in self.clips])

    @cached_property
    def _owner(self) -> Int[np.ndarray, "v"]:
        return np.repeat(np.arange(len(self.clips)), [len(clip) for clip in self.clips])
