"""Frames of several cameras, brought to one size."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from data_catalog.resampling import Resampling
from data_catalog.sampling import LensSampling, source_areas
from extrags.config import IngestConfig
from extrags.errors import ConfigError, SourceError
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
    shown = sampling.color(np.full((64, 96, 3), 200, np.uint8))
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


def test_smaller_pixels_stand_for_the_same_image() -> None:
    whole, small, cropped = (
        LensSampling.planned(DISTORTED, IngestConfig(width=width), None, box=box).source_share
        for width, box in ((None, None), (24, None), (24, (0, 0, 48, 32)))
    )
    assert 0.7 < whole.sum() <= 1
    assert small.sum() == pytest.approx(whole.sum(), rel=1e-6)
    assert cropped.sum() == pytest.approx(whole[:32, :48].sum(), rel=1e-6)


def test_a_radial_model_may_be_off_by_a_pixel_of_the_sequence() -> None:
    fit = replace(DISTORTED.radial(), rms_px=1.5)
    full, half = (
        Resampling.planned(96, 64, IngestConfig(lens="native", downscale=divisor), 1, None)
        for divisor in (1, 2)
    )
    assert LensSampling.native(lambda: fit, half, IngestConfig(lens="native"), None).radial_lens == fit.lens
    with pytest.raises(SourceError, match=r"is 1\.50 px from this lens in the root mean square"):
        LensSampling.native(lambda: fit, full, IngestConfig(lens="native"), None)


def test_areas_do_not_depend_on_how_an_image_is_turned() -> None:
    v, u = np.mgrid[0:6, 0:8].astype(np.float64)
    for angle in np.radians([0, 30, 90, 200]):
        turned = np.cos(angle) * u - np.sin(angle) * v, np.sin(angle) * u + np.cos(angle) * v
        np.testing.assert_allclose(source_areas(2 * turned[0], 3 * turned[1]), 6)
