"""The judge of the fine-tuning: what it tries, what it keeps, and that it sees no held-out frame."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from extrags import finetuning_judge
from extrags.cameras import Cameras
from extrags.confidence import PerceptualDifference
from extrags.config import CoarseConfig, DensifyConfig, EnhanceConfig, FinetuneConfig
from extrags.config.finetuning import JudgeConfig
from extrags.finetuning_judge import AMOUNTS, judge_finetuning
from extrags.finetuning_judgement import Judgement, Trial, decide
from extrags.metrics.lpips import Lpips
from extrags.restoration.benchmark.variants import AsRendered
from extrags.restoration.classical import ClassicalEnhancer
from extrags.restoration.protocol import Clip, Enhancer, Restoration
from extrags.restoration.restored_renders import RESTORED_SHARE, RestoredShares, restored_shares
from extrags.restoration.trajectories import restored_batches
from extrags.scene import Scene
from extrags.sequence import EndoscopicSequence
from extrags.training import TrainingResult
from extrags.training.frame_weights import FrameWeights, frame_weights
from extrags.training.leave_out import MIN_FRAMES
from tests.extrags.lit_tube import Tube, tube_cameras
from tests.extrags.random_lpips import random_weights

COARSE = CoarseConfig(iterations=60, max_points=300, densify=DensifyConfig(max_gaussians=500))
FINETUNE = FinetuneConfig(
    iterations=60, judge=JudgeConfig(iterations_share=1.0, views=4, leave_out_every=3, max_width=64)
)
BRIEF_COARSE = COARSE.model_copy(update={"iterations": 15})
BRIEF = FINETUNE.model_copy(update={"iterations": 10})
"""Where it does not matter how good the trials are."""
ENHANCE = EnhanceConfig(backend="classical")
WITHOUT_WEIGHTS = PerceptualDifference(None, "not in this test")


class Destroyer(ClassicalEnhancer):
    """A restorer that turns everything green, and is sure of it."""

    def restore(self, clip: Clip) -> Restoration:
        found = super().restore(clip)
        return replace(found, rgb=np.broadcast_to(np.float32([0, 1, 0]), found.rgb.shape).copy())


def trajectories() -> list[Cameras]:
    return [tube_cameras(3, offset_mm=3.0, start_mm=start, turn=0.4) for start in (0.0, 4.0)]


def judged(
    tube: Tube,
    enhancer: Enhancer | None,
    config: FinetuneConfig = BRIEF,
    coarse: CoarseConfig = BRIEF_COARSE,
    *,
    measure: PerceptualDifference = WITHOUT_WEIGHTS,
) -> Judgement:
    return judge_finetuning(
        tube.scene,
        tube.sequence,
        trajectories() if enhancer is not None else (),
        enhancer,
        config,
        ENHANCE,
        coarse,
        measure=measure,
    )


def trial(amount: float, gain_db: float, control_db: float, paired_error_db: float = 0.0) -> Trial:
    return Trial(amount, 30.0, 30.0 + gain_db, gain_db, 0.1, gain_db - control_db, paired_error_db)


@pytest.mark.parametrize(
    ("control_db", "gains_db", "paired_error_db", "amount", "words"),
    [
        (0.5, {1.0: 1.2}, 0.0, 1.0, "virtual views are kept"),
        # No better than real views alone, but within the tolerance.
        (0.5, {1.0: 0.41}, 0.0, 1.0, "virtual views are kept"),
        (0.5, {1.0: 0.3, 0.3: 0.45}, 0.0, 0.3, "weigh 0.3"),
        (0.5, {1.0: -2.0, 0.3: 0.1, 0.1: 0.3}, 0.0, 0.0, "real views alone"),
        # Behind the control, but no farther than frames differ among each other.
        (0.5, {1.0: 0.3}, 0.15, 1.0, "virtual views are kept"),
        (1.3, {1.0: 0.2, 0.3: 0.15, 0.1: 1.1}, 0.15, 0.1, "weigh 0.1"),
        # Noise excuses no loss against the coarse scene.
        (0.5, {1.0: -0.2}, 2.0, 0.0, "real views alone"),
        # The control harms: virtual views have to hold against the coarse scene, which they do.
        (-1.0, {1.0: -0.05}, 0.0, 1.0, "virtual views are kept"),
        (-1.0, {1.0: -0.2, 0.3: -0.2}, 0.0, None, "coarse scene is kept"),
        (-0.05, {1.0: -0.2, 0.3: -0.2}, 0.0, 0.0, "real views alone"),
    ],
)
def test_what_is_kept(
    control_db: float, gains_db: dict[float, float], paired_error_db: float, amount: float | None, words: str
) -> None:
    tried = (trial(key, value, control_db, paired_error_db) for key, value in gains_db.items())
    trials = [trial(0.0, control_db, control_db), *tried]
    found = decide(trials, 0.1, np.array([3, 4]))
    assert found.amount == amount
    assert words in found.reason
    assert f"{control_db:+.2f} dB" in found.reason
    assert found.left_out == (3, 4)
    # Why guesses may stay that gain less than real views alone.
    assert ("lose no more than 0.1 dB against the coarse scene" in found.reason) == bool(amount)


def test_what_loses_as_much_as_it_may_holds() -> None:
    assert trial(0.0, 0.0, 0.0).holds(0.0)
    assert trial(1.0, -0.25, 0.0).holds(0.25)
    assert trial(1.0, 0.5, 0.75).holds(0.25)
    assert not trial(1.0, 0.5, 0.75).holds(0.125)
    assert trial(1.0, 0.5, 0.75, paired_error_db=0.125).holds(0.125)


def test_why_neither_holds() -> None:
    """Real views alone gained 1.5 dB without a cool-down: virtual ones fall behind that, and gain."""
    alone, behind = trial(0.0, -0.3, -0.3), trial(0.1, 0.5, 1.5)
    found = decide([alone, behind], 0.1, np.array([3, 4]))
    assert found.amount is None
    assert "all lose" not in found.reason
    assert "where their light comes to rest" in found.reason
    assert "all lose more than 0.1 dB" in decide([alone, trial(0.1, -0.5, -0.3)], 0.1, np.array([3])).reason


@pytest.mark.parametrize(("filled_db", "kept"), [(31.15, True), (31.0, False), (29.8, False)])
def test_what_harms_the_known_may_fill_holes(
    tube: Tube, monkeypatch: pytest.MonkeyPatch, filled_db: float, kept: bool
) -> None:
    """No weight holds beside a control that does: virtual views are tried where it leaves holes alone."""
    # Before, the control, three weights, the control with its cool-down, and its holes filled.
    measured = iter([30.0, 31.0, 29.5, 29.6, 29.8, 31.2, filled_db])
    monkeypatch.setattr(finetuning_judge, "_psnr_db", lambda *_: [next(measured)])
    monkeypatch.setattr(finetuning_judge, "MIN_LEFT_OUT", 1)
    tried: list[tuple[Scene, FinetuneConfig, Scene]] = []

    def recorded(scene: Scene, *given: Any, **named: Any) -> TrainingResult:
        result = finetuning_judge_finetune(scene, *given, **named)
        tried.append((scene, given[2], result.scene))
        return result

    finetuning_judge_finetune = finetuning_judge.finetune
    monkeypatch.setattr(finetuning_judge, "finetune", recorded)
    found = judged(tube, ClassicalEnhancer(""))
    assert [trial.holes_only for trial in found.trials] == [False] * 4 + [True]
    assert found.trials[-1].over_control_db == pytest.approx(filled_db - 31.2)
    assert (found.amount, found.holes_only) == ((1.0, True) if kept else (0.0, False))
    assert ("only fill its holes" in found.reason) == kept
    assert "(in holes alone)" in found.reason
    # It goes on from the control whose light came to rest, and leaves what is there.
    *_, alone, (start, config, _) = tried
    assert start is alone[2]
    assert (config.keep_scene, config.rounds, config.iterations) == (True, 1, BRIEF.iterations // 2)
    settings = found.applied_to(BRIEF)
    assert (settings.holes_only, settings.pseudo_weight) == (kept, BRIEF.pseudo_weight)


def test_a_restorer_that_does_visible_harm_fills_no_holes(
    tube: Tube, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Frames near the path see few holes, and would not tell."""
    measured = iter([30.0, 31.0, 28.0, 29.5, 29.8, 31.2])
    monkeypatch.setattr(finetuning_judge, "_psnr_db", lambda *_: [next(measured)])
    monkeypatch.setattr(finetuning_judge, "MIN_LEFT_OUT", 1)
    found = judged(tube, ClassicalEnhancer(""))
    assert (found.amount, found.holes_only) == (0.0, False)
    # 0.0398 and 0.0275 of 1.
    control, full, *_ = found.trials
    assert full.added_error(control) == pytest.approx(np.sqrt(0.0398107**2 - 0.0275423**2), rel=1e-5)
    assert control.added_error(full) == 0


