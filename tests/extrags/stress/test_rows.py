"""How rows judge: a fault must be seen, and what cannot be measured is none that passes."""

from __future__ import annotations

import json
import math
from collections.abc import Iterator
from functools import partial

import numpy as np
import pytest
import torch

from extrags.errors import ConfigError, ShapeError
from extrags.stress.rows import (
    Effort,
    Row,
    Trial,
    all_finite,
    differs,
    finite_or_refused,
    only_refused,
    relative,
    run_rows,
)


def row(*values: float, limit: float = 1.0, case: str = "case") -> Row:
    return Row("part", case, "what", limit, lambda effort: ((f"seed {k}", v) for k, v in enumerate(values)))


def raising(error: Exception) -> None:
    raise error


class TestRow:
    def test_the_worst_is_kept_with_its_place(self) -> None:
        found = row(0.1, 0.7, 0.3).run(Effort())
        assert (found["worst"], found["where"], found["trials"], found["passed"]) == (0.7, "seed 1", 3, True)

    @pytest.mark.parametrize("value", [1.5, math.inf, math.nan])
    def test_too_much_fails(self, value: float) -> None:
        found = row(0.1, value, 0.3).run(Effort())
        assert not found["passed"]
        assert found["where"] == "seed 1"
        json.dumps(found, allow_nan=False)

    def test_numbers_of_numpy_go_into_json_too(self) -> None:
        found = row(np.float64(0.5), np.float64(0.7)).run(Effort())
        assert json.loads(json.dumps(found, allow_nan=False))["passed"] is True

    def test_no_trial_proves_nothing(self) -> None:
        assert not row().run(Effort())["passed"]

    def test_a_crash_fails_and_says_what_it_was(self) -> None:
        def trials(effort: Effort) -> Iterator[Trial]:
            yield "seed 0", 0.0
            raise RuntimeError("no blocks")

        found = Row("part", "case", "what", 1.0, trials).run(Effort())
        assert not found["passed"]
        assert found["note"] == "after 1 trials: RuntimeError: no blocks"


class TestChoice:
    def test_by_name_or_part(self) -> None:
        rows = [
            row(0.0, case="one"),
            row(0.0, case="two"),
            Row("other", "one", "", 1.0, lambda effort: [("", 0.0)]),
        ]

        def names(*patterns: str) -> list[str]:
            return [f"{found['part']}/{found['case']}" for found in run_rows(rows, patterns)]

        assert names("part") == ["part/one", "part/two"]
        assert names("*/one") == ["part/one", "other/one"]
        assert names("other", "part/t*") == ["part/two", "other/one"]

    def test_a_pattern_without_a_row(self) -> None:
        with pytest.raises(ConfigError, match=r"no row matches wind; .* with the parts part"):
            run_rows([row(0.0)], ["wind"])

    def test_an_effort_of_nothing(self) -> None:
        with pytest.raises(ConfigError, match="scenes is 0"):
            Effort(scenes=0)


class TestMeasures:
    def test_relative(self) -> None:
        assert relative(torch.tensor([1.0, 1.1]), torch.tensor([1.0, 1.0])) == pytest.approx(0.0707, rel=1e-2)
        # Squares of neither overflow.
        assert relative(np.array([2e200]), np.array([1e200])) == pytest.approx(1)
        assert relative(torch.tensor([math.nan]), torch.tensor([1.0])) == math.inf
        assert relative(torch.zeros(2), torch.zeros(2)) == 0

    def test_the_last_bit_counts(self) -> None:
        one = np.float32(1)
        assert differs({"a": one.reshape(1)}, {"a": np.nextafter(one, np.float32(2)).reshape(1)}) == 1
        assert differs([torch.ones(2), 3.0], [torch.ones(2), 3.0]) == 0
        assert differs([torch.ones(2)], []) == 1

    def test_finite_deep_inside(self) -> None:
        assert all_finite([{"a": np.ones(2)}, (1.0, torch.ones(1))])
        assert not all_finite([{"a": np.ones(2)}, (1.0, torch.tensor([math.inf]))])

    def test_a_named_error_is_an_answer_and_another_is_none(self) -> None:
        refusing = partial(raising, ShapeError("too small"))
        assert finite_or_refused(refusing) == only_refused(refusing) == 0
        assert finite_or_refused(lambda: math.nan) == only_refused(lambda: 1.0) == math.inf
        with pytest.raises(RuntimeError):
            finite_or_refused(partial(raising, RuntimeError("not named")))
