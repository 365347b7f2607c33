"""The evaluation protocol: which pixels are evaluated, by which metrics, and the names of the results.

`PROTOCOL.md` in this folder specifies the protocol, one section per rule; this module implements it. Both
change together, with `PROTOCOL_VERSION`.

Metrics of a sequence are means over the views that have a value. Metrics without a value are None, and
`reasons` says why.
"""

from __future__ import annotations

import itertools
import logging
from collections.abc import Sequence
from dataclasses import dataclass, field, fields
from pathlib import Path
from typing import Any, ClassVar

import numpy as np
import torch
from jaxtyping import Float, Int
from torch import Tensor

from extrags.errors import NonFiniteError, ShapeError, SourceNotFoundError
from extrags.events import Progress, emit
from extrags.metrics.depth import depth_errors
from extrags.metrics.exposure import align_exposure, exposure_gain
from extrags.metrics.image import mean_of_known
from extrags.metrics.lpips import MIN_SIDE_PX, LpipsByNet, TargetActivations
from extrags.metrics.photometric import photometric_values
from extrags.metrics.registry import PROTOCOL_VERSION
from extrags.metrics.registry import metrics as registered_metrics
from extrags.metrics.surface import SurfaceErrors, SurfaceResult
from extrags.observed_surface import never_observed
from extrags.sequence import EndoscopicSequence
from extrags.store.storable import Storable
from extrags.threads import in_threads
from extrags.zarr_io import group_exists, new_group, open_group, read_array, write_frames

__all__ = ["PROTOCOL_VERSION", "EvaluationResult", "RenderedViews", "evaluate_views", "figures_per_view"]

logger = logging.getLogger(__name__)

MIN_REGION_SHARE = 0.003
"""Regions with a smaller share of the image are not evaluated: metrics of a few pixels are noise."""
SURFACE_ALPHA = 0.5
"""Smallest alpha of a pixel with a valid rendered depth."""
COLOR_LEVELS = 255
"""Renders are quantised to 8 bits, so that metrics of PNG files of them are the same."""
_PIXELS_AT_ONCE = 400_000

_NO_ERRORS: dict[str, Any] = {item.name: None for item in fields(SurfaceErrors)}
_NO_SURFACE: dict[str, Any] = {
    **_NO_ERRORS,
    "coverage": None,
    "observed_share": None,
    "threshold_mm": None,
    "unobserved": _NO_ERRORS,
}


@dataclass(frozen=True)
class RenderedViews(Storable):
    """Rendered held-out views, the input of all metrics.

    Args:
        rgb: colours, [V, H, W, 3], float32.
        alpha: opacities, [V, H, W], float32.
        depth_mm: expected z-depth in the unit of the sequence, [V, H, W], float32.
        n_gaussians: size of the scene that was rendered; None for renders made elsewhere, or not of
            Gaussians.
        has_depth: false for renders that came without depth; `depth_mm` is 0 then and is not evaluated.

    Raises:
        ShapeError: when sizes do not fit each other.
    """

    stored_as: ClassVar[str] = "renders"

    rgb: Float[np.ndarray, "v h w 3"]
    alpha: Float[np.ndarray, "v h w"]
    depth_mm: Float[np.ndarray, "v h w"]
    n_gaussians: int | None
    has_depth: bool = True

    def __post_init__(self) -> None:
        if self.alpha.shape != self.rgb.shape[:-1] or self.depth_mm.shape != self.rgb.shape[:-1]:
            raise ShapeError(
                f"renders differ in shape: rgb {self.rgb.shape}, alpha {self.alpha.shape}, "
                f"depth {self.depth_mm.shape}"
            )

    def __len__(self) -> int:
        return int(self.rgb.shape[0])

    def __repr__(self) -> str:
        height, width = self.rgb.shape[1:3]
        of = "" if self.n_gaussians is None else f", of {self.n_gaussians} Gaussians"
        depth = "with" if self.has_depth else "without"
        return f"RenderedViews({len(self)} views of {width} x {height} px, {depth} depth{of})"

    def save(self, path: Path) -> None:
        """Write a zarr v3 group, one view per chunk."""
        with new_group(path) as group:
            for name in ("rgb", "alpha", "depth_mm"):
                write_frames(group, name, getattr(self, name).astype(np.float32, copy=False))
            group.attrs["n_gaussians"] = self.n_gaussians
            if not self.has_depth:
                group.attrs["has_depth"] = False

    @classmethod
    def load(cls, path: Path) -> RenderedViews:
        """Read what `save` wrote.

        Raises:
            SourceNotFoundError: when the path does not exist.
        """
        if not group_exists(path):
            raise SourceNotFoundError("no renders here", file=path)
        group = open_group(path)
        count: Any = group.attrs["n_gaussians"]
        return cls(
            read_array(group, "rgb"),
            read_array(group, "alpha"),
            read_array(group, "depth_mm"),
            count,
            has_depth=bool(group.attrs.get("has_depth", True)),
        )


