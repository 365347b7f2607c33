"""The completion network, its loss, and its pretraining on a tiny scale."""

from __future__ import annotations

import copy
from dataclasses import replace

import pytest
import torch

from extrags.depth.completion import (
    INPUT_CHANNELS,
    SHADING,
    STEREO,
    CompletionNetwork,
    completion_inputs,
    completion_loss,
)
from extrags.depth.pretraining import cavities, photographs
from extrags.depth.pretraining import examples as practice
from extrags.depth.pretraining.cavities import KINDS, Cavities, Kind
from extrags.depth.pretraining.examples import make_examples
from extrags.depth.pretraining.photographs import photograph
from extrags.depth.pretraining.points import triangulated_points
from extrags.depth.pretraining.sensor import compressed
from extrags.depth.pretraining.training import (
    CompletionTraining,
    ExampleBank,
    matched,
    mix_weights,
    score,
    train_completion,
    unmatched,
)
from extrags.depth.stereo import StereoSettings, multi_view_stereo
from extrags.depth.weights import load_completion
from tests.extrags.depth.planes import tilted_plane


def test_an_untrained_network_believes_stereo() -> None:
    channels = torch.zeros(1, INPUT_CHANNELS, 21, 34)
    channels[:, STEREO] = 0.7
    log_depth, log_error = CompletionNetwork()(channels)
    assert log_depth.shape == log_error.shape == (1, 21, 34)
    weights = torch.softmax(torch.tensor([2.0, 0.0, -2.0]), 0)
    assert torch.allclose(log_depth, 0.7 * weights[0].expand_as(log_depth), atol=1e-5)


def test_loss_of_a_constant_error() -> None:
    truth, mask = torch.zeros(1, 8, 8), torch.ones(1, 8, 8)
    terms = completion_loss(truth + 0.2, torch.full_like(truth, -1.0), truth, mask)
    assert float(terms["depth"]) == pytest.approx(0.2)
    assert float(terms["slope"]) == pytest.approx(0, abs=1e-6)
    assert float(terms["error"]) == pytest.approx(0.2 * torch.e - 1, rel=1e-5)
    hidden = completion_loss(truth + 0.2, truth, truth, torch.zeros_like(mask))
    assert float(hidden["depth"]) == 0


def test_what_is_unknown_has_no_slope() -> None:
    truth, mask = torch.zeros(1, 8, 8), torch.ones(1, 8, 8)
    mask[..., 4:] = 0
    terms = completion_loss(truth + 0.2, truth, truth, mask)
    assert float(terms["depth"]) == pytest.approx(0.2)
    assert float(terms["slope"]) == pytest.approx(0, abs=1e-6)


def test_brightness_that_could_not_be_fitted_predicts_nothing() -> None:
    frames, _ = tilted_plane()
    sources = torch.tensor([[1, 2], [0, 2], [1, 3], [2, 4], [3, 2]])
    near, far = torch.full((5,), 0.8), torch.full((5,), 5.0)
    stereo = multi_view_stereo(frames, sources, near, far, StereoSettings(hypotheses=16, radius_px=2))
    prior = torch.full_like(stereo.prior, 2.0)
    for scatter, known in ((0.1, True), (torch.inf, False)):
        fitted = replace(stereo, prior=prior, prior_scatter=torch.full_like(stereo.prior_scatter, scatter))
        found = completion_inputs(frames, fitted).channels[:, SHADING]
        assert bool((found != 0).any()) == known


def test_expected_error_does_not_move_the_depth() -> None:
    depth = torch.full((1, 4, 4), 0.3, requires_grad=True)
    terms = completion_loss(depth, torch.zeros(1, 4, 4), torch.zeros(1, 4, 4), torch.ones(1, 4, 4))
    assert not terms["error"].requires_grad


@pytest.mark.parametrize("kind", KINDS)
def test_photographed_depth_lies_on_the_surface(kind: Kind) -> None:
    generator = torch.Generator().manual_seed(11)
    scene = Cavities(kind, 4, generator)
    clips = photograph(scene, generator, (48, 64), 2)
    for row, depth in enumerate(clips.depth):
        pose = clips.frames.world_from_camera[row]
        local = (clips.frames.rays[row] * depth).flatten(1).T[depth.flatten() > 0]
        scene.moment = float(row % clips.views)
        # Clips that touch a wall are left out: the number of a clip need not be that of its scene. A row too
        # high or too low, depth would be .005 to .04 off.
        off = scene.clearance((local @ pose[:3, :3].T + pose[:3, 3]).expand(4, -1, -1)).abs()
        assert float(off.median(dim=1).values.min()) < 0.003


