"""How much of the fine-tuning to keep: a trial on training frames that its scene has never seen.

Virtual views are guesses. Where they are good they fill what was never observed; where they are not (a torn
surface, a restorer outside its training data) they spoil what was. The scene's own frames tell which: some
are left out, the whole chain runs briefly without them, and the trial's coarse and fine-tuned scenes are
compared on them. Held-out frames are never used.
"""

from __future__ import annotations

import logging
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np
import torch
from jaxtyping import Float, Int

from extrags.cameras import Cameras
from extrags.confidence import PerceptualDifference
from extrags.config import DEFAULT_PROFILE, PROFILES, CoarseConfig, EnhanceConfig, FinetuneConfig
from extrags.evaluation import render
from extrags.events import MetricRecorded, Progress, emit
from extrags.finetuning_judgement import Judgement, Trial, decide
from extrags.metrics.image import psnr_per_image
from extrags.metrics.lpips import MIN_SIDE_PX
from extrags.pseudo_views import PseudoViews
from extrags.restoration.protocol import Enhancer, among_kept, never_trained_on
from extrags.restoration.restored_renders import restored_shares
from extrags.restoration.trajectories import restored_batches
from extrags.scene import Scene
from extrags.sequence import EndoscopicSequence, Split
from extrags.threads import one_torch_thread
from extrags.training.finetuning import finetune
from extrags.training.frame_weights import FrameWeights, frame_weights
from extrags.training.leave_out import MIN_FRAMES, leave_out_folds, partial_scene, show_tissue

__all__ = ["AMOUNTS", "judge_finetuning"]

logger = logging.getLogger(__name__)

AMOUNTS = (1.0, 0.3, 0.1)
"""What is tried, as a factor of `finetune.pseudo_weight`, until one holds."""


MIN_LEFT_OUT = 4
"""Two or three frames say too little of how PSNR changes: then a trial leaves out others as well, in a second
reconstruction."""


SMALL_ERROR = 0.02
"""Of values in [0, 1]. Virtual views that at full weight add no more to the left-out frames than is hardly
seen are guesses good enough for holes; those of a restorer that does not know what it sees add several times
that."""


COMPARED_FRAMES = 8
"""Training frames that tell how much better the scene is than its brief reconstructions."""
SOLID = 0.98
"""Opacity of pixels that are compared for it."""


KEPT = (
    "the scene's own Gaussians stay as they are and new ones fill its holes, which was tried in a scene "
    "rebuilt from frames"
)
"""Of `finetune.keep_scene`, in words."""


