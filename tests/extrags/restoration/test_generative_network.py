from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any, ClassVar

import numpy as np
import pytest
import torch
from torch import Tensor

from extrags.config import EnhanceConfig
from extrags.metrics.lpips import Lpips
from extrags.restoration.diffusion import texture_transfer
from extrags.restoration.diffusion.adversary import Adversary, Scene
from extrags.restoration.diffusion.embedded import EmbeddedEnhancer
from extrags.restoration.diffusion.network import build_network
from extrags.restoration.diffusion.network_training import (
    NetworkTraining,
    TrainingSettings,
    drawn_loss,
    train_network,
)
from extrags.restoration.diffusion.patches import choose_patches
from extrags.restoration.diffusion.rectified_flow import Predicted, sample
from extrags.restoration.diffusion.scene_training import train_on_scene
from extrags.restoration.diffusion.texture_transfer import KEY_WIDTH, PatchFeatures, TextureTransfer
from extrags.restoration.training_data.augmentation import Batch, random_patches
from extrags.restoration.training_data.pairs import Pairs
from extrags.sequence import EndoscopicSequence
from extrags.view_synthesis.conditioning import CONDITION_CHANNELS, INVENTED_CHANNELS, Conditioning
from extrags.view_synthesis.gamut import Gamut
from tests.extrags.lit_tube import Tube
from tests.extrags.restoration.conftest import SMALL

WIDTHS = (16, 24, 32)


def seeded(seed: int) -> torch.Generator:
    return torch.Generator().manual_seed(seed)


def generative_network(seed: int = 1) -> torch.nn.Module:
    return build_network(CONDITION_CHANNELS, WIDTHS, seeded(seed), generative=True)


def conditioning(views: int, side: int) -> Conditioning:
    channels = torch.randn(views, CONDITION_CHANNELS, side, side, generator=seeded(2))
    return Conditioning(
        channels, torch.full((views, 3, side, side), 0.4), torch.full((views, 1, side, side), 9.0)
    )


def batch(views: int = 2, side: int = 32) -> Batch:
    ones = torch.ones(views, 1, side, side)
    return Batch(
        conditioning(views, side),
        torch.rand(views, 3, side, side, generator=seeded(4)),
        ones,
        9 * ones,
        0.7 * ones,
        torch.rand(views, 3, 3, 32, 32, generator=seeded(6)),
    )


@pytest.fixture
def perceptual(shared_data: Path) -> Lpips:
    return Lpips.load(shared_data / "lpips_weights", "squeeze")


