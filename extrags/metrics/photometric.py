"""Photometric metrics of images inside regions, as the registry names them."""

from __future__ import annotations

import math
from collections.abc import Iterable
from functools import partial

from jaxtyping import Bool, Float
from torch import Tensor

from extrags.errors import NonFiniteError, ShapeError
from extrags.metrics.lpips import Lpips, LpipsByNet, TargetActivations
from extrags.metrics.registry import Metric

__all__ = ["photometric_values"]


def photometric_values(
    render: Float[Tensor, "n h w 3"],
    target: Float[Tensor, "n h w 3"],
    regions: dict[str, Bool[Tensor, "n h w"]],
    metrics: Iterable[Metric],
    lpips: LpipsByNet | None,
    targets: TargetActivations | None = None,
) -> dict[str, dict[str, list[float | None]]]:
    """Values of photometric metrics for each image inside each region.

    Args:
        render: images in [0, 1].
        target: images in [0, 1].
        regions: pixels that count, by name.
        metrics: what to measure.
        lpips: LPIPS by backbone; None leaves it out.
        targets: of `target`, where several renders are compared with it.

    Returns:
        By region and by key of the metric, one value per image; None where there is none. LPIPS has a key for
        each backbone in `lpips`; its values are None where the weights are missing.

    Raises:
        ShapeError: when a metric returns another number of values than there are images.
        NonFiniteError: when a metric returns NaN or infinity.
    """
    asked = {} if lpips is None else lpips
    wanted = [metric for metric in metrics if metric.lpips_net is None or metric.lpips_net in asked]
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
        values = measure(render, target, regions)
        for name in regions:
            found[name][metric.key] = _checked(metric.key, values[name], len(render))
    return found


def _checked(key: str, values: list[float | None], n_images: int) -> list[float | None]:
    if len(values) != n_images:
        raise ShapeError(f"metric {key}: {len(values)} values for {n_images} images")
    if not all(value is None or math.isfinite(value) for value in values):
        raise NonFiniteError(f"metric {key}: a value is NaN or infinite; None says that there is none")
    return values