@one_torch_thread()
def judge_finetuning(
    scene: Scene,
    sequence: EndoscopicSequence,
    trajectories: Sequence[Cameras],
    enhancer: Enhancer | None,
    config: FinetuneConfig | None = None,
    enhance: EnhanceConfig | None = None,
    coarse: CoarseConfig | None = None,
    *,
    measure: PerceptualDifference | None = None,
) -> Judgement:
    """Try the fine-tuning on left-out training frames, and decide how much of it to keep.

    One in `finetune.judge.leave_out_every` training frames is left out, in short runs; where that makes fewer
    than `MIN_LEFT_OUT`, others are in another reconstruction, and all count together. Without them the scene
    is reconstructed briefly under its own light, some of its virtual views are rendered from that scene and
    restored with references among the kept frames, and it is fine-tuned as the whole scene would be. The
    control is fine-tuning on the kept frames alone: a brief reconstruction gains by any further step. The
    largest of `AMOUNTS` is kept with which the left-out frames come within `finetune.judge.max_loss_db` of
    the coarse scene and, within noise, of the control (`Trial.holds`); else the control, if it holds against
    the coarse scene; else nothing. Where the control is what could be kept, it is tried as it would be run:
    with the cool-down of its light. If it holds, and virtual views did small harm (`SMALL_ERROR`), they are
    tried once more, on its holes alone (`finetune.holes_only`), and fill these where the left-out frames hold
    so, too: frames near the path see few holes, and cannot tell alone whether these are filled well.

    Args:
        scene: the coarse scene, trained on `sequence.train`; trials are optimised where it is.
        sequence: posed frames; only training frames are used.
        trajectories: virtual views of each trajectory, its real start first.
        enhancer: the scene's restorer; None, as no virtual view, leaves the control alone. One that was
            trained on the scene has learned from frames that are left out here: what it was before restores
            in its place.
        config: settings of the fine-tuning; None takes those of the profile `balanced`.
        enhance: settings of the restoration; None takes those of the profile `balanced`.
        coarse: settings the scene was reconstructed with; None takes those of the profile `balanced`.
        measure: behind the pixel-level confidence; None takes LPIPS where its weights can be found.

    Returns:
        The judgement; with fewer than four training frames, or the judge switched off, everything is kept.

    Raises:
        DivergedError: when an optimisation does not stay finite.
    """
    config = PROFILES[DEFAULT_PROFILE].finetune if config is None else config
    enhance = PROFILES[DEFAULT_PROFILE].enhance if enhance is None else enhance
    coarse = PROFILES[DEFAULT_PROFILE].coarse if coarse is None else coarse
    settings, n_frames = config.judge, len(sequence.train)
    if not settings.enabled:
        return Judgement(1.0, "not judged: finetune.judge.enabled is off")
    if n_frames < MIN_FRAMES:
        return Judgement(
            1.0, f"not judged: of {n_frames} training frames none can be left out (at least {MIN_FRAMES})"
        )
    # As in restoration: the start of a trajectory is real.
    trajectories = [cameras for cameras in trajectories if len(cameras) > 1]
    enhancer = None if enhancer is None or not trajectories else never_trained_on(enhancer)
    arms = list(_arms(scene, sequence, trajectories, enhancer, config, enhance, coarse, measure))
    if not arms:
        return Judgement(1.0, "not judged: no training frame with a valid pixel can be left out")
    scenes: dict[float | None, list[Scene]] = {None: [arm.start for arm in arms]}
    before = _psnr_of_arms(arms, scenes[None])
    # The control of virtual views differs from them in nothing else, and so has no cool-down either.
    scenes[0.0] = _finetuned(arms, 0.0, config, coarse, cooldown=enhancer is None)
    control = _psnr_of_arms(arms, scenes[0.0])
    trials = [_trial(0.0, before, control, control)]
    for amount in AMOUNTS if enhancer is not None else ():
        scenes[amount] = _finetuned(arms, amount, config, coarse)
        trials.append(_trial(amount, before, _psnr_of_arms(arms, scenes[amount]), control))
        if trials[-1].holds(settings.max_loss_db):
            break
    if (
        enhancer is not None
        and not trials[-1].holds(settings.max_loss_db)
        and config.light_cooldown_share > 0
    ):
        # What could still be kept is real views alone, whose light then comes to rest.
        scenes[0.0] = _finetuned(arms, 0.0, config, coarse, cooldown=True)
        control = _psnr_of_arms(arms, scenes[0.0])
        trials[0] = _trial(0.0, before, control, control)
    filled: list[Scene] = []
    if (
        enhancer is not None
        and trials[0].holds(settings.max_loss_db)
        and not trials[-1].holds(settings.max_loss_db)
        and trials[1].added_error(trials[0]) <= SMALL_ERROR
        and not config.keep_scene
        and not config.holes_only
    ):
        filled = _filled(arms, scenes[0.0], config, coarse)
        trials.append(replace(_trial(1.0, before, _psnr_of_arms(arms, filled), control), holes_only=True))
    for trial in trials:
        where = "in_holes" if trial.holes_only else f"at_{trial.amount:g}"
        emit(MetricRecorded("finetune", f"left_out_gain_db_{where}", trial.gain_db))
    left = np.sort(np.concatenate([arm.left_out for arm in arms]))
    judgement = decide(trials, settings.max_loss_db, left)
    if config.keep_scene:
        judgement = replace(judgement, reason=f"{KEPT}; {judgement.reason}")
    if enhancer is not None:
        share = np.mean([_error_share(scene, sequence, arm.start, arm.sequence) for arm in arms])
        finals = filled if judgement.holes_only else scenes[judgement.amount]
        shown = (
            (arm.start, render(final, arm.sequence), arm.sequence)
            for arm, final in zip(arms, finals, strict=True)
        )
        shares = restored_shares(
            shown, enhancer, enhance, error_share=float(share), kept=[arm.kept for arm in arms]
        )
        judgement = replace(judgement, restored_shares=shares)
    logger.info("finetune: %s", judgement.reason)
    return judgement


