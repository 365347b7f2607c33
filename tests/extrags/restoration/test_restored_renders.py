from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch

from extrags.config import EnhanceConfig
from extrags.config.stages import Finish
from extrags.errors import ShapeError
from extrags.evaluation import render
from extrags.metrics.protocol import RenderedViews
from extrags.restoration import restored_renders as restored_renders_module
from extrags.restoration.benchmark.variants import AsRendered
from extrags.restoration.classical import ClassicalEnhancer
from extrags.restoration.diffusion.precision import chosen_precision
from extrags.restoration.protocol import Clip, Enhancer, Restoration
from extrags.restoration.refinement.refiner import Refiner
from extrags.restoration.restored_renders import (
    RESTORED_SHARE,
    RestoredShares,
    restored_renders,
    restored_shares,
)
from extrags.view_synthesis.gather import gather_references
from tests.extrags.lit_tube import Tube
from tests.extrags.restoration.test_refinement import untrained

CONFIG = EnhanceConfig(references=4)


@pytest.fixture(scope="module")
def renders(tube: Tube) -> RenderedViews:
    return render(tube.scene, tube.sequence)


@pytest.fixture(scope="module")
def shown(tube: Tube) -> RenderedViews:
    """The coarse scene's views as they are restored: in the colours of `ReferenceViews.shown`."""
    training = tube.sequence.training_part()
    references = gather_references(tube.scene, training, training.train)
    return render(references.shown(tube.scene), tube.sequence)


@pytest.fixture
def each_alone(monkeypatch: pytest.MonkeyPatch) -> None:
    """Views that do not look at their neighbours: what is mixed can be told."""
    monkeypatch.setattr(restored_renders_module, "agreed_views", lambda rgb, *_: rgb)


def restored(tube: Tube, renders: RenderedViews, enhancer: Enhancer) -> RenderedViews:
    training = tube.sequence.training_part()
    return restored_renders(tube.scene, renders, tube.sequence, training, enhancer, CONFIG, finish="smooth")


class Unnamed(AsRendered):
    """Blends and fills, but is not known to do no more than that."""

    def restore(self, clip: Clip) -> Restoration:
        return ClassicalEnhancer().restore(clip)


class Keeping(Unnamed):
    """Says that it keeps what is known, as one that clones seamlessly does."""

    keeps_known = True


