"""Arguments of other kinds than functions of `import extrags` take."""

from __future__ import annotations

import pickle
from collections.abc import Callable
from inspect import isfunction
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

import extrags
from extrags import api
from extrags.arguments import check_argument
from extrags.errors import ConfigError


@pytest.fixture(scope="module")
def sequence() -> Any:
    return extrags.sequence_from_arrays(
        np.full((3, 8, 8, 3), 100, np.uint8),
        np.array([[8.0, 0, 4], [0, 8, 4], [0, 0, 1]]),
        world_from_camera=np.tile(np.eye(4), (3, 1, 1)),
    )


@pytest.fixture(scope="module")
def scene() -> Any:
    points = np.zeros((5, 3))
    return extrags.Scene(extrags.Gaussians.from_points(points, points, np.ones(5)))


REVERSED: list[Callable[..., Any]] = [
    extrags.evaluate,
    extrags.render,
    extrags.assess,
    extrags.explore,
    lambda first, second: extrags.restore(first, second, []),
    lambda first, second: extrags.finetune(first, second, None),
]


@pytest.mark.parametrize("function", REVERSED)
def test_a_scene_and_a_sequence_that_are_reversed(function: Any, scene: Any, sequence: Any) -> None:
    with pytest.raises(TypeError, match=r"EndoscopicSequence as its scene; .* order is \w+\(scene, sequence"):
        function(sequence, scene)


@pytest.mark.parametrize("function", REVERSED)
def test_a_result_in_place_of_its_scene(function: Any, scene: Any, sequence: Any) -> None:
    with pytest.raises(TypeError, match=r"as its scene; pass its \.scene$"):
        function(SimpleNamespace(scene=scene), sequence)


@pytest.mark.parametrize(
    ("call", "error", "said"),
    [
        (lambda e, q, s: e.estimate_poses("x"), TypeError, r"'x' as its sequence; pass extrags\.read"),
        (lambda e, q, s: e.estimate_depth("x"), TypeError, r"'x' as its sequence; pass extrags\.read"),
        (lambda e, q, s: e.reconstruct(q, frames="x"), TypeError, "indices, such as sequence.train"),
        (lambda e, q, s: e.run_pipeline(s), TypeError, "type Scene as its sequence"),
        (lambda e, q, s: e.run_pipeline(q, leave_out=["explore"]), TypeError, "pass a mapping"),
        (lambda e, q, s: e.fuse_surface(s, q), TypeError, r"as its cameras; pass its \.cameras"),
        (lambda e, q, s: e.carve(s, q.cameras, q.cameras), TypeError, r"pass a Mesh, such as extrags\.fuse"),
        (
            lambda e, q, s: e.explore(s, q, freespace=s),
            TypeError,
            r"pass a FreeSpace, such as extrags\.carve",
        ),
        (lambda e, q, s: e.restore(s, q, q.cameras), TypeError, "a list of Cameras"),
        (lambda e, q, s: e.finetune(s, q, q), TypeError, "PseudoViews, .*, or a function"),
        (lambda e, q, s: e.with_estimated_poses(q, q), TypeError, r"extrags\.estimate_poses\(sequence\)"),
        (lambda e, q, s: e.with_estimated_depth(q, q), TypeError, r"extrags\.estimate_depth\(sequence\)"),
        (lambda e, q, s: e.register_reader(3), TypeError, "pass a FolderReader"),
        (lambda e, q, s: e.register_metric("psnr"), TypeError, "pass a Metric"),
        (lambda e, q, s: e.means_in_regions(3), TypeError, "pass a function"),
        (lambda e, q, s: e.assess(s, q, "quick"), ConfigError, r"such as extrags\.PROFILES\[\"quick\"\]$"),
        (lambda e, q, s: e.explore(s, q, e.PROFILES["quick"]), ConfigError, r"pass its \.explore$"),
        (lambda e, q, s: e.estimate_poses(q, "x"), ConfigError, r"PROFILES\[\"quick\"\]\.poses"),
        (lambda e, q, s: e.render(s, q, train_on="al"), ConfigError, "pass 'train' or 'all'"),
    ],
)
def test_what_else_is_wrong(call: Any, error: type[Exception], said: str, sequence: Any, scene: Any) -> None:
    with pytest.raises(error, match=said):
        call(extrags, sequence, scene)


def test_a_sequence_in_place_of_cameras_of_a_view(sequence: Any, scene: Any) -> None:
    with pytest.raises(TypeError, match=r"Scene\.render was given .* as its cameras; pass its \.cameras"):
        check_argument(sequence, extrags.Cameras, "Scene.render", "cameras")
    scene.render(sequence.cameras[0])


def test_missing_arguments_are_told_by_python(scene: Any) -> None:
    evaluate: Any = extrags.evaluate
    with pytest.raises(TypeError, match=r"evaluate\(\) missing 1 required positional argument: 'sequence'"):
        evaluate(scene)


@pytest.mark.parametrize("name", [name for name in api.__all__ if isfunction(getattr(api, name))])
def test_functions_are_pickled_by_name(name: str) -> None:
    function = getattr(extrags, name)
    assert pickle.loads(pickle.dumps(function)) is function
