"""Depth of a sequence's training frames, from all cues there are."""

from __future__ import annotations

import logging
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, ClassVar

import numpy as np
import torch
from jaxtyping import Bool, Float, UInt8
from torch import Tensor
from torch.nn import functional

from extrags.config import DEFAULT_PROFILE, PROFILES, PosesConfig
from extrags.config.depth import DepthConfig
from extrags.depth.combination import CERTAIN, HOPELESS, Depth, combined
from extrags.depth.completion import CompletionNetwork, completion_inputs
from extrags.depth.edges import sharpened
from extrags.depth.frames import PosedFrames
from extrags.depth.monocular import MonocularPredictor, predictions
from extrags.depth.monocular_network import load_monocular
from extrags.depth.report import depth_report
from extrags.depth.stereo import (
    SECOND_SWEEP,
    THIRD_SWEEP,
    StereoDepth,
    StereoSettings,
    multi_view_stereo,
    sweep_around,
)
from extrags.depth.unmatched import scale_error, unmatched_frames
from extrags.depth.weights import NONE, load_completion
from extrags.devices import chosen_device
from extrags.errors import CaptureError
from extrags.events import Progress, emit
from extrags.frame_quantiles import median_of_frames
from extrags.frame_stacks import FrameStack
from extrags.lens import distortion_of_pinhole
from extrags.poses.triangulation import triangulate_points
from extrags.radial_lens import WIDE_FIELD_DEG
from extrags.sequence import EndoscopicSequence
from extrags.source_frames import select_sources
from extrags.store.storable import Storable
from extrags.threads import in_threads, one_torch_thread
from extrags.training.random_start import depth_range
from extrags.zarr_io import new_group, open_group, read_array, write_array, write_frames

__all__ = ["DepthEstimate", "estimate_depth", "posed_frames", "with_estimated_depth"]

_LOG = logging.getLogger(__name__)

MIN_POINTS = 12
"""Fewer points in a view say nothing about the range of its depths."""

STEREO_TRUST_SOURCES = 2.0
"""Sources that must agree with stereo for it to be taken where the network has another opinion."""

STEREO_TRUST_ERRORS = 1.5
"""How far, in expected errors of the network, stereo may be from it."""

ERROR_FACTOR = 1.25
"""Of the network's expected error, which is so much too small on phantoms; it saw none of them."""

STEREO_GAIN = 0.4
"""Share of the network's expected error that agreeing stereo removes."""

STEREO_ERRORS = (0.03, 0.5)
"""Expected relative error of stereo without completion: where all sources agree, and where none does."""


FAR_AWAY = 100.0
"""Distance from the origin, in reaches of the frames, from which poses are taken about their middle."""


@dataclass(frozen=True)
class DepthEstimate(Storable):
    """Dense depth of frames, with its expected error and where it comes from.

    Args:
        depth: z-depth in the poses' unit, 0 outside the mask, [F, H, W].
        expected_error: expected relative error of it, as the network says it and by `ERROR_FACTOR`, 0
            outside the mask, [F, H, W].
        points: sparse points the search started from, [P, 3].
        points_rgb: their colours, [P, 3].
        report: facts on each cue, ready for JSON.
    """

    stored_as: ClassVar[str] = "depth"

    depth: Float[np.ndarray, "f h w"]
    expected_error: Float[np.ndarray, "f h w"]
    points: Float[np.ndarray, "p 3"]
    points_rgb: UInt8[np.ndarray, "p 3"]
    report: dict[str, Any] = field(default_factory=dict)

    @property
    def summary(self) -> str:
        """One line for plans and logs."""
        measured = self.report.get("median_measured_error")
        before = "" if measured is None else f" ({100 * measured:.1f} % as measured)"
        return (
            f"expected error {100 * self.report['median_expected_error']:.1f} % in the median{before}; "
            f"{self.report['n_points']} points, {self.report['agreeing_share']:.0%} of pixels confirmed by "
            "other frames"
            + "".join(f"; {words}" for words in (self.report.get("contradiction", ""),) if words)
        )

    def save(self, path: Path) -> None:
        """Write a zarr v3 group; one frame per chunk."""
        with new_group(path) as group:
            write_frames(group, "depth", self.depth)
            write_frames(group, "expected_error", self.expected_error)
            write_array(group, "points", self.points)
            write_array(group, "points_rgb", self.points_rgb)
            group.attrs["report"] = self.report

    @classmethod
    def load(cls, path: Path) -> DepthEstimate:
        """Read what `save` wrote."""
        group = open_group(path)
        names = ("depth", "expected_error", "points", "points_rgb")
        report: Any = group.attrs["report"]
        depth, expected_error, points, points_rgb = (read_array(group, name) for name in names)
        return cls(depth, expected_error, points, points_rgb, report)


