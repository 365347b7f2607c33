"""Scenes from elsewhere, held against the cameras of a sequence."""

from __future__ import annotations

import math
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

from extrags.config import ImportedConfig, PipelineConfig
from extrags.errors import ConfigError, PoseError, SourceError
from extrags.gaussians import Gaussians
from extrags.in_memory_pipeline import run_pipeline
from extrags.scene import Scene
from extrags.sequence import EndoscopicSequence
from extrags.splat_files import bake_recorded_light, import_scene, write_ply_scene, write_spz
from tests.extrags.lit_tube import Tube


@pytest.fixture(scope="module")
def baked(tube: Tube) -> Gaussians:
    return bake_recorded_light(tube.scene, tube.sequence.training_cameras)


@pytest.fixture(scope="module")
def file(baked: Gaussians, tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("scene") / "theirs.ply"
    write_ply_scene(Scene(baked), path)
    return path


def changed(gaussians: Gaussians, **values: torch.Tensor) -> Gaussians:
    return Gaussians(**{**gaussians.parameters(), **values})


class TestAccepted:
    def test_what_the_training_views_say_of_it(self, file: Path, tube: Tube) -> None:
        found = import_scene(file, tube.sequence)
        assert found.seen_share > 0.7
        assert found.psnr > 20
        assert found.depth_ratio == pytest.approx(1, abs=0.05)
        assert "held-out frames" in " ".join(found.statements)
        assert "without light" in " ".join(found.statements)

    def test_spz(self, baked: Gaussians, tube: Tube, tmp_path: Path) -> None:
        write_spz(baked, tmp_path / "theirs.spz")
        assert import_scene(tmp_path / "theirs.spz", tube.sequence).psnr > 20

    def test_the_light_of_our_own_ply(self, tube: Tube, tmp_path: Path) -> None:
        write_ply_scene(tube.scene, tmp_path / "a.ply")
        lit = import_scene(tmp_path / "a.ply", tube.sequence)
        assert lit.scene.light is not None
        assert lit.psnr > import_scene_without_light(tube, tmp_path) + 3
        assert not any("exposures" in statement for statement in lit.statements)

    def test_exposures_of_other_frames_start_from_the_mean(self, tube: Tube, tmp_path: Path) -> None:
        assert tube.scene.light is not None
        other = replace(tube.scene.light, log_exposure=torch.tensor([0.5, -0.5]))
        write_ply_scene(Scene(tube.scene.gaussians, other), tmp_path / "a.ply")
        found = import_scene(tmp_path / "a.ply", tube.sequence)
        assert found.scene.light is not None
        assert found.scene.light.log_exposure.tolist() == [0.0] * len(tube.sequence.train)
        assert any("exposures of 2 frames" in statement for statement in found.statements)

    def test_another_unit_with_its_scale(self, tube: Tube, tmp_path: Path) -> None:
        """A scene in metres, its light included, is the same scene with a scale of 1000."""
        assert tube.scene.light is not None
        values = tube.scene.gaussians
        metres = changed(values, means=values.means / 1000, scales=values.scales - math.log(1000))
        light = replace(tube.scene.light, reference_distance=tube.scene.light.reference_distance / 1000)
        write_ply_scene(Scene(metres, light), tmp_path / "a.ply")
        found = import_scene(tmp_path / "a.ply", tube.sequence, ImportedConfig(scale=1000.0))
        write_ply_scene(tube.scene, tmp_path / "b.ply")
        assert found.psnr == pytest.approx(import_scene(tmp_path / "b.ply", tube.sequence).psnr, abs=0.05)


def in_unit(sequence: EndoscopicSequence, factor: float) -> EndoscopicSequence:
    """The same in a unit so many times as small."""
    assert sequence.depth_mm is not None
    assert sequence.world_from_camera is not None
    poses = sequence.world_from_camera.copy()
    poses[:, :3, 3] *= factor
    return replace(sequence, world_from_camera=poses, depth_mm=sequence.depth_mm * np.float32(factor))


def import_scene_without_light(tube: Tube, tmp_path: Path) -> float:
    write_ply_scene(Scene(tube.scene.gaussians), tmp_path / "albedo.ply")
    return import_scene(tmp_path / "albedo.ply", tube.sequence).psnr


class TestRefused:
    @pytest.mark.parametrize(
        ("scale", "message"),
        [
            (0.001, r"imported\.scale"),
            (300.0, r"imported\.scale"),
            (3.0, r"imported\.scale 3, .* misses by a factor of 2\.9.*; with 1(\.0\d*)?, which fits"),
        ],
    )
    def test_another_unit(self, scale: float, message: str, file: Path, tube: Tube) -> None:
        with pytest.raises(SourceError, match=message):
            import_scene(file, tube.sequence, ImportedConfig(scale=scale))

    @pytest.mark.parametrize("with_depth", [True, False])
    def test_a_unit_too_large_without_light(
        self, with_depth: bool, baked: Gaussians, tube: Tube, tmp_path: Path
    ) -> None:
        """Nothing nearer than `Scene.near` is rendered: surface would be missing without a word."""
        small = in_unit(tube.sequence, 0.002)
        if not with_depth:
            small = replace(small, depth_mm=None)
        write_ply_scene(Scene(baked), tmp_path / "a.ply")
        with pytest.raises(
            SourceError, match=r"field imported\.scale: the typical depth in test/tube is 0\.0"
        ):
            import_scene(tmp_path / "a.ply", small, ImportedConfig(scale=0.002))
        write_ply_scene(tube.scene, tmp_path / "lit.ply")
        assert import_scene(tmp_path / "lit.ply", small, ImportedConfig(scale=0.002)).seen_share > 0.7
        # Far enough for both, and less than reconstruction takes.
        enough = in_unit(tube.sequence, 0.02)
        assert import_scene(tmp_path / "a.ply", enough, ImportedConfig(scale=0.02)).seen_share > 0.7

    def test_another_place(self, baked: Gaussians, tube: Tube, tmp_path: Path) -> None:
        away = changed(baked, means=baked.means + torch.tensor([500.0, 0, 0]))
        write_ply_scene(Scene(away), tmp_path / "a.ply")
        with pytest.raises(SourceError, match=r"show it in 0\.0 % .* are around \(499,"):
            import_scene(tmp_path / "a.ply", tube.sequence)

    def test_numbers_out_of_range(self, baked: Gaussians, tube: Tube, tmp_path: Path) -> None:
        means = baked.means.clone()
        means[:3] = 1e9
        write_ply_scene(Scene(changed(baked, means=means)), tmp_path / "a.ply")
        with pytest.raises(SourceError, match="field means: 3 of"):
            import_scene(tmp_path / "a.ply", tube.sequence)
        write_ply_scene(Scene(changed(baked, scales=baked.scales + 30)), tmp_path / "a.ply")
        with pytest.raises(SourceError, match="natural logarithms"):
            import_scene(tmp_path / "a.ply", tube.sequence)

    @pytest.mark.parametrize("source", ["estimated", "aligned"])
    def test_poses_with_a_world_of_their_own(self, source: str, file: Path, tube: Tube) -> None:
        with pytest.raises(PoseError, match="world of their own"):
            import_scene(file, replace(tube.sequence, pose_source=source))
        with pytest.raises(PoseError, match="world of their own"):
            import_scene(file, replace(tube.sequence, world_from_camera=None))

    @pytest.mark.parametrize(
        ("name", "value"),
        [
            ("uc_nerf.enabled", True),
            ("coarse.train_on", "all"),
            ("coarse.refine_poses", True),
            ("poses.replace_given", True),
        ],
    )
    def test_settings_that_mean_nothing_beside_it(self, name: str, value: object, file: Path) -> None:
        config = PipelineConfig().with_overrides({"imported.scene": str(file), name: value})
        with pytest.raises(ConfigError, match=name.replace(".", r"\.")):
            config.check_imported()
        PipelineConfig().with_overrides({name: value}).check_imported()


class TestPipeline:
    def test_it_takes_the_place_of_the_coarse_scene(self, file: Path, tube: Tube, baked: Gaussians) -> None:
        config = PipelineConfig().with_overrides({"imported.scene": str(file)})
        result = run_pipeline(tube.sequence, config, until="coarse")
        assert torch.equal(result.coarse.gaussians.means, baked.means)
        assert result.reconstruction is not None
        assert result.reconstruction.history == []

    def test_poses_are_not_estimated_for_it(self, file: Path, tube: Tube) -> None:
        """Minutes of structure from motion would end in the same refusal."""
        config = PipelineConfig().with_overrides({"imported.scene": str(file)})
        with pytest.raises(PoseError, match="needs the cameras it was made with"):
            run_pipeline(replace(tube.sequence, world_from_camera=None), config, until="poses")

    def test_later_stages_are_of_its_kind(self) -> None:
        config = PipelineConfig().of_imported_scene(count=70_000, sh_degree=3, lit=False)
        assert not config.coarse.light.enabled
        assert config.coarse.sh_degree == 3
        assert config.coarse.densify.max_gaussians == 70_000
        assert config.finetune.keep_scene
        few = PipelineConfig().of_imported_scene(count=10, sh_degree=0, lit=True)
        assert few.coarse.light.enabled
        trained = PipelineConfig().with_overrides({"imported.keep": False})
        assert not trained.of_imported_scene(count=10, sh_degree=0, lit=True).finetune.keep_scene
        assert few.coarse.densify == PipelineConfig().coarse.densify
