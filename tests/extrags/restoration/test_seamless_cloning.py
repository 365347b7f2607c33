"""What is invented joins what is known without a seam; where a restorer does harm, it serves like that."""

from __future__ import annotations

import copy
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from torch import Tensor

from extrags.config import CoarseConfig, SeamlessCloning
from extrags.restoration.backends import load_enhancer, train_enhancer
from extrags.restoration.classical import ClassicalEnhancer
from extrags.restoration.diffusion import scene_restorer
from extrags.restoration.diffusion.embedded import EmbeddedEnhancer
from extrags.restoration.diffusion.error_fit import error_over_expected, with_calibration
from extrags.restoration.diffusion.scene_restorer import best_of_all
from extrags.restoration.diffusion.seamless_cloning import certainty, cloned_seamlessly
from extrags.restoration.diffusion.validation import restored_pairs, validation_pairs
from extrags.restoration.protocol import Clip, keeps_known
from extrags.restoration.training_data.pairs import Pairs
from extrags.restoration.uncertainty import calibration
from extrags.restoration.uncertainty.calibration import Calibration
from extrags.view_synthesis.conditioning import LAYER_CHANNELS, Layers
from tests.extrags.lit_tube import Tube
from tests.extrags.restoration.conftest import SMALL

SIZE = (24, 32)
HOLE = (slice(None), slice(None), slice(6, 18), slice(8, 24))


@pytest.fixture
def certain() -> Tensor:
    """All but a hole in the middle."""
    found = torch.ones(1, 1, *SIZE)
    found[HOLE] = 0
    return found


class TestCloning:
    def test_a_shift_of_colours_goes_and_texture_stays(self, certain: Tensor) -> None:
        base = torch.full((1, 3, *SIZE), 0.5)
        texture = 0.05 * torch.randn(1, 3, *SIZE, generator=torch.Generator().manual_seed(0)) * (1 - certain)
        shift = torch.tensor([0.1, -0.05, 0.02])[None, :, None, None]
        found = cloned_seamlessly(base + texture + shift, base, certain)
        torch.testing.assert_close(found, base + texture, atol=1e-6, rtol=0)

    def test_what_is_certain_keeps_every_colour(self, certain: Tensor) -> None:
        generator = torch.Generator().manual_seed(1)
        rgb, base = (torch.rand(1, 3, *SIZE, generator=generator) for _ in range(2))
        found = cloned_seamlessly(rgb, base, certain)
        known = certain.expand_as(found) == 1
        torch.testing.assert_close(found[known], base[known], atol=1e-6, rtol=0)
        assert found.min() >= 0
        assert found.max() <= 1
        assert not torch.equal(found[HOLE], base[HOLE])

    def test_a_slope_across_the_hole_is_followed(self, certain: Tensor) -> None:
        """At the left border the network is too bright, at the right one too dark."""
        base = torch.full((1, 3, *SIZE), 0.5)
        slope = torch.linspace(0.1, -0.1, SIZE[1]).expand(1, 3, *SIZE)
        found = cloned_seamlessly(base + slope, base, certain)
        # Push-pull is smooth, not linear.
        assert (found - base)[HOLE].abs().max() < 0.5 * slope[HOLE].abs().max()

    def test_of_a_view_of_which_nothing_is_known_all_is_invented(self) -> None:
        rgb = torch.rand(1, 3, *SIZE, generator=torch.Generator().manual_seed(2))
        found = cloned_seamlessly(rgb, torch.full_like(rgb, 0.5), torch.zeros(1, 1, *SIZE))
        torch.testing.assert_close(found, rgb)


def test_certain_is_what_views_or_the_rendering_give_less_their_uncertainty() -> None:
    """Where a real view covers a share w of a pixel, the rendering counts for the rest of it."""
    generator = torch.Generator().manual_seed(3)
    data = torch.rand(2, LAYER_CHANNELS, *SIZE, generator=generator)
    layers = Layers(data)
    layers.get("uncertainty")[0, :, :4] = 1.3  # an estimate may exceed one
    found = certainty(layers).double()
    weight, alpha, off = (layers.get(name).double() for name in ("blend_weight", "alpha", "uncertainty"))
    expected = (1 - (1 - weight) * (1 - alpha)) * torch.where(off < 1, 1 - off, 0.0)
    assert not found[0, :, :4].any()
    torch.testing.assert_close(found, expected, rtol=0, atol=4 * torch.finfo(torch.float32).eps)


def shifting(trained: EmbeddedEnhancer) -> EmbeddedEnhancer:
    """The same restorer, all of whose colours are off."""
    network = copy.deepcopy(trained.network)
    with torch.no_grad():
        network.exit.bias += 0.6
    return replace(trained, network=network)


