"""What a data set costs on 1 to 64 workers: `python -m tests.benchmarks.model_dataset STORE ...`.

Simulates C3VDv2's 169 registered videos. How long each task takes is fitted to the manifests of a store of
finished runs: seconds = a + b * frames, both at least 0, one robust line per task. Workers take one sequence
after another (`reconstruct-dataset` with `at_once`, or deployed runs on workers of a pool), or one task after
another (Dask: waves and batches of all sequences share the workers).

Efficiency is work / (workers * end of the last). What bounds it is named: the chain of stages of one
sequence, since no number of workers makes the last one shorter.
"""

from __future__ import annotations

import argparse
import heapq
import json
import statistics
from collections import defaultdict
from collections.abc import Sequence
from dataclasses import dataclass
from importlib.resources import files
from itertools import pairwise
from typing import Any

from extrags.store import Manifest, Store
from tasks.progress import IN_PARALLEL

WORKERS = (1, 2, 4, 8, 16, 32, 64)


@dataclass(frozen=True)
class Task:
    """One task of one sequence; `width` of them may run side by side."""

    name: str
    seconds: float
    width: int = 1


@dataclass(frozen=True)
class Line:
    """seconds = base + per_frame * frames."""

    base: float
    per_frame: float
    width: float
    """Mean number of such tasks per sequence."""

    def seconds(self, frames: int) -> float:
        return self.base + self.per_frame * frames


def video_frames() -> dict[str, int]:
    """Frames of the registered videos by name."""
    text = files("data_catalog.c3vd").joinpath("videos.json").read_text(encoding="utf-8")
    published = json.loads(text)["c3vdv2"]
    return {
        f"{segment}_{texture}_{video}": frames
        for segment, textures in published["frames"].items()
        for texture, counts in textures.items()
        for video, frames in zip(published["videos"], counts, strict=True)
        if frames is not None
    }


def fitted(points: Sequence[tuple[int, float]]) -> tuple[float, float]:
    """A line by Theil and Sen (median of slopes), with neither a negative slope nor a negative start."""
    slopes = [
        (second[1] - first[1]) / (second[0] - first[0])
        for index, first in enumerate(points)
        for second in points[index + 1 :]
        if second[0] != first[0]
    ]
    slope = max(0.0, statistics.median(slopes)) if slopes else 0.0
    return max(0.0, statistics.median(seconds - slope * frames for frames, seconds in points)), slope


def lines(manifests: Sequence[Manifest]) -> dict[str, Line]:
    """How long each task takes, in the order in which tasks run."""
    frames = {
        manifest.label: int(manifest.counts["frames"] or 0)
        for manifest in manifests
        if manifest.stage == "ingest" and "frames" in manifest.counts
    }
    by_task: dict[str, dict[str, list[float]]] = defaultdict(lambda: defaultdict(list))
    for manifest in sorted(manifests, key=lambda manifest: manifest.started):
        if manifest.label in frames:
            by_task[manifest.stage][manifest.label].append(manifest.seconds)
    found = {}
    for task, by_label in by_task.items():
        points = [(frames[label], statistics.mean(seconds)) for label, seconds in by_label.items()]
        base, per_frame = fitted(points)
        found[task] = Line(base, per_frame, statistics.mean(map(len, by_label.values())))
    return found


def sequence_tasks(times: dict[str, Line], frames: int) -> list[Task]:
    """The chain of tasks of a sequence; those that run side by side are one entry."""
    return [
        Task(name, line.seconds(frames), max(1, round(line.width)))
        if name in IN_PARALLEL
        else Task(name, line.seconds(frames) * max(1.0, line.width))
        for name, line in times.items()
    ]


def by_sequence(durations: Sequence[float], workers: int) -> float:
    """End of the last sequence, when each worker takes the next one as soon as it is free."""
    free = [0.0] * workers
    for duration in durations:
        heapq.heappush(free, heapq.heappop(free) + duration)
    return max(free)


