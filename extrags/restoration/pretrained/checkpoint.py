"""DynamiCrafter-type checkpoints, the paper's among them, run by the user's own clone of their code.

Neither code nor weights of these models come with this package: the published ones are a research fork
and a file behind a link. The user names a clone, a config and a checkpoint; everything that can be
missing is looked for by name before anything starts, and the model runs in a process of its own, perhaps
with another interpreter, that exchanges arrays with this one.

No real checkpoint has been run by this project. The tests run a tiny random model through the same
driver; its interface was read from the published callers.

Source: Kim et al.: ExploreGS, 2025 (interface of `enhancer.ckpt`); Xing et al.: DynamiCrafter, 2023.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float

from extrags.config import CheckpointConfig, CoarseConfig, EnhanceConfig
from extrags.errors import NonFiniteError, WeightsError
from extrags.restoration.clips import keep_known
from extrags.restoration.description import DESCRIPTION, description_fields, text_field
from extrags.restoration.pretrained.canvas import Canvas
from extrags.restoration.pretrained.captions import caption_of
from extrags.restoration.pretrained.clone import (
    Clone,
    check_clone,
    check_interpreter,
    clone_fingerprint,
    guidance_scale,
    run_clone,
)
from extrags.restoration.pretrained.inputs import clip_inputs, ranked_references, window_seed
from extrags.restoration.pretrained.prepared import PreparedEnhancer, load_prepared
from extrags.restoration.pretrained.real_views import RealViews
from extrags.restoration.pretrained.windows import Span, cross_faded, padded_to, plan_windows
from extrags.restoration.protocol import Clip, Restoration
from extrags.scene import Scene
from extrags.sequence import EndoscopicSequence

__all__ = ["DYNAMICRAFTER", "CheckpointEnhancer", "relative_poses"]

FORMAT = 2
"""Raised when a saved restorer cannot be read by newer code."""


@dataclass(frozen=True, eq=False)
class CheckpointEnhancer(PreparedEnhancer):
    """A user's clone and checkpoint, a scene's caption and its real views.

    Args:
        caption: text prompt of the model.
    """

    settings: CheckpointConfig
    caption: str

    name = "dynamicrafter"

    def restore(self, clip: Clip) -> Restoration:
        """Restore all views of a clip, in one process for all its windows.

        Every window begins with the real view that sees most of the same surface, at its own pose.

        Raises:
            ConfigError: when a setting is missing or does not fit.
            WeightsError: when the checkpoint is gone, differs from the one the restorer was prepared with,
                does not fit, or is a pickle that the user has not declared trusted.
            MissingDependencyError: when the interpreter lacks a package of the clone.
            ExtragsError: when the process fails or takes too long; with the end of what it wrote.
            NonFiniteError: when the model returns NaN.
        """
        settings = self.settings
        clone = self._unchanged_clone()
        base, unknown = clip_inputs(clip, 0.5, 0)
        restores = settings.interface == "enhancer"
        if restores:
            # The enhancer was trained on renders with all their flaws; the other keeps what it is given.
            images = clip.layers.get("rendered").clamp(0, 1).permute(0, 2, 3, 1).contiguous().numpy()
            holes = clip.layers.get("uncertainty")[:, 0, :, :, None].numpy()
        else:
            images, holes = base, unknown[..., None].astype(np.float32)
        canvas = Canvas.stretched(clip.cameras.width, clip.cameras.height, settings.width, settings.height)
        spans = plan_windows(len(clip), settings.frames - 1, settings.overlap)
        request = self._request(clip, images, holes, canvas, spans)
        result = run_clone(clone, settings, {"caption": self.caption}, request, check=False)
        if result.shape != request["frames"].shape or not np.isfinite(result).all():
            raise NonFiniteError(
                f"{clone.checkpoint} gave {result.shape} images, finite: {bool(np.isfinite(result).all())}; "
                f"expected {request['frames'].shape}"
            )
        parts = [
            window.transpose(0, 2, 3, 1)[1 : 1 + len(span)]
            for window, span in zip(result, spans, strict=True)
        ]
        rgb = canvas.cut(cross_faded(spans, parts, settings.overlap))
        if not restores:
            rgb = keep_known(base, rgb, unknown.astype(np.float32))[0]
        return Restoration(rgb, None, self._provenance())

    def save(self, path: Path) -> None:
        """Write `restorer.json` and `references/`; clone and checkpoint stay where they are."""
        self.save_common(path, backend=self.name, format_number=FORMAT, caption=self.caption)

    def _unchanged_clone(self) -> Clone:
        clone = check_clone(self.settings)
        if clone_fingerprint(self.settings) != self.model_digest:
            raise WeightsError(
                f"{clone.checkpoint}, its config or its code is another one than when this restorer was "
                "prepared; run the stage enhance-train again (--refresh)"
            )
        return clone

    def _request(
        self,
        clip: Clip,
        images: Float[np.ndarray, "t h w 3"],
        holes: Float[np.ndarray, "t h w 1"],
        canvas: Canvas,
        spans: Sequence[Span],
    ) -> dict[str, np.ndarray]:
        """Arrays of `checkpoint_driver`: windows that begin with a real view, at the model's size."""
        settings = self.settings
        frames, masks, poses, seeds = [], [], [], []
        for number, span in enumerate(spans):
            chosen = slice(span.start, span.stop)
            lead = ranked_references(clip.reference[chosen])[:1]
            window = np.concatenate([self.views.images(lead, clip, chosen), images[chosen]])
            covered = np.concatenate([np.zeros_like(holes[:1]), holes[chosen]])
            path = np.concatenate(
                [self.views.world_from_camera[lead], clip.cameras.world_from_camera[chosen]]
            )
            frames.append(padded_to(canvas.placed(window), settings.frames).transpose(0, 3, 1, 2))
            masks.append(padded_to(canvas.placed(covered), settings.frames).transpose(0, 3, 1, 2))
            poses.append(relative_poses(padded_to(path, settings.frames), self.views.world_from_camera))
            seeds.append(window_seed(self.seed, clip.index, number))
        return {
            "frames": np.stack(frames).astype(np.float32),
            "unknown": np.stack(masks).astype(np.float32),
            "poses": np.stack(poses).astype(np.float32),
            "seeds": np.array(seeds, dtype=np.int64),
        }

    def _provenance(self) -> dict[str, Any]:
        return {
            "backend": self.name,
            "steps": self.settings.steps,
            "eta": self.settings.eta,
            "guidance_scale": guidance_scale(self.settings),
            "seed": self.seed,
            "model_digest": self.model_digest,
            **self.record,
        }


