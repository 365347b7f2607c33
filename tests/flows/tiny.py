"""The whole pipeline at a size that takes seconds; `python -m tests.flows.tiny STORE` runs it alone."""

from __future__ import annotations

import copy
import functools
import json
import ssl
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from typing import Any
from unittest.mock import patch

import numpy as np

import data_catalog.phantom.recording
import extrags.metrics.surface
from data_catalog.phantom.config import PhantomConfig
from extrags.config import PipelineConfig, profile_config
from extrags.sequence import EndoscopicSequence
from flows.runners import DirectRunner
from flows.wiring import run_sequence
from tests.drawn_once import drawn_once

SEQUENCE = "phantom/0@sparse"

GIVEN = {"poses": "the source has poses", "depth": "the source has depth"}
"""Stages that its runs skip, with the reason."""

TINY: dict[str, Any] = {
    "ingest.width": 48,
    "ingest.height": 40,
    "ingest.max_frames": 24,
    "coarse.iterations": 120,
    "coarse.max_points": 1500,
    "coarse.pixels_per_point": 1,
    "coarse.sh_degree": 0,
    "uc_nerf.iterations": 12,
    "uc_nerf.stereo_width": 16,
    "uc_nerf.coarse_planes": 8,
    "uc_nerf.fine_planes": 4,
    "uc_nerf.samples_uniform": 4,
    "uc_nerf.samples_prior": 4,
    "uc_nerf.width": 16,
    "uc_nerf.rays": 64,
    "uc_nerf.patches": 2,
    "uc_nerf.sparse_pixels": 16,
    "assess.probe_views": 3,
    "assess.force": True,
    "surface.max_width": 48,
    "freespace.grid_size": 16,
    "freespace.render_width": 32,
    "explore.trajectories": 2,
    "explore.starts": 2,
    "explore.start_spacing": 100.0,
    "explore.length": 3,
    "explore.wave": 2,
    "explore.max_expansions": 3,
    "explore.render_width": 32,
    "explore.probe_views": 24,
    "explore.min_view_gain": 0.0,
    "explore.wave_kept_share": 0.0,
    "explore.safety_share": 0.02,
    "enhance.folds": 1,
    "enhance.fold_iterations": 10,
    "enhance.synthetic_views": 2,
    "enhance.train_iterations": 2,
    "enhance.batch": 2,
    "enhance.crop": 32,
    "enhance.channels": [8, 8, 16],
    # A network of these widths, not the bundled one: trained from nothing in seconds.
    "enhance.pretrained_weights": "none",
    "enhance.keyframes": 2,
    "enhance.max_views": 4,
    "enhance.clips_per_batch": 1,
    # Of two rounds. Fewer, and the judge would keep real views alone: nothing after it would rest on the
    # virtual ones.
    "finetune.iterations": 60,
    "report.held_out_views": 1,
    "report.virtual_views": 1,
}


@dataclass
class FramesRead:
    """Frames that stages were given, and their images as they were read."""

    frames: list[EndoscopicSequence] = field(default_factory=list)
    as_read: list[dict[str, np.ndarray]] = field(default_factory=list)


def images_of(frames: EndoscopicSequence) -> dict[str, np.ndarray]:
    """All arrays of a sequence, by name."""
    return {name: value for name, value in vars(frames).items() if isinstance(value, np.ndarray)}


def tiny_config(**overrides: Any) -> PipelineConfig:
    """The tiny settings, and overrides with `__` for the dot."""
    more = {name.replace("__", "."): value for name, value in overrides.items()}
    return profile_config("quick").with_overrides({**TINY, **more})


@contextmanager
def spared() -> Iterator[None]:
    """Most of what a tiny run would cost, and what other packages prove, is not paid for by every run.

    A process renders each phantom once, draws equal pictures of reports once, and reads the certificates of
    its clients once, none of which goes beyond this machine; surfaces are fused at a third of the usual
    resolution, and compared at a tenth of the usual samples.
    """
    rendered = functools.cache(data_catalog.phantom.recording.record)
    coarse = extrags.metrics.surface.FUSED_WHOLE.model_copy(update={"voxel_share": 1 / 32})

    def record(config: PhantomConfig, name: str) -> EndoscopicSequence:
        # A copy, as a rendering would be: nobody sees what others write into theirs.
        return copy.deepcopy(rendered(config, name))

    with (
        patch.object(data_catalog.phantom.recording, "record", record),
        patch.object(extrags.metrics.surface, "N_SAMPLES", 3000),
        patch.object(extrags.metrics.surface, "FUSED_WHOLE", coarse),
        patch.object(ssl, "create_default_context", functools.cache(ssl.create_default_context)),
        drawn_once(),
    ):
        yield


if __name__ == "__main__":
    with spared():
        ended = run_sequence(SEQUENCE, tiny_config(), sys.argv[1], DirectRunner(sys.argv[1]), profile="quick")
    print(*[f"{row.stage}={row.state}" for row in ended.stages])


def settled(store: str) -> list[str]:
    """The options of a command on a finished run of `tiny_config` in a store."""
    settings = [part for name, value in TINY.items() for part in ("--set", f"{name}={json.dumps(value)}")]
    return ["--profile", "quick", "--store", store, *settings]
