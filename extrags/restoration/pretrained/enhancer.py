"""Restoration by a pretrained diffusers pipeline: the enhancer of a scene, and the backend that makes it."""

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

from extrags.array_files import load_safetensors, save_safetensors
from extrags.config import CoarseConfig, EnhanceConfig, PretrainedConfig
from extrags.errors import ConfigError, WeightsError, reason_of
from extrags.model_files import fingerprint
from extrags.restoration.clips import keep_known
from extrags.restoration.description import DESCRIPTION, description_fields, text_field
from extrags.restoration.pretrained.adapter import Adapter, Window
from extrags.restoration.pretrained.canvas import Canvas
from extrags.restoration.pretrained.captions import caption_of
from extrags.restoration.pretrained.inputs import clip_inputs, ranked_references, window_seed
from extrags.restoration.pretrained.model import check_device, find_model
from extrags.restoration.pretrained.prepared import PreparedEnhancer, load_prepared
from extrags.restoration.pretrained.real_views import RealViews
from extrags.restoration.pretrained.windows import cross_faded, padded_to, plan_windows, valid_frame_count
from extrags.restoration.protocol import Clip, Restoration
from extrags.scene import Scene
from extrags.sequence import EndoscopicSequence
from extrags.threads import torch_threads

__all__ = ["DiffusersBackend", "PretrainedEnhancer"]

FORMAT = 1
"""Raised when a saved restorer cannot be read by newer code."""
TEXT = "text.safetensors"

# Pipelines keep state while they run and hold gigabytes: one at a time in a process, kept between clips.
_LOCK = threading.Lock()
_OPEN: dict[str, Adapter] = {}


@dataclass(frozen=True, eq=False)
class PretrainedEnhancer(PreparedEnhancer):
    """A pretrained pipeline, a scene's encoded caption and its real views.

    Args:
        adapter: of the pipeline.
        text: the caption as encoded by the pipeline; empty where it reads none.
    """

    settings: PretrainedConfig
    adapter: type[Adapter]
    text: dict[str, Tensor]

    @property
    def name(self) -> str:
        """Of the backend."""
        return self.adapter.rule.backend

    def restore(self, clip: Clip) -> Restoration:
        """Restore all views of a clip.

        Every window begins with the real view that sees most of the same surface as its first frame.
        What the scene knows is put back afterwards, as for every restorer.

        Raises:
            WeightsError: when the model is gone, or another one than the restorer was prepared with.
            ConfigError: when a setting does not fit the machine, or leaves nothing to do.
            NonFiniteError: when the pipeline returns NaN.
        """
        with _LOCK, torch_threads(self.settings.threads):
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
        folder = find_model(self.adapter.rule, self.settings)
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
            _OPEN[key] = self.adapter.open(folder, self.text, self.settings)
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
            lead = self.views.images(ranked[:1], clip, chosen)
            frames = np.concatenate([lead, base[chosen]])
            holes = np.concatenate([np.zeros((1, *unknown.shape[1:]), bool), unknown[chosen]])
            count = valid_frame_count(len(frames), rule.frame_step)
            window = Window(
                padded_to(canvas.placed(frames), count),
                padded_to(canvas.placed_mask(holes), count),
                canvas.placed(self.views.images(ranked[: settings.reference_images], clip, chosen)),
            )
            restored = adapter.restore(window, window_seed(self.seed, clip.index, number))
            parts.append(restored[1 : 1 + len(span)])
        rgb = canvas.cut(cross_faded(spans, parts, settings.overlap))
        return keep_known(base, rgb, unknown.astype(np.float32))[0] if rule.masked else rgb

    def save(self, path: Path) -> None:
        """Write `restorer.json`, `text.safetensors` and `references/`; the model stays where it is."""
        self.save_common(path, backend=self.name, format_number=FORMAT)
        save_safetensors(path / TEXT, self.text)


@dataclass(frozen=True)
class DiffusersBackend:
    """The backend of one diffusers pipeline: nothing is trained, the scene's caption is encoded.

    Args:
        adapter: of the pipeline.
    """

    adapter: type[Adapter]

    @property
    def name(self) -> str:
        """As in `enhance.backend`."""
        return self.adapter.rule.backend

    def check(self, config: EnhanceConfig) -> None:
        """Look for model and packages, and for settings that would fail with the first window.

        Raises:
            WeightsError: when the model is missing; says how to get it.
            MissingDependencyError: without diffusers.
            ConfigError: when a setting does not fit the pipeline or the machine.
        """
        self._checked(config)

    def digest(self, config: EnhanceConfig) -> str:
        """Fingerprint of the saved pipeline.

        Raises:
            ExtragsError: as `check`.
        """
        return fingerprint(self._checked(config))

    def needs_text(self, config: EnhanceConfig) -> bool:
        """Whether the pipeline has a text encoder."""
        return bool(self.adapter.rule.text_parts)

    def prepare(
        self, scene: Scene, sequence: EndoscopicSequence, config: EnhanceConfig, coarse: CoarseConfig
    ) -> PretrainedEnhancer:
        """Find the model, encode the scene's caption, gather its real views.

        Raises:
            ExtragsError: as `check`, or when there is no caption.
        """
        adapter = self.adapter
        folder = self._checked(config)
        text: dict[str, Tensor] = {}
        record: dict[str, Any] = {
            "model": config.pretrained.model or adapter.rule.usual_model,
            "diffusers": importlib.metadata.version("diffusers"),
        }
        if adapter.rule.text_parts:
            caption = caption_of(sequence, config.caption)
            text = adapter.encode_text(folder, caption.text, config.caption.negative_text, config.pretrained)
            record["caption"] = caption.as_dict()
        return PretrainedEnhancer(
            settings=config.pretrained,
            seed=config.seed,
            views=RealViews.gather(scene, sequence),
            model_digest=fingerprint(folder),
            record=record,
            adapter=adapter,
            text=text,
        )

    def load(self, path: Path) -> PretrainedEnhancer:
        """Read what `PretrainedEnhancer.save` wrote; the pipeline is loaded with the first clip.

        Raises:
            WeightsError: when a file is missing, damaged, or does not fit this version.
        """
        description, views = load_prepared(path, format_number=FORMAT, files=(TEXT,))
        try:
            text = load_safetensors(path / TEXT)
        except (OSError, ValueError) as error:
            raise WeightsError(f"{path / TEXT}: not readable as safetensors ({reason_of(error)})") from error
        with description_fields(path / DESCRIPTION):
            return PretrainedEnhancer(
                settings=PretrainedConfig.model_validate(description["settings"]),
                seed=int(description["seed"]),
                views=views,
                model_digest=text_field(description, "model_digest"),
                record=dict(description["record"]),
                adapter=self.adapter,
                text=text,
            )

    def _checked(self, config: EnhanceConfig) -> Path:
        """The folder of the saved pipeline, after all checks."""
        rule, settings = self.adapter.rule, config.pretrained
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
        self.adapter(None, {}, settings).check_steps()
        check_device(settings)
        return find_model(rule, settings)


def _digest(text: dict[str, Tensor]) -> str:
    from safetensors.torch import save

    return hashlib.blake2b(save(text), digest_size=16).hexdigest()
