"""The registry of metrics: how they are computed, formatted, and where they are shown.

Everything that lists metrics is derived from here: the columns of the protocol, the figures that runs are
compared by, the tables of the command line, the tiles, tables and charts of the pages, and the tables of the
benchmark of restorers. A *metric* is the definition (`psnr`); a *figure* is its value in one group of pixels,
named by its path in the tree of metrics (`observed.psnr`).

A photometric metric takes one function, in any module, and one entry in `_BUILT_IN`. A program that uses the
library adds its own with `register_metric`:

    def mean_absolute_error(render, target):  # [n, h, w, 3] each
        return (render - target).abs().mean(-1)

    measure = means_in_regions(mean_absolute_error)
    register_metric(Metric("mae", "Mean absolute error", higher_is_better=False, measure=measure))

This module loads neither torch nor the modules of the metrics: tables are printed in processes without them.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from importlib import import_module
from typing import TYPE_CHECKING, Any, Literal, get_args

from extrags.config import LpipsNet
from extrags.errors import ConfigError

if TYPE_CHECKING:
    from torch import Tensor

__all__ = [
    "PROTOCOL_VERSION",
    "Figure",
    "Kind",
    "Measure",
    "Metric",
    "Place",
    "added_metrics",
    "figures",
    "metric_named",
    "metrics",
    "register_metric",
    "unregister_metric",
]

PROTOCOL_VERSION = 7
"""Of the protocol in `PROTOCOL.md`; raised by hand whenever a figure could change for the same renders, or
one is added."""

Measure = Callable[["Tensor", "Tensor", "dict[str, Tensor]"], "dict[str, list[float | None]]"]
"""From render and target, [n, h, w, 3] in [0, 1], and regions by name, [n, h, w]: one value per image and
region, None where the region is empty."""

Kind = Literal["photometric", "depth", "surface"]

Place = Literal["tables", "tiles", "columns", "differences", "charts", "restoration", "counts"]
"""Where figures are shown.

