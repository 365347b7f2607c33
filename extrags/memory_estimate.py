"""How much memory a run will need at most, from the size of its frames and its settings.

A model of what each stage holds at its peak, in bytes per pixel, frame and Gaussian. It states an upper
bound for the usual case, not an average: stages that share a process keep what the largest of them took.

The constants were read off the peaks that runs recorded (`peak_mib` of their artefacts); see
docs/running_at_scale.md.
"""

from __future__ import annotations

from bisect import bisect_left
from collections.abc import Collection
from dataclasses import dataclass, replace

from extrags.config import PipelineConfig, UcNerfConfig
from extrags.frame_stacks import MAPPED_BYTES
from extrags.stages import StageName, stages_until

__all__ = ["FrameSize", "MemoryEstimate", "estimate_memory", "fitting_settings"]

GB = 1e9

PROCESS = 700_000_000
"""Interpreter, libraries and the flow, before anything is read."""
SEQUENCE_STACKS = (3, 1, 1, 4, 4)
"""Bytes per pixel of the stacks of a sequence: colours, two masks, two of depth."""
DECODED = 60
"""Bytes per source pixel of the frame that is being read, with its resampling grid."""
TRAINING_STACKS = (1, 4, 4, 4)
"""Bytes per pixel of the stacks of training views: weights, depth inside the mask, its confidence, and the
depth that new Gaussians must not hide."""
COMPARED = 36
"""Bytes per pixel of a training frame, at the width at which blurred and moved frames are looked for."""
COMPARED_WIDTH = 320
"""That width (`extrags.training.frame_comparison`, which loads more than an estimate needs)."""
DEPTH_FRAME = 195
"""Bytes per pixel of a training frame, at the width it is matched at, while its depth is estimated."""
DEPTH_STACKS = (3, 1, 4, 4)
"""Bytes per pixel of copies of training frames then, and of their depth with its error."""
FEATURES = 350
"""Bytes per pixel of a frame and thread while COLMAP finds features, in a process of its own."""
STEP = 140
"""Bytes per pixel of the image of one optimisation step: rendering, loss and their gradients."""
GAUSSIAN = 2400
"""Bytes of a Gaussian with all harmonics while it is optimised: parameters, gradients, moments, tiles."""
PAIR = 325
"""Bytes per pixel of a leave-out pair while the restorer is prepared: its layers."""
REFERENCE = 64
"""Bytes per pixel of a training frame that is carried into virtual views."""
CLIP = 360
"""Bytes per pixel of a view of a batch: layers, conditioning and what is made of it."""
NETWORK = 6000
"""Bytes per pixel and thread of the network's working set, four views at once."""
PSEUDO_VIEW = 220
"""Bytes per pixel of a restored view: when batches are joined, and as a target of the fine-tuning."""
METRICS = 750
"""Bytes per pixel and thread of the images that metrics are computed on at once, LPIPS of the small backbones
included."""
METRICS_VGG = 1750
"""The same with the features of LPIPS-VGG."""
ENLARGED = 300
"""Bytes per pixel of a held-out view that is mixed with its restored one at the full size and given texture,
and of what earlier stages keep of such a size."""
CLIP_VIEWS = 8
"""Held-out views that are restored at once (`extrags.restoration.benchmark.evaluation`, which loads more)."""
RENDERED_STACKS = (12, 4, 4)
"""Bytes per pixel of the stacks of rendered held-out views: colours, opacity, depth."""
RESTORED_STACKS = (12,)
"""The same of restored ones, which share opacity and depth with those they were made from."""
TRUE_SURFACE_STACKS = (4,)
"""Bytes per pixel of all frames, of the depth that the true surface is fused from."""
SHOWN = 125
"""Bytes per pixel of a held-out view that the page shows: images, depth and errors of all renders."""
PSEUDO_LOADED = 60
"""Bytes per pixel of restored views as they are read: their 8 bits become floats, in memory."""
FUSED_STACKS = (4, 4, 4, 4)
"""Bytes per pixel of the stacks of rendered training views: depth, and what is made of it to be fused."""
PIXELS_MEASURED_AT_ONCE = 400_000
UC_NERF_STEP = 90_000_000
UC_NERF_RENDER = 165_000_000
"""Bytes of a step of the baseline, and of rendering a view of it, beside what depends on settings."""
UC_NERF_CELL = 1500
"""Bytes per cell of its cost volumes, with gradients; without them they take little."""
UC_NERF_SAMPLE = 1600
"""Bytes per sample of a step's rays and source view."""
UC_NERF_RENDERED_SAMPLE = 2_800_000
"""Bytes per sample of a ray and source view, for as many rays as are rendered at once."""
UC_NERF_FRAME = 18
"""Bytes per pixel of a training frame."""
UC_NERF_FEATURES = 450
"""Bytes per pixel of both levels of the features of a training frame, from which views are rendered."""
UC_NERF_VIEW = 1280
"""Bytes per pixel of the view that is rendered."""
SMALLEST_WIDTH = 32
STEPS = {"enhance.max_width": 16, "enhance.max_views": 8, "ingest.width": 16}
"""What settings are multiples of when they are named: an estimate is no finer."""


