from __future__ import annotations

from pathlib import Path

from extrags.config import CoarseConfig, DensifyConfig
from extrags.store import Slot, Store
from tasks.coarse import FRAME_WEIGHTS, coarse
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
    rows = Store(store).load_json(FRAME_WEIGHTS, done)
    assert [row["frame"] for row in rows if row["weight"] < 1] == ["003.png"]
    said = Store(store).manifest(done).counts["inconsistent_frames"]
    assert isinstance(said, str)
    assert said.startswith("frame 003.png is blurred")


def test_nothing_is_said_where_nothing_is_looked_for(tmp_path: Path) -> None:
    store = str(tmp_path)
    config = CONFIG.model_copy(update={"inconsistent_frames": "ignore"})
    done = coarse.fn(store=store, sequence=one_blurred.fn(store=store), config=config)
    assert "inconsistent_frames" not in Store(store).manifest(done).counts
    assert not (Store(store).open(done) / FRAME_WEIGHTS).exists()