* `tables`: tables of runs on the command line and in Prefect; narrow ones show the first few.
* `tiles`: tiles and tables of the pages of a sequence and of a dataset.
* `columns`: tables of the page of a benchmark. `charts`: its charts.
* `differences`: differences between methods on the command line.
* `restoration`: the benchmark of restorers, `extrags bench enhance`.
* `counts`: numbers in the manifest of the evaluation.
"""

# Path in the tree of metrics, what it adds to a label, and the kinds of metrics there.
_GROUPS: tuple[tuple[str, str, tuple[Kind, ...]], ...] = (
    ("", "", ("photometric", "depth")),
    ("aligned", ", aligned", ("photometric",)),
    ("observed", ", observed", ("photometric", "depth")),
    ("observed.aligned", ", observed, aligned", ("photometric",)),
    ("unobserved", ", never observed", ("photometric", "depth")),
    ("unobserved.aligned", ", never observed, aligned", ("photometric",)),
    ("whole", ", all pixels", ("photometric",)),
    ("surface", "", ("surface",)),
    ("surface.unobserved", ", never observed", ("surface",)),
)
_TOP = ("",)
_SURFACE = ("surface",)
_EVERYWHERE: Mapping[Place, tuple[str, ...]] = dict.fromkeys(
    ("tables", "tiles", "columns", "differences", "restoration"), _TOP
)


@dataclass(frozen=True)
class Metric:
    """A metric: how its values are computed, written and shown.

    Args:
        key: its name in the tree of metrics and in tables: lower case, digits and underscores.
        label: name shown in tables and pages.
        higher_is_better: whether larger values are better.
        unit: empty for a plain number; `mm` stands for the unit of the scene where that is not metric.
        digits: decimals on pages.
        table_digits: decimals in tables on the command line.
        kind: photometric metrics are measured by `measure`, the others by `extrags.metrics.depth` and
            `extrags.metrics.surface`.
        measure: computes a photometric metric. LPIPS has none: its network brings it.
        lpips_net: the backbone, for LPIPS. Results have the key only where the backbone was asked for.
        network: display name of the backbone.
        groups: groups of pixels it is measured in; None is all of its kind.
        shown: by place, the groups of pixels for which the metric is shown there.
        description: a sentence on the metric for the pages.
        version: of a metric registered by a program: raised whenever its values could change, as it is part
            of the key under which results are cached.
        coverage: key of the metric that says which share of the pixels this one is over, where that depends
            on the render; empty where all count.

    Raises:
        ConfigError: for an invalid key, or groups that do not exist for the kind.
    """

    key: str
    label: str
    higher_is_better: bool
    unit: str = ""
    digits: int = 3
    table_digits: int = 4
    kind: Kind = "photometric"
    measure: Measure | None = None
    lpips_net: LpipsNet | None = None
    network: str = ""
    groups: tuple[str, ...] | None = None
    shown: Mapping[Place, tuple[str, ...]] = field(default_factory=lambda: _EVERYWHERE)
    description: str = ""
    version: int = 1
    coverage: str = ""

    def __post_init__(self) -> None:
        if not re.fullmatch(r"[a-z][a-z0-9_]*", self.key):
            raise ConfigError(f"metric {self.key!r}: a key is lower case letters, digits and underscores")
        known = [path for path, _, kinds in _GROUPS if self.kind in kinds]
        if not set(self.groups or ()) <= set(known):
            raise ConfigError(f"metric {self.key}: groups {self.groups}; a {self.kind} metric has {known}")
        for place, groups in self.shown.items():
            if place not in get_args(Place):
                places = ", ".join(get_args(Place))
                raise ConfigError(f"metric {self.key}: no place {place!r} to show it; known: {places}")
            if not set(groups) <= set(known):
                raise ConfigError(
                    f"metric {self.key}: groups {groups} in {place}; a {self.kind} metric has {known}"
                )


@dataclass(frozen=True, slots=True)
class Figure:
    """A metric in one group of pixels.

    Args:
        key: of the metric.
        name: dotted path in the tree of metrics.
        label: name shown in tables and pages, group included.
        unit: as the metric's.
        higher_is_better: as the metric's.
        digits: as the metric's.
        table_digits: as the metric's.
        coverage: name of the figure that says which share of the pixels this one is over; empty for all.
    """

    key: str
    name: str
    label: str
    unit: str
    higher_is_better: bool
    digits: int
    table_digits: int
    coverage: str = ""


def _loaded_late(module: str, name: str) -> Measure:
    """A function of a module that is imported with the first call."""

    def measure(render: Tensor, target: Tensor, regions: dict[str, Tensor]) -> dict[str, list[float | None]]:
        function: Measure = getattr(import_module(module), name)
        return function(render, target, regions)

    return measure


def _lpips(net: LpipsNet, network: str, **more: Any) -> Metric:
    return Metric(f"lpips_{net}", f"LPIPS ({network})", False, lpips_net=net, network=network, **more)


_BUILT_IN = (
    Metric(
        "psnr",
        "PSNR",
        True,
        unit="dB",
        digits=2,
        table_digits=2,
        measure=_loaded_late("extrags.metrics.image", "psnr_in_regions"),
        shown={
            **_EVERYWHERE,
            "columns": ("", "aligned", "observed", "observed.aligned", "unobserved"),
            "differences": ("", "observed", "observed.aligned"),
            "charts": ("observed", "observed.aligned"),
            "counts": _TOP,
        },
        description="−10 log₁₀ of the mean squared error of red, green and blue in [0, 1], in dB.",  # noqa: RUF001
    ),
    Metric(
        "ssim",
        "SSIM",
        True,
        measure=_loaded_late("extrags.metrics.image", "ssim_in_regions"),
        shown={**_EVERYWHERE, "counts": _TOP},
        description="11 × 11 Gaussian window, σ = 1.5 px; the mean of the map over the pixels.",  # noqa: RUF001
    ),
    _lpips("alex", "AlexNet", shown={**_EVERYWHERE, "charts": _TOP, "counts": _TOP}),
    _lpips("vgg", "VGG16"),
    _lpips(
        "squeeze",
        "SqueezeNet",
        shown={"tiles": _TOP, "columns": _TOP, "restoration": _TOP},
    ),
    Metric(
        "flip",
        "FLIP",
        False,
        measure=_loaded_late("extrags.metrics.flip", "flip_in_regions"),
        shown={"tables": _TOP, "tiles": _TOP, "columns": _TOP},
        description="The LDR form of Andersson et al. (2020), 67 pixels per degree; the mean of the map over "
        "the pixels.",
    ),
    Metric(
        "depth_absrel",
        "Depth AbsRel",
        False,
        kind="depth",
        shown={"tables": _TOP, "tiles": _TOP, "columns": _TOP, "differences": _TOP, "charts": _TOP},
        description="Mean of |rendered − true| / true over pixels with true depth and rendered opacity of "  # noqa: RUF001
        "at least one half. Exposure does not touch it. The coverage is the share of the pixels with true "
        "depth that count; where it differs by more than 1 %, the errors are over different pixels, and "
        "neither is called better.",
        coverage="depth_coverage",
    ),
    Metric(
        "depth_coverage",
        "Depth coverage",
        True,
        kind="depth",
        shown={"tables": _TOP, "columns": _TOP, "differences": _TOP},
    ),
    Metric("depth_rmse", "Depth RMSE", False, unit="mm", kind="depth", shown={}, coverage="depth_coverage"),
    Metric("depth_delta125", "Depth δ < 1.25", True, kind="depth", shown={}, coverage="depth_coverage"),
    Metric(
        "accuracy_mm",
        "Surface accuracy",
        False,
        unit="mm",
        digits=2,
        kind="surface",
        shown={"columns": _SURFACE},
    ),
    Metric(
        "completeness_mm",
        "Completeness",
        False,
        unit="mm",
        digits=2,
        kind="surface",
        shown={"columns": _SURFACE},
    ),
    Metric("precision", "Precision", True, kind="surface", shown={}),
    Metric("recall", "Recall", True, kind="surface", shown={}),
    Metric("fscore", "F-score", True, kind="surface", shown={"columns": _SURFACE, "counts": _SURFACE}),
    Metric("coverage", "Coverage", True, kind="surface", groups=_SURFACE, shown={"columns": _SURFACE}),
)

_NODES = (
    *("aligned", "observed", "unobserved", "whole", "surface", "gain", "pixel_share", "n_gaussians"),
    *("frame", "name"),
)
"""Other names in the trees of metrics, those of single views among them."""
_metrics: dict[str, Metric] = {metric.key: metric for metric in _BUILT_IN}


def register_metric(metric: Metric) -> None:
    """Add a photometric metric to everything that measures and shows metrics.

    Call it before the evaluation, in every process that evaluates or shows results.

    Args:
        metric: with its `measure`, see `extrags.metrics.image.means_in_regions`.

    Raises:
        ConfigError: for a key that is already registered, or a metric without `measure`.
    """
    if metric.key in _metrics or metric.key in _NODES:
        raise ConfigError(f"metric {metric.key}: the key is taken")
    if metric.kind != "photometric" or metric.measure is None:
        raise ConfigError(f"metric {metric.key}: only photometric metrics with a `measure` can be registered")
    _metrics[metric.key] = metric


def unregister_metric(key: str) -> None:
    """Remove a metric that was added by `register_metric`.

    Raises:
        ConfigError: for a metric that was not registered by a program.
    """
    if metric_named(key) in _BUILT_IN:
        raise ConfigError(f"metric {key} belongs to the protocol and stays")
    del _metrics[key]


def added_metrics() -> list[str]:
    """Metrics registered beside the protocol's, as `key@version`: part of the key of cached results."""
    built_in = {metric.key for metric in _BUILT_IN}
    return sorted(f"{metric.key}@{metric.version}" for metric in metrics() if metric.key not in built_in)