@pytest.mark.parametrize("settings", [{"keep_scene": True}, {"holes_only": True}])
def test_holes_alone_are_not_tried_twice(
    tube: Tube, monkeypatch: pytest.MonkeyPatch, settings: dict[str, bool]
) -> None:
    measured = iter([30.0, 31.0, 29.5, 29.6, 29.8, 31.2])
    monkeypatch.setattr(finetuning_judge, "_psnr_db", lambda *_: [next(measured)])
    monkeypatch.setattr(finetuning_judge, "MIN_LEFT_OUT", 1)
    found = judged(tube, ClassicalEnhancer(""), BRIEF.model_copy(update=settings))
    assert (found.amount, found.holes_only) == (0.0, False)


def test_a_restorer_that_destroys_is_left_out(tube: Tube) -> None:
    # Scenes as brief as these gain by anything: what is green has to be most of what they are shown.
    config = FINETUNE.model_copy(update={"keep_known": False, "pseudo_share": 0.9, "pseudo_share_final": 0.8})
    destroyed = judged(tube, Destroyer(""), config, COARSE)
    assert destroyed.amount == 0.0 or destroyed.amount is None
    weighed = [trial.amount for trial in destroyed.trials if not trial.holes_only]
    assert weighed == [0.0, *AMOUNTS]
    assert not destroyed.holes_only
    control, full, *_ = destroyed.trials
    assert full.gain_db < control.gain_db - 0.1
    # What could be kept is tried as it would be run, which is what runs without a restorer.
    assert judged(tube, None, config, COARSE).trials[0] == control
    without = config.model_copy(update={"light_cooldown_share": 0.0})
    assert judged(tube, None, without, COARSE).trials[0] != control


