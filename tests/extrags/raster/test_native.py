"""What the kernels' own entries refuse."""

from __future__ import annotations

import numpy as np
import pytest

from extrags.raster import native

pytestmark = pytest.mark.skipif(native.native_isa() is None, reason="the native kernels are not built")


@pytest.mark.parametrize(
    ("reach", "start", "directions", "rays", "said"),
    [
        ((4, 2, 2), (3,), (5, 3), 5, "reach"),
        ((4, 4), (3,), (5, 3), 5, "reach"),
        ((4, 4, 4), (2,), (5, 3), 5, "start"),
        ((4, 4, 4), (3,), (5, 2), 5, "directions"),
        ((4, 4, 4), (3,), (15,), 15, "directions"),
        ((4, 4, 4), (3,), (5, 3), 1, "entered"),
    ],
)
def test_a_march_of_sizes_that_do_not_fit(
    reach: tuple[int, ...], start: tuple[int, ...], directions: tuple[int, ...], rays: int, said: str
) -> None:
    # Places behind the last one, so that a kernel without the check writes into no other memory.
    entered = np.full(64, 7, dtype=np.int64)
    with pytest.raises(ValueError, match=f"{said} has an unexpected size"):
        native.compiled_kernels().march(
            np.zeros(reach, np.float32), np.full(start, 1.5), np.ones(directions), entered[:rays]
        )
    assert (entered == 7).all()


def test_a_loss_of_no_pixel() -> None:
    empty = np.zeros((0, 3, 3), np.float32)
    with pytest.raises(ValueError, match="image has an unexpected size"):
        native.compiled_kernels().l1_ssim(empty, empty, None, empty, 0.2, 1.0)
