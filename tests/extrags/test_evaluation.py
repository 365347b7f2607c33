from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from extrags.errors import ShapeError
from extrags.evaluation import evaluate
from tests.extrags.lit_tube import Tube


def test_without_held_out_frames_there_is_nothing_to_evaluate_on(tube: Tube) -> None:
    split = replace(tube.sequence.split, test=np.zeros(0, dtype=np.int64))
    with pytest.raises(ShapeError, match=r"split.test is empty"):
        evaluate(tube.scene, replace(tube.sequence, split=split))
