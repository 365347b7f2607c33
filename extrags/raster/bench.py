"""Run time and error of the rasteriser and of a whole training iteration.

Called by `extrags bench raster|train` and by tests/benchmarks/bench_raster.py. All backends render the same
scene in turns, one call each per round, so that a busy machine slows all of them alike; reported are medians
over the rounds and their spread. One-thread cases can be judged by `cpu_ms`, the processor time of the
process, which a neighbour on the core does not change.
"""

from __future__ import annotations

import gc
import math
import os
import platform
import resource
import subprocess
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from importlib.metadata import version
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from extrags.errors import ConfigError
from extrags.raster import native
from extrags.raster.adam import SelectiveAdam
from extrags.raster.dispatch import available_backends, rasterize
from extrags.raster.loss import l1_ssim_loss, l1_ssim_loss_reference
from extrags.raster.rendering import Rendering

__all__ = ["BenchSize", "bench_raster", "bench_scene", "bench_train", "machine"]

PEERS = ("native", "gsplat", "torch", "reference")
"""`torch` is the reference in float32 with torch's own loss and Adam; `reference` the same in float64."""

FLOPS_PER_LANE = {"forward": 38, "backward": 61}
"""Counted per pixel and Gaussian, the gradient's share of the reduction included."""

PARAMETERS_PER_GAUSSIAN = 59
"""Floats: mean 3, quaternion 4, scales 3, opacity 1, harmonics of degree 3 48."""


@dataclass(frozen=True)
class BenchSize:
    """One case: image size and number of Gaussians."""

    width: int
    height: int
    n_gaussians: int


STANDARD_SIZES = (
    BenchSize(160, 128, 10_000),
    BenchSize(320, 256, 30_000),
    BenchSize(640, 512, 100_000),
)


def bench_scene(size: BenchSize, *, seed: int = 0) -> dict[str, Tensor]:
    """Flattened Gaussians on the wall of a tube with the camera inside: nearly all of them in view.

    Args:
        size: of the image and of the scene.
        seed: of the random numbers.

    Returns:
        `means`, `quats`, `scales`, `opacities`, `sh` (degree 3), `viewmats`, `Ks` as `rasterize` takes
        them, and a `target` image [1, H, W, 3].
    """
    generator = torch.Generator().manual_seed(seed)
    n = size.n_gaussians

    def uniform(*shape: int) -> Tensor:
        return torch.rand(*shape, generator=generator)

    angle, along = 2 * math.pi * uniform(n), 0.4 + 6 * uniform(n)
    radius = 1 + 0.1 * torch.sin(3 * angle)
    means = torch.stack([radius * angle.cos(), radius * angle.sin(), along], -1)
    spacing = math.sqrt(2 * math.pi * 6 / n)
    flat = torch.tensor([1.0, 1.0, 0.15])
    sh = 0.2 * torch.randn(n, 16, 3, generator=generator)
    sh[:, 0] += 0.5
    viewmats = torch.eye(4)[None].clone()
    viewmats[0, 2, 3] = 0.3
    focal = 0.6 * size.width
    K = torch.tensor([[focal, 0, size.width / 2], [0, focal, size.height / 2], [0, 0, 1]])
    return {
        "means": means + 0.02 * torch.randn(n, 3, generator=generator),
        "quats": torch.randn(n, 4, generator=generator),
        "scales": spacing * (0.6 + 0.8 * uniform(n, 3)) * flat,
        "opacities": 0.1 + 0.89 * uniform(n),
        "sh": sh,
        "viewmats": viewmats,
        "Ks": K[None],
        "target": uniform(1, size.height, size.width, 3),
    }


