"""The refiner: what it is shown, what it leaves alone, and that it learns."""

from __future__ import annotations

import json
from dataclasses import replace
from itertools import pairwise
from pathlib import Path

import pytest
import torch

from extrags.errors import CaptureError, ConfigError, WeightsError
from extrags.metrics.lpips import Lpips
from extrags.restoration.diffusion.embedded import EmbeddedEnhancer
from extrags.restoration.diffusion.network import build_network
from extrags.restoration.diffusion.weights import COLONS, starting_weights
from extrags.restoration.refinement import refiner as refiner_module
from extrags.restoration.refinement import training as training_module
from extrags.restoration.refinement.examples import ExampleCrops, RefinementExamples, RefinerBatch
from extrags.restoration.refinement.refiner import REFINER_CHANNELS, Refiner, textured_views
from extrags.restoration.refinement.training import RefinerConfig, refiner_scores, train_refiner
from extrags.restoration.refinement.weights import bundled_refiner, refiner_digest
from extrags.restoration.surface_texture import LaidTexture, SurfaceTexture
from extrags.view_synthesis.conditioning import CONDITION_CHANNELS, INVENTED_CHANNELS
from tests.extrags.random_lpips import random_weights
from tests.flows.test_pretrain import small_scene

HEIGHT, WIDTH = 52, 76


def tiles(seed: int = 0) -> SurfaceTexture:
    generator = torch.Generator().manual_seed(seed)
    found = torch.randn(16, 3, 32, 32, generator=generator) * 0.2
    return SurfaceTexture(found - found.mean(dim=(2, 3), keepdim=True), 0.5)


