"""Procedural cavities as implicit surfaces: colons, sacs, branching airways and open fields.

They are unrelated to the phantom of the catalogue in geometry, texture and light, so that what is
trained on them can be judged on the phantom. Everything is torch, batched over scenes, for any device; a
GPU makes thousands of views a minute.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Literal

import torch
from jaxtyping import Bool, Float
from torch import Tensor

__all__ = ["KINDS", "Cavities", "Kind", "Waves"]

Kind = Literal["colon", "sac", "airways", "field"]
KINDS: tuple[Kind, ...] = ("colon", "sac", "airways", "field")


MOVING_SHARE = 0.12
"""Of the scenes, those whose tissue moves from frame to frame."""


@dataclass(frozen=True)
class Waves:
    """A random smooth function of space for each scene: a sum of plane waves.

    Args:
        wave_vectors: [C, M, 3].
        phases: [C, M].
        amplitudes: [C, M]; the function has about unit variance where their squares sum to two.
    """

    wave_vectors: Float[Tensor, "c m 3"]
    phases: Float[Tensor, "c m"]
    amplitudes: Float[Tensor, "c m"]

    @classmethod
    def random(
        cls,
        generator: torch.Generator,
        scenes: int,
        lowest: float,
        highest: float,
        *,
        waves: int = 24,
        slope: float = 1.0,
    ) -> Waves:
        """Waves with frequencies spread evenly in logarithm, amplitudes falling as frequency^-slope.

        Args:
            generator: source of randomness; its device is used.
            scenes: C.
            lowest: smallest angular frequency.
            highest: largest angular frequency.
            waves: M.
            slope: exponent of the spectrum.
        """
        device = generator.device

        def uniform(*shape: int) -> Tensor:
            return torch.rand(*shape, generator=generator, device=device)

        direction = torch.randn(scenes, waves, 3, generator=generator, device=device)
        direction = direction / direction.norm(dim=2, keepdim=True)
        frequency = lowest * (highest / lowest) ** uniform(scenes, waves)
        amplitude = frequency**-slope * (0.5 + uniform(scenes, waves))
        amplitude = amplitude * math.sqrt(2) / amplitude.square().sum(1, keepdim=True).sqrt()
        return cls(direction * frequency[:, :, None], 2 * math.pi * uniform(scenes, waves), amplitude)

    def __call__(self, points: Float[Tensor, "c n 3"]) -> Float[Tensor, "c n"]:
        """Value at points of each scene."""
        waves = torch.baddbmm(self.phases[:, None], points, self.wave_vectors.transpose(1, 2))
        return torch.bmm(torch.sin(waves), self.amplitudes[:, :, None])[:, :, 0]


class Cavities:
    """A batch of scenes of one kind; lengths are in units of a typical radius.

    Args:
        kind: what they are like.
        scenes: C, how many.
        generator: source of randomness; its device is used.

    `moment` is the time, in frames, at which all questions are answered: tissue of some scenes moves.
    """

    def __init__(self, kind: Kind, scenes: int, generator: torch.Generator) -> None:
        self.kind, self.scenes, self.device = kind, scenes, generator.device
        self.generator = generator
        c = scenes
        self.bumps = Waves.random(generator, c, 2.0, 14.0, slope=1.3)
        self.bump_height = self.uniform(0.0, 0.06, c, 1)
        self.warp = Waves.random(generator, c, 0.5, 3.0, slope=0.5, waves=12)
        self.bends = self.uniform(0.0, 0.55, c, 3, 2)
        self.bend_frequency = self.uniform(0.15, 0.8, c, 3)
        self.bend_phase = self.uniform(0.0, 2 * math.pi, c, 3, 2)
        self.flattening = self.uniform(0.0, 0.25, c, 1)
        self.triangle = self.uniform(0.0, 0.18, c, 1)
        self.twist = self.uniform(-0.6, 0.6, c, 1)
        self.angle_phase = self.uniform(0.0, 2 * math.pi, c, 3)
        self.fold_height = self.uniform(0.0, 0.6, c, 1)
        self.fold_period = self.uniform(0.5, 1.8, c, 1)
        self.fold_width = self.uniform(0.08, 0.35, c, 1)
        self.fold_wobble = self.uniform(0.0, 0.35, c, 1)
        self.axes = self.uniform(0.9, 2.2, c, 1, 3)
        self.rugae = self.uniform(0.0, 0.22, c, 1)
        self.rugae_frequency = self.uniform(4.0, 12.0, c, 1)
        self.lumps = self.uniform(-1.0, 1.0, c, 5, 3)
        self.lump_radius = self.uniform(0.08, 0.4, c, 5)
        self.branches = self._branches()
        self.relief = Waves.random(generator, c, 0.6, 3.0, slope=1.0)
        self.relief_height = self.uniform(0.05, 0.5, c, 1)
        self.distance = self.uniform(0.7, 1.8, c, 1)
        self.instruments = self._instruments()
        self.pulse = Waves.random(generator, c, 0.6, 3.0, slope=0.5, waves=8)
        moving = (self.uniform(0.0, 1.0, c, 1) < MOVING_SHARE).float()
        self.pulse_height = moving * self.uniform(0.01, 0.06, c, 1)
        self.pulse_direction = torch.nn.functional.normalize(self.uniform(-1.0, 1.0, c, 1, 3), dim=2)
        self.pulse_rate = self.uniform(0.2, 1.5, c, 1)
        self.moment = 0.0
        self.anything_moves = bool(moving.any())

    def uniform(self, low: float, high: float, *shape: int) -> Tensor:
        """Uniform random numbers of these bounds from the scenes' generator."""
        return low + (high - low) * torch.rand(*shape, generator=self.generator, device=self.device)

    def _branches(self) -> tuple[Tensor, Tensor, Tensor]:
        """Starts, unit directions and radii of four straight tubes that leave the first one's end."""
        c = self.scenes
        start = torch.zeros(c, 4, 3, device=self.device)
        start[:, 1:, 2] = self.uniform(2.0, 5.0, c, 1)
        direction = self.uniform(-0.9, 0.9, c, 4, 3)
        direction[:, :, 2] = 1.0
        direction[:, 0, :2] = 0
        direction = direction / direction.norm(dim=2, keepdim=True)
        radius = self.uniform(0.45, 0.8, c, 4)
        radius[:, 0] = 1.0
        return start, direction, radius

    def _instruments(self) -> tuple[Tensor, Tensor, Tensor]:
        """Points, directions and radii of two rods; a radius below zero is none."""
        c = self.scenes
        point = self.uniform(-0.6, 0.6, c, 2, 3)
        point[:, :, 2] = self.uniform(0.45, 1.0, c, 2)
        direction = self.uniform(-1.0, 1.0, c, 2, 3)
        direction = direction / direction.norm(dim=2, keepdim=True)
        radius = self.uniform(-0.12, 0.12, c, 2)
        return point, direction, radius

    def center_line(self, z: Float[Tensor, "c n"]) -> Float[Tensor, "c n 2"]:
        """Where the tube's middle lies at a height z."""
        angle = z[:, :, None, None] * self.bend_frequency[:, None, :, None] + self.bend_phase[:, None]
        return (self.bends[:, None] * torch.sin(angle)).sum(2)

    def clearance(self, points: Float[Tensor, "c n 3"]) -> Float[Tensor, "c n"]:
        """Positive inside the cavity, negative behind the wall; near the wall about the distance to it."""
        points = self.at_rest(points)
        return getattr(self, f"_{self.kind}")(points) - self.bump_height * self.bumps(points)  # type: ignore[no-any-return]

    def at_rest(self, points: Float[Tensor, "c n 3"]) -> Float[Tensor, "c n 3"]:
        """Where tissue that lies at these points now, at the time `moment`, lies when nothing moves."""
        if not self.anything_moves:
            return points
        height = self.pulse_height * torch.sin(self.pulse_rate * self.moment)
        return points + (height * self.pulse(points))[:, :, None] * self.pulse_direction

    def _colon(self, points: Tensor) -> Tensor:
        z = points[:, :, 2]
        across = points[:, :, :2] - self.center_line(z)
        rho = across.norm(dim=2)
        theta = torch.atan2(across[:, :, 1], across[:, :, 0])
        phase = self.angle_phase
        radius = 1 + self.flattening * torch.cos(2 * theta + phase[:, :1] + self.twist * z)
        radius = radius + self.triangle * torch.cos(3 * theta + phase[:, 1:2])
        along = z + self.fold_wobble * self.warp(points)
        ridge = torch.sin(math.pi * along / self.fold_period).abs() / self.fold_width
        arcs = 0.65 + 0.35 * torch.cos(3 * theta + phase[:, 2:3] + 2 * along)
        radius = radius - self.fold_height * arcs * torch.exp(-ridge.square())
        return self._with_lumps(radius - rho, points - torch.nn.functional.pad(self.center_line(z), (0, 1)))

    def _sac(self, points: Tensor) -> Tensor:
        scaled = points / self.axes
        rho = scaled.norm(dim=2).clamp_min(1e-6)
        direction = scaled / rho[:, :, None]
        wave = self.warp(direction * 2)
        ridge = 1 - torch.sin(self.rugae_frequency * direction[:, :, 0] + 2.5 * wave).abs()
        surface = 1 + 0.12 * wave - self.rugae * ridge.square()
        return self._with_lumps((surface - rho) * self.axes.mean(2), points)

    def _airways(self, points: Tensor) -> Tensor:
        start, direction, radius = self.branches
        offset = points[:, :, None] - start[:, None]
        along = (offset * direction[:, None]).sum(3)
        # Straight tubes that begin at the fork; the first one begins far behind.
        behind = along.clamp_max(0)
        behind = torch.cat([torch.zeros_like(behind[:, :, :1]), behind[:, :, 1:]], dim=2)
        off_axis = (offset - along[..., None] * direction[:, None]).norm(dim=3)
        rings = 0.03 * torch.sin(7 * along) * (self.rugae[:, None] > 0.1)
        inside = radius[:, None] * (1 + rings) - torch.sqrt(off_axis.square() + behind.square() + 1e-9)
        # The first tube ends a little behind the fork.
        cap = start[:, 1:2, 2] + 0.6 - points[:, :, 2]
        inside = torch.cat([torch.minimum(inside[:, :, 0], cap)[:, :, None], inside[:, :, 1:]], dim=2)
        return self._with_lumps(torch.logsumexp(inside * 12, dim=2) / 12, points)

    def _field(self, points: Tensor) -> Tensor:
        return torch.minimum(self._ground(points), self.to_instruments(points))

    def _ground(self, points: Tensor) -> Tensor:
        flat = points * torch.tensor([1.0, 1.0, 0.0], device=points.device)
        height = self.distance + self.relief_height * self.relief(flat)
        return self._with_lumps(
            0.8 * (height - points[:, :, 2]), points - torch.nn.functional.pad(height[:, :, None], (2, 0))
        )

    def on_instruments(self, points: Float[Tensor, "c n 3"]) -> Bool[Tensor, "c n"]:
        """Which points of an open field's wall lie on a rod, with its bumps and wherever it has moved."""
        points = self.at_rest(points)
        return self.to_instruments(points) < self._ground(points)

    def to_instruments(self, points: Float[Tensor, "c n 3"]) -> Float[Tensor, "c n"]:
        """Distance to the nearest rod; far for scenes without."""
        point, direction, radius = self.instruments
        offset = points[:, :, None] - point[:, None]
        along = (offset * direction[:, None]).sum(3, keepdim=True)
        distance = (offset - along * direction[:, None]).norm(dim=3) - radius[:, None].abs()
        distance = torch.where(radius[:, None] > 0, distance, 10.0)
        return distance.min(dim=2).values

    def _with_lumps(self, inside: Tensor, local: Tensor) -> Tensor:
        """Round bumps on the wall: polyps and bulges, at points given beside the wall's own frame."""
        direction = self.lumps / self.lumps.norm(dim=2, keepdim=True).clamp_min(1e-6)
        if self.kind == "colon":
            center = torch.stack([direction[:, :, 0], direction[:, :, 1], 6 * self.lumps[:, :, 2]], dim=2)
        elif self.kind == "sac":
            center = direction * self.axes
        elif self.kind == "airways":
            center = torch.stack([direction[:, :, 0], direction[:, :, 1], 3 + 3 * self.lumps[:, :, 2]], dim=2)
        else:
            center = torch.stack(
                [2 * self.lumps[:, :, 0], 2 * self.lumps[:, :, 1], 0 * direction[:, :, 2]], dim=2
            )
        distance = (local[:, :, None] - center[:, None]).norm(dim=3) - self.lump_radius[:, None]
        nearest = distance.min(dim=2).values
        # A smooth minimum, so that bumps have a foot.
        k = 0.12
        blend = (0.5 + 0.5 * (nearest - inside) / k).clamp(0, 1)
        joined: Tensor = nearest * (1 - blend) + inside * blend - k * blend * (1 - blend)
        return joined

    def camera_paths(self, frames: int) -> Float[Tensor, "c v 4 4"]:
        """Poses of a short clip in each scene, smooth, looking where the kind of organ lets one look."""
        c, device = self.scenes, self.device
        t = torch.arange(frames, device=device, dtype=torch.float32)[None]
        speed = 0.03 * (0.3 / 0.03) ** self.uniform(0.0, 1.0, c, 1)
        wander = self.uniform(0.0, 0.10, c, 2) * (speed / 0.1).clamp(0.3, 1.5)
        phase = self.uniform(0.0, 2 * math.pi, c, 4)
        rate = self.uniform(0.2, 1.2, c, 4)
        sway = torch.stack(
            [
                wander[:, :1] * torch.sin(rate[:, :1] * t + phase[:, :1]),
                wander[:, 1:] * torch.sin(rate[:, 1:2] * t + phase[:, 1:2]),
            ],
            dim=2,
        )
        if self.kind in ("colon", "airways"):
            sign = torch.where(self.uniform(0.0, 1.0, c, 1) < 0.5, -1.0, 1.0)
            start = self.uniform(-2.0, 2.0, c, 1) if self.kind == "colon" else self.uniform(-1.5, 1.5, c, 1)
            z = start + sign * speed * t
            offset = self.uniform(-0.4, 0.4, c, 1, 2)
            middle = self.center_line(z) if self.kind == "colon" else torch.zeros(c, frames, 2, device=device)
            ahead = self.center_line(z + 0.4) if self.kind == "colon" else middle
            position = torch.cat([middle + offset + sway, z[:, :, None]], dim=2)
            forward = torch.cat([ahead - middle, torch.full((c, frames, 1), 0.4, device=device)], dim=2)
            tilt = self.uniform(-0.9, 0.9, c, 1, 2) * self.uniform(0.2, 1.0, c, 1, 1)
        elif self.kind == "sac":
            heading = self.uniform(-1.0, 1.0, c, 1, 3)
            heading = heading / heading.norm(dim=2, keepdim=True)
            position = (
                self.uniform(-0.35, 0.35, c, 1, 3) * self.axes + heading * speed[:, :, None] * t[:, :, None]
            )
            position = position + torch.nn.functional.pad(sway, (0, 1))
            forward = self.uniform(-1.0, 1.0, c, 1, 3).expand(c, frames, 3)
            tilt = self.uniform(-0.2, 0.2, c, 1, 2)
        else:
            heading = self.uniform(-1.0, 1.0, c, 1, 3) * torch.tensor([1.0, 1.0, 0.5], device=device)
            position = heading * speed[:, :, None] * (t - frames / 2)[:, :, None] + torch.nn.functional.pad(
                sway, (0, 1)
            )
            # Some look at one place from different sides.
            aim = torch.cat([self.uniform(-0.3, 0.3, c, 1, 2), self.distance[:, :, None]], dim=2)
            around = (self.uniform(0.0, 1.0, c, 1, 1) < 0.5).float()
            forward = aim - around * position
            tilt = self.uniform(-0.4, 0.4, c, 1, 2)
        drift = torch.stack(
            [torch.sin(rate[:, 2:3] * t + phase[:, 2:3]), torch.sin(rate[:, 3:] * t + phase[:, 3:])], 2
        )
        tilt = tilt + self.uniform(0.0, 0.12, c, 1, 1) * drift
        return _looking(position, forward, tilt, self.uniform(0.0, 2 * math.pi, c, 1))


