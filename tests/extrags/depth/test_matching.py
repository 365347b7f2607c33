"""Stereo's kernels against their torch specification, and both against surfaces known exactly."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable

import numpy as np
import pytest
import torch

from extrags.depth import matching, native
from extrags.depth.consistency import agreement
from extrags.depth.frames import PosedFrames
from extrags.depth.shading import fit_shading
from extrags.depth.stereo import StereoSettings, multi_view_stereo, sweep_around
from extrags.errors import ShapeError
from extrags.raster import native as raster_native
from extrags.raster.native import compiled_kernels
from extrags.raster.native import set_num_threads as set_threads
from extrags.source_frames import select_sources
from extrags.stress.inputs import plane_views
from tests.extrags.depth.planes import inside_sphere, on, tilted_plane
from tests.extrags.forked_child import exit_code_of_child

ISAS = raster_native.usable_isas()


@pytest.fixture(params=ISAS or ["none"])
def isa(request: pytest.FixtureRequest):  # type: ignore[no-untyped-def]
    if request.param == "none":
        pytest.skip("no native kernels were built")
    kernels = compiled_kernels()
    before = kernels.isa()
    kernels.set_isa(request.param)
    yield request.param
    kernels.set_isa(before)


def _case() -> dict[str, torch.Tensor]:
    _frames, depth = tilted_plane()
    return {
        "references": torch.tensor([2, 0]),
        "sources": torch.tensor([[1, 3, 0, 4], [1, 2, -1, -1]]),
        "base_depth": 1.1 * depth[[2, 0]],
        "offsets": torch.linspace(-0.3, 0.3, 7).repeat(2, 1),
    }


def test_costs_equal_those_of_torch(isa: str) -> None:
    frames, _ = tilted_plane()
    frames.mask[1, :7, :9] = False
    frames.mask[2, 30:, 40:] = False
    expected = matching.matching_cost(frames, **_case(), radius_px=2)
    found = native.matching_cost(frames, **_case(), radius_px=2)
    assert expected.std() > 0.1
    # Sums over 25 values of float32; the floor of the variances bounds how far rounding is enlarged.
    assert (found - expected).abs().max() < 2e-3
    assert (found - expected).abs().mean() < 2e-6


def test_costs_do_not_depend_on_threads_or_instructions() -> None:
    if not ISAS:
        pytest.skip("no native kernels were built")
    frames, _ = tilted_plane()
    kernels = compiled_kernels()
    before, threads = kernels.isa(), kernels.num_threads()
    results = []
    try:
        for name in ISAS:
            for count in (1, 3):
                kernels.set_isa(name)
                set_threads(count)
                cost = native.matching_cost(frames, **_case())
                steps = native.best_steps(cost, frames.grey[[2, 0]], small_step=0.1, jump=0.6)
                results.append(torch.cat([cost.flatten(), *(part.flatten() for part in steps)]))
    finally:
        kernels.set_isa(before)
        set_threads(threads)
    for other in results[1:]:
        assert torch.equal(results[0], other)


def test_torch_gives_these_costs_on_every_device(device: str) -> None:
    frames, _ = tilted_plane()
    frames.mask[1, :7, :9] = False
    expected = matching.matching_cost(frames, **_case(), radius_px=2)
    there = {name: value.to(device) for name, value in _case().items()}
    found = matching.matching_cost(on(frames, device), **there, radius_px=2)
    assert found.device.type == device
    # As between the processor's two implementations.
    assert (found.cpu() - expected).abs().max() < 2e-3
    assert (found.cpu() - expected).abs().mean() < 2e-6
    # The same costs, so that no nearly equal ones change their order.
    grey = frames.grey[[2, 0]]
    steps = matching.best_steps(expected.to(device), grey.to(device), small_step=0.1, jump=0.6)
    for one, other in zip(steps, matching.best_steps(expected, grey, small_step=0.1, jump=0.6), strict=True):
        assert (one.cpu() - other).abs().max() < 1e-4


def test_a_reference_without_sources_costs_the_same_everywhere(isa: str) -> None:
    frames, _depth = tilted_plane()
    case = {**_case(), "sources": torch.full((2, 4), -1)}
    assert torch.equal(native.matching_cost(frames, **case), torch.ones(2, 7, *frames.size))


def test_a_forked_child_does_not_wait_for_a_thread_of_its_parent() -> None:
    kernels, generator = compiled_kernels(), np.random.default_rng(3)

    def job(*shape: int) -> list[np.ndarray]:
        cost = generator.random(shape, dtype=np.float32)
        return [cost, *(cost[0].copy() for _ in range(4))]

    def work(arrays: list[np.ndarray]) -> None:
        cost, grey, *images = arrays
        kernels.semi_global(cost, grey, 0.1, 0.3, 0.15, *images)

    large, small, again = job(64, 500, 500), job(4, 6, 5), job(4, 6, 5)
    again[:2] = small[:2]
    work(small)
    thread = threading.Thread(target=work, args=(large,))
    started = time.monotonic()
    thread.start()
    time.sleep(0.05)

    def same_in_the_child() -> bool:
        work(again)
        return all(np.array_equal(one, other) for one, other in zip(small, again, strict=True))

    held = thread.is_alive()
    assert exit_code_of_child(same_in_the_child, deadline_s=10) == 0
    thread.join()
    assert held, f"the parent's thread was done after {time.monotonic() - started} s: nothing was tested"


@pytest.mark.parametrize("shape", [(5, 9, 7), (12, 1, 6), (33, 8, 1), (16, 21, 34)])
def test_semi_global_equals_torch(shape: tuple[int, int, int], isa: str) -> None:
    generator = torch.Generator().manual_seed(3)
    cost = 2 * torch.rand(1, *shape, generator=generator)
    grey = torch.randn(1, *shape[1:], generator=generator)
    expected = matching.best_steps(cost, grey, small_step=0.1, jump=0.7)
    found = native.best_steps(cost, grey, small_step=0.1, jump=0.7)
    for one, other in zip(found, expected, strict=True):
        assert (one - other).abs().max() < 1e-4


def test_semi_global_against_a_path_written_out() -> None:
    """The sum of eight explicitly followed paths, in float64, at one pixel."""
    generator = torch.Generator().manual_seed(5)
    cost = torch.rand(1, 4, 5, 6, generator=generator)
    grey = torch.randn(1, 5, 6, generator=generator)
    total = matching.semi_global(cost, grey, small_step=0.2, jump=0.9, edge=0.15)[0].double().numpy()
    volume, image = cost[0].double().numpy(), grey[0].double().numpy()
    row, column = 2, 3
    summed = np.zeros(4)
    for step_y, step_x in ((0, 1), (0, -1), (1, 0), (-1, 0), (1, 1), (-1, -1), (1, -1), (-1, 1)):
        path = []
        y, x = row, column
        while 0 <= y < 5 and 0 <= x < 6:
            path.append((y, x))
            y, x = y - step_y, x - step_x
        before, lowest, bright = np.zeros(4), 0.0, None
        for y, x in reversed(path):
            here = volume[:, y, x].copy()
            if bright is not None:
                penalty = max(0.9 / (1 + abs(image[y, x] - bright) / 0.15), 0.2)
                for k in range(4):
                    near = [before[j] + 0.2 for j in (k - 1, k + 1) if 0 <= j < 4]
                    here[k] += min([before[k], lowest + penalty, *near]) - lowest
            before, lowest, bright = here, here.min(), image[y, x]
        summed += before
    assert np.allclose(total[:, row, column], summed / 8, rtol=0, atol=1e-5)


def test_sub_step_finds_the_vertex_of_a_parabola() -> None:
    steps = torch.arange(9.0)
    cost = (steps[None, :, None, None] - torch.tensor([[3.3, 6.8], [0.0, 8.0]])) ** 2
    position, lowest, margin = matching.sub_step(cost)
    assert torch.allclose(position[0], torch.tensor([[3.3, 6.8], [0.0, 8.0]]), atol=1e-5)
    assert torch.allclose(lowest[0, 0], torch.tensor([0.09, 0.04]), atol=1e-5)
    assert (margin > 0).all()


@pytest.mark.parametrize("surface", [tilted_plane, inside_sphere])
def test_stereo_finds_a_textured_surface(surface, device: str) -> None:  # type: ignore[no-untyped-def]
    frames, depth = surface()
    poses, K = frames.world_from_camera.double().numpy(), frames.K.double().numpy()
    sources = torch.from_numpy(select_sources(poses, K, frames.size, np.full(5, 2.0), 3)).to(device)
    near, far = torch.full((5,), 0.8, device=device), torch.full((5,), 5.0, device=device)
    frames, depth = on(frames, device), depth.to(device)
    stereo = multi_view_stereo(frames, sources, near, far, StereoSettings(hypotheses=48, radius_px=2))
    inner = (slice(None), slice(4, -4), slice(4, -4))
    error = (stereo.log_depth - depth.log()).abs()[inner]
    # Twenty pixels between the outermost views: a tenth of a pixel is half a percent of the depth, a step of
    # the sweep four.
    assert error.median() < 0.03
    assert (error < 0.05).float().mean() > 0.8
    again = sweep_around(
        frames, sources, stereo, depth.log() + 0.03, half_width=0.1, hypotheses=13, small_step=0.1, jump=0.5
    )
    assert (again.log_depth - depth.log()).abs()[inner].median() < 0.03


def test_frames_matched_together_are_those_matched_alone(specification: Callable[[], None]) -> None:
    specification()
    frames, _ = tilted_plane()
    sources = torch.tensor([[1, 2], [0, 2], [1, 3], [2, 4], [3, -1]])
    near, far = torch.linspace(0.8, 1.2, 5), torch.full((5,), 5.0)
    settings = StereoSettings(hypotheses=24, radius_px=2)
    alone = multi_view_stereo(frames, sources, near, far, settings, chunk=1)
    together = multi_view_stereo(frames, sources, near, far, settings, chunk=3)
    # torch sums windows of several images in another order than those of one.
    assert (alone.log_depth - together.log_depth).abs().median() < 1e-6
    assert ((alone.log_depth - together.log_depth).abs() > 1e-3).float().mean() < 0.01


def test_agreement_of_true_depths_and_of_wrong_ones() -> None:
    frames, depth = inside_sphere()
    sources = torch.tensor([[1, 2]]).repeat(5, 1)
    right = agreement(frames, depth, torch.arange(3, 5), sources[:2])
    assert right.agrees[right.seen > 0].mean() > 0.99
    # A frame that claims half the depth is looked through by the others.
    wrong = depth.clone()
    wrong[3] /= 2
    found = agreement(frames, wrong, torch.tensor([3]), sources[:1])
    assert found.violates[found.seen > 0].mean() > 0.99
    assert found.agrees[found.seen > 0].mean() < 0.01


def test_depth_is_fused_with_that_of_all_that_agree() -> None:
    frames, depth = inside_sphere()
    farther = depth.clone()
    farther[3] *= 1.03
    found = agreement(frames, farther, torch.tensor([3]), torch.tensor([[1, 2]]))
    both = (found.seen * found.agrees)[0] == 1
    assert both.float().mean() > 0.3
    # A third of the error is left where two others agree.
    assert float((found.fused[0] - depth[3].log())[both].exp().mean()) == pytest.approx(1.01, abs=2e-3)


def test_a_wide_range_is_searched_from_end_to_end() -> None:
    frames, depth = tilted_plane()
    sources = torch.tensor([[1, 2], [0, 2], [1, 3], [2, 4], [3, 2]])
    near, far = torch.full((5,), 1.0), torch.full((5,), 100.0)
    found = multi_view_stereo(frames, sources, near, far, StereoSettings(hypotheses=64, radius_px=2))
    assert (found.log_depth - depth.log()).abs()[:, 4:-4, 4:-4].median() < 0.05


def test_a_frame_that_nothing_matches_has_the_depth_that_is_predicted() -> None:
    frames, depth = tilted_plane()
    sources = torch.tensor([[1, 2], [0, 2], [1, 3], [2, 1], [-1, -1]])
    near, far = torch.full((5,), 0.8), torch.full((5,), 5.0)
    settings = StereoSettings(hypotheses=24, radius_px=2, shading=False)
    known, blind = (
        multi_view_stereo(frames, sources, near, far, settings, monocular=monocular).log_depth[4]
        for monocular in (1 / depth, None)
    )
    # Without any prediction it is the middle of the range.
    torch.testing.assert_close(blind, torch.full_like(blind, 2.0).log())
    both = torch.stack([known.flatten(), depth[4].log().flatten()])
    assert float(torch.corrcoef(both)[0, 1]) > 0.95
    assert (known - depth[4].log()).abs().median() < 0.2


def test_brightness_is_not_fitted_where_it_is_saturated(monkeypatch: pytest.MonkeyPatch) -> None:
    frames, _ = tilted_plane()
    frames.rgb[:, 0, 10:20, 20:30] = 1.0
    asked: list[torch.Tensor] = []

    def fitted(
        brightness: torch.Tensor, log_depth: torch.Tensor, sure: torch.Tensor, recording: torch.Tensor
    ):
        asked.append(sure)
        return fit_shading(brightness, log_depth, sure, recording)

    monkeypatch.setattr("extrags.depth.cues.fit_shading", fitted)
    sources = torch.tensor([[1, 2], [0, 2], [1, 3], [2, 4], [3, 2]])
    near, far = torch.full((5,), 0.8), torch.full((5,), 5.0)
    multi_view_stereo(frames, sources, near, far, StereoSettings(hypotheses=24, radius_px=2))
    assert asked[0].float().mean() > 0.2
    assert not asked[0][:, 10:20, 20:30].any()


def test_sources_lie_on_both_sides_and_share_the_view() -> None:
    frames, _ = tilted_plane(views=9)
    poses, K = frames.world_from_camera.double().numpy(), frames.K.double().numpy()
    poses[8, :3, :3] = np.diag([-1.0, 1.0, -1.0])  # looks the other way
    chosen = select_sources(poses, K, frames.size, np.full(9, 2.0), 4)
    assert {int(np.sign(other - 4)) for other in chosen[4] if other >= 0} == {-1, 1}
    assert 8 not in chosen[:8]
    assert (chosen[8] == -1).all()
    still = np.repeat(poses[:1], 4, axis=0)
    assert (select_sources(still, K[:4], frames.size, np.full(4, 2.0), 2) == -1).all()


def test_a_frame_without_sources_matches_nothing_with_both() -> None:
    frames, _ = tilted_plane()
    case = _case() | {"sources": torch.tensor([[1, 3], [-1, -1]])}
    for kernels in (matching, native):
        cost = kernels.matching_cost(frames, **case)
        assert (cost[1] == 1).all()
        assert cost[0].std() > 0.1


def test_images_too_small_for_stereo_are_refused() -> None:
    cameras, _, _, _ = plane_views(2, 1, 9)
    frames = PosedFrames(
        torch.zeros(2, 3, 9, 1),
        torch.ones(2, 9, 1, dtype=torch.bool),
        torch.from_numpy(cameras.K).float(),
        torch.from_numpy(cameras.world_from_camera).float(),
    )
    with pytest.raises(ShapeError, match="images of 1x9 pixels are too small for stereo"):
        multi_view_stereo(frames, torch.tensor([[1], [0]]), torch.ones(2), 2 * torch.ones(2))
