"""What each pipeline is handed, and that each runs, reloads and repeats with tiny random parts."""

from __future__ import annotations

import shutil
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import torch

from extrags.config import PretrainedConfig
from extrags.errors import ConfigError, NonFiniteError, WeightsError
from extrags.events import Event, MetricRecorded, subscribed
from extrags.restoration.pretrained.adapter import Adapter, Window
from extrags.restoration.pretrained.model import find_model
from extrags.restoration.pretrained.stable_diffusion import (
    StableDiffusionImageToImage,
    StableDiffusionInpaint,
)
from extrags.restoration.pretrained.wan_vace import WanVace
from tests.extrags.restoration.pretrained.tiny_pipelines import ADAPTERS, moving_tube

# Of diffusers and of what it hands to numpy; nothing of ours.
pytestmark = [
    pytest.mark.filterwarnings("ignore::DeprecationWarning"),
    pytest.mark.filterwarnings("ignore::FutureWarning"),
]

SETTINGS = PretrainedConfig(steps=3, strength=1.0, device="cpu", dtype="float32")
TEXT = {"prompt_embeds": torch.zeros(1, 4, 8), "negative_prompt_embeds": torch.ones(1, 4, 8)}


def window(frames: int, side: int = 32) -> Window:
    images = moving_tube(frames, side, side)
    unknown = np.zeros((frames, side, side), bool)
    unknown[1:, 8:24, 8:24] = True
    return Window(images, unknown, images[:2])


class Recorder:
    """Stands for a pipeline: keeps what it is called with."""

    def __init__(self, value: float = 0.5) -> None:
        self.value = value
        self.calls: list[dict[str, Any]] = []
        self.unet = SimpleNamespace(dtype=torch.float32)
        self._execution_device = torch.device("cpu")

    def __call__(self, **arguments: Any) -> Any:
        self.calls.append(arguments)
        given = arguments.get("image") or arguments["video"]
        made = np.full((len(given), given[0].height, given[0].width, 3), self.value, np.float32)
        return SimpleNamespace(frames=made[None], images=made)


class TestWhatPipelinesAreGiven:
    def test_wan_sees_grey_where_something_is_to_be_made(self) -> None:
        pipeline = Recorder()
        WanVace(pipeline, TEXT, SETTINGS).restore(window(5), 7)
        call = pipeline.calls[0]
        frame, mask = np.asarray(call["video"][2]), np.asarray(call["mask"][2])
        assert mask[8:24, 8:24].min() == 255
        assert mask[:8].max() == 0
        assert set(frame[8:24, 8:24].ravel()) == {128}
        assert np.abs(frame[:8] / 255 - moving_tube(5, 32, 32)[2, :8]).max() < 1 / 255
        assert np.asarray(call["mask"][0]).max() == 0
        assert len(call["reference_images"]) == 2
        assert (call["num_frames"], call["height"], call["width"]) == (5, 32, 32)
        assert call["generator"].initial_seed() == 7
        assert call["negative_prompt_embeds"] is TEXT["negative_prompt_embeds"]

    def test_wan_does_without_references(self) -> None:
        pipeline = Recorder()
        alone = replace(window(5), references=np.zeros((0, 32, 32, 3), np.float32))
        WanVace(pipeline, TEXT, SETTINGS).restore(alone, 7)
        assert pipeline.calls[0]["reference_images"] is None

    def test_stable_diffusion_frames_share_their_noise(self) -> None:
        pipeline = Recorder()
        restored = StableDiffusionImageToImage(pipeline, TEXT, SETTINGS).restore(window(6), 7)
        assert restored.shape == (6, 32, 32, 3)
        assert np.array_equal(restored[0], window(6).frames[0])
        assert [len(call["image"]) for call in pipeline.calls] == [4, 1]
        seeds = {generator.initial_seed() for call in pipeline.calls for generator in call["generator"]}
        assert seeds == {7}
        assert pipeline.calls[0]["prompt_embeds"].shape == (4, 4, 8)

    def test_inpainting_gets_the_mask_of_each_frame(self) -> None:
        pipeline = Recorder()
        StableDiffusionInpaint(pipeline, TEXT, SETTINGS).restore(window(6), 7)
        masks = [np.asarray(mask) for call in pipeline.calls for mask in call["mask_image"]]
        assert [mask.max() for mask in masks] == [255] * 5


