from __future__ import annotations

import numpy as np
import pytest

from data_catalog.phantom import pretraining
from data_catalog.phantom.config import PhantomConfig
from data_catalog.phantom.pretraining import (
    FIRST_PRETRAINING_SCENE,
    pretraining_recording,
    pretraining_scene_config,
)
from data_catalog.phantom.recording import Phantom
from data_catalog.phantom.variation import Variation, vary
from extrags.cameras import rotation_angle_deg
from extrags.restoration.training_data.recordings import PretrainingRecording


def test_without_variation_a_scene_is_the_standard_colon() -> None:
    assert vary(PhantomConfig(scene=3)) == Variation()


def test_variation_grows_from_the_standard_and_differs_from_scene_to_scene() -> None:
    standard = Variation()
    little, much = (vary(PhantomConfig(scene=7, variation=share)) for share in (1e-6, 1.0))
    assert little.gamma == pytest.approx(standard.gamma, rel=1e-5)
    assert little.tint == pytest.approx(standard.tint, rel=1e-5)
    others = [vary(PhantomConfig(scene=scene, variation=1.0)) for scene in range(7, 12)]
    assert len({other.gamma for other in others}) == 5
    assert much == others[0]
    # The bends never get tighter than those that keep the wall from folding over itself.
    assert all(other.curvature <= 1 for other in others)


def test_pretraining_scenes_are_none_of_the_catalogue() -> None:
    configs = [pretraining_scene_config(index) for index in range(40)]
    assert min(config.scene for config in configs) == FIRST_PRETRAINING_SCENE
    assert len({config.scene for config in configs}) == 40
    assert len({config.field_of_view_deg for config in configs}) == 40
    assert configs[5] == pretraining_scene_config(5)


@pytest.fixture(scope="module")
def recording() -> PretrainingRecording:
    return small_recording()


def small_recording(*, to_restore: bool = True) -> PretrainingRecording:
    ordinary = pretraining_scene_config(2)
    reduced = ordinary.model_copy(update={"width": 48, "height": 40, "supersample": 1, "train_every": 50})
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(pretraining, "pretraining_scene_config", lambda index: reduced)
        return pretraining_recording(2, to_restore=to_restore)


def test_without_views_to_restore_it_trains_on_the_same(recording: PretrainingRecording) -> None:
    whole, alone = recording.sequence, small_recording(to_restore=False)
    assert len(alone.sequence.test) == len(alone.clip) == 0
    assert np.array_equal(alone.sequence.rgb, whole.rgb[whole.train])
    assert whole.depth_mm is not None
    depth_mm = alone.z_depth_mm(whole.cameras[7])
    assert np.array_equal(np.where(np.isfinite(depth_mm), depth_mm, 0), whole.depth_mm[7])


def test_any_view_is_photographed_as_those_to_restore_are(recording: PretrainingRecording) -> None:
    whole = recording.sequence
    view = int(whole.test[3])
    assert np.array_equal(recording.photograph(whole.cameras[view]), whole.rgb[view])


def test_every_frame_has_its_exposure(recording: PretrainingRecording) -> None:
    exposure = np.array(recording.sequence.truth["exposure"])
    assert len(exposure) == len(recording.sequence)
    assert (exposure[recording.sequence.test] == 1).all()


def test_what_is_to_be_restored_is_not_trained_on(recording: PretrainingRecording) -> None:
    small = recording.sequence
    assert len(small.train) == 4
    assert len(small.test) == 50
    assert small.depth_mm is not None
    assert (small.depth_mm[small.test] > 0).all()
    assert small.rgb[small.test].mean() > 20
    cameras = small.cameras
    distance = np.linalg.norm(
        cameras.centers[small.test][:, None] - cameras.centers[small.train][None], axis=2
    )
    assert np.median(distance.min(axis=1)) > 2


def test_the_views_of_a_clip_follow_each_other(recording: PretrainingRecording) -> None:
    small = recording.sequence
    assert recording.clip.tolist() == np.repeat(np.arange(10), 5).tolist()
    poses = small.cameras.world_from_camera[small.test].reshape(10, 5, 4, 4)
    assert np.linalg.norm(np.diff(poses[:, :, :3, 3], axis=1), axis=2).max() < 4
    turned = rotation_angle_deg(poses[:, 1:, :3, :3], poses[:, :-1, :3, :3])
    assert turned.max() < 40
    # From clip to clip it is another place.
    assert np.linalg.norm(np.diff(poses[:, 0, :3, 3], axis=0), axis=1).max() > 10


def test_depth_is_exact(recording: PretrainingRecording) -> None:
    small = recording.sequence
    phantom = Phantom(PhantomConfig(**small.truth["phantom"]))
    assert small.depth_mm is not None
    for frame in (int(small.train[1]), int(small.test[3])):
        np.testing.assert_array_equal(small.depth_mm[frame], phantom.z_depth(small.cameras[frame]))