@dataclass(frozen=True)
class EvaluationResult:
    """Metrics of a sequence and of each of its views, in JSON types.

    Args:
        sequence: name of the sequence.
        metrics: `{psnr, ssim, lpips_alex, flip, depth_absrel, ..., n_gaussians, aligned: {...},
            observed: {...}, unobserved: {...}, whole: {...}, surface: {...}}`; None for missing values.
        per_view: the same per view, with `frame` and `name`, without `surface`.
        reasons: why a metric is None, by its key.
        true_surface: kind of the true surface, `mesh` or `depth`; None without surface metrics.
        protocol: version of the protocol.
    """

    sequence: str
    metrics: dict[str, Any]
    per_view: list[dict[str, Any]]
    reasons: dict[str, str] = field(default_factory=dict)
    true_surface: str | None = None
    protocol: int = PROTOCOL_VERSION

    def to_json(self) -> dict[str, Any]:
        """The result as JSON types, without NaN or infinity."""
        return {
            "protocol": self.protocol,
            "sequence": self.sequence,
            "n_views": len(self.per_view),
            "true_surface": self.true_surface,
            "metrics": self.metrics,
            "reasons": self.reasons,
            "per_view": self.per_view,
        }


def evaluate_views(
    renders: RenderedViews,
    sequence: EndoscopicSequence,
    frames: Int[np.ndarray, "v"],
    lpips: LpipsByNet | None,
    *,
    surface: SurfaceResult | None = None,
    surface_reason: str = "no surface was given",
    per_view: list[dict[str, Any]] | None = None,
    device: torch.device | str = "cpu",
) -> EvaluationResult:
    """Compare rendered views with the frames they show, by the protocol of this module.

    Args:
        renders: one render per frame of `frames`, at the sequence's size; colours are clipped to [0, 1] and
            rounded to 8 bits.
        sequence: the frames and masks, and true depth and observed masks where it has them.
        frames: indices into the sequence.
        lpips: LPIPS by backbone (`extrags.metrics.lpips.available_lpips`); None measures none. A backbone
            without weights has the figure None, with its reason in `reasons`; so have all on images that are
            too small for them.
        surface: figures of the scene's surface, from `extrags.metrics.surface`.
        surface_reason: said in `reasons` when `surface` is None.
        per_view: of these renders, where `figures_per_view` has measured them with others; None measures.
        device: where photometric metrics are computed, where they are.

    Returns:
        Metrics per view and their means.

    Raises:
        ShapeError: when renders and frames do not fit each other, or there are none.
        NonFiniteError: for NaN or infinity in the renders; names the frame.
    """
    lpips = _lpips_for(sequence, lpips)
    if per_view is None:
        (per_view,) = figures_per_view([renders], sequence, frames, lpips, device=device)
    metrics = _mean_tree([{k: v for k, v in view.items() if k not in ("frame", "name")} for view in per_view])
    metrics["n_gaussians"] = renders.n_gaussians
    metrics["surface"] = _NO_SURFACE if surface is None else surface.to_json()
    reasons = _reasons(metrics, sequence, frames, lpips, has_depth=renders.has_depth)
    reasons |= _surface_reasons(surface, surface_reason)
    return EvaluationResult(
        sequence.name,
        metrics,
        per_view,
        reasons,
        true_surface=None if surface is None else surface.kind,
    )


