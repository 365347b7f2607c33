"""The embedded restorer made ready for a scene: trained on it, and compared with the classical fill."""

from __future__ import annotations

import logging
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import torch

from extrags.config import CoarseConfig, EnhanceConfig, SeamlessCloning
from extrags.errors import ConfigError
from extrags.events import MetricRecorded, emit
from extrags.restoration.classical import ClassicalEnhancer
from extrags.restoration.diffusion.embedded import EmbeddedEnhancer, pretrained
from extrags.restoration.diffusion.error_fit import error_over_expected, with_calibration
from extrags.restoration.diffusion.patches import choose_patches
from extrags.restoration.diffusion.scene_training import train_on_scene
from extrags.restoration.diffusion.validation import (
    RestoredPairs,
    restored_pairs,
    scores_of,
    validation_pairs,
)
from extrags.restoration.protocol import Enhancer
from extrags.restoration.training_data.augmentation import SMALLEST_CROP_PX
from extrags.restoration.training_data.pairs import Pairs, make_pairs, usable_folds
from extrags.restoration.uncertainty.calibration import Calibration
from extrags.scene import Scene
from extrags.sequence import EndoscopicSequence
from extrags.training.leave_out import MIN_FRAMES
from extrags.view_synthesis.gamut import Frame, Gamut
from extrags.view_synthesis.gather import gather_references
from extrags.view_synthesis.references import LightTransfer

__all__ = ["best_of_all", "familiar", "scene_restorer"]

MAX_LOSS_DB = 0.5
"""A PSNR lower by up to so much is accepted: leave-out views are near the path, with little to restore."""
MAX_LOSS_CLONING_DB = 0.1
"""The same where it clones seamlessly: but for what it invents, views are those of blending and filling."""
JUDGE_OFF = "enhance.judge is off"

logger = logging.getLogger(__name__)


def scene_restorer(
    scene: Scene, sequence: EndoscopicSequence, config: EnhanceConfig, coarse: CoarseConfig
) -> Enhancer:
    """The restorer of a scene; see `extrags.restoration.diffusion.backend.EmbeddedBackend.prepare`.

    Raises:
        CaptureError: with too few training frames to train on.
        DivergedError: when a reconstruction or the training does not stay finite.
        WeightsError: when the weights are missing or do not fit.
        ConfigError: when there would be neither weights nor training, or frames are too small to train on.
    """
    _check_size(sequence, config)
    found = _judged_restorer(scene, sequence, config, coarse)
    # Of the one that serves: of two sets of weights the judge may prefer the less familiar one.
    if isinstance(found, EmbeddedEnhancer | ClassicalEnhancer):
        _tell_domain(found)
    return found


def _check_size(sequence: EndoscopicSequence, config: EnhanceConfig) -> None:
    """Refuse to train on frames without room for a crop, before what takes long.

    Args:
        sequence: frames at the size that they are restored at.
        config: whether there is to be a training.
    """
    if config.train_iterations > 0 and min(sequence.width, sequence.height) < SMALLEST_CROP_PX:
        raise ConfigError(
            f"{sequence.name}: frames are restored at {sequence.width} x {sequence.height} px "
            f"(enhance.max_width is {config.max_width}), and a restorer is trained on at least "
            f"{SMALLEST_CROP_PX} px a side; set enhance.train_iterations to 0, or a larger enhance.max_width "
            "where frames are larger"
        )


def _judged_restorer(
    scene: Scene, sequence: EndoscopicSequence, config: EnhanceConfig, coarse: CoarseConfig
) -> Enhancer:
    """Trained as the settings ask, and compared with the classical one as far as frames can be left out."""
    known = familiar([found.with_domain_score(sequence) for found in pretrained(config)])
    start = known[0] if known else None
    transfer = gather_references(scene, sequence, sequence.train).transfer
    patches = choose_patches(sequence) if start is not None and start.network.generative else None
    if start is not None and config.train_iterations == 0:
        gamut = _scene_gamut(sequence)
        untouched = [_as_asked(restorer.with_settings(config, gamut, patches), config) for restorer in known]
        if not config.judge:
            return _cloning_outside(untouched[0], JUDGE_OFF, config.seamless_cloning)
        unjudged = _why_unjudged(sequence, config)
        if unjudged is not None:
            logger.warning("the restorer is not judged: %s", unjudged)
            return _cloning_outside(untouched[0], unjudged, config.seamless_cloning)
        # Nothing is trained, so all leave-out pairs validate; synthetic ones would favour filling holes.
        leave_out = config.model_copy(update={"synthetic_views": 0})
        fresh = make_pairs(scene, sequence, leave_out, coarse, most=config.judge_pairs)
        pairs = replace(fresh, validation=np.ones(len(fresh), dtype=bool))
        # How far off it is differs more from scene to scene than where.
        return best_of_all(untouched, pairs, transfer, calibrate=True, cloning=config.seamless_cloning)
    pairs = make_pairs(scene, sequence, config, coarse)
    trained = _as_asked(train_on_scene(pairs, transfer, config, start, patches=patches), config)
    if not config.judge:
        if trained.record["scene_training_kept"] is False:
            # What restores are weights that do not know this scene, as where none of them are trained.
            trained = _cloning_outside(trained, JUDGE_OFF, config.seamless_cloning)
        return _recalibrated(trained, pairs, transfer)
    weights = Calibration() if start is None else start.calibration
    return best_of_all([trained], pairs, transfer, of_weights=weights, cloning=config.seamless_cloning)