class TestRestoredRenders:
    @pytest.mark.usefixtures("each_alone")
    def test_a_restorer_that_changes_nothing_leaves_the_mean_of_both_scenes(
        self, tube: Tube, renders: RenderedViews, shown: RenderedViews
    ) -> None:
        """The restored view is the coarse scene's own, at the exposure of the protocol."""
        bright = replace(renders, rgb=np.full_like(renders.rgb, 0.75), alpha=np.ones_like(renders.alpha))
        mixed = restored(tube, bright, AsRendered())
        expected = RESTORED_SHARE * shown.rgb.clip(0, 1) + (1 - RESTORED_SHARE) * 0.75
        np.testing.assert_allclose(mixed.rgb, expected, atol=1e-5)

    @pytest.mark.usefixtures("each_alone")
    @pytest.mark.parametrize(
        "shares", [RestoredShares(0.1), RestoredShares(0.1, 0.0), RestoredShares(0.6, 0.2)]
    )
    def test_more_of_the_final_scene_is_kept_where_that_was_judged(
        self, tube: Tube, renders: RenderedViews, shown: RenderedViews, shares: RestoredShares
    ) -> None:
        bright = replace(renders, rgb=np.full_like(renders.rgb, 0.75), alpha=np.ones_like(renders.alpha))
        training = tube.sequence.training_part()
        mixed = restored_renders(
            tube.scene, bright, tube.sequence, training, AsRendered(), CONFIG, finish="smooth", shares=shares
        )
        share = np.abs(mixed.rgb - 0.75) / np.abs(shown.rgb.clip(0, 1) - 0.75).clip(1e-3)
        for expected in (shares.known, shares.invented):
            assert (np.abs(share - expected) < 1e-3).mean() > 0.05
        assert share.max() < max(shares.known, shares.invented) + 1e-2
        assert share.min() > min(shares.known, shares.invented) - 1e-2

    def test_what_serves_as_it_is_gets_no_texture(self, tube: Tube, renders: RenderedViews) -> None:
        """Where invented pixels lose, only holes of the final scene are finished, and here it has none."""
        solid = replace(renders, alpha=np.ones_like(renders.alpha))
        training = tube.sequence.training_part()

        def finished(finish: Finish, shares: RestoredShares) -> np.ndarray:
            return restored_renders(
                tube.scene, solid, tube.sequence, training, Unnamed(), CONFIG, finish=finish, shares=shares
            ).rgb

        alone = RestoredShares(0.0, 0.0)
        np.testing.assert_array_equal(finished("textured", alone), finished("smooth", alone))
        np.testing.assert_allclose(finished("smooth", alone), renders.rgb.clip(0, 1), atol=1e-6)
        assert (finished("textured", RestoredShares()) != finished("smooth", RestoredShares())).any()

    @pytest.mark.usefixtures("each_alone")
    def test_the_final_scene_counts_only_where_it_has_a_surface(
        self, tube: Tube, renders: RenderedViews, shown: RenderedViews
    ) -> None:
        empty = replace(renders, rgb=np.ones_like(renders.rgb), alpha=np.zeros_like(renders.alpha))
        mixed = restored(tube, empty, AsRendered())
        np.testing.assert_allclose(mixed.rgb, shown.rgb.clip(0, 1), atol=1e-5)

    def test_blending_and_filling_leaves_what_is_known_as_it_was_rendered(
        self, tube: Tube, renders: RenderedViews
    ) -> None:
        solid = replace(renders, alpha=np.ones_like(renders.alpha))
        mixed = restored(tube, solid, ClassicalEnhancer())
        rendered = renders.rgb.clip(0, 1)
        changed = np.abs(mixed.rgb - rendered).max(axis=-1)
        assert (changed < 1e-6).any()
        anyhow = np.abs(restored(tube, solid, Unnamed()).rgb - rendered).max(axis=-1)
        assert changed.mean() < 0.9 * anyhow.mean()
        truth = tube.sequence.rgb[tube.sequence.test] / 255
        assert np.square(mixed.rgb - truth).mean() < np.square(renders.rgb - truth).mean()

    @pytest.mark.parametrize("max_width", [None, 32])
    def test_neighbouring_views_agree_on_what_is_invented(
        self, tube: Tube, renders: RenderedViews, monkeypatch: pytest.MonkeyPatch, max_width: int | None
    ) -> None:
        """Two views of one hole, painted differently, come nearer; also those that are restored small."""

        class Painted(Unnamed):
            def restore(self, clip: Clip) -> Restoration:
                found = super().restore(clip)
                gain = np.linspace(0.7, 1.3, len(clip), dtype=np.float32)[:, None, None, None]
                return replace(found, rgb=found.rgb * gain)

        config = CONFIG.model_copy(update={"max_width": max_width})
        training = tube.sequence.training_part()

        def painted() -> np.ndarray:
            return restored_renders(
                tube.scene, renders, tube.sequence, training, Painted(), config, finish="smooth"
            ).rgb

        agreeing = painted()
        monkeypatch.setattr(restored_renders_module, "agreed_views", lambda rgb, *_: rgb)
        change = agreeing - painted()
        # The first view is too dark, the last too bright.
        assert change[0].mean() > 1e-4
        assert change[-1].mean() < -1e-4
        assert (np.abs(change).max(axis=-1) < 1e-6).mean() > 0.05

    def test_holes_of_the_final_scene_are_invented_whatever_was_judged(
        self, tube: Tube, renders: RenderedViews, monkeypatch: pytest.MonkeyPatch
    ) -> None:
        half = renders.rgb.shape[2] // 2
        solid = replace(renders, alpha=np.ones_like(renders.alpha))
        solid.alpha[..., :half] = 0
        training = tube.sequence.training_part()

        def invented(shares: RestoredShares) -> torch.Tensor:
            asked: list[torch.Tensor] = []
            monkeypatch.setattr(
                restored_renders_module,
                "agreed_views",
                lambda rgb, _, unconfirmed, *__: [rgb, asked.append(unconfirmed)][0],
            )
            restored_renders(
                tube.scene, solid, tube.sequence, training, Unnamed(), CONFIG, finish="smooth", shares=shares
            )
            return torch.cat(asked)

        usual, none = invented(RestoredShares()), invented(RestoredShares(0.0, 0.0))
        assert usual[..., :half].any()
        assert usual[..., half:].any()
        torch.testing.assert_close(none[..., :half], usual[..., :half])
        assert none[..., half:].abs().max() < 1e-6

    def test_geometry_stays_that_of_the_scene(self, tube: Tube, renders: RenderedViews) -> None:
        mixed = restored(tube, renders, ClassicalEnhancer())
        np.testing.assert_array_equal(mixed.depth_mm, renders.depth_mm)
        np.testing.assert_array_equal(mixed.alpha, renders.alpha)
        assert mixed.n_gaussians == renders.n_gaussians

    def test_renders_of_other_frames_are_refused(self, tube: Tube, renders: RenderedViews) -> None:
        one = RenderedViews(renders.rgb[:1], renders.alpha[:1], renders.depth_mm[:1], renders.n_gaussians)
        with pytest.raises(ShapeError, match="1 renders of 2 held-out frames"):
            restored(tube, one, ClassicalEnhancer())