@one_torch_thread()
def estimate_depth(
    sequence: EndoscopicSequence,
    config: DepthConfig | None = None,
    poses: PosesConfig | None = None,
    *,
    monocular: MonocularPredictor | None = None,
    stage: str = "depth",
) -> DepthEstimate:
    """Depth of all frames of a sequence, which should be its training part.

    Points give the range to search; stereo searches it, with the depth that brightness predicts, and a
    monocular network where there is one, as a weak prior; a network completes the result and says how wrong
    it expects to be. Measured depth with an expected error (`extrags.measured_depth`) is corrected by the
    estimate and combined with it; without one it is not looked at.

    Args:
        sequence: with poses.
        config: what to use; None takes those of the profile `balanced`.
        poses: settings of the features that points are triangulated from; None takes those of the profile
            `balanced`.
        monocular: a network of the caller's own; None loads that of the settings, if they name one.
        stage: named in progress events.

    Raises:
        CaptureError: with a single frame, when all cameras stand in one place, or when all sparse points lie
            behind the cameras.
        ConfigError: when a CUDA device is asked for and there is none.
        WeightsError: when the weights of a network cannot be read.
        MissingDependencyError: when a monocular network is asked for without the package it needs.
    """
    config = PROFILES[DEFAULT_PROFILE].depth if config is None else config
    if sequence.depth_mm is not None and sequence.depth_error is not None:
        blind = replace(sequence, depth_mm=None, depth_error=None)
        estimate = estimate_depth(blind, config, poses, monocular=monocular, stage=stage)
        return _with_measured(estimate, sequence)
    if sequence.lens is not None:
        flat = sequence.as_pinhole(WIDE_FIELD_DEG)
        return _through_lens(
            sequence, flat, estimate_depth(flat, config, poses, monocular=monocular, stage=stage)
        )
    device = chosen_device(config.device, "depth.device")
    if len(sequence) < 2:
        raise CaptureError(f"{sequence.name}: depth from other frames needs at least two, found one")
    poses = PROFILES[DEFAULT_PROFILE].poses if poses is None else poses
    points, points_rgb, origin, told_of_poses = _points(sequence, config, poses)
    small = _with_masks(sequence.at_most_width(config.max_width))
    near, typical, far = _ranges(small, points, config)
    frames = posed_frames(small, device)
    sources = _sources(small, typical, config).to(device)
    recording = small.recording
    told = _Told(stage, (2 if config.completion == NONE else 6) * len(sequence))
    settings = StereoSettings(
        hypotheses=config.hypotheses, radius_px=config.window_radius_px, shading=config.shading
    )
    # Without shortcuts of single precision, and in one order: depth on a GPU is that on a processor but for
    # rounding, and the same again.
    exact = torch.backends.cudnn.flags(enabled=True, benchmark=False, deterministic=True, allow_tf32=False)
    with exact:
        if monocular is None and config.monocular is not None:
            monocular = load_monocular(config.monocular, device)
        stereo = multi_view_stereo(
            frames,
            sources,
            torch.from_numpy(near).float().to(device),
            torch.from_numpy(far).float().to(device),
            settings,
            recording=None if recording is None else torch.from_numpy(recording).to(device),
            monocular=None if monocular is None else _predicted(monocular, sequence, frames),
            told=told.step,
        )
        network = load_completion(config.completion)
        if network is None:
            log_depth, error = _with_fallback(stereo)
        else:
            network = network.to(device)
            log_depth, error, stereo = _completed(network, frames, small, stereo, config, settings, told)
        log_depth = sharpened(log_depth, error, frames)
    depth, expected = _at_full_size(sequence, frames.mask, log_depth, error)
    report: dict[str, Any] = {
        "points_from": origin,
        "n_points": len(points),
        **depth_report(stereo, frames.mask, config.completion),
        "device": device.type,
        "median_expected_error": _median_error(expected, sequence.mask),
        **told_of_poses,
    }
    return DepthEstimate(depth, expected, points.astype(np.float64), points_rgb, report)


