"""The second device of the tests: it computes what the processor computes, and refuses what a GPU refuses."""

from __future__ import annotations

from collections.abc import Callable, Iterator

import numpy as np
import pytest
import torch
from torch import Tensor

from tests.second_device import MixedDevicesError, SecondDeviceTensor, second_device


@pytest.fixture
def there() -> Iterator[torch.device]:
    with second_device() as device:
        yield device


def test_it_computes_and_differentiates_as_the_processor(there: torch.device) -> None:
    here = torch.randn(6, 3, generator=torch.Generator().manual_seed(1))
    found = []
    for device in (torch.device("cpu"), there):
        x = here.clone().to(device).requires_grad_()
        loss = torch.where(x > 0, x.sin() @ x.T.mean(1, keepdim=True), x.new_zeros(())).square().mean()
        loss.backward()
        assert x.grad is not None
        assert x.grad.device == device
        with torch.no_grad():
            x[1:3].zero_()
        found.append([float(loss.detach()), x.grad.cpu().tolist(), x.tolist()])
    assert found[0] == found[1]


@pytest.mark.parametrize(
    "mixed",
    [
        lambda x: x + torch.ones(4, 3),
        lambda x: torch.ones(4, 3) + x,
        lambda x: torch.cat([x, torch.ones(1, 3)]),
        lambda x: torch.stack([x.sum(), torch.zeros(())]),
        lambda x: torch.ones(4, 3).add_(x),
        lambda x: torch.zeros(()).add_(x.sum()),
        lambda x: x.index_put((torch.tensor([0]),), torch.ones(1, 3)),
        lambda x: x @ torch.ones(3, 2),
        lambda x: torch.ones(4, 3)[x[:, 0] > 0],
        lambda x: torch.maximum(x, torch.zeros(3)),
    ],
)
def test_devices_do_not_mix(there: torch.device, mixed: Callable[[Tensor], Tensor]) -> None:
    with pytest.raises(MixedDevicesError):
        mixed(torch.ones(4, 3).to(there))


@pytest.mark.parametrize("look", [lambda x: x.numpy(), np.asarray])
def test_numpy_does_not_reach_it(there: torch.device, look: Callable[[Tensor], np.ndarray]) -> None:
    with pytest.raises((RuntimeError, TypeError)):
        look(torch.ones(2).to(there))


def test_what_a_gpu_takes_it_takes(there: torch.device) -> None:
    x = torch.arange(6.0).to(there)
    taken = [
        x + torch.tensor(1.0),
        torch.where(x > 2, x, torch.zeros(())),
        x[torch.tensor([1, 2])],
        x[torch.tensor([True, False] * 3)],
        torch.zeros(2, device=there),
        torch.tensor([1.0, 2.0], device=there),
        x.new_tensor([3.0]),
    ]
    assert all(isinstance(tensor, SecondDeviceTensor) for tensor in taken)
    assert [tensor.tolist() for tensor in taken[2:4]] == [[1.0, 2.0], [0.0, 2.0, 4.0]]
    copied = torch.zeros(6)
    copied.copy_(x)
    assert copied.tolist() == x.cpu().numpy().tolist()
