"""AdamW against torch's, bit by bit."""

from __future__ import annotations

import copy

import torch
from torch import nn

from extrags.restoration.diffusion.adamw import AdamW


def test_steps_are_those_of_torch_bit_by_bit() -> None:
    generator = torch.Generator().manual_seed(0)
    own = nn.Sequential(nn.Conv2d(3, 5, 3), nn.GroupNorm(1, 5), nn.Conv2d(5, 2, 1)).to(
        memory_format=torch.channels_last  # type: ignore[call-overload]
    )
    reference = copy.deepcopy(own)
    adamw = AdamW(own.parameters(), weight_decay=1e-2)
    torch_adamw = torch.optim.AdamW(reference.parameters(), weight_decay=1e-2)
    for step in range(25):
        rate = 1e-2 / (1 + step)
        torch_adamw.param_groups[0]["lr"] = rate
        images = torch.randn(2, 3, 8, 8, generator=generator)
        for network in (own, reference):
            network(images).square().mean().backward()
        torch_adamw.step()
        torch_adamw.zero_grad()
        adamw.step(rate)
    for stepped, expected in zip(own.parameters(), reference.parameters(), strict=True):
        assert torch.equal(stepped, expected)


def test_a_parameter_without_gradient_stays() -> None:
    moved, left = (torch.ones(3, requires_grad=True) for _ in range(2))
    adamw = AdamW([moved, left], weight_decay=0.1)
    moved.sum().backward()
    adamw.step(0.1)
    assert torch.equal(left, torch.ones(3))
    assert not torch.equal(moved, torch.ones(3))
    assert moved.grad is None
