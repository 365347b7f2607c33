from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import replace
from functools import partial
from multiprocessing import current_process
from pathlib import Path
from queue import Queue
from typing import Any

import numpy as np
import pytest
import torch

from extrags.array_files import load_safetensors, save_safetensors
from extrags.config import CoarseConfig, profile_config
from extrags.errors import CaptureError, ConfigError, DivergedError, WeightsError
from extrags.restoration.diffusion.embedded import EmbeddedEnhancer
from extrags.restoration.diffusion.frame_features import frame_features
from extrags.restoration.diffusion.network import build_network
from extrags.restoration.diffusion.network_training import NetworkTraining
from extrags.restoration.diffusion.pretraining import (
    PretrainingConfig,
    _mixed_sampler,
    check_sizes,
    pretrain,
)
from extrags.restoration.training_data import parallel
from extrags.restoration.training_data.augmentation import Batch
from extrags.restoration.training_data.parallel import drawn_in_processes
from extrags.restoration.training_data.pretraining_scenes import (
    PRETRAINING_DATA_VERSION,
    PretrainingScene,
    make_pretraining_scene,
)
from extrags.view_synthesis.conditioning import CONDITION_CHANNELS, INVENTED_CHANNELS, Layers
from extrags.view_synthesis.gamut import Gamut
from extrags.view_synthesis.references import LightTransfer
from tests.extrags.lit_tube import Tube, tube_depth_mm, tube_picture, tube_recording
from tests.extrags.restoration.conftest import SMALL

QUICK = profile_config("quick")
RUN = QUICK.model_copy(
    update={
        "enhance": SMALL,
        "coarse": CoarseConfig(max_points=800),
        "explore": QUICK.explore.model_copy(update={"trajectories": 2, "steps": 5, "render_width": 32}),
    }
)
TINY = PretrainingConfig(
    scenes=3,
    validation_scenes=1,
    iterations=12,
    batch=3,
    crop=32,
    channels=(8, 16, 16),
    learning_rate=2e-3,
    perceptual=False,
)


@pytest.fixture(scope="module")
def scene(tube: Tube) -> PretrainingScene:
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("extrags.restoration.training_data.degradation.ITERATIONS", (10, 20))
        patch.setattr("extrags.restoration.training_data.degradation._WITH_LIGHT", 1.0)
        return make_pretraining_scene(tube_recording(tube), RUN, 3)


@pytest.fixture(scope="module")
def explored(tube: Tube) -> PretrainingScene:
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("extrags.restoration.training_data.degradation.ITERATIONS", (150, 200))
        patch.setattr("extrags.restoration.training_data.degradation._EXACT_POSES", 1.0)
        return make_pretraining_scene(tube_recording(tube), RUN, 3, explored=True)


@pytest.fixture(scope="module")
def files(scene: PretrainingScene, tmp_path_factory: pytest.TempPathFactory) -> list[Path]:
    folder = tmp_path_factory.mktemp("pretraining")
    paths = [folder / f"{index:04d}.safetensors" for index in range(3)]
    for path in paths:
        scene.save(path)
    return paths


