"""The command that pretrains the depth completion, with examples that are only noise."""

from __future__ import annotations

from pathlib import Path

import pytest
import torch

from extrags.depth.completion import INPUT_CHANNELS
from extrags.depth.pretraining import __main__ as command
from extrags.depth.pretraining.examples import Examples

SIZE = (16, 16)


def noise(kind: str, clips: int, generator: torch.Generator, *_: object, **__: object) -> Examples:
    channels = torch.randn(clips, INPUT_CHANNELS, *SIZE, generator=generator)
    return Examples(channels.half(), torch.zeros(clips, *SIZE).half(), torch.ones(clips, *SIZE).half())


def pretrain(monkeypatch: pytest.MonkeyPatch, folder: Path, **options: int) -> list[torch.Tensor]:
    """Channels of the examples to train on and of those to validate with, as the bank has them."""
    given = {"batches": 4, "clips": 2, "validation-batches": 2, "iterations": 1, "batch": 2} | options
    words = [word for name, value in given.items() for word in (f"--{name}", str(value))]
    monkeypatch.setattr(
        "sys.argv", ["", str(folder), "--bank", str(folder / "bank"), "--device", "cpu", *words]
    )
    command.main()
    parts = torch.load(folder / "bank", weights_only=True)
    return [torch.cat([channels for channels, _, _ in kept]) for kept in parts]


def test_a_bank_grows_by_other_examples(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setattr(command, "make_examples", noise)
    first, first_validation = pretrain(monkeypatch, tmp_path)
    assert len(first) == len(first_validation) == 4
    grown, validation = pretrain(monkeypatch, tmp_path, **{"validation-batches": 1})
    assert torch.equal(grown[:4], first)
    assert torch.equal(validation[:4], first_validation)
    everything = torch.cat([grown, validation]).flatten(1)
    assert len(everything) == 16
    assert len(everything.unique(dim=0)) == 16
