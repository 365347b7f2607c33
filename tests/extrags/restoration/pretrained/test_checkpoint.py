from __future__ import annotations

import argparse
import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from extrags.config import CheckpointConfig, CoarseConfig, EnhanceConfig
from extrags.errors import ConfigError, ExtragsError, MissingDependencyError, WeightsError
from extrags.restoration.backends import load_enhancer, train_enhancer
from extrags.restoration.clips import render_clips
from extrags.restoration.pretrained import checkpoint_driver
from extrags.restoration.pretrained.checkpoint import CheckpointEnhancer, relative_poses
from extrags.restoration.pretrained.clone import check_clone, clone_fingerprint
from extrags.restoration.pretrained.inputs import clip_inputs
from extrags.restoration.pretrained.real_views import RealViews
from extrags.restoration.protocol import Clip
from tests.extrags.lit_tube import HEIGHT, WIDTH, Tube, tube_cameras
from tests.extrags.restoration.pretrained.fake_clone import tiny_state, write_clone


@pytest.fixture(scope="module")
def clip(tube: Tube) -> Clip:
    return render_clips(tube.scene, tube.references, [tube_cameras(5, offset_mm=4.0)], count=4)[0]


@pytest.fixture
def clone(tmp_path: Path) -> Path:
    return write_clone(tmp_path / "clone")


def settings(clone: Path, **further: Any) -> CheckpointConfig:
    given: dict[str, Any] = {
        "root": str(clone),
        "config": "configs/inference.yaml",
        "checkpoint": str(clone / "enhancer.ckpt"),
        "frames": 4,
        "overlap": 1,
        "width": 64,
        "height": 32,
        "device": "cpu",
        "timeout_s": 120.0,
    }
    return CheckpointConfig(**{**given, **further})


def unprepared(tube: Tube, config: CheckpointConfig, caption: str = "pink wall") -> CheckpointEnhancer:
    views = RealViews.gather(tube.scene, tube.sequence)
    return CheckpointEnhancer(config, 4, views, clone_fingerprint(config), {}, caption)


class TestDriver:
    def test_enhancer_from_settings_to_images(
        self, tube: Tube, clip: Clip, clone: Path, tmp_path: Path
    ) -> None:
        config = EnhanceConfig(backend="dynamicrafter", checkpoint=settings(clone), seed=4)
        made = train_enhancer(tube.scene, tube.sequence, config, CoarseConfig())
        made.save(tmp_path / "restorer")
        loaded = load_enhancer(tmp_path / "restorer")
        first = loaded.restore(clip)
        assert first.rgb.shape == (5, HEIGHT, WIDTH, 3)
        # The fake model changes its input by a tenth at most, and by noise.
        rendered = clip.layers.get("rendered").permute(0, 2, 3, 1).numpy()
        difference = np.abs(first.rgb - rendered)
        assert 0.01 < difference.mean() < 0.15
        assert np.array_equal(first.rgb, made.restore(clip).rgb)
        assert json.loads(json.dumps(first.provenance)) == first.provenance
        assert first.provenance["interface"] == "enhancer"
        seen = json.loads((clone / "seen.json").read_text())
        assert seen["renders"] == seen["video"] == [1, 3, 4, 32, 64]
        assert seen["camera_pose"] == [1, 4, 12]
        assert seen["guidance"] == [1, 4, 32, 64]
        assert (seen["steps"], seen["eta"], seen["scale"], seen["fps"]) == (50, 1.0, 1.0, 5)
        assert seen["cond"] == [0]
        assert seen["lead_uncertainty"] == 0
        assert seen["first_pose"] == pytest.approx([1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1, 0], abs=1e-6)
        assert seen["use_checkpoint"] is False
        assert seen["version"] is None
        assert seen["perframe"] is False

    def test_image_to_video_model_keeps_what_is_known(self, tube: Tube, clip: Clip, clone: Path) -> None:
        restored = unprepared(tube, settings(clone, interface="dynamicrafter")).restore(clip)
        assert restored.rgb.shape == (5, HEIGHT, WIDTH, 3)
        assert restored.provenance["guidance_scale"] == 7.5
        base, unknown = clip_inputs(clip, 0.5, 0)
        _, wide = clip_inputs(clip, 0.5, 16)
        difference = np.abs(restored.rgb - base)
        assert difference[~wide].max() < 1e-6 < difference[unknown].max()

    def test_what_the_model_says_when_it_fails_is_shown(self, tube: Tube, clip: Clip, clone: Path) -> None:
        with pytest.raises(ExtragsError, match=r"(?s)exit code 1\..*told to crash"):
            unprepared(tube, settings(clone), "crash please").restore(clip)

    def test_pickles_need_trust(self, tmp_path: Path) -> None:
        file = tmp_path / "model.ckpt"
        torch.save({"state_dict": tiny_state(), "hyper_parameters": argparse.Namespace(width=4)}, file)
        with pytest.raises(checkpoint_driver.Failure, match=r"set enhance\.checkpoint\.trust_pickle=true"):
            checkpoint_driver._weights(str(file), False, torch)
        assert set(checkpoint_driver._weights(str(file), True, torch)) == set(tiny_state())

    def test_forms_of_checkpoints(self, tmp_path: Path) -> None:
        from safetensors.torch import save_file

        state = tiny_state()
        file = tmp_path / "model.ckpt"
        deepspeed = {"module": {f"_forward_module.{name}": value for name, value in state.items()}}
        for content in (state, {"state_dict": state}, deepspeed):
            torch.save(content, file)
            assert set(checkpoint_driver._weights(str(file), False, torch)) == set(state)
        save_file(state, str(tmp_path / "model.safetensors"))
        assert set(checkpoint_driver._weights(str(tmp_path / "model.safetensors"), False, torch)) == set(
            state
        )
        file.write_bytes(b"no checkpoint")
        with pytest.raises(checkpoint_driver.Failure, match=r"model\.ckpt"):
            checkpoint_driver._weights(str(file), True, torch)

    def test_weights_of_another_model_are_named(self, clone: Path) -> None:
        described = settings(clone).model_dump()
        model = torch.nn.ModuleDict({"mix": torch.nn.Conv3d(3, 3, 3), "further": torch.nn.Linear(2, 2)})
        with pytest.raises(checkpoint_driver.Failure, match=r"(?s)does not fit .*further\.bias") as caught:
            checkpoint_driver._load(model, described, torch)
        assert caught.value.kind == "weights"

    def test_missing_packages_of_the_clone_are_named(self, tube: Tube, tmp_path: Path) -> None:
        root = write_clone(tmp_path / "clone", needs="pytorch_lightning_that_is_not_here")
        config = EnhanceConfig(backend="dynamicrafter", checkpoint=settings(root))
        with pytest.raises(MissingDependencyError, match="pytorch_lightning_that_is_not_here"):
            train_enhancer(tube.scene, tube.sequence, config, CoarseConfig())

    def test_a_process_that_takes_too_long_is_stopped(self, tube: Tube, clip: Clip, clone: Path) -> None:
        with pytest.raises(ExtragsError, match=r"longer than 0\.2 s and was stopped"):
            unprepared(tube, settings(clone, timeout_s=0.2)).restore(clip)

    @pytest.mark.parametrize("part", ["enhancer.ckpt", "configs/inference.yaml", "lvdm/models/ddpm3d.py"])
    def test_a_clone_that_changed_is_noticed(self, tube: Tube, clip: Clip, clone: Path, part: str) -> None:
        made = unprepared(tube, settings(clone))
        with (clone / part).open("ab") as stream:
            stream.write(b"\n")
        with pytest.raises(WeightsError, match=r"another one than when .* enhance-train again"):
            made.restore(clip)

    def test_an_interpreter_that_is_not_there(self, tube: Tube, clip: Clip, clone: Path) -> None:
        with pytest.raises(ConfigError, match=r"checkpoint\.python=/no/python: cannot be run"):
            unprepared(tube, settings(clone, python="/no/python")).restore(clip)


