"""The way from settings to pseudo-observations, and the sentences a user reads when a model is missing."""

from __future__ import annotations

import importlib.util
import json
import shutil
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np
import pytest
import torch

from extrags.confidence import PerceptualDifference
from extrags.config import CoarseConfig, EnhanceConfig, PretrainedConfig
from extrags.errors import ConfigError, MissingDependencyError, WeightsError
from extrags.illumination import NearFieldLight
from extrags.model_files import fingerprint
from extrags.restoration.backends import backend_of, load_enhancer, train_enhancer
from extrags.restoration.clips import make_pseudo_observations, render_clips
from extrags.restoration.pretrained.enhancer import PretrainedEnhancer
from extrags.restoration.pretrained.inputs import clip_inputs, ranked_references, window_seed
from extrags.restoration.pretrained.model import find_model, require_diffusers
from extrags.restoration.pretrained.real_views import RealViews
from extrags.restoration.protocol import Clip
from extrags.restoration.trajectories import at_working_size
from extrags.view_synthesis.gather import gather_references
from tests.extrags.lit_tube import HEIGHT, WIDTH, Tube, tube_cameras
from tests.extrags.restoration.pretrained.tiny_pipelines import ADAPTERS

pytestmark = [
    pytest.mark.filterwarnings("ignore::DeprecationWarning"),
    pytest.mark.filterwarnings("ignore::FutureWarning"),
]


@pytest.fixture(scope="module")
def clip(tube: Tube) -> Clip:
    return render_clips(
        tube.scene, tube.references, [tube_cameras(6, offset_mm=4.0)], count=4, first_index=3
    )[0]


def settings(backend: str, folder: Path, **further: Any) -> EnhanceConfig:
    pretrained = PretrainedConfig(
        model=str(folder), device="cpu", short_side_px=32, steps=2, strength=1.0, **further
    )
    return EnhanceConfig(backend=backend, pretrained=pretrained, seed=4)  # type: ignore[arg-type]


def prepared(tube: Tube, config: EnhanceConfig) -> PretrainedEnhancer:
    made = train_enhancer(tube.scene, tube.sequence, config, CoarseConfig())
    assert isinstance(made, PretrainedEnhancer)
    return made


def smaller_clip(tube: Tube, width: int) -> Clip:
    """Two views at a working size below that of the frames."""
    sequence, trajectories = at_working_size(
        tube.sequence, [tube_cameras(2, offset_mm=4.0)], EnhanceConfig(max_width=width)
    )
    references = gather_references(tube.scene, sequence, sequence.train)
    return render_clips(tube.scene, references, trajectories, count=4)[0]


