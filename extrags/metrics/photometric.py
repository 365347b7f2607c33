"""Photometric metrics of images inside regions, as the registry names them."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from functools import partial
from numbers import Real

import numpy as np
import torch
from jaxtyping import Bool, Float
from torch import Tensor

from extrags.errors import ConfigError, ExtragsError, NonFiniteError, ShapeError
from extrags.metrics.lpips import Lpips, LpipsByNet, TargetActivations
from extrags.metrics.registry import Metric, added_metrics, metrics

__all__ = ["photometric_values", "try_added_metrics"]

_TRIAL_SIZE_PX = (192, 256)
"""Height and width of the images on which metrics are tried: as large as most frames that are read."""


def photometric_values(
    render: Float[Tensor, "n h w 3"],
    target: Float[Tensor, "n h w 3"],
    regions: dict[str, Bool[Tensor, "n h w"]],
    chosen: Iterable[Metric],
    lpips: LpipsByNet | None,
    targets: TargetActivations | None = None,
) -> dict[str, dict[str, list[float | None]]]:
    """Values of photometric metrics for each image inside each region.

    Args:
        render: images in [0, 1].
        target: images in [0, 1].
        regions: pixels that count, by name.
        chosen: what to measure.
        lpips: LPIPS by backbone; None leaves it out.
        targets: of `target`, where several renders are compared with it.

    Returns:
        By region and by key of the metric, one value per image; None where there is none. LPIPS has a key for
        each backbone in `lpips`; its values are None where the weights are missing.

    Raises:
        ShapeError: when a metric returns no numbers, or another number of values than there are images.
        NonFiniteError: when a metric returns NaN or infinity.
    """
    asked = {} if lpips is None else lpips
    wanted = [metric for metric in chosen if metric.lpips_net is None or metric.lpips_net in asked]
    found: dict[str, dict[str, list[float | None]]] = {
        name: {metric.key: [None] * len(region) for metric in wanted} for name, region in regions.items()
    }
    for metric in wanted:
        measure = metric.measure
        if metric.lpips_net is not None:
            network = asked[metric.lpips_net]
            measure = (
                partial(network.regional_distances, targets=targets) if isinstance(network, Lpips) else None
            )
        if measure is None:
            continue
        for name, values in _checked(metric.key, measure(render, target, regions), regions).items():
            found[name][metric.key] = values
    return found


def try_added_metrics(device: torch.device | str = "cpu") -> None:
    """Measure two made-up pairs of images by each metric that a program registered.

    What a metric does wrong is said before a run, and not at its end.

    Args:
        device: where the images are, as those of the run will be.

    Raises:
        ConfigError: a metric fails, or gives what a metric may not; names it.
    """
    if not added_metrics():
        return
    keys = {key.partition("@")[0] for key in added_metrics()}
    noise = np.random.default_rng(0).random((2, 2, *_TRIAL_SIZE_PX, 3), dtype=np.float32)
    render, target = torch.from_numpy(noise).to(device)
    everywhere = torch.ones(render.shape[:3], dtype=torch.bool, device=device)
    # A region may have no pixel in some image: that of the second one here.
    upper = everywhere.clone()
    upper[0, _TRIAL_SIZE_PX[0] // 2 :] = False
    upper[1] = False
    regions = {"valid": everywhere, "observed": upper, "unobserved": ~upper}
    for metric in metrics("photometric"):
        if metric.key not in keys:
            continue
        try:
            photometric_values(render, target, regions, [metric], None)
        # Whatever a program's own code raises.
        except Exception as error:
            height, width = _TRIAL_SIZE_PX
            said = str(error) if isinstance(error, ExtragsError) else f"{type(error).__name__}: {error}"
            raise ConfigError(
                f"metric {metric.key} fails on two made-up pairs of images of {width} x {height} px, before "
                f"the run: {said}"
            ) from error


def _checked(key: str, found: object, regions: Mapping[str, Tensor]) -> dict[str, list[float | None]]:
    """The values that a metric has given for each region, as plain numbers.

    Raises:
        ShapeError: they are no numbers, or not as many as there are images; names the metric.
        NonFiniteError: one is NaN or infinite.
    """
    expected = "for each region one number per image, or None where there is none"
    if not isinstance(found, Mapping):
        raise ShapeError(f"metric {key}: measure gives {type(found).__name__}; expected a dict, {expected}")
    missing = [name for name in regions if name not in found]
    if missing:
        given = ", ".join(map(str, found)) or "none"
        raise ShapeError(
            f"metric {key}: measure gives no values of {', '.join(missing)}, found {given}; expected "
            f"{expected}"
        )
    return {
        name: _as_numbers(f"metric {key}: {name or 'values'}", found[name], len(region))
        for name, region in regions.items()
    }


def _as_numbers(what: str, values: object, n_images: int) -> list[float | None]:
    if isinstance(values, Tensor | np.ndarray):
        values = values.tolist()
    if not isinstance(values, Sequence) or isinstance(values, str):
        found = type(values).__name__
        raise ShapeError(f"{what} is {found}; expected a list of one number, or None, per image")
    if len(values) != n_images:
        raise ShapeError(f"{what}: {len(values)} values for {n_images} images")
    numbers = [
        value.item() if isinstance(value, Tensor) and value.numel() == 1 else value for value in values
    ]
    for value in numbers:
        if value is not None and not isinstance(value, Real):
            raise ShapeError(f"{what} holds {value!r}, {type(value).__name__}; expected numbers or None")
        if value is not None and not math.isfinite(value):
            raise NonFiniteError(f"{what}: a value is NaN or infinite; None says that there is none")
    return [None if value is None else float(value) for value in numbers]
