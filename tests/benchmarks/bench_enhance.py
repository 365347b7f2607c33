"""What restoration is worth: `python -m tests.benchmarks.bench_enhance table|downstream|realism`.

* `table`: restorers on held-out views with real degraded renders, over sequences and seeds; a markdown table
  of what each gains over no restoration and over the classical fill, mean and smallest..largest.
* `downstream`: what pseudo-observations bring to the scene. Per sequence and seed one coarse scene, explored
  as the pipeline explores it, fine-tuned once per arm, always from that same coarse scene and always with the
  same number of steps on real views. An arm with pseudo-observations takes `finetune.iterations` steps, of
  which a fixed pattern gives R to real views; the arm `real` is fine-tuned for R steps, with its schedule
  compressed to them: rates start and end where the other arms' do, densification ends at the same share, and
  is run fewer times because it comes every so many steps.
* `realism`: real tissue. Laparoscopy frames with holes cut out and parts blurred, without depth or real views
  to borrow from, by a restorer that has never seen them (but is told their hues, as it is of any scene); and
  held-out views of the real sinus. Writes contact sheets.

Nothing is cached: every figure belongs to the code it was run with. `--json FILE` is written anew after every
sequence and seed, so that a long run can be looked at.
"""

from __future__ import annotations

import argparse
import json
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import torch

from data_catalog.catalog import read, resolve
from extrags.config import PipelineConfig
from extrags.evaluation import render
from extrags.in_memory_pipeline import InMemoryPipeline
from extrags.metrics.image import mean_of_known, psnr
from extrags.metrics.lpips import LpipsByNet
from extrags.metrics.protocol import evaluate_views
from extrags.metrics.registry import figures, metric_named
from extrags.raster import set_num_threads
from extrags.raster.bench import machine
from extrags.restoration.backends import load_enhancer
from extrags.restoration.benchmark.comparison import (
    check_methods,
    coarse_scene,
    compare_methods,
    prepared,
    with_suffix,
)
from extrags.restoration.benchmark.evaluation import (
    RestorerBenchmark,
    TrueViews,
    held_out_clips,
    restore_views,
)
from extrags.restoration.clips import choose_views, make_pseudo_observations
from extrags.restoration.diffusion.embedded import EmbeddedEnhancer
from extrags.restoration.protocol import Enhancer
from extrags.scene import Scene
from extrags.sequence import EndoscopicSequence
from extrags.training import finetune
from extrags.training.finetuning import virtual_steps
from extrags.view_synthesis.gamut import Gamut
from extrags.view_synthesis.gather import gather_references
from extrags.zarr_io import group_exists
from flows.commands.common import parsed_settings
from flows.settings import pipeline_config
from tasks.weights import lpips_by_net, lpips_weights
from tests.benchmarks.degraded_frames import FromItself, contact_sheet, laparoscopy_benchmark

Case = dict[str, Any]
Sink = Callable[[list[Case]], None]


def loaded(name: str, config: PipelineConfig) -> EndoscopicSequence:
    """A sequence by name, or from what `EndoscopicSequence.save` wrote."""
    if group_exists(Path(name)):
        return EndoscopicSequence.load(Path(name))
    return read(resolve(name), config.ingest)


def perceptual(config: PipelineConfig) -> LpipsByNet:
    return lpips_by_net(lpips_weights(config.evaluate))


# table


def table(names: list[str], methods: list[str], configs: list[PipelineConfig], sink: Sink) -> list[Case]:
    cases: list[Case] = []
    for name in names:
        for config in configs:
            begun = time.perf_counter()
            scene, posed = coarse_scene(loaded(name, config), config.coarse)
            seconds = time.perf_counter() - begun
            found = compare_methods(scene, posed, config, methods, perceptual(config))
            cases += [{**case, "coarse_seconds": seconds} for case in found]
            sink(cases)
    return cases


