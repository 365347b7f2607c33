"""A sequence in its own pixels goes through every stage."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

import extrags
from data_catalog.true_surface import true_surface
from extrags.lens import distortion_of_pinhole
from extrags.radial_lens import RadialLens
from extrags.sequence import EndoscopicSequence
from tests.flows.tiny import SEQUENCE, tiny_config

LENS = RadialLens((-0.05, 0.002, 0.0, 0.0), float(np.radians(60)))


def _through_the_lens(flat: EndoscopicSequence) -> EndoscopicSequence:
    """What a fisheye would have seen of the same views."""
    K = flat.K.copy()
    K[:, [0, 1], [0, 1]] *= 1.1
    plan = distortion_of_pinhole(K[0], LENS, flat.K[0], flat.width, flat.height)
    assert flat.depth_mm is not None
    assert flat.observed is not None
    return replace(
        flat,
        rgb=np.stack([plan.color(image) for image in flat.rgb]),
        K=K,
        mask=np.stack([plan.mask(mask) for mask in flat.mask]),
        depth_mm=np.stack([plan.depth(depth) for depth in flat.depth_mm]),
        observed=np.stack([plan.mask(seen) for seen in flat.observed]),
        lens=LENS,
    )


@pytest.mark.slow
def test_from_start_to_evaluation() -> None:
    sequence = _through_the_lens(extrags.read(SEQUENCE, tiny_config().ingest))
    truth = true_surface(sequence)
    result = extrags.run_pipeline(sequence, tiny_config(assess__force=True), true_surface=truth)
    assert set(result.skipped) <= {"poses", "depth", "report"}
    assert result.exploration is not None
    assert all(part.lens is None for part in result.exploration.trajectories)
    for which in ("coarse", "final"):
        assert result.evaluations[which].metrics["psnr"] > 15
    assert result.renders["coarse"].rgb.shape == sequence.rgb[sequence.test].shape