def _with_masks(small: EndoscopicSequence) -> EndoscopicSequence:
    """Frames in the size they are matched at; of a mask too fine for it, all of the picture.

    Without a pixel a frame has no typical depth, and its depth would be made of nothing.
    """
    lost = [index for index, mask in enumerate(small.mask) if not mask.any()]
    if not lost:
        return small
    _LOG.warning(
        "%s: at a width of %d px the masks of %d of %d frames, %s first, leave no pixel that shows tissue "
        "throughout: these frames are matched as a whole (depth.max_width)",
        small.name,
        small.width,
        len(lost),
        len(small),
        small.frame_name(lost[0]),
    )
    masks = np.array(small.mask)
    masks[lost] = True
    return replace(small, mask=masks)


def _with_measured(estimate: DepthEstimate, sequence: EndoscopicSequence) -> DepthEstimate:
    """An estimate with what was measured, of all frames.

    Args:
        estimate: of all frames of the sequence.
        sequence: its depth has an expected error.
    """
    assert sequence.depth_mm is not None
    assert sequence.depth_error is not None
    depth, expected = FrameStack(len(sequence)), FrameStack(len(sequence))
    for index, mask in enumerate(sequence.mask):
        measured = Depth(np.where(mask, sequence.depth_mm[index], 0), sequence.depth_error[index])
        both = combined(Depth(estimate.depth[index], estimate.expected_error[index]), measured)
        depth.append(both.z)
        expected.append(both.error)
    report = {
        **estimate.report,
        "combined_with_measured": True,
        "median_measured_error": _median_error(sequence.depth_error, sequence.mask),
        "median_expected_error": _median_error(expected.array, sequence.mask),
    }
    return replace(estimate, depth=depth.array, expected_error=expected.array, report=report)


def _median_error(expected: Float[np.ndarray, "f h w"], mask: Bool[np.ndarray, "f h w"]) -> float:
    """Expected error of the pixels in the mask, in the median; 1 where there are none."""
    found = median_of_frames(lambda: (image[inside] for image, inside in zip(expected, mask, strict=True)))
    return 1.0 if found is None else found


def _through_lens(
    sequence: EndoscopicSequence, flat: EndoscopicSequence, estimate: DepthEstimate
) -> DepthEstimate:
    """The depth of wide pinholes, at the pixels of the frames they were resampled from; 0 outside them."""
    lens = sequence.lens
    assert lens is not None
    depth, expected = FrameStack(len(sequence)), FrameStack(len(sequence))
    for index in range(len(sequence)):
        back = distortion_of_pinhole(sequence.K[index], lens, flat.K[index], sequence.width, sequence.height)
        known = sequence.mask[index] & (back.depth(flat.mask[index].astype(np.float32)) > 0)
        for stack, image in ((depth, estimate.depth), (expected, estimate.expected_error)):
            stack.append(np.where(known, back.depth(image[index]), 0).astype(np.float32))
    return replace(estimate, depth=depth.array, expected_error=expected.array)


