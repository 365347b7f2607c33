from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from extrags.config import CoarseConfig, DensifyConfig, FinetuneConfig
from extrags.sequence import EndoscopicSequence
from extrags.store import Slot, Store
from extrags.training.frame_weights import FrameWeights, frame_weights
from tasks.coarse import coarse, refined_frames
from tasks.finetune import finetune
from tasks.stage import stage
from tests.extrags.training.textured_plane import blurred_along_rows, changed, textured_plane

CONFIG = CoarseConfig(iterations=20, max_points=300, densify=DensifyConfig(enabled=False))


@stage("test-blurred", version=1)
def one_blurred(slot: Slot) -> None:
    plane = textured_plane()
    slot.save(changed(plane, 3, blurred_along_rows(plane.rgb[3], 9)))


def test_blurred_frames_stand_in_artefact_and_counts(tmp_path: Path) -> None:
    store = str(tmp_path)
    done = coarse.fn(store=store, sequence=one_blurred.fn(store=store), config=CONFIG)
    rows = Store(store).load_json(FrameWeights.stored_as, done)
    assert [row["frame"] for row in rows if row["weight"] < 1] == ["003.png"]
    said = Store(store).manifest(done).counts["inconsistent_frames"]
    assert isinstance(said, str)
    assert said.startswith("frame 003.png is blurred")


def test_nothing_is_said_where_nothing_is_looked_for(tmp_path: Path) -> None:
    store = str(tmp_path)
    config = CONFIG.model_copy(update={"inconsistent_frames": "ignore"})
    done = coarse.fn(store=store, sequence=one_blurred.fn(store=store), config=config)
    assert "inconsistent_frames" not in Store(store).manifest(done).counts
    assert not (Store(store).open(done) / FrameWeights.stored_as).exists()


def test_finetuning_does_not_look_for_blurred_frames_again(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    store = str(tmp_path)
    config = CONFIG.model_copy(update={"inconsistent_frames": "weight"})
    sequence = one_blurred.fn(store=store)
    scene = coarse.fn(store=store, sequence=sequence, config=config)

    def compared(*_: object) -> None:
        raise AssertionError("looked for blurred frames again")

    monkeypatch.setattr("extrags.training.frame_weights.frame_weights", compared)
    settings = FinetuneConfig(iterations=3, densify_share=0.0)
    finetune.fn(
        store=store, scene=scene, sequence=sequence, pseudo_views=None, config=settings, coarse=config
    )


def test_where_poses_were_refined_frames_are_compared_anew(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    store = str(tmp_path)
    config = CONFIG.model_copy(update={"inconsistent_frames": "weight", "refine_poses": True})
    sequence = one_blurred.fn(store=store)
    scene = coarse.fn(store=store, sequence=sequence, config=config)
    refined = refined_frames.fn(store=store, sequence=sequence, coarse=scene)
    looked: list[int] = []

    def compared(frames: EndoscopicSequence, chosen: np.ndarray) -> FrameWeights | None:
        looked.append(len(chosen))
        return frame_weights(frames, chosen)

    monkeypatch.setattr("extrags.training.frame_weights.frame_weights", compared)
    settings = FinetuneConfig(iterations=3, densify_share=0.0)
    finetune.fn(store=store, scene=scene, sequence=refined, pseudo_views=None, config=settings, coarse=config)
    assert len(looked) == 1