def metrics(kind: Kind | None = None) -> tuple[Metric, ...]:
    """The metrics of a kind, or all; those registered by a program come last."""
    return tuple(metric for metric in _metrics.values() if kind in (None, metric.kind))


def metric_named(key: str) -> Metric:
    """The metric of a key.

    Raises:
        ConfigError: for an unknown key.
    """
    if key not in _metrics:
        raise ConfigError(f"no metric {key!r}; known: {', '.join(_metrics)}")
    return _metrics[key]


def figures(place: Place | None = None) -> tuple[Figure, ...]:
    """The figures that are shown in a place, metric by metric; or all figures, group by group."""
    if place is None:
        return tuple(
            _figure(metric, group)
            for group, _, kinds in _GROUPS
            for metric in _metrics.values()
            if metric.kind in kinds and (metric.groups is None or group in metric.groups)
        )
    return tuple(
        _figure(metric, group) for metric in _metrics.values() for group in metric.shown.get(place, ())
    )


def _figure(metric: Metric, group: str) -> Figure:
    words = next(words for path, words, _ in _GROUPS if path == group)
    return Figure(
        metric.key,
        f"{group}.{metric.key}" if group else metric.key,
        metric.label + words,
        metric.unit,
        metric.higher_is_better,
        metric.digits,
        metric.table_digits,
        ".".join(part for part in (group, metric.coverage) if metric.coverage and part),
    )
