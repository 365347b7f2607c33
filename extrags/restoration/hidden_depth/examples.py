"""What reading depth in holes is practised on: explored views, restored, and their true depth."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Float, Int
from torch import Tensor

from extrags.array_files import load_safetensors, save_safetensors
from extrags.cameras import Cameras
from extrags.config import PipelineConfig
from extrags.depth.hidden import SOLID, reading_inputs, reading_size, shrunk, shrunk_intrinsics
from extrags.depth.pretraining.examples import Examples
from extrags.errors import CaptureError, WeightsError, reason_of
from extrags.restoration.diffusion.embedded import EmbeddedEnhancer
from extrags.restoration.training_data.degradation import Degradation
from extrags.restoration.training_data.explored_views import explored_cameras
from extrags.restoration.training_data.recordings import PretrainingRecording
from extrags.training.reconstruction import reconstruct
from extrags.view_synthesis.conditioning import filled_depth, observe_views
from extrags.view_synthesis.gamut import Gamut
from extrags.view_synthesis.gather import gather_references

__all__ = ["EXAMPLES_VERSION", "HiddenDepthExamples"]

EXAMPLES_VERSION = 8
"""Raised by hand whenever the same recording and restorer give other examples."""
EVERY_VIEW = 2
"""Of a trajectory, one of so many views is taken."""
LEAST_HIDDEN, LEAST_KNOWN = 0.02, 0.05
"""Shares of a view that have to be hidden, and known, for it to teach anything."""
LARGEST_ERROR = 0.3
"""Mean error of the log-depth taken for known, apart from scale, up to which holes can be continued."""


@dataclass(frozen=True)
class HiddenDepthExamples:
    """Views of one scene as the restorer gives them.

    Args:
        rgb: restored, in [0, 1], half precision, [V, 3, H, W].
        filled_mm: rendered z-depth, smoothly continued into holes, [V, H, W].
        opacity: of the rendering, half precision, [V, H, W].
        depth_mm: the true z-depth, 0 where a ray meets nothing, [V, H, W].
        K: pinhole intrinsics in pixels, [V, 3, 3].
        clip: number of the trajectory of each view, which never falls from one view to the next, [V].
    """

    rgb: Float[Tensor, "v 3 h w"]
    filled_mm: Float[Tensor, "v h w"]
    opacity: Float[Tensor, "v h w"]
    depth_mm: Float[Tensor, "v h w"]
    K: Float[Tensor, "v 3 3"]
    clip: Int[Tensor, "v"]

    @classmethod
    def of_recording(
        cls, recording: PretrainingRecording, restorer: EmbeddedEnhancer, config: PipelineConfig, seed: int
    ) -> HiddenDepthExamples:
        """Spoil a recording, reconstruct it, explore it, and restore what virtual cameras see.

        Args:
            recording: made for pretraining; of its views to restore nothing is used.
            restorer: in its own number of steps; one that draws gives its mean.
            config: settings of a run; steps, number of Gaussians and light model are drawn.
            seed: of the draws and of the reconstruction.

        Raises:
            CaptureError: when there is nothing to explore.
            DivergedError: when the reconstruction does not stay finite.
        """
        generator = np.random.default_rng([seed, 5])
        degradation = Degradation.random(generator)
        sequence = degradation.applied(recording.sequence, generator).training_part()
        scene = reconstruct(
            sequence, degradation.settings(config.coarse, seed), stage="pretraining-scene"
        ).scene
        chosen = explored_cameras(scene, sequence, config, every=EVERY_VIEW)
        if not chosen:
            raise CaptureError(f"{sequence.name}: nothing to explore")
        cameras = Cameras.concatenated(chosen)
        references = gather_references(scene, sequence, sequence.train)
        layers = observe_views(scene, references, cameras, count=config.enhance.references).layers
        frames = torch.from_numpy(sequence.rgb[sequence.train]).permute(0, 3, 1, 2).float() / 255
        masks = torch.from_numpy(sequence.mask[sequence.train])[:, None].float()
        own = replace(restorer, drawing=False, gamut=Gamut.of_images(frames, masks))
        noise = own.noise((cameras.height, cameras.width), 0, 0)
        restored = own.restored_layers(layers, references.transfer, noise, steps=own.steps)
        return cls(
            restored.rgb.half(),
            filled_depth(layers, references.transfer.scale_mm)[:, 0],
            layers.get("alpha")[:, 0].half(),
            torch.from_numpy(_true_depths_mm(recording.z_depth_mm, cameras)),
            torch.from_numpy(np.asarray(cameras.K, dtype=np.float32)),
            torch.repeat_interleave(torch.tensor([len(part) for part in chosen])),
        )

    def at_size(self, longest: int) -> Examples | None:
        """What the network is shown and has to say, with the longest side at most so long; None without any.

        Args:
            longest: side in pixels.
        """
        size = self.opacity.shape[-2:]
        small = reading_size(size, longest)
        is_true = (self.depth_mm > 0).float()
        log_truth = shrunk((self.depth_mm.clamp_min(1e-9).log() * is_true)[:, None], small)[:, 0]
        share = shrunk(is_true[:, None], small)[:, 0]
        truth, known = log_truth / share.clamp_min(1e-3), (share > 0.99).float()
        rgb = shrunk(self.rgb.float(), small)
        log_depth = shrunk(self.filled_mm.clamp_min(1e-9).log()[:, None], small)[:, 0]
        solid = shrunk(self.opacity.float()[:, None], small)[:, 0] > SOLID
        K = shrunk_intrinsics(self.K, size, small)
        taken = self._teaching(log_depth - truth, known, solid.float())
        parts = []
        # As in use: brightness is fitted to the views of a clip together.
        for number in torch.unique(self.clip):
            views = torch.nonzero(self.clip == number)[:, 0]
            inputs = reading_inputs(rgb[views], log_depth[views], solid[views], K[views])
            relative = truth[views] - inputs.log_scale[:, None, None]
            parts.append((inputs.channels, relative, known[views]))
        channels, relative, known = (torch.cat(part)[taken].half() for part in zip(*parts, strict=True))
        return Examples(channels, relative, known) if len(relative) else None

    def _teaching(
        self, off: Float[Tensor, "v h w"], known: Float[Tensor, "v h w"], solid: Float[Tensor, "v h w"]
    ) -> Int[Tensor, "n"]:
        """Views with a hole, and with depth beside it that can be trusted."""
        taken = []
        for view in range(len(off)):
            shown = off[view][(known[view] * solid[view]) > 0]
            enough = float((known[view] * (1 - solid[view])).mean()) > LEAST_HIDDEN
            if not enough or shown.numel() < LEAST_KNOWN * off[view].numel():
                continue
            if float((shown - shown.median()).abs().mean()) <= LARGEST_ERROR:
                taken.append(view)
        return torch.tensor(taken, dtype=torch.long)

    def save(self, path: Path, *, origin: str = "") -> None:
        """Write one safetensors file.

        Args:
            path: the file.
            origin: what the examples were made from, read by `made_from`.
        """
        save_safetensors(path, dict(vars(self)), {"origin": origin})

    @classmethod
    def load(cls, path: Path) -> HiddenDepthExamples:
        """Read what `save` wrote.

        Raises:
            WeightsError: when the file holds no examples.
        """
        try:
            return cls(**load_safetensors(path))
        except (OSError, RuntimeError, ValueError, TypeError) as error:
            raise WeightsError(f"{path}: no views with hidden depth ({reason_of(error)})") from error


def _true_depths_mm(
    z_depth_mm: Callable[[Cameras], Float[np.ndarray, "h w"]], cameras: Cameras
) -> Float[np.ndarray, "v h w"]:
    found = np.stack([z_depth_mm(cameras[view]) for view in range(len(cameras))])
    return np.where(np.isfinite(found), found, 0).astype(np.float32)