@dataclass(frozen=True)
class FrameSize:
    """What is known of a sequence before it is reconstructed.

    Args:
        frames: of the sequence, held-out ones included.
        training_frames: of these.
        width: in pixels, as the frames are used (after `ingest.*`).
        height: in pixels.
        source_pixels: of one frame on disk; None: as many as are used.
        held_out_frames: of these; None: all that are no training frames. Fewer where frames are in neither
            part, as those that show nothing.
    """

    frames: int
    training_frames: int
    width: int
    height: int
    source_pixels: int | None = None
    held_out_frames: int | None = None


@dataclass(frozen=True)
class MemoryEstimate:
    """Peak memory of a run by stage.

    Args:
        by_stage: bytes, in the order of the stages.
    """

    by_stage: dict[StageName, int]

    @property
    def stage(self) -> StageName:
        """The stage that needs most."""
        return max(self.by_stage, key=lambda name: self.by_stage[name])

    @property
    def peak_bytes(self) -> int:
        """What that stage needs."""
        return self.by_stage[self.stage]

    @property
    def peak_gb(self) -> float:
        """The same in GB (1e9 bytes)."""
        return self.peak_bytes / GB

    def __str__(self) -> str:
        return f"at most about {self.peak_gb:.1f} GB, in {self.stage}"


