"""What of a run works where: the device it is settled on, and each piece of work with its rasteriser.

Gaussians are optimised, rendered and measured on the run's device (`device` in the settings). Some work stays
on the processor whatever that is, because it needs what only the native kernels compute (blending weights,
median depth, transmittance at points) or a library that has no GPU; `placements` says which and why.
"""

from __future__ import annotations

import logging
from dataclasses import asdict, dataclass
from functools import cache
from importlib.util import find_spec
from typing import Literal

from extrags.config import PipelineConfig
from extrags.config.backends import BACKENDS
from extrags.devices import chosen_device
from extrags.errors import ConfigError, MissingDependencyError, installed_with

__all__ = ["Placement", "check_device", "placements", "run_device"]

log = logging.getLogger(__name__)

DeviceKind = Literal["cpu", "cuda"]

NATIVE_LENS = "gsplat renders pinholes here, not the lens of the frames (ingest.lens=native)"
NO_CUDA = "torch sees no CUDA device"


@dataclass(frozen=True)
class Placement:
    """Where one piece of work is done.

    Args:
        stage: of the pipeline.
        work: what of the stage, in words.
        device: cpu or cuda.
        rasteriser: backend of `extrags.raster.rasterize`; empty where nothing is rasterised.
        reason: why there.
    """

    stage: str
    work: str
    device: DeviceKind
    rasteriser: str
    reason: str

    def to_json(self) -> dict[str, str]:
        """As plain types."""
        return asdict(self)


def run_device(config: PipelineConfig) -> DeviceKind:
    """The device that Gaussians are optimised, rendered and measured on, as it is part of cache keys.

    `auto` is cuda where torch sees a CUDA device, gsplat is installed and the frames are pinholes; else it is
    cpu, and the log says once why. `cuda` stays what it is where there is none: what was made on another
    machine can be read. `check_device` refuses to make anything there.

    Args:
        config: settings of all stages.
    """
    if config.device != "auto":
        return config.device
    reason = _reason_against_cuda(config.ingest.lens == "native")
    if not reason:
        return "cuda"
    _say_once(reason)
    return "cpu"


def check_device(config: PipelineConfig) -> None:
    """Refuse a device that the run cannot have.

    Args:
        config: settings of all stages.

    Raises:
        ConfigError: when `device` is cuda and there is no CUDA device, or the lens is one that gsplat does
            not render.
        MissingDependencyError: when `device` is cuda and gsplat is not installed.
    """
    if config.device != "cuda":
        return
    chosen_device("cuda", "device")
    if find_spec("gsplat") is None:
        raise MissingDependencyError(
            f"device=cuda needs gsplat: {installed_with('cuda')}; or take device=cpu"
        )
    if config.ingest.lens == "native":
        raise ConfigError(f"device=cuda: {NATIVE_LENS}; take ingest.lens=pinhole, or device=cpu")


def placements(config: PipelineConfig) -> list[Placement]:
    """What each stage of a run would do where, on this machine.

    Args:
        config: settings of all stages.

    Raises:
        ConfigError: as `check_device`, and where a stage's own device is unavailable.
        MissingDependencyError: as `check_device`.
    """
    check_device(config)
    config = config.with_run_device()
    device = run_device(config)
    if device == "cuda":
        backend, why = "gsplat", "device=cuda" if config.device == "cuda" else "device=auto: CUDA and gsplat"
    else:
        backend = _processor_backend()
        against = _reason_against_cuda(config.ingest.lens == "native")
        why = "device=cpu" if config.device == "cpu" else f"device=auto: {against}"
    weights = f"blending weights, which the {_processor_backend()} kernels give"
    found = [
        Placement("ingest", "frames", "cpu", "", "reads and resamples files"),
        Placement("poses", "COLMAP", "cpu", "", "pycolmap runs on the processor"),
        _depth(config),
    ]
    if config.uc_nerf.enabled:
        found.append(Placement("coarse", "radiance field", "cpu", "", "it is trained on the processor"))
        return [*found, Placement("evaluate", "metrics", device, "", why), _page()]
    found.append(Placement("coarse", "optimisation", device, backend, why))
    found += [
        Placement("assess", "training views", device, backend, why),
        _native("assess", "coverage and probe views", weights),
        _native("surface", "depth and TSDF", "median depth by the native kernels; Open3D fuses it there"),
        _native("freespace", "carving", "transmittance at points by the native kernels"),
        _native("explore", "search", weights),
    ]
    if config.enhance.backend == "embedded":
        found.append(Placement("enhance", "leave-out reconstructions", device, backend, why))
    found += [_native("enhance", "virtual views", weights), _restorer(config)]
    found += [
        Placement("finetune", "judge and optimisation", device, backend, why),
        Placement("evaluate", "held-out views", device, backend, why),
        _native("evaluate", "surface", "median depth by the native kernels"),
        Placement("evaluate", "metrics", device, "", why),
    ]
    return [*found, _page()]


def _depth(config: PipelineConfig) -> Placement:
    return Placement("depth", "stereo and networks", *_own_device(config.depth.device, "depth.device"))


def _restorer(config: PipelineConfig) -> Placement:
    name = config.enhance.backend
    part = "checkpoint" if name == "dynamicrafter" else "pretrained"
    if name in ("embedded", "classical"):
        return Placement("enhance", f"restorer {name}", "cpu", "", "it is made for processors")
    if BACKENDS[name].version > 0:
        return Placement("enhance", f"restorer {name}", "cpu", "", "a program's own: it chooses for itself")
    asked = getattr(config.enhance, part).device
    return Placement("enhance", f"restorer {name}", *_own_device(asked, f"enhance.{part}.device"))


def _own_device(asked: str, setting: str) -> tuple[DeviceKind, str, str]:
    """Of a network: its device, no rasteriser, and why there."""
    if chosen_device(asked, setting).type == "cuda":
        return "cuda", "", f"{setting}={asked}"
    return "cpu", "", f"{setting}={asked}" + (f": {NO_CUDA}" if asked == "auto" else "")


def _native(stage: str, work: str, reason: str) -> Placement:
    return Placement(stage, work, "cpu", _processor_backend(), reason)


def _page() -> Placement:
    return Placement("report", "page", "cpu", "", "reads artefacts and writes HTML")


def _processor_backend() -> str:
    from extrags.raster import native_isa

    return "reference" if native_isa() is None else "native"


def _reason_against_cuda(native_lens: bool) -> str:
    """Why a run whose device is `auto` stays on the processor; empty where it does not."""
    # First what needs no torch: looking up an artefact does not load it.
    if find_spec("gsplat") is None:
        return "gsplat is not installed"
    if native_lens:
        return NATIVE_LENS
    return "" if chosen_device("auto", "device").type == "cuda" else NO_CUDA


@cache
def _say_once(reason: str) -> None:
    log.info("device=auto: the run is on the processor, since %s", reason)
