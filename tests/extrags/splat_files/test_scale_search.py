"""The scale of a scene's unit, found from frames that show the scene."""

from __future__ import annotations

import re
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
import torch

from extrags.config import ImportedConfig
from extrags.errors import SourceError
from extrags.gaussians import Gaussians
from extrags.scene import Scene
from extrags.sequence import EndoscopicSequence
from extrags.splat_files import bake_recorded_light, import_scene, scale_search, write_ply_scene
from extrags.splat_files.scale_search import ScaleFit, ScaleSearch
from tests.extrags.lit_tube import Tube


@pytest.fixture(scope="module")
def scene(tube: Tube) -> Scene:
    return Scene(bake_recorded_light(tube.scene, tube.sequence.training_cameras))


@pytest.fixture(scope="module")
def shown(scene: Scene, tube: Tube) -> EndoscopicSequence:
    """Frames that show the scene itself: what is wrong about a fit is the scale alone."""
    return frames_of(scene, tube.sequence)


def frames_of(scene: Scene, sequence: EndoscopicSequence) -> EndoscopicSequence:
    with torch.no_grad():
        found = scene.render(sequence.cameras, median_depth=True)
    rgb = np.rint(found.rgb.clamp(0, 1).numpy() * 255).astype(np.uint8)
    return replace(sequence, rgb=rgb, depth_mm=np.asarray(found.median_depth), metric=False)


def turned(scene: Scene, axis: tuple[float, float, float], angle_deg: float, about: np.ndarray) -> Scene:
    """The scene in a world that was turned about a point; spheres in place of its flat Gaussians."""
    rotation = cv2.Rodrigues(np.radians(angle_deg) * np.array(axis))[0]
    means = (scene.gaussians.means.numpy() - about) @ rotation.T + about
    values = scene.gaussians.parameters()
    return Scene(Gaussians(**{**values, "means": torch.from_numpy(means.astype(np.float32))}), scene.light)


def moved(
    scene: Scene, sequence: EndoscopicSequence, by: tuple[float, float, float]
) -> tuple[Scene, EndoscopicSequence]:
    """Both in a world whose origin lies elsewhere."""
    assert sequence.world_from_camera is not None
    poses = sequence.world_from_camera.copy()
    poses[:, :3, 3] += by
    values = scene.gaussians.parameters()
    shifted = Gaussians(**{**values, "means": values["means"] + torch.tensor(by, dtype=torch.float32)})
    return Scene(shifted, scene.light), replace(sequence, world_from_camera=poses)


def without_depth(sequence: EndoscopicSequence) -> EndoscopicSequence:
    return replace(sequence, depth_mm=None)


def imported(scene: Scene, sequence: EndoscopicSequence, scale: float, folder: Path) -> None:
    write_ply_scene(scene, folder / "theirs.ply")
    import_scene(folder / "theirs.ply", sequence, ImportedConfig(scale=scale))


def named_scale(error: pytest.ExceptionInfo[SourceError]) -> float:
    found = re.search(r"; with ([0-9.e+-]+), which fits", str(error.value))
    assert found is not None, str(error.value)
    return float(found[1])


class TestAnotherScale:
    @pytest.mark.parametrize(
        ("scale", "depth"),
        [
            *((scale, True) for scale in (0.001, 0.5, 1.2, 1000.0)),
            *((scale, False) for scale in (0.01, 2.0)),
            *(pytest.param(scale, True, marks=pytest.mark.slow) for scale in (2.0, 20.0)),
            *(pytest.param(scale, False, marks=pytest.mark.slow) for scale in (0.5, 20.0)),
        ],
    )
    def test_is_refused_with_the_right_one(
        self, scale: float, depth: bool, scene: Scene, shown: EndoscopicSequence, tmp_path: Path
    ) -> None:
        """Also a larger one, which keeps the cameras inside: depths do not grow with the scale there."""
        sequence = shown if depth else without_depth(shown)
        with pytest.raises(SourceError, match=r"field imported\.scale: with imported\.scale") as error:
            imported(scene, sequence, scale, tmp_path)
        named = named_scale(error)
        assert named == pytest.approx(1, abs=0.02)
        imported(scene, sequence, named, tmp_path)

    @pytest.mark.parametrize("scale", [pytest.param(0.01, marks=pytest.mark.slow), 30.0])
    def test_with_the_light_kept(self, scale: float, tube: Tube, tmp_path: Path) -> None:
        with pytest.raises(SourceError) as error:
            imported(tube.scene, frames_of(tube.scene, tube.sequence), scale, tmp_path)
        assert named_scale(error) == pytest.approx(1, abs=0.02)

    @pytest.mark.parametrize("depth", [True, False])
    def test_far_from_the_origin(
        self, depth: bool, scene: Scene, shown: EndoscopicSequence, tmp_path: Path
    ) -> None:
        """A scale that is wrong by 5 % moves the scene by its own radius: few scales see anything at all."""
        far_scene, far = moved(scene, shown, (0.0, 400.0, 300.0))
        far = far if depth else without_depth(far)
        imported(far_scene, far, 1.0, tmp_path)
        for scale in (0.95, 1.05, 1000.0):
            with pytest.raises(SourceError) as error:
                imported(far_scene, far, scale, tmp_path)
            assert named_scale(error) == pytest.approx(1, abs=0.002)

    def test_large_scenes_are_searched_thinned(
        self, monkeypatch: pytest.MonkeyPatch, scene: Scene, shown: EndoscopicSequence
    ) -> None:
        monkeypatch.setattr(scale_search, "_SEARCHED_GAUSSIANS", 1000)
        search = ScaleSearch(scene, shown)
        tried = search.along()
        best = search.refined(min(tried, key=lambda fit: fit.misfit))
        assert best.scale == pytest.approx(1, abs=0.02)
        assert best == search.at(best.scale), "what is said of it holds for all Gaussians"

    def test_is_the_same_each_time(self, scene: Scene, shown: EndoscopicSequence) -> None:
        assert ScaleSearch(scene, shown).along() == ScaleSearch(scene, shown).along()