class TestPretrainingScene:
    def test_pairs_are_the_views_off_the_path(self, tube: Tube, scene: PretrainingScene) -> None:
        assert scene.pairs.frame.tolist() == tube.sequence.test.tolist()
        assert not scene.pairs.validation.any()
        truth = torch.from_numpy(tube.sequence.rgb[tube.sequence.test].astype(np.float32) / 255)
        torch.testing.assert_close(scene.pairs.target, truth.permute(0, 3, 1, 2))
        assert scene.transfer.light is not None

    def test_saved_and_loaded_it_is_the_same_to_half_precision(
        self, scene: PretrainingScene, files: list[Path]
    ) -> None:
        loaded = PretrainingScene.load(files[0])
        torch.testing.assert_close(loaded.pairs.layers.data, scene.pairs.layers.data, rtol=1e-3, atol=1e-3)
        torch.testing.assert_close(loaded.pairs.target, scene.pairs.target, rtol=0, atol=1e-6)
        torch.testing.assert_close(loaded.pairs.depth_mm, scene.pairs.depth_mm, rtol=1e-3, atol=1e-3)
        assert loaded.transfer.scale_mm == scene.transfer.scale_mm
        np.testing.assert_array_equal(loaded.clip, scene.clip)
        np.testing.assert_array_equal(loaded.cameras.world_from_camera, scene.cameras.world_from_camera)
        np.testing.assert_array_equal(loaded.cameras.K, scene.cameras.K)
        np.testing.assert_array_equal(loaded.references.rgb, scene.references.rgb)
        np.testing.assert_array_equal(loaded.references.cameras.K, scene.references.cameras.K)
        assert (loaded.cameras.width, loaded.cameras.height) == (scene.cameras.width, scene.cameras.height)
        light, kept = loaded.transfer.light, scene.transfer.light
        assert light is not None
        assert kept is not None
        assert all(torch.equal(light.parameters()[k], v) for k, v in kept.parameters().items())

    def test_a_scene_without_light_keeps_its_exponent(self, scene: PretrainingScene, tmp_path: Path) -> None:
        replace(scene, transfer=LightTransfer(None, 0.7, 12.0)).save(tmp_path / "dark.safetensors")
        assert PretrainingScene.load(tmp_path / "dark.safetensors").transfer == LightTransfer(None, 0.7, 12.0)

    def test_explored_views_are_clips_of_their_own_and_photographed(
        self, tube: Tube, explored: PretrainingScene
    ) -> None:
        off_the_path = len(tube.sequence.test)
        assert set(explored.clip[:off_the_path]) == {0}
        assert explored.clip[off_the_path:].tolist() == [1, 1, 1, 2, 2, 2]
        pairs = explored.pairs
        np.testing.assert_array_equal(pairs.frame, 10 + np.arange(len(pairs)))
        for view in range(off_the_path, len(pairs)):
            camera = explored.cameras[view]
            shown = torch.from_numpy(tube_picture(camera)).permute(2, 0, 1) / 255
            torch.testing.assert_close(pairs.target[view], shown)
            depth_mm = torch.from_numpy(tube_depth_mm(camera)).float()
            torch.testing.assert_close(pairs.depth_mm[view, 0], depth_mm)
        moved = np.abs(np.diff(explored.cameras.world_from_camera[off_the_path:], axis=0))
        assert (moved.max(axis=(1, 2)) > 0.01).all()

    def test_where_nothing_can_be_explored_the_clips_remain(
        self, tube: Tube, scene: PretrainingScene, monkeypatch: pytest.MonkeyPatch
    ) -> None:
        monkeypatch.setattr("extrags.restoration.training_data.degradation.ITERATIONS", (10, 20))
        monkeypatch.setattr("extrags.restoration.training_data.degradation._WITH_LIGHT", 1.0)
        module = "extrags.restoration.training_data.explored_views"
        monkeypatch.setattr(
            f"{module}.explore", lambda *_given, **_named: type("Nothing", (), {"trajectories": ()})
        )
        found = make_pretraining_scene(tube_recording(tube), RUN, 3, explored=True)
        assert torch.equal(found.pairs.layers.data, scene.pairs.layers.data)

        def too_poor(*_given: object, **_named: object) -> None:
            raise CaptureError("the fused depth of 10 views holds no surface")

        for step in ("fuse_surface", "carve"):
            with monkeypatch.context() as patch:
                patch.setattr(f"{module}.{step}", too_poor)
                found = make_pretraining_scene(tube_recording(tube), RUN, 3, explored=True)
            assert torch.equal(found.pairs.layers.data, scene.pairs.layers.data)

    def test_training_frames_are_kept_as_references(self, tube: Tube, scene: PretrainingScene) -> None:
        train = tube.sequence.train
        assert len(train) < 24
        np.testing.assert_array_equal(scene.references.rgb, tube.sequence.rgb[train])
        assert len(scene.references.cameras) == len(train)
        assert scene.cameras.centers.tolist() == tube.sequence.cameras.centers[tube.sequence.test].tolist()

    def test_an_exact_scene_keeps_the_poses_of_its_recording(
        self, tube: Tube, monkeypatch: pytest.MonkeyPatch
    ) -> None:
        monkeypatch.setattr("extrags.restoration.training_data.degradation.ITERATIONS", (10, 20))
        monkeypatch.setattr("extrags.restoration.training_data.degradation._EXACT_POSES", 0.0)
        exact = tube.sequence.cameras[tube.sequence.train].world_from_camera
        for share in (0.0, 1.0):
            made = make_pretraining_scene(tube_recording(tube), RUN, 3, exact_share=share)
            assert np.array_equal(made.references.cameras.world_from_camera, exact) == bool(share)

    def test_files_of_another_version_are_refused(
        self, scene: PretrainingScene, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
    ) -> None:
        module = "extrags.restoration.training_data.pretraining_scenes.PRETRAINING_DATA_VERSION"
        monkeypatch.setattr(module, 1)
        scene.save(tmp_path / "old.safetensors")
        monkeypatch.undo()
        expected = rf"old\.safetensors: .* version 1, expected {PRETRAINING_DATA_VERSION};"
        with pytest.raises(WeightsError, match=expected):
            PretrainingScene.load(tmp_path / "old.safetensors")

    def test_a_foreign_file_is_named(self, tmp_path: Path) -> None:
        (tmp_path / "x.safetensors").write_bytes(b"nothing")
        with pytest.raises(WeightsError, match=r"x\.safetensors: not the pairs"):
            PretrainingScene.load(tmp_path / "x.safetensors")