@pytest.mark.parametrize("starts", [[], [tube_cameras(1)]])
def test_without_virtual_views_real_ones_alone_are_judged(tube: Tube, starts: list[Cameras]) -> None:
    found = judge_finetuning(
        tube.scene,
        tube.sequence,
        starts,
        Destroyer(""),
        BRIEF,
        ENHANCE,
        BRIEF_COARSE,
        measure=WITHOUT_WEIGHTS,
    )
    assert found == judged(tube, None)


class Trained(ClassicalEnhancer):
    """A restorer that has learned from the frames of the scene, and before that destroyed."""

    untrained = Destroyer("")

    def restore(self, clip: Clip) -> Restoration:
        raise AssertionError("it knows the frames that are left out")


def test_a_restorer_does_not_restore_frames_that_it_was_trained_on(tube: Tube) -> None:
    assert judged(tube, Trained("")) == judged(tube, Destroyer(""))


class Remembering(AsRendered):
    """A restorer that has the training frames of the scene, and remembers which it was referred to."""

    def __init__(self) -> None:
        self.references: list[int] = []

    def restore(self, clip: Clip) -> Restoration:
        self.references += clip.reference.tolist()
        return super().restore(clip)


def test_a_restorer_is_referred_to_frames_that_are_kept(tube: Tube) -> None:
    """In one trial alone, so that what it leaves out is left out of all of it."""
    enhancer = Remembering()
    judge = FINETUNE.judge.model_copy(update={"leave_out_every": 2})
    config = FINETUNE.model_copy(update={"iterations": 5, "judge": judge})
    found = judged(tube, enhancer, config)
    kept = set(range(len(tube.sequence.train))) - set(found.left_out)
    assert len(found.left_out) == 5
    assert len(set(enhancer.references)) > 1
    assert set(enhancer.references) <= kept


