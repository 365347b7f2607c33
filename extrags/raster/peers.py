"""The implementations compared by the benchmarks: all backends and a torch baseline."""

from __future__ import annotations

import time
from collections.abc import Mapping
from typing import Any, cast

import numpy as np
import torch
from torch import Tensor

from extrags.errors import ConfigError
from extrags.raster import native
from extrags.raster.adam import SelectiveAdam
from extrags.raster.direct import DirectStep, Target
from extrags.raster.dispatch import Backend, available_backends, rasterize
from extrags.raster.loss import l1_ssim_loss
from extrags.raster.rendering import Rendering
from extrags.raster.torch_tiles import (
    TileImages,
    l1_ssim_loss_torch,
    rasterize_tiles,
    tile_gradients,
)

__all__ = [
    "PEERS",
    "TimedPeer",
    "check_peers",
    "errors",
    "exact_gradients",
    "gradients",
    "rasterize_scene",
    "use_threads",
]

PEERS: dict[str, str] = {
    "native": "the compiled kernels",
    "direct": "the compiled kernels without autograd, as training uses them; training only",
    "torch": "batched 8x8 tiles in float32 torch, depthwise SSIM, fused Adam",
    "reference": "the specification in float64 torch",
    "gsplat": "gsplat's CUDA kernels",
}

MAX_ROUNDS = {"torch": 6, "reference": 3}
"""Upper limit on the rounds of slow implementations, one warm-up round included."""

NOT_LEARNED = ("viewmats", "Ks", "target")


def check_peers(peers: list[str]) -> None:
    """Check that all peers are known and available on this machine.

    Raises:
        ConfigError: for an unknown peer, or one that is not available.
    """
    unknown = [peer for peer in peers if peer not in PEERS]
    if unknown:
        raise ConfigError(f"unknown peers {', '.join(unknown)}; expected {', '.join(PEERS)}")
    if {"native", "direct"} & set(peers) and native.native_isa() is None:
        raise ConfigError(f"peers native and direct are not available: {native.missing_kernels_error()}")
    if "gsplat" in peers and "gsplat" not in available_backends():
        raise ConfigError("peer gsplat needs a CUDA device and the package gsplat")


def use_threads(backend: str, count: int) -> None:
    """Set the number of threads of a backend."""
    # With the native kernels torch handles small arrays only, for which the synchronisation of several
    # threads costs more than it gains.
    torch.set_num_threads(1 if backend in ("native", "direct") else count)
    if native.native_isa() is not None:
        native.set_num_threads(count)


class TimedPeer:
    """Timed iterations of one peer on its own copy of a scene.

    Args:
        backend: one of `PEERS`.
        scene: as `bench_scene` makes it.
        training: whole iterations with loss and Adam, instead of forward and backward alone.
    """

    def __init__(self, backend: str, scene: Mapping[str, Tensor], *, training: bool) -> None:
        self.backend, self.training = backend, training
        values = _placed(backend, scene)
        self.target = values["target"]
        self.cameras = {name: values[name] for name in ("viewmats", "Ks")}
        if backend == "direct":
            values["scales"], values["opacities"] = values["scales"].log(), values["opacities"].logit()
        self.parameters = {k: v.requires_grad_() for k, v in values.items() if k not in NOT_LEARNED}
        # Learning rates so small that the scene is practically constant over all rounds
        rate = 1e-9
        self.adam: SelectiveAdam | torch.optim.Adam
        if backend in ("native", "direct", "gsplat"):
            self.adam = SelectiveAdam(self.parameters, dict.fromkeys(self.parameters, rate))
        else:
            self.adam = torch.optim.Adam(list(self.parameters.values()), lr=rate, eps=1e-15, fused=True)
        if backend == "direct":
            viewmat, K = (self.cameras[name][0].numpy() for name in ("viewmats", "Ks"))
            self.view = Target(viewmat, K, self.target[0])
            self.direct = DirectStep()
            self.direct.bind(self.parameters)
        self._wall: list[dict[str, float]] = []
        self._cpu: list[dict[str, float]] = []

    def iteration(self) -> None:
        """One iteration (forward, loss, backward, optimiser step); its times are recorded."""
        if self.backend == "direct":
            self._direct_iteration()
            return
        marks = [self._now()]
        rgb, visible = self._render()
        marks.append(self._now())
        loss = self._loss(rgb) if self.training else rgb.sum()
        marks.append(self._now())
        loss.backward()
        marks.append(self._now())
        if self.training:
            if isinstance(self.adam, SelectiveAdam):
                self.adam.step(visible)
            else:
                self.adam.step()
        marks.append(self._now())
        for value in self.parameters.values():
            value.grad = None
        names = ("forward", "loss", "backward", "adam")
        for kind, record in enumerate((self._wall, self._cpu)):
            steps = {name: marks[i + 1][kind] - marks[i][kind] for i, name in enumerate(names)}
            record.append({**steps, "iteration": marks[-1][kind] - marks[0][kind]})

    def _direct_iteration(self) -> None:
        marks = [self._now()]
        self.direct.run(self.view, sh_degree=3)
        marks.append(self._now())
        if isinstance(self.adam, SelectiveAdam):
            self.adam.step(self.direct.visible, self.direct.gradients)
        marks.append(self._now())
        for kind, record in enumerate((self._wall, self._cpu)):
            start, carried, end = (mark[kind] for mark in marks)
            record.append({"gradients": carried - start, "adam": end - carried, "iteration": end - start})

    def _render(self) -> tuple[Tensor, Tensor | None]:
        scene = {**self.parameters, **self.cameras}
        height, width = self.target.shape[1:3]
        if self.backend == "torch":
            return rasterize_tiles(scene, width, height).rgb[None], None
        rendering = rasterize_scene(scene, self.backend, width, height)
        return rendering.rgb, rendering.visible[0]

    def _loss(self, rgb: Tensor) -> Tensor:
        if self.backend == "torch":
            return l1_ssim_loss_torch(rgb[0], self.target[0])
        return l1_ssim_loss(rgb, self.target)

    def _now(self) -> tuple[float, float]:
        if self.backend == "gsplat":
            torch.cuda.synchronize()
        return 1e3 * time.perf_counter(), 1e3 * time.process_time()

    @property
    def finished(self) -> bool:
        """Whether a slow peer has run often enough."""
        return len(self._wall) >= MAX_ROUNDS.get(self.backend, len(self._wall) + 1)

    def summary(self) -> dict[str, Any]:
        """Medians in milliseconds without warm-up, and quantiles of the iteration time."""
        warm_up = 1 if self.backend in MAX_ROUNDS else 2

        def medians(record: list[dict[str, float]]) -> dict[str, float]:
            kept = record[warm_up:]
            return {name: float(np.median([r[name] for r in kept])) for name in kept[0]}

        iterations = [r["iteration"] for r in self._wall[warm_up:]]
        return {
            "ms": medians(self._wall),
            "cpu_ms": medians(self._cpu),
            "spread_ms": [float(q) for q in np.quantile(iterations, (0.1, 0.9))],
            "rounds": len(iterations),
        }


