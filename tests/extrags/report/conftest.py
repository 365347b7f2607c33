"""A small synthetic sequence inside a tube, with everything a report can show."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np
import pytest

from extrags.cameras import look_at, pixel_rays, rotation_about
from extrags.config import PipelineConfig
from extrags.metrics.protocol import PROTOCOL_VERSION
from extrags.report import ReportInputs
from extrags.sequence import EndoscopicSequence, Split
from tests.drawn_once import drawn_once

WIDTH, HEIGHT, RADIUS_MM = 48, 40, 10.0
TRAIN, TEST = np.arange(6), np.arange(6, 11)


@dataclass(frozen=True)
class Renders:
    rgb: np.ndarray
    alpha: np.ndarray
    depth_mm: np.ndarray


@dataclass(frozen=True)
class Pseudo:
    rendered: np.ndarray
    restored: np.ndarray
    target: np.ndarray
    uncertainty: np.ndarray
    expected_error: np.ndarray | None
    image_confidence: np.ndarray
    reference: np.ndarray
    clip: np.ndarray
    provenance: dict[str, Any]


@dataclass(frozen=True)
class Grid:
    occupancy: np.ndarray
    clearance: np.ndarray
    origin_mm: np.ndarray
    axes: np.ndarray
    voxel_mm: float


@dataclass(frozen=True)
class TubeMesh:
    vertices: np.ndarray
    triangles: np.ndarray


@pytest.fixture(scope="package", autouse=True)
def little_drawing() -> Iterator[None]:
    """Most tests are about words and numbers of a page, and their inputs differ in little."""
    with drawn_once():
        yield


@pytest.fixture(scope="session")
def sequence() -> EndoscopicSequence:
    """Eleven views along a straight tube whose axis is x, its wall striped."""
    places = np.linspace(0, 30, 11)
    poses = np.stack(
        [
            look_at(np.array([x, 0.5, 0.0]), np.array([x + 10, -1.0, 0.5]), np.array([0.0, -1.0, 0.0]))
            for x in places
        ]
    )
    K = np.tile(np.array([[30.0, 0, WIDTH / 2], [0, 30.0, HEIGHT / 2], [0, 0, 1]]), (11, 1, 1))
    bare = EndoscopicSequence(
        name="tube/0@sparse",
        rgb=np.zeros((11, HEIGHT, WIDTH, 3), dtype=np.uint8),
        K=K,
        mask=np.ones((11, HEIGHT, WIDTH), dtype=bool),
        split=Split("sparse", TRAIN, TEST),
        world_from_camera=poses,
    )
    rays = pixel_rays(bare.cameras)
    center = poses[:, None, None, :3, 3]
    a = (rays[..., 1:] ** 2).sum(-1)
    b = (rays[..., 1:] * center[..., 1:]).sum(-1)
    c = (center[..., 1:] ** 2).sum(-1) - RADIUS_MM**2
    depth = np.clip((-b + np.sqrt(b**2 - a * c)) / np.maximum(a, 1e-9), 0, 60)
    points = center + depth[..., None] * rays
    stripes = 0.5 + 0.3 * np.sin(points[..., 0]) * np.cos(4 * np.arctan2(points[..., 2], points[..., 1]))
    color = stripes[..., None] * np.array([0.9, 0.6, 0.5]) * (12 / (depth[..., None] + 12))
    return EndoscopicSequence(
        name=bare.name,
        rgb=np.rint(255 * np.clip(color, 0, 1)).astype(np.uint8),
        K=K,
        mask=bare.mask,
        split=bare.split,
        world_from_camera=poses,
        depth_mm=depth.astype(np.float32),
        observed=points[..., 0] < 28,
        frame_names=tuple(f"b_{index:03d}" for index in range(11)),
    )


def metrics_of(psnr: float) -> dict[str, object]:
    figures = {"psnr": psnr, "ssim": psnr / 40, "lpips_alex": 1 - psnr / 40, "flip": 0.3 - psnr / 200}
    return figures | {
        "depth_absrel": 0.05,
        "aligned": figures | {"psnr": psnr + 0.4},
        "observed": figures | {"psnr": psnr + 1, "pixel_share": 0.8, "aligned": figures},
        "unobserved": figures | {"psnr": psnr - 4, "pixel_share": 0.2, "aligned": figures},
    }


def result_of(psnr: float, n_gaussians: int) -> dict[str, object]:
    """As `EvaluationResult.to_json` writes it."""
    per_view = [{"frame": int(f), "name": f"b_{f:03d}"} | metrics_of(psnr + f - 8) for f in TEST]
    return {
        "protocol": PROTOCOL_VERSION,
        "sequence": "tube/0@sparse",
        "n_views": len(TEST),
        "metrics": metrics_of(psnr) | {"n_gaussians": n_gaussians},
        "reasons": {},
        "per_view": per_view,
    }


@pytest.fixture(scope="session")
def inputs(sequence: EndoscopicSequence) -> ReportInputs:
    """Everything is there."""
    random = np.random.default_rng(0)
    truth = sequence.rgb[TEST].astype(np.float32) / 255
    depth = sequence.depth_mm[TEST]
    alpha = np.ones_like(depth)
    waves = np.sin(np.arange(depth.size).reshape(depth.shape) / 7)
    coarse = Renders(
        np.clip(truth + 0.2 * random.standard_normal(truth.shape), 0, 1), alpha, depth * (1 + 0.1 * waves)
    )
    final = Renders(np.clip(truth + 0.05 * waves[..., None], 0, 1), alpha, depth * (1 + 0.02 * waves))

    noise = random.integers(0, 256, (12, HEIGHT, WIDTH, 3), dtype=np.uint8)
    pseudo = Pseudo(
        rendered=noise,
        restored=noise // 2,
        target=noise // 2 + noise // 4,
        uncertainty=random.random((12, HEIGHT, WIDTH)).astype(np.float16),
        expected_error=(0.1 * random.random((12, HEIGHT, WIDTH))).astype(np.float32),
        image_confidence=random.random(12).astype(np.float32),
        reference=np.arange(12) % 6,
        clip=np.arange(12) // 6,
        provenance={
            "backend": "embedded",
            "judged": {"restored_db": 26.04, "filled_db": 25.1, "error_over_expected": 1.24},
        },
    )
    trajectories = []
    for anchor in (0, 3):
        poses = np.repeat(sequence.world_from_camera[[anchor]], 7, axis=0)
        poses[:, :3, 3] += np.arange(7)[:, None] * np.array([1.0, 0.4, -0.2])
        poses[:, :3, :3] = rotation_about(np.array([0.0, 1, 0]), 0.3) @ poses[:, :3, :3]
        trajectories.append(poses)
    why = "12.40 % of the pixels are holes"
    return ReportInputs(
        name="tube/0@sparse",
        sequence=sequence,
        coarse=coarse,
        final=final,
        coarse_metrics=result_of(20.0, 1000),
        final_metrics=result_of(22.5, 1500),
        pseudo=pseudo,
        trajectories=trajectories,
        exploration={
            "trajectories": [
                {"anchor_frame": anchor, "views": 7, "gain": gain, "moves": [], "reason": "at its length"}
                for anchor, gain in ((0, 900), (3, 400))
            ],
            "virtual_views": 12,
            "gain": 1300,
            "gain_share": 0.04,
            "coverage_share": {"before": 0.1, "after": 0.14},
            "pairs": 32000,
            "renders": 300,
            "waves": 1,
            "rejected": ["frame b_005: adds too little"],
        },
        grid=tube_grid(),
        mesh=tube_mesh(),
        plan={
            "measurements": {"hole_share": 0.124, "n_probes": 24.0},
            "decisions": [
                {"stage": stage, "run": True, "budget": {"trajectories": 2} if stage == "explore" else {},
                 "reason": why, "value": 0.124, "threshold": 0.002}
                for stage in ("surface", "freespace", "explore", "enhance", "finetune")
            ],
        },
        stages=[
            {"stage": "ingest", "state": "cached", "seconds": 0.1, "reason": "", "made_seconds": 5.0},
            {"stage": "poses", "state": "skipped", "seconds": 0.0, "reason": "the source has poses"},
            {"stage": "coarse", "state": "ran", "seconds": 65.0, "reason": ""},
        ],
        history={
            stage: [
                {"iteration": 50.0 * i, "loss": 1 / (i + 2), "psnr": 15.0 + i, "n_gaussians": 900.0 + i}
                for i in range(10)
            ]
            for stage in ("coarse", "finetune")
        },
        environment={"Python": "3.11"},
        config=PipelineConfig().with_overrides({"coarse.iterations": 777}),
        profile="quick",
    )  # fmt: skip


def tube_grid() -> Grid:
    voxel_mm = 2.0
    center = (np.arange(24) + 0.5) * voxel_mm
    _, y, z = np.meshgrid(center - 4, center - 24, center - 24, indexing="ij")
    radius = np.hypot(y, z)
    occupancy = np.where(radius < 9, 0, np.where(radius < 12, 1, 2))
    clearance = (9 - radius).astype(np.float32)
    return Grid(occupancy.astype(np.uint8), clearance, np.array([-4.0, -24.0, -24.0]), np.eye(3), voxel_mm)


def tube_mesh() -> TubeMesh:
    angle, x = np.meshgrid(np.linspace(0, 2 * np.pi, 25)[:-1], np.linspace(0, 40, 30))
    vertices = np.stack([x, RADIUS_MM * np.cos(angle), RADIUS_MM * np.sin(angle)], -1).reshape(-1, 3)
    row, column = np.meshgrid(np.arange(29), np.arange(24), indexing="ij")
    a, b = row * 24 + column, row * 24 + (column + 1) % 24
    triangles = np.concatenate(
        [np.stack([a, b, a + 24], -1).reshape(-1, 3), np.stack([b, b + 24, a + 24], -1).reshape(-1, 3)]
    )
    return TubeMesh(vertices.astype(np.float32), triangles.astype(np.int32))
