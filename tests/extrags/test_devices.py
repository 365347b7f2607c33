"""What settings of a device mean on this machine."""

from __future__ import annotations

import pytest
import torch

from extrags.devices import chosen_device
from extrags.errors import ConfigError


@pytest.mark.parametrize("there", [True, False])
def test_auto_is_what_there_is(there: bool, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(torch.cuda, "is_available", lambda: there)
    assert chosen_device("auto", "depth.device").type == ("cuda" if there else "cpu")
    assert chosen_device("cpu", "depth.device").type == "cpu"


def test_cuda_that_is_not_there_names_the_setting(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(torch.cuda, "is_available", lambda: False)
    with pytest.raises(ConfigError, match=r"depth\.device=cuda, but torch sees no CUDA device"):
        chosen_device("cuda", "depth.device")
    monkeypatch.setattr(torch.cuda, "is_available", lambda: True)
    assert chosen_device("cuda", "depth.device").type == "cuda"
