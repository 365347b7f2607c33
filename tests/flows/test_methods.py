"""What each method pins and shares; the baseline above all."""

from __future__ import annotations

from typing import get_args

import pytest

from extrags.config import PROFILES, CoarseConfig, PipelineConfig
from extrags.config.settings import settings_of
from extrags.errors import ConfigError
from extrags.pipeline import NEED_GAUSSIANS
from flows.methods import (
    METHODS,
    THREE_DGS_SHARED,
    MethodName,
    check_not_pinned,
    method_config,
    profile_label,
    three_dgs,
)


def test_the_names_are_those_of_the_flows_parameter() -> None:
    assert tuple(METHODS) == get_args(MethodName)


def test_the_baseline_decides_on_every_setting_of_the_coarse_stage() -> None:
    """A new setting must be pinned for plain 3DGS in `three_dgs`, or named in `THREE_DGS_SHARED`."""
    pinned = {name.removeprefix("coarse.") for name in three_dgs(PipelineConfig())}
    # With the light switched off its other settings do nothing.
    every = {name for name in settings_of(CoarseConfig) if not name.startswith("light.")} | {"light.enabled"}
    assert pinned & THREE_DGS_SHARED == set()
    assert every - pinned - THREE_DGS_SHARED == set()
    assert (pinned | THREE_DGS_SHARED) - every == set()


@pytest.mark.parametrize("profile", list(PROFILES))
def test_the_baseline_is_not_handicapped(profile: str) -> None:
    ours, plain = method_config("coarse", profile).coarse, method_config("3dgs", profile).coarse
    assert plain.iterations == ours.iterations
    assert plain.max_points == ours.max_points
    assert plain.densify.max_gaussians == ours.densify.max_gaussians
    assert plain.densify.enabled
    # All harmonics are there after a tenth of the run, as published, however short it is.
    assert plain.sh_degree == 3
    assert 3 * plain.sh_every == pytest.approx(plain.iterations / 10, rel=0.01)


def test_the_baseline_is_plain() -> None:
    plain = method_config("3dgs", "paper").coarse
    assert not plain.light.enabled
    assert plain.depth_weight == 0
    assert plain.dssim_weight == 0.2
    assert plain.sh_every == 1000
    assert plain.densify.start_share * plain.iterations == pytest.approx(500)
    assert plain.densify.stop_share * plain.iterations == pytest.approx(15_000)
    assert set(METHODS["3dgs"].leave_out) >= {"explore", "enhance", "finetune"}


def test_a_baseline_of_its_own_representation_leaves_out_what_needs_gaussians() -> None:
    assert method_config("uc-nerf", "quick").uc_nerf.enabled
    assert set(METHODS["uc-nerf"].leave_out) == set(NEED_GAUSSIANS)
    for name in set(METHODS) - {"uc-nerf"}:
        assert not method_config(name, "quick").uc_nerf.enabled


def test_overrides_and_seeds_reach_what_is_open_only() -> None:
    config = method_config("3dgs", "quick", {"coarse.iterations": 600, "coarse.sh_degree": 0}, 4)
    assert (config.coarse.iterations, config.coarse.seed) == (600, 4)
    assert (config.coarse.sh_degree, config.coarse.sh_every) == (3, 20)
    assert method_config("classical", "quick").enhance.backend == "classical"
    assert method_config("extrags", "quick") == method_config("coarse", "quick")


def test_an_override_of_a_pinned_setting_is_refused_where_both_are_named() -> None:
    check_not_pinned("3dgs", {"coarse.iterations": 5})
    check_not_pinned("coarse", {"coarse.light.enabled": False})
    with pytest.raises(ConfigError, match=r"3dgs sets coarse\.sh_degree itself"):
        check_not_pinned("3dgs", {"coarse.sh_degree": 1})
    with pytest.raises(ConfigError, match="no method 'nerf'; known: extrags"):
        method_config("nerf", "quick")


def test_pages_name_the_method() -> None:
    assert profile_label("quick", "extrags") == "quick"
    assert profile_label("quick", "3dgs") == "quick, method 3dgs"