class Shifted(Unnamed):
    """Makes all views brighter than those it was made for."""

    def __init__(self, views: np.ndarray, shift: float) -> None:
        super().__init__()
        self._views, self._shift = iter(views), shift

    def restore(self, clip: Clip) -> Restoration:
        views = np.stack([next(self._views) for _ in range(len(clip))])
        return replace(super().restore(clip), rgb=(views + self._shift).astype(np.float32))


class TestRestoredShares:
    @pytest.mark.parametrize(
        ("nearest", "expected"),
        # What restoring gains, or loses a little, is taken; what harms is taken as far as it helps, or not.
        # Between a loss of 2 and of 3 dB (here 20 log10(0.34 / 0.26) = 2.33) one passes into the other.
        [(1.0, RESTORED_SHARE), (0.28, RESTORED_SHARE), (0.26, 0.488), (0.2, 0.2), (-0.5, 0.0)],
    )
    def test_known_pixels_take_the_nearest_mixture_where_restoring_harms(
        self, tube: Tube, renders: RenderedViews, nearest: float, expected: float
    ) -> None:
        shift = 0.1
        truth = tube.sequence.rgb[tube.sequence.test].astype(np.float32) / 255
        rendered = (truth - nearest * shift).astype(np.float32)
        trials = [(tube.scene, replace(renders, rgb=rendered), tube.sequence)]
        found = restored_shares(trials, Shifted(rendered.clip(0, 1), shift), CONFIG)
        assert found is not None
        assert found.known == pytest.approx(expected, abs=0.01)

    def test_the_errors_of_a_brief_trial_are_larger_than_the_scenes(
        self, tube: Tube, renders: RenderedViews
    ) -> None:
        """Restored views a little better than those of the trial are worse than those of the scene."""
        # No colour so dark or bright that an error would leave the range.
        gray = tube.sequence.rgb // 2 + 64
        sequence = replace(tube.sequence, rgb=gray.astype(np.uint8))
        truth = sequence.rgb[sequence.test].astype(np.float32) / 255
        rng = np.random.default_rng(0)
        rendered = (truth + 0.10 * rng.choice([-1, 1], truth.shape)).astype(np.float32)
        other = (truth + 0.09 * rng.choice([-1, 1], truth.shape)).astype(np.float32)
        trials = [(tube.scene, replace(renders, rgb=rendered), sequence)]

        def found(error_share: float) -> RestoredShares | None:
            return restored_shares(trials, Shifted(other, 0.0), CONFIG, error_share=error_share)

        assert found(1.0) == RestoredShares()
        better = found(0.1)
        assert better is not None
        # Of independent errors the weights are the inverse squares.
        assert better.known == pytest.approx(0.1 * 0.10**2 / (0.1 * 0.10**2 + 0.09**2), abs=0.05)

    @pytest.mark.parametrize(("certainty", "expected"), [(0.0, 0.6), (0.25, 0.5), (1.0, 0.2)])
    def test_invented_pixels_follow_as_far_as_known_ones_decide(
        self,
        tube: Tube,
        renders: RenderedViews,
        certainty: float,
        expected: float,
        monkeypatch: pytest.MonkeyPatch,
    ) -> None:
        told = {"known": (0.4, certainty), "invented": (0.2, 1.0)}
        monkeypatch.setattr(restored_renders_module._Errors, "share", lambda _self, kind, _share: told[kind])
        shown = renders.rgb.clip(0, 1)
        found = restored_shares([(tube.scene, renders, tube.sequence)], Shifted(shown, 0.0), CONFIG)
        assert found is not None
        assert found.known == (0.4 if certainty else RESTORED_SHARE)
        assert found.invented == pytest.approx(expected)

    def test_what_lies_outside_the_masks_does_not_decide(self, tube: Tube, renders: RenderedViews) -> None:
        test = tube.sequence.test
        mask, other = tube.sequence.mask.copy(), tube.sequence.rgb.copy()
        mask[..., 40:] = False
        other[test, :, 40:] = 255 - other[test, :, 40:]
        truth = tube.sequence.rgb[test].astype(np.float32) / 255
        rendered = (truth - 0.02).astype(np.float32)
        found = [
            restored_shares(
                [(tube.scene, replace(renders, rgb=rendered), replace(tube.sequence, mask=mask, rgb=rgb))],
                Shifted(rendered.clip(0, 1), 0.1),
                CONFIG,
            )
            for rgb in (tube.sequence.rgb, other)
        ]
        assert found[0] is not None
        assert found[0].known < RESTORED_SHARE
        assert found[0] == found[1]

    def test_smaller_errors_have_less_in_common_with_those_of_restored_views(self) -> None:
        """A quarter of the squared error is half the error, and so half its product with another."""
        errors = restored_renders_module._Errors
        trial = errors(pixels=1e4, rendered=4.0, restored=10.0, product=1.5)
        scene = errors(pixels=1e4, rendered=1.0, restored=10.0, product=0.75)
        share, certainty = trial.share("known", 0.25)
        assert (share, certainty) == pytest.approx(scene.share("known", 1.0))
        assert share == pytest.approx(0.25 / 9.5)
        assert certainty == 1

    def test_blending_and_filling_needs_none(self, tube: Tube, renders: RenderedViews) -> None:
        assert restored_shares([(tube.scene, renders, tube.sequence)], ClassicalEnhancer(), CONFIG) is None


