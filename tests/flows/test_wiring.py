"""The real stages wired together, without any server: what is cached, what is skipped, what fails."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest
from torch import Tensor

from extrags.errors import ConfigError, WeightsError
from extrags.metrics.image import means_in_regions
from extrags.metrics.registry import Metric, register_metric, unregister_metric
from extrags.stages import STAGES
from extrags.store import Store
from flows.methods import METHODS
from flows.outcome import SequenceOutcome
from flows.runners import DirectRunner, NotInStoreError, StoreRunner
from flows.wiring import run_sequence
from tasks.evaluate import measure
from tasks.weights import Weights
from tests.flows.tiny import GIVEN, SEQUENCE, tiny_config

SKIPPED = dict.fromkeys(GIVEN, "skipped")


def states(outcome: SequenceOutcome) -> dict[str, str]:
    return {row.stage: row.state for row in outcome.stages}


def test_every_stage_runs(finished: tuple[str, SequenceOutcome]) -> None:
    store, outcome = finished
    assert outcome.status == "ok"
    assert list(states(outcome)) == list(STAGES)
    assert states(outcome) == {**dict.fromkeys(STAGES, "ran"), **SKIPPED}
    assert {row.stage: row.reason for row in outcome.stages if row.state == "skipped"} == GIVEN
    for which in ("coarse", "final"):
        assert {"psnr", "ssim", "lpips_alex", "flip", "depth_absrel", "n_gaussians"} <= set(
            outcome.metrics[which]
        )
        assert {"aligned", "observed", "unobserved"} <= set(outcome.metrics[which])
    assert outcome.report is not None
    assert "</html>" in Path(outcome.report).read_text()
    assert list((Path(store) / "scratch").iterdir()) == []


def test_outcome_is_json(finished: tuple[str, SequenceOutcome]) -> None:
    tree = json.loads(json.dumps(finished[1].to_json(), allow_nan=False))
    assert {"name", "status", "stages", "metrics"} <= set(tree)
    assert {"stage", "state", "seconds", "reason"} <= set(tree["stages"][0])


def test_lineage_leads_back_to_the_source(finished: tuple[str, SequenceOutcome]) -> None:
    store, outcome = finished
    manifests = {manifest.key: manifest for manifest in Store(store).ls()}
    seen = set()
    waiting = [Path(outcome.artefacts["finetune"]).name]
    while waiting:
        manifest = manifests[waiting.pop()]
        seen.add(manifest.stage)
        waiting += manifest.input_keys.values()
    assert {"ingest", "coarse", "surface", "freespace", "explore", "enhance-train", "enhance"} <= seen


def test_second_run_is_all_cached_and_the_same(finished: tuple[str, SequenceOutcome]) -> None:
    store, first = finished
    second = run_sequence(SEQUENCE, tiny_config(), store, StoreRunner(store), profile="quick")
    assert states(second) == {**dict.fromkeys(STAGES, "cached"), **SKIPPED}
    assert second.digests == first.digests
    assert second.metrics == first.metrics
    # The figures of all views as well, which no task looks up where there are metrics.
    (now, then) = (outcome.row("evaluate") for outcome in (second, first))
    assert now is not None
    assert then is not None
    assert any(key.startswith("evaluate-views-v") for key in then.made)
    assert (now.made, now.tasks) == (then.made, then.tasks)
    assert now.made_seconds == pytest.approx(then.made_seconds)


def test_what_counts_as_seen_is_measured_again(finished: tuple[str, SequenceOutcome]) -> None:
    store, _ = finished
    changed = tiny_config(explore__directions=16)
    outcome = run_sequence(SEQUENCE, changed, store, DirectRunner(store), until="assess")
    assert states(outcome)["coarse"] == "cached"
    assert states(outcome)["assess"] == "ran"


def test_exploration_settings_leave_everything_before_cached(finished: tuple[str, SequenceOutcome]) -> None:
    store, _ = finished
    changed = tiny_config(explore__step_share=0.15, explore__trajectories=3)
    outcome = run_sequence(SEQUENCE, changed, store, DirectRunner(store), until="explore")
    before = STAGES[: STAGES.index("explore")]
    assert {stage: states(outcome)[stage] for stage in before} == {
        **dict.fromkeys(before, "cached"),
        **SKIPPED,
    }
    assert states(outcome)["explore"] == "ran"


def test_another_seed_or_source_setting_runs_again(finished: tuple[str, SequenceOutcome]) -> None:
    store, _ = finished
    with pytest.raises(NotInStoreError, match="coarse-v"):
        run_sequence(SEQUENCE, tiny_config().with_seed(5), store, StoreRunner(store))
    with pytest.raises(NotInStoreError, match="ingest-v"):
        run_sequence("phantom/0@distanced", tiny_config(), store, StoreRunner(store))


def test_a_scene_that_lacks_nothing_skips_with_reasons(finished: tuple[str, SequenceOutcome]) -> None:
    store, first = finished
    config = tiny_config(assess__force=False, assess__min_hole_share=1.0)
    outcome = run_sequence(SEQUENCE, config, store, DirectRunner(store))
    assert outcome.status == "ok"
    skipped = ("surface", "freespace", "explore", "enhance")
    for stage in skipped:
        row = outcome.row(stage)
        assert row is not None
        assert row.state == "skipped"
        assert "%" in row.reason
    # Then the scene is fine-tuned on its real views, and nothing judged.
    row = outcome.row("finetune")
    assert row is not None
    assert row.state == "ran"
    assert row.reason.startswith("on real views alone, which need no judge")
    judged = Store(store).load_json("judgement.json", outcome.refs["judgement"])
    assert (judged["amount"], judged["trials"]) == (1.0, [])
    assert outcome.metrics["coarse"] == first.metrics["coarse"]
    assert outcome.metrics["final"] != first.metrics["final"]
    assert outcome.digests["finetune"] != first.digests["finetune"]
    assert "restored" not in outcome.metrics
    assert outcome.report is not None


def test_a_kept_scene_that_lacks_nothing_is_the_final_one(finished: tuple[str, SequenceOutcome]) -> None:
    store, first = finished
    config = tiny_config(assess__force=False, assess__min_hole_share=1.0, finetune__keep_scene=True)
    outcome = run_sequence(SEQUENCE, config, store, DirectRunner(store), until="evaluate")
    assert states(outcome)["finetune"] == "skipped"
    assert outcome.metrics["final"] == outcome.metrics["coarse"] == first.metrics["coarse"]


def test_control_on_real_views_alone(finished: tuple[str, SequenceOutcome]) -> None:
    store, first = finished
    left_out = dict.fromkeys(("surface", "freespace", "explore", "enhance"), "control")
    runner = DirectRunner(store)
    # So short a fine-tuning may lose: it is not to be judged here.
    config = tiny_config(finetune__iterations=21, finetune__judge__enabled=False)
    before = {item.key for item in Store(store).ls("evaluate-views")}
    outcome = run_sequence(SEQUENCE, config, store, runner, until="evaluate", leave_out=left_out)
    # The coarse scene's views have been measured: only the new scene's are.
    (added,) = (item for item in Store(store).ls("evaluate-views") if item.key not in before)
    assert added.counts["stacks"] == 1
    assert states(outcome)["explore"] == "skipped"
    assert states(outcome)["finetune"] == "ran"
    assert outcome.digests["finetune"] != first.digests["finetune"]


def test_a_bad_source_is_told_and_nothing_is_kept(tmp_path: Path) -> None:
    (tmp_path / "empty").mkdir()
    store = str(tmp_path / "store")
    outcome = run_sequence(str(tmp_path / "empty"), tiny_config(), store, DirectRunner(store))
    assert outcome.status == "failed"
    row = outcome.row("ingest")
    assert row is not None
    assert row.state == "failed"
    assert "empty" in row.reason
    assert [item.reason for item in outcome.stages[1:]] == ["ingest failed"] * (len(STAGES) - 1)
    assert Store(store).ls() == []


def test_named_weights_that_are_missing_fail_the_run(finished: tuple[str, SequenceOutcome]) -> None:
    store, _ = finished
    config = tiny_config(evaluate__lpips_weights="no/such/file.npz")
    outcome = run_sequence(SEQUENCE, config, store, DirectRunner(store))
    assert outcome.status == "failed"
    assert isinstance(outcome.error, WeightsError)
    assert "no/such/file.npz" in str(outcome.error)


def test_absent_weights_are_a_reason_not_a_failure(
    finished: tuple[str, SequenceOutcome], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    from extrags.metrics import lpips_weights as search
    from tasks.weights import lpips_weights

    def nowhere(explicit: str | None, net: str) -> tuple[Path, ...]:
        raise WeightsError("no LPIPS weights here; put them there")

    monkeypatch.setattr(search, "find_weights", nowhere)
    store, _ = finished
    # Measured anew, also where there are no weights for `finished` either; of the coarse scene alone, since
    # fine-tuning depends on the weights.
    config = tiny_config(**{"evaluate.lpips_nets": ("alex", "vgg")})
    outcome = run_sequence(
        SEQUENCE,
        config,
        store,
        DirectRunner(store),
        until="evaluate",
        leave_out=METHODS["coarse"].leave_out,
    )
    assert outcome.status == "ok"
    assert outcome.metrics["coarse"]["lpips_alex"] is None
    assert lpips_weights(config.evaluate)[0].reason == "no LPIPS weights here; put them there"
    (measured,) = [
        json.loads((Store(store).open(ref) / "metrics.json").read_bytes())
        for ref in [Store(store).find(Path(outcome.artefacts["metrics_coarse"]).name)]
        if ref is not None
    ]
    assert "put them there" in measured["reasons"]["lpips_alex"]


def test_a_metric_of_ones_own_is_measured_anew(finished: tuple[str, SequenceOutcome]) -> None:
    store, before = finished
    error = Metric("toy_error", "Toy error", higher_is_better=False, measure=means_in_regions(_error))

    def evaluated() -> SequenceOutcome:
        return run_sequence(SEQUENCE, tiny_config(), store, DirectRunner(store), until="evaluate")

    register_metric(error)
    try:
        with_it = evaluated()
        assert states(with_it)["evaluate"] == "ran"
        assert 0 < with_it.metrics["final"]["observed"]["toy_error"] < 1
    finally:
        unregister_metric("toy_error")
    without = evaluated()
    assert states(without)["evaluate"] == "cached"
    assert without.metrics == before.metrics


def test_a_process_that_lacks_a_metric_says_so(finished: tuple[str, SequenceOutcome]) -> None:
    store, outcome = finished
    found = {
        name: Store(store).find(Path(outcome.artefacts[name]).name) for name in ("renders_final", "sequence")
    }
    with pytest.raises(ConfigError, match="other_error@1; registered in this process: none"):
        measure.fn(
            store=store,
            renders=found["renders_final"],
            sequence=found["sequence"],
            lpips_digests={"alex": None},
            weights=[Weights(net="alex")],
            added=["other_error@1"],
        )


def _error(render: Tensor, target: Tensor) -> Tensor:
    return (render - target).abs().mean(-1)


def start(store: Path) -> subprocess.Popen[str]:
    return subprocess.Popen(
        [sys.executable, "-m", "tests.flows.tiny", str(store)],
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        env={**os.environ, "PYTHONPATH": str(Path(__file__).parents[2])},
    )


def kill_in(stage: str, store: Path) -> None:
    """Start the pipeline and SIGKILL it as soon as a stage has begun to write."""
    process = start(store)
    begun = time.monotonic()
    while not list(store.glob(f"scratch/{stage}-v*")):
        assert process.poll() is None, process.communicate()[1]
        assert time.monotonic() - begun < 120
        time.sleep(0.002)
    process.send_signal(signal.SIGKILL)
    process.communicate()
    assert process.returncode == -signal.SIGKILL


@pytest.mark.slow
def test_killed_in_three_stages_it_ends_bit_identical(
    finished: tuple[str, SequenceOutcome], tmp_path: Path
) -> None:
    _, undisturbed = finished
    store = tmp_path / "store"
    for stage in ("coarse", "explore-branch", "finetune"):
        kill_in(stage, store)
        # Whatever can be seen is whole.
        for manifest in Store(store).ls():
            ref = Store(store).find(manifest.key)
            assert ref is not None
            assert Store(store).verify(ref)
    last = start(store)
    said, complaints = last.communicate(timeout=120)
    assert last.returncode == 0, complaints
    assert "ingest=cached" in said
    assert "explore=" in said
    resumed = run_sequence(SEQUENCE, tiny_config(), str(store), StoreRunner(str(store)), profile="quick")
    assert resumed.digests == undisturbed.digests
    Store(store).sweep()
    assert list((store / "scratch").iterdir()) == []