def estimate_memory(
    config: PipelineConfig,
    size: FrameSize,
    *,
    threads: int = 2,
    until: StageName = "report",
    leave_out: Collection[str] = (),
) -> MemoryEstimate:
    """Peak resident memory of a run, stage by stage.

    Restorers other than `embedded` and `classical` bring the memory of their own models, which is not
    counted, and neither is what several sequences or workers at once add.

    Args:
        config: settings of all stages.
        size: of the sequence.
        threads: that work at the same time.
        until: last stage.
        leave_out: stages that the method leaves out.
    """
    pixels = size.width * size.height
    share = min(1.0, config.enhance.working_width(size.width) / size.width)
    working = round(pixels * share**2)
    train, all_frames = size.training_frames, size.frames
    source = pixels if size.source_pixels is None else size.source_pixels
    explored = "explore" not in leave_out and "enhance" not in leave_out
    views = config.enhance.max_views if explored else 0
    harmonics = ((config.coarse.sh_degree + 1) ** 2 + 15) / 31
    coarse_gaussians = max(config.coarse.max_points, config.coarse.densify.max_gaussians)
    gaussian = GAUSSIAN * min(1.0, harmonics)
    held = PROCESS + _held(SEQUENCE_STACKS, train * pixels)
    compared = round(pixels * min(1.0, COMPARED_WIDTH / size.width) ** 2)
    if config.coarse.inconsistent_frames == "ignore":
        compared = 0

    def steps(frames: int) -> int:
        """What the optimisation holds beside Gaussians, of so many frames."""
        return _held(TRAINING_STACKS, frames * pixels) + max(STEP * pixels, COMPARED * frames * compared)

    batch_views = min(views, config.enhance.clips_per_batch * (config.explore.length + 1))
    network = NETWORK * threads * working if config.enhance.backend == "embedded" else 0
    references = REFERENCE * train * working
    fused = round(pixels * min(1.0, config.surface.max_width / size.width) ** 2)
    matched = round(pixels * min(1.0, config.depth.max_width / size.width) ** 2)
    looked_at = round(pixels * min(1.0, config.poses.max_width / size.width) ** 2)
    features = FEATURES * threads * looked_at
    in_test = all_frames - train if size.held_out_frames is None else size.held_out_frames
    held_out = max(1, in_test)
    # Each thread has images of its own, as long as there are some.
    measured = min(threads * max(pixels, PIXELS_MEASURED_AT_ONCE), held_out * pixels)
    metrics = (METRICS_VGG if "vgg" in config.evaluate.lpips_nets else METRICS) * measured
    whole = PROCESS + _held(SEQUENCE_STACKS, all_frames * pixels)
    rendered = _held(RENDERED_STACKS, held_out * pixels)
    true_surface = _held(TRUE_SURFACE_STACKS, all_frames * pixels)
    # The oracle alone optimises with held-out frames too.
    trained_on = train + in_test if config.coarse.train_on == "all" else train
    # Held-out views are restored as well, in clips.
    restored = (
        references
        + CLIP * CLIP_VIEWS * working
        + network
        + ENLARGED * min(CLIP_VIEWS, held_out) * pixels
        + _held(RESTORED_STACKS, held_out * pixels)
    )
    if not explored or config.evaluate.restored == "none":
        restored = 0
    # The views of all renders are measured together: coarse, final, restored.
    stacks = 1 + ("finetune" not in leave_out) + (restored > 0)
    found: dict[StageName, float] = {
        "ingest": whole + DECODED * source,
        "poses": whole + features,
        "depth": held + _held(DEPTH_STACKS, train * pixels) + max(features, DEPTH_FRAME * train * matched),
        "coarse": PROCESS
        + _held(SEQUENCE_STACKS, trained_on * pixels)
        + steps(trained_on)
        + gaussian * coarse_gaussians,
        "surface": held + _held(FUSED_STACKS, train * fused),
        # It keeps what the surface took before it in the same process, and renders smaller views itself.
        "explore": held + _held(FUSED_STACKS, train * fused),
        "enhance": held
        + max(
            # The judge of the restorer runs the network beside the pairs.
            PAIR * _pairs(config, train) * working + references + network,
            references + CLIP * batch_views * working + network,
            PSEUDO_VIEW * views * working,
        ),
        "finetune": held
        + steps(train)
        + gaussian * config.finetune.growth * coarse_gaussians
        + PSEUDO_VIEW * views * working,
        "evaluate": whole + max(stacks * rendered + metrics, rendered + max(restored, true_surface)),
        "report": whole
        + stacks * rendered
        + SHOWN * min(config.report.held_out_views, held_out) * pixels
        + PSEUDO_LOADED * views * working,
    }
    if config.uc_nerf.enabled:
        trained, shown = _uc_nerf(config.uc_nerf, size)
        found |= {"coarse": held + trained, "evaluate": whole + rendered + max(metrics, shown)}
    wanted = [stage for stage in stages_until(until) if stage not in leave_out]
    return MemoryEstimate({stage: round(found[stage]) for stage in wanted if stage in found})


def _held(stacks: Collection[int], pixels: int) -> int:
    """Bytes in memory of stacks of so many pixels in all, of which larger ones are mapped files."""
    return sum(min(size * pixels, MAPPED_BYTES) for size in stacks)