class TestTextureTransfer:
    def test_an_untrained_network_takes_nothing(self) -> None:
        network = generative_network().eval()
        given = conditioning(1, 32)
        patches = network.texture.encode(torch.randn(1, 3, 3, 32, 32, generator=seeded(5)))
        noise, time = torch.randn(1, 3, 32, 32, generator=seeded(8)), torch.ones(1)
        with torch.no_grad():
            alone = network(given.channels, noise, time)
            assert torch.equal(alone, network(given.channels, noise, time, torch.ones(1), patches))

    def test_each_place_takes_the_block_of_the_patch_that_is_most_like_it(self) -> None:
        network = generative_network()
        texture = network.texture
        torch.nn.init.dirac_(texture.to_fine.weight)
        torch.nn.init.dirac_(texture.to_middle.weight)
        patches = texture.encode(torch.randn(1, 2, 3, 32, 32, generator=seeded(5)))
        coarse = torch.randn(1, WIDTHS[2], 4, 4, generator=seeded(7))
        with torch.no_grad():
            taken = texture(coarse, patches)
            query = torch.nn.functional.normalize(texture.query(coarse).flatten(2).transpose(1, 2), dim=-1)
            best = (query @ patches.key.transpose(1, 2)).argmax(dim=2)[0, 6]
            # Place 6 is row 1, column 2; a gate of an untrained network lets half through.
            inner = patches.fine.shape[2] // 16
            expected = patches.fine[0, best].unflatten(0, (inner, 4, 4))
            found = (taken.fine - texture.to_fine.bias[:, None, None])[0, :inner, 4:8, 8:12]
            bias = texture.to_fine.bias[:inner, None, None]
            torch.testing.assert_close(2 * (found + bias) - bias, expected, rtol=1e-4, atol=1e-4)

    def test_many_places_at_once_are_as_few_at_a_time(self, monkeypatch: pytest.MonkeyPatch) -> None:
        network = generative_network()
        patches = network.texture.encode(torch.randn(1, 2, 3, 32, 32, generator=seeded(5)))
        torch.nn.init.normal_(network.texture.to_coarse.weight, generator=seeded(3))
        coarse = torch.randn(1, WIDTHS[2], 8, 8, generator=seeded(7))
        with torch.no_grad():
            whole = network.texture(coarse, patches).coarse
            monkeypatch.setattr("extrags.restoration.diffusion.texture_transfer.QUERIES_AT_ONCE", 7)
            torch.testing.assert_close(network.texture(coarse, patches).coarse, whole, rtol=1e-5, atol=1e-5)

    def test_the_best_place_is_found_in_float32_whatever_the_precision(
        self, monkeypatch: pytest.MonkeyPatch
    ) -> None:
        """In bfloat16 similarities are multiples of 1/256, and the first of several equal ones was taken."""
        transfer = TextureTransfer((16, 16, KEY_WIDTH)).eval()
        torch.nn.init.dirac_(transfer.query.weight)
        torch.nn.init.zeros_(transfer.query.bias)
        places = 500
        # Of values that bfloat16 holds, so that the queries are the same in either precision.
        coarse = torch.randn(1, KEY_WIDTH, 6, 6, generator=seeded(1)).bfloat16().float()
        # Of much the same looks, as mucosa has.
        like = 1 + 0.1 * torch.randn(1, places, KEY_WIDTH, generator=seeded(2))
        key = torch.nn.functional.normalize(like, dim=-1)
        patches = PatchFeatures(
            key,
            torch.randn(1, places, 32, generator=seeded(3)),
            torch.randn(1, places, 4 * 8, generator=seeded(4)),
            torch.randn(1, places, 16 * 8, generator=seeded(5)),
        )
        found: list[Tensor] = []
        fetched = texture_transfer._fetched
        monkeypatch.setattr(
            texture_transfer,
            "_fetched",
            lambda features, index, *size: found.append(index) or fetched(features, index, *size),
        )
        with torch.no_grad():
            transfer(coarse, patches)
            with torch.autocast("cpu", torch.bfloat16):
                transfer(coarse, patches)
        assert len(found) == 4
        assert all(torch.equal(index, found[0]) for index in found)

    def test_patches_of_small_frames_fit_the_encoder(self) -> None:
        frames = torch.rand(2, 3, 60, 90, generator=seeded(5))
        valid = torch.ones(2, 60, 90, dtype=torch.bool)
        patches = random_patches(frames, valid, 3, 64, np.random.default_rng(1))
        assert patches.shape == (3, 3, 56, 56)
        assert generative_network().texture.encode(patches[None]).key.shape == (1, 3 * 7 * 7, 64)


class TestWidened:
    def test_it_answers_as_the_network_it_came_from(self) -> None:
        small = build_network(CONDITION_CHANNELS, WIDTHS, seeded(1))
        torch.nn.init.normal_(small.exit.weight, std=0.1, generator=seeded(3))
        wide = small.widened(CONDITION_CHANNELS + 4)
        given = conditioning(1, 32).channels
        more = torch.randn(1, 4, 32, 32, generator=seeded(11))
        noise, time = torch.randn(1, 3, 32, 32, generator=seeded(8)), torch.ones(1)
        with torch.no_grad():
            expected = small(given, noise, time)
            answer = wide(torch.cat([given, more], dim=1), noise, time, torch.zeros(1))
        torch.testing.assert_close(answer, expected, rtol=1e-4, atol=1e-5)