def machine() -> dict[str, Any]:
    """What the measurements were taken on."""
    processor = platform.processor()
    info = Path("/proc/cpuinfo")
    if info.exists():
        names = [x for x in info.read_text().splitlines() if x.startswith("model name")]
        processor = names[0].split(":", 1)[1].strip() if names else processor
    git = subprocess.run(
        ["git", "rev-parse", "HEAD"], capture_output=True, text=True, check=False, cwd=Path(__file__).parent
    )
    load = os.getloadavg()[0]
    return {
        "processor": processor,
        "cores": os.cpu_count(),
        "threads": native.num_threads() if native.native_isa() else 1,
        "isa": native.native_isa(),
        "load_average": load,
        "versions": {
            "python": platform.python_version(),
            "torch": torch.__version__,
            "numpy": version("numpy"),
            "extrags": version("extrags"),
        },
        "commit": git.stdout.strip() or None,
    }


def bench_raster(
    sizes: Sequence[BenchSize] | None = None,
    *,
    quick: bool = False,
    peers: Sequence[str] = ("torch",),
    threads: Sequence[int] = (1,),
    rounds: int = 20,
    with_error: bool = True,
    seed: int = 0,
) -> dict[str, Any]:
    """Time forward and backward of `rasterize`, harmonics of degree 3.

    Args:
        sizes: the cases; None is `STANDARD_SIZES`.
        quick: of the standard sizes, the smallest only.
        peers: backends beside the native one; see `PEERS`.
        threads: numbers of threads for the native kernels; torch peers run with the first of them.
        rounds: how often each backend runs; slow peers run at most three times.
        with_error: compare image and gradients with the float64 reference.
        seed: of the scene.

    Returns:
        `{machine, cases}` with, per case, `ms` and `cpu_ms` (medians of forward, backward, iteration),
        `spread_ms` (10 % and 90 % quantile of the iteration), `error` (relative L2 of the image and of
        each gradient) and `peak_mib` (memory taken beyond the scene itself).

    Raises:
        ConfigError: for an unknown peer.
    """
    return _bench(_sizes(sizes, quick), peers, threads, rounds, with_error, seed, training=False)


def bench_train(
    sizes: Sequence[BenchSize] | None = None,
    *,
    quick: bool = False,
    peers: Sequence[str] = ("torch",),
    threads: Sequence[int] = (1,),
    rounds: int = 20,
    with_error: bool = False,
    seed: int = 0,
) -> dict[str, Any]:
    """Time whole training iterations: render, L1 + SSIM, backward, Adam over all parameters.

    Arguments, result and errors as `bench_raster`; native cases also hold `parts_ms` (where the time goes)
    and `roofline` (the floor set by measured arithmetic and memory bandwidth, and the share reached).
    """
    return _bench(_sizes(sizes, quick), peers, threads, rounds, with_error, seed, training=True)


def _sizes(sizes: Sequence[BenchSize] | None, quick: bool) -> Sequence[BenchSize]:
    if sizes is not None:
        return sizes
    return STANDARD_SIZES[:1] if quick else STANDARD_SIZES


def _bench(
    sizes: Sequence[BenchSize],
    peers: Sequence[str],
    threads: Sequence[int],
    rounds: int,
    with_error: bool,
    seed: int,
    *,
    training: bool,
) -> dict[str, Any]:
    unknown = [peer for peer in peers if peer not in PEERS]
    if unknown:
        raise ConfigError(f"unknown peers {', '.join(unknown)}; expected {', '.join(PEERS)}")
    if "gsplat" in peers and "gsplat" not in available_backends():
        raise ConfigError("peer gsplat needs a CUDA device and the package gsplat")
    before = native.num_threads(), torch.get_num_threads()
    cases: list[dict[str, Any]] = []
    try:
        for size in sizes:
            cases += _bench_size(size, peers, threads, rounds, with_error, seed, training=training)
    finally:
        native.set_num_threads(before[0])
        torch.set_num_threads(before[1])
    return {"machine": machine(), "cases": cases}


