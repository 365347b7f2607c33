"""Depth of a phantom's frames from the frames alone, beside what was withheld."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

from extrags.config import DepthConfig
from extrags.depth import estimate as depth_estimate
from extrags.depth.completion import CompletionNetwork
from extrags.depth.estimate import DepthEstimate, estimate_depth, posed_frames
from extrags.depth.frames import PosedFrames
from extrags.depth.stereo import StereoDepth, StereoSettings, multi_view_stereo
from extrags.errors import CaptureError, ConfigError
from extrags.events import Progress, subscribed
from extrags.sequence import EndoscopicSequence, Split
from extrags.stress.inputs import plane_views
from tests.extrags.depth.planes import tilted_plane
from tests.extrags.depth.withheld import true_training_depth, with_points, withheld_phantom

SETTINGS = {"hypotheses": 48, "sources": 4}


@pytest.fixture(scope="module")
def withheld() -> EndoscopicSequence:
    return with_points(withheld_phantom())


@pytest.fixture(scope="module")
def estimate(withheld: EndoscopicSequence) -> DepthEstimate:
    return estimate_depth(withheld.training_part(), DepthConfig(**SETTINGS))


def relative_error(sequence: EndoscopicSequence, estimate: DepthEstimate) -> np.ndarray:
    """Of the pixels whose truth is known."""
    truth, mask = true_training_depth(sequence), sequence.mask[sequence.train]
    known = (truth > 0) & mask
    return np.abs(estimate.depth - truth)[known] / truth[known]


def test_it_is_near_the_truth(withheld: EndoscopicSequence, estimate: DepthEstimate) -> None:
    error = relative_error(withheld, estimate)
    assert error.mean() < 0.12
    assert np.median(error) < 0.04
    assert not (estimate.depth[~withheld.mask[withheld.train]]).any()
    assert estimate.report["points_from"] == "the source or the poses stage"
    assert f"{estimate.report['n_points']} points" in estimate.summary


def test_points_behind_all_cameras_are_refused(withheld: EndoscopicSequence) -> None:
    training = withheld.training_part().at_most_width(16)
    behind = training.cameras.centers[0] - 1e4 * training.cameras.world_from_camera[0, :3, 2]
    moved = replace(training, points=behind + np.random.default_rng(0).normal(size=(20, 3)), points_rgb=None)
    with pytest.raises(CaptureError, match=r"all 20 sparse points lie behind all \d+ cameras"):
        estimate_depth(moved, DepthConfig(**SETTINGS))


def test_it_knows_where_it_is_wrong(withheld: EndoscopicSequence, estimate: DepthEstimate) -> None:
    error = relative_error(withheld, estimate)
    known = (true_training_depth(withheld) > 0) & withheld.mask[withheld.train]
    expected = estimate.expected_error[known]
    assert 0 < expected.min() <= expected.max() <= 1
    surer = expected <= np.median(expected)
    assert error[surer].mean() < 0.4 * error[~surer].mean()
    assert estimate.report["median_expected_error"] == pytest.approx(np.median(expected), rel=0.05)


def test_the_median_is_of_all_valid_pixels(withheld: EndoscopicSequence, estimate: DepthEstimate) -> None:
    mask = withheld.mask[withheld.train]
    expected = estimate.expected_error[mask]
    assert estimate.report["median_expected_error"] == float(np.median(expected))
    assert not estimate.expected_error[~mask].any()


def test_stereo_alone_is_farther_off(withheld: EndoscopicSequence, estimate: DepthEstimate) -> None:
    plain = estimate_depth(withheld.training_part(), DepthConfig(completion="none", **SETTINGS))
    completed, alone = relative_error(withheld, estimate), relative_error(withheld, plain)
    assert np.median(alone) < 0.1
    assert completed.mean() < 0.5 * alone.mean()
    assert plain.report["completion"] == "none"


def test_a_gpu_gives_that_of_a_processor(device: str, specification: Callable[[], None]) -> None:
    """On the processor, torch's implementation stands in for what runs on a GPU."""
    small = with_points(withheld_phantom(6, width=64, height=48))
    part = small.training_part()
    settings = [
        DepthConfig(device="cpu", completion=completion, hypotheses=24, sources=3)
        for completion in ("none", "bundled")
    ]
    expected = [estimate_depth(part, each) for each in settings]
    specification()
    there = [each.model_copy(update={"device": device}) for each in settings]
    found = [estimate_depth(part, each) for each in there]
    assert {each.report["device"] for each in expected} == {"cpu"}
    assert {each.report["device"] for each in found} == {device}
    # Rounding moves most depths of stereo by less than a thousandth. Where two depths match nearly equally
    # well it decides between them: between two implementations on a processor one to three in a hundred of
    # these pixels move by more than a percent.
    away = np.abs(np.log(found[0].depth[part.mask] / expected[0].depth[part.mask]))
    assert np.median(away) < 1e-3
    assert (away > 0.01).mean() < 0.04
    # The completion looks far around such a pixel, and carries it on into others, on some processors more
    # than on others: it is no nearer to the truth and no farther.
    for own, true in zip(found, expected, strict=True):
        assert relative_error(small, own).mean() == pytest.approx(
            relative_error(small, true).mean(), rel=0.03
        )
    again = estimate_depth(part, there[1]) if device == "cuda" else found[1]
    np.testing.assert_array_equal(again.depth, found[1].depth)


