"""Run time and error of the rasteriser and of a whole training iteration: `extrags bench raster|train`.

All peers (the backends compared) render the same scene, one call each per round, so that other load on the
machine affects all of them equally; reported are medians over the rounds and quantiles. For cases with one
thread `cpu_ms`, the processor time of the process, is independent of such load.
"""

from __future__ import annotations

import ctypes
import gc
import logging
import math
import os
import platform
import resource
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from importlib.metadata import version
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from extrags.cores import processor_name
from extrags.devices import device_name
from extrags.errors import ConfigError
from extrags.raster import native
from extrags.raster.peers import TimedPeer, check_peers, errors, exact_gradients, gradients, use_threads
from extrags.raster.roofline import part_times, roofline
from extrags.source_commit import source_commit

__all__ = ["STANDARD_SIZES", "BenchSize", "bench_raster", "bench_scene", "bench_train", "machine"]

logger = logging.getLogger(__name__)


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
    """The environment of the measurements: processor, threads, GPU, versions, commit."""
    load = os.getloadavg()[0]
    return {
        "processor": processor_name(),
        "device": device_name("cuda" if torch.cuda.is_available() else "cpu"),
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
        "commit": source_commit(),
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
        peers: what runs beside the native kernels; see `extrags.raster.peers.PEERS`.
        threads: numbers of threads, each a case of its own (the reference runs with the first only).
        rounds: how often each peer is timed; slow peers stop earlier.
        with_error: compare image and gradients with float64.
        seed: of the scene.

    Returns:
        `{machine, cases}` with, per case, `ms` and `cpu_ms` (medians of forward, backward, iteration),
        `spread_ms` (10 % and 90 % quantile of the iteration), `peak_mib` (memory taken beyond the scene
        itself), `times_native` (processor time over that of the native kernels with as many threads) and
        `error` (relative L2 of the image and of each gradient).

    Raises:
        ConfigError: for a peer that is unknown or not available, or a number below 1.
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
    entrants = ["native", *(peer for peer in dict.fromkeys(peers) if peer != "native")]
    check_peers(entrants)
    if "direct" in entrants and not training:
        raise ConfigError("peer direct is a training iteration: extrags bench train")
    smallest = min([rounds, *threads, *(min(size.width, size.height, size.n_gaussians) for size in sizes)])
    if smallest < 1:
        raise ConfigError(f"sizes, numbers of Gaussians, threads and rounds start at 1, got {smallest}")
    before = native.num_threads(), torch.get_num_threads()
    cases: list[dict[str, Any]] = []
    try:
        for size in sizes:
            cases += _bench_size(size, entrants, threads, rounds, with_error, seed, training=training)
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
    exact = exact_gradients(scene) if with_error else None
    keys = [(peer, n) for peer in peers for n in (threads[:1] if peer == "reference" else threads)]
    timed_peers = {key: TimedPeer(key[0], scene, training=training) for key in keys}
    peaks: dict[tuple[str, int], float | None] = {}
    gc.collect()
    for index in range(rounds + 2):
        for (peer, count), timed_peer in timed_peers.items():
            if timed_peer.finished:
                continue
            use_threads(peer, count)
            if index == 0:
                peaks[peer, count] = _peak_mib(timed_peer.iteration)
            else:
                timed_peer.iteration()
    cases = []
    for (peer, count), timed_peer in timed_peers.items():
        case: dict[str, Any] = {
            "width": size.width,
            "height": size.height,
            "n_gaussians": size.n_gaussians,
            "backend": peer,
            "threads": count,
            **timed_peer.summary(),
            "peak_mib": peaks[peer, count],
        }
        use_threads(peer, count)
        # The direct step runs the same kernels; its gradients are held against autograd's in the tests.
        if exact is not None and peer != "direct":
            case["error"] = errors(gradients(peer, scene), exact)
        measured = case["cpu_ms" if count == 1 else "ms"]["iteration"]
        if peer == "direct":
            case["roofline"] = roofline(size.n_gaussians, part_times(scene)[1], count, measured)
        if peer == "native" and training:
            case["parts_ms"], entries = part_times(scene)
            case["roofline"] = roofline(size.n_gaussians, entries, count, measured)
        cases.append(case)
    own = {case["threads"]: case["cpu_ms"]["iteration"] for case in cases if case["backend"] == "native"}
    for case in cases:
        case["times_native"] = case["cpu_ms"]["iteration"] / own[case["threads"]]
    return cases


def _peak_mib(function: Callable[[], None]) -> float | None:
    """Peak resident memory of a call beyond that of the process before it, in MiB."""
    _return_free_memory()
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


def _return_free_memory() -> None:
    """Return freed heap memory to the system: memory reused from an earlier peer would not be counted."""
    try:
        ctypes.CDLL("libc.so.6").malloc_trim(0)
    except (OSError, AttributeError):  # another C library: the figure of later peers is a lower bound
        logger.debug("no malloc_trim: peak memory of later peers may read low")
