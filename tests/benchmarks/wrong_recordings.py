"""Recordings as a sensor, a tracker, a calibration or a recorder get them wrong, by known amounts."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import cv2
import numpy as np
from scipy.spatial.transform import Rotation

from extrags.cameras import pixel_rays
from extrags.carried_depth import Correction
from extrags.sequence import EndoscopicSequence

__all__ = ["OTHERWISE_RECORDED", "WRONG", "distorted", "with_instrument"]

Sequence = EndoscopicSequence

GAMMA = 2.2


def _depths(sequence: Sequence, changed: Callable[[int, np.ndarray], np.ndarray]) -> Sequence:
    assert sequence.depth_mm is not None
    depth = [np.where(d > 0, changed(k, d), 0) for k, d in enumerate(sequence.depth_mm)]
    return replace(sequence, depth_mm=np.stack(depth).astype(np.float32))


def _smooth(frame: int, depth: np.ndarray, share: float = 0.05) -> np.ndarray:
    noise = np.random.default_rng([500, frame]).normal(size=depth.shape)
    field = cv2.GaussianBlur(noise, (0, 0), 0.2 * depth.shape[1])
    return np.asarray(depth * np.exp(share * field / field.std()))


def _monocular(frame: int, depth: np.ndarray) -> np.ndarray:
    scale, shift = np.random.default_rng([501, frame]).normal(scale=0.05, size=2)
    inverse = 1 / np.maximum(depth, 1e-6)
    moved = np.exp(scale) * inverse + shift * np.median(inverse[depth > 0])
    return _smooth(frame, 1 / np.maximum(moved, 0.05 * inverse))


def _of_frames(frame: int, depth: np.ndarray) -> np.ndarray:
    return np.asarray(depth * np.exp(0.05 * np.random.default_rng([502, frame]).normal()))


def _noisy(frame: int, depth: np.ndarray) -> np.ndarray:
    return np.asarray(
        depth * np.exp(np.random.default_rng([503, frame]).normal(scale=0.05, size=depth.shape))
    )


def _speckled(frame: int, depth: np.ndarray) -> np.ndarray:
    generator = np.random.default_rng([504, frame])
    anything = generator.uniform(0.2, 2.5, depth.shape) * np.median(depth[depth > 0])
    return np.where(generator.random(depth.shape) < 0.1, anything, depth)


def _blurred(frame: int, depth: np.ndarray) -> np.ndarray:
    """Its edges are blurred, by 1 px of a picture of 160 px."""
    return np.asarray(cv2.GaussianBlur(depth, (0, 0), depth.shape[1] / 160))


def _enlarged(frame: int, depth: np.ndarray) -> np.ndarray:
    """As of a picture of a quarter of the size that was enlarged with interpolation."""
    size = depth.shape[::-1]
    small = cv2.resize(depth, (size[0] // 4, size[1] // 4), interpolation=cv2.INTER_NEAREST)
    return np.asarray(cv2.resize(small, size, interpolation=cv2.INTER_LINEAR))


def _along_ray(sequence: Sequence) -> Sequence:
    lengths = np.linalg.norm(pixel_rays(sequence.cameras), axis=-1)
    return _depths(sequence, lambda frame, depth: depth * lengths[frame])


def _lens(sequence: Sequence, focal: float = 1.0, shift_px: tuple[float, float] = (0.0, 0.0)) -> Sequence:
    K = sequence.K.copy()
    K[:, :2, :2] *= focal
    K[:, :2, 2] += shift_px
    return replace(sequence, K=K)


def distorted(sequence: Sequence, coefficients: tuple[float, float] = (-0.08, 0.0)) -> Sequence:
    """All frames as a lens of this k1 and k2 records them, though it is said to be a pinhole."""
    assert sequence.depth_mm is not None
    v, u = np.mgrid[: sequence.height, : sequence.width] + 0.5
    rgb, depth, mask = (np.array(part) for part in (sequence.rgb, sequence.depth_mm, sequence.mask))
    for k, K in enumerate(sequence.K):
        seen = np.stack([(u - K[0, 2]) / K[0, 0], (v - K[1, 2]) / K[1, 1]], axis=-1)
        rays = cv2.undistortPoints(seen.reshape(-1, 1, 2), np.eye(3), np.array([*coefficients, 0, 0]))
        x, y = (
            (rays.reshape(seen.shape) * K[[0, 1], [0, 1]] + K[:2, 2] - 0.5)
            .astype(np.float32)
            .transpose(2, 0, 1)
        )
        inside = (x >= 0) & (y >= 0) & (x <= sequence.width - 1) & (y <= sequence.height - 1)
        known = (depth[k] > 0).astype(np.float32)
        inverse = cv2.remap(1 / np.maximum(depth[k], 1e-6) * known, x, y, cv2.INTER_LINEAR)
        inside &= cv2.remap(mask[k].astype(np.uint8), x, y, cv2.INTER_NEAREST) > 0
        known = inside & (cv2.remap(known, x, y, cv2.INTER_LINEAR) > 0.999)
        depth[k] = np.where(known, 1 / np.maximum(inverse, 1e-6), 0)
        rgb[k], mask[k] = cv2.remap(rgb[k], x, y, cv2.INTER_CUBIC), inside
    return replace(sequence, rgb=rgb, depth_mm=depth, mask=mask)


def _late(sequence: Sequence) -> Sequence:
    """Each frame has the pose of the next one."""
    poses = Correction(time=1.0).of_poses(sequence.cameras.world_from_camera, sequence.recording)
    return replace(sequence, world_from_camera=poses)


def _hand_eye(sequence: Sequence) -> Sequence:
    further = np.eye(4)
    further[:3, 3] = 1.6, -1.2, 0.0
    return replace(sequence, world_from_camera=sequence.cameras.world_from_camera @ further)


def _developed(sequence: Sequence, changed: Callable[[int, np.ndarray], np.ndarray]) -> Sequence:
    """With the linear light of training frames changed; in the order of the recording."""
    rgb = np.array(sequence.rgb)
    for place, frame in enumerate(np.sort(sequence.train).tolist()):
        light = changed(place, (rgb[frame] / 255.0) ** GAMMA)
        rgb[frame] = np.rint(255 * light.clip(0, 1) ** (1 / GAMMA))
    return replace(sequence, rgb=rgb)


def _white_balance(place: int, light: np.ndarray) -> np.ndarray:
    red, blue = np.exp(0.15 * np.random.default_rng([505, place]).normal(size=2))
    return np.asarray(light * [red, 1.0, blue])


def _haze(count: int) -> Callable[[int, np.ndarray], np.ndarray]:
    """Smoke or a fogged lens in the middle third: it takes a third of the light and scatters its own."""
    return lambda place, light: 0.65 * light + 0.1 if place * 3 // count == 1 else light


def _narrow_band(count: int) -> Callable[[int, np.ndarray], np.ndarray]:
    """Light of narrow bands in the middle third: green for red, and blue for both others."""
    mixing = np.array([[0.04, 0.60, 0.04], [0.02, 0.20, 0.40], [0.02, 0.24, 0.42]])
    return lambda place, light: light @ mixing.T if place * 3 // count == 1 else light


def _blank(sequence: Sequence) -> Sequence:
    rgb = np.array(sequence.rgb)
    rgb[np.sort(sequence.train)[4::8]] = 0
    return replace(sequence, rgb=rgb)


def _misplaced(sequence: Sequence) -> Sequence:
    poses, generator = sequence.cameras.world_from_camera.copy(), np.random.default_rng(3)
    for frame in np.sort(sequence.train)[5::10]:
        turn, shift = (axis / np.linalg.norm(axis) for axis in generator.normal(size=(2, 3)))
        poses[frame, :3, :3] = poses[frame, :3, :3] @ Rotation.from_rotvec(np.radians(5) * turn).as_matrix()
        poses[frame, :3, 3] += 5 * shift
    return replace(sequence, world_from_camera=poses)


def with_instrument(
    sequence: Sequence, every: int = 3, near: float = 0.35, width_share: float = 0.09
) -> tuple[Sequence, np.ndarray]:
    """An instrument from the lower right into the middle of each so many training frames, and its pixels.

    Args:
        sequence: with depth.
        every: 1 is in all training frames.
        near: its depth, as a share of the frame's median.
        width_share: of it, of the image's width.
    """
    assert sequence.depth_mm is not None
    generator = np.random.default_rng(506)
    rgb, depth = np.array(sequence.rgb), np.array(sequence.depth_mm)
    shown = np.zeros(depth.shape, bool)
    size = np.array([sequence.width, sequence.height])
    for frame in np.sort(sequence.train)[::every].tolist():
        tip, end = (size * generator.uniform(*span) for span in ((0.35, 0.65), ((1.05, 0.7), (1.06, 1.1))))
        drawn = np.zeros(depth[frame].shape, np.uint8)
        thickness = max(1, round(width_share * sequence.width))
        cv2.line(drawn, [int(x) for x in tip], [int(x) for x in end], 1, thickness)
        z = near * np.median(depth[frame][depth[frame] > 0])
        shown[frame] = (drawn > 0) & (depth[frame] > z)
        depth[frame][shown[frame]] = z
        rgb[frame][shown[frame]] = generator.uniform(60, 120)
    return replace(sequence, rgb=rgb, depth_mm=depth), shown


WRONG: dict[str, Callable[[Sequence], Sequence]] = {
    "smooth": lambda sequence: _depths(sequence, _smooth),
    "frames": lambda sequence: _depths(sequence, _of_frames),
    "monocular": lambda sequence: _depths(sequence, _monocular),
    "noise": lambda sequence: _depths(sequence, _noisy),
    "speckles": lambda sequence: _depths(sequence, _speckled),
    "blurred edges": lambda sequence: _depths(sequence, _blurred),
    "enlarged": lambda sequence: _depths(sequence, _enlarged),
    "unit": lambda sequence: _depths(sequence, lambda _, depth: 1.1 * depth),
    "offset": lambda sequence: _depths(sequence, lambda _, depth: depth + 2),
    "ray": _along_ray,
    "focal": lambda sequence: _lens(sequence, 1.05),
    "principal": lambda sequence: _lens(sequence, shift_px=(1.6, 1.2)),
    "distorted": distorted,
    "delay": _late,
    "hand-eye": _hand_eye,
    "white balance": lambda sequence: _developed(sequence, _white_balance),
    "haze": lambda sequence: _developed(sequence, _haze(len(sequence.train))),
    "narrow band": lambda sequence: _developed(sequence, _narrow_band(len(sequence.train))),
    "blank": _blank,
    "misplaced": _misplaced,
    "instrument": lambda sequence: with_instrument(sequence)[0],
    "instruments": lambda sequence: with_instrument(sequence, every=1)[0],
}
"""What is wrong, by its name on the command line."""

OTHERWISE_RECORDED = ("distorted",)
"""Those whose frames show other rays than the right ones: they are measured against themselves."""
