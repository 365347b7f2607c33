"""The model of a data set on many workers, against cases that can be worked out by hand."""

from __future__ import annotations

import pytest

from extrags.store import Manifest
from tests.benchmarks.model_dataset import (
    Task,
    by_sequence,
    by_task,
    fitted,
    lines,
    model,
    sequence_tasks,
    video_frames,
)


def test_workers_take_the_next_sequence_when_they_are_free() -> None:
    assert by_sequence([4, 1, 1, 1, 1], 1) == 8
    assert by_sequence([4, 1, 1, 1, 1], 2) == 4
    assert by_sequence([1, 1, 1, 1, 4], 2) == 6
    assert by_sequence([4], 64) == 4


def test_tasks_of_a_sequence_share_the_workers() -> None:
    chain = [Task("first", 1), Task("side by side", 2, width=4), Task("last", 1)]
    assert by_task([chain], 1) == 1 + 8 + 1
    assert by_task([chain], 4) == 1 + 2 + 1
    assert by_task([chain], 3) == 1 + 4 + 1
    # The second sequence fills what the first leaves idle.
    assert by_task([[Task("a", 2)], [Task("b", 1), Task("c", 1)]], 2) == 2


def test_the_line_is_that_of_most_points() -> None:
    straight = [(10 * number, 1 + 2.0 * number) for number in range(1, 6)]
    assert fitted([*straight, (60, 80.0)]) == (pytest.approx(1.0), pytest.approx(0.2))
    assert fitted([(10, 3.0), (20, 5.0), (30, 7.0)]) == (pytest.approx(1.0), pytest.approx(0.2))
    assert fitted([(10, 3.0)]) == (3.0, 0.0)
    base, slope = fitted([(10, 3.0), (20, 1.0)])
    assert slope == 0
    assert base == 2


def finished(label: str, frames: int, branches: int) -> list[Manifest]:
    tasks = [("ingest", 0.5 * frames), *[("explore-branch", 3.0)] * branches, ("coarse", 10.0)]
    return [
        Manifest(
            stage=stage,
            version=1,
            key=f"{stage}-v1-{label}{number}",
            digest="",
            label=label,
            seconds=seconds,
            started=f"2026-01-01T00:00:{number:02}",
            counts={"frames": frames} if stage == "ingest" else {},
        )
        for number, (stage, seconds) in enumerate(tasks)
    ]


def test_times_are_read_from_manifests() -> None:
    times = lines([*finished("a", 10, 2), *finished("b", 30, 2)])
    assert list(times) == ["ingest", "explore-branch", "coarse"]
    assert times["ingest"].seconds(20) == pytest.approx(10)
    assert times["coarse"].per_frame == 0
    chain = sequence_tasks(times, 20)
    assert [(task.name, task.width) for task in chain] == [
        ("ingest", 1),
        ("explore-branch", 2),
        ("coarse", 1),
    ]


def test_the_published_videos_are_all_there() -> None:
    frames = video_frames()
    assert (len(frames), sum(frames.values())) == (169, 67_886)


def test_no_number_of_workers_is_quicker_than_the_longest_sequence() -> None:
    found = model([*finished("a", 10, 2), *finished("b", 30, 2)], overhead_s=1.0)
    first, *_, last = found["rows"]
    assert first["longest first"]["efficiency"] == pytest.approx(1)
    path = found["critical_path"]
    assert path["sequence"] == "c1_cecum_t4_v2"
    for way in ("as listed", "longest first"):
        assert last[way]["hours"] * 3600 >= path["seconds_with_a_worker_of_its_own"] - 1e-6
    assert last["tasks"]["hours"] * 3600 >= path["seconds_with_workers_for_all_its_tasks"] - 1e-6