def test_it_tells_how_much_of_restored_views_serves(tube: Tube, monkeypatch: pytest.MonkeyPatch) -> None:
    """Of a restorer that changes nothing: the trial's coarse scene against its fine-tuned one."""
    asked: list[float] = []

    def keeping(*arguments: Any, error_share: float, **others: Any) -> RestoredShares | None:
        asked.append(error_share)
        return restored_shares(*arguments, error_share=error_share, **others)

    monkeypatch.setattr(finetuning_judge, "restored_shares", keeping)
    config = FINETUNE.model_copy(update={"iterations": 100})
    found = judged(tube, AsRendered(), config, COARSE)
    assert found.trials[-1].gain_db > 0.5
    assert found.restored_shares is not None
    # The coarse trial is worse than the fine-tuned one, whose errors are taken for even smaller.
    assert found.restored_shares.known < 0.5 * RESTORED_SHARE
    # The tube's scene is the truth, far from what sixty steps reach.
    assert 0 < asked[0] < 0.5
    assert judged(tube, ClassicalEnhancer("")).restored_shares is None


def test_the_first_round_is_tried(tube: Tube, monkeypatch: pytest.MonkeyPatch) -> None:
    """Others go on from what it makes."""
    tried: list[FinetuneConfig] = []

    def recorded(scene: Scene, _: object, __: object, config: FinetuneConfig, *___: Any, **____: Any) -> Any:
        tried.append(config)
        return TrainingResult(scene, [])

    monkeypatch.setattr(finetuning_judge, "finetune", recorded)
    half = FINETUNE.judge.model_copy(update={"iterations_share": 0.5})
    config = FINETUNE.model_copy(update={"judge": half, "rounds": 3, "iterations": 60, "growth": 2.0})
    judged(tube, ClassicalEnhancer(""), config)
    assert tried
    assert {(brief.rounds, brief.iterations, brief.growth) for brief in tried} == {(1, 10, 1.6)}


def test_errors_outside_the_masks_are_nobodys(tube: Tube) -> None:
    mask, other = tube.sequence.mask.copy(), tube.sequence.rgb.copy()
    mask[..., 40:] = False
    other[:, :, 40:] = 255 - other[:, :, 40:]
    gaussians = tube.scene.gaussians
    brief = Scene(replace(gaussians, sh0=0.8 * gaussians.sh0), tube.scene.light)
    shares = []
    for rgb in (tube.sequence.rgb, other):
        frames = replace(tube.sequence, rgb=rgb, mask=mask)
        shares.append(finetuning_judge._error_share(tube.scene, frames, brief, frames))
    assert 0 < shares[0] < 0.8
    assert shares[1] == pytest.approx(shares[0])


def test_the_control_is_compared_frame_by_frame(tube: Tube, monkeypatch: pytest.MonkeyPatch) -> None:
    """PSNR of four frames: trials that lose as much on average, on all frames or on one."""
    measured = iter(
        [
            [30.0, 30.0, 30.0, 30.0],  # before
            [31.0, 31.0, 31.0, 31.0],  # the control
            [30.7, 30.7, 30.7, 30.7],
            [29.8, 31.0, 31.0, 31.0],
        ]
    )
    monkeypatch.setattr(finetuning_judge, "_psnr_db", lambda *_: next(measured))
    monkeypatch.setattr(finetuning_judge, "MIN_LEFT_OUT", 1)
    found = judged(tube, ClassicalEnhancer(""))
    control, evenly, once = found.trials
    assert (control.over_control_db, control.over_control_error_db) == (0, 0)
    assert (evenly.amount, once.amount) == (1.0, 0.3)
    for lost in (evenly, once):
        assert lost.gain_db == pytest.approx(0.7)
        assert lost.over_control_db == pytest.approx(-0.3)
    assert evenly.over_control_error_db == pytest.approx(0, abs=1e-9)
    # The standard deviation of 0, 0, 0 and -1.2 is 0.6, over the root of four frames.
    assert once.over_control_error_db == pytest.approx(0.3)
    assert found.amount == 0.3