MEASURED = {figure.label: (figure.key,) for figure in figures("restoration")}
RESTORED = {
    **MEASURED,
    "aligned": ("aligned", "psnr"),
    "aligned well": ("aligned", "well", "psnr"),
    "aligned hole": ("aligned", "hole", "psnr"),
    "aligned kept well": ("aligned", "kept", "well", "psnr"),
    "well": ("well", "psnr"),
    "hole": ("hole", "psnr"),
    "unobserved": ("unobserved", "psnr"),
    "kept PSNR": ("kept", "psnr"),
    "kept well": ("kept", "well", "psnr"),
    "rank corr.": ("calibration", "rank_correlation"),
    "aligned rank corr.": ("aligned", "calibration", "rank_correlation"),
    "hole depth": ("hole_depth_error", "mean"),
    "hole depth, median": ("hole_depth_error", "median"),
    "error flicker": ("error_flicker",),
    "s/frame": ("seconds_per_frame",),
    "prepared in s": ("prepare_seconds",),
}
EVALUATED = {
    figure.label: tuple(figure.name.split("."))
    for figure in figures("columns")
    if metric_named(figure.key).kind != "surface"
}
FINE_TUNED = {
    **EVALUATED,
    "training PSNR": ("train_psnr",),
    "fine-tuned in s": ("seconds", "finetune"),
}


def markdown(
    cases: list[Case], figures: dict[str, tuple[str, ...]], key: str, baselines: list[str], gained: list[str]
) -> str:
    """Means of every figure, then gains over each baseline: mean (smallest..largest) over all runs.

    LPIPS is given as a multiple of the baseline's.
    """
    rows = list(dict.fromkeys(case[key] for case in cases))
    blocks = [f"Means over {len({(c['sequence'], c['seed']) for c in cases})} runs.\n"]
    cells = [
        [_mean([_at(c, path) for c in cases if c[key] == row]) for path in figures.values()] for row in rows
    ]
    blocks.append(
        _markdown_table([key, *figures], [[row, *line] for row, line in zip(rows, cells, strict=True)])
    )
    for baseline in baselines:
        if baseline not in rows:
            continue
        paths = {name: figures[name] for name in gained}
        lines = [
            [row, *(_gain(cases, key, row, baseline, name, path) for name, path in paths.items())]
            for row in rows
            if row != baseline
        ]
        blocks.append(f"\nGains over `{baseline}`, mean (smallest..largest).\n")
        blocks.append(_markdown_table([key, *paths], lines))
    return "\n".join(blocks) + "\n"


def _gain(cases: list[Case], key: str, row: str, baseline: str, name: str, path: tuple[str, ...]) -> str:
    found = {(c["sequence"], c["seed"], c[key]): _at(c, path) for c in cases}
    pairs = [
        (value, found.get((sequence, seed, baseline)))
        for (sequence, seed, which), value in found.items()
        if which == row
    ]
    known = [(own, other) for own, other in pairs if own is not None and other is not None]
    if not known:
        return "-"
    if name.startswith("LPIPS"):
        ratios = [own / other for own, other in known]
        if len(ratios) == 1:
            return f"x{ratios[0]:.2f}"
        return f"x{np.mean(ratios):.2f} ({min(ratios):.2f}..{max(ratios):.2f})"
    gains = [own - other for own, other in known]
    if len(gains) == 1:
        return f"{gains[0]:+.3g}"
    return f"{np.mean(gains):+.3g} ({min(gains):+.3g}..{max(gains):+.3g})"


def _at(case: Case, path: tuple[str, ...]) -> float | None:
    value: Any = case
    for part in path:
        value = None if value is None else value.get(part)
    return None if value is None else float(value)


def _mean(values: list[float | None]) -> str:
    mean = mean_of_known(values)
    return "-" if mean is None else f"{mean:.4g}"


def _markdown_table(header: list[str], rows: list[list[str]]) -> str:
    lines = [header, ["---"] * len(header), *rows]
    return "\n".join("| " + " | ".join(line) + " |" for line in lines)


# downstream


@contextmanager
def timed(seconds: dict[str, float], part: str) -> Iterator[None]:
    begun = time.perf_counter()
    yield
    seconds[part] = time.perf_counter() - begun


def downstream(names: list[str], arms: list[str], configs: list[PipelineConfig], sink: Sink) -> list[Case]:
    cases: list[Case] = []
    for name in names:
        for config in configs:
            for case in _arms(loaded(name, config), arms, config):
                cases.append(case)
                sink(cases)
    return cases


