"""A small restorer's settings, and training pairs from the lit tube."""

from __future__ import annotations

from collections.abc import Iterator

import pytest
import torch

from extrags.config import EnhanceConfig
from extrags.restoration.training_data.pairs import Pairs, synthetic_pairs
from tests.extrags.lit_tube import Tube


@pytest.fixture(scope="session", autouse=True)
def _one_thread() -> Iterator[None]:
    """Small tensors gain nothing from threads, and busy machines lose much to their spinning."""
    threads = torch.get_num_threads()
    torch.set_num_threads(1)
    yield
    torch.set_num_threads(threads)


SMALL = EnhanceConfig(
    channels=(16, 24, 32),
    crop=32,
    batch=3,
    synthetic_views=12,
    train_iterations=60,
    references=4,
    learning_rate=2e-3,
    precision="float32",
    pretrained_weights="none",
)


@pytest.fixture(scope="session")
def tube_pairs(tube: Tube) -> Pairs:
    return synthetic_pairs(tube.scene, tube.sequence, SMALL)