def _bench_size(
    size: BenchSize,
    peers: Sequence[str],
    threads: Sequence[int],
    rounds: int,
    with_error: bool,
    seed: int,
    *,
    training: bool,
) -> list[dict[str, Any]]:
    scene = bench_scene(size, seed=seed)
    exact = _gradients("reference", scene, size) if with_error else None
    entrants = [(backend, count) for backend in ("native",) for count in threads]
    entrants += [(peer, threads[0]) for peer in peers if peer != "native"]
    runs = {key: _Run(key[0], scene, size, training=training) for key in entrants}
    peaks: dict[tuple[str, int], float | None] = {}
    for index in range(rounds + 2):
        for (backend, count), run in runs.items():
            if backend in ("torch", "reference") and index >= 4:
                continue
            _use_threads(backend, count)
            if index == 0:
                peaks[backend, count] = _peak_mib(run.iteration)
            else:
                run.iteration()
    cases = []
    for (backend, count), run in runs.items():
        case: dict[str, Any] = {
            "width": size.width,
            "height": size.height,
            "n_gaussians": size.n_gaussians,
            "backend": backend,
            "threads": count,
            **run.summary(warm_up=1 if backend in ("torch", "reference") else 2),
            "peak_mib": peaks[backend, count],
        }
        if exact is not None:
            case["error"] = _errors(_gradients(backend, scene, size), exact)
        if backend == "native" and training:
            _use_threads(backend, count)
            case["parts_ms"], entries = _parts(scene, size)
            measured = case["cpu_ms" if count == 1 else "ms"]["iteration"]
            case["roofline"] = _roofline(size, entries, count, measured)
        cases.append(case)
    return cases


def _use_threads(backend: str, count: int) -> None:
    # Beside the native kernels torch has only small arrays to handle: its threads, which wait for each other
    # at barriers, would cost more than they bring.
    torch.set_num_threads(1 if backend == "native" else count)
    if native.native_isa() is not None:
        native.set_num_threads(count)


class _Run:
    """Repeated iterations of one backend on its own copy of the scene."""

    def __init__(self, backend: str, scene: dict[str, Tensor], size: BenchSize, *, training: bool) -> None:
        dtype = torch.float64 if backend == "reference" else torch.float32
        device = "cuda" if backend == "gsplat" else "cpu"
        self.backend, self.size, self.training = backend, size, training
        values = {k: v.to(device=device, dtype=dtype, copy=True) for k, v in scene.items()}
        self.target = values.pop("target")
        self.cameras = {name: values.pop(name) for name in ("viewmats", "Ks")}
        self.parameters = {k: v.requires_grad_() for k, v in values.items()}
        # Rates so small that the scene stays what it is, round after round
        rates = dict.fromkeys(self.parameters, 1e-9)
        self.adam: SelectiveAdam | torch.optim.Adam
        if backend in ("native", "gsplat"):
            self.adam = SelectiveAdam(self.parameters, rates)
        else:
            self.adam = torch.optim.Adam(list(self.parameters.values()), lr=1e-9, eps=1e-15)
        self.wall: list[dict[str, float]] = []
        self.cpu: list[dict[str, float]] = []

    def iteration(self) -> None:
        loss_function = l1_ssim_loss if self.backend in ("native", "gsplat") else l1_ssim_loss_reference
        marks = [self._now()]
        rendering = _render(self.backend, {**self.parameters, **self.cameras}, self.size)
        marks.append(self._now())
        loss = loss_function(rendering.rgb, self.target) if self.training else rendering.rgb.sum()
        marks.append(self._now())
        loss.backward()
        marks.append(self._now())
        if self.training:
            if isinstance(self.adam, SelectiveAdam):
                self.adam.step(rendering.visible[0])
            else:
                self.adam.step()
        marks.append(self._now())
        for value in self.parameters.values():
            value.grad = None
        names = ("forward", "loss", "backward", "adam")
        for kind, record in enumerate((self.wall, self.cpu)):
            steps = {name: marks[i + 1][kind] - marks[i][kind] for i, name in enumerate(names)}
            record.append({**steps, "iteration": marks[-1][kind] - marks[0][kind]})

    def _now(self) -> tuple[float, float]:
        if self.backend == "gsplat":
            torch.cuda.synchronize()
        return 1e3 * time.perf_counter(), 1e3 * time.process_time()

    def summary(self, *, warm_up: int) -> dict[str, Any]:
        """Medians in milliseconds, without the first iterations."""

        def medians(record: list[dict[str, float]]) -> dict[str, float]:
            kept = record[warm_up:]
            return {name: float(np.median([r[name] for r in kept])) for name in kept[0]}

        iterations = [r["iteration"] for r in self.wall[warm_up:]]
        return {
            "ms": medians(self.wall),
            "cpu_ms": medians(self.cpu),
            "spread_ms": [float(q) for q in np.quantile(iterations, (0.1, 0.9))],
            "rounds": len(iterations),
        }


