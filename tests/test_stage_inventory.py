"""Whoever changes what a stage computes raises its version, or says that results are the same."""

from __future__ import annotations

from pathlib import Path

import pytest

from tasks import (
    assess,
    benchmark,
    coarse,
    continuation,
    depth,
    enhance,
    evaluate,
    explore,
    finetune,
    freespace,
    imported,
    ingest,
    poses,
    report,
    surface,
    uc_nerf,
)
from tasks.stage import stage_versions
from tests import stage_inventory
from tests.stage_inventory import NATIVE, changed_modules, inventory, reached, recorded, stages

TASKS = (
    assess, benchmark, coarse, continuation, depth, enhance, evaluate, explore, finetune, freespace,
    imported, ingest, poses, report, surface, uc_nerf,
)  # fmt: skip


def test_versions_follow_the_code() -> None:
    now, then = inventory()["stages"], recorded()["stages"]
    changed = sorted(name for name in {*now, *then} if now.get(name) != then.get(name))
    versions = [{name: row["version"] for name, row in rows.items()} for rows in (now, then)]
    not_raised = [name for name in changed if versions[0].get(name) == versions[1].get(name)]
    assert changed == [], (
        f"the code behind {', '.join(changed)} has changed (in {', '.join(changed_modules())}). Where the "
        "same inputs now give another artefact, raise the stage's version in tasks/ (not raised: "
        f"{', '.join(not_raised) or 'none'}); then, or where results are the same, run `make same-results`"
    )


def test_the_inventory_reads_versions_as_the_decorator_does() -> None:
    assert len(TASKS) == 16
    real = {name: version for name, version in stage_versions().items() if not name.startswith("toy")}
    found = {name: version for name, (_, version) in stages().items()}
    assert {name: real[name] for name in found} == found


class TestReached:
    def test_what_training_rests_on(self) -> None:
        found = reached(stages()["coarse"][0])
        assert (NATIVE, "") in found
        assert ("extrags.training.reconstruction", "reconstruct") in found
        assert ("extrags.scene", "Scene") in found
        assert not any(module.startswith("extrags.restoration") for module, _ in found)

    def test_restorers_are_reached_by_their_entries(self) -> None:
        found = reached(stages()["enhance-train"][0])
        assert ("extrags.restoration.diffusion.scene_training", "train_on_scene") in found
        assert ("extrags.restoration.pretrained.wan_vace", "WanVace") in found

    def test_a_leaf_rests_on_little(self) -> None:
        # A sequence, its cameras and their lens, and zarr with stacks that are mapped.
        assert len(reached(stages()["training-frames"][0])) < 90

    @pytest.mark.parametrize("edit", ["# said otherwise", '"""Said otherwise."""'])
    def test_words_do_not_count_and_code_does(
        self, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, edit: str
    ) -> None:
        package = tmp_path / "extrags"
        package.mkdir()
        monkeypatch.setattr(stage_inventory, "REPOSITORY", tmp_path)

        def digest(code: str) -> dict[tuple[str, str], str]:
            (package / "one.py").write_text(
                "from extrags.two import LIMIT\ndef f(x):\n    return x < LIMIT\n"
            )
            (package / "two.py").write_text(code)
            stage_inventory.forget()
            return reached(("extrags.one", "f"))

        try:
            plain = digest("LIMIT = 3\nOTHER = 4\n")
            assert set(plain) == {("extrags.one", "f"), ("extrags.two", "LIMIT")}
            assert digest(f"{edit}\nLIMIT = 3\nOTHER = 5\n") == plain
            assert digest("LIMIT = 2\nOTHER = 4\n") != plain
        finally:
            stage_inventory.forget()
