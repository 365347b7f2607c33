"""Which stages a run with given settings goes through, told before it begins."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import pytest

from extrags.config import profile_config
from extrags.errors import ConfigError
from extrags.pipeline import Pipeline, stages_that_can_run
from extrags.stages import STAGES
from flows.methods import METHODS, method_config

WHOLE = {"has_poses": True, "has_depth": True, "train": 20, "test": 20}


def run_through(told: dict[str, Any], *arguments: Any) -> set[str]:
    """The stages that a run without a plan goes through, of a source of which so much is told."""
    ran: set[str] = set()

    def stage(name: str) -> Callable[[Pipeline], None]:
        return lambda _: ran.add(name)

    answers = {
        "has_poses": told["has_poses"],
        "has_depth": told["has_depth"],
        "training_frame_count": told["train"],
        "held_out_frames": told["test"],
        "frames_without_pose": (0, 0),
        "virtual_views": 8,
    }
    methods: dict[str, Any] = {name: stage(name) for name in STAGES}
    methods |= {name: lambda _, answer=answer: answer for name, answer in answers.items()}
    type("Run", (Pipeline,), {**methods, "skip": lambda *_: None})(*arguments).run_stages()
    return ran


@pytest.mark.parametrize("method", METHODS)
@pytest.mark.parametrize(
    "told",
    [{}, {"has_poses": False}, {"has_depth": False}, {"has_depth": False, "train": 1}, {"test": 0}],
    ids=str,
)
@pytest.mark.parametrize(
    "settings",
    [{}, {"poses.replace_given": True}, {"depth.enabled": False}, {"uc_nerf.enabled": True}],
    ids=str,
)
def test_they_are_those_that_run(method: str, told: dict[str, Any], settings: dict[str, Any]) -> None:
    config, leave_out = method_config(method, "quick", settings), METHODS[method].leave_out
    found = stages_that_can_run(config, leave_out, **{**WHOLE, **told})
    assert found == run_through({**WHOLE, **told}, config, leave_out)


@pytest.mark.parametrize("left_out", ["surface", "explore", "enhance", "finetune"])
def test_so_they_are_without_a_stage(left_out: str) -> None:
    config = profile_config("quick")
    assert stages_that_can_run(config, [left_out], **WHOLE) == run_through(WHOLE, config, {left_out: "no"})


def test_an_imported_scene_is_not_reconstructed() -> None:
    config = profile_config("quick").with_overrides({"imported.scene": "their.ply"})
    assert stages_that_can_run(config, (), **WHOLE) == set(STAGES) - {"poses", "depth", "coarse"}


def test_what_cannot_be_left_out_is_refused_by_the_run() -> None:
    with pytest.raises(ConfigError, match="cannot be left out"):
        run_through(WHOLE, profile_config("quick"), {"coarse": "no"})
