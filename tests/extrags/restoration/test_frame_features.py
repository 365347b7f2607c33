from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
import torch

from data_catalog.phantom.imaging import recording_sensor
from data_catalog.phantom.pretraining import pretraining_scene_config
from data_catalog.phantom.recording import TRAINS, Phantom
from extrags.restoration.diffusion.embedded import EmbeddedEnhancer
from extrags.restoration.diffusion.frame_features import FRAMES, frame_features, sequence_features
from extrags.restoration.diffusion.network import RestorationNetwork
from extrags.restoration.diffusion.weights import COLONS, starting_weights
from tests.extrags.lit_tube import Tube


@pytest.fixture(scope="module")
def bundled() -> EmbeddedEnhancer:
    return EmbeddedEnhancer.load(starting_weights(COLONS))


@pytest.fixture(scope="module")
def network(bundled: EmbeddedEnhancer) -> RestorationNetwork:
    return bundled.network


def photographs(tube: Tube, count: int = 3) -> tuple[torch.Tensor, torch.Tensor]:
    rgb = torch.from_numpy(tube.sequence.rgb[:count]).permute(0, 3, 1, 2).float() / 255
    return rgb, torch.ones(count, *rgb.shape[2:], dtype=torch.bool)


def score_of(bundled: EmbeddedEnhancer, *images: np.ndarray) -> float:
    assert bundled.domain is not None
    rgb = torch.from_numpy(np.stack(images)).permute(0, 3, 1, 2).float() / 255
    valid = torch.ones(len(rgb), *rgb.shape[2:], dtype=torch.bool)
    return bundled.domain.score(frame_features(bundled.network, rgb, valid))


class TestFrameFeatures:
    def test_each_frame_has_its_own(self, network: RestorationNetwork, tube: Tube) -> None:
        rgb, valid = photographs(tube)
        together = frame_features(network, rgb, valid)
        assert together.shape == (3, 2 * network.widths[-1])
        alone = [frame_features(network, rgb[[k]], valid[[k]])[0] for k in range(3)]
        np.testing.assert_array_equal(together, alone)

    def test_what_is_no_tissue_is_not_looked_at(self, network: RestorationNetwork, tube: Tube) -> None:
        rgb, valid = photographs(tube, 1)
        valid[:, :, : valid.shape[2] // 2] = False
        other = torch.where(valid[:, None], rgb, 1 - rgb)
        np.testing.assert_array_equal(
            frame_features(network, rgb, valid), frame_features(network, other, valid)
        )

    def test_the_same_picture_in_larger_pixels_is_the_same(self, network: RestorationNetwork) -> None:
        rgb = torch.rand(1, 3, 128, 160, generator=torch.Generator().manual_seed(0))
        large = rgb.repeat_interleave(2, dim=2).repeat_interleave(2, dim=3)
        small, other = (
            frame_features(network, one, torch.ones(1, *one.shape[2:], dtype=torch.bool))
            for one in (rgb, large)
        )
        np.testing.assert_allclose(small, other, rtol=0, atol=1e-4)

    @pytest.mark.parametrize("size", [(7, 64), (64, 7), (1, 1)])
    def test_frames_too_small_for_the_network_have_none(
        self, network: RestorationNetwork, size: tuple[int, int]
    ) -> None:
        found = frame_features(network, torch.rand(2, 3, *size), torch.ones(2, *size, dtype=torch.bool))
        assert found.shape == (0, 2 * network.widths[-1])

    def test_frames_without_tissue_are_left_out(self, network: RestorationNetwork, tube: Tube) -> None:
        rgb, valid = photographs(tube)
        valid[1] = False
        found = frame_features(network, rgb, valid)
        np.testing.assert_array_equal(found, frame_features(network, rgb[[0, 2]], valid[[0, 2]]))

    def test_of_a_sequence_training_frames_count(self, network: RestorationNetwork, tube: Tube) -> None:
        sequence = tube.sequence
        train = np.asarray(sequence.train)
        assert 1 < len(train) <= FRAMES
        rgb = torch.from_numpy(sequence.rgb[train]).permute(0, 3, 1, 2).float() / 255
        expected = frame_features(network, rgb, torch.from_numpy(sequence.mask[train]))
        np.testing.assert_array_equal(sequence_features(network, sequence), expected)

    def test_the_same_bits_with_any_number_of_threads(self, network: RestorationNetwork, tube: Tube) -> None:
        rgb, valid = photographs(tube)
        threads = torch.get_num_threads()
        found = []
        try:
            for count in (1, 2):
                torch.set_num_threads(count)
                found.append(frame_features(network, rgb, valid))
        finally:
            torch.set_num_threads(threads)
        np.testing.assert_array_equal(*found)


class TestBundledDomain:
    """What the packaged restorer knows, and says that it does not."""

    def test_a_colon_of_its_family_is_inside(self, bundled: EmbeddedEnhancer) -> None:
        # Of no scene that anything was fitted to.
        config = pretraining_scene_config(3000)
        phantom = Phantom(config)
        sensor = recording_sensor(config, TRAINS, phantom.scene_gain())
        cameras = phantom.cameras("b", np.linspace(0.1, 0.9, 3))
        images = [phantom.photograph(cameras[k], sensor, TRAINS, k)[0] for k in range(3)]
        assert score_of(bundled, *images) < 1

    def test_noise_is_outside(self, bundled: EmbeddedEnhancer) -> None:
        noise = np.random.default_rng(0).integers(0, 255, (128, 160, 3), dtype=np.uint8)
        assert score_of(bundled, noise) > 1.5

    def test_real_laparoscopy_is_outside(self, bundled: EmbeddedEnhancer, shared_data: Path) -> None:
        files = sorted((shared_data / "laparoscopy_frames_40").glob("*.jpg"))[::8]
        if not files:
            pytest.skip("no laparoscopy_frames_40")
        for file in files:
            image = cv2.imread(str(file))
            assert image is not None
            assert score_of(bundled, image[..., ::-1]) > 1, file.name

    def test_a_scene_is_told_how_far_it_is(self, bundled: EmbeddedEnhancer, tube: Tube) -> None:
        assert bundled.domain is not None
        told = bundled.with_domain_score(tube.sequence)
        expected = bundled.domain.score(sequence_features(bundled.network, tube.sequence))
        assert told.provenance["domain_score"] == expected
        unknown = replace(bundled, domain=None)
        assert unknown.with_domain_score(tube.sequence) is unknown

    def test_outside_errors_are_expected_larger_unless_frames_have_told_them(
        self, bundled: EmbeddedEnhancer
    ) -> None:
        assert replace(bundled, domain_score=0.5).modesty == 1
        assert replace(bundled, domain_score=2.0).modesty == 2
        assert replace(bundled, domain_score=50.0).modesty == 3
        assert replace(bundled, domain_score=2.0, scene_calibrated=True).modesty == 1