class TestRestoration:
    def test_views_smaller_than_the_frames(self, tube: Tube, saved: Callable[[str], Path]) -> None:
        made = prepared(tube, settings("sd-inpaint", saved("StableDiffusionInpaintPipeline")))
        assert made.restore(smaller_clip(tube, WIDTH // 2)).rgb.shape == (2, HEIGHT // 2, WIDTH // 2, 3)

    @pytest.mark.parametrize("backend", ["wan-vace", "ltx"])
    def test_masked_pipelines_leave_known_pixels_as_they_were(
        self, backend: str, tube: Tube, clip: Clip, saved: Callable[[str], Path]
    ) -> None:
        rule = ADAPTERS[backend].rule
        restored = prepared(tube, settings(backend, saved(rule.pipeline))).restore(clip).rgb
        base, unknown = clip_inputs(clip, 0.5, 3)
        _, wide = clip_inputs(clip, 0.5, 16)
        assert np.abs(restored - base)[unknown].mean() > 0.05
        away = np.abs(restored - base)[~wide]
        assert away.size
        assert bool(away.max() < 1e-6) == rule.masked

    def test_known_texture_is_kept_by_the_blend(self, tube: Tube, saved: Callable[[str], Path]) -> None:
        made = prepared(tube, settings("sd-img2img", saved("StableDiffusionImg2ImgPipeline")))
        pseudo = make_pseudo_observations(
            tube.scene,
            tube.references,
            [tube_cameras(2, offset_mm=4.0)],
            made,
            PerceptualDifference(None, "test"),
            count=4,
        )
        sure = pseudo.uncertainty < np.quantile(pseudo.uncertainty, 0.1)
        kept = np.abs(pseudo.target - pseudo.rendered)[sure].mean()
        made_up = np.abs(pseudo.restored - pseudo.rendered)[sure].mean()
        assert kept < 0.35 * made_up
        assert pseudo.provenance["caption"]["source"] == "constant"

    def test_another_model_in_the_same_folder_is_noticed(
        self, tube: Tube, clip: Clip, saved: Callable[[str], Path], tmp_path: Path
    ) -> None:
        folder = tmp_path / "model"
        shutil.copytree(saved("StableDiffusionInpaintPipeline"), folder)
        made = prepared(tube, settings("sd-inpaint", folder))
        index = folder / "scheduler" / "scheduler_config.json"
        index.write_text(index.read_text() + "\n")
        with pytest.raises(WeightsError, match="another model"):
            made.restore(clip)

    def test_a_missing_part_of_a_restorer_is_named(self, tmp_path: Path) -> None:
        (tmp_path / "restorer.json").write_text(json.dumps({"backend": "wan-vace"}))
        with pytest.raises(WeightsError, match=r"text\.safetensors"):
            load_enhancer(tmp_path)

    def test_unknown_backends_are_listed(self, tmp_path: Path) -> None:
        (tmp_path / "restorer.json").write_text(json.dumps({"backend": "magic"}))
        with pytest.raises(WeightsError, match="known: embedded, classical"):
            load_enhancer(tmp_path)


class TestInputs:
    def test_holes_are_masked_and_known_pixels_are_not(self, clip: Clip) -> None:
        base, unknown = clip_inputs(clip, 0.5, 0)
        alpha = clip.layers.get("alpha")[:, 0].numpy()
        blend = clip.layers.get("blend_weight")[:, 0].numpy()
        assert unknown[(alpha < 0.05) & (blend < 0.05)].all()
        assert not unknown[blend > 0.9].any()
        assert 0 < unknown.mean() < 0.9
        assert base.shape == (len(clip), HEIGHT, WIDTH, 3)

    def test_dilation_only_adds(self, clip: Clip) -> None:
        _, narrow = clip_inputs(clip, 0.5, 0)
        _, wide = clip_inputs(clip, 0.5, 2)
        assert (wide >= narrow).all()
        assert wide.sum() > narrow.sum()

    def test_references_are_ranked(self) -> None:
        assert ranked_references(np.array([7, 2, 2, 5, 2, 5])).tolist() == [7, 2, 5]

    def test_seeds_differ_between_windows_and_clips(self) -> None:
        seeds = {window_seed(seed, clip, window) for seed in (0, 1) for clip in (0, 1) for window in (0, 1)}
        assert len(seeds) == 8
        assert all(0 <= seed < 2**63 for seed in seeds)

    def test_real_views_are_at_the_mean_exposure(self, tube: Tube, tmp_path: Path) -> None:
        views = RealViews.gather(tube.scene, tube.sequence)
        assert len(views) == len(tube.sequence.train)
        # The tube's exposures are all 1.
        assert np.abs(views.rgb.astype(int) - tube.sequence.rgb[tube.sequence.train]).max() <= 1
        views.save(tmp_path / "views")
        again = RealViews.load(tmp_path / "views")
        assert np.array_equal(again.rgb, views.rgb)
        assert np.array_equal(again.world_from_camera, views.world_from_camera)

    def test_real_views_of_a_long_recording_are_not_in_memory_at_once(
        self, tube: Tube, monkeypatch: pytest.MonkeyPatch
    ) -> None:
        """Each at its own gain, and as floats one at a time."""
        count = len(tube.sequence.train)
        light = tube.scene.light
        assert light is not None
        light = replace(light, log_exposure=torch.linspace(-0.6, 0.6, count))
        sizes: list[tuple[int, ...]] = []
        inverted = NearFieldLight.invert_response

        def counted(self: NearFieldLight, rgb: torch.Tensor) -> torch.Tensor:
            sizes.append(tuple(rgb.shape))
            return inverted(self, rgb)

        monkeypatch.setattr(NearFieldLight, "invert_response", counted)
        views = RealViews.gather(replace(tube.scene, light=light), tube.sequence)
        assert sizes == count * [(HEIGHT, WIDTH, 3)]
        signal = inverted(light, torch.from_numpy(tube.sequence.rgb[tube.sequence.train] / np.float32(255)))
        balanced = light.apply_response(signal / light.exposures()[:, None, None, None]).clamp(0, 1)
        assert np.array_equal(views.rgb, (balanced * 255).round().to(torch.uint8).numpy())

    def test_real_views_are_shown_at_the_exposure_of_the_clip(self, tube: Tube, clip: Clip) -> None:
        views = RealViews.gather(tube.scene, tube.sequence)
        as_they_are = views.images(np.array([1, 3]), clip)
        np.testing.assert_allclose(as_they_are, views.rgb[[1, 3]] / 255, atol=1e-6)
        exposure = np.linspace(0.5, 1.5, len(clip)).astype(np.float32)
        darker = replace(clip, exposure=exposure)
        light = clip.transfer.light
        assert light is not None
        signal = light.invert_response(torch.from_numpy(as_they_are))
        for chosen in (slice(0, 2), slice(None)):
            expected = light.apply_response(float(exposure[chosen].mean()) * signal).clamp(0, 1)
            found = views.images(np.array([1, 3]), darker, chosen)
            np.testing.assert_allclose(found, expected.numpy(), atol=1e-6)

    def test_real_views_have_the_size_of_the_clip(self, tube: Tube) -> None:
        """Virtual views are at most `enhance.max_width` wide, frames need not be."""
        views = RealViews.gather(tube.scene, tube.sequence)
        small = tube.sequence.at_most_width(WIDTH // 2)
        index = np.array([1, 3])
        found = views.images(index, smaller_clip(tube, WIDTH // 2))
        assert found.shape == (2, HEIGHT // 2, WIDTH // 2, 3)
        np.testing.assert_allclose(found, small.rgb[small.train[index]] / 255, atol=2 / 255)
        assert views.images(index[:0], smaller_clip(tube, WIDTH // 2)).shape == (0, *found.shape[1:])


class TestSettings:
    def test_frame_counts_that_do_not_fit(self, tube: Tube, saved: Callable[[str], Path]) -> None:
        config = settings("wan-vace", saved("WanVACEPipeline"), frames=16)
        with pytest.raises(ConfigError, match=r"takes 4k\+1 frames, 17 for example"):
            prepared(tube, config)

    def test_overlaps_that_do_not_fit(self, tube: Tube, saved: Callable[[str], Path]) -> None:
        config = settings("sd-inpaint", saved("StableDiffusionInpaintPipeline"), frames=5, overlap=4)
        with pytest.raises(ConfigError, match="leaves no new frame"):
            prepared(tube, config)

    def test_no_step_left_is_said_before_anything_is_reconstructed(
        self, saved: Callable[[str], Path]
    ) -> None:
        config = settings("sd-inpaint", saved("StableDiffusionInpaintPipeline"))
        short = config.pretrained.model_copy(update={"strength": 0.2})
        with pytest.raises(ConfigError, match=r"2 steps at strength 0\.2 leave no step"):
            backend_of("sd-inpaint").check(config.model_copy(update={"pretrained": short}))


class TestMissing:
    def test_packages(self, monkeypatch: pytest.MonkeyPatch) -> None:
        monkeypatch.setattr(importlib.util, "find_spec", lambda name: None)
        with pytest.raises(MissingDependencyError) as caught:
            require_diffusers()
        assert str(caught.value) == (
            "the pretrained backends need diffusers, transformers, accelerate, ftfy: not installed. "
            "Install with: pip install -e '.[diffusers]' in a checkout of extrags"
        )

    def test_hub_id_that_is_not_here(
        self, diffusers: ModuleType, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
    ) -> None:
        import huggingface_hub.constants

        monkeypatch.setattr(huggingface_hub.constants, "HF_HUB_CACHE", str(tmp_path))
        with pytest.raises(WeightsError) as caught:
            find_model(ADAPTERS["wan-vace"].rule, PretrainedConfig())
        assert str(caught.value) == (
            "the model Wan-AI/Wan2.1-VACE-1.3B-diffusers is neither a folder here nor in the local Hugging "
            "Face cache. extrags downloads nothing by default. Get it once with `hf download "
            "Wan-AI/Wan2.1-VACE-1.3B-diffusers` (about 19 GB), or set enhance.pretrained.model to a folder "
            "where a WanVACEPipeline was saved (it holds model_index.json), or allow the download with "
            "enhance.pretrained.local_files_only=false."
        )

    def test_hub_id_in_the_cache_is_found_offline(
        self, saved: Callable[[str], Path], monkeypatch: pytest.MonkeyPatch, tmp_path: Path
    ) -> None:
        import huggingface_hub.constants

        commit = "0123456789abcdef0123456789abcdef01234567"
        kept = tmp_path / "models--someone--tiny-wan"
        shutil.copytree(saved("WanVACEPipeline"), kept / "snapshots" / commit)
        (kept / "refs").mkdir()
        (kept / "refs" / "main").write_text(commit)
        monkeypatch.setattr(huggingface_hub.constants, "HF_HUB_CACHE", str(tmp_path))
        found = find_model(ADAPTERS["wan-vace"].rule, PretrainedConfig(model="someone/tiny-wan"))
        assert found == kept / "snapshots" / commit

    def test_folder_that_is_not_there(self, diffusers: ModuleType) -> None:
        with pytest.raises(WeightsError, match=r"model=/no/such/folder: there is no such folder"):
            find_model(ADAPTERS["ltx"].rule, PretrainedConfig(model="/no/such/folder"))

    @pytest.mark.parametrize("model", ["../wan", "./wan", "models/wan--old"])
    def test_relative_folder_that_is_not_there(self, model: str, diffusers: ModuleType) -> None:
        with pytest.raises(WeightsError, match=r"no such folder, and it is no hub id.*hf download Wan"):
            find_model(ADAPTERS["wan-vace"].rule, PretrainedConfig(model=model))

    def test_folder_that_holds_no_pipeline(self, diffusers: ModuleType, tmp_path: Path) -> None:
        with pytest.raises(WeightsError, match=r"holds no model_index\.json"):
            find_model(ADAPTERS["ltx"].rule, PretrainedConfig(model=str(tmp_path)))

    def test_folder_with_another_pipeline(self, saved: Callable[[str], Path]) -> None:
        config = PretrainedConfig(model=str(saved("WanVACEPipeline")))
        with pytest.raises(WeightsError, match=r"names a WanVACEPipeline; enhance\.backend=ltx needs one of"):
            find_model(ADAPTERS["ltx"].rule, config)


def test_the_fingerprint_sees_names_sizes_and_content(tmp_path: Path) -> None:
    (tmp_path / "a.bin").write_bytes(b"x" * 10)
    digests = [fingerprint(tmp_path)]
    (tmp_path / "a.bin").write_bytes(b"x" * 9 + b"y")
    digests.append(fingerprint(tmp_path))
    (tmp_path / "a.bin").rename(tmp_path / "b.bin")
    digests.append(fingerprint(tmp_path))
    (tmp_path / ".cache").write_bytes(b"z")
    assert len(set(digests)) == 3
    assert fingerprint(tmp_path) == digests[-1]


def test_the_fingerprint_sees_the_middle_of_large_files(tmp_path: Path) -> None:
    content = bytearray(3 << 20)
    (tmp_path / "weights.bin").write_bytes(content)
    before = fingerprint(tmp_path)
    content[len(content) // 2] = 1
    (tmp_path / "weights.bin").write_bytes(content)
    assert fingerprint(tmp_path) != before