def _why_unjudged(sequence: EndoscopicSequence, config: EnhanceConfig) -> str | None:
    """Why no training frames can be left out; None where some can be."""
    count = len(sequence.train)
    if count < MIN_FRAMES:
        frames = "1 training frame is" if count == 1 else f"{count} training frames are"
        return f"{frames} too few to leave some out"
    if not usable_folds(sequence, config):
        return "no training frame with a valid pixel can be left out"
    return None


def _as_asked(restorer: EmbeddedEnhancer, config: EnhanceConfig) -> EmbeddedEnhancer:
    return restorer.cloning_seamlessly() if config.seamless_cloning == "always" else restorer


def familiar(restorers: Sequence[EmbeddedEnhancer]) -> list[EmbeddedEnhancer]:
    """Those of the restorers that come into question for a scene, the most familiar with it first.

    Args:
        restorers: the first is preferred; with their domain scores, where these are known.

    Returns:
        The first that knows the scene alone; where none does, all of them.
    """
    for restorer in restorers:
        if restorer.domain_score is None or restorer.domain_score <= 1:
            return [restorer]
    return sorted(restorers, key=lambda restorer: restorer.domain_score or 0.0)


def best_of_all(
    restorers: Sequence[EmbeddedEnhancer],
    pairs: Pairs,
    transfer: LightTransfer,
    *,
    calibrate: bool = False,
    of_weights: Calibration | None = None,
    cloning: SeamlessCloning = "auto",
) -> Enhancer:
    """The best restorer, as far as the scene's validation pairs do not prefer the classical one.

    On scenes unlike its training data a network can do harm, mostly by a shift of colours. Then what it
    invents is cloned seamlessly into what is known; where that, too, is clearly worse, the classical restorer
    replaces it, and carries the reason. Views are compared as they are used: with the rendering put back
    where it is certain.

    Args:
        restorers: ready for the scene, at least one; where no pair has a valid pixel the first counts.
        pairs: those for validation were not trained on.
        transfer: how brightness changes with distance.
        calibrate: fit the expected error of the restorer that is kept to these pairs.
        of_weights: calibration of the weights it began with, where its own has been fitted to these pairs,
            by which no error can be larger than expected.
        cloning: `auto` tries seamless cloning where the restorers do harm as they are.

    Returns:
        The restorer of the highest PSNR, with its scores, plain or else seamless; or the classical one with
        the reason.
    """
    chosen = validation_pairs(pairs)
    if not bool((pairs.weight > 0).any()):
        blind = "no left-out frame has a valid pixel"
        logger.warning("the restorer is not judged: %s", blind)
        return _cloning_outside(restorers[0], blind, cloning)
    validating = chosen or pairs
    best = _best(restorers, validating, transfer)
    filled = best.scores["classical"]["psnr_kept"]
    score = best.restorer.domain_score
    # Outside of what it knows, nothing says that it does better far from the path than near it.
    tolerated = MAX_LOSS_DB if score is None or score <= 1 else 0.0
    plain = best
    if best.restored_db < filled - tolerated and cloning == "auto":
        best = _best([each.cloning_seamlessly() for each in restorers], validating, transfer)
    if best.restorer.seamless:
        tolerated = MAX_LOSS_CLONING_DB
    enhancer, means, restored = best.restorer, best.means, best.restored_db
    emit(MetricRecorded("enhance", "judged_gain_over_classical_db", restored - filled))
    shown = restored_pairs(enhancer, means.pairs, transfer) if enhancer.drawing else means
    # Without validation pairs nothing tells of errors: the restorer was trained on these.
    known = enhancer if of_weights is None else replace(enhancer, calibration=of_weights)
    ratio = None if chosen is None else error_over_expected(known, shown)
    if ratio is not None:
        emit(MetricRecorded("enhance", "error_over_expected", ratio))
    judged = {
        "restored_db": round(restored, 3),
        "filled_db": round(filled, 3),
        "error_over_expected": None if ratio is None else round(ratio, 3),
    }
    if best is not plain:
        judged["plain_db"] = round(plain.restored_db, 3)
    if restored < filled - tolerated:
        reason = (
            f"on leave-out pairs of this scene the embedded restorer reaches {restored:.2f} dB, blending and "
            f"filling {filled:.2f} dB"
        )
        logger.warning("%s; the scene is restored by blending and filling", reason)
        return ClassicalEnhancer(reason, judged, enhancer.domain_score)
    if best is not plain:
        logger.warning(
            "on leave-out pairs of this scene the embedded restorer reaches %.2f dB, blending and filling "
            "%.2f dB: what it invents is cloned seamlessly into what is known, which reaches %.2f dB",
            plain.restored_db,
            filled,
            restored,
        )
    validation = {**enhancer.record.get("validation", {}), **best.scores}
    kept = replace(enhancer, record={**enhancer.record, "validation": validation, "judged": judged})
    fitted = calibrate or _calibrated_plain(kept)
    return with_calibration(kept, shown) if fitted and chosen is not None else kept


