"""What each method pins and shares; the baseline above all."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any, get_args

import pytest
import yaml

from extrags.config import PROFILES, CoarseConfig, PipelineConfig
from extrags.config.settings import settings_of
from extrags.errors import ConfigError
from extrags.pipeline import HELD_OUT_TRAINED_ON
from flows.benchmark import Case, case_of, check_methods
from flows.methods import (
    METHODS,
    PAPER_SHARED,
    THREE_DGS_SHARED,
    MethodName,
    check_not_pinned,
    gaussian_pancakes,
    method_config,
    paper,
    profile_label,
    three_dgs,
)
from flows.outcome import SequenceOutcome, StageRow
from flows.tables import benchmark_markdown


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


def test_gaussian_pancakes_is_the_baseline_with_two_terms() -> None:
    plain, pancakes = three_dgs(PipelineConfig()), gaussian_pancakes(PipelineConfig())
    changed = {name.removeprefix("coarse.") for name in pancakes if pancakes[name] != plain.get(name)}
    assert changed == {
        "densify.stop_share",
        "depth_loss",
        "depth_weight",
        "depth_weight_final_share",
        "depth_huber_delta",
        "normal_weight",
        "normal_start_share",
        "normal_every",
    }
    assert set(plain) <= set(pancakes)
    config = method_config("gaussian-pancakes", "paper").coarse
    assert config.normal_start_share * config.iterations == pytest.approx(1000)
    assert config.densify.start_share * config.iterations == pytest.approx(500)
    assert config.densify.stop_share * config.iterations == pytest.approx(4000)
    assert (config.depth_weight, config.normal_weight) == (0.2, 0.2)


def test_the_paper_decides_on_every_setting_of_its_own_stages() -> None:
    """A new setting of exploration or fine-tuning must be pinned in `paper`, or named in `PAPER_SHARED`."""
    pinned = set(paper(PipelineConfig()))
    every = {name for name in settings_of(PipelineConfig) if name.startswith(("explore.", "finetune."))} - {
        "explore.seed"
    }
    assert pinned & PAPER_SHARED == set()
    assert every - pinned - PAPER_SHARED == set()
    assert every >= PAPER_SHARED
    # Its coarse scene is plain 3DGS, every setting of which is decided on.
    assert three_dgs(PipelineConfig()).items() <= paper(PipelineConfig()).items()


def test_the_paper_s_counts_with_its_own_profile() -> None:
    config = method_config("paper", "paper")
    assert (config.coarse.iterations, config.finetune.iterations) == (30_000, 15_000)
    assert config.finetune.densify_share * config.finetune.iterations == pytest.approx(9_000)
    assert (config.explore.trajectories, config.explore.directions, config.freespace.grid_size) == (
        20,
        32,
        64,
    )
    # Every virtual view is restored.
    assert config.enhance.max_views >= config.explore.trajectories * (config.explore.length - 1)
    assert config.ingest.size == "central"
    assert config.enhance.max_width is None
    assert (config.ingest.width, config.ingest.height) == (None, None)
    quick = method_config("paper", "quick")
    assert quick.finetune.iterations == method_config("extrags", "quick").finetune.iterations


def test_the_documented_settings_of_the_paper_s_search() -> None:
    """The rows name settings, and the cells give their values in the same order or by name."""
    page = (Path(__file__).parents[2] / "docs" / "algorithms" / "exploration.md").read_text()
    heading, _, *rows = re.findall(r"^\|.*", page.split("## The paper's search")[1], re.MULTILINE)
    columns = re.findall(r"method `([a-z]+)`", heading)
    assert columns == ["paper", "exploregs"]
    checked = set()
    for row in rows:
        names, *cells = row.strip("| ").split(" | ")
        for method, cell in zip(columns, cells, strict=True):
            named = dict(re.findall(r"`([a-z_.]+)` (\S+)", cell))
            values = named or dict(zip(re.findall(r"`([a-z_.]+)`", names), cell.split(", "), strict=True))
            config = method_config(method, "paper")
            for name, value in values.items():
                assert config.value(name) == yaml.safe_load(value), (method, name)
            checked |= set(values)
    assert {"explore.max_expansions", "explore.length", "explore.fold_penalty", "enhance.iou"} <= checked
    assert "12 and 10 with `quick`" in page
    quick = method_config("paper", "quick").explore
    assert (quick.trajectories, quick.length) == (12, 10)


def test_the_paper_s_losses() -> None:
    """L1 + (1 - SSIM), the pixel weight on L1 alone, U_img once."""
    found = method_config("paper", "quick").finetune
    assert found.loss == "paper"
    assert found.dssim_weight is not None
    assert found.photometric_weight * (1 - found.dssim_weight) == pytest.approx(1)
    # The term is (1 - SSIM) / 2.
    assert found.photometric_weight * found.dssim_weight / 2 == pytest.approx(1)
    assert found.pseudo_weight == 1
    assert (found.pseudo_depth, found.seed_holes, found.keep_known) == (False, False, False)
    assert (found.depth_weight, found.confidence_floor) == (0, 0)


def test_the_rows_beside_the_paper_s_differ_in_their_parts_alone() -> None:
    def changes(method: str, base: str) -> dict[str, object]:
        one, other = (METHODS[name].pinned(PipelineConfig()) for name in (method, base))
        assert set(one) == set(other)
        assert METHODS[method].leave_out == METHODS[base].leave_out
        return {name: value for name, value in one.items() if value != other[name]}

    assert changes("paper-no-illum-fold", "paper") == {
        "explore.darkness_weight": 0.0,
        "explore.fold_penalty": 1.0,
    }
    assert changes("exploregs", "paper-no-illum-fold") == {
        "explore.visibility": "frustum",
        "enhance.iou": "union",
    }


def test_the_oracle_alone_trains_on_held_out_frames() -> None:
    for method in METHODS:
        config = method_config(method, "quick")
        assert config.coarse.train_on == ("all" if method == "oracle" else "train")
        # Neither openly nor by a variant or an override for all methods.
        other = "train" if method == "oracle" else "all"
        with pytest.raises(ConfigError, match=r"sets coarse\.train_on itself"):
            check_not_pinned(method, {"coarse.train_on": other})
        with pytest.raises(ConfigError, match=r"sets coarse\.train_on itself"):
            method_config(method, "quick", {"coarse.train_on": other})
    with pytest.raises(ConfigError, match=r"variant seen: coarse\.train_on cannot be changed"):
        check_methods(["coarse"], {"seen": {"coarse.train_on": "all"}})
    oracle, ours = method_config("oracle", "balanced"), method_config("coarse", "balanced")
    # Its poses stay those that it is evaluated at.
    assert not oracle.coarse.refine_poses
    same = oracle.with_overrides({"coarse.train_on": "train", "coarse.refine_poses": "auto"})
    assert same == ours


def test_tables_say_which_method_has_seen_held_out_frames() -> None:
    def case(method: str, reason: str) -> dict[str, Any]:
        outcome = SequenceOutcome("made/up@sparse", stages=[StageRow("coarse", "ran", reason=reason)])
        return case_of(Case(method, "quick", 0, outcome))

    plain, ceiling = case("3dgs", "poses refined"), case("ceiling", HELD_OUT_TRAINED_ON)
    assert (plain["held_out_trained_on"], ceiling["held_out_trained_on"]) == (False, True)
    assert "oracle" not in benchmark_markdown([plain], "3dgs")
    found = benchmark_markdown([plain, ceiling], "3dgs")
    assert found.startswith("oracle: held-out frames were trained on in ceiling.")


def test_a_baseline_of_its_own_representation_leaves_out_what_needs_gaussians() -> None:
    assert method_config("uc-nerf", "quick").uc_nerf.enabled
    assert set(METHODS["uc-nerf"].leave_out) == {"assess", *METHODS["coarse"].leave_out}
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
    assert profile_label("quick", "oracle") == "quick, oracle: held-out frames were trained on"