@pytest.mark.parametrize("kind", KINDS)
def test_photographs_are_whole_and_the_same_each_time(kind: Kind) -> None:
    generator = torch.Generator().manual_seed(11)
    scene = Cavities(kind, 4, generator)
    clips = photograph(scene, generator, (16, 24), 2)
    assert len(clips.depth) == 2 * len(clips.clip.unique())
    assert len(clips.depth) >= 2
    known = clips.frames.mask
    assert ((clips.depth > 0) | ~known).all()
    assert torch.isfinite(clips.frames.rgb).all()
    # The same seed makes the same clips.
    generator = torch.Generator().manual_seed(11)
    again = photograph(Cavities(kind, 4, generator), generator, (16, 24), 2)
    assert torch.equal(again.depth, clips.depth)
    assert torch.equal(again.frames.rgb, clips.frames.rgb)


def test_training_lowers_the_error_on_what_it_is_shown() -> None:
    generator = torch.Generator().manual_seed(3)
    settings = StereoSettings(hypotheses=24, radius_px=2, refinement_hypotheses=5)
    examples = make_examples("sac", 2, generator, (24, 32), settings)
    assert examples is not None
    bank = ExampleBank(generator)
    bank.add(examples)
    before = score(CompletionNetwork(), [examples])
    heard: list[int] = []
    torch.manual_seed(0)
    network = train_completion(
        bank, CompletionTraining(iterations=100, batch=2), told=lambda done, means: heard.append(done)
    )
    after = score(network, [examples])
    assert heard == [100]
    assert after.absrel < 0.8 * before.absrel


def test_bundled_weights_complete_unseen_cavities() -> None:
    """Scenes drawn with another seed than any of the training."""
    network = load_completion("bundled")
    assert network is not None
    generator = torch.Generator().manual_seed(990)
    examples = make_examples("sac", 3, generator, (64, 80), StereoSettings(hypotheses=48))
    assert examples is not None
    found = score(network, [examples])
    assert found.absrel < 0.6 * found.stereo_absrel
    assert found.rank_correlation > 0.2
    assert 0.5 < found.calibration < 2
    # Blind to stereo, it is worse, and expects to be.
    channels = examples.channels.clone()
    channels[:, STEREO] = 0
    channels[:, 5:11] = 0
    blind = score(network, [replace(examples, channels=channels)])
    assert blind.absrel > found.absrel


@pytest.mark.slow
def test_single_frames_are_told_to_be_as_wrong_as_they_are(monkeypatch: pytest.MonkeyPatch) -> None:
    """Weights that never practised single frames are .31 off here and expect .12."""
    monkeypatch.setattr(practice, "SINGLE_SHARE", 1.0)
    network = load_completion("bundled")
    assert network is not None
    generator = torch.Generator().manual_seed(991)
    groups = []
    for kind in ("colon", "sac", "field"):
        examples = make_examples(kind, 2, generator, (48, 64), StereoSettings(hypotheses=16))
        assert examples is not None
        assert not len(matched([examples])[0].truth)
        groups += unmatched([examples])
    found = score(network, groups)
    assert found.absrel < 0.25
    assert 0.5 < found.calibration < 2


def test_the_second_sweep_is_practised_too() -> None:
    settings = StereoSettings(hypotheses=16, refinement_hypotheses=5)
    made = [
        make_examples("sac", 2, torch.Generator().manual_seed(3), (32, 48), settings, network)
        for network in (None, CompletionNetwork())
    ]
    once, twice = made
    assert once is not None
    assert twice is not None
    frames = len(once.truth)
    assert len(twice.truth) == 2 * frames
    assert torch.equal(twice.channels[:frames], once.channels)
    assert not torch.equal(twice.channels[frames:, STEREO], once.channels[:, STEREO])


