"""Stages whose work is torch's: the same bits on any number of threads.

Machines and workers with other numbers of threads share a store, and the number is no part of a key.
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import asdict

import numpy as np
import pytest
import torch

from extrags.confidence import PerceptualDifference
from extrags.config import CoarseConfig, DensifyConfig, DepthConfig, EnhanceConfig, FinetuneConfig
from extrags.config.finetuning import JudgeConfig
from extrags.depth.estimate import estimate_depth
from extrags.finetuning_judge import judge_finetuning
from extrags.metrics.lpips import Lpips
from extrags.pseudo_views import PseudoViews
from extrags.raster import native, set_num_threads
from extrags.restoration.backends import train_enhancer
from extrags.restoration.diffusion.embedded import EmbeddedEnhancer
from extrags.restoration.trajectories import restore_batch
from extrags.training.finetuning import finetune
from tests.extrags.depth.withheld import with_points, withheld_phantom
from tests.extrags.lit_tube import build_tube, tube_cameras
from tests.extrags.random_lpips import random_weights

COARSE = CoarseConfig(iterations=20, max_points=300, densify=DensifyConfig(max_gaussians=500))
ENHANCE = EnhanceConfig(
    folds=1,
    fold_iterations=20,
    synthetic_views=4,
    references=4,
    max_views=10,
    clips_per_batch=2,
    precision="float32",
)
FROM_NOTHING = ENHANCE.model_copy(
    update={
        "pretrained_weights": "none",
        "channels": (16, 24, 32),
        "crop": 32,
        "train_iterations": 4,
        "synthetic_views": 8,
        "judge": False,
    }
)
FINETUNE = FinetuneConfig(iterations=20, judge=JudgeConfig(iterations_share=1.0, views=2, max_width=192))
ENLARGED = 3
"""Images of the usual size are too small for torch to divide much of the work."""
TRAJECTORIES = [
    tube_cameras(4, offset_mm=3.0, start_mm=start, turn=0.4, enlarged=ENLARGED) for start in (0.0, 4.0)
]
MEASURE = PerceptualDifference(Lpips("alex", random_weights("alex")))

Arrays = dict[str, np.ndarray]


class Stages:
    """Tiny stages, each with what the one before it made on one thread."""

    def __init__(self) -> None:
        self.tube = build_tube(enlarged=ENLARGED)
        self.withheld = with_points(withheld_phantom(5)).training_part()
        with threads(1):
            # As it is, so that there is a share of restored views to judge.
            plain = {"judge": False, "seamless_cloning": "never"}
            self.enhancer = self._restorer(ENHANCE.model_copy(update=plain))
            self.pseudo_views = self._restored()
        self._expected = {"restored_views": self.restored_views(self.pseudo_views)}

    def expected(self, stage: str) -> Arrays:
        """What a stage makes on one thread."""
        if stage not in self._expected:
            with threads(1):
                self._expected[stage] = getattr(self, stage)()
        return self._expected[stage]

    def _restorer(self, config: EnhanceConfig) -> EmbeddedEnhancer:
        found = train_enhancer(self.tube.scene, self.tube.sequence, config, COARSE)
        assert isinstance(found, EmbeddedEnhancer)
        return found

    def _restored(self) -> PseudoViews:
        scene, sequence = self.tube.scene, self.tube.sequence
        return restore_batch(scene, sequence, TRAJECTORIES, self.enhancer, ENHANCE, 0, MEASURE)

    def trained_restorer(self) -> Arrays:
        network = self._restorer(FROM_NOTHING).network
        return {name: value.numpy() for name, value in network.state_dict().items()}

    def judged_restorer(self) -> Arrays:
        record = self._restorer(ENHANCE).record
        return {method: np.array(list(scores.values())) for method, scores in record["validation"].items()}

    def restored_views(self, views: PseudoViews | None = None) -> Arrays:
        views = self._restored() if views is None else views
        names = ("rendered", "restored", "target", "depth_mm", "uncertainty", "pixel_confidence")
        assert views.expected_error is not None
        return {name: getattr(views, name) for name in names} | {"expected_error": views.expected_error}

    def judgement(self) -> Arrays:
        found = judge_finetuning(
            self.tube.scene,
            self.tube.sequence,
            TRAJECTORIES,
            self.enhancer,
            FINETUNE,
            ENHANCE,
            COARSE,
            measure=MEASURE,
        )
        assert found.restored_shares is not None
        told = {str(trial.amount): np.array(list(asdict(trial).values())) for trial in found.trials}
        return told | {"shares": np.array(list(asdict(found.restored_shares).values()))}

    def finetuned_scene(self) -> Arrays:
        found = finetune(self.tube.scene, self.tube.sequence, self.pseudo_views, FINETUNE, COARSE)
        gaussians = found.scene.gaussians
        names = ("means", "quats", "scales", "opacities", "sh0")
        return {name: getattr(gaussians, name).numpy() for name in names}

    def estimated_depth(self) -> Arrays:
        found = estimate_depth(self.withheld, DepthConfig(hypotheses=24, sources=3))
        return {"depth": found.depth, "expected_error": found.expected_error}


STAGES = (
    "trained_restorer",
    "judged_restorer",
    "restored_views",
    "judgement",
    "finetuned_scene",
    "estimated_depth",
)


@contextmanager
def threads(count: int) -> Iterator[None]:
    """So many of torch and of the kernels."""
    before = torch.get_num_threads(), native.num_threads()
    torch.set_num_threads(count)
    set_num_threads(count)
    try:
        yield
        assert torch.get_num_threads() == count
    finally:
        torch.set_num_threads(before[0])
        set_num_threads(before[1])


@pytest.fixture(scope="module")
def stages() -> Stages:
    return Stages()


# Sums of two parts are the same in either order, those of three are not.
@pytest.mark.parametrize("count", [3, *(pytest.param(count, marks=pytest.mark.slow) for count in (2, 4))])
@pytest.mark.parametrize("stage", [pytest.param(STAGES[0], marks=pytest.mark.slow), *STAGES[1:]])
def test_same_bits_on_any_number_of_threads(stages: Stages, stage: str, count: int) -> None:
    with threads(count):
        found = getattr(stages, stage)()
    expected = stages.expected(stage)
    assert list(found) == list(expected)
    for name, value in expected.items():
        np.testing.assert_array_equal(found[name], value, err_msg=name)
