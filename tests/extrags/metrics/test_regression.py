"""A regression told from noise."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from extrags.errors import ConfigError
from extrags.metrics.registry import figures
from extrags.metrics.regression import compare_results

MACHINE = {"processor": "one", "cores": 2, "threads": 1, "isa": "avx2"}


def result(
    *,
    slower: float = 1.0,
    worse_db: float = 0.0,
    noise: float = 0.05,
    seeds: range = range(5),
    entropy: int = 0,
    groups: int = 1,
    machine: dict[str, Any] | None = None,
) -> dict[str, Any]:
    rng = np.random.default_rng(entropy)
    cases = [
        {
            "method": "coarse",
            "profile": "quick",
            "sequence": f"phantom/{group}",
            "setting": "sparse",
            "seed": seed,
            "seconds": 100 * slower * float(np.exp(noise * rng.normal())),
            # Seeds differ by much more than what is looked for: only pairs show it.
            "metrics": {"psnr": 20 + 2 * seed - worse_db + 0.02 * float(rng.normal())},
            "error": "",
        }
        for group in range(groups)
        for seed in seeds
    ]
    return {"machine": {**MACHINE, **(machine or {})}, "cases": cases}


def verdicts(found: dict[str, Any]) -> dict[str, str]:
    return {row["quantity"]: row["verdict"] for row in found["rows"]}


class TestVerdicts:
    def test_the_same_is_equal(self) -> None:
        found = compare_results(result(), result())
        assert verdicts(found) == {"seconds": "equal", "psnr": "equal"}
        assert found["regressions"] == []

    def test_noise_is_no_regression(self) -> None:
        found = compare_results(result(), result(entropy=1))
        assert "worse" not in verdicts(found).values()

    def test_pairs_show_what_the_spread_of_seeds_would_hide(self) -> None:
        found = compare_results(result(), result(entropy=1, worse_db=0.3))
        assert verdicts(found)["psnr"] == "worse"
        (line,) = found["regressions"]
        assert "psnr" in line
        assert "5 pairs" in line
        (row,) = [row for row in found["rows"] if row["quantity"] == "psnr"]
        assert row["worsening"] == pytest.approx(0.3, abs=0.05)
        assert row["interval"][0] < 0.3 < row["interval"][1]

    def test_slower_and_faster(self) -> None:
        assert verdicts(compare_results(result(), result(entropy=1, slower=1.5)))["seconds"] == "worse"
        assert verdicts(compare_results(result(), result(entropy=1, slower=0.6)))["seconds"] == "better"

    def test_what_does_not_matter_is_no_regression_however_certain(self) -> None:
        found = compare_results(result(noise=0.0), result(noise=0.0, slower=1.02))
        assert verdicts(found)["seconds"] == "noise"

    def test_a_single_pair_is_not_judged(self) -> None:
        found = compare_results(result(seeds=range(1)), result(seeds=range(1), slower=3, worse_db=4))
        assert set(verdicts(found).values()) == {"not judged"}
        assert found["regressions"] == []

    def test_other_seeds_are_compared_as_samples(self) -> None:
        found = compare_results(result(), result(seeds=range(5, 10), entropy=1, slower=2))
        (row,) = [row for row in found["rows"] if row["quantity"] == "seconds"]
        assert (row["paired"], row["verdict"]) == (False, "worse")

    def test_one_seed_in_common_makes_no_pairs_of_several(self) -> None:
        for sides in ((range(3), range(1)), (range(1), range(3))):
            before, after = (result(seeds=seeds) for seeds in sides)
            (row,) = [row for row in compare_results(before, after)["rows"] if row["quantity"] == "psnr"]
            assert (row["paired"], row["n"], row["verdict"]) == (False, 1, "not judged")
            for side, mean in ((before, row["before"]), (after, row["after"])):
                figures_of_all = [case["metrics"]["psnr"] for case in side["cases"]]
                assert mean == pytest.approx(np.mean(figures_of_all))

    def test_costs_change_by_factors(self) -> None:
        """Twice as long on one seed and half as long on another are no change, however long each takes."""
        before, after = result(seeds=range(4)), result(seeds=range(4))
        for case, was, factor in zip(before["cases"], (10, 1000, 30, 70), (2, 0.5, 3, 1 / 3), strict=True):
            case["seconds"] = was
            after["cases"][case["seed"]]["seconds"] = was * factor
        (row,) = [row for row in compare_results(before, after)["rows"] if row["quantity"] == "seconds"]
        assert row["worsening"] == pytest.approx(0, abs=1e-12)
        low, high = row["interval"]
        assert (1 + low) * (1 + high) == pytest.approx(1)

    def test_a_cost_of_nothing_has_no_factor(self) -> None:
        before, after = result(noise=0.0), result(noise=0.0)
        before["cases"][0]["seconds"] = 0.0
        for one, other, change in ((before, after, 0.25), (after, before, -0.2)):
            (row,) = [row for row in compare_results(one, other)["rows"] if row["quantity"] == "seconds"]
            assert row["worsening"] == pytest.approx(change)
            assert np.isfinite(row["interval"]).all()

    def test_times_of_other_machines_are_not_judged(self) -> None:
        found = compare_results(result(), result(slower=9, machine={"processor": "another"}))
        assert not found["times_judged"]
        assert set(verdicts(found)) == {"psnr"}

    def test_times_of_a_processor_and_of_a_gpu_are_not_judged_unless_nobody_said(self) -> None:
        on_gpu = {**MACHINE, "device": "NVIDIA H200"}
        before = result(machine={**MACHINE, "device": "cpu"})
        assert not compare_results(before, result(slower=9, machine=on_gpu))["times_judged"]
        assert compare_results(result(), result(slower=9, machine=on_gpu))["times_judged"]

    def test_figures_of_two_versions_of_the_protocol_are_not_judged(self) -> None:
        before = result() | {"protocol": 6}
        after = result(worse_db=4, slower=2) | {"protocol": 7}
        # A figure that is gone went with its version.
        for case in before["cases"]:
            case["metrics"]["ssim"] = 0.9
        found = compare_results(before, after)
        assert found["protocols"] == [6, 7]
        assert verdicts(found) == {"seconds": "worse"}
        assert not found["missing"]
        # Results that do not say their version are from before it was said.
        found = compare_results(result(), after)
        assert found["protocols"] == [None, 7]
        assert verdicts(found)["psnr"] == "worse"


@pytest.mark.parametrize("seeds", [*(pytest.param(few, marks=pytest.mark.slow) for few in (2, 3)), 5])
def test_few_false_alarms_among_many_quantities(seeds: int) -> None:
    """The chance is at most 5 % for a whole comparison of ten quantities, of which some seem to matter."""

    def drawn(entropy: int) -> dict[str, Any]:
        return result(entropy=entropy, groups=5, noise=0.1, seeds=range(seeds))

    alarms = sum(
        bool(compare_results(drawn(2 * number), drawn(2 * number + 1))["regressions"])
        for number in range(100)
    )
    # Of 200 there were 3, 3 and 6; corrected over what has changed by enough alone 14, 13 and 21.
    assert alarms <= 6


def whole_result(
    *,
    seeds: int,
    entropy: int,
    worse_db: float = 0.0,
    slower: float = 1.0,
    sequences: int = 3,
    deviations: tuple[float, ...] = (0.1,),
    pace: float = 1.0,
) -> dict[str, Any]:
    """Two methods on some sequences with all costs and figures, of which the second method is worse.

    Args:
        seeds: of each.
        entropy: of the noise.
        worse_db: PSNR of all pixels that the second method has lost everywhere.
        slower: how many times as long the second method takes.
        sequences: their number.
        deviations: of PSNR between seeds, sequence by sequence, in dB; of other figures a hundredth.
        pace: how many times as long everything takes on this machine today.
    """
    rng = np.random.default_rng(entropy)

    def metrics(deviation_db: float, loss_db: float) -> dict[str, Any]:
        tree: dict[str, Any] = {}
        for figure in figures():
            node = tree
            *group, key = figure.name.split(".")
            for part in group:
                node = node.setdefault(part, {})
            base, noise = (27.0, deviation_db) if figure.unit == "dB" else (0.5, deviation_db / 100)
            node[key] = base + noise * float(rng.normal()) - loss_db * (figure.name == "psnr")
        return tree

    cases = [
        {
            "method": method,
            "profile": "quick",
            "sequence": f"phantom/{number}",
            "setting": "sparse",
            "seed": seed,
            "seconds": 60 * factor * pace * float(np.exp(0.02 * rng.normal())),
            "processor_seconds": 60 * factor * pace * float(np.exp(0.01 * rng.normal())),
            "peak_mib": 800 * float(np.exp(0.005 * rng.normal())),
            "image_size": [160, 128],
            "metrics": metrics(deviations[number % len(deviations)], loss_db),
            "error": "",
        }
        for method, loss_db, factor in (("coarse", 0.0, 1.0), ("extrags", worse_db, slower))
        for number in range(sequences)
        for seed in range(seeds)
    ]
    return {"machine": MACHINE, "cases": cases}


class TestPowerAtRealSize:
    @pytest.mark.parametrize(("seeds", "worse_db"), [(3, 1.0), (2, 5.0)])
    def test_a_gross_loss_is_found_on_every_sequence(self, seeds: int, worse_db: float) -> None:
        found = []
        alarms = 0
        for number in range(10):
            before = whole_result(seeds=seeds, entropy=2 * number)
            after = whole_result(seeds=seeds, entropy=2 * number + 1, worse_db=worse_db)
            rows = compare_results(before, after)["rows"]
            assert len(rows) > 200
            worse = [row for row in rows if row["verdict"] == "worse"]
            lost = [row for row in worse if (row["method"], row["quantity"]) == ("extrags", "psnr")]
            assert None in {row["sequence"] for row in lost}
            found.append(sum(row["sequence"] is not None for row in lost))
            alarms += len(lost) < len(worse)
        assert sum(found) >= 28
        assert alarms <= 1

    def test_times_three_times_as_long_are_found(self) -> None:
        found = compare_results(
            whole_result(seeds=2, entropy=0), whole_result(seeds=2, entropy=1, slower=3.0)
        )
        worse = [row["quantity"] for row in found["rows"] if row["verdict"] == "worse"]
        assert sorted(worse) == ["processor_seconds"] * 4 + ["seconds"] * 4

    def test_a_small_loss_everywhere_is_found_over_all_sequences(self) -> None:
        lines = [
            line
            for number in range(5)
            for line in compare_results(
                whole_result(seeds=3, entropy=2 * number),
                whole_result(seeds=3, entropy=2 * number + 1, worse_db=0.4),
            )["regressions"]
        ]
        assert sum(line.startswith("extrags (quick) on all sequences: psnr") for line in lines) >= 4
        assert all("psnr" in line for line in lines)

    def test_several_sequences_need_no_second_seed(self) -> None:
        found = compare_results(
            whole_result(seeds=1, entropy=0), whole_result(seeds=1, entropy=1, worse_db=5.0)
        )
        (line,) = found["regressions"]
        assert line.startswith("extrags (quick) on all sequences: psnr")

    def test_a_loss_on_one_of_the_sequences(self) -> None:
        before, after = (whole_result(seeds=2, entropy=entropy) for entropy in (0, 1))
        for case in after["cases"]:
            if (case["method"], case["sequence"]) == ("coarse", "phantom/1"):
                case["metrics"]["psnr"] -= 5
        (line,) = compare_results(before, after)["regressions"]
        assert line.startswith("coarse (quick) on phantom/1@sparse, 160x128: psnr")

    @pytest.mark.parametrize("seeds", [2, pytest.param(3, marks=pytest.mark.slow)])
    @pytest.mark.parametrize("deviations", [(0.1,), (0.3, 0.1, 0.1)])
    def test_few_false_alarms(self, seeds: int, deviations: tuple[float, ...]) -> None:
        """Also where one sequence is three times as noisy as the others, which pooling does not know."""
        alarms = sum(
            bool(
                compare_results(
                    whole_result(seeds=seeds, entropy=2 * number, deviations=deviations),
                    whole_result(seeds=seeds, entropy=2 * number + 1, deviations=deviations),
                )["regressions"]
            )
            for number in range(12)
        )
        # Of 300 with 2 and 3 seeds: 0 and 2, 4 and 2 with a noisy sequence.
        assert alarms <= 2

    def test_the_pace_of_the_machine_is_no_regression(self) -> None:
        """Repeats of a sitting share it; 10 % between two sittings were measured."""
        paces = np.exp(0.07 * np.random.default_rng(0).normal(size=(10, 2)))
        alarms = sum(
            bool(
                compare_results(
                    whole_result(seeds=5, entropy=2 * number, pace=float(before)),
                    whole_result(seeds=5, entropy=2 * number + 1, pace=float(after)),
                )["regressions"]
            )
            for number, (before, after) in enumerate(paces)
        )
        assert alarms <= 2

    def test_what_could_not_be_judged_is_told(self) -> None:
        found = compare_results(
            whole_result(seeds=1, entropy=0, sequences=1),
            whole_result(seeds=1, entropy=1, sequences=1, worse_db=5.0),
        )
        assert {row["verdict"] for row in found["rows"]} == {"not judged"}
        assert found["regressions"] == []
        told = [line.split(" on ")[0] for line in found["not_judged"] if ": psnr 2" in line]
        assert "extrags (quick)" in told
        # A pair of seeds of one sequence alone is too little to tell a loss of decibels from noise.
        before, after = (result(seeds=range(2)) for _ in range(2))
        for case, loss_db in zip(after["cases"], (0.3, 1.8), strict=True):
            case["metrics"]["psnr"] -= loss_db
        alone = compare_results(before, after)
        assert verdicts(alone)["psnr"] == "not judged"
        (line,) = alone["not_judged"]
        assert "worse by 1.05 dB" in line

    def test_figures_of_parts_are_a_family_of_their_own(self) -> None:
        rows = compare_results(whole_result(seeds=2, entropy=0), whole_result(seeds=2, entropy=1))["rows"]
        primary = {row["quantity"] for row in rows if row["primary"]}
        assert {"seconds", "peak_mib", "psnr", "ssim", "lpips_alex", "depth_absrel"} <= primary
        assert not {"observed.psnr", "aligned.psnr", "whole.psnr", "flip", "depth_rmse"} & primary

    def test_of_a_full_mask_nothing_is_told_twice(self) -> None:
        sides = [whole_result(seeds=2, entropy=entropy) for entropy in (0, 1)]
        for side in sides:
            for case in side["cases"]:
                case["metrics"]["whole"]["psnr"] = case["metrics"]["psnr"]
        quantities = {row["quantity"] for row in compare_results(*sides)["rows"]}
        assert "whole.psnr" not in quantities
        assert "whole.ssim" in quantities


class TestWhatIsNotAlike:
    def asked(self, side: dict[str, Any], **known: Any) -> dict[str, Any]:
        return {**side, "cases": [{**case, **known} for case in side["cases"]]}

    def test_another_digest_is_told(self) -> None:
        sides = [
            self.asked(result(), asked=digest, settings={"coarse.iterations": iterations})
            for digest, iterations in (("a", 500), ("b", 1500))
        ]
        assert compare_results(*sides)["other_settings"] == [
            "coarse (quick) on phantom/0@sparse was asked for with other settings: "
            "coarse.iterations = 500, now coarse.iterations = 1500"
        ]
        assert compare_results(sides[0], sides[0])["other_settings"] == []

    def test_earlier_results_have_the_words_of_variants(self) -> None:
        def worded(words: str) -> dict[str, Any]:
            return {**result(), "methods": {"coarse": words}}

        one, other = (worded(f"coarse with coarse.iterations = {number}") for number in (500, 1500))
        (line,) = compare_results(one, other)["other_settings"]
        assert "coarse.iterations = 500, now coarse with coarse.iterations = 1500" in line
        # A method's description may be worded anew.
        assert compare_results(worded("as it was"), worded("better said"))["other_settings"] == []
        assert compare_results(result(), other)["other_settings"] == []

    def test_memory_of_shared_stages_is_not_that_of_separate_ones(self) -> None:
        before, after = (self.asked(result(), peak_mib=peak) for peak in (500.0, 900.0))
        shared, separate = {"sharing": "once"}, {"sharing": "none: a store for each cell"}
        found = compare_results(before | shared, after | separate)
        assert (found["times_judged"], found["memory_judged"]) == (True, False)
        assert "peak_mib" not in verdicts(found)
        assert "seconds" in verdicts(found)
        assert verdicts(compare_results(before | shared, after | shared))["peak_mib"] == "worse"
        assert verdicts(compare_results(before, after | shared))["peak_mib"] == "worse"
        # However the words for it have changed.
        reworded = {"sharing": "stages that runs have in common are made once", "separate": False}
        assert verdicts(compare_results(before | shared, after | reworded))["peak_mib"] == "worse"
        assert not compare_results(before | separate, after | reworded)["memory_judged"]

    def test_settings_given_to_one_grid_alone_are_told(self) -> None:
        def with_settings(settings: dict[str, Any]) -> dict[str, Any]:
            found = result()
            for case in found["cases"]:
                case["settings"] = settings
            return found

        plain, changed = with_settings({}), with_settings({"enhance.samples": 4})
        (line,) = compare_results(plain, changed)["other_settings"]
        assert line.endswith("nothing, now enhance.samples = 4")
        assert compare_results(plain, with_settings({}))["other_settings"] == []
        assert compare_results(result(), changed)["other_settings"] == []


def test_runs_that_fail_now_are_a_regression() -> None:
    after = result()
    after["cases"][0]["error"] = "coarse: it diverged"
    found = compare_results(result(), after)
    assert found["regressions"] == ["coarse (quick) on phantom/0@sparse fails: coarse: it diverged"]


def test_repeats_of_a_seed_are_no_evidence_about_figures() -> None:
    def repeated(slower: float, worse_db: float) -> dict[str, Any]:
        once = result(slower=slower, worse_db=worse_db, noise=0.01, seeds=range(1))["cases"][0]
        return {
            "machine": MACHINE,
            "cases": [
                {**once, "repeat": repeat, "seconds": once["seconds"] * (1 + repeat / 1000)}
                for repeat in range(5)
            ],
        }

    rows = {row["quantity"]: row for row in compare_results(repeated(1.0, 0.0), repeated(2.0, 0.5))["rows"]}
    assert (rows["psnr"]["n"], rows["psnr"]["verdict"]) == (1, "not judged")
    assert (rows["seconds"]["n"], rows["seconds"]["verdict"]) == (5, "worse")


def test_one_seed_that_failed_before_excuses_no_other() -> None:
    before, after = result(), result()
    before["cases"][4]["error"] = after["cases"][4]["error"] = "coarse: it diverged"
    assert compare_results(before, after)["failed"] == []
    for case in after["cases"]:
        case["error"] = "coarse: no memory"
    assert compare_results(before, after)["regressions"] == [
        "coarse (quick) on phantom/0@sparse fails: coarse: no memory"
    ]


def test_other_seeds_fail_as_often_as_those_before() -> None:
    before, after = result(), result(seeds=range(5, 10))
    after["cases"][0]["error"] = "coarse: it diverged"
    assert len(compare_results(before, after)["failed"]) == 1
    before["cases"][0]["error"] = "coarse: it diverged"
    assert compare_results(before, after)["failed"] == []


def test_a_figure_that_is_gone_is_named() -> None:
    before, after = result(), result()
    for case in after["cases"]:
        case["metrics"] = {"psnr": None}
    found = compare_results(before, after)
    assert found["missing"] == ["coarse (quick) on phantom/0@sparse has no psnr"]
    assert found["regressions"] == found["missing"]
    before["cases"][0]["metrics"] = {"psnr": None}
    assert compare_results(before, after)["missing"] == []


def test_groups_that_were_not_run_are_named() -> None:
    found = compare_results(result(groups=2), result())
    assert found["missing"] == ["coarse (quick) on phantom/1@sparse was not run"]
    assert found["regressions"] == found["missing"]


class TestRunsThatAreGone:
    def test_seeds_are_named(self) -> None:
        found = compare_results(result(seeds=range(3)), result(seeds=range(1), worse_db=5))
        assert found["missing"] == ["coarse (quick) on phantom/0@sparse was not run with seed 1; seed 2"]
        assert found["regressions"] == found["missing"]

    def test_repeats_are_named(self) -> None:
        once = result(seeds=range(1))
        twice = {**once, "cases": [{**once["cases"][0], "repeat": repeat} for repeat in (0, 1)]}
        assert compare_results(twice, once)["missing"] == [
            "coarse (quick) on phantom/0@sparse was not run with seed 0, repeat 1"
        ]
        assert compare_results(once, twice)["missing"] == []

    def test_other_seeds_are_not_fewer(self) -> None:
        assert compare_results(result(), result(seeds=range(5, 10)))["missing"] == []


class TestRunsThatFailedWhileReading:
    """Of these no size is known."""

    def sized(self, *, groups: int = 1, failing: int | None = None) -> dict[str, Any]:
        found = result(groups=groups)
        for case in found["cases"]:
            failed = case["sequence"] == f"phantom/{failing}"
            case.update(width=None if failed else 160, height=None if failed else 128)
            case["error"] = "ingest: a file is broken" if failed else ""
        return found

    def test_they_are_the_runs_of_that_size(self) -> None:
        found = compare_results(self.sized(groups=2), self.sized(groups=2, failing=0))
        assert found["regressions"] == [
            "coarse (quick) on phantom/0@sparse, 160x128 fails: ingest: a file is broken"
        ]

    def test_though_nothing_else_was_run(self) -> None:
        assert len(compare_results(self.sized(), self.sized(failing=0))["failed"]) == 1

    def test_what_works_now_is_not_gone(self) -> None:
        found = compare_results(self.sized(groups=2, failing=0), self.sized(groups=2))
        assert found["regressions"] == []

    def test_one_seed_of_several(self) -> None:
        after = self.sized()
        after["cases"][1].update(width=None, height=None, error="ingest: a file is broken")
        found = compare_results(self.sized(), after)
        assert found["missing"] == []
        assert len(found["failed"]) == 1


class TestSizesOfABenchmark:
    def sized(self, size: list[int] | None, worse_db: float = 0.0) -> dict[str, Any]:
        found = result(worse_db=worse_db)
        for case in found["cases"]:
            case["image_size"] = size
        return found

    def test_images_of_another_size_are_no_regression(self) -> None:
        with pytest.raises(ConfigError, match="no method, budget, sequence and size of images in common"):
            compare_results(self.sized([48, 40]), self.sized([675, 540], worse_db=1.5))

    def test_of_one_size_they_are_compared(self) -> None:
        found = compare_results(self.sized([48, 40]), self.sized([48, 40], worse_db=1.5))
        assert verdicts(found)["psnr"] == "worse"

    def test_earlier_results_did_not_tell(self) -> None:
        found = compare_results(result(), self.sized([48, 40], worse_db=1.5))
        assert verdicts(found)["psnr"] == "worse"
        assert found["missing"] == []


@pytest.mark.parametrize(("now", "verdict"), [(1e-5, "noise"), (0.3, "better"), (0.0, "equal")])
def test_a_figure_that_was_zero_has_no_shares(now: float, verdict: str) -> None:
    sides = [result(), result()]
    for side, value in zip(sides, (0.0, now), strict=True):
        for case in side["cases"]:
            case["metrics"] = {"surface": {"recall": value}}
    (row,) = [row for row in compare_results(*sides)["rows"] if row["quantity"] == "surface.recall"]
    assert (row["unit"], row["verdict"]) == ("absolute", verdict)
    assert row["worsening"] == pytest.approx(-now)


def _with(**changes: Any) -> dict[str, Any]:
    return {"cases": [{**result()["cases"][0], **changes}]}


@pytest.mark.parametrize(
    "wrong",
    [
        {},
        {"cases": []},
        {"cases": [1]},
        {"cases": [{"method": "coarse"}]},
        {"cases": [*result()["cases"], {"method": "coarse"}]},
        {**result(), "machine": "x"},
        {**result(), "methods": ["x"]},
        _with(sequence=["phantom/0"]),
        _with(seed={}),
        _with(image_size=[48]),
        _with(image_size="48x40"),
        _with(seconds="long"),
        _with(metrics=[20.0]),
        _with(metrics={"psnr": "good"}),
        _with(metrics={"psnr": [20.0]}),
    ],
)
def test_other_documents_are_refused(wrong: dict[str, Any]) -> None:
    with pytest.raises(ConfigError, match="second result is no JSON"):
        compare_results(result(), wrong)