def _looking(position: Tensor, forward: Tensor, tilt: Tensor, roll: Tensor) -> Tensor:
    """Poses [C, V, 4, 4] at positions, looking forward, turned by tilt (right, down) in radians and roll."""
    forward = forward / forward.norm(dim=2, keepdim=True)
    helper = torch.zeros_like(forward)
    helper[..., 1] = 1
    # Where the view is nearly along y another axis serves.
    steep = forward[..., 1].abs() > 0.9
    helper[steep] = torch.tensor([1.0, 0.0, 0.0], device=position.device)
    right = torch.linalg.cross(helper, forward)
    right = right / right.norm(dim=2, keepdim=True)
    down = torch.linalg.cross(forward, right)
    base = torch.stack([right, down, forward], dim=3)
    a, b, r = tilt[..., 0], tilt[..., 1], roll.expand(tilt.shape[:2])
    zero, one = torch.zeros_like(a), torch.ones_like(a)
    yaw = torch.stack([a.cos(), zero, a.sin(), zero, one, zero, -a.sin(), zero, a.cos()], 2).unflatten(
        2, (3, 3)
    )
    pitch = torch.stack([one, zero, zero, zero, b.cos(), -b.sin(), zero, b.sin(), b.cos()], 2).unflatten(
        2, (3, 3)
    )
    spin = torch.stack([r.cos(), -r.sin(), zero, r.sin(), r.cos(), zero, zero, zero, one], 2).unflatten(
        2, (3, 3)
    )
    pose = torch.eye(4, device=position.device).repeat(*position.shape[:2], 1, 1)
    pose[:, :, :3, :3] = base @ yaw @ pitch @ spin
    pose[:, :, :3, 3] = position
    return pose