def with_estimated_depth(sequence: EndoscopicSequence, estimate: DepthEstimate) -> EndoscopicSequence:
    """A sequence with the estimated depth of its frames, the expected error of it, and the points.

    Args:
        sequence: the frames that were given to `estimate_depth`; points of its own are kept.
        estimate: depth and expected error, [F, H, W].

    Raises:
        ShapeError: when the estimate is of other frames.
    """
    known = sequence.points is not None or not len(estimate.points)
    return replace(
        sequence,
        depth_mm=estimate.depth,
        depth_error=estimate.expected_error,
        points=sequence.points if known else estimate.points,
        points_rgb=sequence.points_rgb if known else estimate.points_rgb,
    )


class _Told:
    """Progress of the stage, counted in passes over frames."""

    def __init__(self, stage: str, total: int) -> None:
        self.stage, self.done, self.total = stage, 0, total

    def step(self, frames: int) -> None:
        self.done += frames
        emit(Progress(self.stage, self.done, self.total))


def posed_frames(sequence: EndoscopicSequence, device: torch.device | str = "cpu") -> PosedFrames:
    """A sequence's frames as tensors on a device.

    Raises:
        ShapeError: while the poses are unknown.
    """
    poses = sequence.cameras.world_from_camera.copy()
    # Only where frames stand to each other counts, and far from the origin float32 has no digits for that.
    middle = poses[:, :3, 3].mean(axis=0)
    reach = np.abs(poses[:, :3, 3] - middle).max()
    if np.abs(middle).max() > FAR_AWAY * reach:
        poses[:, :3, 3] -= middle
    return PosedFrames(
        rgb=torch.from_numpy(sequence.rgb).to(device).permute(0, 3, 1, 2).float() / 255,
        mask=torch.from_numpy(sequence.mask.copy()).to(device),
        K=torch.from_numpy(sequence.K).float().to(device),
        world_from_camera=torch.from_numpy(poses).float().to(device),
    )


def _points(
    sequence: EndoscopicSequence, config: DepthConfig, poses: PosesConfig
) -> tuple[np.ndarray, np.ndarray, str, dict[str, str]]:
    """Sparse points, their colours, where they come from, and what they tell against the poses."""
    told: dict[str, str] = {}
    if sequence.points is not None and len(sequence.points) >= MIN_POINTS:
        rgb = sequence.points_rgb
        rgb = np.full((len(sequence.points), 3), 128, np.uint8) if rgb is None else rgb
        return sequence.points, rgb, "the source or the poses stage", told
    if config.triangulate:
        found = triangulate_points(sequence, poses)
        # On the page too: of poses that are wrong nothing else there tells but its figures.
        told = {name: words for name, words in found.report.items() if name == "contradiction"}
        if len(found) >= MIN_POINTS:
            return found.points, found.points_rgb, "triangulation with the given poses", told
    _LOG.warning(
        "%s: no points to tell the range of depths; it is guessed from the cameras' motion", sequence.name
    )
    return np.zeros((0, 3)), np.zeros((0, 3), np.uint8), "none", told