class TestAdversary:
    def test_it_learns_to_tell_noise_from_smooth_views(self, perceptual: Lpips) -> None:
        smooth = torch.full((2, 3, 64, 64), 0.5)
        noisy = torch.rand(2, 3, 64, 64, generator=seeded(1))
        channels = [tap.shape[1] for tap in perceptual.activations(torch.zeros(1, 64, 64, 3))]
        adversary = Adversary(channels, 1e-3, 0)
        scene = Scene(smooth, torch.ones(2, 1, 64, 64))

        def seen(images: Tensor) -> tuple[Tensor, list[Tensor]]:
            return images, list(perceptual.activations(images.permute(0, 2, 3, 1)))

        losses = [adversary.step(seen(smooth), seen(noisy), scene) for _ in range(14)]
        assert losses[-1] < 0.6 * losses[0]
        deceived = [
            float(adversary.generator_loss(*seen(images), scene).detach()) for images in (smooth, noisy)
        ]
        assert deceived[1] < deceived[0]

    def test_its_weights_come_from_its_seed_alone(self, perceptual: Lpips) -> None:
        before = torch.random.get_rng_state()
        first, second = (Adversary([8] * 7, 1e-3, 3).state_dict() for _ in range(2))
        assert torch.equal(before, torch.random.get_rng_state())
        assert all(torch.equal(first[name], second[name]) for name in first)


class TestTrainingOfDrawing:
    SETTINGS: ClassVar[dict[str, Any]] = {
        "learning_rate": 2e-3,
        "half_precision": False,
        "drawn_share": 1.0,
    }

    def test_the_loss_of_drawn_views_falls(self, perceptual: Lpips) -> None:
        settings = TrainingSettings(15, perceptual=perceptual, **self.SETTINGS)
        training = NetworkTraining(generative_network(), settings, seeded(3))
        found = [training.step(batch()) for _ in range(15)]
        assert found[-1]["drawn_loss"] < 0.8 * found[0]["drawn_loss"]
        assert all(np.isfinite(step["adversary"]) for step in found)

    def test_what_is_invented_counts_by_its_coarse_colours_alone(self) -> None:
        clean = torch.rand(1, 3, 32, 32, generator=seeded(4))
        shuffled = clean.unflatten(2, (4, 8)).unflatten(4, (4, 8)).flip((3, 5)).flatten(4, 5).flatten(2, 3)
        ones = torch.ones(1, 1, 32, 32)

        def loss(rgb: Tensor, invented: float) -> float:
            given = Batch(conditioning(1, 32), clean, ones, 9 * ones, invented * ones)
            predicted = Predicted(rgb, torch.full((1, 1, 32, 32), float(np.log(9))), torch.zeros_like(ones))
            return float(drawn_loss(predicted, given))

        # Texture in another order costs where pixels are confirmed.
        assert loss(shuffled, 1.0) - loss(clean, 1.0) < 0.02
        assert loss(shuffled, 0.0) - loss(clean, 0.0) > 0.3

    def test_it_goes_on_from_a_checkpoint(self, perceptual: Lpips) -> None:
        settings = TrainingSettings(4, perceptual=perceptual, **self.SETTINGS)
        whole = NetworkTraining(generative_network(), settings, seeded(3))
        for _ in range(2):
            whole.step(batch())
        state = {name: value.clone() for name, value in whole.state().items()}
        later = NetworkTraining(generative_network(9), settings, seeded(0))
        later.restore(state)
        assert later.iteration == 2
        whole.generator.manual_seed(5)
        later.generator.manual_seed(5)
        whole.step(batch())
        later.step(batch())
        for name, value in whole.state().items():
            torch.testing.assert_close(later.state()[name], value, rtol=1e-5, atol=1e-6)

    def test_without_a_perceptual_distance_it_is_refused(self) -> None:
        with pytest.raises(ValueError, match="perceptual distance"):
            train_network(generative_network(), batch, TrainingSettings(1, **self.SETTINGS), seeded(1))