def figures_per_view(
    stacks: Sequence[RenderedViews],
    sequence: EndoscopicSequence,
    frames: Int[np.ndarray, "v"],
    lpips: LpipsByNet | None,
    *,
    device: torch.device | str = "cpu",
) -> list[list[dict[str, Any]]]:
    """`EvaluationResult.per_view` of several stacks of renders of the same frames.

    LPIPS looks at each frame once for all of them. The figures are those of each stack alone, to the last
    bit.

    Args:
        stacks: renders, each as `evaluate_views` takes them.
        sequence: as there.
        frames: as there.
        lpips: as there.
        device: where photometric metrics are computed; LPIPS is moved there.

    Raises:
        ShapeError: when renders and frames do not fit each other, or there are none.
        NonFiniteError: for NaN or infinity in the renders; names the frame.
    """
    for renders in stacks:
        _check(renders, sequence, frames)
    lpips = _lpips_for(sequence, lpips)
    for net, network in ({} if lpips is None else lpips).items():
        if isinstance(network, str):
            logger.warning("%s: LPIPS with %s is not measured: %s", sequence.name, net, network)
    if lpips is not None:
        lpips = {net: found if isinstance(found, str) else found.to(device) for net, found in lpips.items()}
    at_once = max(1, _PIXELS_AT_ONCE // (sequence.height * sequence.width))
    done = itertools.count(1)

    def evaluated(start: int) -> list[list[dict[str, Any]]]:
        found = _evaluate_chunk(stacks, sequence, frames, slice(start, start + at_once), lpips, device)
        emit(Progress("evaluate", min(next(done) * at_once, len(frames)), len(frames)))
        return found

    # Each with one thread of torch: filters divided among several would add up in another order.
    parts = in_threads(evaluated, range(0, len(frames), at_once))
    return [[view for part in parts for view in part[index]] for index in range(len(stacks))]


def _lpips_for(sequence: EndoscopicSequence, lpips: LpipsByNet | None) -> LpipsByNet | None:
    """The backbones, or why there is no figure of them on images of this size."""
    if lpips is None or min(sequence.width, sequence.height) >= MIN_SIDE_PX:
        return lpips
    size = f"{sequence.width} x {sequence.height}"
    return dict.fromkeys(lpips, f"LPIPS needs images of at least {MIN_SIDE_PX} px a side, these have {size}")


def _check(renders: RenderedViews, sequence: EndoscopicSequence, frames: np.ndarray) -> None:
    if len(frames) == 0:
        raise ShapeError(f"{sequence.name}: there is no frame to evaluate on")
    expected = (len(frames), sequence.height, sequence.width, 3)
    if renders.rgb.shape != expected:
        raise ShapeError(f"{sequence.name}: renders have shape {renders.rgb.shape}, expected {expected}")
    for name, stack in (("rgb", renders.rgb), ("alpha", renders.alpha), ("depth", renders.depth_mm)):
        finite = np.array([np.isfinite(view).all() for view in stack])
        if not finite.all():
            worst = sequence.frame_name(int(frames[int(np.argmin(finite))]))
            raise NonFiniteError(
                f"{sequence.name}: the rendered {name} of frame {worst} holds NaN or infinity"
            )


def _evaluate_chunk(
    stacks: Sequence[RenderedViews],
    sequence: EndoscopicSequence,
    frames: np.ndarray,
    part: slice,
    lpips: LpipsByNet | None,
    device: torch.device | str,
) -> list[list[dict[str, Any]]]:
    chosen = frames[part]
    target = torch.from_numpy(sequence.rgb[chosen].astype(np.float32) / 255).to(device)
    valid = torch.from_numpy(np.ascontiguousarray(sequence.mask[chosen]))
    parts, shares = _parts_of(sequence, chosen)
    # Depth is compared on the processor, colour on the device.
    regions = {name: region.to(device) for name, region in {"valid": valid, **parts}.items()}
    counted = regions["valid"]
    inside = counted[..., None].to(target.dtype)
    renders = [_in_8_bits(stack.rgb[part]).to(device) for stack in stacks]

    masked = target * inside
    known = TargetActivations(masked)
    plain = [_photometric(render * inside, masked, regions, lpips, known) for render in renders]
    aligned = [
        _photometric(align_exposure(render, target, counted) * inside, masked, regions, lpips, known)
        for render in renders
    ]
    if bool(valid.all()):
        whole = [found["valid"] for found in plain]
    else:
        everything = {"whole": torch.ones_like(counted)}
        known = TargetActivations(target)
        whole = [_photometric(render, target, everything, lpips, known)["whole"] for render in renders]

    found = []
    for index, (stack, render) in enumerate(zip(stacks, renders, strict=True)):
        gains = exposure_gain(render, target, counted)[:, 0].tolist()
        depths = [None] * len(chosen)
        if stack.has_depth:
            depths = list(np.where(stack.alpha[part] >= SURFACE_ALPHA, stack.depth_mm[part], 0))
        found.append(
            [
                _view(
                    sequence,
                    int(frame),
                    depths[at],
                    valid[at],
                    {name: region[at] for name, region in parts.items()},
                    {name: values[at] for name, values in plain[index].items()},
                    {name: values[at] for name, values in aligned[index].items()},
                    whole[index][at],
                )
                for at, frame in enumerate(chosen)
            ]
        )
        for at, view in enumerate(found[-1]):
            view["aligned"]["gain"] = gains[at] if bool(valid[at].any()) else None
            for name in parts:
                view[name]["pixel_share"] = shares[name][at]
    return found


def _in_8_bits(rgb: np.ndarray) -> Float[Tensor, "n h w 3"]:
    render = torch.from_numpy(rgb.astype(np.float32)).clamp(0, 1)
    return (render * COLOR_LEVELS).round() / COLOR_LEVELS


def _view(
    sequence: EndoscopicSequence,
    frame: int,
    depth: np.ndarray | None,
    valid: Tensor,
    parts: dict[str, Tensor],
    plain: dict[str, dict[str, Any]],
    aligned: dict[str, dict[str, Any]],
    whole: dict[str, Any],
) -> dict[str, Any]:
    """The figures of one view, group by group."""
    view: dict[str, Any] = {"frame": frame, "name": sequence.frame_name(frame)}
    view |= plain["valid"] | _depth_metrics(depth, sequence, frame, valid)
    view["aligned"] = dict(aligned["valid"])
    for name, region in parts.items():
        depths = _depth_metrics(depth, sequence, frame, region)
        view[name] = plain[name] | depths | {"aligned": aligned[name]}
    view["whole"] = whole
    return view


def _parts_of(
    sequence: EndoscopicSequence, chosen: np.ndarray
) -> tuple[dict[str, Tensor], dict[str, list[float | None]]]:
    """Observed and unobserved pixels, and their shares of the mask.

    A mask is empty where it is unknown or has fewer pixels than `MIN_REGION_SHARE`; the share is that before.
    """
    mask = sequence.mask[chosen]
    # The array says nothing about frames that are not held out.
    known = np.isin(chosen, sequence.test) & mask.any((1, 2)) & (sequence.observed is not None)
    seen = np.zeros_like(mask) if sequence.observed is None else mask & sequence.observed[chosen]
    unseen = never_observed(sequence, chosen)
    # Nor about frames without any depth.
    known &= (seen | unseen).any((1, 2))
    smallest = MIN_REGION_SHARE * sequence.height * sequence.width
    parts, shares = {}, {}
    for name, pixels in (("observed", seen), ("unobserved", unseen)):
        counts = pixels.sum((1, 2))
        parts[name] = torch.from_numpy(pixels & (known & (counts >= smallest))[:, None, None])
        shares[name] = [
            float(count / area) if there else None
            for count, area, there in zip(counts, mask.sum((1, 2)), known, strict=True)
        ]
    return parts, shares


def _photometric(
    render: Float[Tensor, "n h w 3"],
    target: Float[Tensor, "n h w 3"],
    regions: dict[str, Tensor],
    lpips: LpipsByNet | None,
    known: TargetActivations,
) -> dict[str, list[dict[str, Any]]]:
    """Photometric figures of each image inside each region."""
    found = photometric_values(render, target, regions, registered_metrics("photometric"), lpips, known)
    return {
        name: [{key: values[index] for key, values in columns.items()} for index in range(len(render))]
        for name, columns in found.items()
    }


def _depth_metrics(
    depth: np.ndarray | None, sequence: EndoscopicSequence, frame: int, region: Tensor
) -> dict[str, float | None]:
    errors = None
    if depth is not None and sequence.true_depth_mm is not None:
        errors = depth_errors(depth, sequence.true_depth_mm[frame], region.numpy())
    keys = [metric.key for metric in registered_metrics("depth")]
    if errors is None:
        return dict.fromkeys(keys)
    return {key: getattr(errors, key.removeprefix("depth_")) for key in keys}


def _mean_tree(views: list[dict[str, Any]]) -> dict[str, Any]:
    """Means over the views, key by key, through nested groups."""
    means: dict[str, Any] = {}
    for key, first in views[0].items():
        values = [view[key] for view in views]
        means[key] = _mean_tree(values) if isinstance(first, dict) else mean_of_known(values)
    return means


def _reasons(
    metrics: dict[str, Any],
    sequence: EndoscopicSequence,
    frames: np.ndarray,
    lpips: LpipsByNet | None,
    *,
    has_depth: bool,
) -> dict[str, str]:
    reasons = {}
    if metrics["psnr"] is None:
        reasons["psnr"] = "the validity masks of all views are empty"
    else:
        for metric in registered_metrics("photometric"):
            if metrics.get(metric.key, 0) is not None:
                continue
            network = None if lpips is None or metric.lpips_net is None else lpips[metric.lpips_net]
            reasons[metric.key] = network if isinstance(network, str) else "no view has a value"
    if metrics["n_gaussians"] is None:
        reasons["n_gaussians"] = "the renders were made elsewhere, or are not of Gaussians"
    if metrics["depth_absrel"] is None:
        if sequence.true_depth_mm is None:
            reasons["depth_absrel"] = "the sequence has no true depth"
        elif has_depth:
            reasons["depth_absrel"] = "no pixel has both a true and a rendered depth"
        else:
            reasons["depth_absrel"] = "the renders came without depth"
    for name in ("observed", "unobserved"):
        if metrics[name]["psnr"] is None:
            if sequence.observed is None:
                reasons[name] = "the source does not tell which surface the training frames saw"
            elif not np.isin(frames, sequence.test).any():
                reasons[name] = "told apart for held-out frames only"
            else:
                reasons[name] = f"no view has {MIN_REGION_SHARE:.1%} of its pixels {name}"
    return reasons


def _surface_reasons(surface: SurfaceResult | None, reason: str) -> dict[str, str]:
    if surface is None:
        return {"surface": reason}
    if surface.coverage is None:
        return {"surface": "no camera of the sequence sees the true surface"}
    if surface.observed.accuracy_mm is None:
        return {"surface.accuracy_mm": "the scene has no surface where the true one was observed"}
    return {}
