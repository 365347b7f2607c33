"""Pretraining data: renderings of views far off the trajectory, paired with the truth.

A pretraining recording is spoilt (`Degradation`) and reconstructed like any other; then clips of views
far from all training frames are rendered, whose true images are known. The pairs of a scene, its light, the
clips' cameras and some training frames are one safetensors file.
"""

from __future__ import annotations

import json
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Bool, Float, Int, UInt8
from torch.nn import functional

from extrags.array_files import save_safetensors
from extrags.cameras import Cameras
from extrags.config import PipelineConfig
from extrags.errors import ShapeError, WeightsError, reason_of
from extrags.illumination import NearFieldLight
from extrags.restoration.surface_texture import SurfaceTexture
from extrags.restoration.training_data.augmentation import unconfirmed
from extrags.restoration.training_data.degradation import Degradation
from extrags.restoration.training_data.explored_views import explored_cameras
from extrags.restoration.training_data.pairs import Pairs, pair_views
from extrags.restoration.training_data.recordings import PretrainingRecording
from extrags.sequence import EndoscopicSequence
from extrags.training.reconstruction import reconstruct
from extrags.view_synthesis.conditioning import Layers, observe_views
from extrags.view_synthesis.gather import gather_references
from extrags.view_synthesis.invented import InventedViews, with_invented
from extrags.view_synthesis.references import LightTransfer

__all__ = ["PretrainingScene", "ReferenceFrames", "make_pretraining_scene"]

PRETRAINING_DATA_VERSION = 12
"""Raised by hand whenever the same scene and settings give other pairs, or files hold something else."""
REFERENCE_FRAMES = 24
"""Training frames at most that are kept with the pairs."""
EVERY_EXPLORED = 4
"""Of a trajectory, one of so many virtual views is paired: rather more scenes than more views of one."""
FOLLOWING_SHARE = 0.6
"""Share of the clips that are shown what other views have invented."""
OTHER_KEYFRAMES = 2
"""Views of other clips among them; one more is of the same clip."""
DEPTH_WAVES = 0.06
"""Largest deviation of the smooth errors of the depth that keyframes are given: they have to restore it."""


@dataclass(frozen=True)
class ReferenceFrames:
    """Some training frames, evenly spread, as the reconstruction was given them.

    Args:
        rgb: [R, H, W, 3].
        mask: true where a pixel shows tissue.
        cameras: with the errors of pose that the reconstruction suffered from.
    """

    rgb: UInt8[np.ndarray, "r h w 3"]
    mask: Bool[np.ndarray, "r h w"]
    cameras: Cameras

    @property
    def images(self) -> Float[torch.Tensor, "r 3 h w"]:
        """Colours in [0, 1], in half precision."""
        return torch.from_numpy(self.rgb).permute(0, 3, 1, 2).half() / 255

    @property
    def valid(self) -> Bool[torch.Tensor, "r h w"]:
        """`mask` as a tensor."""
        return torch.from_numpy(self.mask)

    def __post_init__(self) -> None:
        count, height, width = self.mask.shape
        if self.rgb.shape != (count, height, width, 3) or len(self.cameras) != count:
            raise ShapeError(
                f"reference frames: {self.rgb.shape} pictures, {self.mask.shape} masks and "
                f"{len(self.cameras)} cameras do not fit"
            )


