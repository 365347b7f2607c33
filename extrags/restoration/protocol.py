"""The protocols of the restoration: `Enhancer` restores clips, `Backend` makes and loads enhancers."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, Protocol, runtime_checkable

import numpy as np
from jaxtyping import Float, Int

from extrags.cameras import Cameras
from extrags.config import CoarseConfig, EnhanceConfig
from extrags.errors import NonFiniteError, ShapeError
from extrags.scene import Scene
from extrags.sequence import EndoscopicSequence
from extrags.view_synthesis.conditioning import Layers
from extrags.view_synthesis.references import LightTransfer

__all__ = [
    "Backend",
    "Clip",
    "Enhancer",
    "Restoration",
    "among_kept",
    "keeps_known",
    "never_trained_on",
    "restore_clip",
    "restore_clips",
]

COLOR_ROUNDING = 1e-4
"""By so much colours may lie outside [0, 1]: half precision, and interpolation, round."""


@dataclass(frozen=True)
class Clip:
    """T views of one trajectory, rendered and ready to be restored.

    Args:
        index: of the clip in the scene; its noise is drawn from it.
        cameras: the views, [T].
        layers: renderings and warped real views of them, [T].
        transfer: how brightness changes with distance in this scene.
        reference: position among the training frames of the one that sees most of the same surface, [T].
        image_confidence: U_img of each view, [T].
        exposure: gain of each view; None is 1, the mean of the training frames, [T].

    Raises:
        ShapeError: when the numbers of views differ.
    """

    index: int
    cameras: Cameras
    layers: Layers
    transfer: LightTransfer
    reference: Int[np.ndarray, "t"]
    image_confidence: Float[np.ndarray, "t"]
    exposure: Float[np.ndarray, "t"] | None = None

    def __post_init__(self) -> None:
        counts = {len(self.cameras), len(self.layers), len(self.reference), len(self.image_confidence)}
        if self.exposure is not None:
            counts.add(len(self.exposure))
        if len(counts) != 1:
            raise ShapeError(f"the parts of clip {self.index} have different lengths: {sorted(counts)}")

    def __len__(self) -> int:
        return len(self.cameras)


@dataclass(frozen=True)
class Restoration:
    """Restored views of a clip.

    Args:
        rgb: in [0, 1], [T, H, W, 3].
        expected_error: expected absolute error of a pixel, mean of the channels, or None where the restorer
            predicts none, [T, H, W].
        provenance: backend, steps, seed, ...; ready for JSON.
        depth_mm: z-depth without gaps, where the restorer completes it better than smooth filling does,
            or None, [T, H, W].
    """

    rgb: Float[np.ndarray, "t h w 3"]
    expected_error: Float[np.ndarray, "t h w"] | None
    provenance: dict[str, Any] = field(default_factory=dict)
    depth_mm: Float[np.ndarray, "t h w"] | None = None


@runtime_checkable
class Enhancer(Protocol):
    """Restores renderings of one scene: removes artefacts and fills holes.

    `name` is that of the backend that loads it again. One that makes use of what keyframes have invented
    (`Layers.get("invented")`, folded into the base image of `condition`) says so by a further attribute
    `follows_keyframes = True`; without it there are no keyframes. One that was trained on frames of the scene
    keeps what it was before as `untrained`: trials on left-out frames restore with that (`never_trained_on`).
    One whose views are the base image of `condition` wherever that is certain says `keeps_known = True`:
    held-out views then stay as the scene renders them there, and no network refines them.
    """

    @property
    def name(self) -> str: ...  # noqa: D102

    def restore(self, clip: Clip) -> Restoration:
        """Restore all views of a clip; the same clip always gives the same result."""
        ...

    def save(self, path: Path) -> None:
        """Write a folder that the backend's `load` reads.

        It holds a `restorer.json` with an entry `backend`: see
        `extrags.restoration.description.write_description`.
        """
        ...


def keeps_known(enhancer: Enhancer) -> bool:
    """Whether restored views are the base image wherever that is certain; see `Enhancer`."""
    return bool(getattr(enhancer, "keeps_known", False))


def never_trained_on(enhancer: Enhancer) -> Enhancer:
    """What restores in trials on frames of the scene, whose targets an enhancer may have been trained on.

    Args:
        enhancer: of the scene.

    Returns:
        Its `untrained`; itself where it has none.
    """
    untrained: Enhancer | None = getattr(enhancer, "untrained", None)
    return enhancer if untrained is None else untrained


@dataclass(frozen=True)
class _AmongKept:
    """A restorer whose clips count their references among some of the frames that it was made from."""

    enhancer: Enhancer
    kept: Int[np.ndarray, "k"]

    @property
    def name(self) -> str:
        return self.enhancer.name

    @property
    def follows_keyframes(self) -> bool:
        return bool(getattr(self.enhancer, "follows_keyframes", False))

    @property
    def keeps_known(self) -> bool:
        return keeps_known(self.enhancer)

    def restore(self, clip: Clip) -> Restoration:
        return self.enhancer.restore(replace(clip, reference=self.kept[clip.reference]))

    def save(self, path: Path) -> None:
        self.enhancer.save(path)


def among_kept(enhancer: Enhancer, kept: Int[np.ndarray, "k"]) -> Enhancer:
    """The restorer for a trial that leaves out some of the training frames it was made from.

    A restorer that keeps real views of its own finds them by `Clip.reference`, which in a trial is a position
    among the frames that are kept: taken for one among all of them, it would name another frame, and perhaps
    one that is left out.

    Args:
        enhancer: of the scene.
        kept: positions, among the training frames of the scene, of those of the trial.
    """
    return _AmongKept(enhancer, kept)


@runtime_checkable
class Backend(Protocol):
    """A kind of restorer: checks its settings, makes the enhancer of a scene, and loads a saved one.

    Entered in `extrags.config.backends.BACKENDS`, or registered by
    `extrags.restoration.backends.register_backend`. A backend holds no state: everything comes from the
    settings.
    """

    @property
    def name(self) -> str: ...  # noqa: D102

    def check(self, config: EnhanceConfig) -> None:
        """Look for everything that is needed besides the scene, before a run begins.

        Args:
            config: settings with this backend.

        Raises:
            ExtragsError: when a setting, a package or a file is missing or wrong; says what to do.
        """
        ...

    def digest(self, config: EnhanceConfig) -> str | None:
        """Digest of the pretrained model: weights and code, but not where they are stored.

        It is part of the key of a scene's restorer: another digest makes another restorer.
        An enhancer that does not save all it restores with saves this digest, so that cached views follow it.

        Returns:
            None without a pretrained model.

        Raises:
            ExtragsError: when the model is not there.
        """
        ...

    def needs_text(self, config: EnhanceConfig) -> bool:
        """Whether a caption of the scene is used; its source is then checked and part of the digest."""
        ...

    def prepare(
        self, scene: Scene, sequence: EndoscopicSequence, config: EnhanceConfig, coarse: CoarseConfig
    ) -> Enhancer:
        """Make the enhancer of a scene.

        Args:
            scene: the coarse scene, trained on `sequence.train`.
            sequence: posed frames; only training frames are used.
            config: settings with this backend.
            coarse: settings for further reconstructions of the scene.

        Raises:
            ExtragsError: when it cannot be made.
        """
        ...

    def load(self, path: Path) -> Enhancer:
        """Read an enhancer that its `save` wrote.

        Raises:
            WeightsError: when a file is missing, damaged, or of another version; names the file.
        """
        ...


def restore_clip(enhancer: Enhancer, clip: Clip) -> Restoration:
    """Restore a clip, and hold the restorer to what `Restoration` promises.

    What comes back may be of another program: stored in steps of 1/255, a NaN would be black.

    Raises:
        ShapeError: when there is no restoration, or an array of it has another shape, is not of floats or is
            out of range.
        NonFiniteError: when an array of it holds NaN or infinity.
    """
    restoration = enhancer.restore(clip)
    name = f"the restorer {enhancer.name!r}, clip {clip.index}"
    if not isinstance(restoration, Restoration):
        raise ShapeError(f"{name}: expected a Restoration, found {type(restoration).__name__}")
    planes = (len(clip), clip.cameras.height, clip.cameras.width)
    _check_array(f"{name}: rgb", restoration.rgb, (*planes, 3), (-COLOR_ROUNDING, 1 + COLOR_ROUNDING))
    if restoration.expected_error is not None:
        _check_array(f"{name}: expected_error", restoration.expected_error, planes, (0.0, np.inf))
    if restoration.depth_mm is not None:
        _check_array(f"{name}: depth_mm", restoration.depth_mm, planes, (0.0, np.inf))
    return restoration


def restore_clips(enhancer: Enhancer, clips: Iterable[Clip]) -> list[Restoration]:
    """Restore clips one after the other; each is independent of the others.

    Raises:
        ExtragsError: as `restore_clip`.
    """
    return [restore_clip(enhancer, clip) for clip in clips]


def _check_array(name: str, values: object, shape: tuple[int, ...], limits: tuple[float, float]) -> None:
    if not isinstance(values, np.ndarray) or not np.issubdtype(values.dtype, np.floating):
        found = values.dtype if isinstance(values, np.ndarray) else type(values).__name__
        raise ShapeError(f"{name} has to be a NumPy array of floats, found {found}")
    if values.shape != shape:
        raise ShapeError(f"{name} has to have the shape {shape}, found {values.shape}")
    if not np.isfinite(values).all():
        raise NonFiniteError(f"{name} holds NaN or infinity")
    least, most = float(values.min()), float(values.max())
    if least < limits[0] or most > limits[1]:
        wanted = "non-negative" if np.isinf(limits[1]) else "in [0, 1]"
        raise ShapeError(f"{name} has to be {wanted}, found {least:.4g} to {most:.4g}")