def _arms(sequence: EndoscopicSequence, arms: list[str], config: PipelineConfig) -> Iterator[Case]:
    pipeline = InMemoryPipeline(sequence, config)
    pipeline.run_stages("explore")
    found, config = pipeline.result, pipeline.config
    if found.exploration is None:
        raise SystemExit(
            f"{sequence.name}: {found.skipped['explore']}; --set assess.force=true explores nevertheless"
        )
    scene, posed, shared = found.coarse, found.sequence, found.seconds
    training = posed.training_part()
    exploration, trajectories = found.exploration, found.exploration.trajectories
    chosen = choose_views([len(cameras) for cameras in trajectories], config.enhance.max_views)
    virtual = [cameras[views] for cameras, views in zip(trajectories, chosen, strict=True)]
    lpips = perceptual(config)
    references = gather_references(scene, training, training.train)
    before = [value.clone() for value in _contents(scene)]
    pattern = virtual_steps(config.finetune)
    real_steps = int((~pattern).sum())
    about = {
        "sequence": posed.name,
        "seed": config.finetune.seed,
        "trajectories": len(exploration),
        "virtual_views": sum(len(views) for views in virtual),
        "real_steps": real_steps,
    }
    yield {**about, "arm": "coarse", **held_out_figures(scene, posed, lpips), "seconds": dict(shared)}
    if "real" in arms:
        seconds = dict(shared)
        alone = config.finetune.model_copy(update={"iterations": real_steps})
        with timed(seconds, "finetune"):
            result = finetune(scene, training, None, alone, config.coarse)
        found = held_out_figures(result.scene, posed, lpips)
        yield {**about, "arm": "real", "steps": alone.iterations, **found, "seconds": seconds}
    restorers = [arm for arm in arms if arm != "real"]
    for arm, enhancer, preparation in prepared(restorers, scene, training, config.enhance, config.coarse):
        seconds = {**shared, "prepare": preparation}
        with timed(seconds, "restore"):
            pseudo = make_pseudo_observations(
                scene,
                references,
                virtual,
                enhancer,
                lpips_weights(config.evaluate)[0].perceptual_difference(),
                count=config.enhance.references,
                reference=config.enhance.reference,
                iou=config.enhance.iou,
            )
        with timed(seconds, "finetune"):
            result = finetune(scene, training, pseudo, config.finetune, config.coarse)
        if not all(torch.equal(a, b) for a, b in zip(before, _contents(scene), strict=True)):
            raise RuntimeError(
                f"{posed.name}: arm {arm} has changed the coarse scene that all arms start from"
            )
        found = held_out_figures(result.scene, posed, lpips)
        more = {"steps": config.finetune.iterations, "changed_share": pseudo.changed_share}
        yield {**about, "arm": arm, **more, **found, "seconds": seconds}


def _contents(scene: Scene) -> list[torch.Tensor]:
    gaussians = scene.gaussians
    contents = [gaussians.means, gaussians.quats, gaussians.scales, gaussians.opacities, gaussians.sh]
    return contents if scene.light is None else [*contents, *scene.light.parameters().values()]


def held_out_figures(scene: Scene, sequence: EndoscopicSequence, lpips: LpipsByNet) -> Case:
    """Metrics of the protocol on held-out views, and the PSNR of the training views."""
    frames = np.asarray(sequence.test)
    metrics = evaluate_views(render(scene, sequence, frames), sequence, frames, lpips).metrics
    train = np.asarray(sequence.train)
    shown = torch.from_numpy(render(scene, sequence, train).rgb).clamp(0, 1)
    truth = torch.from_numpy(sequence.rgb[train].astype(np.float32) / 255)
    return {**metrics, "train_psnr": psnr(shown, truth, torch.from_numpy(sequence.mask[train]))}


# realism


def realism(
    methods: list[str],
    config: PipelineConfig,
    *,
    trained_on: str,
    restorer: Path | None,
    frames: int,
    folder: Path,
    sink: Sink,
) -> list[Case]:
    cases: list[Case] = []
    lpips = perceptual(config)
    benchmark = laparoscopy_benchmark(frames, config.enhance.seed, lpips)
    simple = [name for name in methods if name in ("none", "classical")]
    scene, posed = coarse_scene(loaded(trained_on, config), config.coarse)
    wanted = simple if restorer is not None else methods
    strangers: list[tuple[str, Enhancer]] = []
    if wanted:
        made = prepared(wanted, scene, posed.training_part(), config.enhance, config.coarse)
        strangers = [(name, enhancer) for name, enhancer, _ in made]
    if restorer is not None:
        strangers.append((restorer.name, load_enhancer(restorer)))
    # As a scene's own frames would bound it.
    truth = torch.from_numpy(benchmark.truth.rgb).permute(0, 3, 1, 2)
    hues = Gamut.of_images(truth, torch.ones_like(truth[:, :1]))
    strangers = [
        (name, replace(enhancer, gamut=hues) if isinstance(enhancer, EmbeddedEnhancer) else enhancer)
        for name, enhancer in strangers
    ]
    strangers = [(name, FromItself(name, enhancer, config.enhance)) for name, enhancer in strangers]
    cases += shown(benchmark, strangers, folder / "laparoscopy.png", "laparoscopy", config.enhance.seed)
    sink(cases)
    scene, posed = coarse_scene(loaded("sinus/hopkins", config), config.coarse)
    training = posed.training_part()
    references = gather_references(scene, training, training.train)
    test = np.asarray(posed.test)
    clips = held_out_clips(scene, references, posed, test, count=config.enhance.references)
    natives = prepared(methods, scene, training, config.enhance, config.coarse)
    own = [(name, with_suffix(name, enhancer, references, config.enhance)) for name, enhancer, _ in natives]
    benchmark = RestorerBenchmark(clips, TrueViews.of_sequence(posed, test), lpips)
    cases += shown(benchmark, own, folder / "sinus.png", posed.name, config.enhance.seed)
    sink(cases)
    return cases