@dataclass(frozen=True)
class PretrainingScene:
    """Pairs of one scene.

    Args:
        pairs: renderings with the truth; none is for validation.
        transfer: how brightness changes with distance in this scene.
        clip: which clip each pair belongs to; the views of a clip follow each other.
        cameras: of the pairs.
        references: some training frames.
        texture: tiles cut out of the training frames; None where no frame shows the surface closely enough.
    """

    pairs: Pairs
    transfer: LightTransfer
    clip: Int[np.ndarray, "p"]
    cameras: Cameras
    references: ReferenceFrames
    texture: SurfaceTexture | None = None

    def __post_init__(self) -> None:
        if not len(self.pairs) == len(self.clip) == len(self.cameras):
            raise ShapeError(
                f"{len(self.pairs)} pairs, {len(self.clip)} clip numbers and {len(self.cameras)} cameras"
            )

    def save(self, path: Path, *, origin: str = "") -> None:
        """Write one safetensors file: colours and layers in half precision.

        Args:
            path: the file.
            origin: what the scene was made from, read by `made_from`.
        """
        light = self.transfer.light
        tensors = {
            "layers": self.pairs.layers.data.half(),
            "target": (self.pairs.target * 255).round().to(torch.uint8),
            "weight": self.pairs.weight.to(torch.uint8),
            "depth_mm": self.pairs.depth_mm.half(),
            "frame": torch.from_numpy(np.asarray(self.pairs.frame, dtype=np.int64)),
            "clip": torch.from_numpy(np.asarray(self.clip, dtype=np.int64)),
            **_camera_tensors("camera", self.cameras),
            "reference.rgb": torch.from_numpy(self.references.rgb),
            "reference.mask": torch.from_numpy(self.references.mask.astype(np.uint8)),
            **_camera_tensors("reference", self.references.cameras),
        }
        if light is not None:
            tensors.update(
                {f"light.{name}": value.detach().clone() for name, value in light.parameters().items()}
            )
        if self.texture is not None:
            tensors["texture.tiles"] = self.texture.tiles.half()
        scales = {
            "exponent": self.transfer.exponent,
            "scale_mm": self.transfer.scale_mm,
            "reference_distance": None if light is None else light.reference_distance,
            "texel_mm": None if self.texture is None else self.texture.texel_mm,
        }
        about = {"scales": json.dumps(scales), "origin": origin, "version": str(PRETRAINING_DATA_VERSION)}
        save_safetensors(path, tensors, about)

    @staticmethod
    def made_from(path: Path) -> str | None:
        """The `origin` a file was saved with; None where there is no such file."""
        from safetensors import SafetensorError, safe_open

        try:
            with safe_open(str(path), "pt") as file:
                return str((file.metadata() or {}).get("origin", ""))
        except (OSError, SafetensorError):
            return None

    @staticmethod
    def size_of(path: Path) -> tuple[int, int]:
        """Height and width in pixels of a file's images; nothing but its header is read.

        Raises:
            WeightsError: when the file holds no pretraining scene.
        """
        from safetensors import SafetensorError, safe_open

        try:
            with safe_open(str(path), "pt") as file:
                height, width = file.get_slice("target").get_shape()[-2:]
        except (OSError, SafetensorError, ValueError) as error:
            raise WeightsError(
                f"{path}: not the pairs of a pretraining scene ({reason_of(error)})"
            ) from error
        return int(height), int(width)

    @classmethod
    def load(cls, path: Path) -> PretrainingScene:
        """Read what `save` wrote.

        Raises:
            WeightsError: when the file holds no pretraining scene, or one of another version.
        """
        from safetensors import SafetensorError, safe_open

        try:
            with safe_open(str(path), "pt") as file:
                metadata = file.metadata() or {}
                version = metadata.get("version", "1")
                if "scales" in metadata and version != str(PRETRAINING_DATA_VERSION):
                    raise WeightsError(
                        f"{path}: pretraining data of version {version}, expected "
                        f"{PRETRAINING_DATA_VERSION}; make the scene again"
                    )
                tensors = {name: file.get_tensor(name) for name in file.keys()}  # noqa: SIM118
            scales = json.loads(metadata["scales"])
            light = None
            if scales["reference_distance"] is not None:
                values = {k.removeprefix("light."): v for k, v in tensors.items() if k.startswith("light.")}
                light = NearFieldLight(**values, reference_distance=scales["reference_distance"])
            transfer = LightTransfer(light, scales["exponent"], scales["scale_mm"])
            count = len(tensors["frame"])
            pairs = Pairs(
                Layers(tensors["layers"].float()),
                tensors["target"].float() / 255,
                tensors["weight"].float(),
                tensors["depth_mm"].float(),
                tensors["frame"].numpy(),
                np.zeros(count, dtype=bool),
                np.zeros(count, dtype=bool),
            )
            references = ReferenceFrames(
                tensors["reference.rgb"].numpy(),
                tensors["reference.mask"].numpy().astype(bool),
                _read_cameras("reference", tensors, pairs.size),
            )
            cameras = _read_cameras("camera", tensors, pairs.size)
            texture = None
            if scales["texel_mm"] is not None:
                texture = SurfaceTexture(tensors["texture.tiles"].float(), float(scales["texel_mm"]))
            return cls(pairs, transfer, tensors["clip"].numpy(), cameras, references, texture)
        except WeightsError:
            raise
        except (OSError, SafetensorError, KeyError, ValueError, TypeError, ShapeError) as error:
            raise WeightsError(
                f"{path}: not the pairs of a pretraining scene ({reason_of(error)})"
            ) from error