def test_frames_are_compared_once_for_all_amounts(tube: Tube, monkeypatch: pytest.MonkeyPatch) -> None:
    compared: list[int] = []

    def counted(sequence: EndoscopicSequence, frames: np.ndarray) -> FrameWeights | None:
        compared.append(len(frames))
        return frame_weights(sequence, frames)

    # Fine-tuning looks for itself where it is given none.
    for module in ("extrags.finetuning_judge", "extrags.training.frame_weights"):
        monkeypatch.setattr(f"{module}.frame_weights", counted)
    monkeypatch.setattr(finetuning_judge, "MIN_LEFT_OUT", 1)
    assert len(judged(tube, Destroyer("")).trials) > 1
    assert len(compared) == 1


def test_a_scene_that_is_kept(tube: Tube) -> None:
    """Real views alone change nothing of it, and the words say what was tried."""
    found = judged(tube, None, BRIEF.model_copy(update={"keep_scene": True}))
    assert [trial.gain_db for trial in found.trials] == [0.0]
    assert found.reason.startswith("the scene's own Gaussians stay as they are")
    assert "rebuilt from frames" in found.reason


def test_trials_too_small_for_lpips_are_judged_without(tube: Tube, monkeypatch: pytest.MonkeyPatch) -> None:
    """`enhance.pixel_confidence=raw` is LPIPS itself, which the frames are large enough for."""
    measures = []

    def told(*given: Any) -> Any:
        measures.append(given[-1].for_images(given[1].width, given[1].height))
        return restored_batches(*given)

    monkeypatch.setattr(finetuning_judge, "restored_batches", told)
    monkeypatch.setattr(finetuning_judge, "MIN_LEFT_OUT", 1)
    raw = PerceptualDifference(Lpips("alex", random_weights("alex")), raw=True)
    small = BRIEF.model_copy(update={"judge": FINETUNE.judge.model_copy(update={"max_width": 24})})
    found = judged(tube, ClassicalEnhancer(""), small, measure=raw)
    assert found.trials
    assert {measure.name for measure in measures} == {"perceptual_map"}


def test_held_out_frames_are_not_looked_at(tube: Tube) -> None:
    sequence = tube.sequence
    test = np.setdiff1d(np.arange(len(sequence)), sequence.train)
    if len(test) == 0:
        pytest.fail("the fixture has no held-out frames")
    rgb = sequence.rgb.copy()
    rgb[test] = 255 - rgb[test]
    other = replace(tube, sequence=replace(sequence, rgb=rgb))
    assert judged(other, None) == judged(tube, None)


