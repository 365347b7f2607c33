"""A small restorer's settings, training pairs from the lit tube, and tiny pretrained pipelines on disk."""

from __future__ import annotations

import os
import warnings
from collections.abc import Callable, Iterator
from pathlib import Path
from types import ModuleType

import pytest
import torch

from extrags.config import EnhanceConfig
from extrags.restoration.clips import render_clips
from extrags.restoration.diffusion.embedded import EmbeddedEnhancer
from extrags.restoration.diffusion.scene_training import train_on_scene
from extrags.restoration.protocol import Clip
from extrags.restoration.training_data.pairs import Pairs, synthetic_pairs
from tests.extrags.lit_tube import Tube, tube_cameras
from tests.extrags.restoration.pretrained.tiny_pipelines import BUILDERS

# Before huggingface_hub is loaded: nothing in these tests may reach for the network.
os.environ["HF_HUB_OFFLINE"] = "1"


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


@pytest.fixture(scope="session")
def trained(tube: Tube, tube_pairs: Pairs) -> EmbeddedEnhancer:
    """A small restorer that has learned from the tube alone."""
    return train_on_scene(tube_pairs, tube.references.transfer, SMALL)


@pytest.fixture(scope="session")
def clip(tube: Tube) -> Clip:
    """Three views off the path."""
    return render_clips(tube.scene, tube.references, [tube_cameras(3, offset_mm=4.0)], count=4)[0]


@pytest.fixture(scope="session")
def diffusers() -> ModuleType:
    """The extra; its own deprecation warnings are not ours to mend."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        for name in ("transformers", "accelerate", "ftfy"):
            pytest.importorskip(name, reason="needs extrags[diffusers]")
        package = pytest.importorskip("diffusers", reason="needs extrags[diffusers]")
        # Lazily imported parts warn as well, the first time they are touched.
        for name in BUILDERS:
            getattr(package, name)
    return package


@pytest.fixture(scope="session")
def saved(diffusers: ModuleType, tmp_path_factory: pytest.TempPathFactory) -> Callable[[str], Path]:
    """Folder of a saved tiny pipeline, built when it is first asked for."""
    root = tmp_path_factory.mktemp("pipelines")
    folders: dict[str, Path] = {}

    def folder(pipeline: str) -> Path:
        if pipeline not in folders:
            with warnings.catch_warnings():
                warnings.simplefilter("ignore")
                torch.manual_seed(0)
                made = BUILDERS[pipeline](diffusers)
                folders[pipeline] = root / pipeline
                made.save_pretrained(str(folders[pipeline]))
        return folders[pipeline]

    return folder
