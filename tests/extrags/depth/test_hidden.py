"""Depth that is read from an image, against true depth of procedural cavities."""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch
from torch import Tensor

from extrags.depth.hidden import SOLID, depth_from_image
from extrags.depth.pretraining.cavities import Cavities
from extrags.depth.pretraining.photographs import Clips, photograph
from extrags.depth.weights import load_hidden
from extrags.view_synthesis.filling import completed_depth

SIZE = (64, 80)
MEDIAN_MM = 20.0


@pytest.fixture(scope="module")
def clips() -> Clips:
    """Pictures of scenes drawn with another seed than any of the training, all seen to the end."""
    generator = torch.Generator().manual_seed(990)
    found = photograph(Cavities("colon", 8, generator), generator, SIZE, 1)
    assert len(found.depth) >= 5
    return found


@pytest.fixture(scope="module")
def few(clips: Clips) -> Clips:
    """Three of them, where it does not matter how near to the truth what is read is on average."""
    return replace(
        clips, frames=clips.frames.of_frames(torch.arange(3)), depth=clips.depth[:3], clip=clips.clip[:3]
    )


def true_depth_mm(clips: Clips) -> Tensor:
    depth = torch.where(clips.depth > 0, clips.depth, clips.depth.amax(dim=(1, 2), keepdim=True))
    return MEDIAN_MM * depth / depth.flatten(1).median(dim=1).values[:, None, None]


def with_a_hole() -> Tensor:
    """Opacity of views of which only a frame is known."""
    opacity = torch.ones(SIZE)
    opacity[12:52, 24:76] = 0
    return opacity


def hidden(
    clips: Clips, opacity: Tensor, guess_mm: Tensor | None = None, *, half_precision: bool = False
) -> tuple[Tensor, Tensor]:
    """What is read, and smooth filling."""
    network = load_hidden()
    truth = true_depth_mm(clips)
    opacity = opacity.expand(len(truth), *SIZE)
    filled = completed_depth(truth[:, None] * (opacity[:, None] > 0), opacity[:, None], MEDIAN_MM)[:, 0]
    guess_mm = filled if guess_mm is None else guess_mm
    read = depth_from_image(
        network,
        clips.frames.rgb,
        filled,
        guess_mm,
        opacity,
        clips.frames.K,
        half_precision=half_precision,
    )
    return read, filled


def test_it_is_nearer_to_the_truth_than_smooth_filling(clips: Clips) -> None:
    opacity = with_a_hole()
    read, filled = hidden(clips, opacity)
    inside = (opacity == 0).expand_as(read) & clips.frames.mask & (clips.depth > 0)
    errors = [(depth / true_depth_mm(clips)).log().abs()[inside].mean() for depth in (read, filled)]
    assert errors[0] < 0.7 * errors[1]


def test_half_precision_reads_the_same_depth(few: Clips) -> None:
    opacity = with_a_hole()
    (whole, _), (half, filled), (again, _) = (
        hidden(few, opacity, half_precision=half) for half in (False, True, True)
    )
    assert torch.equal(half, again)
    inside = (opacity == 0).expand_as(whole)
    difference = (half / whole).log().abs()[inside]
    # Eight bits of what is added to smooth filling, through some sixty convolutions.
    change = (whole / filled).log().abs()[inside].mean()
    assert 0 < difference.mean() < 2.0**-8 < change
    assert difference.max() < 2.0**-5


def test_views_of_any_size_and_pixels_that_are_not_square() -> None:
    """Read at two smaller sizes, from images with different focal lengths; the last view shows nothing."""
    generator = torch.Generator().manual_seed(991)
    found = photograph(Cavities("colon", 2, generator), generator, (198, 171), 1)
    assert len(found.depth) >= 2
    frames = found.frames
    truth = true_depth_mm(found)
    # Every second row of a view with square pixels has twice its height.
    rgb, truth, mask = frames.rgb[:, :, ::2], truth[:, ::2], frames.mask[:, ::2] & (found.depth[:, ::2] > 0)
    K = frames.K.clone()
    K[:, 1] /= 2
    opacity = torch.ones_like(truth)
    opacity[:, 20:80, 50:163] = 0
    opacity[-1] = 0
    filled = completed_depth(truth[:, None] * (opacity[:, None] > 0), opacity[:, None], MEDIAN_MM)[:, 0]
    network = load_hidden()
    read = depth_from_image(network, rgb, filled, filled, opacity, K)
    assert torch.isfinite(read).all()
    inside = ((opacity == 0) & mask)[:-1]
    errors = [(depth / truth)[:-1].log().abs()[inside].mean() for depth in (read, filled)]
    assert errors[0] < 0.8 * errors[1]


def test_what_is_solid_stays(few: Clips) -> None:
    opacity = with_a_hole()
    opacity[:12] = SOLID + 0.01
    guess = 2 * true_depth_mm(few)
    read, _ = hidden(few, opacity, guess)
    solid = (opacity > SOLID).expand_as(read)
    torch.testing.assert_close(read[solid], guess[solid], atol=0, rtol=1e-5)
    assert not torch.isclose(read[~solid], guess[~solid]).all()


def test_lengths_have_any_unit(few: Clips) -> None:
    network = load_hidden()
    truth, opacity = true_depth_mm(few), with_a_hole().expand(len(few.depth), *SIZE)
    given = [few.frames.rgb, truth, truth, opacity, few.frames.K]
    here = depth_from_image(network, *given)
    given[1:3] = [1000 * truth, 1000 * truth]
    torch.testing.assert_close(depth_from_image(network, *given), 1000 * here, atol=0, rtol=1e-4)


def test_a_view_of_which_nothing_is_known(few: Clips) -> None:
    read, _ = hidden(few, torch.zeros(SIZE), torch.full_like(few.depth, MEDIAN_MM))
    assert torch.isfinite(read).all()
    assert (read > 0).all()