class TestPreflight:
    def test_complete(self, clone: Path) -> None:
        found = check_clone(settings(clone))
        assert found.target == "lvdm.models.ddpm3d.LatentVisualDiffusion"

    @pytest.mark.parametrize("name", ["root", "config", "checkpoint"])
    def test_missing_setting(self, clone: Path, name: str) -> None:
        with pytest.raises(ConfigError, match=rf"needs enhance\.checkpoint\.{name};"):
            check_clone(settings(clone, **{name: None}))

    @pytest.mark.parametrize(
        ("file", "error", "told"),
        [
            ("utils/utils.py", ConfigError, "utils/utils.py is missing"),
            ("lvdm/models/samplers/ddim.py", ConfigError, "ddim.py is missing"),
            ("lvdm/models/ddpm3d.py", ConfigError, r"has no lvdm/models/ddpm3d\.py"),
            ("configs/inference.yaml", ConfigError, "no file"),
            ("enhancer.ckpt", WeightsError, "downloads no checkpoints"),
        ],
    )
    def test_missing_file(self, clone: Path, file: str, error: type[Exception], told: str) -> None:
        (clone / file).unlink()
        with pytest.raises(error, match=told):
            check_clone(settings(clone))

    def test_missing_root(self, tmp_path: Path) -> None:
        with pytest.raises(ConfigError, match="no such folder"):
            check_clone(settings(tmp_path / "nowhere"))

    @pytest.mark.parametrize(
        ("text", "told"),
        [
            ("model: [", "not readable as YAML"),
            ("weights: 3", "expected model.target"),
            ("model: {target: x, params: {}}", "package.module.Class"),
        ],
    )
    def test_wrong_config(self, clone: Path, text: str, told: str) -> None:
        (clone / "configs" / "inference.yaml").write_text(text)
        with pytest.raises(ConfigError, match=told):
            check_clone(settings(clone))

    def test_config_in_another_encoding(self, clone: Path) -> None:
        (clone / "configs" / "inference.yaml").write_bytes(b"# 5 \xb5m\nmodel: 3\n")
        with pytest.raises(ConfigError, match=r"inference\.yaml: not readable as YAML \('utf-8'"):
            check_clone(settings(clone))

    def test_sizes(self, clone: Path) -> None:
        with pytest.raises(ConfigError, match="multiples of 16"):
            check_clone(settings(clone, width=60))
        with pytest.raises(ConfigError, match="no new frame"):
            check_clone(settings(clone, overlap=3))


def test_relative_poses_begin_at_the_origin_and_have_no_scale() -> None:
    training = tube_cameras(8).world_from_camera
    path = tube_cameras(4, offset_mm=5.0).world_from_camera
    poses = relative_poses(path, training)
    assert np.abs(poses[0] - np.eye(4)).max() < 1e-12
    larger = [stack.copy() for stack in (path, training)]
    for stack in larger:
        stack[:, :3, 3] = 7 * stack[:, :3, 3] + 100
    assert np.abs(relative_poses(*larger) - poses).max() < 1e-9