def rasterize_scene(scene: Mapping[str, Tensor], backend: str, width: int, height: int) -> Rendering:
    """Call `rasterize` with the arrays of a scene."""
    return rasterize(
        scene["means"],
        scene["quats"],
        scene["scales"],
        scene["opacities"],
        scene["sh"],
        scene["viewmats"],
        scene["Ks"],
        width,
        height,
        backend=cast("Backend", backend),
    )


def _placed(backend: str, scene: Mapping[str, Tensor]) -> dict[str, Tensor]:
    dtype = torch.float64 if backend == "reference" else torch.float32
    device = "cuda" if backend == "gsplat" else "cpu"
    return {name: value.to(device=device, dtype=dtype, copy=True) for name, value in scene.items()}


def _cotangents(scene: Mapping[str, Tensor]) -> TileImages:
    """Fixed random weights on colour, alpha and depth, in float64."""
    generator = torch.Generator().manual_seed(1)
    height, width = scene["target"].shape[1:3]
    shapes = ((height, width, 3), (height, width), (height, width))
    return TileImages(*(torch.randn(shape, generator=generator).double() for shape in shapes))


def exact_gradients(scene: Mapping[str, Tensor]) -> dict[str, Tensor]:
    """Image, and gradients of a fixed random linear function of colour, alpha and depth, in float64.

    Computed by `tile_gradients`, whose memory is bounded; the tests compare it with the reference
    implementation.
    """
    exact = {name: value.double() for name, value in scene.items()}
    height, width = scene["target"].shape[1:3]
    images, found = tile_gradients(exact, width, height, _cotangents(scene))
    return {"image": images.rgb, **found}


def gradients(backend: str, scene: Mapping[str, Tensor]) -> dict[str, Tensor]:
    """The same results as `exact_gradients`, computed by a peer in its own precision."""
    height, width = scene["target"].shape[1:3]
    values = _placed(backend, scene)
    leaves = {k: v.requires_grad_() for k, v in values.items() if k not in NOT_LEARNED}
    inputs = {**leaves, **{name: values[name] for name in ("viewmats", "Ks")}}
    images: TileImages | Rendering
    if backend == "torch":
        images = rasterize_tiles(inputs, width, height)
    else:
        images = rasterize_scene(inputs, backend, width, height)
    weights = _cotangents(scene)
    total = images.rgb.new_zeros(())
    for name in ("rgb", "alpha", "depth"):
        image: Tensor = getattr(images, name)
        weight: Tensor = getattr(weights, name)
        total = total + (weight.to(image).reshape(image.shape) * image).sum()
    total.backward()
    found = {k: v.grad for k, v in leaves.items() if v.grad is not None}
    return {"image": images.rgb.detach().reshape(height, width, 3), **found}


def errors(found: Mapping[str, Tensor], exact: Mapping[str, Tensor]) -> dict[str, Any]:
    """Relative L2 error of the image and of each gradient."""
    relative = {
        name: float((found[name].double().cpu() - value).norm() / value.norm().clamp_min(1e-30))
        for name, value in exact.items()
    }
    return {"image": relative.pop("image"), "grads": relative}