class TestNoScale:
    @pytest.mark.parametrize(
        ("axis", "angle_deg", "depth"),
        [
            ((1.0, 0, 0), 90, True),
            ((1.0, 0, 0), 180, False),
            ((0, 1.0, 0), 90, False),
            pytest.param((1.0, 0, 0), 90, False, marks=pytest.mark.slow),
            pytest.param((1.0, 0, 0), 180, True, marks=pytest.mark.slow),
            pytest.param((0, 1.0, 0), 90, True, marks=pytest.mark.slow),
        ],
    )
    def test_other_axes(
        self,
        axis: tuple[float, float, float],
        angle_deg: float,
        depth: bool,
        scene: Scene,
        shown: EndoscopicSequence,
        tmp_path: Path,
    ) -> None:
        wrong = turned(scene, axis, angle_deg, np.zeros(3))
        with pytest.raises(
            SourceError, match=r"field means: .* No scale from 0\.0001 to 10000 .* other axes"
        ):
            imported(wrong, shown if depth else without_depth(shown), 1.0, tmp_path)

    def test_another_place(self, scene: Scene, shown: EndoscopicSequence, tmp_path: Path) -> None:
        away, _ = moved(scene, shown, (60.0, 0.0, 0.0))
        with pytest.raises(SourceError, match=r"field means: .* around \(59, .* No scale"):
            imported(away, shown, 1.0, tmp_path)

    def test_far_from_the_origin_a_wall_in_the_way_is_none_that_was_missed(
        self, scene: Scene, shown: EndoscopicSequence, tmp_path: Path
    ) -> None:
        far_scene, far = moved(scene, shown, (0.0, 400.0, 300.0))
        assert far.world_from_camera is not None
        wrong = turned(far_scene, (0, 1.0, 0), 90, np.median(far.world_from_camera[:, :3, 3], axis=0))
        with pytest.raises(SourceError, match="No scale from"):
            imported(wrong, far, 1.0, tmp_path)


class TestTaken:
    def test_a_scene_with_biased_depth(self, scene: Scene, shown: EndoscopicSequence, tmp_path: Path) -> None:
        """Depth of a scene that was trained without any may be off by some percent; pictures are right."""
        assert shown.depth_mm is not None
        imported(scene, replace(shown, depth_mm=shown.depth_mm * np.float32(1.07)), 1.0, tmp_path)

    def test_albedo_where_depth_agrees(self, tube: Tube, tmp_path: Path) -> None:
        """Its pictures are of another light, and hardly resemble the frames."""
        write_ply_scene(Scene(tube.scene.gaussians), tmp_path / "albedo.ply")
        found = import_scene(tmp_path / "albedo.ply", tube.sequence)
        assert "correlate by 0.1" in " ".join(found.statements)

    @pytest.mark.parametrize("by", [(0.0, 0.0, 0.0), (0.0, 400.0, 300.0)])
    def test_the_right_place_in_other_colours(
        self, by: tuple[float, float, float], scene: Scene, shown: EndoscopicSequence, tmp_path: Path
    ) -> None:
        """A surface in one grey hides the frames in its place, and resembles them nowhere."""
        there, sequence = moved(scene, shown, by)
        values = there.gaussians.parameters()
        grey = Scene(Gaussians(**{**values, "sh0": torch.full_like(values["sh0"], 0.3)}))
        with torch.no_grad():
            seen = there.render(sequence.cameras).alpha.numpy() > 0.9
        sequence = replace(sequence, mask=sequence.mask & seen)
        write_ply_scene(grey, tmp_path / "grey.ply")
        found = import_scene(tmp_path / "grey.ply", without_depth(sequence))
        assert found.seen_share > 0.95
        assert "training frames correlate by" in " ".join(found.statements)
        with pytest.raises(SourceError, match="field means"):
            import_scene(tmp_path / "grey.ply", without_depth(sequence), ImportedConfig(scale=0.05))

    def test_far_from_the_origin_the_given_scale_may_be_the_only_one(
        self, scene: Scene, shown: EndoscopicSequence, tmp_path: Path
    ) -> None:
        """No step of the search comes near it: what was tried fits alike badly at all scales."""
        far_scene, far = moved(scene, shown, (500_000.0, 0.0, 0.0))
        right = 1.2345678
        values = far_scene.gaussians.parameters()
        unit = {"means": values["means"] / right, "scales": values["scales"] - np.log(right)}
        write_ply_scene(Scene(Gaussians(**{**values, **unit})), tmp_path / "a.ply")
        found = import_scene(tmp_path / "a.ply", without_depth(far), ImportedConfig(scale=right))
        assert "fit alike" not in " ".join(found.statements)
        with pytest.raises(SourceError, match=r"could not be searched finely enough.* origin near the cam"):
            import_scene(tmp_path / "a.ply", without_depth(far), ImportedConfig(scale=1.236))

    def test_a_scale_that_frames_without_depth_cannot_tell(
        self, scene: Scene, shown: EndoscopicSequence, tmp_path: Path
    ) -> None:
        """Cameras that turn about the origin see the same scene at every scale."""
        assert shown.world_from_camera is not None
        poses = shown.world_from_camera.copy()
        centre = poses[0, :3, 3].copy()
        poses[:, :3, 3] = 0
        there, _ = moved(scene, shown, tuple(-centre))
        turning = frames_of(there, replace(shown, world_from_camera=poses))
        write_ply_scene(there, tmp_path / "a.ply")
        found = import_scene(tmp_path / "a.ply", without_depth(turning), ImportedConfig(scale=3.0))
        assert "their pictures fit alike from 0.0" in " ".join(found.statements)
        with pytest.raises(SourceError, match="with 1, which fits"):
            import_scene(tmp_path / "a.ply", turning, ImportedConfig(scale=3.0))

    def test_frames_that_tell_nothing(self, scene: Scene, shown: EndoscopicSequence, tmp_path: Path) -> None:
        grey = replace(without_depth(shown), rgb=np.full_like(shown.rgb, 90))
        write_ply_scene(scene, tmp_path / "a.ply")
        found = import_scene(tmp_path / "a.ply", grey)
        assert "neither depth nor contrast" in " ".join(found.statements)