class TestDrawing:
    def enhancer(self) -> EmbeddedEnhancer:
        network = generative_network()
        torch.nn.init.normal_(network.exit.weight, std=0.1, generator=seeded(3))
        torch.nn.init.normal_(network.drawing.weight, generator=seeded(4))
        return EmbeddedEnhancer(network.eval(), 2, 1, 0, False, Gamut(0.0, 1e6, 0.0, 1e6), {})

    def test_drawn_views_differ_with_the_noise_and_are_the_same_for_the_same(self) -> None:
        network, given = self.enhancer().network, conditioning(1, 32)

        def drawn(seed: int) -> Tensor:
            noise = torch.randn(1, 3, 32, 32, generator=seeded(seed))
            return sample(network, given, noise, steps=3, half_precision=False, drawing=True).rgb

        assert torch.equal(drawn(1), drawn(1))
        assert not torch.allclose(drawn(1), drawn(2), atol=1e-3)

    def test_mean_and_drawn_views_are_different_questions(self) -> None:
        enhancer = self.enhancer()
        drawn = enhancer.with_settings(EnhanceConfig(samples=1), enhancer.gamut)
        mean = enhancer.with_settings(EnhanceConfig(samples="mean"), enhancer.gamut)
        assert (drawn.drawing, mean.drawing) == (True, False)
        plain = build_network(CONDITION_CHANNELS, WIDTHS, seeded(1))
        unable = EmbeddedEnhancer(plain, 1, 1, 0, False, enhancer.gamut, {})
        assert not unable.with_settings(EnhanceConfig(samples=1), enhancer.gamut).drawing

    def test_saved_and_loaded_it_keeps_its_patches(self, tube: Tube, tmp_path: Path) -> None:
        patches = choose_patches(tube.sequence, side_px=32)
        enhancer = self.enhancer()
        ready = enhancer.with_settings(EnhanceConfig(precision="float32"), enhancer.gamut, patches)
        ready.save(tmp_path)
        loaded = EmbeddedEnhancer.load(tmp_path)
        assert loaded.drawing
        assert loaded.network.generative
        torch.testing.assert_close(loaded.patches, ready.patches, rtol=0, atol=1e-6)
        self.enhancer().save(tmp_path)
        assert EmbeddedEnhancer.load(tmp_path).patches is None

    def test_one_is_trained_on_a_scene(self, tube: Tube, tube_pairs: Pairs) -> None:
        """With channels of its own for what is invented, and with the texture that it will be shown."""
        network = build_network(
            CONDITION_CHANNELS + INVENTED_CHANNELS, WIDTHS, seeded(1), generative=True
        ).eval()
        start = replace(self.enhancer(), network=network)
        patches = choose_patches(tube.sequence, side_px=32)
        config = SMALL.model_copy(update={"train_iterations": 2, "steps": 1})
        training: list[bool] = []
        network.texture.register_forward_pre_hook(lambda *_: training.append(torch.is_grad_enabled()))
        trained = train_on_scene(tube_pairs, tube.references.transfer, config, start, patches=patches)
        assert trained.patches is patches
        assert training.count(True) == 2
        assert trained.record["iterations"] == 2


class TestChoosePatches:
    def test_they_come_from_frames_far_apart_and_have_texture(self, tube: Tube) -> None:
        patches = choose_patches(tube.sequence, count=4, side_px=32)
        assert patches is not None
        assert patches.shape == (4, 3, 32, 32)
        assert all(0.05 < float(patch.mean()) < 0.9 for patch in patches)
        assert not torch.equal(patches[0], patches[1])

    def test_frames_without_room_for_a_patch(self, tube: Tube) -> None:
        rgb = np.full((len(tube.sequence), 7, 40, 3), 120, np.uint8)
        small = EndoscopicSequence(
            name="low",
            rgb=rgb,
            K=np.repeat(np.diag([20.0, 20.0, 1.0])[None], len(rgb), axis=0),
            mask=np.ones(rgb.shape[:3], dtype=bool),
            split=tube.sequence.split,
        )
        assert choose_patches(small) is None

    def test_without_a_usable_tile_there_are_none(self, tube: Tube) -> None:
        dark = replace(tube.sequence, rgb=np.zeros_like(tube.sequence.rgb))
        assert choose_patches(dark, side_px=32) is None
