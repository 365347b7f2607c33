"""Joint fine-tuning on real views and confidence-weighted pseudo-observations."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import torch

from extrags.config import DEFAULT_PROFILE, PROFILES, CoarseConfig, FinetuneConfig
from extrags.facing import with_facing
from extrags.gaussians import Gaussians
from extrags.pseudo_views import PseudoViews
from extrags.scene import Scene
from extrags.sequence import EndoscopicSequence
from extrags.threads import one_torch_thread
from extrags.training.filling import FillingStep, filling_schedule
from extrags.training.frame_weights import FrameWeights, weighted_views
from extrags.training.frame_weights import frame_weights as found_weights
from extrags.training.hole_gaussians import hole_gaussians
from extrags.training.optimise import TrainingResult, optimise
from extrags.training.reconstruction import coarse_schedule, scene_extent, smallest_footprint
from extrags.training.starting import median_depth
from extrags.training.views import View, epochs, real_views
from extrags.training.virtual_views import shown_again, virtual_steps, virtual_views

__all__ = ["finetune"]

MAX_GUESS_DISTANCE = 1.0
"""In median depths. Farther from known surface completed depth says nothing; nearer, a wall at a third too
short a distance is less wrong than none at all."""


def finetune(
    scene: Scene,
    sequence: EndoscopicSequence,
    pseudo_views: PseudoViews | Callable[[], PseudoViews] | None,
    config: FinetuneConfig | None = None,
    coarse: CoarseConfig | None = None,
    *,
    stage: str = "finetune",
    frame_weights: FrameWeights | None = None,
) -> TrainingResult:
    r"""Fine-tune a scene on real and virtual views together.

    With P pixels in an image, :math:`\ell_1 = \sum_c |I - \hat I| / 3` and
    :math:`\ell_s = \sum_c (1 - \mathrm{SSIM}_c) / 6` of each of them, a virtual view's loss is

    .. math:: w \, U_{img} \Bigl( \frac{\phi}{Z} \sum_p \bigl( (1 - \lambda) \, U_{pixel} \, \ell_1
            + \lambda \, s \, \ell_s \bigr) + w_d \, L_{depth} \Bigr)

    with w the `pseudo_weight`, :math:`\phi` the `photometric_weight` and :math:`U_{pixel}` not below
    `confidence_floor`. `loss` chooses Z and s: `weighted_mean` :math:`Z = \sum_p U_{pixel}` and
    :math:`s = U_{pixel}`, in which the magnitude of :math:`U_{pixel}` cancels; `weighted_sum` Z = P and
    :math:`s = U_{pixel}`; `paper` Z = P and s = 1. For a real view w, :math:`U_{img}` and :math:`U_{pixel}`
    are one and sums are over its valid pixels. The depth term, for virtual views with `pseudo_depth` alone,
    is `inverse_depth_loss`; there on pixels whose surface the scene does not know.

    [ExtraGS, eq. 24 and 25] are loss `paper`, `dssim_weight` 2/3 and `photometric_weight` 3, which is
    L1 + (1 - SSIM), the D-SSIM of the published code; `pseudo_weight` 1, `confidence_floor` 0, `depth_weight`
    0, and U_pixel from `enhance.pixel_confidence` raw.

    Which kind a step draws follows a fixed pattern whose share of virtual views falls linearly. The position
    learning rate starts anew. Seeds and densification together may bring the scene to `growth` times the
    coarse limit. Without pseudo-observations only real views are used, and the light cools down
    (`light_cooldown_share`): with them, half of the steps hold the brightness.

    With virtual views the iterations fall into `rounds`. In each but the first, these views are compared with
    what was restored and what the scene has become, mixed (`shown_again`), holes that are left get new
    Gaussians, and pattern and learning rates start anew.

    With `coarse.one_sided` the scene is told from which side the views saw its Gaussians
    (`extrags.facing.with_facing`).

    With `keep_scene` the scene's own Gaussians and its light stay as they are: only new ones in holes are
    learned, without densification; where there are none, the Gaussians are returned as they were given.

    With `holes_only` virtual views do no more than that: real views alone train the scene first, with all
    iterations, and then virtual ones fill its holes with half as many.

    Args:
        scene: the coarse scene; the optimisation runs where it is, and so does the result.
        sequence: posed frames; only training frames are used.
        pseudo_views: restored virtual views with confidences, or None; or what loads them, once a round, so
            that they are not in memory while the scene is optimised.
        config: budgets and shares; None takes those of the profile `balanced`.
        coarse: rates and weights, those the coarse scene was made with; None takes those of the profile
            `balanced`.
        stage: named in progress events.
        frame_weights: of the training frames, where they are known from the reconstruction; None looks for
            blurred frames where `coarse.inconsistent_frames` is `weight`.

    Raises:
        DivergedError: when the optimisation does not stay finite.
        ShapeError: for weights of other frames.

    Source: [ExtraGS, eq. 24] (training views) and [ExtraGS, eq. 25] (virtual views), see
    docs/references.md; their depth term is our own.
    """
    # Not as a decorator, which would hold the virtual views for its caller.
    with one_torch_thread():
        config = PROFILES[DEFAULT_PROFILE].finetune if config is None else config
        coarse = PROFILES[DEFAULT_PROFILE].coarse if coarse is None else coarse
        parts = config.parts
        if pseudo_views is None:
            parts = (config.model_copy(update={"rounds": 1, "holes_only": False}),)
        load = pseudo_views if callable(pseudo_views) else _loaded_once(pseudo_views, parts[-1].rounds)
        del pseudo_views
        seen_from = [sequence.cameras[sequence.train]]

        def remembered() -> PseudoViews | None:
            views = load()
            if views is not None and len(seen_from) == 1:
                seen_from.append(views.cameras)
            return views

        rounds = [(part, number) for part in parts for number in range(part.rounds)]
        if len(rounds) > 1 and coarse.inconsistent_frames == "weight" and frame_weights is None:
            # Once for all rounds.
            frame_weights = found_weights(sequence, sequence.train)
        current, history, before = scene, [], 0
        for part, number in rounds:
            if number == 0:
                fixed = len(current.gaussians)
            found = _round(
                number,
                current,
                remembered if part is parts[-1] else _no_views,
                sequence,
                part,
                coarse,
                stage=stage,
                frame_weights=frame_weights,
                fixed=fixed,
                iterations_before=before,
                iterations_in_all=sum(each.iterations for each in parts),
            )
            history += [{**entry, "iteration": entry["iteration"] + before} for entry in found.history]
            before += part.steps_of_rounds[number]
            current = found.scene
        if coarse.one_sided:
            current = with_facing(current, seen_from)
        return TrainingResult(current, history)


def _loaded_once(pseudo_views: PseudoViews | None, rounds: int) -> Callable[[], PseudoViews | None]:
    """What hands virtual views out that are in memory anyway; in the last round, for good."""
    held = [pseudo_views] * rounds
    return held.pop


def _no_views() -> None:
    """What real views alone load."""


def _round(
    number: int,
    scene: Scene,
    load: Callable[[], PseudoViews | None],
    sequence: EndoscopicSequence,
    config: FinetuneConfig,
    coarse: CoarseConfig,
    *,
    stage: str,
    frame_weights: FrameWeights | None,
    fixed: int,
    iterations_before: int,
    iterations_in_all: int,
) -> TrainingResult:
    """One round of `finetune`; with `keep_scene` the first `fixed` Gaussians stay as they are."""
    frames, last = sequence.train, number == config.rounds - 1
    depth = median_depth(sequence, frames)
    growth = config.growth if last else config.growth_before_last
    max_gaussians = round(growth * coarse.densify.max_gaussians)
    start, pseudo_views = scene, load()
    cooldown_share = config.light_cooldown_share if pseudo_views is None else 0.0
    if pseudo_views is not None:
        targets, alpha = pseudo_views, None
        if number > 0 and len(pseudo_views):
            targets, alpha = shown_again(pseudo_views, scene, config)
        if config.seed_holes:
            room = max_gaussians - len(scene.gaussians)
            new = hole_gaussians(
                scene.to("cpu"),
                sequence,
                pseudo_views,
                room,
                thickness=coarse.thickness,
                max_distance=MAX_GUESS_DISTANCE * depth,
                alpha=alpha,
            )
            if new is not None:
                grown = Gaussians.concatenated(scene.gaussians, new.to(scene.device))
                start = Scene(grown, scene.light)
        pseudo_views = targets
        del targets
    if config.keep_scene and len(start.gaussians) == fixed:
        return TrainingResult(scene.detached(), [])
    steps = config.steps_of_rounds[number]
    own = config.model_copy(update={"iterations": steps, "rounds": 1})
    draw = _draws(sequence, pseudo_views, own, coarse, frame_weights, scene.device)
    # A caller that keeps none either has their floats out of memory while the scene is optimised.
    del pseudo_views
    densify = {"start_share": 0.0, "stop_share": config.densify_share, "max_gaussians": max_gaussians}
    schedule = coarse_schedule(
        _with_loss_weights(coarse, config),
        scene_extent(sequence, frames),
        depth,
        stage,
        iterations=steps,
        densify=coarse.densify.model_copy(update=densify),
    )
    # All harmonics are active from the first step: the scene is optimised already.
    schedule = replace(
        schedule,
        photometric_weight=config.photometric_weight,
        light_cooldown_share=cooldown_share,
        iterations_before=iterations_before,
        iterations_after=iterations_in_all - iterations_before - steps,
    ).resumed(seed=config.seed)
    if config.keep_scene:
        return optimise(
            start,
            draw,
            filling_schedule(schedule),
            make_step=lambda scene, schedule: FillingStep(scene, schedule, fixed),
        )
    footprint = smallest_footprint(coarse, sequence.cameras[frames])
    return optimise(start, draw, schedule, footprint=footprint)


def _draws(
    sequence: EndoscopicSequence,
    pseudo_views: PseudoViews | None,
    config: FinetuneConfig,
    coarse: CoarseConfig,
    frame_weights: FrameWeights | None,
    device: torch.device,
) -> Callable[[int], View]:
    """What each iteration draws: a real or a virtual view, by the pattern of `virtual_steps`."""
    if coarse.inconsistent_frames == "weight":
        real, _ = weighted_views(sequence, sequence.train, coarse, frame_weights)
    else:
        real = real_views(sequence, sequence.train)
    virtual = [] if pseudo_views is None else virtual_views(pseudo_views, config)
    real, virtual = ([view.to(device) for view in views] for views in (real, virtual))
    generator = np.random.default_rng(config.seed)
    next_real, next_virtual = epochs(len(real), generator), epochs(max(1, len(virtual)), generator)
    pattern = virtual_steps(config, any_virtual=bool(virtual))

    def draw(iteration: int) -> View:
        return virtual[next(next_virtual)] if pattern[iteration] else real[next(next_real)]

    return draw


def _with_loss_weights(coarse: CoarseConfig, config: FinetuneConfig) -> CoarseConfig:
    """The coarse stage's weights of the loss, where fine-tuning sets none of its own."""
    own = {"dssim_weight": config.dssim_weight, "depth_weight": config.depth_weight}
    return coarse.model_copy(update={name: value for name, value in own.items() if value is not None})
