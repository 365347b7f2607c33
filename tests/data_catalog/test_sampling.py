"""Frames of several cameras, brought to one size."""

from __future__ import annotations

import numpy as np
import pytest

from data_catalog.sampling import LensSampling
from extrags.config import IngestConfig
from extrags.errors import ConfigError
from extrags.lens import Lens

DISTORTED = Lens("OPENCV", (80.0, 80.0, 48.0, 32.0, -0.1, 0.0, 0.0, 0.0), 96, 64)
PINHOLE = Lens("PINHOLE", (80.0, 80.0, 48.0, 32.0), 96, 64)
GROWN = IngestConfig(size="central", field_of_view_deg=100.0)


def test_a_pinhole_beside_a_lens_whose_pinhole_grows() -> None:
    first = LensSampling.planned(DISTORTED, GROWN, None)
    said = r"pinhole keep their 96 x 64 pixels, .* become 191 x 127 by ingest\.size=central and ingest\.field"
    with pytest.raises(ConfigError, match=said):
        LensSampling.planned(PINHOLE, GROWN, first)


def test_the_grown_pinhole_shows_frames() -> None:
    sampling = LensSampling.planned(DISTORTED, GROWN, None)
    shown = sampling.colour(np.full((64, 96, 3), 200, np.uint8))
    assert shown.shape == (127, 191, 3)
    assert (shown[60:67, 90:100] == 200).all()


@pytest.mark.parametrize(
    "config", [GROWN.model_copy(update={"width": 48}), GROWN.model_copy(update={"field_of_view_deg": None})]
)
def test_they_share_a_size_that_does_not_grow(config: IngestConfig) -> None:
    first = LensSampling.planned(DISTORTED, config, None)
    assert LensSampling.planned(PINHOLE, config, first).resampling == first.resampling


def test_the_pinhole_may_come_first() -> None:
    first = LensSampling.planned(PINHOLE, GROWN, None)
    assert LensSampling.planned(DISTORTED, GROWN, first).resampling == first.resampling
