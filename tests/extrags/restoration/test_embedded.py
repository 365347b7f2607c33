from __future__ import annotations

import copy
import json
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from extrags.config import CoarseConfig
from extrags.depth.hidden import SOLID
from extrags.errors import CaptureError, ConfigError, WeightsError
from extrags.events import Event, subscribed
from extrags.metrics.image import SSIM_WINDOW_PX
from extrags.restoration.backends import load_enhancer, train_enhancer
from extrags.restoration.classical import ClassicalEnhancer
from extrags.restoration.diffusion import scene_restorer
from extrags.restoration.diffusion.embedded import EmbeddedEnhancer
from extrags.restoration.diffusion.error_fit import cell_errors, error_over_expected, with_calibration
from extrags.restoration.diffusion.frame_features import sequence_features
from extrags.restoration.diffusion.scene_restorer import best_of_all, familiar
from extrags.restoration.diffusion.scene_training import train_on_scene
from extrags.restoration.diffusion.validation import restored_pairs, validation_pairs, validation_scores
from extrags.restoration.protocol import Clip, Enhancer, never_trained_on
from extrags.restoration.training_data.pairs import Pairs
from extrags.restoration.uncertainty import calibration
from extrags.restoration.uncertainty.calibration import Calibration
from extrags.restoration.uncertainty.domain import Domain
from extrags.thresholds import HOLE_ALPHA
from extrags.training.leave_out import leave_out_folds
from extrags.view_synthesis.conditioning import Layers
from extrags.view_synthesis.gamut import Gamut
from tests.extrags.lit_tube import Tube
from tests.extrags.restoration.conftest import SMALL