class TestPretraining:
    def test_it_learns_and_says_how_well(self, files: list[Path], tmp_path: Path) -> None:
        enhancer = pretrain(files, TINY.model_copy(update={"iterations": 30}))
        scores = enhancer.record["validation_scores"]
        assert scores["embedded_1"]["psnr"] > scores["none"]["psnr"]
        enhancer.save(tmp_path, half=True)
        loaded = EmbeddedEnhancer.load(tmp_path / "restorer.safetensors")
        assert loaded.record["pretraining"]["iterations"] == 30
        # What others than Python read as well: infinity is no number of JSON.
        json.loads((tmp_path / "restorer.json").read_text(), parse_constant=pytest.fail)
        for one, two in zip(
            loaded.network.state_dict().values(), enhancer.network.state_dict().values(), strict=True
        ):
            torch.testing.assert_close(one, two, rtol=2e-3, atol=1e-4)

    def test_twice_gives_the_same_bits(self, files: list[Path]) -> None:
        first, second = (pretrain(files, TINY).network.state_dict() for _ in range(2))
        assert all(torch.equal(first[name], second[name]) for name in first)

    def test_a_perceptual_distance_changes_what_is_learned(
        self, files: list[Path], shared_data: Path
    ) -> None:
        plain, seen = (
            pretrain(files, TINY.model_copy(update={"perceptual": perceptual, "iterations": 2}))
            for perceptual in (False, True)
        )
        assert not torch.equal(plain.network.exit.weight, seen.network.exit.weight)

    def test_the_number_of_scenes_is_checked(self, files: list[Path]) -> None:
        with pytest.raises(ConfigError, match="2 pretraining scenes found, settings say 3"):
            pretrain(files[:2], TINY)

    @pytest.mark.slow  # Each of them imports torch.
    def test_processes_draw_batches_in_turn(self, files: list[Path]) -> None:
        config = TINY.model_copy(update={"drawing_processes": 2})
        make = partial(_mixed_sampler, files[:2], config, 0)
        own = [make(number, 2) for number in range(2)]
        with drawn_in_processes(make, 2) as draw:
            for index in range(4):
                drawn, expected = draw(), own[index % 2]()
                assert torch.equal(drawn.clean, expected.clean)
                assert torch.equal(drawn.conditioning.channels, expected.conditioning.channels)

    def test_it_ends_in_time_and_goes_on_from_its_checkpoint(self, files: list[Path], tmp_path: Path) -> None:
        checkpoint = tmp_path / "checkpoint.safetensors"
        short = TINY.model_copy(update={"most_seconds": 1e-3})
        assert pretrain(files, short, checkpoint=checkpoint).record["iterations_made"] == 1
        assert pretrain(files, short, checkpoint=checkpoint).record["iterations_made"] == 2
        other = short.model_copy(update={"channels": (16, 16, 16)})
        with pytest.raises(WeightsError, match=r"checkpoint\.safetensors: not a checkpoint of this training"):
            pretrain(files, other, checkpoint=checkpoint)

    @pytest.mark.parametrize(
        ("changes", "told"),
        [
            ({"learning_rate": 1e-3}, r"learning_rate was .* and is 0\.001"),
            ({"drawn_share": 0.2, "seed": 7}, r"drawn_share was 0\.7 and is 0\.2, seed was 0 and is 7"),
        ],
    )
    def test_it_does_not_go_on_with_other_settings(
        self, files: list[Path], tmp_path: Path, changes: dict[str, float], told: str
    ) -> None:
        checkpoint = tmp_path / "checkpoint.safetensors"
        short = TINY.model_copy(update={"most_seconds": 1e-3})
        pretrain(files, short, checkpoint=checkpoint)
        with pytest.raises(WeightsError, match=rf"its settings are others: {told}\); give the same"):
            pretrain(files, short.model_copy(update=changes), checkpoint=checkpoint)

    def test_checkpoints_of_an_earlier_version_tell_no_settings(
        self, files: list[Path], tmp_path: Path
    ) -> None:
        checkpoint = tmp_path / "checkpoint.safetensors"
        short = TINY.model_copy(update={"most_seconds": 1e-3})
        pretrain(files, short, checkpoint=checkpoint)
        state = load_safetensors(checkpoint)
        del state["settings"], state["beginning"]
        save_safetensors(checkpoint, state)
        other = short.model_copy(update={"learning_rate": 1e-3})
        record = pretrain(files, other, checkpoint=checkpoint, about={"command": "second"}).record
        assert record["iterations_made"] == 2
        assert (record["before"], record["command"]) == ("unknown", "unknown")
        # It stays unknown.
        record = pretrain(files, other, checkpoint=checkpoint, about={"command": "third"}).record
        assert record["command"] == "unknown"
        assert [later["command"] for later in record["resumed"]] == ["second", "third"]

    def test_it_goes_on_from_the_weights_that_it_began_with(self, files: list[Path], tmp_path: Path) -> None:
        checkpoint = tmp_path / "checkpoint.safetensors"
        short = TINY.model_copy(update={"most_seconds": 1e-3})
        starts = [
            EmbeddedEnhancer(
                build_network(
                    CONDITION_CHANNELS, TINY.channels, torch.Generator().manual_seed(seed), generative=False
                ),
                *(1, 1, 0, False, Gamut(0.0, 1e6, 0.0, 1e6)),
                {"command": f"start {seed}"},
            )
            for seed in range(2)
        ]
        first = pretrain(files, short, starts[0], checkpoint=checkpoint, about={"command": "first"}).record
        assert "resumed" not in first
        for other in (starts[1], None):
            with pytest.raises(WeightsError, match="it began with other weights"):
                pretrain(files, short, other, checkpoint=checkpoint)
        # The same weights, though their record is worded otherwise.
        same = replace(starts[0], record={"command": "moved"})
        record = pretrain(files, short, same, checkpoint=checkpoint, about={"command": "second"}).record
        assert record["iterations_made"] == 2
        assert record["before"] == {"command": "start 0"}
        assert record["command"] == "first"
        assert record["resumed"] == [{"command": "second"}]

    def test_a_training_that_goes_on_keeps_the_record_of_its_beginning(
        self, files: list[Path], tmp_path: Path
    ) -> None:
        checkpoint = tmp_path / "checkpoint.safetensors"
        first = pretrain(files, TINY, checkpoint=checkpoint).record["history"]
        longer = TINY.model_copy(update={"iterations": 20})
        history = pretrain(files, longer, checkpoint=checkpoint).record["history"]
        assert [entry["iteration"] for entry in history] == [10, 12, 20]
        assert history[:2] == first

    def test_weights_that_are_not_finite_end_it(
        self, files: list[Path], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
    ) -> None:
        """The loss of the last step is that of the weights before it."""
        descend = NetworkTraining._descend

        def last_one_diverges(training: NetworkTraining, *given: Any) -> None:
            descend(training, *given)
            if training.iteration == TINY.iterations - 1:
                next(training.network.parameters()).data.fill_(float("nan"))

        monkeypatch.setattr(NetworkTraining, "_descend", last_one_diverges)
        checkpoint = tmp_path / "checkpoint.safetensors"
        for file in (None, checkpoint):
            with pytest.raises(DivergedError, match="weights are not finite after iteration 12"):
                pretrain(files, TINY, checkpoint=file)
        assert not checkpoint.exists()

    def test_crops_of_several_sizes_are_refused(
        self, scene: PretrainingScene, files: list[Path], tmp_path: Path
    ) -> None:
        """Images of 64 x 48 pixels, and of 64 x 40."""
        pairs = scene.pairs
        lower = replace(
            pairs,
            layers=Layers(pairs.layers.data[..., :40, :]),
            target=pairs.target[..., :40, :],
            weight=pairs.weight[..., :40, :],
            depth_mm=pairs.depth_mm[..., :40, :],
        )
        small = tmp_path / "small.safetensors"
        replace(scene, pairs=lower, references=scene.references).save(small)
        told = r"crop=48: images of some scenes \(64x40 px\) are too small.*set crop=40"
        with pytest.raises(ConfigError, match=told):
            pretrain([files[0], small, files[1]], TINY.model_copy(update={"crop": 48}))

    def test_patches_of_several_sizes_are_refused(self) -> None:
        config = PretrainingConfig(generative=True, crop=96, patch_px=128)
        check_sizes(config, [(144, 160), (128, 160)])
        with pytest.raises(
            ConfigError, match=r"patch_px=128: .* \(176x112 px\) are too small.*set patch_px=112"
        ):
            check_sizes(config, [(144, 160), (112, 176)])
        # Others show no patches.
        check_sizes(config.model_copy(update={"generative": False}), [(144, 160), (112, 176)])

    def test_a_file_that_is_no_scene_has_no_size(self, tmp_path: Path) -> None:
        (tmp_path / "x.safetensors").write_bytes(b"nothing")
        save_safetensors(tmp_path / "y.safetensors", {"other": torch.zeros(1)})
        for name in ("x", "y"):
            with pytest.raises(WeightsError, match=rf"{name}\.safetensors: not the pairs"):
                PretrainingScene.size_of(tmp_path / f"{name}.safetensors")

    def test_what_a_process_raises_is_told(self, monkeypatch: pytest.MonkeyPatch) -> None:
        monkeypatch.setattr(torch, "set_num_threads", lambda _count: None)

        def refused(number: int, workers: int) -> Callable[[], Batch]:
            raise ConfigError(f"process {number} of {workers}: images are too small")

        given: Queue = Queue()
        parallel._draw(refused, 1, 2, given)
        with pytest.raises(ConfigError, match="process 1 of 2: images are too small"):
            parallel._taken(given, current_process())

    @pytest.mark.slow  # Each of them imports torch.
    def test_what_a_process_raises_is_told_by_its_parent(self, tmp_path: Path) -> None:
        missing = partial(_mixed_sampler, [tmp_path / "gone.safetensors"] * 2, TINY, 0)
        with (
            drawn_in_processes(missing, 2) as draw,
            pytest.raises(WeightsError, match=r"gone\.safetensors: not the pairs"),
        ):
            draw()

    def test_more_processes_than_scenes_are_refused(self, files: list[Path]) -> None:
        with pytest.raises(ConfigError, match="drawing_processes=3: there are 2 scenes"):
            pretrain(files, TINY.model_copy(update={"drawing_processes": 3}))

    def test_a_plain_network_does_not_start_from_a_generative_one(self, files: list[Path]) -> None:
        network = build_network(
            CONDITION_CHANNELS + INVENTED_CHANNELS,
            TINY.channels,
            torch.Generator().manual_seed(1),
            generative=True,
        )
        start = EmbeddedEnhancer(network, 1, 1, 0, False, Gamut(0.0, 1e6, 0.0, 1e6), {})
        with pytest.raises(ConfigError, match="are generative; set generative"):
            pretrain(files, TINY, start)

    def test_a_generative_network_starts_from_a_plain_one(
        self,
        scene: PretrainingScene,
        files: list[Path],
        shared_data: Path,
        monkeypatch: pytest.MonkeyPatch,
        tmp_path: Path,
    ) -> None:
        monkeypatch.setenv("EXTRAGS_LPIPS_WEIGHTS", str(shared_data / "lpips_weights"))
        plain = pretrain(files, TINY)
        wider = {"generative": True, "perceptual": True, "drawn_share": 1.0, "iterations": 2}
        enhancer = pretrain(files, TINY.model_copy(update=wider | {"patch_px": 32}), plain)
        assert enhancer.network.generative
        assert not torch.equal(enhancer.network.exit.weight, plain.network.exit.weight)
        assert {"embedded_1", "drawn_1", "drawn_4"} <= set(enhancer.record["validation_scores"])
        enhancer.save(tmp_path)
        loaded = EmbeddedEnhancer.load(tmp_path)
        rgb = np.random.default_rng(1).integers(0, 255, scene.references.rgb.shape, dtype=np.uint8)
        given = scene.references
        features = [
            frame_features(enhancer.network, one.images.float(), one.valid)
            for one in (given, replace(given, rgb=rgb, mask=np.ones_like(given.mask)))
        ]
        for one in (enhancer, loaded):
            near, far = (one.domain.score(each) for each in features)
            assert far > 3 * near

    def test_crops_have_sides_that_the_network_takes(self) -> None:
        with pytest.raises(ValueError, match="multiple of 8"):
            PretrainingConfig(crop=100)

    def test_drawing_needs_the_perceptual_distance(self) -> None:
        with pytest.raises(ValueError, match="needs the perceptual distance"):
            PretrainingConfig(generative=True, perceptual=False)
