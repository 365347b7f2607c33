"""The keys of the depth stage: what another depth would come from is in them, and nothing else."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any

import pytest

import extrags.poses
from extrags.config import DepthConfig, PosesConfig
from extrags.store import Ref
from tasks.depth import TRIANGULATION, depth, keyed_settings, triangulation_settings
from tasks.stage import stage_key

OTHER: dict[str, Any] = {
    "max_width": 200,
    "n_features": 500,
    "peak_threshold": 0.01,
    "edge_threshold": 8.0,
    "sequential_overlap": 3,
    "exhaustive_below": 9,
    "seed": 4,
}


def key(digest: str = "frames", weights: str | None = "weights", **settings: Any) -> str:
    poses = PosesConfig(**settings.pop("poses", {}))
    monocular_digest = settings.pop("monocular_digest", None)
    config = DepthConfig(**settings)
    return stage_key(
        depth,
        {
            "sequence": Ref(uri="somewhere/frames", digest=digest),
            "config": keyed_settings(config),
            "features": triangulation_settings(poses),
            "weights_digest": weights,
            "monocular_digest": monocular_digest,
            "monocular": config.monocular,
        },
    )


def test_frames_settings_and_weights_are_in_it() -> None:
    keys = [key(), key("others"), key(weights="others"), key(weights=None), key(hypotheses=32)]
    assert len(set(keys)) == len(keys)
    assert key() == key()


@pytest.mark.parametrize("there", [True, False])
def test_the_device_is_settled_before_the_key(there: bool, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("torch.cuda.is_available", lambda: there)
    assert key(device="cuda") != key(device="cpu")
    assert key(device="auto") == key(device="cuda" if there else "cpu")


def test_a_monocular_network_counts_by_its_content() -> None:
    here, there = (key(monocular=folder, monocular_digest="one") for folder in ("here", "there"))
    assert here == there
    assert len({here, key(), key(monocular="here", monocular_digest="other")}) == 3


@pytest.mark.parametrize("name", sorted(TRIANGULATION))
def test_features_are_in_it(name: str) -> None:
    assert key(poses={name: OTHER[name]}) != key()


def test_what_only_estimates_poses_is_not() -> None:
    others = {"fallback": "never", "working_distance_mm": 30.0, "min_registered_share": 0.7}
    assert key(poses=others) == key()


def test_triangulation_reads_no_other_setting() -> None:
    (folder,) = extrags.poses.__path__
    read = set()
    for module in ("colmap_triangulation", "features"):
        source = (Path(folder) / f"{module}.py").read_text(encoding="utf-8")
        read |= set(re.findall(r'settings\["(\w+)"\]', source))
        for names in re.findall(r"settings\[key\] for key in \(([^)]*)\)", source):
            read |= set(re.findall(r'"(\w+)"', names))
    before = (Path(folder) / "triangulation.py").read_text(encoding="utf-8")
    read |= set(re.findall(r"\bconfig\.(\w+)\b(?!\()", before))
    assert read == TRIANGULATION
