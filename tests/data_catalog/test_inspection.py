"""What `data check` and `data show` say about sources that are right, and the parts they are made of."""

from __future__ import annotations

import json
import subprocess
import sys
import tracemalloc
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from data_catalog.checks import check_depth_scale, check_sequence
from data_catalog.diagnostics import _exposure, _images, _light, diagnose
from data_catalog.inspection import contact_sheet, facts, inspect
from data_catalog.matches import FrameMatches, match_neighbours, pose_support
from extrags.cameras import invert_poses, pixel_rays
from extrags.config import IngestConfig
from extrags.errors import PoseError, SourceError, UnknownSequenceError
from extrags.sequence import EndoscopicSequence, Split
from tests.benchmarks.wrong_recordings import WRONG
from tests.extrags.depth.withheld import recorded


class TestRightSources:
    def test_the_phantom(self, sparse, distanced) -> None:
        assert diagnose(sparse, "phantom") == []
        assert diagnose(distanced, "phantom") == []

    @pytest.mark.parametrize(
        ("name", "downscale"),
        [("sinus_hopkins", 2), ("simcol3d_s1", 1), ("c3vdv2_sim/c9_transverse1_t3_v1", 2)],
    )
    def test_shared_data(self, shared_data, name, downscale) -> None:
        if not (shared_data / name).is_dir():
            pytest.skip(f"no {name} here")
        inspection = inspect(shared_data / name, IngestConfig(downscale=downscale))
        assert inspection.ok, inspection.findings
        assert inspection.conventions
        assert inspection.facts is not None

    def test_settings_that_do_not_fit_are_findings_of_the_source(self, posed_folder) -> None:
        found = inspect(posed_folder, IngestConfig(downscale=16))
        (finding,) = found.findings
        assert (finding.kind, finding.topic) == ("error", "cannot be read")
        assert finding.file == str(posed_folder)
        assert "pixels is too small" in finding.sentence
        assert found.facts is None
        assert found.format == "extrags"

    def test_torch_is_not_loaded(self, posed_folder) -> None:
        """It took two thirds of the time that a look at a source takes."""
        program = (
            "import sys; from data_catalog.inspection import inspect; inspect(sys.argv[1]); "
            "assert 'torch' not in sys.modules"
        )
        subprocess.run([sys.executable, "-c", program, str(posed_folder)], check=True)

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

    def test_a_single_training_frame_is_no_camera_that_stands_still(self, posed_folder) -> None:
        content = json.loads((posed_folder / "poses.json").read_text())
        for entry in content["frames"][2:]:
            for part, suffix in (("rgb", ".png"), ("depth", ".npy")):
                (posed_folder / part / Path(entry["file"]).with_suffix(suffix).name).unlink()
        content["frames"] = content["frames"][:2]
        (posed_folder / "poses.json").write_text(json.dumps(content))
        (found,) = inspect(posed_folder).findings
        assert (found.kind, found.topic, found.field) == ("warning", "number of frames", "split")
        assert found.sentence.startswith("1 of 2 frames is to train on, and the others are held out")

    def test_a_length_unit_that_is_not_stated_is_a_note(self, posed_folder, edit_poses) -> None:
        said = "no length_unit: lengths are taken for millimetres"
        assert not any(said in note for note in inspect(posed_folder).notes)
        edit_poses(lambda content: content.pop("length_unit"))
        found = inspect(posed_folder)
        assert found.facts["length_unit"] == "mm"
        assert sum(said in note for note in found.notes) == 1

    def test_assumptions_are_notes(self, shared_data) -> None:
        found = inspect(shared_data / "sinus_hopkins" / "images", IngestConfig(downscale=8, max_frames=6))
        assert any("assuming a horizontal field of view of 90 degrees" in note for note in found.notes)
        assert found.format == "frames"


