"""What is wrong with a recording that is to be reconstructed: poses, depth, budget, light model.

The reconstruction is real; only what it is given is spoilt as real inputs are.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Literal

import numpy as np
from jaxtyping import Float

from extrags.cameras import rotation_about
from extrags.config import CoarseConfig
from extrags.sequence import EndoscopicSequence

__all__ = ["Degradation", "DepthFlaw"]

DepthFlaw = Literal["exact", "noisy", "waves", "missing"]
"""noisy: a few percent of smooth and of white noise; waves: smooth factors as monocular depth has them, up to
15 percent; missing: some frames have none, the others are noisy."""

ITERATIONS = (300, 2500)
"""Range of the random number of iterations, even in logarithm, so that renderings of different quality
occur."""
GAUSSIANS = (0.35, 1.0)
"""Range of the random share of the starting points and of the limit on Gaussians."""
_FLAWS: dict[DepthFlaw, float] = {"exact": 0.3, "noisy": 0.25, "waves": 0.3, "missing": 0.15}
_EXACT_POSES, _WITH_LIGHT = 0.5, 0.75
_POSE_MM, _POSE_DEG = 0.5, 0.5
_NOISE, _WAVES = 0.03, 0.15
_CLIPPED = 2.0


@dataclass(frozen=True)
class Degradation:
    """How a recording is spoilt and reconstructed.

    Args:
        iterations: of the reconstruction.
        gaussians_share: of the starting points and of the limit on Gaussians.
        light: whether the reconstruction has a light model.
        pose_mm: largest error of a camera's centre.
        pose_deg: largest error of its orientation.
        depth: what is wrong with depth.
        depth_error: largest relative error of depth, apart from white noise.
        missing_share: of the frames, those without depth.
    """

    iterations: int
    gaussians_share: float
    light: bool
    pose_mm: float
    pose_deg: float
    depth: DepthFlaw
    depth_error: float
    missing_share: float

    @classmethod
    def random(cls, generator: np.random.Generator, *, exact_share: float = 0.0) -> Degradation:
        """A degradation, drawn; its flaws fall independently.

        Args:
            generator: draws it.
            exact_share: how often, beyond chance, poses and depth are exact and light is modelled; steps and
                number of Gaussians are drawn all the same.
        """
        share = float(generator.uniform(*GAUSSIANS))
        iterations = int(np.exp(generator.uniform(*np.log(ITERATIONS))))
        light = bool(generator.random() < _WITH_LIGHT)
        noisy = generator.random() >= _EXACT_POSES
        pose_mm, pose_deg = generator.uniform(0, (_POSE_MM, _POSE_DEG)) * noisy
        names = list(_FLAWS)
        flaw = names[int(generator.choice(len(names), p=list(_FLAWS.values())))]
        largest = {"exact": 0.0, "noisy": _NOISE, "waves": _WAVES, "missing": _NOISE}[flaw]
        degradation = cls(
            iterations,
            share,
            light,
            float(pose_mm),
            float(pose_deg),
            flaw,
            float(generator.uniform(0.2, 1.0) * largest),
            float(generator.uniform(0.3, 0.8)) if flaw == "missing" else 0.0,
        )
        # Without a share nothing is drawn: scenes that were made before stay what they are.
        if exact_share > 0 and generator.random() < exact_share:
            return cls(iterations, share, True, 0.0, 0.0, "exact", 0.0, 0.0)
        return degradation

    def settings(self, coarse: CoarseConfig, seed: int) -> CoarseConfig:
        """Settings of the reconstruction: steps, number of Gaussians and light model of this degradation."""
        densify = {"max_gaussians": round(self.gaussians_share * coarse.densify.max_gaussians)}
        return coarse.model_copy(
            update={
                "iterations": self.iterations,
                "sh_every": max(1, self.iterations // 4),
                # Sides are for evaluation alone.
                "one_sided": False,
                # Poses that were spoilt on purpose stay so.
                "refine_poses": False,
                "max_points": round(self.gaussians_share * coarse.max_points),
                "densify": coarse.densify.model_copy(update=densify),
                # And so do colours.
                "light": coarse.light.model_copy(update={"enabled": self.light, "frame_colors": False}),
                "seed": seed,
            }
        )

    def applied(self, sequence: EndoscopicSequence, generator: np.random.Generator) -> EndoscopicSequence:
        """The recording with spoilt poses and depth of its training frames; held-out frames stay exact.

        Args:
            sequence: with poses and depth.
            generator: draws the errors.
        """
        train = np.asarray(sequence.train)
        poses, depth = sequence.world_from_camera, sequence.depth_mm
        if poses is not None and (self.pose_mm > 0 or self.pose_deg > 0):
            poses = poses.copy()
            for frame in train:
                poses[frame] = _moved(poses[frame], self.pose_mm, self.pose_deg, generator)
        if depth is not None and self.depth != "exact":
            depth = depth.copy()
            for frame in train:
                depth[frame] *= self._factors(depth.shape[1:], generator)
            without = round(self.missing_share * len(train))
            # Two frames keep theirs: something must say how far away the wall is.
            chosen = generator.permutation(train)[: max(0, min(without, len(train) - 2))]
            depth[chosen] = 0
        return replace(sequence, world_from_camera=poses, depth_mm=depth)

    def _factors(self, shape: tuple[int, ...], generator: np.random.Generator) -> Float[np.ndarray, "h w"]:
        import cv2

        height, width = shape
        cells = (3, 4) if self.depth == "waves" else (7, 9)
        coarse = np.clip(generator.standard_normal(cells) / _CLIPPED, -1, 1).astype(np.float32)
        waves = cv2.resize(coarse, (width, height), interpolation=cv2.INTER_LINEAR)
        white = np.zeros(shape, dtype=np.float32)
        if self.depth != "waves":
            white = 0.5 * self.depth_error * generator.standard_normal(shape).astype(np.float32)
        return np.asarray(np.exp(self.depth_error * waves + white), dtype=np.float32)


def _moved(
    pose: Float[np.ndarray, "4 4"], most_mm: float, most_deg: float, generator: np.random.Generator
) -> Float[np.ndarray, "4 4"]:
    moved = pose.copy()
    direction, axis = generator.standard_normal((2, 3))
    moved[:3, 3] += direction / np.linalg.norm(direction) * most_mm * generator.uniform()
    moved[:3, :3] = pose[:3, :3] @ rotation_about(axis, np.radians(most_deg) * generator.uniform())
    return moved