def test_a_refiner_changes_only_what_is_invented(
    tube: Tube, renders: RenderedViews, monkeypatch: pytest.MonkeyPatch
) -> None:
    training = tube.sequence.training_part()

    def finished(finish: Finish, enhancer: Enhancer) -> np.ndarray:
        return restored_renders(
            tube.scene, renders, tube.sequence, training, enhancer, CONFIG, finish=finish
        ).rgb

    smooth, textured = finished("smooth", Unnamed()), finished("textured", Unnamed())
    asked: list[bool] = []

    def refiner(*, half_precision: bool) -> Refiner:
        asked.append(half_precision)
        return untrained(scrambled=True)

    monkeypatch.setattr(restored_renders_module, "bundled_refiner", refiner)
    refined = finished("refined", Unnamed())
    changed = np.abs(textured - smooth).max(axis=-1) > 1e-5
    assert changed.any()
    assert (refined != textured)[changed].mean() > 0.9
    # Both ways touch the same pixels, and keep the bits of all others.
    known = (textured == smooth).all(axis=-1)
    assert known.any()
    assert (refined == smooth).all(axis=-1)[known].mean() > 0.999
    assert asked == [chosen_precision(CONFIG) == "bfloat16"]
    # Where the leave-out frames speak against networks, none of them invents anything.
    without = finished("refined", ClassicalEnhancer())
    assert np.array_equal(without, finished("textured", ClassicalEnhancer()))
    assert np.array_equal(finished("refined", Keeping()), finished("textured", Keeping()))
    assert len(asked) == 1


class TestMeanDepth:
    def test_it_lies_between_both_where_the_final_scene_has_a_surface(self) -> None:
        own, scene, solid = (torch.full((1, 1, 60, 160), value) for value in (4.0, 9.0, 1.0))
        solid[..., 80:] = 0
        found = restored_renders_module._mean_depth(own, scene, solid)
        torch.testing.assert_close(found[..., :70], torch.full((1, 1, 60, 70), 6.0))
        torch.testing.assert_close(found[..., 100:], own[..., 100:])
        # Without a step that texture and normals would show.
        assert float(found.log().diff(dim=-1).abs().max()) < 0.15

    def test_roughness_of_rendered_depth_does_not_come_through(self) -> None:
        noise = 0.2 * torch.randn(1, 1, 60, 160, generator=torch.Generator().manual_seed(0))
        own, scene = torch.full((1, 1, 60, 160), 4.0), 9 * noise.exp()
        found = restored_renders_module._mean_depth(own, scene, torch.ones(1, 1, 60, 160))
        assert float(found.log().std()) < 0.2 * 0.5 * float(scene.log().std())

    def test_far_apart_they_are_not_one_surface(self) -> None:
        own, scene, solid = (torch.full((1, 1, 60, 160), value) for value in (4.0, 400.0, 1.0))
        found = restored_renders_module._mean_depth(own, scene, solid)
        torch.testing.assert_close(found, own * float(np.exp(0.5)))

    def test_larger_renders_and_unknown_depth(self) -> None:
        own, scene = torch.full((1, 1, 20, 50), 4.0), torch.full((1, 1, 60, 150), 9.0)
        scene[..., ::7] = 0
        found = restored_renders_module._mean_depth(own, scene, torch.ones(1, 1, 60, 150))
        torch.testing.assert_close(found, torch.full((1, 1, 20, 50), 6.0))