class TestNumbering:
    @staticmethod
    def named(sequence: EndoscopicSequence, numbers: list[int], pattern: str) -> EndoscopicSequence:
        shown = np.arange(len(numbers)) % len(sequence)
        return EndoscopicSequence(
            name="numbered",
            rgb=sequence.rgb[shown],
            K=sequence.K[shown],
            mask=sequence.mask[shown],
            split=Split("first", np.arange(1, len(numbers)), np.arange(1)),
            frame_names=tuple(pattern.format(number) for number in numbers),
        )

    @pytest.mark.parametrize("pattern", ["{:04d}", "frame_{}", "frame_{:06d}", "0_{:020d}"])
    @pytest.mark.parametrize(
        ("left_out", "missing"), [((), ()), ((12,), (11,)), ((12, 13), (11,)), (tuple(range(1, 31, 2)), ())]
    )
    def test_a_gap_is_found(self, clip, pattern, left_out, missing) -> None:
        """What was compared was how many digits the numbers have."""
        numbers = [number for number in range(31) if number not in left_out]
        findings = diagnose(self.named(clip, numbers, pattern), "source")
        found = [finding.frame for finding in findings if finding.topic == "missing frame"]
        assert found == [pattern.format(number) for number in missing]
        if missing:
            (told,) = (finding for finding in findings if finding.topic == "missing frame")
            assert f"{len(left_out) + 1} on; all others are 1 apart" in told.sentence

    @pytest.mark.parametrize(
        ("names", "topic", "told"),
        [
            ([f"frame_{k / 10:.1f}" for k in range(24)], None, ""),
            ([f"{k * 0.05:g}" for k in range(31)], None, ""),
            ([f"t{k / 30:.3f}" for k in range(70)], None, ""),
            ([f"{k / 30 + k % 3 / 100:.6f}" for k in range(70)], None, ""),
            ([f"scan_1.{k}" for k in range(8, 20)], None, ""),
            (
                [f"frame_{k / 10:.1f}" for k in range(24) if k != 12],
                "missing frame",
                "0.2 on; all others are 0.1",
            ),
            ([f"{k * 0.05:g}" for k in range(31) if k != 9], "missing frame", "0.1 on; all others are 0.05"),
            (
                [f"{s}.{k:03d}" for s in (1, 2) for k in range(12)],
                "series of frames",
                "the numbering starts over",
            ),
        ],
    )
    def test_decimals_are_numbers(self, clip, names, topic, told) -> None:
        """After 0.9 the numbering was said to begin anew."""
        sequence = replace(self.named(clip, list(range(len(names))), "{}"), frame_names=tuple(names))
        findings = [f for f in diagnose(sequence, "source") if f.field == "frame names"]
        assert [finding.topic for finding in findings] == ([] if topic is None else [topic])
        assert all(told in finding.sentence for finding in findings)

    def test_frames_that_were_left_out_on_purpose_are_not_missing(self, clip, tmp_path) -> None:
        sequence = self.named(clip, [*range(12), *range(13, 31)], "{:04d}")
        assert not [f for f in diagnose(sequence, "source", thinned=True) if f.topic == "missing frame"]
        for number in range(21):
            Image.fromarray(clip.rgb[number % len(clip)]).save(tmp_path / f"{number:04d}.png")
        thinned = inspect(tmp_path, IngestConfig(max_frames=20)).findings
        assert not [finding for finding in thinned if finding.topic == "missing frame"]


class TestLens:
    @staticmethod
    def written(clip: EndoscopicSequence, folder: Path, **lens: float) -> Path:
        (folder / "images").mkdir()
        frames = []
        for index in range(6):
            Image.fromarray(clip.rgb[index]).save(folder / "images" / f"{index:04d}.png")
            pose = clip.world_from_camera[index] @ np.diag([1.0, -1, -1, 1])
            frames.append({"file_path": f"images/{index:04d}.png", "transform_matrix": pose.tolist()})
        sizes = {"w": clip.width, "h": clip.height, "fl_x": 80, "fl_y": 80, "camera_model": "OPENCV"}
        (folder / "transforms.json").write_text(json.dumps({**sizes, **lens, "frames": frames}))
        return folder

    def test_a_lens_of_which_little_is_used_is_told(self, clip, tmp_path) -> None:
        """The pinhole's own principal point is always in the middle, and shows nothing."""
        found = inspect(self.written(clip, tmp_path, cx=24, cy=20, k1=-0.05))
        (told,) = (finding for finding in found.findings if finding.topic == "lens")
        assert "principal point is (24.0, 20.0): that is far from the centre" in told.sentence
        assert told.file == str(tmp_path)

    @pytest.mark.parametrize("masked", [False, True])
    def test_corners_that_show_nothing_are_no_loss(self, clip, tmp_path, masked) -> None:
        """Of an endoscope's round picture nothing is left out, and 30 % of the image is."""
        rows, columns = np.mgrid[: clip.height, : clip.width] + 0.5
        round_picture = np.hypot(columns - clip.width / 2, rows - clip.height / 2) < 0.36 * clip.width
        lens = {"cx": clip.width / 2, "cy": clip.height / 2, "k1": -0.6, "k2": 0.2}
        folder = self.written(clip, tmp_path, **lens)
        assert [finding for finding in inspect(folder).findings if finding.topic == "lens"]
        if masked:
            content = json.loads((folder / "transforms.json").read_text())
            for frame in content["frames"]:
                frame["mask_path"] = "mask.png"
            (folder / "transforms.json").write_text(json.dumps(content))
            Image.fromarray(255 * round_picture.astype(np.uint8)).save(folder / "mask.png")
        else:
            for index in range(6):
                seen = clip.rgb[index] * round_picture[..., None]
                Image.fromarray(seen).save(folder / "images" / f"{index:04d}.png")
        assert not [finding for finding in inspect(folder).findings if finding.topic == "lens"]

    def test_most_of_it_is_enough(self, clip, tmp_path) -> None:
        found = inspect(self.written(clip, tmp_path, cx=48, cy=38.5, k1=-0.05))
        assert not [finding for finding in found.findings if finding.topic == "lens"]


