"""Which settings change which cache keys: each changes its stage and what follows, and nothing before.

All settings are found by introspection. `DIRECTLY` (`cache_key_tables`) says which stages read them; a
setting without an entry fails, as does one that changes more or less than it should.
"""

from __future__ import annotations

import json
import os
import shutil
from collections.abc import Iterable
from dataclasses import replace
from fnmatch import fnmatchcase
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image

import flows.wiring
from extrags.config import PipelineConfig
from extrags.config.settings import Setting, settings_of
from extrags.errors import ConfigError
from extrags.finetuning_judgement import Judgement
from extrags.restoration.restored_renders import RestoredShares
from extrags.store import Store
from flows.runners import DirectRunner, StoreRunner
from flows.wiring import run_sequence
from tasks.stage import StageKey
from tests.flows.cache_key_tables import DIRECTLY, EXPLORE, FOLLOWS, OTHERS
from tests.flows.recorded_keys import KEPT, RecordedRun, recorded_keys, recorded_run
from tests.flows.tiny import SEQUENCE, tiny_config

SETTINGS = settings_of(PipelineConfig)

BASE = PipelineConfig().with_overrides(
    {
        "ingest.width": 64,
        "ingest.height": 51,
        "device": "cpu",
        "depth.device": "cpu",
        "enhance.keyframes": 2,
        "enhance.precision": "float32",
    }
)
"""What depends on the machine is settled; what `auto` becomes is tested beside the stages. With
keyframes, which have a stage of their own."""


