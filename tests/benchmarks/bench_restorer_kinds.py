"""Restorers on views of many kinds of cavity, from the scenes that `extrags pretrain --scenes-only` makes.

python -m tests.benchmarks.bench_restorer_kinds FOLDER --weights colons other=OUT --mix 0.5 --views 8

Every scene file of the folder (or those of one family, `--family cavities`) is restored in one step without a
judge: as rendered, by blending and filling, and by each of the weights, on at most so many of its views.
`--mix SHARE ...` takes weighted means of the first two weights as well (SHARE of the second): means of
weights that one training leads from one to the other are often better on both sides than either (Wortsman
et al., "Robust fine-tuning of zero-shot models", CVPR 2022). Views of the first weights are also shown with
texture laid onto them, and refined.

Weights must not have been trained on the scenes that they are compared on: `--last N` takes the last ones of
each family, which a training keeps for validation. Those for colons have never seen a cavity.
"""

from __future__ import annotations

import argparse
import copy
import json
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from data_catalog.cavities.shapes import KINDS
from extrags.metrics.image import mean_of_known
from extrags.metrics.lpips import Lpips
from extrags.restoration.benchmark.evaluation import RestorerBenchmark, TrueViews
from extrags.restoration.benchmark.variants import AsRendered, Textured
from extrags.restoration.classical import ClassicalEnhancer
from extrags.restoration.clips import as_images
from extrags.restoration.diffusion.embedded import EmbeddedEnhancer
from extrags.restoration.diffusion.weights import starting_weights
from extrags.restoration.protocol import Clip, Enhancer
from extrags.restoration.refinement.weights import bundled_refiner
from extrags.restoration.training_data.pretraining_scenes import PretrainingScene
from extrags.view_synthesis.gamut import Gamut

COLUMNS = ("psnr", "lpips_alex", "well.psnr", "hole.psnr", "hole.lpips_alex", "detail.hole")


def main() -> None:
    """Compare and print one table for each kind, and one of their means."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("folder", type=Path)
    parser.add_argument("--family", choices=("phantom", "cavities"), help="default: both")
    parser.add_argument(
        "--last", type=int, metavar="N", help="the last N scenes of each family; default: all"
    )
    parser.add_argument("--weights", nargs="+", default=["colons"], metavar="[NAME=]FOLDER")
    parser.add_argument("--mix", nargs="*", type=float, default=[], metavar="SHARE")
    parser.add_argument("--views", type=int, default=8, help="of each scene at most (default: 8)")
    parser.add_argument("--json", type=Path)
    given = parser.parse_args()
    restorers = dict(_restorers(given.weights, given.mix))
    lpips = {"alex": Lpips.load(net="alex")}
    rows: list[dict[str, Any]] = []
    for family in (given.family,) if given.family else ("phantom", "cavities"):
        files = sorted(given.folder.glob(f"{family}_*.safetensors"))
        for file in files[-given.last :] if given.last else files:
            number = int(file.stem.rpartition("_")[2])
            kind = "phantom" if family == "phantom" else str(KINDS[number % len(KINDS)])
            rows += _compared(file, kind, restorers, given.views, lpips)
            if given.json is not None:
                given.json.write_text(json.dumps(rows, indent=1) + "\n", encoding="utf-8")
            print(f"{file.name} ({kind})", flush=True)
    for kind in dict.fromkeys(row["kind"] for row in rows):
        _print(kind, [row for row in rows if row["kind"] == kind])
    _print("all cavities", [row for row in rows if row["kind"] != "phantom"])


def _restorers(weights: list[str], shares: list[float]) -> Iterator[tuple[str, Enhancer]]:
    yield "none", AsRendered()
    yield "classical", ClassicalEnhancer()
    loaded: list[EmbeddedEnhancer] = []
    for text in weights:
        name, _, place = text.rpartition("=")
        loaded.append(replace(EmbeddedEnhancer.load(starting_weights(place)), steps=1))
        yield name or place, loaded[-1]
    for share in shares:
        yield f"mean {share:g}", _mixed(loaded[0], loaded[1], share)


def _mixed(first: EmbeddedEnhancer, second: EmbeddedEnhancer, share: float) -> EmbeddedEnhancer:
    """The mean of two restorers' weights."""
    network, other = copy.deepcopy(first.network), second.network.state_dict()
    network.load_state_dict(
        {name: value.lerp(other[name], share) for name, value in network.state_dict().items()}
    )
    return replace(first, network=network)


def _compared(
    file: Path, kind: str, restorers: dict[str, Enhancer], most: int, lpips: dict[str, Lpips]
) -> list[dict[str, Any]]:
    scene = PretrainingScene.load(file)
    chosen = np.unique(np.linspace(0, len(scene.pairs) - 1, most).round().astype(int))
    pairs = scene.pairs.subset(chosen)
    clips = [
        Clip(
            index=index,
            cameras=scene.cameras[view : view + 1],
            layers=pairs.layers[index],
            transfer=scene.transfer,
            reference=np.zeros(1, dtype=np.int64),
            image_confidence=np.ones(1, dtype=np.float32),
        )
        for index, view in enumerate(chosen.tolist())
    ]
    truth = TrueViews(as_images(pairs.target), pairs.weight[:, 0].numpy() > 0)
    benchmark = RestorerBenchmark(clips, truth, lpips)
    gamut = Gamut.of_images(scene.references.images.float(), scene.references.valid[:, None].float())
    rows = []
    own: dict[str, Enhancer] = {
        name: replace(restorer, gamut=gamut) if isinstance(restorer, EmbeddedEnhancer) else restorer
        for name, restorer in restorers.items()
    }
    first = next((name for name, restorer in own.items() if isinstance(restorer, EmbeddedEnhancer)), None)
    if first is not None and scene.texture is not None:
        own[f"{first}, textured"] = Textured(own[first], scene.texture)
        own[f"{first}, refined"] = Textured(own[first], scene.texture, refiner=bundled_refiner())
    for name, restorer in own.items():
        figures = benchmark.evaluate(restorer)
        row = {"file": file.name, "kind": kind, "restorer": name}
        rows.append(row | {column: _at(figures, column) for column in COLUMNS})
    return rows


def _at(figures: dict[str, Any], column: str) -> float | None:
    found: Any = figures
    for part in column.split("."):
        found = None if found is None else found.get(part)
    # Of the detail the finest octave: what is missing there is what looks smooth.
    found = found[0] if isinstance(found, (list, tuple)) else found
    return None if found is None else float(found)


def _print(title: str, rows: list[dict[str, Any]]) -> None:
    if not rows:
        return
    scenes = len({row["file"] for row in rows})
    print(f"\n**{title}** ({scenes} scenes)\n\n| restorer | {' | '.join(COLUMNS)} |")
    print("|---|" + "---:|" * len(COLUMNS))
    for name in dict.fromkeys(row["restorer"] for row in rows):
        own = [row for row in rows if row["restorer"] == name]
        means = [mean_of_known([row[column] for row in own]) for column in COLUMNS]
        print(f"| {name} | {' | '.join('' if mean is None else f'{mean:.3f}' for mean in means)} |")


if __name__ == "__main__":
    main()