def _calibrated_plain(enhancer: EmbeddedEnhancer) -> bool:
    """Whether it clones seamlessly by now, and its expected error was fitted to what it was before."""
    return enhancer.seamless and enhancer.scene_calibrated


def _recalibrated(enhancer: EmbeddedEnhancer, pairs: Pairs, transfer: LightTransfer) -> EmbeddedEnhancer:
    """The restorer with the expected error of the views that it makes now."""
    chosen = validation_pairs(pairs)
    if chosen is None or not _calibrated_plain(enhancer):
        return enhancer
    return with_calibration(enhancer, restored_pairs(enhancer, chosen, transfer))


@dataclass(frozen=True)
class _Trial:
    """A restorer, its means of pairs, and the scores of these."""

    restorer: EmbeddedEnhancer
    means: RestoredPairs
    scores: dict[str, dict[str, float]]

    @classmethod
    def of(cls, restorer: EmbeddedEnhancer, pairs: Pairs, transfer: LightTransfer) -> _Trial:
        # By their means: a drawn view has texture of its own, which costs PSNR wherever it is right.
        means = restored_pairs(replace(restorer, drawing=False), pairs, transfer)
        return cls(restorer, means, scores_of([means], transfer))

    @property
    def restored_db(self) -> float:
        """As its views are used: with what is known put back."""
        return self.scores[self.means.name]["psnr_kept"]


def _best(restorers: Sequence[EmbeddedEnhancer], pairs: Pairs, transfer: LightTransfer) -> _Trial:
    trials = [_Trial.of(restorer, pairs, transfer) for restorer in restorers]
    return max(trials, key=lambda trial: trial.restored_db)


def _cloning_outside(enhancer: EmbeddedEnhancer, reason: str, cloning: SeamlessCloning) -> EmbeddedEnhancer:
    """The restorer where nothing judges it: `auto` makes it clone seamlessly on an unfamiliar scene.

    Args:
        enhancer: ready for the scene.
        reason: why it is not judged, for the artefact.
        cloning: as in the settings.
    """
    score = enhancer.domain_score
    if cloning != "auto" or score is None or score <= 1:
        return enhancer
    reason = (
        f"{reason}, and this scene is unlike what the embedded restorer was trained on ({score:.1f} times "
        "as far as unseen scenes of that kind are)"
    )
    found = enhancer.cloning_seamlessly()
    return replace(found, record={**found.record, "unjudged": reason})


def _tell_domain(restorer: EmbeddedEnhancer | ClassicalEnhancer) -> None:
    """Say where a scene is unlike the training data, and what follows where nothing judges the restorer."""
    score = restorer.domain_score
    if score is None:
        return
    emit(MetricRecorded("enhance", "domain_score", score))
    if score > 1:
        logger.warning(
            "this scene is unlike what the restorer was trained on (%.1f times as far as unseen scenes of "
            "that kind are)%s",
            score,
            "; what it invents is cloned seamlessly into what is known"
            if isinstance(restorer, EmbeddedEnhancer) and "unjudged" in restorer.record
            else "",
        )


def _scene_gamut(sequence: EndoscopicSequence) -> Gamut:
    """Hues of the training frames' valid tissue."""

    def frame(index: int) -> Frame:
        shown = sequence.train[index]
        image = torch.from_numpy(sequence.rgb[shown].astype(np.float32) / 255).permute(2, 0, 1)
        return image, torch.from_numpy(sequence.mask[shown].astype(np.float32))[None]

    # One at a time: as floats, the frames of a long recording would not be in memory at once.
    return Gamut.of_frames(frame, len(sequence.train))
