"""The adversary of the generative restorer: tells restored views from true ones, by their texture.

Small heads on the frozen features of the perceptual distance's backbone judge texture at several scales; a
shallow network of its own sees the pixels. Both know where the view was to be invented, and count there. The
backbone's features, made for photographs, spare the adversary most of its training.

Source: features of a frozen backbone [Sauer2021]; spectral normalisation [Miyato2018].
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor, nn
from torch.nn import functional

from extrags.restoration.diffusion.adamw import AdamW

__all__ = ["Adversary", "Scene"]

HEAD_WIDTH = 64
PIXEL_WIDTH = 48
KNOWN_WEIGHT = 0.1
"""Weight of places that need no invention; those that do have one."""
BETAS = (0.0, 0.99)
TAPS = (0, 1, 2, 4)
"""Layers of SqueezeNet whose features are judged: 1/2, 1/4, 1/8 and 1/16 of the image's size."""


@dataclass(frozen=True)
class Scene:
    """What is known of views, whoever made them.

    Args:
        base: the image the restorer starts from, in [0, 1], [N, 3, H, W].
        invented: share of each pixel that nothing confirms, [N, 1, H, W].
    """

    base: Float[Tensor, "n 3 h w"]
    invented: Float[Tensor, "n 1 h w"]


class _Head(nn.Module):
    def __init__(self, inputs: int) -> None:
        super().__init__()
        normalised = nn.utils.spectral_norm
        self.mix = normalised(nn.Conv2d(inputs + 1, HEAD_WIDTH, 1))
        self.look = normalised(nn.Conv2d(HEAD_WIDTH, HEAD_WIDTH, 3, padding=1))
        self.judge = normalised(nn.Conv2d(HEAD_WIDTH, 1, 1))

    def forward(self, features: Tensor, invented: Tensor) -> Tensor:
        # Features of a ReLU grow without bound from layer to layer; a head starts from their unit length.
        unit = features / features.square().mean(dim=1, keepdim=True).add(1e-6).sqrt()
        hidden = functional.leaky_relu(self.mix(torch.cat([unit, invented], dim=1)), 0.2)
        return self.judge(functional.leaky_relu(self.look(hidden), 0.2))  # type: ignore[no-any-return]


class _Pixels(nn.Module):
    def __init__(self) -> None:
        super().__init__()
        normalised = nn.utils.spectral_norm
        self.entrance = normalised(nn.Conv2d(7, PIXEL_WIDTH, 3, padding=1))
        self.look = normalised(nn.Conv2d(PIXEL_WIDTH, PIXEL_WIDTH, 4, stride=2, padding=1))
        self.farther = normalised(nn.Conv2d(PIXEL_WIDTH, 2 * PIXEL_WIDTH, 4, stride=2, padding=1))
        self.judge = normalised(nn.Conv2d(2 * PIXEL_WIDTH, 1, 3, padding=1))

    def forward(self, rgb: Tensor, scene: Scene) -> Tensor:
        hidden = torch.cat([2 * rgb - 1, rgb - scene.base, scene.invented], dim=1)
        for layer in (self.entrance, self.look, self.farther):
            hidden = functional.leaky_relu(layer(hidden), 0.2)
        return self.judge(hidden)  # type: ignore[no-any-return]


class Adversary(nn.Module):
    """Judges views, and learns to.

    Args:
        channels: of the backbone's activations, one number per layer.
        learning_rate: of its own optimiser.
        seed: of its weights.
        half_precision: convolutions in bfloat16.
    """

    def __init__(
        self, channels: list[int], learning_rate: float, seed: int, *, half_precision: bool = False
    ) -> None:
        super().__init__()
        self._half_precision = half_precision
        # The layers draw their weights from the global generator, which stays as it was.
        with torch.random.fork_rng(devices=[]):
            torch.manual_seed(seed)
            self.heads = nn.ModuleList([_Head(channels[tap]) for tap in TAPS])
            self.pixels = _Pixels()
        self._learning_rate = learning_rate
        self._optimiser: AdamW | None = None

    def generator_loss(
        self, rgb: Float[Tensor, "n 3 h w"], activations: list[Tensor], scene: Scene
    ) -> Float[Tensor, ""]:
        """What restored views are to minimise: how far they are from looking true.

        Args:
            rgb: restored views.
            activations: of the backbone for them, layer by layer.
            scene: what is known of them.
        """
        judged = self._judged(rgb, activations, scene)
        return torch.stack([_mean(-logits, weight) for logits, weight in judged]).mean()

    def step(
        self,
        restored: tuple[Tensor, list[Tensor]],
        true: tuple[Tensor, list[Tensor]],
        scene: Scene,
    ) -> float:
        """Learn to tell both apart; returns the loss, 2 where it cannot.

        Args:
            restored: views and activations, without gradients.
            true: the same of the true views.
            scene: what is known of them.
        """
        self.zero_grad(set_to_none=True)
        pairs = zip(self._judged(*restored, scene), self._judged(*true, scene), strict=True)
        loss = torch.stack(
            [
                _mean(functional.relu(1 + fake), weight) + _mean(functional.relu(1 - real), weight)
                for (fake, weight), (real, _) in pairs
            ]
        ).mean()
        loss.backward()
        if self._optimiser is None:
            # Not before: the parameters may have moved to another device since they were made.
            self._optimiser = AdamW(self.parameters(), 0.0, BETAS)
        self._optimiser.step(self._learning_rate)
        return float(loss.detach())

    def state(self) -> dict[str, Tensor]:
        """Weights and the state of the optimiser, for a checkpoint."""
        own = {f"weights.{name}": value for name, value in self.state_dict().items()}
        moments = {} if self._optimiser is None else self._optimiser.state()
        return {**own, **{f"optimiser.{name}": value for name, value in moments.items()}}

    def restore(self, state: dict[str, Tensor]) -> None:
        """Take over what `state` gave.

        Raises:
            KeyError: when it is of another adversary.
        """
        parts: dict[str, dict[str, Tensor]] = {"weights": {}, "optimiser": {}}
        for name, value in state.items():
            part, _, rest = name.partition(".")
            parts[part][rest] = value
        self.load_state_dict(parts["weights"])
        if parts["optimiser"]:
            self._optimiser = AdamW(self.parameters(), 0.0, BETAS)
            self._optimiser.restore(parts["optimiser"])

    def _judged(self, rgb: Tensor, activations: list[Tensor], scene: Scene) -> list[tuple[Tensor, Tensor]]:
        """Verdicts of each scale, and their weights."""
        verdicts = []
        with torch.autocast(rgb.device.type, torch.bfloat16, enabled=self._half_precision):
            for head, tap in zip(self.heads, TAPS, strict=True):
                verdicts.append(head(activations[tap], _pooled(scene.invented, activations[tap])))
            verdicts.append(self.pixels(rgb, scene))
        return [(logits.float(), _pooled(scene.invented, logits) + KNOWN_WEIGHT) for logits in verdicts]


def _pooled(share: Tensor, features: Tensor) -> Tensor:
    """The share of each of the features' cells."""
    return functional.adaptive_avg_pool2d(share, (features.shape[-2], features.shape[-1]))


def _mean(values: Tensor, weight: Tensor) -> Tensor:
    return (values * weight).sum() / weight.sum()