def make_pretraining_scene(
    recording: PretrainingRecording,
    config: PipelineConfig,
    seed: int,
    *,
    explored: bool = False,
    exact_share: float = 0.0,
) -> PretrainingScene:
    """Spoil and reconstruct a recording, and pair the views to restore with the truth.

    Args:
        recording: made for pretraining.
        config: settings of a run; steps, number of Gaussians and light model are drawn.
        seed: of the draws and of the reconstruction.
        explored: whether there are also the virtual views of the trajectories that the explorer chooses,
            some of each; each trajectory is a clip.
        exact_share: as `Degradation.random` takes it.

    Raises:
        DivergedError: when the reconstruction does not stay finite.
    """
    generator = np.random.default_rng([seed, 5])
    degradation = Degradation.random(generator, exact_share=exact_share)
    sequence = degradation.applied(recording.sequence, generator)
    settings = degradation.settings(config.coarse, seed)
    scene = reconstruct(sequence.training_part(), settings, stage="pretraining-scene").scene
    recording = replace(recording, sequence=sequence)
    if explored and (
        virtual := explored_cameras(scene, sequence.training_part(), config, every=EVERY_EXPLORED)
    ):
        recording = recording.with_views(virtual)
        sequence = recording.sequence
    references = gather_references(scene, sequence, sequence.train)
    frames = np.asarray(sequence.test, dtype=np.int64)
    observation = observe_views(scene, references, sequence.cameras[frames], count=config.enhance.references)
    pairs = pair_views(sequence, observation.layers, frames, synthetic=False)
    pairs.validation[:] = False
    clip = np.asarray(recording.clip, dtype=np.int64)
    layers = _with_keyframes(pairs, clip, sequence.cameras[frames], references.transfer, generator)
    pairs = replace(pairs, layers=layers)
    return PretrainingScene(
        pairs,
        references.transfer,
        clip,
        sequence.cameras[frames],
        _reference_frames(sequence),
        SurfaceTexture.of_references(references),
    )


def _with_keyframes(
    pairs: Pairs,
    clip: Int[np.ndarray, "p"],
    cameras: Cameras,
    transfer: LightTransfer,
    generator: np.random.Generator,
) -> Layers:
    """Layers in which most clips are shown other views where nothing else knows the surface.

    What such a keyframe shows is the truth, at a depth with smooth errors: the network learns to follow what
    was invented before, and to mend what was carried to a wrong place.
    """
    layers = Layers(pairs.layers.data.clone())
    unknown = unconfirmed(layers)
    for number in np.unique(clip):
        own, others = np.flatnonzero(clip == number), np.flatnonzero(clip != number)
        if generator.random() > FOLLOWING_SHARE or len(own) < 2:
            continue
        first = int(generator.choice(own))
        chosen = np.append(generator.permutation(others)[:OTHER_KEYFRAMES], first)
        index = torch.from_numpy(chosen)
        depth = pairs.depth_mm[index]
        usable = (depth > 0).float()
        cells = generator.uniform(-DEPTH_WAVES, DEPTH_WAVES, (len(chosen), 1, 3, 4)).astype(np.float32)
        depth = depth * functional.interpolate(torch.from_numpy(cells), pairs.size, mode="bilinear").exp()
        filled = torch.where(usable > 0, depth, torch.full_like(depth, transfer.scale_mm))
        invented = InventedViews.of_views(
            cameras[chosen],
            pairs.target[index],
            filled,
            unknown[index] * pairs.weight[index] * usable,
            torch.ones(len(chosen)),
            transfer,
        )
        # Not the keyframe itself: it would be shown the answer.
        following = own[own != first]
        shown = with_invented(layers[following], invented, cameras[following], None)
        layers.data[torch.from_numpy(following)] = shown.data
    return layers


def _reference_frames(sequence: EndoscopicSequence) -> ReferenceFrames:
    train = np.asarray(sequence.train, dtype=np.int64)
    count = min(len(train), REFERENCE_FRAMES)
    chosen = train[np.linspace(0, len(train) - 1, count).round().astype(np.int64)]
    return ReferenceFrames(
        np.ascontiguousarray(sequence.rgb[chosen]),
        np.ascontiguousarray(sequence.mask[chosen]),
        sequence.cameras[chosen],
    )


def _camera_tensors(name: str, cameras: Cameras) -> dict[str, torch.Tensor]:
    def tensor(values: Float[np.ndarray, "*n"]) -> torch.Tensor:
        # A copy: safetensors refuses tensors that share memory.
        return torch.from_numpy(np.array(values, dtype=np.float64))

    return {
        f"{name}.K": tensor(cameras.K),
        f"{name}.world_from_camera": tensor(cameras.world_from_camera),
    }


def _read_cameras(name: str, tensors: dict[str, torch.Tensor], size: tuple[int, int]) -> Cameras:
    height, width = size
    return Cameras(tensors[f"{name}.K"].numpy(), tensors[f"{name}.world_from_camera"].numpy(), width, height)
