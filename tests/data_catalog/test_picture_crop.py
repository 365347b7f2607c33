"""The surround of a picture is cut off, and nothing else."""

from __future__ import annotations

import logging
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
from PIL import Image

from data_catalog import read
from data_catalog.catalog import measured_detail
from data_catalog.picture_crop import cropped_to_picture
from extrags.cameras import pixel_rays
from extrags.config import IngestConfig
from extrags.sequence import EndoscopicSequence, Split
from tests.data_catalog.footage_fixture import write_video
from tests.data_catalog.test_content import in_a_circle, moving_scene, rim

SIZE = (320, 180)
BOX = (slice(20, 120), slice(90, 200))
"""Rows and columns of all pixels that a mask keeps."""


@pytest.fixture
def framed() -> EndoscopicSequence:
    generator = np.random.default_rng(0)
    frames = 4
    mask = np.zeros((frames, SIZE[1], SIZE[0]), bool)
    # No frame alone shows all of the box.
    mask[:2, 20:110, 90:190] = True
    mask[2:, 30:120, 100:200] = True
    rgb = generator.integers(0, 255, (*mask.shape, 3)).astype(np.uint8)
    K = np.tile(np.array([[200.0, 0, 140], [0, 210, 75], [0, 0, 1]]), (frames, 1, 1))
    depth = generator.uniform(1, 2, mask.shape).astype(np.float32)
    return EndoscopicSequence(
        name="framed",
        rgb=rgb,
        K=K,
        mask=mask,
        split=Split("all", np.arange(3), np.array([3])),
        depth_mm=depth,
        specular=depth > 1.9,
    )


def test_all_that_belongs_to_a_frame_is_cut(
    framed: EndoscopicSequence, caplog: pytest.LogCaptureFixture
) -> None:
    with caplog.at_level(logging.INFO, logger="data_catalog"):
        found = cropped_to_picture(framed, IngestConfig())
    for name in ("rgb", "mask", "depth_mm", "specular"):
        np.testing.assert_array_equal(getattr(found, name), getattr(framed, name)[:, *BOX], err_msg=name)
    assert "framed: frames of 320 x 180 px are cut to the picture, 110 x 100 px" in caplog.text
    # The ray of each pixel is the one that it had.
    posed = np.tile(np.eye(4), (4, 1, 1))
    before, after = (pixel_rays(replace(s, world_from_camera=posed).cameras) for s in (framed, found))
    np.testing.assert_allclose(after, before[:, *BOX], atol=1e-12)
    assert found.split is framed.split
    assert cropped_to_picture(found, IngestConfig()) is found


def test_what_stays_as_it_is(framed: EndoscopicSequence) -> None:
    assert cropped_to_picture(framed, IngestConfig(crop_surround=False)) is framed
    # Who sets a width gets it.
    assert cropped_to_picture(framed, IngestConfig(width=320)) is framed
    # Others render posed frames at the size that their source has.
    posed = replace(framed, world_from_camera=np.tile(np.eye(4), (4, 1, 1)))
    assert cropped_to_picture(posed, IngestConfig()) is posed
    narrow = replace(framed, mask=framed.mask & (np.arange(320) < 150))
    assert cropped_to_picture(narrow, IngestConfig()) is narrow
    K = framed.K.copy()
    K[3, 0, 2] = 205
    beside = replace(framed, K=K)
    assert cropped_to_picture(beside, IngestConfig()) is beside
    nothing = replace(framed, mask=np.zeros_like(framed.mask))
    assert cropped_to_picture(nothing, IngestConfig()) is nothing


@pytest.mark.parametrize(("rows", "is_cut"), [(134, True), (137, False)])
def test_a_quarter_of_the_frame_is_cut_and_less_is_not(
    framed: EndoscopicSequence, rows: int, is_cut: bool
) -> None:
    mask = np.zeros_like(framed.mask)
    mask[:, :rows] = True
    found = cropped_to_picture(replace(framed, mask=mask), IngestConfig())
    assert found.height == (rows if is_cut else SIZE[1])


def test_a_round_picture_of_a_video(tmp_path: Path) -> None:
    scene = in_a_circle(moving_scene(30, *SIZE, speed=3), rim(150, 90, 84))
    file = write_video(tmp_path / "exam.avi", scene)
    whole, found = read(file, IngestConfig(crop_surround=False)), read(file)
    assert (whole.width, whole.height) == SIZE
    assert 160 <= found.width <= 168
    assert found.height == pytest.approx(found.width, abs=2)
    assert found.mask.sum() == whole.mask.sum()
    np.testing.assert_array_equal(found.rgb[found.mask], whole.rgb[whole.mask])
    # A guess follows the round picture in either.
    np.testing.assert_allclose(found.K[0, :2, 2], [found.width / 2, found.height / 2], atol=1.5)
    assert found.K[0, 0, 0] == whole.K[0, 0, 0]


def test_frames_of_the_size_of_their_detail_are_cut_too(tmp_path: Path) -> None:
    """By a stage, which measures that size before, as by one call."""
    scene = in_a_circle(moving_scene(30, *SIZE, speed=3), rim(150, 90, 84))
    for number, image in enumerate(scene[:12]):
        blurred = cv2.GaussianBlur(cv2.resize(image, None, fx=2, fy=2), (0, 0), 4)
        Image.fromarray(blurred).save(tmp_path / f"{number:04d}.png")
    config = IngestConfig(size="detail", detail_psnr_db=40)
    detail = measured_detail(tmp_path, config)
    assert detail is not None
    assert detail.divisor > 1
    once, twice = read(tmp_path, config), read(tmp_path, config, detail=detail)
    assert once.width == twice.width < 0.6 * detail.reduced_width
    # Who sets a width gets it.
    assert read(tmp_path, IngestConfig(size="detail", width=320)).width == 320


def test_a_round_picture_of_plain_frames(tmp_path: Path) -> None:
    for number, image in enumerate(in_a_circle(moving_scene(12, *SIZE, speed=3), rim(150, 90, 84))):
        Image.fromarray(image).save(tmp_path / f"{number:04d}.png")
    assert 160 <= read(tmp_path).width <= 168