def test_left_out_frames_are_training_frames_in_the_middle(
    tube: Tube, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(finetuning_judge, "MIN_LEFT_OUT", 1)
    found = judged(tube, None)
    assert [trial.amount for trial in found.trials] == [0.0]
    assert 0 < len(found.left_out) < len(tube.sequence.train)
    assert 0 not in found.left_out


def test_a_few_left_out_frames_do_not_judge_alone(tube: Tube, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(finetuning_judge, "MIN_LEFT_OUT", 1)
    few = judged(tube, None)
    monkeypatch.setattr(finetuning_judge, "MIN_LEFT_OUT", len(few.left_out) + 1)
    # Two reconstructions, before and after the control: all frames count alike.
    measured = iter([[30.0, 30.0, 30.0], [20.0], [31.0, 31.0, 31.0], [17.0]])
    monkeypatch.setattr(finetuning_judge, "_psnr_db", lambda *_: next(measured))
    more = judged(tube, None)
    assert set(few.left_out) < set(more.left_out)
    assert more.trials[0].gain_db == pytest.approx(0)
    assert more.trials[0].coarse_psnr_db == pytest.approx(27.5)


def test_the_fewest_frames_that_can_be_judged(tube: Tube) -> None:
    """Four, of which one in five is left out: every trial leaves out one, and none leaves out nothing."""
    split = replace(tube.sequence.split, train=tube.sequence.train[:MIN_FRAMES])
    few = replace(tube, scene=replace(tube.scene, light=None), sequence=replace(tube.sequence, split=split))
    every_fifth = FINETUNE.judge.model_copy(update={"leave_out_every": 5})
    found = judged(few, None, FINETUNE.model_copy(update={"judge": every_fifth, "iterations": 5}))
    assert found.left_out == (0, 1, 2, 3)
    assert np.isfinite(found.trials[0].gain_db)


def test_frames_without_valid_pixels_do_not_judge(tube: Tube, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(finetuning_judge, "MIN_LEFT_OUT", 1)
    before = judged(tube, None).left_out
    mask = tube.sequence.mask.copy()
    mask[tube.sequence.train[list(before)]] = False
    found = judged(replace(tube, sequence=replace(tube.sequence, mask=mask)), None)
    assert len(found.left_out) > 0
    assert not set(found.left_out) & set(before)
    assert np.isfinite(found.trials[0].gain_db)
    monkeypatch.setattr(
        finetuning_judge,
        "leave_out_folds",
        lambda *_: [(tube.sequence.train, tube.sequence.train[list(before)])],
    )
    nothing = judged(replace(tube, sequence=replace(tube.sequence, mask=mask)), None)
    assert (nothing.amount, nothing.trials) == (1.0, ())
    assert nothing.reason.startswith("not judged: no training frame with a valid pixel can be left out")


def test_what_is_left_of_the_frames_has_valid_pixels(tube: Tube) -> None:
    """Of the only frame with tissue nothing can be learned where it is left out."""
    mask = np.zeros_like(tube.sequence.mask)
    mask[tube.sequence.train[4]] = True
    found = judged(replace(tube, sequence=replace(tube.sequence, mask=mask)), None)
    assert found.amount == 1.0
    assert found.reason.startswith("not judged: no training frame with a valid pixel can be left out")


def test_off_or_too_few_frames_keep_everything(tube: Tube) -> None:
    off = judged(tube, None, FINETUNE.model_copy(update={"judge": JudgeConfig(enabled=False)}))
    assert (off.amount, off.trials) == (1.0, ())
    assert "finetune.judge.enabled" in off.reason
    split = replace(tube.sequence.split, train=tube.sequence.train[:3])
    few = judged(replace(tube, sequence=replace(tube.sequence, split=split)), None)
    assert few.amount == 1.0
    assert "3 training frames" in few.reason


def test_the_weight_of_virtual_views_follows() -> None:
    config = FinetuneConfig(pseudo_weight=2.0)
    assert Judgement(0.3, "").applied_to(config).pseudo_weight == pytest.approx(0.6)
    assert Judgement(1.0, "").applied_to(config) == config
    shares = Judgement(1.0, "", restored_shares=RestoredShares(known=0.2, invented=0.5)).applied_to(config)
    assert (shares.known_share, shares.invented_share) == (0.2, 0.5)
    # Asked for less, less it is; and where left-out frames lose nothing, what is asked for.
    less = FinetuneConfig(known_share=0.1, invented_share=0.9)
    shares = Judgement(1.0, "", restored_shares=RestoredShares(known=0.2, invented=0.5)).applied_to(less)
    assert (shares.known_share, shares.invented_share) == (0.1, 0.5)
    assert Judgement(1.0, "", restored_shares=RestoredShares()).applied_to(less) == less
    assert Judgement(0.0, "").applied_to(config) == config


def test_storage(tmp_path: Path) -> None:
    filled = replace(trial(1.0, 0.2, 0.5), holes_only=True)
    for amount in (None, 0.0, 1.0):
        found = Judgement(
            amount, "why", (trial(0.0, 0.5, 0.5), trial(1.0, -0.25, 0.5, 0.2)), (2, 5), RestoredShares(0.25)
        )
        found = replace(found, holes_only=amount == 1, trials=(*found.trials, filled))
        found.save(tmp_path / "judgement.json")
        assert Judgement.load(tmp_path / "judgement.json") == found