def _uc_nerf(given: UcNerfConfig, size: FrameSize) -> tuple[int, int]:
    """Bytes that the baseline takes while it is trained, and while a view of it is rendered."""
    pixels = size.width * size.height
    height = max(1, round(given.stereo_width * size.height / size.width))
    # The fine volume has twice the width and the height of the coarse one.
    level = given.stereo_width * height
    cells = level * (given.coarse_planes + 4 * given.fine_planes)
    samples = given.source_views * (given.samples_uniform + given.samples_prior)
    rays = given.rays + given.patches * given.patch_px**2 + given.sparse_pixels
    frames = size.training_frames * pixels
    trained = UC_NERF_STEP + UC_NERF_CELL * cells + UC_NERF_SAMPLE * samples * rays + UC_NERF_FRAME * frames
    shown = (
        UC_NERF_RENDER
        + UC_NERF_RENDERED_SAMPLE * samples
        + UC_NERF_FRAME * frames
        + UC_NERF_FEATURES * size.training_frames * 5 * level
        + UC_NERF_VIEW * pixels
    )
    return trained, shown


def _pairs(config: PipelineConfig, training_frames: int) -> int:
    """How many pairs the restorer is prepared with: two of every training frame, and synthetic ones."""
    given = config.enhance
    if given.backend != "embedded":
        return 0
    if given.train_iterations > 0 or given.pretrained_weights == "none":
        return 2 * training_frames + given.synthetic_views
    return min(2 * training_frames, given.judge_pairs) if given.judge else 0


def fitting_settings(
    config: PipelineConfig,
    size: FrameSize,
    limit_gb: float,
    *,
    threads: int = 2,
    until: StageName = "report",
    leave_out: Collection[str] = (),
    fixed: Collection[str] = (),
) -> dict[str, int] | None:
    """Settings that bring a run below a limit, those that cost least quality first.

    Tried are, one after the other and together with those before: virtual views of smaller size
    (`enhance.max_width`), fewer of them (`enhance.max_views`), smaller frames (`ingest.width`). Once a run
    fits, each of these is raised as far as it still does, in the opposite order.

    Args:
        config: settings of all stages.
        size: of the sequence.
        limit_gb: in GB (1e9 bytes).
        threads: as `estimate_memory`.
        until: as `estimate_memory`.
        leave_out: as `estimate_memory`.
        fixed: settings that are to stay as they are.

    Returns:
        Dotted names and values; empty where nothing has to change, None where nothing that is tried helps.
    """
    changed: dict[str, int] = {}

    def fits(changes: dict[str, int]) -> bool:
        share = changes.get("ingest.width", size.width) / size.width
        smaller = replace(size, width=round(size.width * share), height=round(size.height * share))
        settings = config.with_overrides(changes)
        estimate = estimate_memory(settings, smaller, threads=threads, until=until, leave_out=leave_out)
        return estimate.peak_gb <= limit_gb

    if fits(changed):
        return changed

    def raised(name: str, now: int) -> dict[str, int]:
        """The changes with one of them as large as still fits; without it where nothing needs to change."""
        others = {other: kept for other, kept in changed.items() if other != name}
        if fits(others):
            return others
        step = STEPS[name]
        larger = range((changed[name] // step + 1) * step, now, step)
        # Memory grows with each of them.
        fitting = bisect_left(larger, True, key=lambda value: not fits({**changed, name: value}))
        return changed if fitting == 0 else {**changed, name: larger[fitting - 1]}

    ways: dict[str, tuple[int, list[int]]] = {
        "enhance.max_width": (config.enhance.working_width(size.width), [320, 240, 160]),
        "enhance.max_views": (config.enhance.max_views, [160, 96, 48]),
        "ingest.width": (size.width, [size.width * part // 4 for part in (3, 2, 1)]),
    }
    for name, (now, values) in ways.items():
        for value in values if name not in fixed else ():
            if not SMALLEST_WIDTH <= value < now:
                continue
            changed[name] = value
            if fits(changed):
                # Steps were large, and what was tried before may not be needed any more.
                for earlier in reversed(list(changed)):
                    changed = raised(earlier, ways[earlier][0])
                if "ingest.width" in changed and config.ingest.height is not None:
                    # A height that was given belongs to the width that was given with it.
                    changed["ingest.height"] = round(size.height * changed["ingest.width"] / size.width)
                return changed
    return None
