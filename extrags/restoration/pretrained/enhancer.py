"""The restorer of a scene by a pretrained diffusers pipeline."""

from __future__ import annotations

import hashlib
import importlib.metadata
import json
import threading
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float
from torch import Tensor

from extrags.config import EnhanceConfig, PretrainedConfig
from extrags.errors import ConfigError, WeightsError
from extrags.restoration.clips import keep_known
from extrags.restoration.pretrained.adapter import Adapter, Window
from extrags.restoration.pretrained.canvas import Canvas
from extrags.restoration.pretrained.captions import caption_of
from extrags.restoration.pretrained.fingerprint import fingerprint
from extrags.restoration.pretrained.inputs import clip_inputs, ranked_references, window_seed
from extrags.restoration.pretrained.ltx import LtxCondition
from extrags.restoration.pretrained.model import check_device, find_model
from extrags.restoration.pretrained.real_views import RealViews
from extrags.restoration.pretrained.stable_diffusion import (
    StableDiffusionImageToImage,
    StableDiffusionInpaint,
)
from extrags.restoration.pretrained.stable_video import StableVideo
from extrags.restoration.pretrained.wan_vace import WanVace
from extrags.restoration.pretrained.windows import cross_faded, padded_to, plan_windows, valid_frame_count
from extrags.restoration.protocol import Clip, Restoration
from extrags.scene import Scene
from extrags.sequence import EndoscopicSequence

__all__ = ["ADAPTERS", "PretrainedEnhancer", "check_pipeline"]

FORMAT = 1
"""Raised when a saved restorer cannot be read by newer code."""

ADAPTERS: dict[str, type[Adapter]] = {
    adapter.rule.backend: adapter
    for adapter in (
        WanVace,
        StableVideo,
        LtxCondition,
        StableDiffusionImageToImage,
        StableDiffusionInpaint,
    )
}

# Pipelines keep state while they run and hold gigabytes: one at a time in a process, kept between clips.
_LOCK = threading.Lock()
_OPEN: dict[str, Adapter] = {}


