"""Sequences from arrays in memory, and what entry points say to arguments that cannot be right."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

import extrags
from extrags.cameras import Cameras, look_at
from extrags.errors import ConfigError, ExtragsError, PoseError, ShapeError, SourceError
from extrags.gaussians import Gaussians
from extrags.in_memory_pipeline import InMemoryPipeline
from extrags.metrics.image import ssim
from extrags.metrics.protocol import RenderedViews
from extrags.radial_lens import RadialLens
from extrags.scene import Scene
from extrags.sequence import EndoscopicSequence, Split
from extrags.sequence_checks import SMALLEST_SIDE_PX, check_arrays

FRAMES, HEIGHT, WIDTH = 10, 12, 16
K = np.array([[14.0, 0, 8], [0, 14.0, 6], [0, 0, 1]])


def arrays() -> dict[str, Any]:
    generator = np.random.default_rng(0)
    centres = np.linspace([0.0, 0, -20], [4.0, 0, -18], FRAMES)
    return {
        "rgb": generator.integers(0, 255, (FRAMES, HEIGHT, WIDTH, 3), dtype=np.uint8),
        "K": K,
        "world_from_camera": np.stack([look_at(c, np.zeros(3), np.array([0, -1.0, 0])) for c in centres]),
        "depth_mm": generator.uniform(10, 20, (FRAMES, HEIGHT, WIDTH)),
    }


def changed(array: np.ndarray, index: Any, value: Any) -> np.ndarray:
    other = array.copy()
    other[index] = value
    return other


def test_the_smallest_frames_are_those_that_can_be_evaluated() -> None:
    side = SMALLEST_SIDE_PX
    assert ssim(torch.zeros(side, side, 3), torch.zeros(side, side, 3)) == pytest.approx(1)
    too_small = np.zeros((FRAMES, side, side - 1, 3), np.uint8)
    with pytest.raises(SourceError, match="field rgb: frames of 5 x 6 px; expected at least 6 px a side"):
        extrags.sequence_from_arrays(too_small, K)
    with pytest.raises(ShapeError, match="SSIM needs images larger"):
        ssim(torch.zeros(side, side - 1, 3), torch.zeros(side, side - 1, 3))


def test_a_lens_has_its_axis_in_the_image() -> None:
    """There is no pinhole about another."""
    sequence = replace(
        extrags.sequence_from_arrays(arrays()["rgb"], K), lens=RadialLens((0.0, 0.0, 0.0, 0.0), 1.0)
    )
    check_arrays(sequence)
    for x, y in ((-1.0, 6.0), (8.0, 12.5)):
        beside = np.tile(np.array([[14.0, 0, x], [0, 14.0, y], [0, 0, 1]]), (FRAMES, 1, 1))
        check_arrays(replace(sequence, K=beside, lens=None))
        with pytest.raises(SourceError, match=r"field K: the axis of the lens, at .* lies outside"):
            check_arrays(replace(sequence, K=beside))


class TestFromArrays:
    def test_what_is_not_said(self) -> None:
        given = arrays()
        sequence = extrags.sequence_from_arrays(given["rgb"], K)
        assert sequence.rgb is given["rgb"]
        assert sequence.K.shape == (FRAMES, 3, 3)
        assert sequence.mask.all()
        assert (sequence.world_from_camera, sequence.depth_mm, sequence.metric) == (None, None, False)
        np.testing.assert_array_equal(sequence.test, [0, 8])
        np.testing.assert_array_equal(sequence.train, [1, 2, 3, 4, 5, 6, 7, 9])
        assert (sequence.split.name, sequence.frame_name(3)) == ("every8", "0003")

    def test_what_is_said_is_taken(self) -> None:
        given = arrays()
        split = Split("mine", np.arange(4), np.arange(4, 6))
        mask = np.ones((HEIGHT, WIDTH), bool)
        mask[0] = False
        specular = np.zeros((FRAMES, HEIGHT, WIDTH), bool)
        sequence = extrags.sequence_from_arrays(
            **given, mask=mask, specular=specular, split=split, name="mine/0", metric=True
        )
        assert (sequence.split, sequence.name, sequence.metric) == (split, "mine/0", True)
        assert not sequence.mask[:, 0].any()
        assert sequence.mask[:, 1:].all()
        assert sequence.specular is specular
        assert sequence.world_from_camera is not None
        np.testing.assert_allclose(sequence.world_from_camera, given["world_from_camera"], atol=1e-12)
        assert sequence.depth_mm is not None
        assert sequence.depth_mm.dtype == np.float32

    def test_it_goes_through_a_file(self, tmp_path: Path) -> None:
        """The mask is one array seen from all frames, and intrinsics were integers."""
        given = arrays()
        whole = extrags.sequence_from_arrays(
            **{**given, "K": K.astype(np.int64)}, mask=np.ones((12, 16), bool)
        )
        whole.save(tmp_path / "sequence")
        np.testing.assert_array_equal(EndoscopicSequence.load(tmp_path / "sequence").mask, whole.mask)
        assert len(whole.training_part()) == 8

    def test_floats_are_rounded_to_bytes(self) -> None:
        given = arrays()
        floats = given["rgb"].astype(np.float32) / 255
        np.testing.assert_array_equal(extrags.sequence_from_arrays(floats, K).rgb, given["rgb"])

    def test_gaps_in_depth_are_unknown(self) -> None:
        depth = changed(arrays()["depth_mm"], (0, 0, slice(0, 4)), [np.nan, np.inf, 0, 1e10])
        found = extrags.sequence_from_arrays(**{**arrays(), "depth_mm": depth}).depth_mm
        assert found is not None
        np.testing.assert_array_equal(found[0, 0, :4], 0)
        assert (found[1:] > 0).all()

    def test_depth_in_integers(self) -> None:
        depth = np.full((FRAMES, HEIGHT, WIDTH), 12, np.uint16)
        found = extrags.sequence_from_arrays(**{**arrays(), "depth_mm": depth}).depth_mm
        assert found is not None
        assert (found == 12).all()

    def test_one_frame_trains(self) -> None:
        sequence = extrags.sequence_from_arrays(arrays()["rgb"][:1], K)
        assert (list(sequence.train), list(sequence.test)) == ([0], [])

    @pytest.mark.usefixtures("unchecked")
    @pytest.mark.parametrize(
        ("field", "value", "kind", "message"),
        [
            ("metric", "no", ConfigError, "arrays: metric is 'no', expected True or False"),
            ("metric", 1, ConfigError, "metric is 1, expected True or False"),
            ("name", None, ConfigError, "name is None, expected a text"),
            ("name", 3, ConfigError, "name is 3, expected a text"),
            (
                "frame_names",
                ["a"] * 2 + [f"b{k}" for k in range(8)],
                SourceError,
                "two frames are called 'a'",
            ),
            ("rgb", np.zeros((4, 12, 16), np.uint8), ShapeError, r"rgb is uint8 \(4, 12, 16\)"),
            ("rgb", np.zeros((4, 12, 16, 4), np.uint8), ShapeError, "expected uint8 or float"),
            ("rgb", np.zeros((0, 12, 16, 3), np.uint8), ShapeError, "rgb is"),
            ("rgb", np.zeros((FRAMES, 12, 16, 3), np.int64), ShapeError, "rgb is int64"),
            ("rgb", np.full((FRAMES, 12, 16, 3), 200.0), SourceError, "frame 0000, field rgb: .* to 200"),
            ("rgb", np.full((FRAMES, 12, 16, 3), np.nan), SourceError, "field rgb"),
            ("K", np.eye(4), ShapeError, "K is float64"),
            ("K", np.diag([0.0, 14, 1]), SourceError, "field K: focal length fx = 0 px"),
            ("K", np.diag([-14.0, 14, 1]), SourceError, "focal length fx = -14 px"),
            ("K", changed(K, (0, 2), 900), SourceError, "principal point cx = 900 px"),
            ("K", changed(K, (0, 2), np.nan), SourceError, "K holds NaN"),
            ("mask", np.zeros((12, 16), bool), SourceError, "frame 0000, field mask: the mask leaves no"),
            ("mask", np.ones((12, 16)), ShapeError, "mask is float64"),
            ("mask", np.ones((3, 12, 16), bool), ShapeError, "mask is bool"),
            (
                "depth_mm",
                np.full((FRAMES, 12, 16), -1.0),
                SourceError,
                "0000, field depth_mm: 192 .* negative",
            ),
            ("depth_mm", np.zeros((FRAMES, 12, 16)), SourceError, "no pixel of any frame has a depth"),
            ("depth_mm", np.array(["a"]), ShapeError, r"depth_mm is <U1 \(1,\), expected real numbers"),
            ("depth_mm", np.array(5.0), ShapeError, r"depth_mm is float64 \(\), expected \[F, H, W\]"),
            ("depth_mm", [[1.0], [1.0, 2.0]], ShapeError, "depth_mm is no array of numbers"),
            ("K", np.full((3, 3), "a"), ShapeError, "K is <U1"),
            ("world_from_camera", np.full((FRAMES, 4, 4), 1j), ShapeError, "world_from_camera is complex128"),
            ("depth_mm", np.ones((FRAMES, 12, 15)), ShapeError, "depth_mm is float32"),
            ("world_from_camera", np.tile(np.eye(4), (3, 1, 1)), ShapeError, r"\(3, 4, 4\), expected \(10"),
            ("frame_names", ("a", "b"), ShapeError, "2 frame names for 10 frames"),
            ("split", Split("x", np.arange(5), np.arange(4, 8)), SourceError, "0004, field split: 1 of 10"),
            (
                "split",
                Split("x", np.array([1, 1]), np.arange(3, 5)),
                SourceError,
                "train split names a frame",
            ),
            ("split", Split("x", np.arange(0), np.arange(4)), SourceError, "no training frame"),
            ("split", Split("x", np.arange(11), np.arange(0)), ShapeError, "split.train has indices"),
        ],
    )
    def test_what_cannot_be_right_is_refused_by_frame_and_field(
        self, field: str, value: object, kind: type[ExtragsError], message: str
    ) -> None:
        with pytest.raises(kind, match=message):
            extrags.sequence_from_arrays(**{**arrays(), field: value})

    @pytest.mark.parametrize(
        ("index", "value", "message"),
        [
            ((slice(None), slice(3), 0), -1, "mirrored"),
            ((slice(3), slice(3)), 2 * np.eye(3), "singular values"),
            ((0, 3), np.nan, "1 of 16 entries are NaN"),
            ((3, 0), 1.0, "the last row is"),
        ],
    )
    def test_poses_that_are_no_rigid_motion(self, index: Any, value: Any, message: str) -> None:
        poses = arrays()["world_from_camera"]
        if message == "mirrored":
            poses[6][:3, 0] *= -1
        else:
            poses[6][index] = value
        with pytest.raises(PoseError, match=f"frame 0006, field world_from_camera: .*{message}"):
            extrags.sequence_from_arrays(**{**arrays(), "world_from_camera": poses})


@pytest.fixture
def sequence() -> EndoscopicSequence:
    return extrags.sequence_from_arrays(**arrays())


def wrong_fields(sequence: EndoscopicSequence) -> dict[str, tuple[dict[str, Any], str]]:
    """By name: changes of a sequence that its constructor takes, and the message that they deserve."""
    poses, depth = sequence.world_from_camera, sequence.depth_mm
    assert poses is not None
    assert depth is not None
    mirrored = poses.copy()
    mirrored[:, :3, 0] *= -1
    doubled = poses.copy()
    doubled[:, :3, :3] *= 2
    leaking = Split("x", np.arange(5), np.arange(4, 8))
    return {
        "overlap": ({"split": leaking}, "frame 0004, field split: 1 of 10 frames both train and"),
        "mirrored": ({"world_from_camera": mirrored}, "field world_from_camera: the rotation is mirrored"),
        "doubled": ({"world_from_camera": doubled}, "field world_from_camera: not a rotation"),
        "negative": ({"depth_mm": changed(depth, (3, 1, 2), -1)}, "0003, field depth_mm: 1 of .* negative"),
        "nan": ({"depth_mm": changed(depth, (3, 1, 2), np.nan)}, "frame 0003, field depth_mm: 1 of .* NaN"),
        "infinite": ({"depth_mm": changed(depth, (3, 1, 2), np.inf)}, "field depth_mm: 1 of .* infinite"),
        "withheld": ({"withheld_depth_mm": -depth}, "field withheld_depth_mm: 192 of 192 .* negative"),
        "focal": ({"K": changed(sequence.K, (2, 0, 0), 0)}, "frame 0002, field K: focal length fx = 0 px"),
        "mask": ({"mask": np.zeros_like(sequence.mask)}, "frame 0000, field mask: the mask leaves no pixel"),
    }


WRONG = ["overlap", "mirrored", "doubled", "negative", "nan", "infinite", "withheld", "focal", "mask"]


class TestArguments:
    @pytest.mark.parametrize("which", WRONG)
    def test_entry_points_refuse_what_no_stage_could_use(
        self, which: str, sequence: EndoscopicSequence
    ) -> None:
        change, message = wrong_fields(sequence)[which]
        wrong = replace(sequence, **change)
        with pytest.raises(SourceError, match=message):
            extrags.run_pipeline(wrong, extrags.PROFILES["quick"])
        with pytest.raises(SourceError, match=message):
            extrags.reconstruct(wrong, extrags.PROFILES["quick"].coarse)

    def test_a_run_without_settings_is_the_default_profile(
        self, sequence: EndoscopicSequence, monkeypatch: pytest.MonkeyPatch
    ) -> None:
        used = []

        def noted(pipeline: InMemoryPipeline, until: str) -> None:
            used.append(pipeline.config)

        monkeypatch.setattr(InMemoryPipeline, "run_stages", noted)
        extrags.run_pipeline(sequence)
        assert used == [extrags.PROFILES["balanced"]]

    @pytest.mark.usefixtures("unchecked")
    def test_a_name_is_no_sequence(self) -> None:
        name: Any = "phantom/0@sparse"
        with pytest.raises(
            TypeError, match=r"run_pipeline was given 'phantom/0@sparse' .* extrags\.read\('ph"
        ):
            extrags.run_pipeline(name)
        with pytest.raises(TypeError, match=r"reconstruct was given 'phantom/0@sparse' as its sequence"):
            extrags.reconstruct(name)
        path: Any = Path("frames")
        with pytest.raises(TypeError, match=r"type PosixPath .* extrags\.sequence_from_arrays"):
            extrags.run_pipeline(path)

    @pytest.mark.usefixtures("unchecked")
    def test_settings_of_another_kind(self, sequence: EndoscopicSequence) -> None:
        profile: Any = extrags.PROFILES["quick"]
        name: Any = "quick"
        with pytest.raises(
            ConfigError, match=r"given 'quick' .* PipelineConfig, such as extrags\.PROFILES\["
        ):
            extrags.run_pipeline(sequence, name)
        with pytest.raises(ConfigError, match="type CoarseConfig as its config"):
            extrags.run_pipeline(sequence, profile.coarse)
        with pytest.raises(ConfigError, match=r"type PipelineConfig as its config; pass its \.coarse"):
            extrags.reconstruct(sequence, profile)


def test_other_representations_are_lines() -> None:
    points = np.zeros((5, 3))
    gaussians = Gaussians.from_points(points, points, np.ones(5))
    assert repr(gaussians) == "Gaussians(5, SH degree 0, on cpu)"
    assert repr(Scene(gaussians)) == "Scene(Gaussians(5, SH degree 0, on cpu), without light)"
    views = np.zeros((2, 6, 8), np.float32)
    rendered = RenderedViews(np.zeros((2, 6, 8, 3), np.float32), views, views, 5)
    assert repr(rendered) == "RenderedViews(2 views of 8 x 6 px, with depth, of 5 Gaussians)"
    assert repr(Cameras(K[None], np.eye(4)[None], 16, 12)) == "Cameras(1 views of 16 x 12 px, pinholes)"