def test_intrinsics_of_the_picture_on_its_side_are_told(clip) -> None:
    assert "intrinsics" not in [finding.topic for finding in diagnose(clip, "here")]
    K = clip.K.copy()
    K[:, 0, 2], K[:, 1, 2] = clip.height / 2, clip.width / 2
    found = [finding for finding in diagnose(replace(clip, K=K), "here") if finding.topic == "intrinsics"]
    assert len(found) == 1
    told = f"is the centre of an image of {clip.height} x {clip.width} pixels, and this one has {clip.width}"
    assert told in found[0].sentence


def test_intrinsics_are_those_of_the_picture_where_it_has_a_clear_surround(clip) -> None:
    # Beside a panel, as recorders put it.
    beside = ((0, 0), (10, 10), (120, 14))
    K = clip.K.copy()
    K[:, 0, 2] += 120
    recorded = replace(
        clip,
        rgb=np.pad(clip.rgb, (*beside, (0, 0))),
        mask=np.pad(clip.mask, beside),
        K=K,
        depth_mm=None,
        observed=None,
        specular=None,
    )
    assert "intrinsics" not in {finding.topic for finding in diagnose(recorded, "here")}
    in_the_middle = K.copy()
    in_the_middle[:, 0, 2] = recorded.width / 2
    found = [
        item for item in diagnose(replace(recorded, K=in_the_middle), "here") if item.topic == "intrinsics"
    ]
    assert len(found) == 1
    assert f"far from the centre of {clip.width} x {clip.height} pixels" in found[0].sentence


@pytest.mark.parametrize(
    ("factor", "told"),
    [(1e-3, "nearer than endoscopes see: are they metres?"), (1e3, "are they micrometres?")],
)
def test_another_unit_that_is_called_millimetres_is_told(clip, factor, told) -> None:
    """Depth and poses in one unit contradict nothing, and the report said millimetres."""
    poses = clip.world_from_camera.copy()
    poses[:, :3, 3] *= factor
    other = replace(clip, world_from_camera=poses, depth_mm=clip.depth_mm * np.float32(factor))
    for sequence, is_told in ((clip, False), (other, True), (replace(other, metric=False), False)):
        found = [finding for finding in diagnose(sequence, "here") if finding.topic == "unit"]
        assert len(found) == is_told
        assert all(told in item.sentence for item in found)


def test_memory_does_not_grow_with_the_frames(clip) -> None:
    """What is made of all frames at once would be as large as they are."""
    peaks = []
    for count in (10, 60):
        shown = np.arange(count) % len(clip)
        many = EndoscopicSequence(
            name="many",
            rgb=clip.rgb[shown],
            K=clip.K[shown],
            mask=clip.mask[shown],
            split=Split("first", np.arange(1, count), np.arange(1)),
            depth_mm=clip.depth_mm[shown],
            specular=np.zeros((count, clip.height, clip.width), bool),
        )
        tracemalloc.start()
        diagnose(many, "source")
        facts(many)
        peaks.append(tracemalloc.get_traced_memory()[1])
        tracemalloc.stop()
    assert peaks[1] - peaks[0] < 5 * clip.rgb[0].nbytes


@pytest.fixture(scope="module")
def matches(clip: EndoscopicSequence) -> list[FrameMatches]:
    return match_neighbours(clip)


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
    def test_the_reading_is_found(self, clip, matches, change, name) -> None:
        changed = replace(clip, world_from_camera=change(clip.world_from_camera))
        support = pose_support(changed, matches)
        assert support.matches > 60
        assert support.best > 0.82
        assert support.best_name.startswith(name)
        if name:
            assert support.as_given < 0.4

    def test_real_images(self, shared_data) -> None:
        from data_catalog.catalog import read

        sequence = read(shared_data / "sinus_hopkins", IngestConfig(size="thumbnail"))
        support = pose_support(sequence, match_neighbours(sequence))
        assert support.as_given > 0.82
        assert support.best_name == ""


def test_all_that_is_corrected_is_told(clip, tmp_path) -> None:
    """Instruments and depth of few frames were on the log alone."""
    (tmp_path / "rgb").mkdir()
    for number, rgb in enumerate(WRONG["narrow band"](recorded(12, 160, 128)).rgb[:12]):
        Image.fromarray(rgb).save(tmp_path / "rgb" / f"{number:04d}.png")
    told = inspect(tmp_path)
    assert [(finding.topic, finding.field) for finding in told.findings] == [("light", "rgb")]
    assert not told.ok