@pytest.fixture(autouse=True)
def given_weights(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """No test depends on the weights of this machine."""
    (tmp_path / "lpips").mkdir()
    for net in ("alex", "vgg", "squeeze"):
        (tmp_path / "lpips" / f"lpips_{net}_v0.1.npz").write_bytes(net.encode())
    monkeypatch.setenv("EXTRAGS_LPIPS_WEIGHTS", str(tmp_path / "lpips"))


@pytest.fixture
def hashed_once(monkeypatch: pytest.MonkeyPatch) -> None:
    """The weights of the package are not read anew for each setting."""
    for name in ("restorer_digest", "depth_completion_digest"):
        monkeypatch.setattr(flows.wiring, name, cache(getattr(flows.wiring, name)))


def with_all_that_follow(stages: Iterable[str]) -> set[str]:
    found: set[str] = set()
    waiting = list(stages)
    while waiting:
        stage = waiting.pop()
        if stage not in found:
            found.add(stage)
            waiting += FOLLOWS[stage]
    return found - {"after-coarse"}


def changed(before: dict[str, list[str]], after: dict[str, list[str]]) -> set[str]:
    return {stage for stage in {*before, *after} if set(before.get(stage, ())) != set(after.get(stage, ()))}


def expected(stages: Iterable[str], present: Iterable[str]) -> set[str]:
    """The page shows all settings: whatever changes, it is made anew."""
    return with_all_that_follow((*stages, "report")) & set(present)


def directly(name: str) -> tuple[str, ...]:
    for pattern, stages in DIRECTLY.items():
        if fnmatchcase(name, pattern):
            return stages
    raise AssertionError(f"the setting {name} has no entry in DIRECTLY: which stages read it?")


def another(setting: Setting, value: Any) -> Any:
    """Another valid value of a setting."""
    if setting.name in OTHERS:
        return OTHERS[setting.name]
    number = isinstance(value, int | float) and not isinstance(value, bool)
    candidates = [*setting.choices, "true", "false"]
    candidates += [str(value + 1), str(value - 1), str(value * 0.9), str(value * 1.1)] if number else []
    candidates += ["16", "20", "0.5", "other"]
    for text in candidates:
        try:
            found = setting.parse(text)
        except ConfigError:
            continue
        if found is not None and found != value:
            return found
    raise AssertionError(f"no other value of {setting.name} is known: give one in OTHERS")


def value_of(config: PipelineConfig, name: str) -> Any:
    found: Any = config
    for part in name.split("."):
        found = getattr(found, part)
    return found


def differences(base: PipelineConfig, names: Iterable[str], **kind: Any) -> dict[str, set[str]]:
    """The stages that each setting changes; settings to be left out have the value None in `OTHERS`."""
    before = recorded_keys(SEQUENCE, base, **kind)
    found = {}
    for name in names:
        other = another(SETTINGS[name], value_of(base, name))
        if other is None:
            continue
        start, keys = base, before
        if name == "ingest.downscale":
            # Beside a width it is refused.
            start = base.with_overrides({"ingest.width": None, "ingest.height": None})
            keys = recorded_keys(SEQUENCE, start, **kind)
        after = recorded_keys(SEQUENCE, start.with_overrides({name: other}), **kind)
        found[name] = changed(keys, after)
    return found


@pytest.mark.usefixtures("hashed_once")
def test_every_setting_changes_its_stage_and_what_follows() -> None:
    present = {*recorded_keys(SEQUENCE, BASE), "uc-nerf", "uc-nerf-render"}
    assert present == set(FOLLOWS) - {"after-coarse"}
    found = differences(BASE, SETTINGS)
    assert len(found) == len(SETTINGS) - sum(value is None for value in OTHERS.values())
    wrong = {}
    for name, stages in found.items():
        apart = {"uc-nerf", "uc-nerf-render"} if name != "uc_nerf.enabled" else set()
        should = expected(directly(name), present) - apart
        if stages != should:
            wrong[name] = {"too much": sorted(stages - should), "too little": sorted(should - stages)}
    assert wrong == {}


@pytest.mark.usefixtures("hashed_once")
def test_features_of_triangulation_count_where_the_source_has_poses() -> None:
    names = [name for name in SETTINGS if name.startswith("poses.")]
    found = differences(BASE, names, has_poses=True)
    counted = {"max_width", "n_features", "peak_threshold", "edge_threshold"}
    counted |= {"sequential_overlap", "exhaustive_below"}
    present = recorded_keys(SEQUENCE, BASE, has_poses=True)
    for name, stages in found.items():
        if name == "poses.replace_given":
            assert stages == expected(["poses"], {*present, "poses"})
        elif name.removeprefix("poses.") in {*counted, "seed"}:
            assert stages == expected(["depth"], present), name
        else:
            assert stages == {"report"}, name


@pytest.mark.usefixtures("hashed_once")
@pytest.mark.parametrize(
    ("shares", "given"),
    [(None, None), (RestoredShares(), None), (RestoredShares(0.1, 0.3), (0.1, 0.3))],
)
def test_restored_views_are_given_what_the_judge_found(
    shares: RestoredShares | None, given: tuple[float, float] | None
) -> None:
    judgement = Judgement(1.0, "made up", restored_shares=shares)
    recorded = RecordedRun(has_poses=True, has_depth=True, judgement=judgement)
    recorded_run(SEQUENCE, BASE, recorded)
    assert recorded.inputs["evaluate-restore"]["shares"] == given


@pytest.mark.usefixtures("hashed_once")
def test_the_radiance_field_reads_its_own_settings_alone() -> None:
    base = BASE.with_overrides({"uc_nerf.enabled": True})
    present = recorded_keys(SEQUENCE, base)
    names = [name for name in SETTINGS if name.startswith(("uc_nerf.", "coarse.see", "depth.h", "explore.w"))]
    for name, stages in differences(base, names).items():
        if name == "uc_nerf.enabled":
            continue
        assert stages == expected(["uc-nerf"] if name.startswith("uc_nerf.") else [], present), name


@pytest.mark.parametrize(
    ("backend", "read"),
    [
        ("wan-vace", ("caption", "pretrained")),
        ("dynamicrafter", ("caption", "checkpoint")),
        ("classical", ()),
    ],
)
def test_a_backend_reads_its_own_settings_alone(
    backend: str, read: tuple[str, ...], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(flows.wiring, "restorer_digest", lambda config: "model")
    devices = {f"enhance.{part}.device": "cpu" for part in ("pretrained", "checkpoint")}
    base = BASE.with_overrides({"enhance.backend": backend, **devices})
    present = recorded_keys(SEQUENCE, base)
    # How a caption is asked for is not what it is, and its file counts by its content.
    uncounted = {f"enhance.caption.{name}" for name in ("file", "timeout_s", "retries", "retry_wait_s")}
    for name, stages in differences(base, [name for name in SETTINGS if name.startswith("enhance.")]).items():
        group = name.split(".")[1] if name.count(".") > 1 else ""
        restoring = set(directly(name)) - {"enhance-train"}
        if group:
            should = ["enhance-train"] if group in read and name not in uncounted else []
        elif name == "enhance.backend" or (name == "enhance.seed" and read):
            should = ["enhance-train"]
        elif name == "enhance.precision":
            # That of the refiner of restored views.
            should = ["evaluate-restore"]
        else:
            should = list(restoring)
        if name != "enhance.backend":
            assert stages == expected(should, present), name


def test_the_oracle_is_another_reconstruction() -> None:
    left_out = dict.fromkeys(("assess", "surface", "freespace", "explore", "enhance", "finetune"), "oracle")
    before = recorded_keys(SEQUENCE, BASE, has_poses=True, has_depth=True, leave_out=left_out)
    oracle = BASE.with_overrides({"coarse.train_on": "all"})
    after = recorded_keys(SEQUENCE, oracle, has_poses=True, has_depth=True, leave_out=left_out)
    assert changed(before, after) == {"coarse", "evaluate-render", "evaluate-views", "evaluate", "report"}


class TestContent:
    """Files that settings name count by what is in them."""

    @pytest.mark.parametrize(
        ("name", "file", "stages"),
        [
            ("ingest.calibration", "calibration.yaml", ("ingest",)),
            ("depth.completion", "own.safetensors", ("depth",)),
            ("depth.monocular", "folder/model.bin", ("depth",)),
            ("enhance.pretrained_weights", "folder/restorer.safetensors", ("enhance-train",)),
            (
                "evaluate.lpips_weights",
                "folder/lpips_alex_v0.1.npz",
                ("enhance-restore", "finetune-judge", "evaluate"),
            ),
        ],
    )
    def test_other_content_misses_and_a_copy_hits(
        self,
        name: str,
        file: str,
        stages: tuple[str, ...],
        tmp_path: Path,
        monkeypatch: pytest.MonkeyPatch,
    ) -> None:
        def digest(folder: str | None) -> str | None:
            return None if folder is None else (Path(folder) / "model.bin").read_text()

        monkeypatch.setattr(flows.wiring, "depth_monocular_digest", digest)

        def keys(place: str) -> dict[str, list[str]]:
            given = tmp_path / place / file
            given = given.parent if "/" in file else given
            return recorded_keys(SEQUENCE, BASE.with_overrides({name: str(given)}))

        for place, content in (("one", b"content"), ("copy", b"content"), ("other", b"cOntent")):
            given = tmp_path / place / file
            given.parent.mkdir(parents=True)
            given.write_bytes(content)
            given.with_suffix(".json").write_text("{}")
            os.utime(given, (1e9, 1e9))
        assert changed(keys("one"), keys("copy")) == {"report"}
        present = recorded_keys(SEQUENCE, BASE)
        assert changed(keys("one"), keys("other")) == expected(stages, present)

    def test_an_imported_scene(self, tmp_path: Path) -> None:
        """It takes the place of the coarse stage: all that follows this one changes with its content."""

        def keys(place: str, scale: float = 1.0) -> dict[str, list[str]]:
            base = BASE.with_overrides(
                {"imported.scene": str(tmp_path / place / "theirs.ply"), "imported.scale": scale}
            )
            return recorded_keys(SEQUENCE, base, has_poses=True)

        for place, content in (("one", b"content"), ("copy", b"content"), ("other", b"cOntent")):
            (tmp_path / place).mkdir()
            (tmp_path / place / "theirs.ply").write_bytes(content)
        present = keys("one")
        usual = recorded_keys(SEQUENCE, BASE, has_poses=True)
        assert set(present) == {*usual, "import-scene"} - {"coarse", "refined-frames"}
        assert changed(present, keys("copy")) == {"report"}
        follow = with_all_that_follow(["coarse"]) & set(present) | {"import-scene", "report"}
        assert changed(present, keys("other")) == follow
        assert changed(present, keys("one", 2.0)) == follow

    def test_a_source_of_the_same_name_and_size(self, tmp_path: Path) -> None:
        source = tmp_path / "source"
        (source / "rgb").mkdir(parents=True)
        frames = []
        for name in ("0", "1"):
            Image.fromarray(np.full((40, 48, 3), 90, np.uint8)).save(source / "rgb" / f"{name}.png")
            frames.append({"file": f"rgb/{name}.png", "world_from_camera": np.eye(4).tolist()})
        content = {"K": [[40, 0, 24], [0, 40, 20], [0, 0, 1]], "frames": frames}
        (source / "poses.json").write_text(json.dumps(content))
        before = recorded_keys(str(source), BASE, has_poses=True, has_depth=True)
        copy = shutil.copytree(source, tmp_path / "elsewhere" / "source")
        assert recorded_keys(str(copy), BASE, has_poses=True, has_depth=True) == before
        # Of another name it is the same content, and has a page of its own.
        other = RecordedRun(has_poses=True, has_depth=True, judgement=KEPT)
        recorded_run(str(shutil.copytree(source, tmp_path / "renamed")), BASE, other)
        assert changed(before, dict(other.keys)) == {"report"}
        assert other.inputs["report"]["name"] == "renamed"
        poses = copy / "poses.json"
        text = poses.read_text()
        position = next(index for index, letter in enumerate(text) if letter in "2345678")
        stat = poses.stat()
        poses.write_text(text[:position] + str(int(text[position]) + 1) + text[position + 1 :])
        os.utime(poses, ns=(stat.st_atime_ns, stat.st_mtime_ns))
        assert poses.stat().st_size == stat.st_size
        after = recorded_keys(str(copy), BASE, has_poses=True, has_depth=True)
        assert changed(before, after) == set(before)


def test_a_moved_store_hits(tmp_path: Path) -> None:
    store = str(tmp_path / "store")
    made = run_sequence(SEQUENCE, tiny_config(), store, DirectRunner(store), until="ingest")
    assert made.status == "ok"
    moved = str(tmp_path / "elsewhere" / "store")
    shutil.copytree(store, moved)
    shutil.rmtree(store)
    found = run_sequence(SEQUENCE, tiny_config(), moved, StoreRunner(moved), until="ingest")
    assert found.digests == made.digests
    assert Store(moved).verify(found.refs["ingest"])


@pytest.mark.usefixtures("hashed_once")
def test_a_raised_version_runs_that_stage_and_what_follows(monkeypatch: pytest.MonkeyPatch) -> None:
    before = recorded_keys(SEQUENCE, BASE)
    compute = StageKey.compute_key
    for raised in before:

        def bumped(self: StageKey, *inputs: Any, stage: str = raised) -> str:
            return compute(replace(self, version=self.version + (self.name == stage)), *inputs)

        with monkeypatch.context() as patched:
            patched.setattr(StageKey, "compute_key", bumped)
            after = recorded_keys(SEQUENCE, BASE)
        should = with_all_that_follow([raised])
        # A plan that says the same is the same, whatever made it.
        assert changed(before, after) == (should & set(before)) - (
            {"report"} if raised in ("assess", "plan") else set()
        )


def test_floats_count_by_their_bits() -> None:
    value = BASE.explore.step_share
    near = BASE.with_overrides({"explore.step_share": float(np.nextafter(value, 1))})
    assert changed(recorded_keys(SEQUENCE, BASE), recorded_keys(SEQUENCE, near)) == expected(
        EXPLORE, recorded_keys(SEQUENCE, BASE)
    )