def test_points_lie_on_the_surface_but_for_their_error() -> None:
    generator = torch.Generator().manual_seed(8)
    scene = Cavities("field", 4, generator)
    clips = photograph(scene, generator, (36, 48), 5)
    points = triangulated_points(clips, scene)
    there = (points > 0) & clips.frames.mask
    assert there.sum() > 100
    assert not points[~clips.frames.mask].any()
    error = torch.log(points[there] / clips.depth[there]).abs()
    assert 0.002 < float(error.median()) < 0.1


def test_tissue_moves_in_some_scenes() -> None:
    scene = Cavities("sac", 40, torch.Generator().manual_seed(2))
    points = torch.rand(40, 5, 3, generator=torch.Generator().manual_seed(3))
    still = scene.pulse_height[:, 0] == 0
    assert 0 < int((~still).sum()) < 20
    scene.moment = 2.0
    moved = (scene.at_rest(points) - points).norm(dim=2).amax(dim=1)
    assert not moved[still].any()
    assert (moved[~still] > 0).all()


def test_rods_are_of_one_colour_all_over(monkeypatch: pytest.MonkeyPatch) -> None:
    """Bumps swell a rod, and in some scenes it moves with the tissue."""
    monkeypatch.setattr(cavities, "MOVING_SHARE", 0.5)
    scene = Cavities("field", 24, torch.Generator().manual_seed(1))
    monkeypatch.setattr(photographs._Mucosa, "albedo", lambda mucosa, points: torch.full_like(points, 0.99))
    scene.moment = 2.0
    mucosa, lamps = photographs._Mucosa(scene, scene.generator), photographs._Lamps(scene)
    lamps.shine, lamps.fixed = torch.zeros(24, 1), torch.ones(24, 1)
    poses = scene.camera_paths(3)[:, 2]
    x, y = torch.meshgrid(torch.linspace(-0.8, 0.8, 40), torch.linspace(-0.8, 0.8, 40), indexing="ij")
    local = torch.stack([x.flatten(), y.flatten(), torch.ones(1600)], dim=1).expand(24, -1, -1)
    directions = local @ poses[:, :3, :3].transpose(1, 2)
    z, hit = photographs._march(scene, poses[:, :3, 3], directions)
    points = poses[:, None, :3, 3] + z[:, :, None] * directions
    light = lamps.radiance(scene, mucosa, points, poses[:, :3, :3], poses[:, :3, 3])[:, :, 0]
    sun = torch.nn.functional.normalize(lamps.sun, dim=1)[:, None]
    facing = (photographs._normal(scene, points) * sun).sum(2)
    color = light / (0.6 + 0.4 * facing)
    # Without its rods a scene is free where they were.
    tissue = without_rods(scene)
    rod = hit & (tissue.clearance(points) > 1e-3)
    assert int(rod.sum()) > 1000
    wrong = (color - mucosa.rod_color[:, :1]).abs() > 1e-3
    assert not wrong[rod].any()
    on_tissue = hit & (tissue.clearance(points) < 1e-4)
    assert torch.allclose(color[on_tissue], torch.tensor(0.99), atol=1e-3)


def without_rods(scene: Cavities) -> Cavities:
    """The same scene without rods."""
    without = copy.copy(scene)
    point, direction, radius = scene.instruments
    without.instruments = (point, direction, -radius.abs() - 1e-6)
    return without


def test_compression_spoils_only_what_is_compressed() -> None:
    images = torch.rand(3, 3, 20, 28, generator=torch.Generator().manual_seed(4))
    loss = torch.tensor([0.0, 0.2, 1.0])
    wrong = (compressed(images, loss) - images).abs().mean(dim=(1, 2, 3))
    assert wrong[0] == 0
    assert 0 < wrong[1] < wrong[2] < 0.3
    flat = torch.full((1, 3, 16, 16), 0.5)
    assert torch.allclose(compressed(flat, torch.tensor([1.0])), flat, atol=0.02)


def test_weights_move_back_towards_the_start() -> None:
    network, start = CompletionNetwork(), CompletionNetwork().state_dict()
    before = {name: value.clone() for name, value in network.state_dict().items()}
    mix_weights(network, start, 0.25)
    for name, value in network.state_dict().items():
        assert torch.allclose(value, 0.75 * before[name] + 0.25 * start[name], atol=1e-6)
