"""Budgets of a grid: named sets of overrides, from presets and from settings that are varied."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from itertools import product
from typing import Any

from extrags.config import PipelineConfig
from extrags.config.settings import listed_values, settings_of, unknown_setting
from extrags.errors import ConfigError

__all__ = ["PRESETS", "SET_PRESETS", "Budget", "budgets_of", "parsed_vary", "preset_budgets", "reaching"]

AS_PROFILE = "profile"
"""Name of the budget that changes nothing."""
RENDERED_SIZES = ((120, 96), (160, 128), (240, 192))
"""Width and height of the preset `size`, in pixels; 160x128 is the phantom's own."""

PRESETS: dict[str, tuple[tuple[str, ...], tuple[float, ...]]] = {
    "iterations": (("coarse.iterations", "finetune.iterations"), (0.25, 0.5, 1, 2)),
    "gaussians": (("coarse.densify.max_gaussians", "coarse.max_points"), (0.25, 0.5, 1, 2)),
    "views": (("enhance.max_views",), (0.25, 0.5, 1)),
}
"""Settings that a preset multiplies together, and by what; `size` and `steps` set values."""
SET_PRESETS: dict[str, tuple[dict[str, Any], ...]] = {
    "size": tuple({"ingest.width": width, "ingest.height": height} for width, height in RENDERED_SIZES),
    "steps": ({"enhance.steps": 1}, {"enhance.steps": 4}),
    "precision": ({"enhance.precision": "float32"}, {"enhance.precision": "bfloat16"}),
}


@dataclass(frozen=True)
class Budget:
    """A name, and what is changed of a run.

    Args:
        name: `profile` where nothing is: the profile, with what was set for all runs.
        settings: overrides by dotted name.
    """

    name: str = AS_PROFILE
    settings: Mapping[str, Any] = field(default_factory=dict)


def preset_budgets(name: str, config: PipelineConfig) -> list[Budget]:
    """The budgets of a preset for a run: one setting, or one group of settings, at a time.

    Args:
        name: a key of `PRESETS` or `SET_PRESETS`.
        config: of the run, whose values are multiplied: the profile's with what was set beside it.

    Raises:
        ConfigError: for an unknown preset.
    """
    if name in SET_PRESETS:
        return [_budget(settings) for settings in SET_PRESETS[name]]
    if name not in PRESETS:
        known = ", ".join((*PRESETS, *SET_PRESETS))
        raise ConfigError(f"no preset of budgets {name!r}; known: {known}")
    names, factors = PRESETS[name]
    made = []
    for factor in factors:
        settings = {setting: max(1, round(config.value(setting) * factor)) for setting in names}
        made.append(Budget(AS_PROFILE) if factor == 1 else _budget(settings))
    return made


def budgets_of(
    config: PipelineConfig, presets: Sequence[str], vary: Sequence[Sequence[Mapping[str, Any]]]
) -> list[Budget]:
    """All budgets of a run: those of each preset, and every combination of what is varied.

    Args:
        config: of the run, with the profile's settings and what was set beside it.
        presets: names; see `preset_budgets`.
        vary: of each axis, the overrides at its points (`parsed_vary`).

    Returns:
        Without repetitions; without presets and axes the run as it is alone.

    Raises:
        ConfigError: for an unknown preset, or a setting on two axes.
    """
    found: dict[str, Budget] = {}
    for preset in presets:
        found |= {budget.name: budget for budget in preset_budgets(preset, config)}
    if vary:
        taken = [name for axis in vary for name in axis[0]]
        if len(set(taken)) < len(taken):
            raise ConfigError(f"a setting is varied twice: {', '.join(sorted(taken))}")
        for point in product(*vary):
            merged: dict[str, Any] = {}
            for part in point:
                merged |= part
            budget = _budget(merged)
            found[budget.name] = budget
    return list(found.values()) or [Budget()]


def parsed_vary(text: str) -> list[dict[str, Any]]:
    """`coarse.iterations=500,1500` to `[{"coarse.iterations": 500}, {"coarse.iterations": 1500}]`.

    Settings that change together are joined by `+`; each value is then one for all of them, or one for each,
    joined by `+` as well: `ingest.width+ingest.height=120+96,160+128`. Values are written as for the
    setting's own flag; those that hold commas themselves between brackets:
    `enhance.channels=[8,8,16],[16,16,32]`.

    Raises:
        ConfigError: for an unknown setting, one without values, a wrong value, or values that do not match
            the settings.
    """
    left, separator, right = text.partition("=")
    names, points = left.split("+"), [point for point in listed_values(right) if point]
    if not separator or not points:
        raise ConfigError(f"--vary {text}: expected NAME=VALUE,VALUE, e.g. coarse.iterations=500,1500")
    known = settings_of(PipelineConfig)
    for name in names:
        if name not in known:
            raise unknown_setting(name, known)
    found = []
    for point in points:
        values = point.split("+")
        if len(values) == 1:
            values *= len(names)
        if len(values) != len(names):
            raise ConfigError(f"--vary {text}: {point} has {len(values)} values for {len(names)} settings")
        found.append({name: known[name].parse(value) for name, value in zip(names, values, strict=True)})
    return found


def reaching(budget: Budget, left_out: Mapping[str, str]) -> dict[str, Any]:
    """The overrides that reach a method, which leaves out some stages.

    Args:
        budget: as asked for.
        left_out: stages that the method does not run.
    """
    return {name: value for name, value in budget.settings.items() if name.partition(".")[0] not in left_out}


def _budget(settings: Mapping[str, Any]) -> Budget:
    return Budget(", ".join(f"{name}={value}" for name, value in settings.items()), dict(settings))