def test_light_of_another_colour_is_told(clip) -> None:
    """Narrow-band light among white: one surface has two colours, which no exposure explains."""
    assert not list(_light(clip))
    rgb = clip.rgb.copy()
    rgb[4:7, ..., 0] //= 3
    (found,) = _light(replace(clip, rgb=rgb))
    assert (found.topic, found.frame, found.field) == ("colour jump", clip.frame_name(4), "rgb")
    assert "(2 such jumps; neighbours usually" in found.sentence
    # Brighter and darker light of the same colour is a matter of exposure.
    assert not list(
        _light(
            replace(
                clip, rgb=np.where(np.arange(len(clip))[:, None, None, None] > 4, clip.rgb // 2, clip.rgb)
            )
        )
    )


def test_black_frames_are_neither_repeats_nor_jumps_of_exposure(clip) -> None:
    """They were told three times, and the second of them was to be removed as a copy of the first."""
    rgb = clip.rgb.copy()
    rgb[4:6] = 0
    dark = replace(clip, rgb=rgb)
    assert [finding.topic for check in (_images, _exposure) for finding in check(dark)] == ["black frame"]
    rgb[7] = rgb[8]
    (repeat,) = (finding for finding in _images(dark) if finding.topic == "duplicate frame")
    assert repeat.frame == clip.frame_name(8)


class TestDepthScale:
    @pytest.mark.parametrize("factor", [1000.0, 0.001, 25.4, 3.0, 0.1])
    def test_a_wrong_factor_is_named(self, clip, factor) -> None:
        with pytest.raises(SourceError, match="depth and poses are in different units") as caught:
            check_depth_scale(replace(clip, depth_mm=(clip.depth_mm / factor).astype(np.float32)))
        told = float(caught.value.problem.split("multiplied by about ")[1].split()[0].rstrip(",."))
        assert told == pytest.approx(factor, rel=0.06)

    def test_the_unit_of_a_layout_takes_the_place_of_a_guess(self, clip) -> None:
        other = replace(clip, depth_mm=(clip.depth_mm / 1000).astype(np.float32))
        told = r"about \d+\. Expected depth in the unit of the poses: a level is 1/5000 m$"
        with pytest.raises(SourceError, match=told):
            check_depth_scale(other, depth_unit="a level is 1/5000 m")

    def test_small_errors_are_let_pass(self, clip, distanced) -> None:
        check_depth_scale(replace(clip, depth_mm=(clip.depth_mm * 1.05).astype(np.float32)))
        check_sequence(distanced)

    def test_depth_along_the_ray_is_in_the_unit_of_the_poses(self, clip, caplog) -> None:
        lengths = np.linalg.norm(pixel_rays(clip.cameras), axis=-1)
        check_depth_scale(replace(clip, depth_mm=(clip.depth_mm * lengths).astype(np.float32)), file="poses")
        assert not caplog.messages

    @pytest.mark.parametrize("constant", [1.0, 300.0, 5e4])
    def test_inverse_depth_is_refused(self, clip, constant) -> None:
        """Of disparity no factor fits, and where it is small nothing meets: it was read as it stood."""
        disparity = np.divide(
            constant, clip.depth_mm, out=np.zeros_like(clip.depth_mm), where=clip.depth_mm > 0
        )
        with pytest.raises(SourceError, match=r"depth is inverse, .* but only by 0\.\d% when a") as caught:
            check_depth_scale(replace(clip, depth_mm=disparity), file="poses")
        assert caught.value.field == "depth_mm"

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

    @pytest.mark.parametrize("step", [0.4, 0.8])
    def test_depth_far_too_large_is_refused_beside_small_steps(self, clip, step) -> None:
        """A thousand times as far, nothing comes nearer in a step: depth is off by 1 or 2 % alone."""
        straight = np.repeat(np.eye(4)[None], len(clip), axis=0)
        straight[:, 2, 3] = step * np.arange(len(clip))
        wall = (40 - straight[:, 2, 3])[:, None, None] * np.ones_like(clip.depth_mm)
        towards = replace(clip, world_from_camera=straight, depth_mm=wall)
        check_depth_scale(towards)
        told = r"multiplied by about 0\.00\d+, as of depth in millimetres beside poses in metres"
        with pytest.raises(SourceError, match=told):
            check_depth_scale(replace(towards, depth_mm=1000 * wall))

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
        far = np.where(mask, clip.depth_mm, np.float32(5000))
        beyond = facts(replace(clip, mask=mask, depth_mm=far))
        assert beyond["depth"] == found["depth"]
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
