"""AdamW for the weights of a network."""

from __future__ import annotations

import math
from collections.abc import Iterable

import torch
from torch import Tensor

__all__ = ["AdamW"]


class AdamW:
    """As `torch.optim.AdamW`, whose first use loads torch's compiler: more than a second in every process.

    Args:
        parameters: leaves, stepped in place; those without a gradient stay as they are.
        weight_decay: per step, as a share of the learning rate.
        betas: memory of the first and of the second moment.

    Source: [LoshchilovHutter2019].
    """

    EPS = 1e-8

    def __init__(
        self, parameters: Iterable[Tensor], weight_decay: float, betas: tuple[float, float] = (0.9, 0.999)
    ) -> None:
        self._parameters = list(parameters)
        self._weight_decay = weight_decay
        self._betas = betas
        self._first = [torch.zeros_like(parameter) for parameter in self._parameters]
        self._second = [torch.zeros_like(parameter) for parameter in self._parameters]
        self._steps = 0

    @torch.no_grad()
    def step(self, learning_rate: float) -> None:
        """One step along the gradients, which are cleared."""
        beta1, beta2 = self._betas
        self._steps += 1
        size = learning_rate / (1 - beta1**self._steps)
        root_correction = math.sqrt(1 - beta2**self._steps)
        for parameter, first, second in zip(self._parameters, self._first, self._second, strict=True):
            gradient = parameter.grad
            if gradient is None:
                continue
            parameter.grad = None
            parameter.mul_(1 - learning_rate * self._weight_decay)
            first.lerp_(gradient, 1 - beta1)
            second.mul_(beta2).addcmul_(gradient, gradient, value=1 - beta2)
            parameter.addcdiv_(first, (second.sqrt() / root_correction).add_(self.EPS), value=-size)

    def state(self) -> dict[str, Tensor]:
        """Moments and number of steps, for a checkpoint."""
        moments = {
            f"{name}.{index}": value
            for name, values in (("first", self._first), ("second", self._second))
            for index, value in enumerate(values)
        }
        return {**moments, "steps": torch.tensor(self._steps)}

    def restore(self, state: dict[str, Tensor]) -> None:
        """Take over what `state` gave.

        Raises:
            KeyError: when it is of other parameters.
        """
        for index in range(len(self._parameters)):
            self._first[index].copy_(state[f"first.{index}"])
            self._second[index].copy_(state[f"second.{index}"])
        self._steps = int(state["steps"])
