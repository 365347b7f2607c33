"""Selective Adam: updates only the Gaussians visible in a view, and supports densification."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import torch
from jaxtyping import Bool
from torch import Tensor

from extrags.errors import ConfigError, ShapeError
from extrags.raster import native

__all__ = ["Joined", "SelectiveAdam"]

GRADIENT_MAX = 1e18
"""Gradients are held to this size either way: both moments stay finite, and their ratio bounds the step."""


@dataclass(frozen=True)
class Joined:
    """Several parameters concatenated in one array, and their moments, all [N, K, ...] and contiguous."""

    values: Tensor
    first_moments: Tensor
    second_moments: Tensor


class SelectiveAdam:
    """Adam over named parameters that share their rows (one row per Gaussian).

    A step updates only the rows flagged visible; other rows keep their values, moments and step counts, and
    cost no time. The bias correction of a row counts that row's own steps, so a row that is first visible
    late, or was added by densification, starts at step one. With all rows visible the result equals
    `torch.optim.Adam` for gradients up to `GRADIENT_MAX`; larger ones count as that. Results are
    deterministic and independent of the number of threads.

    Joined parameters are stored in one array, so that kernels that take them together need no copy. They
    remain separate parameters with their own names, learning rates, moments and leaf tensors.

    Args:
        parameters: leaf tensors [N, ...] by name, contiguous; stepped in place.
        learning_rates: one per parameter, by name; a rate of 0 freezes the parameter.
        betas: decay rates of the first and second moment.
        eps: added to the square root of the second moment.
        joined: names of float32 CPU parameters [N, K_i, ...] to be joined along K, by the name of the whole;
            `parameters` holds new leaves for them.

    Raises:
        ShapeError: when the parameters differ in their number of rows.
        ConfigError: when a learning rate is missing.

    Source: Kingma & Ba, Adam, ICLR 2015; Mallick et al., Taming 3DGS, 2024 (selective steps).
    """

    def __init__(
        self,
        parameters: Mapping[str, Tensor],
        learning_rates: Mapping[str, float],
        *,
        betas: tuple[float, float] = (0.9, 0.999),
        eps: float = 1e-15,
        joined: Mapping[str, Sequence[str]] | None = None,
    ) -> None:
        self.parameters: dict[str, Tensor] = dict(parameters)
        self.learning_rates: dict[str, float] = dict(learning_rates)
        self.betas = betas
        self.eps = eps
        rows = {name: len(value) for name, value in self.parameters.items()}
        if len(set(rows.values())) > 1:
            raise ShapeError(f"parameters differ in their number of rows: {rows}")
        missing = set(self.parameters) - set(self.learning_rates)
        if missing:
            raise ConfigError(f"no learning rate for {', '.join(sorted(missing))}")
        self.first_moments = {k: torch.zeros_like(v) for k, v in self._detached().items()}
        self.second_moments = {k: torch.zeros_like(v) for k, v in self._detached().items()}
        device = next((value.device for value in self.parameters.values()), torch.device("cpu"))
        self.steps = torch.zeros(next(iter(rows.values()), 0), dtype=torch.int32, device=device)
        self._bias = self._bias_corrections(1024)
        self._taken = 0
        self._parts = {name: tuple(parts) for name, parts in (joined or {}).items()}
        self.joined: dict[str, Joined] = {}
        self._join()

    def _bias_corrections(self, n_steps: int) -> tuple[Tensor, Tensor]:
        """1 / (1 - beta1^t) and 1 / sqrt(1 - beta2^t) for t up to `n_steps`; 1 for t = 0."""
        t = torch.arange(n_steps + 1, dtype=torch.float64)
        first, second = (1 - beta**t for beta in self.betas)
        first[0] = second[0] = 1
        return (1 / first).float(), (1 / second.sqrt()).float()

    def _detached(self) -> dict[str, Tensor]:
        return {name: value.detach() for name, value in self.parameters.items()}

    @torch.no_grad()
    def _join(self) -> None:
        """Concatenate joined parameters, and their moments, into one array each."""
        for whole, parts in self._parts.items():
            arrays = []
            for held in (self.parameters, self.first_moments, self.second_moments):
                array = torch.cat([held[part].detach() for part in parts], dim=1)
                arrays.append(array)
                begin = 0
                for part in parts:
                    old = held[part]
                    piece = array[:, begin : begin + old.shape[1]].detach()
                    held[part] = piece.requires_grad_(old.requires_grad)
                    begin += old.shape[1]
            self.joined[whole] = Joined(*arrays)

    def _joined_rates(self, whole: str) -> list[float]:
        rates: list[float] = []
        for part in self._parts[whole]:
            columns = self.parameters[part].shape[1:].numel()
            rates += [self.learning_rates[part]] * columns
        return rates

    @torch.no_grad()
    def step(
        self, visible: Bool[Tensor, "n"] | None = None, gradients: Mapping[str, Tensor] | None = None
    ) -> None:
        """Update the parameters from their `.grad`; a parameter without a gradient is unchanged.

        Args:
            visible: rows to update; None updates all.
            gradients: gradients to use instead of `.grad`, by name; joined parameters have one array, under
                the name of the joined array. A parameter without a gradient is unchanged.

        Raises:
            ShapeError: when `visible` does not have one flag per row, or a gradient not the shape of what it
                belongs to.
        """
        if visible is not None and (visible.shape != self.steps.shape or visible.dtype != torch.bool):
            raise ShapeError(
                f"visible is {visible.dtype} {tuple(visible.shape)}, expected torch.bool "
                f"{tuple(self.steps.shape)}"
            )
        self._check_shapes(gradients or {})
        self.steps += 1 if visible is None else visible
        self._taken += 1
        if self._taken >= len(self._bias[0]):
            self._bias = self._bias_corrections(2 * self._taken)
        quick: list[tuple[Tensor, Tensor, Tensor, Tensor, float | list[float]]] = []
        for name, value in self.parameters.items():
            gradient = value.grad if gradients is None else gradients.get(name)
            rate = self.learning_rates[name]
            if gradient is None or rate == 0 or value.numel() == 0:
                continue
            moments = self.first_moments[name], self.second_moments[name]
            if (
                value.dtype == torch.float32
                and value.device.type == "cpu"
                and value.is_contiguous()
                and native.native_isa() is not None
            ):
                quick.append((value, gradient, *moments, rate))
            else:
                self._step_torch(value, gradient, *moments, visible, rate)
        for whole, array in self.joined.items():
            gradient = None if gradients is None else gradients.get(whole)
            if gradient is not None and array.values.numel():
                moments = array.first_moments, array.second_moments
                quick.append((array.values, gradient, *moments, self._joined_rates(whole)))
        if quick:
            native.adam_step(quick, self.steps, visible, self._bias, self.betas, self.eps)

    def _check_shapes(self, gradients: Mapping[str, Tensor]) -> None:
        joined = {name: array.values for name, array in self.joined.items()}
        for name, value in {**self.parameters, **joined}.items():
            gradient = gradients.get(name)
            if gradient is not None and gradient.shape != value.shape:
                raise ShapeError(
                    f"the gradient of {name} has shape {tuple(gradient.shape)}, expected {tuple(value.shape)}"
                )

    def _step_torch(
        self,
        value: Tensor,
        gradient: Tensor,
        first: Tensor,
        second: Tensor,
        visible: Tensor | None,
        rate: float,
    ) -> None:
        beta1, beta2 = self.betas
        rows = slice(None) if visible is None else visible
        shape = (-1, *([1] * (value.ndim - 1)))
        count = self.steps[rows].to(value.dtype).reshape(shape)
        g = gradient[rows].clamp(-GRADIENT_MAX, GRADIENT_MAX)
        m = beta1 * first[rows] + (1 - beta1) * g
        v = beta2 * second[rows] + (1 - beta2) * g * g
        first[rows], second[rows] = m, v
        denominator = (v / (1 - beta2**count)).sqrt() + self.eps
        value[rows] -= rate * (m / (1 - beta1**count)) / denominator

    def zero_grad(self) -> None:
        """Set all gradients to None."""
        for value in self.parameters.values():
            value.grad = None

    @torch.no_grad()
    def keep(self, mask: Bool[Tensor, "n"]) -> None:
        """Keep the flagged rows of parameters, moments and counts; `parameters` holds new leaves.

        Args:
            mask: which rows stay.

        Raises:
            ShapeError: when there is not one flag per row.
        """
        if mask.shape != self.steps.shape:
            raise ShapeError(f"mask has shape {tuple(mask.shape)}, expected {tuple(self.steps.shape)}")
        for name, value in self.parameters.items():
            self.parameters[name] = value.detach()[mask].requires_grad_(value.requires_grad)
            self.first_moments[name] = self.first_moments[name][mask]
            self.second_moments[name] = self.second_moments[name][mask]
        self.steps = self.steps[mask]
        self._join()

    @torch.no_grad()
    def append(self, rows: Mapping[str, Tensor]) -> None:
        """Append rows with zero moments and counts; `parameters` holds new leaves.

        Args:
            rows: new rows of every parameter, by name.

        Raises:
            ShapeError: when a parameter is missing or the numbers of rows differ.
        """
        if set(rows) != set(self.parameters):
            raise ShapeError(f"rows of {sorted(rows)}, expected {sorted(self.parameters)}")
        if len({len(value) for value in rows.values()}) > 1:
            raise ShapeError("the new rows differ in their number")
        new_gaussians = 0
        for name, value in self.parameters.items():
            new = rows[name].detach().to(value.dtype)
            if new.shape[1:] != value.shape[1:]:
                raise ShapeError(
                    f"rows of {name} have shape {tuple(new.shape)}, expected (M, "
                    f"{', '.join(map(str, value.shape[1:]))})"
                )
            new_gaussians = len(new)
            grown = torch.cat([value.detach(), new])
            self.parameters[name] = grown.requires_grad_(value.requires_grad)
            zeros = torch.zeros_like(new)
            self.first_moments[name] = torch.cat([self.first_moments[name], zeros])
            self.second_moments[name] = torch.cat([self.second_moments[name], zeros])
        self.steps = torch.cat([self.steps, self.steps.new_zeros(new_gaussians)])
        self._join()
