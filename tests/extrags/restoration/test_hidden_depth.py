"""Practice in reading hidden depth: what it is shown, what it is judged by, and that it learns."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import pytest
import torch

from extrags.config import PipelineConfig, profile_config
from extrags.depth.completion import SEEN, STEREO
from extrags.depth.hidden import SOLID
from extrags.depth.weights import load_completion
from extrags.errors import CaptureError, ConfigError, DivergedError, WeightsError
from extrags.restoration.diffusion.embedded import EmbeddedEnhancer
from extrags.restoration.diffusion.weights import COLONS, starting_weights
from extrags.restoration.hidden_depth import training as training_module
from extrags.restoration.hidden_depth.examples import HiddenDepthExamples
from extrags.restoration.hidden_depth.training import (
    HiddenDepthConfig,
    hidden_depth_loss,
    hidden_depth_scores,
    train_hidden_depth,
)
from extrags.thresholds import HOLE_ALPHA
from tests.extrags.lit_tube import Tube, tube_recording

HEIGHT, WIDTH = 48, 64


def settings() -> PipelineConfig:
    quick = profile_config("quick")
    explore = quick.explore.model_copy(update={"trajectories": 2, "steps": 3, "render_width": 32})
    coarse = quick.coarse.model_copy(update={"max_points": 800})
    return quick.model_copy(update={"explore": explore, "coarse": coarse})


def restorer() -> EmbeddedEnhancer:
    found = EmbeddedEnhancer.load(starting_weights(COLONS))
    return replace(found, steps=1, half_precision=False)


@pytest.fixture(scope="module")
def examples(tube: Tube) -> HiddenDepthExamples:
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("extrags.restoration.training_data.degradation.ITERATIONS", (150, 200))
        patch.setattr("extrags.restoration.training_data.degradation._FLAWS", {"exact": 1.0})
        patch.setattr("extrags.restoration.training_data.degradation._EXACT_POSES", 1.0)
        return HiddenDepthExamples.of_recording(tube_recording(tube), restorer(), settings(), 3)


def half_hidden(seed: int = 0, views: int = 4) -> HiddenDepthExamples:
    """Walls that fall back on the right, where nothing is known, and are the darker the farther they are."""
    generator = torch.Generator().manual_seed(seed)
    slope = 0.5 + torch.rand(views, 1, 1, generator=generator)
    across = torch.linspace(-1, 1, WIDTH).expand(views, HEIGHT, WIDTH)
    depth_mm = 20 * (slope * across.clamp_min(0)).exp()
    opacity = (across < 0).float()
    rgb = (0.8 * (20 / depth_mm) ** 2)[:, None] * torch.tensor([0.9, 0.6, 0.5])[:, None, None]
    K = torch.tensor([[50.0, 0, WIDTH / 2], [0, 50.0, HEIGHT / 2], [0, 0, 1]]).expand(views, 3, 3)
    filled_mm = torch.where(opacity > 0, depth_mm, torch.tensor(20.0))
    clip = torch.zeros(views, dtype=torch.long)
    return HiddenDepthExamples(rgb.half(), filled_mm, opacity.half(), depth_mm, K.clone(), clip)


@pytest.fixture(scope="module")
def files(tmp_path_factory: pytest.TempPathFactory) -> list[Path]:
    folder = tmp_path_factory.mktemp("hidden_depth")
    paths = [folder / f"{number}.safetensors" for number in range(3)]
    for number, path in enumerate(paths):
        half_hidden(number).save(path)
    return paths


class TestExamples:
    def test_explored_views_come_with_their_true_depth(self, examples: HiddenDepthExamples) -> None:
        count = len(examples.clip)
        assert count >= 2
        assert examples.rgb.shape == (count, 3, HEIGHT, WIDTH)
        assert float(examples.rgb.min()) >= 0
        assert float(examples.rgb.max()) <= 1
        assert bool((examples.opacity < HOLE_ALPHA).any())
        # The tube ends at 80 mm.
        assert 0 < float(examples.depth_mm.min()) < float(examples.depth_mm.max()) <= 80
        assert examples.clip.tolist() == sorted(examples.clip.tolist())
        solid = examples.opacity > 0.98
        off = (examples.filled_mm / examples.depth_mm).log().abs()[solid]
        assert float(off.median()) < 0.1

    def test_stored_and_read(self, examples: HiddenDepthExamples, tmp_path: Path) -> None:
        path = tmp_path / "views.safetensors"
        examples.save(path, origin="the tube")
        found = HiddenDepthExamples.load(path)
        for name in examples.__dataclass_fields__:
            assert torch.equal(getattr(found, name), getattr(examples, name)), name
        path.write_bytes(b"nothing")
        with pytest.raises(WeightsError, match=r"views\.safetensors"):
            HiddenDepthExamples.load(path)

    def test_where_nothing_can_be_explored_there_are_none(
        self, tube: Tube, monkeypatch: pytest.MonkeyPatch
    ) -> None:
        monkeypatch.setattr("extrags.restoration.training_data.degradation.ITERATIONS", (10, 20))
        module = "extrags.restoration.training_data.explored_views.explore"
        monkeypatch.setattr(module, lambda *_given, **_named: type("Nothing", (), {"trajectories": ()}))
        with pytest.raises(CaptureError, match="nothing to explore"):
            HiddenDepthExamples.of_recording(tube_recording(tube), restorer(), settings(), 3)

    def test_the_network_is_shown_what_it_reads_in_use(self) -> None:
        views = half_hidden()
        found = views.at_size(160)
        assert found is not None
        assert torch.equal(found.channels[:, SEEN] > 0, views.opacity > SOLID)
        # Both are relative to the median of what is known.
        off = found.channels[:, STEREO].float() - found.truth.float()
        torch.testing.assert_close(off, (views.filled_mm / views.depth_mm).log(), atol=2e-3, rtol=0)

    def test_smaller_images_show_the_same(self) -> None:
        full, small = half_hidden().at_size(64), half_hidden().at_size(32)
        assert full is not None
        assert small is not None
        assert small.truth.shape == (4, 24, 32)
        block = torch.nn.functional.avg_pool2d(full.truth.float(), 2)
        torch.testing.assert_close(small.truth.float(), block, atol=5e-3, rtol=0)

    def test_views_that_teach_nothing_are_left_out(self) -> None:
        views = half_hidden()
        views.opacity[0] = 1
        views.opacity[1] = 0
        # Beside this hole, depth is wrong by factors.
        views.filled_mm[2, ::2] *= 4
        found = views.at_size(160)
        assert found is not None
        assert len(found.truth) == 1
        assert half_hidden(views=1).at_size(160) is not None
        views.opacity[:] = 1
        assert views.at_size(160) is None


class TestLoss:
    def test_another_scale_is_no_error(self) -> None:
        found = half_hidden().at_size(160)
        assert found is not None
        channels, truth, known = (part.float() for part in (found.channels, found.truth, found.known))
        terms = hidden_depth_loss(channels, truth + 0.3, torch.zeros_like(truth), truth, known)
        assert float(terms["depth"]) == pytest.approx(0, abs=1e-5)
        assert float(terms["slope"]) == pytest.approx(0, abs=1e-5)

    def test_it_is_the_hole_that_counts(self) -> None:
        found = half_hidden().at_size(160)
        assert found is not None
        channels, truth, known = (part.float() for part in (found.channels, found.truth, found.known))
        hole = channels[:, SEEN] == 0
        wrong = truth + 0.2 * hole
        terms = hidden_depth_loss(channels, wrong, torch.zeros_like(truth), truth, known)
        # Half of the pixels are known, are right, and hardly count.
        assert float(terms["depth"]) == pytest.approx(0.2 / 1.05, rel=0.02)


class TestTraining:
    def test_it_learns_that_darkness_is_distance(
        self, files: list[Path], monkeypatch: pytest.MonkeyPatch
    ) -> None:
        monkeypatch.setattr(training_module, "LONGEST_SIDES_PX", (32,))
        start = load_completion("bundled")
        assert start is not None
        before = {name: value.clone() for name, value in start.state_dict().items()}
        config = HiddenDepthConfig(scenes=3, validation_scenes=1, iterations=20, batch=4, learning_rate=2e-3)
        network, record = train_hidden_depth(files, config, start)
        assert all(torch.equal(value, before[name]) for name, value in start.state_dict().items())
        assert not torch.equal(network.entrance.weight, start.entrance.weight)
        scores = record["validation_scores"]
        assert set(scores) == {"smooth", "before", "trained"}
        assert scores["trained"]["error"] < scores["before"]["error"] < scores["smooth"]["error"]
        # Smooth filling stays near where the wall falls back.
        assert scores["smooth"]["bias"] == pytest.approx(-scores["smooth"]["error"])
        assert record["examples"] == 8

    def test_weights_that_are_not_finite_end_it(
        self, files: list[Path], monkeypatch: pytest.MonkeyPatch
    ) -> None:
        """Fewer steps than those after which the loss is looked at."""

        def infinite(*given: torch.Tensor) -> dict[str, torch.Tensor]:
            return {name: value * float("inf") for name, value in hidden_depth_loss(*given).items()}

        monkeypatch.setattr(training_module, "LONGEST_SIDES_PX", (32,))
        monkeypatch.setattr(training_module, "hidden_depth_loss", infinite)
        start = load_completion("bundled")
        assert start is not None
        config = HiddenDepthConfig(scenes=3, validation_scenes=1, iterations=2, batch=2)
        with pytest.raises(DivergedError, match="is not finite at the end"):
            train_hidden_depth(files, config, start)

    def test_scenes_have_to_be_left(self, files: list[Path], tmp_path: Path) -> None:
        start = load_completion("bundled")
        assert start is not None
        with pytest.raises(ConfigError, match="3 scenes could be explored, and 3 are for validation"):
            train_hidden_depth(files, HiddenDepthConfig(validation_scenes=3), start)
        solid = half_hidden()
        solid.opacity[:] = 1
        solid.save(tmp_path / "solid.safetensors")
        with pytest.raises(ConfigError, match="none of 1 scenes has a hole"):
            train_hidden_depth(
                [tmp_path / "solid.safetensors", files[0]], HiddenDepthConfig(validation_scenes=1), start
            )

    def test_scores_are_of_holes_alone(self, files: list[Path]) -> None:
        scores = hidden_depth_scores({}, files[:1])
        views = half_hidden()
        off = (views.depth_mm / views.filled_mm).log()
        holes = views.opacity < HOLE_ALPHA
        expected = float(torch.stack([off[view][holes[view]].mean() for view in range(4)]).mean())
        assert scores == {
            "smooth": {"error": pytest.approx(expected, abs=1e-4), "bias": -scores["smooth"]["error"]}
        }
