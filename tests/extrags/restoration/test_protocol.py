from __future__ import annotations

from collections.abc import Callable
from copy import copy
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from extrags.errors import NonFiniteError, ShapeError
from extrags.restoration.classical import ClassicalEnhancer
from extrags.restoration.clips import render_clips
from extrags.restoration.protocol import Clip, Restoration, restore_clip, restore_clips
from tests.extrags.lit_tube import Tube, tube_cameras


class Changed:
    """The restorer of another program, whose result may be anything."""

    name = "theirs"

    def __init__(self, change: Callable[[Restoration], Any]) -> None:
        self.change = change

    def restore(self, clip: Clip) -> Restoration:
        found: Restoration = self.change(ClassicalEnhancer().restore(clip))
        return found

    def save(self, path: Path) -> None:
        raise NotImplementedError


@pytest.fixture(scope="module")
def clip(tube: Tube) -> Clip:
    return render_clips(tube.scene, tube.references, [tube_cameras(3, offset_mm=4.0)], count=4)[0]


def _with(**values: Any) -> Callable[[Restoration], Restoration]:
    def changed(found: Restoration) -> Restoration:
        found, rgb = copy(found), found.rgb
        for name, value in values.items():
            # Past the checks of types, which other programs do not have.
            object.__setattr__(found, name, value(rgb) if callable(value) else value)
        return found

    return changed


def test_what_is_as_promised_passes_as_it_is(clip: Clip) -> None:
    plain = ClassicalEnhancer().restore(clip)
    error, depth = np.zeros(plain.rgb.shape[:3]), np.full(plain.rgb.shape[:3], 7.0)
    found = restore_clip(
        Changed(_with(rgb=lambda rgb: rgb.astype(np.float64), expected_error=error, depth_mm=depth)), clip
    )
    np.testing.assert_array_equal(found.rgb, plain.rgb)
    assert found.depth_mm is depth


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda found: None, "the restorer 'theirs', clip 0: expected a Restoration, found NoneType"),
        (_with(rgb=lambda rgb: rgb + 5), r"clip 0: rgb has to be in \[0, 1\], found 5"),
        (_with(rgb=lambda rgb: -rgb), r"clip 0: rgb has to be in \[0, 1\], found -"),
        (
            _with(rgb=lambda rgb: (255 * rgb).astype(np.uint8)),
            "rgb has to be a NumPy array of floats, found uint8",
        ),
        (_with(rgb=lambda rgb: rgb.tolist()), "rgb has to be a NumPy array of floats, found list"),
        (_with(rgb=lambda rgb: rgb[:, ::2]), "rgb has to have the shape"),
        (_with(expected_error=lambda rgb: rgb), "expected_error has to have the shape"),
        (_with(depth_mm=lambda rgb: -1 - rgb[..., 0]), "depth_mm has to be non-negative, found -"),
    ],
)
def test_what_is_not_is_named(clip: Clip, change: Callable[[Restoration], Any], message: str) -> None:
    with pytest.raises(ShapeError, match=message):
        restore_clips(Changed(change), [clip])


@pytest.mark.parametrize("field", ["rgb", "expected_error", "depth_mm"])
@pytest.mark.parametrize("value", [np.nan, np.inf])
def test_nothing_that_is_not_finite_becomes_black(clip: Clip, field: str, value: float) -> None:
    def spoilt(rgb: np.ndarray) -> np.ndarray:
        values = rgb.copy() if field == "rgb" else rgb[..., 0].copy()
        values[1, 2, 3] = value
        return values

    with pytest.raises(NonFiniteError, match=f"'theirs', clip 0: {field} holds NaN or infinity"):
        restore_clip(Changed(_with(**{field: spoilt})), clip)