def shown(
    benchmark: RestorerBenchmark, restorers: list[tuple[str, Enhancer]], file: Path, sequence: str, seed: int
) -> list[Case]:
    """Figures of each restorer, and a contact sheet: truth, rendering, restorations."""
    columns = {"truth": benchmark.truth.rgb}
    cases = []
    for name, enhancer in restorers:
        restored = restore_views(enhancer, benchmark.clips)
        columns[name] = restored.rgb
        found = benchmark.figures(restored)
        cases.append({"sequence": sequence, "seed": seed, "method": name, **found})
    contact_sheet(columns, file)
    return cases


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else None)
    parser.add_argument("what", choices=("table", "downstream", "realism"))
    parser.add_argument("--sequences", nargs="+", default=[f"phantom/{k}@distanced" for k in range(5)])
    parser.add_argument("--methods", nargs="+", default=["none", "classical", "embedded"])
    parser.add_argument("--arms", nargs="+", default=["real", "classical", "embedded"])
    parser.add_argument("--profile", default="quick")
    parser.add_argument("--set", dest="settings", action="append", default=[], metavar="NAME=VALUE")
    parser.add_argument("--seeds", nargs="+", type=int, default=[0])
    parser.add_argument("--threads", type=int, help="of torch and of the kernels (default: theirs)")
    parser.add_argument("--json", default="-", metavar="FILE|-")
    parser.add_argument("--trained-on", default="phantom/11@sparse", help="realism: where strangers learned")
    parser.add_argument("--restorer", type=Path, help="realism: a saved restorer instead")
    parser.add_argument("--frames", type=int, default=16, help="realism: laparoscopy frames")
    parser.add_argument("--sheets", type=Path, default=Path(), help="realism: folder for contact sheets")
    given = parser.parse_args()
    if given.threads is not None:
        torch.set_num_threads(given.threads)
        set_num_threads(given.threads)
    settings = parsed_settings(given.settings)
    configs = [pipeline_config(given.profile, settings, seed) for seed in given.seeds]
    methods = check_methods(given.methods)
    check_methods(arm for arm in [*given.arms, "none"] if arm != "real")

    def sink(cases: list[Case]) -> None:
        sys.stderr.write(f"{cases[-1]['sequence']} seed {cases[-1]['seed']} done, {len(cases)} cases\n")
        if given.json != "-":
            text = json.dumps({"machine": machine(), "profile": given.profile, "cases": cases}, indent=1)
            Path(given.json).write_text(text + "\n")

    quality = [*MEASURED, "well", "hole", "unobserved", "kept PSNR", "kept well"]
    if given.what == "table":
        cases = table(given.sequences, methods, configs, sink)
        said = markdown(cases, RESTORED, "method", ["none", "classical"], quality)
    elif given.what == "downstream":
        cases = downstream(given.sequences, given.arms, configs, sink)
        said = markdown(
            cases,
            FINE_TUNED,
            "arm",
            ["real", "classical"],
            [*EVALUATED, "training PSNR"],
        )
    else:
        cases = realism(
            methods,
            configs[0],
            trained_on=given.trained_on,
            restorer=given.restorer,
            frames=given.frames,
            folder=given.sheets,
            sink=sink,
        )
        said = "\n".join(
            f"{name}\n\n"
            + markdown([c for c in cases if c["sequence"] == name], RESTORED, "method", ["none"], quality)
            for name in dict.fromkeys(case["sequence"] for case in cases)
        )
    if given.json == "-":
        sys.stdout.write(json.dumps({"machine": machine(), "profile": given.profile, "cases": cases}) + "\n")
    (sys.stderr if given.json == "-" else sys.stdout).write(said)
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