def _render(backend: str, scene: dict[str, Tensor], size: BenchSize) -> Rendering:
    kind: Any = "reference" if backend == "torch" else backend
    return rasterize(
        scene["means"],
        scene["quats"],
        scene["scales"],
        scene["opacities"],
        scene["sh"],
        scene["viewmats"],
        scene["Ks"],
        size.width,
        size.height,
        backend=kind,
    )


def _gradients(backend: str, scene: dict[str, Tensor], size: BenchSize) -> dict[str, Tensor]:
    """Image and gradients for fixed random weights on colour, alpha and depth."""
    dtype = torch.float64 if backend == "reference" else torch.float32
    device = "cuda" if backend == "gsplat" else "cpu"
    values = {k: v.to(device=device, dtype=dtype, copy=True) for k, v in scene.items() if k != "target"}
    leaves = {k: v.requires_grad_() for k, v in values.items() if k not in ("viewmats", "Ks")}
    rendering = _render(backend, values, size)
    generator = torch.Generator().manual_seed(1)
    total = rendering.rgb.new_zeros(())
    for image in (rendering.rgb, rendering.alpha, rendering.depth):
        weights = torch.randn(image.shape, generator=generator).to(image)
        total = total + (weights * image).sum()
    total.backward()
    found = {k: v.grad for k, v in leaves.items() if v.grad is not None}
    return {"image": rendering.rgb.detach(), **found}


def _errors(found: dict[str, Tensor], exact: dict[str, Tensor]) -> dict[str, Any]:
    relative = {
        name: float((found[name].double().cpu() - value).norm() / value.norm().clamp_min(1e-30))
        for name, value in exact.items()
    }
    return {"image": relative.pop("image"), "grads": relative}


def _peak_mib(function: Callable[[], None]) -> float | None:
    """Memory a call takes at its height beyond what the process held before."""
    gc.collect()
    reset, status = Path("/proc/self/clear_refs"), Path("/proc/self/status")
    if not os.access(reset, os.W_OK):
        before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
        function()
        grown = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before
        return grown / 1024 if grown > 0 else None

    def field(name: str) -> float:
        lines = [x for x in status.read_text().splitlines() if x.startswith(name)]
        return float(lines[0].split()[1]) / 1024

    reset.write_text("5")  # the high-water mark starts anew
    before_mib = field("VmRSS")
    function()
    return field("VmHWM") - before_mib