@dataclass(eq=False)
class PretrainedEnhancer:
    """A pretrained pipeline, a scene's encoded caption and its real views.

    Args:
        name: backend, a key of `ADAPTERS`.
        settings: of the user.
        seed: of the noise, together with clip and window.
        text: the caption as the pipeline's encoder gave it.
        views: training frames.
        model_digest: fingerprint of the weights the restorer was prepared with.
        record: caption and versions, for the provenance.
    """

    name: str
    settings: PretrainedConfig
    seed: int
    text: dict[str, Tensor]
    views: RealViews
    model_digest: str
    record: dict[str, Any]

    @classmethod
    def prepare(cls, scene: Scene, sequence: EndoscopicSequence, config: EnhanceConfig) -> PretrainedEnhancer:
        """Find the model, encode the scene's caption, gather its real views. Nothing is trained.

        Args:
            scene: the coarse scene, trained on `sequence.train`.
            sequence: posed frames; only training frames are used.
            config: backend, model and caption.

        Raises:
            WeightsError: when the model is not there; says how to get it.
            MissingDependencyError: without diffusers.
            ConfigError: when a setting does not fit the machine.
        """
        adapter = ADAPTERS[config.backend]
        folder = check_pipeline(config)
        text: dict[str, Tensor] = {}
        record: dict[str, Any] = {
            "model": config.pretrained.model or adapter.rule.usual_model,
            "diffusers": importlib.metadata.version("diffusers"),
        }
        if adapter.rule.text_parts:
            caption = caption_of(sequence, config.caption)
            text = adapter.encode_text(folder, caption.text, config.caption.negative_text, config.pretrained)
            record["caption"] = caption.as_dict()
        return cls(
            config.backend,
            config.pretrained,
            config.seed,
            text,
            RealViews.gather(scene, sequence),
            fingerprint(folder),
            record,
        )

    def restore(self, clip: Clip) -> Restoration:
        """Restore all views of a clip.

        Every window begins with the real view that sees most of the same surface as its first frame.
        What the scene knows is put back afterwards, as for every restorer.

        Raises:
            WeightsError: when the model is gone, or another one than the restorer was prepared with.
            ConfigError: when a setting does not fit the machine, or leaves nothing to do.
            NonFiniteError: when the pipeline returns NaN.
        """
        with _LOCK:
            adapter = self._opened()
            rgb = self._restored(adapter, clip)
        provenance = {
            "backend": self.name,
            **adapter.parameters(),
            "seed": self.seed,
            "model_digest": self.model_digest,
            **self.record,
        }
        return Restoration(rgb, None, provenance)

    def _opened(self) -> Adapter:
        adapter = ADAPTERS[self.name]
        folder = find_model(adapter.rule, self.settings)
        key = json.dumps(
            [self.name, str(folder), self.model_digest, self.settings.model_dump(), _digest(self.text)]
        )
        if key not in _OPEN:
            if fingerprint(folder) != self.model_digest:
                raise WeightsError(
                    f"{folder} holds another model than when this restorer was prepared; "
                    "run the stage enhance-train again (--refresh)"
                )
            # The old one goes first: two would not fit.
            _OPEN.clear()
            _OPEN[key] = adapter.open(folder, self.text, self.settings)
        return _OPEN[key]

    def _restored(self, adapter: Adapter, clip: Clip) -> Float[np.ndarray, "t h w 3"]:
        rule, settings = adapter.rule, self.settings
        base, unknown = clip_inputs(clip, settings.mask_threshold, settings.mask_dilation_px)
        canvas = Canvas.fitted(
            clip.cameras.width,
            clip.cameras.height,
            short_side_px=settings.short_side_px or rule.short_side_px,
            multiple=rule.size_multiple,
        )
        spans = plan_windows(len(clip), (settings.frames or rule.frames) - 1, settings.overlap)
        parts = []
        for number, span in enumerate(spans):
            chosen = slice(span.start, span.stop)
            ranked = ranked_references(clip.reference[chosen])
            lead = self.views.images(ranked[:1])
            frames = np.concatenate([lead, base[chosen]])
            holes = np.concatenate([np.zeros((1, *unknown.shape[1:]), bool), unknown[chosen]])
            count = valid_frame_count(len(frames), rule.frame_step)
            window = Window(
                padded_to(canvas.placed(frames), count),
                padded_to(canvas.placed_mask(holes), count),
                canvas.placed(self.views.images(ranked[: settings.reference_images])),
            )
            restored = adapter.restore(window, window_seed(self.seed, clip.index, number))
            parts.append(restored[1 : 1 + len(span)])
        rgb = canvas.cut(cross_faded(spans, parts, settings.overlap))
        return keep_known(base, rgb, unknown.astype(np.float32))[0] if rule.masked else rgb

    def save(self, path: Path) -> None:
        """Write `restorer.json`, `text.safetensors` and `references/`; the model stays where it is."""
        from safetensors.torch import save_file

        path.mkdir(parents=True, exist_ok=True)
        save_file(self.text, str(path / "text.safetensors"))
        self.views.save(path / "references")
        description = {
            "backend": self.name,
            "format": FORMAT,
            "settings": self.settings.model_dump(mode="json"),
            "seed": self.seed,
            "model_digest": self.model_digest,
            "record": self.record,
        }
        (path / "restorer.json").write_text(json.dumps(description, indent=2) + "\n")

    @classmethod
    def load(cls, path: Path) -> PretrainedEnhancer:
        """Read what `save` wrote; the model itself is loaded with the first clip.

        Raises:
            WeightsError: when a file is missing, or does not fit this version.
        """
        from safetensors.torch import load_file

        description_file, text_file = path / "restorer.json", path / "text.safetensors"
        for file in (description_file, text_file, path / "references"):
            if not file.exists():
                raise WeightsError(f"{file}: not there; prepare the restorer first (stage enhance)")
        description = json.loads(description_file.read_text())
        if description.get("format") != FORMAT:
            raise WeightsError(
                f"{description_file}: format {description.get('format')}, this version reads {FORMAT}; "
                "prepare the restorer again"
            )
        return cls(
            description["backend"],
            PretrainedConfig.model_validate(description["settings"]),
            int(description["seed"]),
            load_file(str(text_file)),
            RealViews.load(path / "references"),
            description["model_digest"],
            description["record"],
        )


def _digest(text: dict[str, Tensor]) -> str:
    from safetensors.torch import save

    return hashlib.blake2b(save(text), digest_size=16).hexdigest()


def check_pipeline(config: EnhanceConfig) -> Path:
    """Look for everything a backend needs, and for settings that would fail with the first window.

    Args:
        config: with a backend of `ADAPTERS`.

    Returns:
        The folder of the saved pipeline.

    Raises:
        WeightsError: when the model is not there; says how to get it.
        MissingDependencyError: without diffusers.
        ConfigError: when a setting does not fit the pipeline or the machine.
    """
    rule, settings = ADAPTERS[config.backend].rule, config.pretrained
    frames = settings.frames or rule.frames
    if (frames - 1) % rule.frame_step:
        near = valid_frame_count(frames, rule.frame_step)
        raise ConfigError(
            f"enhance.pretrained.frames={frames}: {rule.pipeline} takes "
            f"{rule.frame_step}k+1 frames, {near} for example"
        )
    if frames - 1 <= settings.overlap:
        raise ConfigError(
            f"enhance.pretrained.overlap={settings.overlap} leaves no new frame in windows of {frames}, "
            "the first of which is a real view"
        )
    check_device(settings)
    return find_model(rule, settings)