@dataclass(frozen=True)
class _Arm:
    """A brief reconstruction without some training frames, and what it is fine-tuned on.

    Args:
        sequence: the frames, at the size of trials; those left out are held out.
        left_out: their positions among the training frames.
        kept: the positions of the others.
        start: the brief reconstruction.
        views: its virtual views, restored; None without a restorer.
        frame_weights: of the frames it was made from; None where they count alike.
    """

    sequence: EndoscopicSequence
    left_out: Int[np.ndarray, "m"]
    kept: Int[np.ndarray, "k"]
    start: Scene
    views: PseudoViews | None
    frame_weights: FrameWeights | None


def _arms(
    scene: Scene,
    sequence: EndoscopicSequence,
    trajectories: Sequence[Cameras],
    enhancer: Enhancer | None,
    config: FinetuneConfig,
    enhance: EnhanceConfig,
    coarse: CoarseConfig,
    measure: PerceptualDifference | None,
) -> Iterator[_Arm]:
    """The brief reconstructions, with arguments as `judge_finetuning`."""
    settings = config.judge
    frames = np.asarray(sequence.train, dtype=np.int64)
    small = sequence.at_most_width(settings.max_width)
    for part, left_out in _without_some_frames(small, frames, settings.leave_out_every):
        kept = np.flatnonzero(np.isin(frames, part.train))
        # Once for the brief reconstruction and all amounts.
        weighted = coarse.inconsistent_frames == "weight"
        weights = frame_weights(part, part.train) if weighted else None
        start = partial_scene(
            scene,
            replace(part, split=sequence.split),
            coarse,
            part.train,
            iterations=max(1, round(settings.iterations_share * coarse.iterations)),
            seed=config.seed,
            stage="finetune-judge",
            frame_weights=weights,
        )
        views = None
        if enhancer is not None:
            smaller = [cameras.at_most_width(settings.max_width) for cameras in trajectories]
            restorer = among_kept(enhancer, kept)
            views = _restored(start, part, smaller, restorer, enhance, settings.views, measure)
        yield _Arm(part, left_out, kept, start, views, weights)


def _finetuned(
    arms: Sequence[_Arm],
    amount: float,
    config: FinetuneConfig,
    coarse: CoarseConfig,
    *,
    cooldown: bool = False,
) -> list[Scene]:
    """The brief reconstructions after fine-tuning as brief, on real views alone for an amount of 0."""
    brief = _brief(config)
    changes = {"light_cooldown_share": config.light_cooldown_share if cooldown else 0.0}
    if amount > 0:
        changes["pseudo_weight"] = amount * config.pseudo_weight
    brief = brief.model_copy(update=changes)
    return [
        finetune(
            arm.start,
            arm.sequence,
            arm.views if amount > 0 else None,
            brief,
            coarse,
            stage="finetune-judge",
            frame_weights=arm.frame_weights,
        ).scene
        for arm in arms
    ]


def _filled(
    arms: Sequence[_Arm], scenes: Sequence[Scene], config: FinetuneConfig, coarse: CoarseConfig
) -> list[Scene]:
    """The scenes of real views alone, with their holes filled from virtual ones, as briefly."""
    filling = _brief(config).model_copy(update={"holes_only": True}).parts[-1]
    return [
        finetune(
            scene,
            arm.sequence,
            arm.views,
            filling,
            coarse,
            stage="finetune-judge",
            frame_weights=arm.frame_weights,
        ).scene
        for arm, scene in zip(arms, scenes, strict=True)
    ]


def _brief(config: FinetuneConfig) -> FinetuneConfig:
    """Settings of a trial."""
    # Whether guesses harm shows in the first round; the others go on from what it makes.
    config = config.first_round
    iterations = max(1, round(config.judge.iterations_share * config.iterations))
    return config.model_copy(update={"iterations": iterations})


def _psnr_of_arms(arms: Sequence[_Arm], scenes: Sequence[Scene]) -> list[float]:
    """PSNR of all frames left out, each in the scene that was made without it."""
    return [value for arm, scene in zip(arms, scenes, strict=True) for value in _psnr_db(scene, arm.sequence)]