class TestComparison:
    GOOD = ScaleFit(1.0, 0.9, 0.9, 0.02, 0.12)

    def test_half_the_error_is_clearly_better(self) -> None:
        assert self.GOOD.clearly_better_than(replace(self.GOOD, depth_error=0.2, misfit=0.3))
        assert not self.GOOD.clearly_better_than(replace(self.GOOD, depth_error=0.03, misfit=0.13))

    def test_a_small_error_counts_where_pictures_are_worse(self) -> None:
        biased = replace(self.GOOD, depth_error=0.08, misfit=0.18)
        assert not self.GOOD.clearly_better_than(biased)
        assert self.GOOD.clearly_better_than(replace(biased, correlation=0.5))

    def test_pictures_may_say_the_contrary(self) -> None:
        biased = replace(self.GOOD, depth_error=0.2, misfit=0.3)
        assert not replace(self.GOOD, correlation=0.6).clearly_better_than(biased)

    @pytest.mark.parametrize(
        ("fit", "fits"),
        [
            (GOOD, True),
            (replace(GOOD, depth_error=0.4, misfit=0.5, correlation=0.3), False),
            (replace(GOOD, depth_error=0.1, misfit=0.8, correlation=0.1), False),
            (replace(GOOD, depth_error=0.1, misfit=0.8, correlation=0.4), True),
            (replace(GOOD, depth_error=0.4, misfit=0.5, correlation=0.8), True),
            (replace(GOOD, depth_error=None, misfit=0.6, correlation=0.4), True),
            (replace(GOOD, depth_error=None, misfit=0.8, correlation=0.2), False),
        ],
    )
    def test_one_world_or_another(self, fit: ScaleFit, fits: bool) -> None:
        assert fit.fits == fits

    def test_what_is_shown_everywhere_may_have_other_colours(self) -> None:
        low = replace(self.GOOD, depth_error=None, misfit=0.9, correlation=0.1, shown_share=0.99)
        assert low.possible
        assert not replace(low, shown_share=0.9).possible
        assert not replace(low, depth_error=0.5).possible

    @pytest.mark.parametrize(
        ("fit", "words"),
        [
            (
                GOOD,
                "show it in 90 % of their pixels, correlate with it by 0.90 and have depth that it misses by "
                "2 % (median)",
            ),
            (replace(GOOD, depth_error=1.2), "show it in 90 % .* a factor of 3.32 (median)"),
            (replace(GOOD, depth_error=np.inf), "show it in 90 % .* and have no depth there"),
            (
                replace(GOOD, depth_error=None),
                "show it in 90 % of their pixels and correlate with it by 0.90",
            ),
            (replace(GOOD, depth_error=None, correlation=None), "show it in 90 % of their pixels"),
            (replace(GOOD, shown_share=0.0), "do not see it"),
        ],
    )
    def test_in_words(self, fit: ScaleFit, words: str) -> None:
        start, _, end = words.partition(" .* ")
        assert fit.words.startswith(start)
        assert fit.words.endswith(end)