def test_cuda_that_is_not_there_is_refused(
    withheld: EndoscopicSequence, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("torch.cuda.is_available", lambda: False)
    with pytest.raises(ConfigError, match=r"depth\.device=cuda"):
        estimate_depth(withheld.training_part(), DepthConfig(device="cuda"))


def test_without_points_they_are_triangulated() -> None:
    sequence = withheld_phantom()
    found = estimate_depth(sequence.training_part(), DepthConfig(**SETTINGS))
    assert found.report["points_from"] == "triangulation with the given poses"
    assert len(found.points) == len(found.points_rgb) == found.report["n_points"] > 50
    assert np.median(relative_error(sequence, found)) < 0.1


def test_without_any_points_the_cameras_tell_the_range(caplog: pytest.LogCaptureFixture) -> None:
    part = withheld_phantom(4, width=48, height=40).training_part()
    with caplog.at_level("WARNING"):
        found = estimate_depth(part, DepthConfig(triangulate=False, hypotheses=16, completion="none"))
    assert "guessed from the cameras' motion" in caplog.text
    assert len(found.points) == 0
    assert (found.depth[part.mask] > 0).all()


def test_what_features_tell_against_the_poses_stays_with_the_depth(
    withheld: EndoscopicSequence, monkeypatch: pytest.MonkeyPatch
) -> None:
    from extrags.poses import triangulation

    training = withheld.training_part().at_most_width(32)
    told = "the poses explain 34 % of 900 feature matches"

    def contradicted(sequence: EndoscopicSequence, _: object) -> triangulation.Triangulation:
        found = triangulation._assessed(sequence, triangulation._no_points(sequence))
        return replace(found, report={**found.report, "contradiction": told})

    monkeypatch.setattr(depth_estimate, "triangulate_points", contradicted)
    found = estimate_depth(replace(training, points=None, points_rgb=None), DepthConfig(**SETTINGS))
    assert found.report["contradiction"] == told
    assert found.summary.endswith(f"confirmed by other frames; {told}")


def test_wide_frames_are_matched_small(withheld: EndoscopicSequence) -> None:
    part = withheld.training_part()
    small = replace(part.at_most_width(48), split=part.split)
    settings = DepthConfig(max_width=48, completion="none", **SETTINGS)
    found = estimate_depth(part, settings)
    assert found.depth.shape == part.mask.shape
    expected = estimate_depth(small, settings)
    assert np.median(found.depth[part.mask]) == pytest.approx(np.median(expected.depth[small.mask]), rel=0.02)


def test_progress_and_the_same_result_again(withheld: EndoscopicSequence) -> None:
    part = withheld.training_part().at_most_width(48)
    seen: list[Progress] = []
    with subscribed(lambda event: seen.append(event) if isinstance(event, Progress) else None):
        first = estimate_depth(part, DepthConfig(**SETTINGS))
    assert {event.stage for event in seen} == {"depth"}
    assert seen[-1].done == seen[-1].total
    assert seen[-1].total % len(part) == 0
    again = estimate_depth(part, DepthConfig(**SETTINGS))
    np.testing.assert_array_equal(first.depth, again.depth)
    np.testing.assert_array_equal(first.expected_error, again.expected_error)


def test_on_disk_and_back(estimate: DepthEstimate, tmp_path: Path) -> None:
    estimate.save(tmp_path / "depth")
    loaded = DepthEstimate.load(tmp_path / "depth")
    for name in ("depth", "expected_error", "points", "points_rgb"):
        np.testing.assert_array_equal(getattr(loaded, name), getattr(estimate, name))
    assert loaded.summary == estimate.summary


def test_a_single_frame_is_refused(withheld: EndoscopicSequence) -> None:
    one = replace(withheld, split=Split("one", withheld.train[:1], withheld.train[1:])).training_part()
    with pytest.raises(CaptureError, match="needs at least two"):
        estimate_depth(one)


def test_a_frame_that_nothing_matches_is_told_to_be_a_guess(withheld: EndoscopicSequence) -> None:
    part = withheld.training_part()
    poses = part.cameras.world_from_camera.copy()
    poses[0, :3, :3] = poses[0, :3, :3] @ np.diag([-1.0, 1.0, -1.0])  # looks the other way
    found = estimate_depth(part.with_poses(poses), DepthConfig(**SETTINGS))
    assert found.report["frames_alone"] == 1
    true = true_training_depth(withheld)[0]
    known = (true > 0) & part.mask[0]
    expected = found.expected_error[0][known]
    ratio = true[known] / found.depth[0][known]
    scaled = np.abs(np.median(ratio) / ratio - 1)
    assert scaled.mean() < 0.2
    assert 0.5 < scaled.mean() / expected.mean() < 2
    assert expected.mean() > 2 * np.median(found.expected_error[1:][part.mask[1:]])
    assert np.median(found.expected_error[1:][part.mask[1:]]) < 0.1
    assert found.report == estimate_depth(part.with_poses(poses), DepthConfig(**SETTINGS)).report


def _plane_sequence() -> EndoscopicSequence:
    cameras, depth, _, _ = plane_views(3, 16, 12)
    return EndoscopicSequence(
        name="made/plane",
        rgb=np.zeros((*depth.shape, 3), np.uint8),
        K=cameras.K,
        mask=np.ones(depth.shape, dtype=bool),
        split=Split("made", np.arange(3), np.arange(0)),
        world_from_camera=cameras.world_from_camera,
    )


def test_far_from_the_origin_of_the_world() -> None:
    sequence = _plane_sequence()
    poses = sequence.cameras.world_from_camera.copy()
    poses[:, :3, 3] += 1e5
    here, there = (posed_frames(given) for given in (sequence, replace(sequence, world_from_camera=poses)))
    steps = [
        given.world_from_camera[1:, :3, 3] - given.world_from_camera[:1, :3, 3] for given in (here, there)
    ]
    torch.testing.assert_close(steps[1], steps[0], atol=1e-5, rtol=1e-5)


def test_a_frame_that_sees_far_points_alone_is_searched_nearer_too() -> None:
    poses = np.tile(np.eye(4), (2, 1, 1))
    poses[1, 0, 3] = 1000.0
    sequence = EndoscopicSequence(
        name="made/apart",
        rgb=np.zeros((2, 12, 16, 3), np.uint8),
        K=np.tile(np.array([[16.0, 0, 8], [0, 16.0, 6], [0, 0, 1]]), (2, 1, 1)),
        mask=np.ones((2, 12, 16), dtype=bool),
        split=Split("made", np.arange(2), np.arange(0)),
        world_from_camera=poses,
    )
    points = np.repeat([[0.0, 0.0, 10.0], [1000.0, 0.0, 50.0]], 20, axis=0)
    near, typical, far = depth_estimate._ranges(sequence, points, DepthConfig(range_margin=2.0))
    np.testing.assert_allclose(near, [5.0, 15.0])
    np.testing.assert_allclose(typical, [10.0, 50.0])
    # At least as far as what is typical of all.
    np.testing.assert_allclose(far, [60.0, 100.0])


@pytest.fixture(scope="module")
def plane_stereo() -> tuple[PosedFrames, StereoDepth]:
    frames, depth = tilted_plane()
    sources = torch.tensor([[1, 2], [0, 2], [1, 3], [2, 4], [3, 2]])
    near, far = torch.full((5,), 0.8), torch.full((5,), 5.0)
    settings = StereoSettings(hypotheses=16, radius_px=2)
    return frames, multi_view_stereo(frames, sources, near, far, settings, monocular=1 / depth)


def test_stereo_and_a_monocular_network_count_by_the_squares_of_their_errors(
    plane_stereo: tuple[PosedFrames, StereoDepth],
) -> None:
    _, stereo = plane_stereo
    unsure = replace(
        stereo,
        agrees=torch.zeros_like(stereo.agrees),
        prior=stereo.fused + 0.3,
        prior_scatter=torch.full_like(stereo.prior_scatter, 0.1),
    )
    log_depth, error = depth_estimate._with_fallback(unsure)
    # Errors of a half and of a tenth: 4 to 100.
    torch.testing.assert_close(log_depth - stereo.fused, torch.full_like(log_depth, 0.3 * 100 / 104))
    torch.testing.assert_close(error, torch.full_like(error, 104**-0.5))


def test_stereo_that_others_look_through_is_not_mixed_in(
    plane_stereo: tuple[PosedFrames, StereoDepth], monkeypatch: pytest.MonkeyPatch
) -> None:
    frames, stereo = plane_stereo
    ones = torch.ones_like(stereo.agrees)
    violates = torch.zeros_like(ones)
    violates[..., :20] = 1
    found = replace(stereo, agrees=ones, seen=ones, violates=violates)
    expected = stereo.fused - 0.1
    error = torch.full_like(expected, 0.2)
    sources = torch.tensor([[1, 2], [0, 2], [1, 3], [2, 4], [3, 2]])
    monkeypatch.setattr(depth_estimate, "_run_network", lambda *_: (expected, error))
    monkeypatch.setattr(depth_estimate, "_sources", lambda *_: sources)
    monkeypatch.setattr(depth_estimate, "sweep_around", lambda *_, **__: found)
    mixed, left, _ = depth_estimate._completed(
        CompletionNetwork(),
        frames,
        _plane_sequence(),
        stereo,
        DepthConfig(),
        StereoSettings(),
        depth_estimate._Told("depth", 6),
    )
    torch.testing.assert_close(mixed[..., :20], expected[..., :20])
    assert (mixed - expected)[..., 20:].min() > 0.05
    assert left[..., :20].min() > 1.5 * left[..., 20:].max()
