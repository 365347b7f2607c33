from __future__ import annotations

import json
from collections.abc import Iterator

import pytest
import torch

from extrags.errors import ConfigError
from extrags.radial_lens import RadialLens
from extrags.raster import stability
from extrags.raster.stability import AXES, REFUSED, bench_stability

QUICK = ["scale", "flat", "quaternion length", "near plane", "opacity", "duplicate depths", "harmonics"]


def test_cases_are_told_and_pass() -> None:
    result = bench_stability([*QUICK, "number of Gaussians", REFUSED])
    json.dumps(result, allow_nan=False)
    assert result["machine"]["processor"]
    for case in result["cases"]:
        assert {"axis", "value", "ok", "error", "note"} <= set(case)
        assert case["ok"], case
    assert {case["axis"] for case in result["cases"]} == {*QUICK, "number of Gaussians", REFUSED}
    assert sum(case["error"] is not None for case in result["cases"]) > 20


def test_other_numbers_of_threads_give_the_same() -> None:
    one, two = (bench_stability(["needle", "scale"], threads=n)["cases"] for n in (1, 2))
    assert [case["error"] for case in one] == [case["error"] for case in two]


@pytest.mark.slow
def test_all_axes() -> None:
    cases = bench_stability()["cases"]
    assert {case["axis"] for case in cases} == {*AXES, REFUSED}
    assert [case for case in cases if not case["ok"] and case["note"].startswith("not finite")] == []


def test_unknown_axis() -> None:
    with pytest.raises(ConfigError, match="unknown axes wind; expected scale"):
        bench_stability(["wind"])


class TestFailures:
    """What is wrong must be seen: the kernels replaced by ones that err."""

    @pytest.fixture
    def one_case(self, monkeypatch: pytest.MonkeyPatch) -> None:
        def only() -> Iterator[object]:
            yield next(stability._flat())

        monkeypatch.setattr(stability, "AXES", {"flat": only})

    def erring(self, monkeypatch: pytest.MonkeyPatch, name: str, change: float) -> None:
        true = stability._outputs_and_gradients

        def wrong(
            scene: stability.Scene, backend: str, dtype: torch.dtype, *lens: RadialLens | None
        ) -> dict[str, torch.Tensor]:
            found = true(scene, backend, dtype, *lens)
            if backend == "native":
                found[name] = found[name] * change
            return found

        monkeypatch.setattr(stability, "_outputs_and_gradients", wrong)

    @pytest.mark.parametrize(
        ("name", "change", "note"),
        [
            ("rgb", 1.001, "image further off"),
            ("gradient of scales", 1.01, "gradient further off"),
            ("depth", float("nan"), "not finite: depth"),
            ("alpha", 1.5, "alpha outside"),
        ],
    )
    def test_a_fault_is_found(
        self, one_case: None, monkeypatch: pytest.MonkeyPatch, name: str, change: float, note: str
    ) -> None:
        self.erring(monkeypatch, name, change)
        (case,) = bench_stability(["flat"])["cases"]
        assert not case["ok"]
        assert note in case["note"]
