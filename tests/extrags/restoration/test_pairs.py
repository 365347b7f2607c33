from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from extrags.config import CoarseConfig, DensifyConfig
from extrags.errors import CaptureError, ConfigError
from extrags.restoration.training_data.augmentation import CropSampler
from extrags.restoration.training_data.pairs import (
    Pairs,
    fold_pairs,
    make_pairs,
    synthetic_pairs,
    usable_folds,
)
from extrags.sequence import Split
from extrags.training.leave_out import leave_out_folds
from tests.extrags.lit_tube import Tube
from tests.extrags.restoration.conftest import SMALL


class TestFolds:
    @given(count=st.integers(4, 120), folds=st.integers(1, 6))
    def test_kept_and_left_out_frames_partition(self, count: int, folds: int) -> None:
        frames = np.arange(count) * 3
        parts = leave_out_folds(frames, folds)
        # A fold without a left-out frame would have nothing to tell.
        assert len(parts) == min(folds, count)
        for kept, left in parts:
            assert len(kept) > 0
            assert len(left) > 0
            assert np.array_equal(np.sort(np.concatenate([kept, left])), frames)
        left_out = np.concatenate([left for _, left in parts])
        assert len(left_out) == len(np.unique(left_out))
        if folds > 1:
            assert len(left_out) == count

    def test_too_few_frames_name_the_way_out(self) -> None:
        with pytest.raises(CaptureError, match="classical"):
            leave_out_folds(np.arange(3), 2)


class TestPairs:
    def test_targets_are_training_frames_only(self, tube: Tube, tube_pairs: Pairs) -> None:
        assert len(tube_pairs) == SMALL.synthetic_views
        assert set(tube_pairs.frame) <= set(tube.sequence.train)
        assert tube_pairs.synthetic.all()
        first = torch.from_numpy(tube.sequence.rgb[tube_pairs.frame[0]] / np.float32(255))
        assert torch.equal(tube_pairs.target[0].permute(1, 2, 0), first)

    def test_held_out_frames_have_no_influence(self, tube: Tube, tube_pairs: Pairs) -> None:
        rgb = tube.sequence.rgb.copy()
        rgb[tube.sequence.test] = 0
        again = synthetic_pairs(tube.scene, replace(tube.sequence, rgb=rgb), SMALL)
        assert torch.equal(again.layers.data, tube_pairs.layers.data)
        assert torch.equal(again.target, tube_pairs.target)

    def test_validation_frames_are_never_trained_on(self, tube_pairs: Pairs) -> None:
        kept = set(tube_pairs.frame[tube_pairs.validation])
        assert kept
        assert kept.isdisjoint(tube_pairs.frame[~tube_pairs.validation])

    def test_one_training_frame_is_refused(self, tube: Tube) -> None:
        lone = replace(tube.sequence, split=Split("lone", np.array([0]), np.array([1])))
        with pytest.raises(CaptureError, match="classical"):
            synthetic_pairs(replace(tube.scene, light=None), lone, SMALL)

    def test_frames_without_surface_are_named(self, tube: Tube) -> None:
        mask = np.zeros_like(tube.sequence.mask)
        mask[tube.sequence.train[0]] = True
        blind = replace(tube.sequence, mask=mask)
        told = rf"{blind.name}: no surface is known at any valid pixel of the training frames \w+, \w+"
        with pytest.raises(CaptureError, match=told):
            synthetic_pairs(tube.scene, blind, SMALL)

    def test_a_fold_that_keeps_no_tissue_gives_no_pair(self, tube: Tube) -> None:
        mask = tube.sequence.mask.copy()
        mask[tube.sequence.train[:-1]] = False
        alone = replace(tube.sequence, mask=mask)
        config = SMALL.model_copy(update={"fold_iterations": 2, "synthetic_views": 0})
        coarse = CoarseConfig(max_points=300, densify=DensifyConfig(max_gaussians=500))
        (usable,) = usable_folds(alone, config)
        pairs = make_pairs(tube.scene, alone, config, coarse)
        _, left = leave_out_folds(alone.train, config.folds)[usable]
        assert set(pairs.frame) == set(left)
        assert not pairs.weight.any()

    def test_more_folds_than_frames(self, tube: Tube) -> None:
        split = replace(tube.sequence.split, train=tube.sequence.train[:4])
        few = replace(tube.sequence, split=split)
        coarse = CoarseConfig(max_points=400, densify=DensifyConfig(enabled=False))
        config = SMALL.model_copy(update={"folds": 5, "fold_iterations": 2, "synthetic_views": 0})
        pairs = make_pairs(replace(tube.scene, light=None), few, config, coarse)
        assert sorted(pairs.frame.tolist()) == [0, 0, 1, 1, 2, 2, 3, 3]

    def test_left_out_frames_are_rendered_without_having_been_seen(self, tube: Tube) -> None:
        coarse = CoarseConfig(max_points=400, densify=DensifyConfig(enabled=False))
        config = SMALL.model_copy(update={"fold_iterations": 5})
        pairs = fold_pairs(tube.scene, tube.sequence, config, coarse, 0)
        kept, left = leave_out_folds(np.asarray(tube.sequence.train), config.folds)[0]
        assert np.array_equal(pairs.frame, np.concatenate([left, left]))
        assert pairs.synthetic.tolist() == [False] * len(left) + [True] * len(left)
        rgb = tube.sequence.rgb.copy()
        rgb[left] = 255 - rgb[left]
        again = fold_pairs(tube.scene, replace(tube.sequence, rgb=rgb), config, coarse, 0)
        assert torch.equal(again.layers.data, pairs.layers.data)
        assert not torch.equal(again.target, pairs.target)
        assert len(kept) > 0


class TestCrops:
    def test_same_seed_same_crops(self, tube: Tube, tube_pairs: Pairs) -> None:
        batches = [
            CropSampler(tube_pairs, tube.references.transfer, batch=2, crop_px=32, side_multiple=8, seed=seed)
            for seed in (4, 4, 5)
        ]
        first, second, other = ([sampler.draw() for _ in range(3)] for sampler in batches)
        for one, two in zip(first, second, strict=True):
            assert torch.equal(one.conditioning.channels, two.conditioning.channels)
            assert torch.equal(one.clean, two.clean)
        assert not torch.equal(first[0].clean, other[0].clean)
        assert first[0].clean.shape == (2, 3, 32, 32)

    def test_pairs_are_not_changed_by_drawing(self, tube: Tube, tube_pairs: Pairs) -> None:
        before = tube_pairs.layers.data.clone()
        sampler = CropSampler(
            tube_pairs, tube.references.transfer, batch=4, crop_px=48, side_multiple=8, seed=0
        )
        for _ in range(5):
            batch = sampler.draw()
            assert torch.isfinite(batch.conditioning.channels).all()
        assert torch.equal(before, tube_pairs.layers.data)

    def test_nothing_left_to_train_on(self, tube: Tube, tube_pairs: Pairs) -> None:
        kept = tube_pairs.subset(np.flatnonzero(tube_pairs.validation))
        with pytest.raises(ConfigError, match="validation"):
            CropSampler(kept, tube.references.transfer, batch=1, crop_px=32, side_multiple=8, seed=0)
