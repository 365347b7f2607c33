"""When COLMAP tries again, and which of its attempts counts."""

from __future__ import annotations

from dataclasses import dataclass, field
from functools import partial
from typing import Any

import numpy as np
import pytest

from extrags.config import PosesConfig
from extrags.errors import CaptureError
from extrags.poses import estimate
from extrags.poses.attempts import Attempt, attempted
from extrags.poses.estimate import estimate_poses
from extrags.poses.job import PoseJob, PoseJobResult
from extrags.sequence import EndoscopicSequence, Split

HELD_OUT = 2


def sequence(n_train: int) -> EndoscopicSequence:
    count = n_train + HELD_OUT
    return EndoscopicSequence(
        "test/recording",
        np.zeros((count, 12, 16, 3), np.uint8),
        np.tile(np.array([[16.0, 0, 8], [0, 16.0, 6], [0, 0, 1]]), (count, 1, 1)),
        np.ones((count, 12, 16), bool),
        Split("test", np.arange(n_train), np.arange(n_train, count)),
        metric=False,
    )


@dataclass
class Colmap:
    """Registers so many training frames, the first ones, in its first and in its second attempt.

    Args:
        n_train: training frames.
        registers: in each attempt.
        determined: whether each attempt found the lens; None where none is sought.
    """

    n_train: int
    registers: tuple[int, int]
    determined: tuple[bool, bool] | None = None
    lenient: list[bool] = field(default_factory=list)

    def __call__(self, job: PoseJob, _name: str) -> PoseJobResult:
        self.lenient.append(job.lenient)
        poses = np.full((self.n_train + HELD_OUT, 4, 4), np.nan)
        poses[: self.registers[job.lenient]] = np.eye(4)
        report: dict[str, Any] = {
            "registrations": {},
            "model_sizes": [self.registers[job.lenient]],
            "features_median": 500.0,
            "features_fewest": 400,
            "pairs": 3,
            "pairs_verified": 3,
            "inliers_median": 50.0,
            "pairs_examined": 3,
            "pairs_turn_only": 0,
            "pair_angle_deg": 9.0,
            "frames": {"0": {"features": 500, "best_pair_inliers": 50, "verified_pairs": 3}},
        }
        if self.determined is not None:
            report["calibration"] = {"determined": self.determined[job.lenient]}
        none = np.zeros(0, dtype=np.int64)
        return PoseJobResult(
            poses, np.zeros((0, 3)), np.zeros((0, 3), np.uint8), none, none, np.zeros((0, 2)), report
        )


def outcome(colmap: Colmap, *, retry_too_few: bool = True, **settings: Any) -> Attempt:
    given = sequence(colmap.n_train)
    config = PosesConfig(**settings)
    return attempted(given, estimate._job(given, config), config, colmap, retry_too_few=retry_too_few)


@pytest.mark.parametrize(
    ("n_train", "registers"), [(17, (10, 17)), (17, (7, 17)), (4, (2, 4)), (5, (4, 5)), (20, (8, 9))]
)
def test_the_second_attempt_counts_where_it_registers_clearly_more(
    n_train: int, registers: tuple[int, int], caplog: pytest.LogCaptureFixture
) -> None:
    colmap = Colmap(n_train, registers)
    found = outcome(colmap)
    assert colmap.lenient == [False, True]
    assert int(found.registered.sum()) == registers[1]
    assert found.report["lenient"] is True
    assert found.report["first_attempt"]["registered_train"] == registers[0]
    assert f"COLMAP registered {registers[0]} of {n_train} training frames; trying again" in caplog.text


@pytest.mark.parametrize(("n_train", "registers"), [(20, (18, 20)), (17, (17, 17)), (10, (9, 10))])
def test_a_tenth_may_be_missing(n_train: int, registers: tuple[int, int]) -> None:
    colmap = Colmap(n_train, registers)
    found = outcome(colmap)
    assert colmap.lenient == [False]
    assert int(found.registered.sum()) == registers[0]
    assert "lenient" not in found.report


@pytest.mark.parametrize("registers", [(12, 14), (12, 12), (12, 5)])
def test_the_more_exact_poses_stay_where_the_second_attempt_adds_little(
    registers: tuple[int, int], caplog: pytest.LogCaptureFixture
) -> None:
    colmap = Colmap(20, registers)
    found = outcome(colmap)
    assert colmap.lenient == [False, True]
    assert int(found.registered.sum()) == 12
    assert "lenient" not in found.report
    assert f"the second attempt registered {registers[1]} of 20 training frames; the first" in caplog.text


def test_a_lens_that_was_found_is_not_given_up_for_a_guess(caplog: pytest.LogCaptureFixture) -> None:
    assert int(outcome(Colmap(20, (12, 20), (True, False))).registered.sum()) == 12
    assert "and did not determine the lens; the first one counts" in caplog.text
    assert int(outcome(Colmap(20, (12, 20), (True, True))).registered.sum()) == 20
    assert int(outcome(Colmap(20, (12, 20), (False, False))).registered.sum()) == 20
    # Too few frames are none that could be kept.
    assert int(outcome(Colmap(20, (6, 20), (True, False))).registered.sum()) == 20


def test_a_first_attempt_that_was_enough_outlives_the_failure_of_the_second(
    caplog: pytest.LogCaptureFixture,
) -> None:
    def run(job: PoseJob, name: str, colmap: Colmap) -> PoseJobResult:
        if job.lenient:
            raise CaptureError("COLMAP's process ended with code -9")
        return colmap(job, name)

    given, config = sequence(20), PosesConfig()
    job = estimate._job(given, config)
    enough = partial(run, colmap=Colmap(20, (17, 20)))
    found = attempted(given, job, config, enough, retry_too_few=True)
    assert int(found.registered.sum()) == 17
    assert "lenient" not in found.report
    assert (
        "the second attempt failed; the first one counts (COLMAP's process ended with code -9" in caplog.text
    )
    too_few = partial(run, colmap=Colmap(20, (6, 20)))
    with pytest.raises(CaptureError, match="code -9"):
        attempted(given, job, config, too_few, retry_too_few=True)


@pytest.mark.parametrize(
    ("first", "retry_too_few", "settings"),
    [(7, False, {}), (10, True, {"lenient_retry": False}), (7, True, {"lenient_retry": False})],
)
def test_another_way_or_the_settings_leave_it_at_one(
    first: int, retry_too_few: bool, settings: dict[str, Any]
) -> None:
    colmap = Colmap(17, (first, 17))
    outcome(colmap, retry_too_few=retry_too_few, **settings)
    assert colmap.lenient == [False]


def test_where_enough_registered_there_is_no_other_way_for_the_rest() -> None:
    colmap = Colmap(17, (10, 17))
    assert int(outcome(colmap, retry_too_few=False).registered.sum()) == 17
    assert colmap.lenient == [False, True]


def test_two_frames_make_no_map(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(estimate, "_run", Colmap(4, (2, 2)))
    with pytest.raises(CaptureError, match=r"2 of 4 training frames \(50%\), expected at least 50% and 3 fr"):
        estimate_poses(sequence(4))