def _without_some_frames(
    sequence: EndoscopicSequence, frames: Int[np.ndarray, "n"], every: int
) -> Iterator[tuple[EndoscopicSequence, Int[np.ndarray, "m"]]]:
    """The sequence with splits that hold out some training frames, and their positions among these.

    One split leaves out a share of the frames; where that makes fewer than `MIN_LEFT_OUT`, others follow.
    Frames without a valid pixel tell nothing: they are not among those left out, nor is a scene made of them.
    """
    folds = leave_out_folds(frames, every)
    # From the middle: the first fold would leave out the ends of the path, which nothing surrounds.
    count = 0
    for fold in sorted(range(len(folds)), key=lambda fold: (abs(fold - len(folds) // 2), -fold)):
        kept, left = folds[fold]
        left = left[[bool(sequence.mask[frame].any()) for frame in left]]
        if not len(left) or not show_tissue(sequence, kept):
            continue
        yield replace(sequence, split=Split("leave-out", kept, left)), np.flatnonzero(np.isin(frames, left))
        count += len(left)
        if count >= MIN_LEFT_OUT:
            return


def _restored(
    scene: Scene,
    sequence: EndoscopicSequence,
    trajectories: Sequence[Cameras],
    enhancer: Enhancer,
    enhance: EnhanceConfig,
    max_views: int,
    measure: PerceptualDifference | None,
) -> PseudoViews:
    fewer = enhance.model_copy(update={"max_views": max_views})
    measure = PerceptualDifference.available() if measure is None else measure
    if min(sequence.width, sequence.height) < MIN_SIDE_PX:
        # Trials are small; what is fine-tuned after them may be large enough for LPIPS itself.
        measure = replace(measure, raw=False)
    parts: list[PseudoViews] = []
    for part in restored_batches(scene, sequence, trajectories, enhancer, fewer, measure):
        parts.append(part)
        emit(Progress("finetune-judge", len(parts), fewer.batches(len(trajectories))))
    return PseudoViews.concatenated(parts).quantised()


def _psnr_db(scene: Scene, sequence: EndoscopicSequence) -> list[float]:
    """PSNR of each held-out frame of a sequence inside its mask; frames without valid pixels are omitted."""
    renders = render(scene, sequence)
    truth = torch.from_numpy(sequence.rgb[sequence.test].astype(np.float32) / 255)
    mask = torch.from_numpy(sequence.mask[sequence.test])
    values = psnr_per_image(torch.from_numpy(renders.rgb).clamp(0, 1), truth, mask)
    return [value for value in values if value is not None]


def _error_share(scene: Scene, sequence: EndoscopicSequence, brief: Scene, part: EndoscopicSequence) -> float:
    """Squared error of the scene as a share of a brief reconstruction's, on frames that both were made with.

    Args:
        scene: the coarse scene.
        sequence: its frames.
        brief: the brief one.
        part: the frames it was made with, which may be smaller.
    """
    places = np.linspace(0, len(part.train) - 1, min(COMPARED_FRAMES, len(part.train)))
    frames = part.train[places.round().astype(np.int64)]
    truth = part.rgb[frames].astype(np.float32) / 255
    errors = []
    for shown, its_frames in ((scene, sequence), (brief, part)):
        views = render(shown, its_frames, frames)
        solid = [_resized(alpha, part) > SOLID for alpha in views.alpha]
        rgb = [_resized(view.clip(0, 1), part) for view in views.rgb]
        errors.append((np.square(np.stack(rgb) - truth), np.stack(solid) & part.mask[frames]))
    known = errors[0][1] & errors[1][1]
    own, other = (float(squares[known].mean()) if known.any() else 1.0 for squares, _ in errors)
    return own / max(other, 1e-9)


def _resized(image: Float[np.ndarray, "..."], like: EndoscopicSequence) -> Float[np.ndarray, "..."]:
    import cv2

    if image.shape[:2] == (like.height, like.width):
        return image
    return np.asarray(cv2.resize(image, (like.width, like.height), interpolation=cv2.INTER_AREA))


def _trial(amount: float, before: list[float], after: list[float], control: list[float]) -> Trial:
    """Of PSNR of each left-out frame: before the fine-tuning, after it, and after the control's."""
    gain, error = _mean_and_error(np.array(after) - np.array(before))
    return Trial(
        amount,
        float(np.mean(before)),
        float(np.mean(after)),
        gain,
        error,
        *_mean_and_error(np.array(after) - np.array(control)),
    )


def _mean_and_error(values: Float[np.ndarray, "n"]) -> tuple[float, float]:
    error = values.std(ddof=1) / np.sqrt(len(values)) if len(values) > 1 else 0.0
    return float(values.mean()), float(error)