def by_task(sequences: Sequence[Sequence[Task]], workers: int) -> float:
    """End of the last task, when all workers take tasks of all sequences, earlier sequences first."""
    free = workers
    now = 0.0
    ready: list[tuple[int, int, float]] = []
    """(sequence, number, seconds)"""
    running: list[tuple[float, int]] = []
    stage = [-1] * len(sequences)
    left = [0] * len(sequences)
    number = 0

    def advance(index: int) -> None:
        nonlocal number
        stage[index] += 1
        if stage[index] < len(sequences[index]):
            task = sequences[index][stage[index]]
            left[index] = task.width
            for _ in range(task.width):
                heapq.heappush(ready, (index, number, task.seconds))
                number += 1

    for index in range(len(sequences)):
        advance(index)
    while ready or running:
        while ready and free:
            index, _, seconds = heapq.heappop(ready)
            heapq.heappush(running, (now + seconds, index))
            free -= 1
        now, index = heapq.heappop(running)
        free += 1
        left[index] -= 1
        if left[index] == 0:
            advance(index)
    return now


def model(manifests: Sequence[Manifest], overhead_s: float) -> dict[str, Any]:
    """Efficiency by number of workers, for both ways and both orders, and what bounds it."""
    times = lines(manifests)
    chains = {name: sequence_tasks(times, frames) for name, frames in video_frames().items()}
    chains = {name: [*chain, Task("overhead", overhead_s)] for name, chain in chains.items()}
    work = {name: sum(task.seconds * task.width for task in chain) for name, chain in chains.items()}
    alone = {name: sum(task.seconds for task in chain) for name, chain in chains.items()}
    total = sum(work.values())
    longest_first = sorted(work, key=lambda name: -work[name])
    rows = []
    for workers in WORKERS:
        ends = {
            "as listed": by_sequence([work[name] for name in work], workers),
            "longest first": by_sequence([work[name] for name in longest_first], workers),
            "tasks": by_task([chains[name] for name in longest_first], workers),
        }
        rows.append(
            {
                "workers": workers,
                **{
                    way: {"hours": end / 3600, "efficiency": total / (workers * end)}
                    for way, end in ends.items()
                },
            }
        )
    last = max(alone, key=lambda name: alone[name])
    shares = {task.name: task.seconds / alone[last] for task in chains[last]}
    return {
        "sequences": len(work),
        "frames": sum(video_frames().values()),
        "work_hours": total / 3600,
        "shortest_s": min(work.values()),
        "longest_s": max(work.values()),
        "rows": rows,
        "critical_path": {
            "sequence": last,
            "seconds_with_a_worker_of_its_own": work[last],
            "seconds_with_workers_for_all_its_tasks": alone[last],
            "largest_shares": dict(sorted(shares.items(), key=lambda item: -item[1])[:6]),
        },
        "lines": {
            name: {"base_s": line.base, "per_frame_s": line.per_frame, "tasks": line.width}
            for name, line in times.items()
        },
    }


def as_text(found: dict[str, Any]) -> str:
    """A table for people."""
    ways = [name for name in found["rows"][0] if name != "workers"]
    said = [
        f"{found['sequences']} sequences of {found['frames']} frames: {found['work_hours']:.2f} h of work, "
        f"{found['shortest_s']:.0f} to {found['longest_s']:.0f} s each",
        "workers  " + "  ".join(f"{way:>22}" for way in ways),
    ]
    for row in found["rows"]:
        cells = [f"{row[way]['hours']:11.3f} h {row[way]['efficiency']:7.1%}" for way in ways]
        said.append(f"{row['workers']:7}  " + "  ".join(f"{cell:>22}" for cell in cells))
    path = found["critical_path"]
    shares = ", ".join(f"{name} {share:.0%}" for name, share in path["largest_shares"].items())
    said.append(
        f"critical path: {path['sequence']}, {path['seconds_with_a_worker_of_its_own']:.0f} s on one worker, "
        f"{path['seconds_with_workers_for_all_its_tasks']:.0f} s on as many as it can use ({shares})"
    )
    return "\n".join(said)


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("stores", nargs="+", help="with runs, of several numbers of frames among them")
    parser.add_argument(
        "--overhead", type=float, default=0.0, metavar="S", help="of each sequence, in seconds"
    )
    parser.add_argument("--json", action="store_true")
    given = parser.parse_args()
    manifests = [
        manifest.model_copy(update={"label": f"{store} {manifest.label}"})
        for store in given.stores
        for manifest in Store(store).ls()
    ]
    found = model(manifests, given.overhead)
    efficiencies = [row["longest first"]["efficiency"] for row in found["rows"]]
    assert all(later <= earlier + 1e-9 for earlier, later in pairwise(efficiencies)), efficiencies
    print(json.dumps(found, indent=1) if given.json else as_text(found))


if __name__ == "__main__":
    main()
