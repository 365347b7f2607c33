"""Two builds of the kernels side by side: `python -m tests.benchmarks.bench_builds OLD NEW`.

OLD and NEW are folders that hold a package `extrags` with its compiled kernels. Each runs lit training
iterations (harmonics of degree 3, L1 + SSIM, Adam) of the scene of `bench_scene` in a process of its own;
they take turns, one iteration at a time, so that a busy machine slows both alike. Printed are the medians
and the paired ratios OLD / NEW with their 10 % and 90 % quantiles, of processor and of wall time, and the
relative difference of the gradients: 0 means the same bits.
"""

from __future__ import annotations

import argparse
import json
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import numpy as np

LIGHT = (1, 1, 1, 0.1, 1, 1, 0.5, 0, 0, 0, 0.2)
"""Exposure, softening, exponent, spread, cosine, offset and shoulder."""
HIGHLIGHTS = (0.2, 0.15)
GLARE = (0.1, 0.05, 0.07)
"""Strength and roughness of highlights, and glare, which builds of before there were any do not take."""
REFERENCE_DISTANCE = 1


def serve(root: Path, width: int, height: int, n_gaussians: int, threads: int, gradients: Path) -> None:
    """Run one iteration for each line on the standard input; print its wall and processor seconds."""
    # The finder of an editable installation would go first.
    sys.meta_path[:] = [finder for finder in sys.meta_path if "Redirect" not in type(finder).__name__]
    sys.path.insert(0, str(root))
    import torch

    from extrags.raster import native
    from extrags.raster.adam import SelectiveAdam
    from extrags.raster.bench import BenchSize, bench_scene
    from extrags.raster.direct import DirectStep, Target

    if not Path(native.compiled_kernels().__file__).is_relative_to(root):
        raise RuntimeError(f"{root} holds no compiled kernels")
    torch.set_num_threads(1)
    native.set_num_threads(threads)
    scene = bench_scene(BenchSize(width, height, n_gaussians))
    parameters = {name: scene[name].clone() for name in ("means", "quats", "opacities", "sh")}
    parameters["scales"] = scene["scales"].log()
    parameters["opacities"] = parameters["opacities"].logit()
    for value in parameters.values():
        value.requires_grad_()
    # Rates so small that the scene stays what it is
    adam = SelectiveAdam(parameters, dict.fromkeys(parameters, 1e-9))
    target = Target(scene["viewmats"][0].numpy(), scene["Ks"][0].numpy(), scene["target"][0])
    step = DirectStep(lit=True)
    step.bind(parameters)
    row = [*LIGHT, *HIGHLIGHTS, *GLARE]
    row = [*row[: len(step.light_gradient) - 1], REFERENCE_DISTANCE]
    light = np.array(row, dtype=np.float32)
    for index, _ in enumerate(sys.stdin):
        wall, processor = time.perf_counter(), time.process_time()
        step.run(target, sh_degree=3, light=light)
        adam.step(step.visible, step.gradients)
        print(json.dumps([time.perf_counter() - wall, time.process_time() - processor]), flush=True)
        if index == 0:
            arrays = {name: value.numpy() for name, value in step.gradients.items()}
            np.savez(gradients, light=step.light_gradient, **arrays)


def compare(roots: list[Path], case: list[int], rounds: int) -> None:
    """Run both builds in turns and print what came out."""
    with tempfile.TemporaryDirectory() as folder:
        files = [Path(folder) / f"{name}.npz" for name in ("old", "new")]
        workers = [
            subprocess.Popen(
                [sys.executable, __file__, "--serve", str(root), *map(str, case), str(file)],
                stdin=subprocess.PIPE,
                stdout=subprocess.PIPE,
                text=True,
            )
            for root, file in zip(roots, files, strict=True)
        ]
        seconds = np.empty((rounds + 2, 2, 2))
        for index in range(rounds + 2):
            for which in (0, 1) if index % 2 else (1, 0):
                stdin, stdout = workers[which].stdin, workers[which].stdout
                if stdin is None or stdout is None:
                    raise RuntimeError("a worker without pipes")
                print("go", file=stdin, flush=True)
                seconds[index, which] = json.loads(stdout.readline())
        for worker in workers:
            worker.communicate()
        old, new = (np.load(file) for file in files)
        differences = {
            name: float(np.linalg.norm(old[name] - new[name]) / max(np.linalg.norm(old[name]), 1e-30))
            for name in old.files
            if old[name].shape == new[name].shape  # The light has had fewer parameters.
        }
    width, height, n_gaussians, threads = case
    print(f"{width}x{height}, {n_gaussians} Gaussians, {threads} threads, {rounds} rounds")
    kept = 1e3 * seconds[2:]  # less the warm-up
    for kind, name in enumerate(("wall", "processor")):
        ratios = kept[:, 0, kind] / kept[:, 1, kind]
        medians = np.median(kept[:, :, kind], axis=0)
        low, high = np.quantile(ratios, (0.1, 0.9))
        print(
            f"  {name}: {medians[0]:.1f} -> {medians[1]:.1f} ms, "
            f"old / new {np.median(ratios):.3f} [{low:.3f}, {high:.3f}]"
        )
    print("  relative difference: " + ", ".join(f"{k} {v:.1e}" for k, v in differences.items()))


def main() -> None:
    """Parse the command line."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("old", type=Path)
    parser.add_argument("new", type=Path)
    parser.add_argument("--size", default="640x512", help="image size (default: %(default)s)")
    parser.add_argument("--gaussians", type=int, default=100_000)
    parser.add_argument("--threads", type=int, nargs="+", default=[1, 2])
    parser.add_argument("--rounds", type=int, default=20)
    given = parser.parse_args()
    width, height = map(int, given.size.split("x"))
    for threads in given.threads:
        compare(
            [given.old.resolve(), given.new.resolve()],
            [width, height, given.gaussians, threads],
            given.rounds,
        )


if __name__ == "__main__":
    if sys.argv[1:2] == ["--serve"]:
        serve(Path(sys.argv[2]), *(int(value) for value in sys.argv[3:7]), Path(sys.argv[7]))
    else:
        main()