def _ranges(
    sequence: EndoscopicSequence, points: np.ndarray, config: DepthConfig
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Nearest, typical and farthest depth of each frame."""
    count = len(sequence)
    if len(points) < MIN_POINTS:
        guessed = depth_range(sequence.cameras, sequence.name)
        return tuple(np.full(count, value) for value in (guessed.near, guessed.typical, guessed.far))  # type: ignore[return-value]
    pixels, z = sequence.cameras.project(points)
    found = np.full((count, 3), np.nan)
    everything = []
    for frame in range(count):
        inside = _inside(sequence, frame, pixels[frame], z[frame])
        everything.append(z[frame][inside])
        if inside.sum() >= MIN_POINTS:
            found[frame] = np.quantile(z[frame][inside], (0.02, 0.5, 0.98))
    together = np.concatenate(everything)
    if not len(together):
        together = z[z > 0]
    if not len(together):
        raise CaptureError(
            f"{sequence.name}: all {len(points)} sparse points lie behind all {count} cameras; expected "
            "points in the world of the poses, in front of the cameras that saw them. Mend them, or take "
            "them out of the source: then points are triangulated"
        )
    overall = np.quantile(together, (0.02, 0.5, 0.98))
    # A frame with few points may see what none of them lies on: it searches the whole scene's range.
    found = np.where(np.isnan(found), overall, found)
    low = np.minimum(found[:, 0], 0.5 * (found[:, 0] + overall[0]))
    return low / config.range_margin, found[:, 1], np.maximum(found[:, 2], overall[1]) * config.range_margin


def _inside(sequence: EndoscopicSequence, frame: int, pixels: np.ndarray, z: np.ndarray) -> np.ndarray:
    column, row = np.floor(np.nan_to_num(pixels, nan=-1.0, posinf=-1.0, neginf=-1.0)).astype(np.int64).T
    inside = (z > 0) & (column >= 0) & (column < sequence.width) & (row >= 0) & (row < sequence.height)
    inside[inside] = sequence.mask[frame][row[inside], column[inside]]
    return np.asarray(inside)


def _completed(
    network: CompletionNetwork,
    frames: PosedFrames,
    sequence: EndoscopicSequence,
    stereo: StereoDepth,
    config: DepthConfig,
    settings: StereoSettings,
    told: _Told,
) -> tuple[Tensor, Tensor, StereoDepth]:
    """Completion and stereo around what it gives, twice, and a mixture of both: stereo where views agree."""
    log_depth, error = _run_network(network, frames, stereo, told)
    # The typical depths are known now; those of few points were not.
    typical = np.array(
        [float(image[mask].exp().median()) for image, mask in zip(log_depth, frames.mask, strict=True)]
    )
    sources = _sources(sequence, typical, config).to(log_depth.device)
    stereo = sweep_around(
        frames, sources, stereo, log_depth, **SECOND_SWEEP, settings=settings, told=told.step
    )
    log_depth, error = _run_network(network, frames, stereo, told)
    stereo = sweep_around(
        frames, sources, stereo, log_depth, **THIRD_SWEEP, settings=settings, told=told.step
    )
    agreeing = stereo.agrees * stereo.seen * stereo.n_sources[:, None, None]
    away = (stereo.fused - log_depth) / (STEREO_TRUST_ERRORS * error)
    weight = (agreeing / STEREO_TRUST_SOURCES).clamp(max=1) * (1 - stereo.violates)
    weight = weight * torch.exp(-0.5 * away.square())
    mixed = log_depth + weight * (stereo.fused - log_depth)
    expected = ERROR_FACTOR * error * (1 - STEREO_GAIN * weight)
    of_scale = scale_error(stereo, unmatched_frames(stereo, frames.mask))
    return mixed, torch.hypot(expected, of_scale[:, None, None]), stereo


@torch.no_grad()
def _run_network(
    network: CompletionNetwork, frames: PosedFrames, stereo: StereoDepth, told: _Told
) -> tuple[Tensor, Tensor]:
    """Log-depth, and the expected absolute error of it."""
    # Without sparse points: those of triangulation are 6 to 7 % off in the mean, which is worse than what
    # stereo and the network make of the pixels around them (AbsRel .034 with them and .031 without on three
    # phantoms), and practice with points as wrong as these did not change it.

    def completed(frame: Tensor) -> tuple[Tensor, Tensor]:
        inputs = completion_inputs(frames.of_frames(frame), stereo.of_frames(frame))
        log_depth, log_error = network(inputs.channels)
        return log_depth + inputs.log_scale[:, None, None], log_error.exp()

    answers = in_threads(completed, torch.arange(len(frames), device=stereo.cost.device).split(1))
    log_depth, error = (torch.cat(parts) for parts in zip(*answers, strict=True))
    told.step(len(frames))
    return log_depth, error


def _sources(sequence: EndoscopicSequence, typical: np.ndarray, config: DepthConfig) -> Tensor:
    return torch.from_numpy(
        select_sources(
            sequence.cameras.world_from_camera.astype(np.float64),
            sequence.K.astype(np.float64),
            (sequence.height, sequence.width),
            typical,
            config.sources,
        )
    )


def _stereo_error(stereo: StereoDepth) -> Tensor:
    """A rough expected error without the network, from the share of sources that agree."""
    low, high = STEREO_ERRORS
    return high * (low / high) ** (stereo.agrees * stereo.seen)


def _with_fallback(stereo: StereoDepth) -> tuple[Tensor, Tensor]:
    """Stereo without completion; where few views confirm it, a monocular network has its say."""
    error = _stereo_error(stereo)
    if not stereo.monocular:
        return stereo.fused, error
    own, other = (1 / value.square() for value in (error, stereo.prior_scatter[:, None, None]))
    total = own + other
    log_depth = stereo.fused + other / total * (stereo.prior - stereo.fused)
    return log_depth, 1 / total.sqrt()


def _predicted(monocular: MonocularPredictor, sequence: EndoscopicSequence, frames: PosedFrames) -> Tensor:
    """What a monocular network says, of frames in full size."""
    device = frames.rgb.device
    images = (torch.from_numpy(image).to(device).permute(2, 0, 1).float() / 255 for image in sequence.rgb)
    return predictions(monocular, images, frames.size).to(device)


def _at_full_size(
    sequence: EndoscopicSequence,
    known: Bool[Tensor, "f h w"],
    log_depth: Float[Tensor, "f h w"],
    error: Float[Tensor, "f h w"],
) -> tuple[Float[np.ndarray, "f h0 w0"], Float[np.ndarray, "f h0 w0"]]:
    """Depth and its expected error at the pixels of the frames, one frame after the other.

    Args:
        sequence: the frames in full size.
        known: pixels of the smaller ones that show tissue throughout: others say nothing of depth, and those
            of full size beside them take it from the nearest that do.
        log_depth: of the smaller ones.
        error: expected of it.
    """
    depth, expected = FrameStack(len(sequence)), FrameStack(len(sequence))
    for index, mask in enumerate(sequence.mask):
        own_log_depth, own_error = log_depth[index], error[index]
        if own_log_depth.shape != mask.shape:
            own_log_depth, own_error = _continued(known[index], own_log_depth, own_error)
        depth.append(np.where(mask, np.exp(_enlarged(own_log_depth, mask.shape)), 0).astype(np.float32))
        bounded = np.clip(_enlarged(own_error, mask.shape), CERTAIN, HOPELESS)
        expected.append(np.where(mask, bounded, 0).astype(np.float32))
    return depth.array, expected.array


def _continued(known: Bool[Tensor, "h w"], *images: Float[Tensor, "h w"]) -> list[Float[Tensor, "h w"]]:
    """Images with the nearest known pixel's value at the others."""
    from scipy.ndimage import distance_transform_edt

    if bool(known.all()) or not bool(known.any()):
        return list(images)
    rows, columns = distance_transform_edt(~known.cpu().numpy(), return_distances=False, return_indices=True)
    at = torch.from_numpy(rows).to(known.device), torch.from_numpy(columns).to(known.device)
    return [image[at] for image in images]


def _enlarged(image: Float[Tensor, "h w"], size: tuple[int, ...]) -> Float[np.ndarray, "h0 w0"]:
    if image.shape != size:
        image = functional.interpolate(image[None, None], size=size, mode="bilinear", align_corners=False)[
            0, 0
        ]
    return np.asarray(image.cpu().numpy())