class TestSettings:
    def test_no_step_left_is_refused(self) -> None:
        few = PretrainedConfig(steps=2, strength=0.2)
        with pytest.raises(ConfigError, match="no step"):
            StableDiffusionImageToImage(Recorder(), TEXT, few).restore(window(2), 0)

    def test_strength_leaves_all_steps_of_ltx(self, saved: Callable[[str], Path]) -> None:
        assert opened("ltx", saved, steps=2, strength=0.2).restore(window(9), 0).shape == (9, 32, 32, 3)

    def test_nan_is_refused(self) -> None:
        with pytest.raises(NonFiniteError, match="dtype=float32"):
            WanVace(Recorder(float("nan")), TEXT, SETTINGS).restore(window(5), 0)

    def test_values_outside_are_clipped(self) -> None:
        assert WanVace(Recorder(1.5), TEXT, SETTINGS).restore(window(5), 0).max() == 1

    def test_rules_name_what_they_accept(self) -> None:
        assert set(ADAPTERS) == {"wan-vace", "stable-video", "ltx", "sd-img2img", "sd-inpaint"}
        for backend, adapter in ADAPTERS.items():
            assert adapter.rule.backend == backend
            assert adapter.rule.pipeline in adapter.rule.accepts
            assert (adapter.rule.frames - 1) % adapter.rule.frame_step == 0