def _parts(scene: dict[str, Tensor], size: BenchSize, rounds: int = 8) -> tuple[dict[str, float], int]:
    """Where an iteration's time goes when the kernels are called directly, and the composited entries."""
    kernels = native.compiled_kernels()
    n, width, height = size.n_gaussians, size.width, size.height
    names = ("means", "quats", "scales", "opacities", "sh")
    parameters = [scene[name].clone() for name in names]
    gradients = [torch.empty_like(value) for value in parameters]
    moments = [(torch.zeros_like(value), torch.zeros_like(value)) for value in parameters]
    rgb, v_rgb = torch.empty(height, width, 3), torch.empty(height, width, 3)
    alpha, depth = torch.empty(height, width), torch.empty(height, width)
    means2d, radius, v_means2d = torch.empty(n, 2), torch.empty(n), torch.empty(n, 2)
    steps, bias = torch.ones(n, dtype=torch.int32), torch.ones(2)
    records: list[dict[str, float]] = []
    entries = 0
    for _ in range(rounds + 2):
        frame = kernels.render(
            *parameters,
            *(3, None, scene["viewmats"][0], scene["Ks"][0], None, width, height, 0.01),
            *(rgb, alpha, depth, means2d, radius, None, None, None),
        )
        start = time.perf_counter()
        kernels.l1_ssim(rgb, scene["target"][0], None, v_rgb, height, width, 0.2, 1 / (3 * width * height))
        compared = time.perf_counter()
        frame.backward(
            *parameters,
            *(3, None, v_rgb, None, None, None, False, *gradients, None, None, v_means2d, None),
        )
        carried = time.perf_counter()
        stepped = [
            (value, gradient, first, second, 1e-9)
            for value, gradient, (first, second) in zip(parameters, gradients, moments, strict=True)
        ]
        kernels.adam(stepped, steps, bias, bias, None, 0.9, 0.999, 1e-15)
        project, tiles, tiles_backward, project_backward = frame.seconds()
        records.append(
            {
                "project": project,
                "tiles": tiles,
                "loss": compared - start,
                "tiles_backward": tiles_backward,
                "project_backward": project_backward,
                "adam": time.perf_counter() - carried,
            }
        )
        entries = int(frame.entries())
    kept = records[2:]
    return {name: 1e3 * float(np.median([r[name] for r in kept])) for name in kept[0]}, entries


def _roofline(size: BenchSize, entries: int, threads: int, iteration_ms: float) -> dict[str, float]:
    """The least time an iteration could take at the measured arithmetic peak and memory bandwidth.

    Arithmetic: composited entries times sixteen lanes, forward and backward (projection, loss and Adam
    left out). Memory: parameters read twice, gradients written and read, Adam's moments and parameters
    read and written; none of it from a cache.
    """
    flops = 16 * entries * sum(FLOPS_PER_LANE.values())
    traffic = 4 * PARAMETERS_PER_GAUSSIAN * size.n_gaussians * (2 + 2 + 6)
    peak_gflops, bandwidth_gbs = threads * _peak_gflops(), _bandwidth_gbs()
    arithmetic_ms, memory_ms = 1e-6 * flops / peak_gflops, 1e-6 * traffic / bandwidth_gbs
    floor_ms = max(arithmetic_ms, memory_ms)
    return {
        "peak_gflops": peak_gflops,
        "bandwidth_gbs": bandwidth_gbs,
        "entries": float(entries),
        "gflop": flops / 1e9,
        "traffic_mib": traffic / 2**20,
        "arithmetic_ms": arithmetic_ms,
        "memory_ms": memory_ms,
        "floor_ms": floor_ms,
        "share": floor_ms / iteration_ms,
    }


def _peak_gflops() -> float:
    """Best of a few runs of independent fused multiply-adds: 16 chains of 16 lanes, 2 flops each."""
    kernels, rounds = native.compiled_kernels(), 200_000
    best = math.inf
    for _ in range(5):
        start = time.thread_time()
        kernels.fma_chain(rounds)
        best = min(best, time.thread_time() - start)
    return rounds * 16 * 16 * 2 / best / 1e9


def _bandwidth_gbs() -> float:
    """Best of a few copies of 64 MiB, read and written."""
    source = torch.ones(16 * 2**20)
    target = torch.empty_like(source)
    best = math.inf
    for _ in range(5):
        start = time.thread_time()
        target.copy_(source)
        best = min(best, time.thread_time() - start)
    return 2 * 4 * source.numel() / best / 1e9
