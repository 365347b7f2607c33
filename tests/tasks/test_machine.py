"""What a manifest tells of the machine it was made on."""

from __future__ import annotations

import pytest
import torch

from extrags.config import CoarseConfig, DepthConfig
from extrags.raster.bench import machine
from tasks.machine import machine_counts


@pytest.fixture
def with_gpu(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(torch.cuda, "is_available", lambda: True)
    monkeypatch.setattr(torch.cuda, "get_device_name", lambda: "made-up GPU")


@pytest.mark.usefixtures("with_gpu")
def test_a_gpu_is_named_where_a_task_asks_for_one() -> None:
    assert machine_counts({"config": CoarseConfig(), "device": "cuda"})["device"] == "made-up GPU"
    assert machine_counts({"config": DepthConfig(device="cuda")})["device"] == "made-up GPU"
    assert machine_counts({"config": CoarseConfig(), "device": "cpu"})["device"] == "cpu"


@pytest.mark.usefixtures("with_gpu")
def test_benchmarks_name_the_gpu() -> None:
    assert machine()["device"] == "made-up GPU"


def test_without_a_gpu(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(torch.cuda, "is_available", lambda: False)
    assert machine()["device"] == "cpu"
    assert machine_counts({})["device"] == "cpu"