@pytest.mark.parametrize("backend", sorted(ADAPTERS))
class TestTinyPipelines:
    def test_runs_reloads_and_repeats(self, backend: str, saved: Callable[[str], Path]) -> None:
        adapter = ADAPTERS[backend]
        settings = SETTINGS.model_copy(update={"model": str(saved(adapter.rule.pipeline))})
        folder = find_model(adapter.rule, settings)
        text = adapter.encode_text(folder, "pink wall of a tube", "blurry", settings)
        assert bool(text) == bool(adapter.rule.text_parts)
        if text:
            assert not torch.equal(text["prompt_embeds"], text["negative_prompt_embeds"])
        side = max(32, adapter.rule.size_multiple)
        frames = 1 + max(2, adapter.rule.frame_step)
        given = window(frames, side)
        opened = adapter.open(folder, text, settings)
        first = opened.restore(given, 3)
        assert first.shape == (frames, side, side, 3)
        assert first.std() > 0.01
        assert np.array_equal(first, opened.restore(given, 3))
        assert np.array_equal(first, adapter.open(folder, text, settings).restore(given, 3))
        assert not np.array_equal(first, opened.restore(given, 4))

    def test_every_step_is_told_and_may_be_the_last(self, backend: str, saved: Callable[[str], Path]) -> None:
        """Within a clip, which takes long at the size of a model, no limit of time ended it."""
        adapter = opened(backend, saved)
        events: list[Event] = []
        with subscribed(events.append):
            restored = adapter.restore(window(9), 3)
        told = [(event.name, event.value) for event in events if isinstance(event, MetricRecorded)]
        steps = [("denoising_step", float(step)) for step in range(1, adapter.steps_run + 1)]
        assert told == steps * (len(told) // len(steps))
        assert len(told) >= len(steps) > 1

        def end(event: Event) -> None:
            raise TimeoutError

        with pytest.raises(TimeoutError), subscribed(end):
            adapter.restore(window(9), 3)
        assert np.array_equal(adapter.restore(window(9), 3), restored)

    def test_half_precision_runs(self, backend: str, saved: Callable[[str], Path]) -> None:
        adapter = ADAPTERS[backend]
        folder = saved(adapter.rule.pipeline)
        settings = SETTINGS.model_copy(update={"dtype": "bfloat16", "steps": 1})
        text = adapter.encode_text(folder, "pink wall", "blurry", settings)
        opened = adapter.open(folder, text, settings)
        side = max(32, adapter.rule.size_multiple)
        restored = opened.restore(window(1 + adapter.rule.frame_step, side), 3)
        assert restored.dtype == np.float32
        kept = {
            part.dtype for name, part in opened.pipeline.components.items() if name in opened.float32_parts
        }
        assert kept <= {torch.float32}


def opened(backend: str, saved: Callable[[str], Path], **settings: Any) -> Adapter:
    adapter = ADAPTERS[backend]
    folder = saved(adapter.rule.pipeline)
    chosen = SETTINGS.model_copy(update=settings)
    return adapter.open(folder, adapter.encode_text(folder, "pink wall", "blurry", chosen), chosen)


class TestKnownPixels:
    def test_stable_video_puts_back_all_that_is_known(self, saved: Callable[[str], Path]) -> None:
        adapter = opened("stable-video", saved, steps=2)
        given = window(3, 64)
        known = replace(given, unknown=np.zeros_like(given.unknown))
        with torch.no_grad():
            latents = adapter._latents(given.frames)  # type: ignore[attr-defined]
            decoded = adapter.pipeline.decode_latents(latents[None], 3, 3)[0].permute(1, 2, 3, 0)
        expected = ((decoded.numpy() + 1) / 2).clip(0, 1)
        assert np.abs(adapter.restore(known, 5) - expected).max() < 1e-5
        assert np.abs(adapter.restore(given, 5) - expected).max() > 1e-3

    def test_wan_reacts_to_frames_and_references(self, saved: Callable[[str], Path]) -> None:
        adapter = opened("wan-vace", saved)
        given = window(5)
        first = adapter.restore(given, 5)
        assert not np.array_equal(first, adapter.restore(replace(given, frames=1 - given.frames), 5))
        assert not np.array_equal(first, adapter.restore(replace(given, references=1 - given.references), 5))

    def test_image_to_image_at_low_strength_keeps_more(self, saved: Callable[[str], Path]) -> None:
        given = window(2)
        changes = []
        for strength in (0.25, 1.0):
            adapter = opened("sd-img2img", saved, steps=4, strength=strength)
            changes.append(adapter.restore(given, 5))
        autoencoded = opened("sd-img2img", saved, steps=20, strength=0.05).restore(given, 5)
        near, far = (float(np.abs(change - autoencoded).mean()) for change in changes)
        assert near < far


class TestLoading:
    def test_offload_without_cuda_is_refused(self, saved: Callable[[str], Path]) -> None:
        with pytest.raises(ConfigError, match="offload=model"):
            opened("sd-img2img", saved, offload="model")

    def test_cuda_that_is_not_there_is_refused(
        self, saved: Callable[[str], Path], monkeypatch: pytest.MonkeyPatch
    ) -> None:
        monkeypatch.setattr(torch.cuda, "is_available", lambda: False)
        with pytest.raises(ConfigError, match="no CUDA device"):
            opened("sd-img2img", saved, device="cuda")

    def test_missing_weights_name_the_folder(self, saved: Callable[[str], Path], tmp_path: Path) -> None:
        folder = tmp_path / "broken"
        shutil.copytree(saved("StableDiffusionImg2ImgPipeline"), folder)
        for file in (folder / "unet").glob("*.safetensors"):
            file.unlink()
        with pytest.raises(WeightsError, match="broken: not loadable"):
            StableDiffusionImageToImage.open(folder, TEXT, SETTINGS)

    def test_a_plain_checkpoint_inpaints_too(self, saved: Callable[[str], Path], tmp_path: Path) -> None:
        folder = tmp_path / "plain"
        shutil.copytree(saved("StableDiffusionImg2ImgPipeline"), folder)
        index = folder / "model_index.json"
        index.write_text(
            index.read_text().replace("StableDiffusionImg2ImgPipeline", "StableDiffusionPipeline")
        )
        settings = SETTINGS.model_copy(update={"model": str(folder), "steps": 2})
        found = find_model(StableDiffusionInpaint.rule, settings)
        text = StableDiffusionInpaint.encode_text(found, "pink", "blurry", settings)
        restored = StableDiffusionInpaint.open(found, text, settings).restore(window(2), 1)
        assert restored.shape == (2, 32, 32, 3)
