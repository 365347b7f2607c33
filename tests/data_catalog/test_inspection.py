"""What `data check` and `data show` say about sources that are right, and the parts they are made of."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from PIL import Image

from data_catalog.checks import check_depth_scale, check_sequence
from data_catalog.diagnostics import diagnose
from data_catalog.inspection import contact_sheet, facts, inspect
from data_catalog.matches import match_neighbours, pose_support
from extrags.cameras import invert_poses
from extrags.config import IngestConfig
from extrags.errors import PoseError, SourceError, UnknownSequenceError


class TestRightSources:
    def test_the_phantom(self, sparse, distanced) -> None:
        assert diagnose(sparse, "phantom") == []
        assert diagnose(distanced, "phantom") == []

    @pytest.mark.parametrize("name", ["sinus_hopkins", "simcol3d_s1", "c3vdv2_sim/c9_transverse1_t3_v1"])
    def test_shared_data(self, shared_data, name) -> None:
        if not (shared_data / name).is_dir():
            pytest.skip(f"no {name} here")
        inspection = inspect(shared_data / name)
        assert inspection.ok, inspection.findings
        assert inspection.conventions
        assert inspection.facts is not None

    def test_unknown_names_are_not_findings(self) -> None:
        with pytest.raises(UnknownSequenceError):
            inspect("phantm/1")

    @pytest.mark.parametrize(("frames", "wrong"), [(2, True), (3, True), (4, False)])
    def test_too_few_frames_for_poses_are_an_error(self, tmp_path, frames, wrong) -> None:
        """One in eight is held out, the first among them."""
        rng = np.random.default_rng(0)
        for number in range(frames):
            Image.fromarray(rng.integers(0, 255, (40, 48, 3), dtype=np.uint8)).save(
                tmp_path / f"{number}.png"
            )
        found = [item for item in inspect(str(tmp_path)).findings if item.topic == "number of frames"]
        assert bool(found) == wrong
        for item in found:
            assert item.kind == "error"
            assert f"{frames - 1} of {frames} frames are to train on" in item.sentence

    def test_assumptions_are_notes(self, shared_data) -> None:
        found = inspect(shared_data / "sinus_hopkins" / "images", IngestConfig(downscale=8, max_frames=6))
        assert any("assuming a horizontal field of view of 90 degrees" in note for note in found.notes)
        assert found.format == "frames"


class TestPoseSupport:
    """Exact poses explain matches; every other reading of them explains clearly fewer."""

    @pytest.mark.parametrize(
        ("change", "name"),
        [
            (lambda poses: poses, ""),
            (lambda poses: poses @ np.diag([1.0, -1, -1, 1]), "OpenGL axes"),
            (invert_poses, "world-to-camera (inverted), OpenCV axes"),
            (lambda poses: invert_poses(poses) @ np.diag([1.0, -1, -1, 1]), "world-to-camera (inverted)"),
        ],
    )
    def test_the_reading_is_found(self, clip, change, name) -> None:
        changed = replace(clip, world_from_camera=change(clip.world_from_camera))
        support = pose_support(changed, match_neighbours(clip))
        assert support.matches > 60
        assert support.best > 0.82
        assert support.best_name.startswith(name)
        if name:
            assert support.as_given < 0.4

    def test_real_images(self, shared_data) -> None:
        from data_catalog.catalog import read

        sequence = read(shared_data / "sinus_hopkins")
        support = pose_support(sequence, match_neighbours(sequence))
        assert support.as_given > 0.82
        assert support.best_name == ""


class TestDepthScale:
    @pytest.mark.parametrize("factor", [1000.0, 0.001, 25.4, 3.0, 0.1])
    def test_a_wrong_factor_is_named(self, clip, factor) -> None:
        with pytest.raises(SourceError, match="depth and poses are in different units") as caught:
            check_depth_scale(replace(clip, depth_mm=(clip.depth_mm / factor).astype(np.float32)))
        told = float(caught.value.problem.split("multiplied by about ")[1].split()[0].rstrip(",."))
        assert told == pytest.approx(factor, rel=0.06)

    def test_small_errors_are_let_pass(self, clip, distanced) -> None:
        check_depth_scale(replace(clip, depth_mm=(clip.depth_mm * 1.05).astype(np.float32)))
        check_sequence(distanced)

    def test_wrong_positions_are_no_unit(self, clip) -> None:
        """Of cameras that move little, any large factor fits as well as none that moves."""
        calm = clip.world_from_camera.copy()
        calm[:, :3, 3] = calm[0, :3, 3]
        calm[:, :3, :3] = calm[0, :3, :3]
        still = replace(
            clip, world_from_camera=calm, depth_mm=np.repeat(clip.depth_mm[:1], len(clip), axis=0)
        )
        check_depth_scale(still)
        wandering = calm.copy()
        wandering[:, :3, 3] += np.random.default_rng(0).normal(scale=5.0, size=(len(clip), 3))
        told = "positions of the cameras contradict the depth: .* off by .*if the cameras did not move at all"
        with pytest.raises(PoseError, match=told) as caught:
            check_depth_scale(replace(still, world_from_camera=wandering))
        assert caught.value.field == "world_from_camera"

    @pytest.mark.parametrize("moved", [0.5, 0.2, 0.1, 0.05])
    def test_another_unit_is_refused_however_little_the_camera_moves(self, clip, moved) -> None:
        """As a unit where the motion tells, else as positions that fit no better than none."""
        calm = clip.world_from_camera.copy()
        calm[:, :3, 3] = calm[0, :3, 3] + moved * (calm[:, :3, 3] - calm[0, :3, 3])
        depth = (clip.depth_mm / 1000).astype(np.float32)
        with pytest.raises((SourceError, PoseError), match=r"different units|positions of the cameras"):
            check_depth_scale(replace(clip, world_from_camera=calm, depth_mm=depth))

    def test_no_parallax_no_verdict(self, clip) -> None:
        still = np.repeat(clip.world_from_camera[:1], len(clip), axis=0)
        check_depth_scale(replace(clip, world_from_camera=still))


class TestFacts:
    def test_numbers(self, clip) -> None:
        mask = clip.mask.copy()
        mask[:, :, :24] = False
        found = facts(replace(clip, mask=mask))
        assert (found["frames"], found["train"], found["test"]) == (10, 9, 1)
        assert found["masked_share"] == pytest.approx(0.25)
        assert found["depth_known_share"] == 1
        assert found["depth"]["p1"] < found["depth"]["median"] < found["depth"]["p99"]
        assert found["field_of_view_deg"] == pytest.approx(96, abs=0.5)
        assert 0 < found["specular_share"] < 0.1
        assert found["reach"] > 50

    def test_without_poses_or_depth(self, clip) -> None:
        found = facts(replace(clip, world_from_camera=None, depth_mm=None))
        assert found["has_poses"] is False
        assert "reach" not in found
        assert "depth" not in found


class TestPicture:
    def test_masks_highlights_and_held_out_frames_show(self, clip) -> None:
        mask, specular = clip.mask.copy(), np.zeros(clip.mask.shape, bool)
        mask[:, 40:, :20] = False
        specular[:, 30:40, 50:70] = True
        sheet = contact_sheet(replace(clip, mask=mask, specular=specular, depth_mm=None))
        height = round(240 * 77 / 96)
        first, second = sheet[:height, :240], sheet[:height, 240:480]
        assert sheet.shape[1] % 240 == 0
        assert first[88, 150].tolist() == [0, 255, 0]
        assert first[150, 20, 2] > first[150, 20, 0] + 30
        # Frame 0 is held out.
        assert first[1, 120].tolist() == [255, 210, 0]
        assert second[1, 120].tolist() != [255, 210, 0]

    def test_depth_stands_below(self, clip) -> None:
        with_depth, without = contact_sheet(clip), contact_sheet(replace(clip, depth_mm=None))
        assert with_depth.size > 1.5 * without.size