class TestEmbedded:
    def test_one_step_beats_no_restoration(self, trained: EmbeddedEnhancer) -> None:
        scores = trained.record["validation"]
        assert scores["embedded_1"]["psnr"] > scores["none"]["psnr"] + 2

    def test_the_better_number_of_steps_is_chosen(self, trained: EmbeddedEnhancer) -> None:
        scores = trained.record["validation"]
        best = max((1, 4), key=lambda steps: scores[f"embedded_{steps}"]["psnr"])
        assert trained.steps == best

    def test_training_twice_gives_the_same_bits(self, tube: Tube, tube_pairs: Pairs) -> None:
        transfer, brief = tube.references.transfer, SMALL.model_copy(update={"train_iterations": 12})
        first, second = (train_on_scene(tube_pairs, transfer, brief).network.state_dict() for _ in range(2))
        assert all(torch.equal(value, second[name]) for name, value in first.items())

    def test_saved_and_loaded_it_restores_the_same(
        self, trained: EmbeddedEnhancer, clip: Clip, tmp_path
    ) -> None:
        trained.save(tmp_path / "restorer")
        loaded = load_enhancer(tmp_path / "restorer")
        assert isinstance(loaded, EmbeddedEnhancer)
        assert isinstance(loaded, Enhancer)
        assert np.array_equal(loaded.restore(clip).rgb, trained.restore(clip).rgb)
        assert loaded.restore(clip).provenance == trained.restore(clip).provenance

    def test_depth_of_holes_is_read_from_the_image(
        self, trained: EmbeddedEnhancer, clip: Clip, tmp_path
    ) -> None:
        assert trained.depth_from_image
        guessing = trained.with_settings(SMALL.model_copy(update={"depth_from_image": False}), trained.gamut)
        read, guessed = trained.restore(clip), guessing.restore(clip)
        assert np.array_equal(read.rgb, guessed.rgb)
        assert read.depth_mm is not None
        assert guessed.depth_mm is not None
        alpha = clip.layers.get("alpha")[:, 0].numpy()
        np.testing.assert_allclose(read.depth_mm[alpha > SOLID], guessed.depth_mm[alpha > SOLID], rtol=1e-5)
        holes = alpha < HOLE_ALPHA
        assert holes.any()
        assert np.abs(np.log(read.depth_mm / guessed.depth_mm))[holes].mean() > 1e-3
        guessing.save(tmp_path)
        loaded = load_enhancer(tmp_path).restore(clip).depth_mm
        assert loaded is not None
        assert np.array_equal(loaded, guessed.depth_mm)
        # Restorers of the format before are of a time when none read it.
        file = tmp_path / "restorer.json"
        description = json.loads(file.read_text())
        del description["depth_from_image"]
        file.write_text(json.dumps(description | {"format": 3}))
        assert load_enhancer(tmp_path).provenance["depth_from_image"] is False

    def test_samples_add_to_the_expected_error(self, trained: EmbeddedEnhancer, clip: Clip) -> None:
        plain = replace(trained, steps=4, calibration=Calibration())
        one, several = plain.restore(clip), replace(plain, samples=3).restore(clip)
        assert one.expected_error is not None
        assert several.expected_error is not None
        assert several.expected_error.shape == several.rgb.shape[:3]
        assert several.expected_error.mean() > 0
        assert np.abs(several.expected_error - one.expected_error).max() > 0
        assert several.depth_mm is not None
        assert (several.depth_mm > 0).all()

    def test_training_that_does_not_help_is_not_kept(
        self, tube: Tube, tube_pairs: Pairs, trained: EmbeddedEnhancer
    ) -> None:
        harmful = SMALL.model_copy(update={"scene_learning_rate": 0.5, "train_iterations": 3})
        kept = train_on_scene(tube_pairs, tube.references.transfer, harmful, trained)
        assert kept.record["scene_training_kept"] is False
        assert never_trained_on(kept) is kept
        for one, two in zip(
            kept.network.state_dict().values(), trained.network.state_dict().values(), strict=True
        ):
            assert torch.equal(one, two)

    def test_frames_too_small_to_train_on_are_refused_before_any_is_left_out(
        self, tube: Tube, monkeypatch: pytest.MonkeyPatch
    ) -> None:
        """The size is that of restored views: frames of 640 x 40 px are large enough, and restored at 20."""
        monkeypatch.setattr(scene_restorer, "make_pairs", None)
        config = SMALL.model_copy(update={"max_width": 32})
        with pytest.raises(ConfigError, match=r"restored at 32 x 24 px \(enhance.max_width is 32\)"):
            train_enhancer(tube.scene, tube.sequence, config, CoarseConfig())

    def test_without_a_valid_pixel_nothing_is_trained(
        self, tube: Tube, tube_pairs: Pairs, trained: EmbeddedEnhancer, tmp_path: Path
    ) -> None:
        """As where all frames are saturated: there is no figure of anything, and none is told."""
        hidden = replace(tube_pairs, weight=torch.zeros_like(tube_pairs.weight))
        transfer = tube.references.transfer
        kept = train_on_scene(hidden, transfer, SMALL, trained)
        assert kept.record["scene_training_kept"] is False
        assert never_trained_on(kept) is kept
        for name, value in kept.network.state_dict().items():
            assert torch.equal(value, trained.network.state_dict()[name])
        judged = best_of_all([kept], hidden, transfer)
        judged.save(tmp_path)
        assert load_enhancer(tmp_path).name == "embedded"
        with pytest.raises(CaptureError, match="valid pixel that is not saturated"):
            train_on_scene(hidden, transfer, SMALL)

    def test_training_that_helps_is_kept(self, tube: Tube, tube_pairs: Pairs, clip: Clip, tmp_path) -> None:
        crude = train_on_scene(
            tube_pairs, tube.references.transfer, SMALL.model_copy(update={"train_iterations": 4})
        )
        more = SMALL.model_copy(update={"scene_learning_rate": 2e-3})
        kept = train_on_scene(tube_pairs, tube.references.transfer, more, crude)
        scores = kept.record["validation"]
        assert kept.record["scene_training_kept"] is True
        assert scores["embedded_1"]["psnr"] > scores["untrained_embedded_1"]["psnr"]
        # What it was before stays beside it, as it would have been kept.
        assert kept.untrained is not None
        assert kept.untrained.record["scene_training_kept"] is False
        assert kept.untrained.untrained is None
        kept.save(tmp_path)
        loaded = load_enhancer(tmp_path)
        assert isinstance(loaded, EmbeddedEnhancer)
        assert np.array_equal(loaded.restore(clip).rgb, kept.restore(clip).rgb)
        before = never_trained_on(loaded).restore(clip)
        assert np.array_equal(before.rgb, replace(crude, steps=kept.untrained.steps).restore(clip).rgb)
        assert not np.array_equal(before.rgb, kept.restore(clip).rgb)
        # Nor is it left over from a restorer that was saved there before.
        crude.save(tmp_path)
        loaded = load_enhancer(tmp_path)
        assert never_trained_on(loaded) is loaded

    def test_without_iterations_the_pretrained_restorer_serves(
        self, tube: Tube, trained: EmbeddedEnhancer, clip: Clip, tmp_path
    ) -> None:
        trained.save(tmp_path, half=True)
        config = SMALL.model_copy(
            update={"train_iterations": 0, "pretrained_weights": str(tmp_path), "judge": False}
        )
        served = train_enhancer(tube.scene, tube.sequence, config, CoarseConfig())
        assert isinstance(served, EmbeddedEnhancer)
        difference = np.abs(served.restore(clip).rgb - trained.restore(clip).rgb)
        assert difference.mean() < 0.01
        with pytest.raises(ConfigError, match="nothing would restore"):
            train_enhancer(
                tube.scene,
                tube.sequence,
                SMALL.model_copy(update={"train_iterations": 0}),
                CoarseConfig(),
            )

    def test_what_does_harm_gives_way_to_blending_and_filling(
        self, tube: Tube, tube_pairs: Pairs, trained: EmbeddedEnhancer, clip: Clip, tmp_path, caplog
    ) -> None:
        transfer = tube.references.transfer
        kept = best_of_all([trained], tube_pairs, transfer)
        assert isinstance(kept, EmbeddedEnhancer)
        assert f"embedded_{trained.steps}" in kept.provenance["validation"]
        told = kept.provenance["judged"]
        assert told["restored_db"] > told["filled_db"]
        network = copy.deepcopy(trained.network)
        torch.nn.init.normal_(network.exit.weight, std=0.3, generator=torch.Generator().manual_seed(3))
        served = best_of_all([replace(trained, network=network)], tube_pairs, transfer)
        assert isinstance(served, ClassicalEnhancer)
        assert "restored by blending and filling" in caplog.text
        served.save(tmp_path)
        loaded = load_enhancer(tmp_path)
        provenance = loaded.restore(clip).provenance
        assert "on leave-out pairs of this scene" in provenance["reason"]
        assert provenance["judged"]["restored_db"] < provenance["judged"]["filled_db"]

    def test_without_a_valid_pixel_it_is_not_judged(
        self, trained: EmbeddedEnhancer, tube_pairs: Pairs, tube: Tube
    ) -> None:
        hidden = replace(tube_pairs, weight=torch.zeros_like(tube_pairs.weight))
        assert validation_pairs(hidden) is None
        assert best_of_all([trained], hidden, tube.references.transfer) is trained

    def test_unjudged_it_serves_familiar_scenes_as_it_is(
        self, trained: EmbeddedEnhancer, tube_pairs: Pairs, tube: Tube, clip: Clip, tmp_path, caplog
    ) -> None:
        transfer = tube.references.transfer
        hidden = replace(tube_pairs, weight=torch.zeros_like(tube_pairs.weight))
        familiar, strange = (replace(trained, domain_score=score) for score in (0.9, 2.5))
        assert best_of_all([familiar], hidden, transfer) is familiar
        served = best_of_all([strange], hidden, transfer)
        assert isinstance(served, EmbeddedEnhancer)
        assert served.seamless
        assert "no left-out frame has a valid pixel" in caplog.text
        served.save(tmp_path)
        provenance = load_enhancer(tmp_path).restore(clip).provenance
        assert "2.5 times as far" in provenance["unjudged"]
        assert provenance["domain_score"] == 2.5
        assert best_of_all([strange], hidden, transfer, cloning="never") is strange

    @pytest.mark.parametrize(
        ("scores", "expected"),
        [
            ([0.7, 0.4], [0.7]),
            ([1.2, 0.9], [0.9]),
            ([None, 0.9], [None]),
            ([2.5, 1.5], [1.5, 2.5]),
            ([1.5, 2.5], [1.5, 2.5]),
            ([3.0], [3.0]),
            ([], []),
        ],
    )
    def test_weights_that_know_the_scene_come_into_question_and_all_where_none_do(
        self, trained: EmbeddedEnhancer, scores: list[float | None], expected: list[float | None]
    ) -> None:
        given = [replace(trained, domain_score=score) for score in scores]
        assert [restorer.domain_score for restorer in familiar(given)] == expected

    def test_of_several_weights_the_judge_takes_the_best(
        self, trained: EmbeddedEnhancer, tube_pairs: Pairs, tube: Tube
    ) -> None:
        network = copy.deepcopy(trained.network)
        torch.nn.init.normal_(network.exit.weight, std=0.3, generator=torch.Generator().manual_seed(3))
        worse = replace(trained, network=network, trained_on="noise", domain_score=1.2)
        better = replace(trained, trained_on="tubes", domain_score=1.4)
        transfer = tube.references.transfer
        for given in ([worse, better], [better, worse]):
            kept = best_of_all(given, tube_pairs, transfer)
            assert isinstance(kept, EmbeddedEnhancer)
            assert kept.provenance["trained_on"] == "tubes"
            assert kept.provenance["domain_score"] == 1.4
            alone = best_of_all([better], tube_pairs, transfer)
            assert isinstance(alone, EmbeddedEnhancer)
            assert kept.record["judged"] == alone.record["judged"]

    @pytest.fixture
    def judged(
        self,
        trained: EmbeddedEnhancer,
        tube_pairs: Pairs,
        tube: Tube,
        monkeypatch: pytest.MonkeyPatch,
    ) -> Callable[..., Enhancer]:
        """What serves where a restorer loses so much to blending and filling."""

        def of(restorer: EmbeddedEnhancer, lost_db: float, **options: Any) -> Enhancer:
            scores = {
                f"embedded_{trained.steps}": {"psnr_kept": 20.0},
                "classical": {"psnr_kept": 20.0 + lost_db},
            }
            monkeypatch.setattr(scene_restorer, "scores_of", lambda *_: scores)
            return best_of_all([restorer], tube_pairs, tube.references.transfer, **options)

        return of

    @pytest.mark.parametrize(
        ("lost_db", "score", "served_by"),
        [(0.3, 0.9, "plain"), (0.05, 1.1, "seamless"), (0.3, 1.1, "filling"), (0.7, 0.9, "filling")],
    )
    def test_on_unfamiliar_scenes_no_loss_is_tolerated_but_of_cloning(
        self,
        trained: EmbeddedEnhancer,
        judged: Callable[..., Enhancer],
        lost_db: float,
        score: float,
        served_by: str,
    ) -> None:
        served = judged(replace(trained, domain_score=score), lost_db)
        assert isinstance(served, EmbeddedEnhancer) == (served_by != "filling")
        assert getattr(served, "seamless", False) == (served_by == "seamless")

    @pytest.mark.parametrize(("lost_db", "serves"), [(0.05, True), (0.3, False)])
    @pytest.mark.parametrize("score", [0.9, 1.1])
    def test_what_clones_by_hand_is_held_to_the_same(
        self,
        trained: EmbeddedEnhancer,
        judged: Callable[..., Enhancer],
        lost_db: float,
        score: float,
        serves: bool,
    ) -> None:
        cloning = replace(trained, domain_score=score).cloning_seamlessly()
        assert isinstance(judged(cloning, lost_db, cloning="always"), EmbeddedEnhancer) == serves

    @pytest.mark.parametrize("judge", [True, False])
    def test_unjudged_unfamiliar_scenes_keep_what_is_known(
        self, tube: Tube, tmp_path: Path, trained: EmbeddedEnhancer, monkeypatch, judge: bool
    ) -> None:
        """With too few frames to leave some out, or because nobody asks for it."""
        monkeypatch.setattr(scene_restorer, "MIN_FRAMES", len(tube.sequence.train) + 1)
        features = sequence_features(trained.network, tube.sequence)
        settings = {"train_iterations": 0, "pretrained_weights": str(tmp_path), "judge": judge}
        for limit, cloning, seamless in (
            (1e6, "auto", False),
            (1e-6, "auto", True),
            (1e-6, "never", False),
            (1e6, "always", True),
        ):
            domain = replace(Domain.fitted(features, []), limit=limit)
            replace(trained, domain=domain).save(tmp_path)
            config = SMALL.model_copy(update={**settings, "seamless_cloning": cloning})
            served = train_enhancer(tube.scene, tube.sequence, config, CoarseConfig())
            assert isinstance(served, EmbeddedEnhancer)
            assert served.seamless == seamless

    def test_unjudged_where_frames_without_tissue_would_be_all_that_is_kept(
        self, tube: Tube, tmp_path: Path, trained: EmbeddedEnhancer, caplog: pytest.LogCaptureFixture
    ) -> None:
        trained.save(tmp_path)
        settings = {"train_iterations": 0, "pretrained_weights": str(tmp_path), "folds": 1}
        config = SMALL.model_copy(update=settings)
        _, left = leave_out_folds(tube.sequence.train, config.folds)[0]
        mask = np.zeros_like(tube.sequence.mask)
        mask[left[0]] = True
        alone = replace(tube.sequence, mask=mask)
        served = train_enhancer(tube.scene, alone, config, CoarseConfig())
        assert isinstance(served, EmbeddedEnhancer)
        assert "the restorer is not judged: no training frame with a valid pixel" in caplog.text

    @pytest.mark.parametrize(
        ("limit", "cloning", "seamless"), [(1e-6, "auto", True), (1e6, "auto", False), (1e-6, "never", False)]
    )
    def test_unjudged_unfamiliar_scenes_whose_training_is_not_kept_keep_what_is_known(
        self,
        tube: Tube,
        tube_pairs: Pairs,
        tmp_path: Path,
        trained: EmbeddedEnhancer,
        monkeypatch,
        caplog: pytest.LogCaptureFixture,
        limit: float,
        cloning: str,
        seamless: bool,
    ) -> None:
        """The same weights serve as where nothing is trained."""
        monkeypatch.setattr(scene_restorer, "make_pairs", lambda *_: tube_pairs)
        features = sequence_features(trained.network, tube.sequence)
        replace(trained, domain=replace(Domain.fitted(features, []), limit=limit)).save(tmp_path)
        settings = {"scene_learning_rate": 0.5, "train_iterations": 1, "pretrained_weights": str(tmp_path)}
        config = SMALL.model_copy(update={**settings, "judge": False, "seamless_cloning": cloning})
        served = train_enhancer(tube.scene, tube.sequence, config, CoarseConfig())
        assert isinstance(served, EmbeddedEnhancer)
        assert served.record["scene_training_kept"] is False
        assert served.seamless == seamless
        said = [message for message in caplog.messages if "unlike" in message or "cloned" in message]
        assert len(said) == int(limit < 1)
        assert all(("cloned seamlessly" in message) == seamless for message in said)

    def test_a_restorer_saved_for_a_scene_gives_another_one_its_weights_alone(
        self, tube: Tube, tmp_path: Path, trained: EmbeddedEnhancer
    ) -> None:
        found = {"judged": {"restored_db": 1.0, "filled_db": 2.0}, "unjudged": "it was another scene"}
        earlier = replace(
            trained,
            record={**trained.record, **found},
            domain_score=2.0,
            scene_calibrated=True,
            untrained=trained,
        )
        earlier.cloning_seamlessly().save(tmp_path)
        settings = {"train_iterations": 0, "pretrained_weights": str(tmp_path), "judge": False}
        config = SMALL.model_copy(update={**settings, "seamless_cloning": "never"})
        served = train_enhancer(tube.scene, tube.sequence, config, CoarseConfig())
        assert isinstance(served, EmbeddedEnhancer)
        assert not served.seamless
        assert served.depth_from_image
        assert served.domain_score is None
        assert not served.scene_calibrated
        assert never_trained_on(served) is served
        for name in ("judged", "unjudged", "scene_training_kept"):
            assert served.provenance[name] is None

    def test_weights_have_their_own_calibration_whatever_scene_they_were_saved_for(
        self, tube_pairs: Pairs, tube: Tube, trained: EmbeddedEnhancer, tmp_path: Path, monkeypatch
    ) -> None:
        monkeypatch.setattr(calibration, "MIN_CELLS", 50)
        sure = replace(trained, calibration=Calibration((0.01, 1.0), (0.001, 0.1)))
        chosen = validation_pairs(tube_pairs)
        assert chosen is not None
        restored = restored_pairs(sure, chosen, tube.references.transfer)
        # Calibrated twice, as where it clones seamlessly after all.
        told = with_calibration(with_calibration(sure, restored), restored)
        assert told.scene_calibrated
        assert told.calibration != sure.calibration
        told.save(tmp_path)
        loaded = EmbeddedEnhancer.load(tmp_path)
        assert loaded.calibration == told.calibration
        alone = loaded.without_scene()
        assert alone.calibration == sure.calibration
        assert not alone.scene_calibrated
        assert alone.without_scene() == alone

    def test_the_domain_that_is_told_is_that_of_the_weights_that_serve(
        self, tube: Tube, trained: EmbeddedEnhancer, monkeypatch: pytest.MonkeyPatch
    ) -> None:
        """Not of the most familiar one, where the judge prefers another."""
        familiar_one = replace(trained, domain_score=1.2)
        better = replace(trained, domain_score=1.4)
        monkeypatch.setattr(scene_restorer, "pretrained", lambda _: (familiar_one, better))
        monkeypatch.setattr(EmbeddedEnhancer, "with_domain_score", lambda self, _: self)
        monkeypatch.setattr(scene_restorer, "best_of_all", lambda restorers, *_, **__: restorers[1])
        heard: list[Event] = []
        config = SMALL.model_copy(update={"train_iterations": 0})
        with subscribed(heard.append):
            served = train_enhancer(tube.scene, tube.sequence, config, CoarseConfig())
        assert isinstance(served, EmbeddedEnhancer)
        told = [event.value for event in heard if getattr(event, "name", "") == "domain_score"]
        assert told == [served.domain_score] == [1.4]

    def test_validation_pairs_have_valid_pixels(self, tube_pairs: Pairs) -> None:
        chosen = np.flatnonzero(tube_pairs.validation)
        weight = tube_pairs.weight.clone()
        weight[chosen[0]] = 0
        found, before = validation_pairs(replace(tube_pairs, weight=weight)), validation_pairs(tube_pairs)
        assert found is not None
        assert before is not None
        assert len(found) == len(before) - 1

    @pytest.mark.parametrize("height", [4, 6])
    def test_pairs_lower_than_the_window_of_ssim_are_judged_without_it(
        self, tube: Tube, tube_pairs: Pairs, trained: EmbeddedEnhancer, height: int
    ) -> None:
        """Frames of 640 x 8 px are restored at 320 x 4."""
        low = replace(
            tube_pairs,
            layers=Layers(tube_pairs.layers.data[:, :, :height]),
            target=tube_pairs.target[:, :, :height],
            weight=tube_pairs.weight[:, :, :height],
            depth_mm=tube_pairs.depth_mm[:, :, :height],
        )
        scores = validation_scores(trained, low, tube.references.transfer, (1,))
        assert set(scores) == {"none", "classical", "embedded_1"}
        for score in scores.values():
            assert {"psnr", "psnr_kept"} <= set(score)
            assert ("ssim" in score) == (height > SSIM_WINDOW_PX // 2)

    def test_error_over_what_was_expected(
        self, tube: Tube, tube_pairs: Pairs, trained: EmbeddedEnhancer
    ) -> None:
        transfer = tube.references.transfer
        plain = replace(trained, calibration=Calibration((0.01, 1.0), (0.01, 1.0)))
        doubled = replace(trained, calibration=Calibration((0.01, 1.0), (0.02, 2.0)))
        chosen = validation_pairs(tube_pairs)
        assert chosen is not None
        restored = restored_pairs(plain, chosen, transfer)
        ratio, half = (error_over_expected(each, restored) for each in (plain, doubled))
        assert ratio is not None
        assert half == pytest.approx(ratio / 2, rel=1e-5)
        expected, true = cell_errors(restored)
        assert ratio == pytest.approx(true.mean() / expected.mean(), rel=1e-5)

    def test_the_error_of_a_restorer_trained_on_the_scene_is_over_what_its_weights_expect(
        self, tube: Tube, tube_pairs: Pairs, trained: EmbeddedEnhancer, tmp_path, monkeypatch
    ) -> None:
        """Its own expectation was fitted to these very pairs: the error is never above it."""
        monkeypatch.setattr(calibration, "MIN_CELLS", 50)
        monkeypatch.setattr(scene_restorer, "make_pairs", lambda *_: tube_pairs)
        sure = replace(trained, calibration=Calibration((0.01, 1.0), (0.001, 0.1)))
        sure.save(tmp_path)
        harmful = {"scene_learning_rate": 0.5, "train_iterations": 3, "pretrained_weights": str(tmp_path)}
        served = train_enhancer(tube.scene, tube.sequence, SMALL.model_copy(update=harmful), CoarseConfig())
        assert isinstance(served, EmbeddedEnhancer)
        assert served.calibration != sure.calibration
        untouched = best_of_all([sure], tube_pairs, tube.references.transfer)
        assert isinstance(untouched, EmbeddedEnhancer)
        ratios = [each.record["judged"]["error_over_expected"] for each in (served, untouched)]
        assert ratios[0] == pytest.approx(ratios[1], rel=1e-2) != pytest.approx(1, rel=0.5)

    def test_pairs_are_restored_once_to_judge_and_to_calibrate(
        self, tube: Tube, tube_pairs: Pairs, trained: EmbeddedEnhancer, monkeypatch
    ) -> None:
        count = 0
        once = EmbeddedEnhancer.restored_layers

        def counted(self: EmbeddedEnhancer, *given: Any, **named: Any) -> Any:
            nonlocal count
            count += 1
            return once(self, *given, **named)

        monkeypatch.setattr(EmbeddedEnhancer, "restored_layers", counted)
        transfer = tube.references.transfer
        plain = replace(trained, calibration=Calibration())
        kept = best_of_all([plain], tube_pairs, transfer, calibrate=True)
        chosen = validation_pairs(tube_pairs)
        assert chosen is not None
        assert count == len(chosen)
        assert isinstance(kept, EmbeddedEnhancer)
        assert kept.calibration == Calibration.fitted(*cell_errors(restored_pairs(plain, chosen, transfer)))
        assert best_of_all([plain], tube_pairs, transfer).calibration == plain.calibration

    @pytest.mark.parametrize(("most", "expected"), [(48, 20), (8, 8)])
    def test_no_more_pairs_are_judged_than_tell_something(
        self, tube: Tube, trained: EmbeddedEnhancer, tmp_path, monkeypatch, most: int, expected: int
    ) -> None:
        trained.save(tmp_path, half=True)
        judged: list[Pairs] = []

        def keep(
            enhancers: list[EmbeddedEnhancer], pairs: Pairs, _: object, *, calibrate: bool, cloning: str
        ) -> EmbeddedEnhancer:
            assert calibrate
            assert cloning == "auto"
            judged.append(pairs)
            return enhancers[0]

        monkeypatch.setattr(scene_restorer, "best_of_all", keep)
        settings = {
            "train_iterations": 0,
            "pretrained_weights": str(tmp_path),
            "judge_pairs": most,
            "folds": 2,
            # How many pairs there are does not depend on how good their folds are.
            "fold_iterations": 20,
        }
        train_enhancer(tube.scene, tube.sequence, SMALL.model_copy(update=settings), CoarseConfig())
        (pairs,) = judged
        assert len(pairs) == expected
        assert pairs.validation.all()
        # From both folds, and from the scene as well as from its perturbed copy.
        assert {*pairs.synthetic.tolist()} == {True, False}
        assert len({*pairs.frame.tolist()}) == expected / 2

    def test_a_plain_regression_needs_no_noise(self, tube: Tube, tube_pairs: Pairs, clip: Clip) -> None:
        brief = SMALL.model_copy(update={"train_iterations": 12})
        plain = train_on_scene(tube_pairs, tube.references.transfer, brief, deterministic=True)
        assert plain.steps == 1
        assert plain.record["validation"].keys() == {"none", "classical", "embedded_1"}
        assert np.array_equal(plain.restore(clip).rgb, replace(plain, seed=5).restore(clip).rgb)

    def test_without_weights_it_says_what_to_do(self, tmp_path) -> None:
        with pytest.raises(WeightsError, match="train the restorer"):
            load_enhancer(tmp_path)
        with pytest.raises(WeightsError, match="train the restorer"):
            EmbeddedEnhancer.load(tmp_path)

    def test_foreign_weights_are_refused(self, trained: EmbeddedEnhancer, tmp_path) -> None:
        from safetensors.torch import save_file

        trained.save(tmp_path)
        save_file({"something": torch.zeros(1)}, str(tmp_path / "restorer.safetensors"))
        with pytest.raises(WeightsError, match="not the weights"):
            load_enhancer(tmp_path)


class TestGamut:
    def test_real_colours_stay_and_foreign_hues_do_not(self) -> None:
        generator = torch.Generator().manual_seed(3)
        shade = torch.rand(2, 1, 24, 24, generator=generator) * 0.6 + 0.3
        tissue = shade * torch.tensor([1.0, 0.6, 0.5])[None, :, None, None]
        gamut = Gamut.of_images(tissue, torch.ones(2, 1, 24, 24))
        torch.testing.assert_close(gamut.bounded(tissue), tissue, atol=2e-3, rtol=0)
        green = tissue[:, [1, 0, 2]]
        bounded = gamut.bounded(green)
        assert (bounded[:, 0] > bounded[:, 1]).all()
        torch.testing.assert_close(bounded.mean(dim=1), green.mean(dim=1), atol=0.02, rtol=0)

    def test_dark_frames_set_no_bounds(self) -> None:
        dark = torch.zeros(1, 3, 8, 8)
        image = torch.rand(1, 3, 8, 8, generator=torch.Generator().manual_seed(1))
        gamut = Gamut.of_images(dark, torch.ones(1, 1, 8, 8))
        torch.testing.assert_close(gamut.bounded(image), image, atol=2e-3, rtol=0)