class TestRestorer:
    def test_pixels_are_those_of_the_base_image_as_far_as_they_are_certain(
        self, trained: EmbeddedEnhancer, clip: Clip
    ) -> None:
        cloning = shifting(trained).cloning_seamlessly()
        assert keeps_known(cloning)
        assert not keeps_known(trained)
        found, base = cloning.restore(clip).rgb, ClassicalEnhancer().restore(clip).rgb
        certain = certainty(clip.layers)[:, 0].numpy()
        off = np.abs(found - base).max(axis=-1)
        plain_off = np.abs(shifting(trained).restore(clip).rgb - base).max(axis=-1)
        # From the membrane, which lies between the differences, each is as far as it is uncertain.
        assert (off <= 2 * (1 - certain) * plain_off.max() + 1e-5).all()
        assert off.mean() < 0.5 * plain_off.mean()
        assert found.min() >= 0
        assert found.max() <= 1

    def test_on_disk_and_back(self, trained: EmbeddedEnhancer, clip: Clip, tmp_path) -> None:
        cloning = replace(trained, untrained=trained).cloning_seamlessly()
        assert cloning.untrained is not None
        assert cloning.untrained.seamless
        cloning.save(tmp_path)
        loaded = load_enhancer(tmp_path)
        assert isinstance(loaded, EmbeddedEnhancer)
        assert loaded.seamless
        assert loaded.untrained is not None
        assert loaded.untrained.seamless
        assert loaded.restore(clip).provenance["seamless"]
        np.testing.assert_array_equal(loaded.restore(clip).rgb, cloning.restore(clip).rgb)

    def test_the_judge_lets_it_serve_where_the_plain_one_does_harm(
        self, trained: EmbeddedEnhancer, tube: Tube, tube_pairs: Pairs, caplog: pytest.LogCaptureFixture
    ) -> None:
        harmful, transfer = shifting(trained), tube.references.transfer
        served = best_of_all([harmful], tube_pairs, transfer)
        assert isinstance(served, EmbeddedEnhancer)
        assert served.seamless
        assert "cloned seamlessly" in caplog.text
        judged = served.record["judged"]
        assert judged["plain_db"] < judged["filled_db"] - 0.5
        assert judged["restored_db"] >= judged["filled_db"] - 0.1
        assert not served.depth_from_image
        assert isinstance(best_of_all([harmful], tube_pairs, transfer, cloning="never"), ClassicalEnhancer)
        plain = best_of_all([trained], tube_pairs, transfer)
        assert isinstance(plain, EmbeddedEnhancer)
        assert not plain.seamless
        assert "plain_db" not in plain.record["judged"]

    @pytest.mark.parametrize("cloning", ["auto", "always"])
    def test_its_expected_error_is_that_of_the_views_it_makes(
        self, trained: EmbeddedEnhancer, tube: Tube, tube_pairs: Pairs, monkeypatch, cloning: SeamlessCloning
    ) -> None:
        """Where training on the scene has fitted it to the plain restorer's, which are far more wrong."""
        monkeypatch.setattr(calibration, "MIN_CELLS", 50)
        transfer, pairs = tube.references.transfer, validation_pairs(tube_pairs)
        assert pairs is not None
        harmful = shifting(trained)
        fitted = with_calibration(harmful, restored_pairs(harmful, pairs, transfer))
        given = fitted.cloning_seamlessly() if cloning == "always" else fitted
        served = best_of_all([given], tube_pairs, transfer, of_weights=Calibration(), cloning=cloning)
        assert isinstance(served, EmbeddedEnhancer)
        assert served.seamless
        ratio = error_over_expected(served, restored_pairs(served, pairs, transfer))
        assert ratio == pytest.approx(1, abs=0.2)

    def test_unjudged_its_expected_error_is_that_as_well(
        self, trained: EmbeddedEnhancer, tube: Tube, tube_pairs: Pairs, tmp_path: Path, monkeypatch
    ) -> None:
        monkeypatch.setattr(calibration, "MIN_CELLS", 50)
        monkeypatch.setattr(scene_restorer, "make_pairs", lambda *_: tube_pairs)
        shifting(trained).save(tmp_path)
        settings = {"scene_learning_rate": 0.5, "train_iterations": 1, "pretrained_weights": str(tmp_path)}
        config = SMALL.model_copy(update={**settings, "judge": False, "seamless_cloning": "always"})
        served = train_enhancer(tube.scene, tube.sequence, config, CoarseConfig())
        assert isinstance(served, EmbeddedEnhancer)
        pairs = validation_pairs(tube_pairs)
        assert pairs is not None
        ratio = error_over_expected(served, restored_pairs(served, pairs, tube.references.transfer))
        assert ratio == pytest.approx(1, abs=0.2)