class CheckpointBackend:
    """`enhance.backend=dynamicrafter`: nothing is trained."""

    name = CheckpointEnhancer.name

    def check(self, config: EnhanceConfig) -> None:
        """Look for clone, config and checkpoint, and import the clone's modules.

        Raises:
            ConfigError: when a setting is missing or does not fit.
            WeightsError: when the checkpoint is missing.
            MissingDependencyError: when the interpreter lacks a package of the clone.
            ExtragsError: when the process ends otherwise than it should.
        """
        check_interpreter(config.checkpoint)

    def digest(self, config: EnhanceConfig) -> str:
        """Fingerprint of checkpoint, config and code.

        Raises:
            ConfigError: when a setting is missing or does not fit.
            WeightsError: when the checkpoint is missing.
        """
        return clone_fingerprint(config.checkpoint)

    def needs_text(self, config: EnhanceConfig) -> bool:
        """Both interfaces read a caption."""
        return True

    def prepare(
        self, scene: Scene, sequence: EndoscopicSequence, config: EnhanceConfig, coarse: CoarseConfig
    ) -> CheckpointEnhancer:
        """Check everything that is needed, gather the scene's real views.

        Raises:
            ExtragsError: as `check`, or when there is no caption.
        """
        check_interpreter(config.checkpoint)
        clone = check_clone(config.checkpoint)
        caption = caption_of(sequence, config.caption)
        record = {
            "interface": config.checkpoint.interface,
            "checkpoint": clone.checkpoint.name,
            "checkpoint_bytes": clone.checkpoint.stat().st_size,
            "caption": caption.as_dict(),
        }
        return CheckpointEnhancer(
            settings=config.checkpoint,
            seed=config.seed,
            views=RealViews.gather(scene, sequence),
            model_digest=clone_fingerprint(config.checkpoint),
            record=record,
            caption=caption.text,
        )

    def load(self, path: Path) -> CheckpointEnhancer:
        """Read what `CheckpointEnhancer.save` wrote.

        Raises:
            WeightsError: when a file is missing, damaged, or does not fit this version.
        """
        description, views = load_prepared(path, format_number=FORMAT)
        with description_fields(path / DESCRIPTION):
            return CheckpointEnhancer(
                settings=CheckpointConfig.model_validate(description["settings"]),
                seed=int(description["seed"]),
                views=views,
                model_digest=text_field(description, "model_digest"),
                record=dict(description["record"]),
                caption=text_field(description, "caption"),
            )


DYNAMICRAFTER = CheckpointBackend()


def relative_poses(
    world_from_camera: Float[np.ndarray, "t 4 4"], training: Float[np.ndarray, "r 4 4"]
) -> Float[np.ndarray, "t 4 4"]:
    """Poses in the first camera's frame, with lengths as the paper's enhancer was given them.

    Its published caller divides by the largest, over the three axes, norm of all training positions about
    their mean. That grows with the number of frames; the checkpoint was used so, and is used so here.

    Args:
        world_from_camera: of a window.
        training: of all training frames.
    """
    centers = training[:, :3, 3]
    mean = centers.mean(axis=0)
    scale = max(float(np.linalg.norm(centers - mean, axis=0).max()), 1e-9)
    scaled = world_from_camera.astype(np.float64).copy()
    scaled[:, :3, 3] = (scaled[:, :3, 3] - mean) / scale
    return np.asarray(np.linalg.inv(scaled[0]) @ scaled)