def views(count: int = 2) -> tuple[torch.Tensor, LaidTexture, torch.Tensor, torch.Tensor]:
    """Smooth views whose right half is invented, texture for them, their depth, and what is invented."""
    generator = torch.Generator().manual_seed(1)
    rgb = 0.4 + 0.1 * torch.rand(count, 3, HEIGHT, WIDTH, generator=generator)
    share = torch.zeros(count, 1, HEIGHT, WIDTH)
    share[..., WIDTH // 2 :] = 1
    change = 0.1 * torch.randn(count, 3, HEIGHT, WIDTH, generator=generator) * share
    laid = LaidTexture(change, share, torch.full_like(share, 0.8), torch.full_like(share, 1.2))
    return rgb, laid, torch.full_like(share, 20.0), share


def untrained(seed: int = 0, *, scrambled: bool = False) -> Refiner:
    generator = torch.Generator().manual_seed(seed)
    network = build_network(REFINER_CHANNELS, (8, 8, 16), generator)
    if scrambled:
        torch.nn.init.normal_(network.exit.weight, std=0.05, generator=generator)
    return Refiner(network.eval(), {})


class TestRefiner:
    def test_untrained_it_shows_the_laid_texture(self) -> None:
        rgb, laid, depth, unconfirmed = views()
        found = untrained().refined(rgb, laid, depth, unconfirmed)
        # Noise of deviation 0.1 has small means over wide areas, which are taken out.
        torch.testing.assert_close(found, (rgb + laid.change).clamp(0, 1), atol=0.03, rtol=0)

    def test_what_is_known_keeps_its_bits(self) -> None:
        rgb, laid, depth, unconfirmed = views()
        found = untrained(scrambled=True).refined(rgb, laid, depth, unconfirmed)
        assert torch.equal(found[..., : WIDTH // 2], rgb[..., : WIDTH // 2])
        assert float((found - rgb - laid.change)[..., WIDTH // 2 :].abs().mean()) > 1e-3

    def test_views_do_not_depend_on_each_other(self) -> None:
        rgb, laid, depth, unconfirmed = views(3)
        refiner = untrained(scrambled=True)
        found = refiner.refined(rgb, laid, depth, unconfirmed)
        alone = LaidTexture(laid.change[1:2], laid.share[1:2], laid.facing[1:2], laid.texels[1:2])
        single = refiner.refined(rgb[1:2], alone, depth[1:2], unconfirmed[1:2])
        assert torch.equal(found[1:2], single)

    def test_units_do_not_count(self) -> None:
        """Depth is told relative to that of the view, a pixel's width in texels."""
        rgb, laid, depth, unconfirmed = views()
        refiner = untrained(scrambled=True)
        found = refiner.refined(rgb, laid, depth, unconfirmed)
        torch.testing.assert_close(refiner.refined(rgb, laid, 1e3 * depth, unconfirmed), found)

    def test_a_shift_of_colour_is_taken_out(self) -> None:
        """Means over wide areas are the restorer's."""
        rgb, laid, depth, unconfirmed = views()
        shifting = untrained()
        torch.nn.init.constant_(shifting.network.exit.bias, -0.3)
        expected = untrained().refined(rgb, laid, depth, unconfirmed)
        found = shifting.refined(rgb, laid, depth, unconfirmed)
        torch.testing.assert_close(found, expected, atol=2e-3, rtol=0)

    def test_tiles_join_without_a_seam(self, monkeypatch: pytest.MonkeyPatch) -> None:
        """A network that only darkens what is invented does so evenly, whatever the tiles."""
        monkeypatch.setattr(refiner_module, "_with_coarse_colors", lambda refined, *_given: refined)
        rgb, laid, depth, unconfirmed = views()
        refiner = untrained()
        torch.nn.init.constant_(refiner.network.exit.bias, -0.3)
        whole = refiner.refined(rgb, laid, depth, unconfirmed)
        monkeypatch.setattr(refiner_module, "LARGEST_TILE_PX", 32)
        monkeypatch.setattr(refiner_module, "TILE_OVERLAP_PX", 8)
        looked: list[tuple[int, ...]] = []
        true_tile = Refiner._refined_tile

        def watched(self: Refiner, maps: torch.Tensor) -> torch.Tensor:
            looked.append(tuple(maps.shape[-2:]))
            return true_tile(self, maps)

        monkeypatch.setattr(Refiner, "_refined_tile", watched)
        tiled = refiner.refined(rgb, laid, depth, unconfirmed)
        torch.testing.assert_close(tiled, whole)
        assert len(looked) > 8
        assert max(max(size) for size in looked) <= 32
        assert torch.equal(tiled[..., : WIDTH // 2], rgb[..., : WIDTH // 2])

    def test_tiles_agree_on_depth(self, monkeypatch: pytest.MonkeyPatch) -> None:
        """A pixel's relative depth is the same in all tiles that show it."""
        rgb, laid, _, _ = views(1)
        everywhere = torch.ones_like(laid.share)
        laid = replace(laid, share=everywhere)
        depth = 10 + torch.arange(WIDTH).float().expand(1, 1, HEIGHT, WIDTH)
        monkeypatch.setattr(refiner_module, "LARGEST_TILE_PX", 32)
        monkeypatch.setattr(refiner_module, "TILE_OVERLAP_PX", 8)
        shown: list[torch.Tensor] = []
        true_tile = Refiner._refined_tile

        def watched(self: Refiner, maps: torch.Tensor) -> torch.Tensor:
            shown.append(maps[:, 9])
            return true_tile(self, maps)

        monkeypatch.setattr(Refiner, "_refined_tile", watched)
        untrained().refined(rgb, laid, depth, everywhere)
        assert min(float(tile.min()) for tile in shown) == pytest.approx(10 / 47, rel=1e-5)
        assert max(float(tile.max()) for tile in shown) == pytest.approx(85 / 47, rel=1e-5)

    @pytest.mark.parametrize("length", [1, 384, 385, 640, 1350, 1920])
    def test_tiles_cover_every_pixel(self, length: int) -> None:
        spans = refiner_module._spans(length)
        assert spans[0][0] == 0
        assert spans[-1][1] == length
        assert max(end - start for start, end in spans) <= refiner_module.LARGEST_TILE_PX
        overlaps = [end - start for (_, end), (start, _) in pairwise(spans)]
        assert all(overlap >= refiner_module.TILE_OVERLAP_PX - 1 for overlap in overlaps)

    def test_saved_and_loaded(self, tmp_path: Path) -> None:
        rgb, laid, depth, unconfirmed = views()
        refiner = untrained(scrambled=True)
        refiner.save(tmp_path)
        loaded = Refiner.load(tmp_path)
        # Weights are stored in half precision.
        torch.testing.assert_close(
            loaded.refined(rgb, laid, depth, unconfirmed),
            refiner.refined(rgb, laid, depth, unconfirmed),
            atol=2e-3,
            rtol=0,
        )

    @pytest.mark.parametrize("damage", ["no weights", "half of the weights", "another format"])
    def test_damage_is_named(self, tmp_path: Path, damage: str) -> None:
        untrained().save(tmp_path)
        weights, description = tmp_path / "refiner.safetensors", tmp_path / "restorer.json"
        if damage == "no weights":
            weights.unlink()
        elif damage == "half of the weights":
            weights.write_bytes(weights.read_bytes()[: weights.stat().st_size // 2])
        else:
            description.write_text(description.read_text().replace('"format": 1', '"format": 7'))
        with pytest.raises(WeightsError, match="refiner"):
            Refiner.load(tmp_path)

    def test_the_bundled_one_is_whole(self) -> None:
        assert bundled_refiner().record["iterations_made"] > 1000
        assert len(refiner_digest()) == 32


class TestTexturedViews:
    def test_without_a_refiner_texture_is_laid(self) -> None:
        rgb, _, depth, unconfirmed = views()
        cameras = small_scene(0).cameras
        size = (cameras.height, cameras.width)
        rgb, depth, unconfirmed = (
            torch.nn.functional.interpolate(one, size) for one in (rgb, depth, unconfirmed)
        )
        expected = tiles().applied(rgb, cameras, depth[:, 0], unconfirmed[:, 0])
        assert torch.equal(textured_views(tiles(), None, rgb, cameras, depth, unconfirmed), expected)
        refined = textured_views(tiles(), untrained(scrambled=True), rgb, cameras, depth, unconfirmed)
        assert not torch.equal(refined, expected)


@pytest.fixture(scope="module")
def examples() -> RefinementExamples:
    scene = replace(small_scene(0), texture=tiles())
    restorer = EmbeddedEnhancer.load(starting_weights(COLONS))
    return RefinementExamples.of_scene(scene, replace(restorer, steps=1))


class TestExamples:
    def test_each_placement_is_another_texture_at_the_same_places(self, examples: RefinementExamples) -> None:
        first, second = examples.changes
        invented = examples.maps[:, 0:1].expand_as(first) > 0.05
        assert not bool((first[~(examples.maps[:, 0:1].expand_as(first) > 0)] != 0).any())
        assert float((first != second)[invented].float().mean()) > 0.9

    def test_a_scene_without_texture_is_refused(self) -> None:
        restorer = EmbeddedEnhancer.load(starting_weights(COLONS))
        with pytest.raises(CaptureError, match="gives texture"):
            RefinementExamples.of_scene(small_scene(0), restorer)

    def test_saved_and_loaded(self, examples: RefinementExamples, tmp_path: Path) -> None:
        file = tmp_path / "a.safetensors"
        examples.save(file)
        found = RefinementExamples.load(file)
        assert torch.equal(found.changes, examples.changes)
        assert torch.equal(found.target, examples.target)
        file.write_bytes(b"no examples")
        with pytest.raises(WeightsError, match=r"a\.safetensors"):
            RefinementExamples.load(file)

    def test_crops_of_a_seed_are_the_same(self, examples: RefinementExamples) -> None:
        first, same = ExampleCrops(examples, 64, 3), ExampleCrops(examples, 64, 3)
        other = ExampleCrops(examples, 64, 4)
        drawn = [crops.draw() for crops in (first, same, other)]
        assert drawn[0].shape == (1, 15, 64, 64)
        assert torch.equal(drawn[0], drawn[1])
        assert not torch.equal(drawn[0], drawn[2])

    def test_crops_much_larger_than_the_views(self, examples: RefinementExamples) -> None:
        assert ExampleCrops(examples, 128, 0).draw().shape == (1, 15, 128, 128)

    def test_a_restorer_that_draws_gives_its_mean(self) -> None:
        """The views to refine are smooth ones."""
        scene = replace(small_scene(0), texture=tiles())
        restorer = EmbeddedEnhancer.load(starting_weights(COLONS))
        network = restorer.network.widened(CONDITION_CHANNELS + INVENTED_CHANNELS)
        torch.nn.init.ones_(network.drawing.weight)
        drawing = replace(restorer, network=network, steps=1, drawing=True, half_precision=False)
        mean = RefinementExamples.of_scene(scene, replace(drawing, drawing=False))
        assert torch.equal(RefinementExamples.of_scene(scene, drawing).rgb, mean.rgb)

    def test_an_enlarged_crop_shows_less_of_the_surface(self, examples: RefinementExamples) -> None:
        """Views of 40 pixels are enlarged for crops of 64."""
        texels = ExampleCrops(examples, 64, 0).draw()[:, 10]
        assert float(texels.max()) <= 40 / 64 * float(examples.maps[:, 4].max()) + 1e-3


class TestTraining:
    @pytest.fixture
    def files(self, tmp_path: Path) -> list[Path]:
        """Scenes that are brighter where the surface faces the lens, which the smooth views do not show."""
        found = []
        for seed in range(3):
            generator = torch.Generator().manual_seed(seed)
            rgb = 0.5 + 0.1 * torch.rand(2, 3, 64, 64, generator=generator)
            share = torch.zeros(2, 1, 64, 64)
            share[..., 32:] = 1
            stripes = ((torch.arange(64) // 4) % 2).float().expand(2, 1, 64, 64)
            ones = torch.ones_like(share)
            examples = RefinementExamples(
                rgb.half(),
                (0.02 * torch.randn(2, 2, 3, 64, 64, generator=generator) * share).half(),
                torch.cat([share, share, ones, stripes, ones], dim=1).half(),
                (rgb + 0.3 * share * (stripes - 0.5)).half(),
                torch.ones(2, 1, 64, 64).half(),
            )
            file = tmp_path / f"{seed}.safetensors"
            examples.save(file)
            found.append(file)
        return found

    @pytest.fixture(autouse=True)
    def random_perception(self, monkeypatch: pytest.MonkeyPatch) -> Lpips:
        lpips = Lpips("alex", random_weights("alex"))
        monkeypatch.setattr(training_module.Lpips, "load", lambda **_given: lpips)
        monkeypatch.setattr(training_module, "REFINER_WIDTHS", (8, 8, 16))
        return lpips

    def config(self, iterations: int, **changes: float) -> RefinerConfig:
        return RefinerConfig(
            scenes=3,
            validation_scenes=1,
            iterations=iterations,
            batch=2,
            crop=64,
            learning_rate=5e-3,
            **changes,
        )

    def test_it_learns(self, files: list[Path], random_perception: Lpips) -> None:
        # Random perception would lead elsewhere.
        settings = {"perceptual_weight": 0.01, "adversarial_weight": 0.0, "pixel_weight": 1.0}
        trained = train_refiner(files, self.config(20, **settings))
        scores = trained.record["validation_scores"]
        assert scores["refined"]["psnr"] > scores["textured"]["psnr"] + 2
        assert set(scores) == {"smooth", "textured", "refined"}
        again = refiner_scores(trained, files[-1:], random_perception)
        assert again == scores

    def test_where_nothing_is_invented_there_is_no_score(
        self, files: list[Path], random_perception: Lpips, tmp_path: Path
    ) -> None:
        examples = RefinementExamples.load(files[-1])
        maps = examples.maps.clone()
        maps[:, 0] = 0
        replace(examples, maps=maps).save(tmp_path / "known")
        refiner = train_refiner(files, self.config(1, adversarial_weight=0.0))
        scores = refiner_scores(refiner, [tmp_path / "known"], random_perception)
        assert set(scores) == {"smooth", "textured", "refined"}
        assert all(value is None for figures in scores.values() for value in figures.values())

    def test_the_adversary_is_told_of_in_every_report(self, files: list[Path]) -> None:
        """It judges every other step, and reports are made in the other ones."""
        history = train_refiner(files, self.config(20)).record["history"]
        assert [sorted(entry) for entry in history] == [
            ["adversary", "drawn_loss", "drawn_perceptual", "iteration"]
        ] * 2

    def test_no_limit_of_time_is_valid_json(self) -> None:
        assert json.loads(json.dumps(self.config(1).model_dump(mode="json"), allow_nan=False))

    def test_a_seed_is_a_refiner(self, files: list[Path]) -> None:
        first, same = (train_refiner(files, self.config(3)).network.state_dict() for _ in range(2))
        assert all(torch.equal(value, same[name]) for name, value in first.items())

    def test_a_training_without_scenes_is_refused(self, files: list[Path]) -> None:
        with pytest.raises(ConfigError, match="1 scenes give texture"):
            train_refiner(files[:1], self.config(3))


def test_batches_move_whole() -> None:
    batch = RefinerBatch.of_crops(torch.rand(2, 15, 64, 64))
    moved = batch.to(torch.device("cpu"))
    assert torch.equal(moved.laid.change, batch.laid.change)
    assert torch.equal(moved.conditioning.base, batch.conditioning.base)
