"""What is in the key of the restoration's stages."""

from __future__ import annotations

from typing import Any

import pytest

from extrags.config import CoarseConfig, EnhanceConfig
from extrags.restoration.diffusion import precision
from extrags.store import Ref
from tasks.enhance import keyed_settings, train
from tasks.stage import stage_key


def key(**settings: Any) -> str:
    return stage_key(
        train,
        {
            "scene": Ref(uri="somewhere/coarse", digest="scene"),
            "sequence": Ref(uri="somewhere/frames", digest="frames"),
            "config": keyed_settings(EnhanceConfig(**settings)),
            "coarse": CoarseConfig(),
            "model_digest": "weights",
        },
    )


@pytest.mark.parametrize("fast", [True, False])
def test_the_precision_is_settled_before_the_key(fast: bool, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(precision, "has_fast_half_precision", lambda: fast)
    assert key(precision="bfloat16") != key(precision="float32")
    assert key(precision="auto") == key(precision="bfloat16" if fast else "float32")


@pytest.mark.parametrize(
    ("backend", "part"), [("stable-video", "pretrained"), ("dynamicrafter", "checkpoint")]
)
@pytest.mark.parametrize("there", [True, False])
def test_the_device_is_settled_before_the_key(
    backend: str, part: str, there: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("torch.cuda.is_available", lambda: there)
    keys = {name: key(backend=backend, **{part: {"device": name}}) for name in ("auto", "cpu", "cuda")}
    assert keys["cpu"] != keys["cuda"]
    assert keys["auto"] == keys["cuda" if there else "cpu"]
    assert key(backend=backend, **{part: {"threads": 2}}) != keys["auto"]


@pytest.mark.parametrize("backend", ["embedded", "classical"])
def test_a_device_that_is_not_used_is_not_in_it(backend: str, monkeypatch: pytest.MonkeyPatch) -> None:
    keys = set()
    for there in (True, False):
        monkeypatch.setattr("torch.cuda.is_available", lambda there=there: there)
        keys.add(key(backend=backend))
    assert len(keys) == 1


def test_blending_and_filling_has_no_precision(monkeypatch: pytest.MonkeyPatch) -> None:
    keys = set()
    for fast in (True, False):
        monkeypatch.setattr(precision, "has_fast_half_precision", lambda fast=fast: fast)
        keys.add(key(backend="classical"))
    assert len(keys) == 1
