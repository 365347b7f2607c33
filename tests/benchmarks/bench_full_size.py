"""Scenes of small and large frames on the same held-out frames at full size.

    python -m tests.benchmarks.bench_full_size SEQUENCE --widths 225 450 675 --store DIR

The last width is full size. Each scene is trained at its own width, as `extrags run` does, and its held-out
views are measured by the protocol against the frames of full size, in two ways: `rendered` at full size, and
`enlarged` bicubically from renders at its own width. What the store holds already is not made again.
"""

from __future__ import annotations

import argparse
import json
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

if TYPE_CHECKING:
    from extrags.config import PipelineConfig
    from extrags.metrics.protocol import RenderedViews
    from extrags.sequence import EndoscopicSequence

FIGURES = ("psnr", "ssim", "lpips_alex", "lpips_vgg", "flip", "depth_absrel")


def main() -> None:
    """Run, measure, print, write."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("sequence")
    parser.add_argument("--widths", nargs="+", type=int, default=[225, 450, 675], metavar="PX")
    parser.add_argument("--profile", default="balanced")
    parser.add_argument("--scene", choices=("coarse", "final"), default="final")
    parser.add_argument("--set", nargs="*", default=[], metavar="NAME=VALUE")
    parser.add_argument("--store", type=Path, required=True)
    parser.add_argument("--json", type=Path)
    given = parser.parse_args()
    rows = measured(given)
    for row in rows:
        print(" ".join(f"{name} {value}" for name, value in row.items()))
    if given.json is not None:
        given.json.write_text(json.dumps(rows, indent=1) + "\n", encoding="utf-8")


def measured(given: argparse.Namespace) -> list[dict[str, Any]]:
    """One row for each width and way of making views of full size."""
    from extrags.config import PipelineConfig, profile_config
    from extrags.config.settings import settings_of
    from extrags.evaluation import render
    from extrags.metrics.lpips import available_lpips
    from extrags.metrics.protocol import evaluate_views, figures_per_view
    from extrags.scene import Scene
    from extrags.sequence import EndoscopicSequence
    from extrags.store import Store
    from flows.runners import DirectRunner
    from flows.wiring import run_sequence

    store = Store(str(given.store))
    known = settings_of(PipelineConfig)
    overrides = {name: known[name].parse(text) for name, text in (item.split("=", 1) for item in given.set)}
    usual = profile_config(given.profile).with_overrides(overrides)
    scenes, frames = {}, {}
    until = "coarse" if given.scene == "coarse" else "finetune"
    for width in given.widths:
        config = usual
        if width != given.widths[-1]:
            config = usual.with_overrides(resized(source_size(given.sequence, usual), width))
        outcome = run_sequence(given.sequence, config, store.root, DirectRunner(store.root), until=until)
        if outcome.error is not None:
            raise outcome.error
        part = "finetune" if "finetune" in outcome.refs and given.scene == "final" else "coarse"
        scenes[width] = store.load(Scene, outcome.refs[part])
        frames[width] = store.load(EndoscopicSequence, outcome.refs["sequence"])
    truth = frames[given.widths[-1]]
    stacks = {}
    for width in given.widths:
        stacks[width, "rendered"] = render(scenes[width], truth)
        if width != given.widths[-1]:
            stacks[width, "enlarged"] = enlarged(render(scenes[width], frames[width]), truth)
    lpips = available_lpips(usual.evaluate)
    found = figures_per_view(list(stacks.values()), truth, truth.test, lpips)
    rows = []
    for ((width, way), views), per_view in zip(stacks.items(), found, strict=True):
        metrics = evaluate_views(views, truth, truth.test, lpips, per_view=per_view).metrics
        row: dict[str, Any] = {"sequence": truth.name, "scene": given.scene, "width": width, "way": way}
        row |= {name: _rounded(metrics.get(name)) for name in FIGURES}
        row |= {f"aligned.{name}": _rounded(metrics["aligned"].get(name)) for name in FIGURES[:5]}
        rows.append(row)
    return rows


def source_size(name: str, config: PipelineConfig) -> tuple[int, int]:
    """Width and height at which a sequence of the catalogue is read."""
    from data_catalog import describe
    from flows.workloads import read_size

    width, height = read_size(describe(name), config)
    return round(width), round(height)


def resized(size: tuple[int, int], width: int) -> dict[str, Any]:
    """Settings that read frames of another width in the same shape."""
    return {"ingest.width": width, "ingest.height": round(size[1] * width / size[0])}


def enlarged(views: RenderedViews, truth: EndoscopicSequence) -> RenderedViews:
    """Colours enlarged bicubically, depth and opacity by the nearest pixel."""
    import torch
    import torch.nn.functional as F

    size = (truth.height, truth.width)
    rgb = torch.from_numpy(views.rgb).movedim(-1, 1)
    larger = F.interpolate(rgb, size, mode="bicubic", align_corners=False).clamp(0, 1)
    rows = (np.arange(size[0]) + 0.5) * views.alpha.shape[1] // size[0]
    columns = (np.arange(size[1]) + 0.5) * views.alpha.shape[2] // size[1]
    nearest = (slice(None), rows.astype(int)[:, None], columns.astype(int)[None])
    return replace(
        views,
        rgb=larger.movedim(1, -1).numpy(),
        alpha=views.alpha[nearest],
        depth_mm=views.depth_mm[nearest],
    )


def _rounded(value: float | None) -> float | None:
    return None if value is None else round(value, 4)


if __name__ == "__main__":
    main()
