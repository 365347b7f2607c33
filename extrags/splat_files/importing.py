"""A scene that another program has made, held against the cameras it shall be used with."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Float

from extrags.config import ImportedConfig
from extrags.errors import PoseError, SourceError
from extrags.frame_quantiles import median_of_frames
from extrags.gaussians import Gaussians
from extrags.scene import NEAR, SHALLOWEST, Scene
from extrags.sequence import EndoscopicSequence
from extrags.splat_files.reading import read_splat_file
from extrags.splat_files.scale_search import LARGEST_SCALE, SMALLEST_SCALE, ScaleSearch

__all__ = ["ImportedScene", "import_scene"]

_FARTHEST = 1e7
_LARGEST_LOG_SCALE = 16.0
_MIN_SEEN_SHARE = 0.05
_CERTAIN_MISFIT = 0.05
"""Where known depth agrees so well, no other scale is looked for."""
_LOOSE_SCALE = 1.5
_LOW_CORRELATION = 0.5
_SAMPLE = 20_000
"""So many Gaussians tell how far away a scene is."""
_WIDTH_PX = 160
_VIEWS_PER_BATCH = 8


@dataclass(frozen=True)
class ImportedScene:
    """A scene from a file, and what the training views say of it.

    Args:
        scene: in the world of the sequence.
        seen_share: pixels of the training views that show it.
        psnr: of its renderings against the training frames, in dB.
        depth_ratio: median of its depth over the frames' depth; None where none is known.
        statements: what has to be known of it, in words.
    """

    scene: Scene
    seen_share: float
    psnr: float
    depth_ratio: float | None
    statements: tuple[str, ...]


def import_scene(
    path: Path, sequence: EndoscopicSequence, config: ImportedConfig | None = None
) -> ImportedScene:
    """Read a scene and check that the sequence's cameras see it where it should be.

    Args:
        path: 3DGS PLY or SPZ; a PLY of `write_ply_scene` brings its light. Its exposures are kept where there
            is one for each training frame, else they are the mean.
        sequence: whose training frames are looked at, with the poses of its source.
        config: scale of the file's unit.

    Raises:
        SourceError: when the file is damaged, numbers are out of range, another scale fits the frames clearly
            better (it is named, and was rendered), none fits, or the unit of scene and cameras is too large
            for a scene without light.
        PoseError: when the sequence's poses are not those of its source: estimated ones have their own world.
    """
    config = ImportedConfig() if config is None else config
    if sequence.world_from_camera is None or sequence.pose_source not in ("given", "refined"):
        raise PoseError(
            f"{sequence.name}: an imported scene needs the cameras it was made with; poses that are "
            "estimated here have a world of their own",
            file=path,
            field="world_from_camera",
        )
    given = read_splat_file(path)
    scene = _in_range(_scaled(given, config.scale), path)
    statements = []
    if scene.light is not None and len(scene.light.log_exposure) != len(sequence.train):
        statements.append(
            f"its light has exposures of {len(scene.light.log_exposure)} frames, the sequence has "
            f"{len(sequence.train)} training frames: they start from the mean"
        )
        scene = Scene(scene.gaussians, replace(scene.light, log_exposure=torch.zeros(len(sequence.train))))
    # Known depth says how large the unit is whatever the scale; without it the scale has to be right first.
    if sequence.training_depth_known:
        _check_unit(scene, sequence, config.scale, path)
    statements += _scale_statements(given, sequence, config.scale, path)
    if not sequence.training_depth_known:
        _check_unit(scene, sequence, config.scale, path)
    seen, error, ratio = _compared(scene, sequence)
    if seen < _MIN_SEEN_SHARE:
        raise SourceError(
            f"{_elsewhere(scene, sequence, seen)}. Were other cameras used, other axes, or another light?",
            file=path,
            field="means",
        )
    if scene.light is None:
        statements.append("without light: its colours hold the brightness of its recording")
    statements.append("it may have been made from held-out frames too: nothing in the file says so")
    psnr = -10 * math.log10(max(error, 1e-20))
    return ImportedScene(scene, seen, psnr, ratio, tuple(statements))


def _check_unit(scene: Scene, sequence: EndoscopicSequence, scale: float, path: Path) -> None:
    depth = None if scene.light is not None else _typical_depth(scene, sequence)
    if depth is not None and depth < SHALLOWEST:
        raise SourceError(
            f"the typical depth in {sequence.name} is {depth:.3g} units, too small without light, as nothing "
            f"nearer than {NEAR:g} is rendered; scale its poses and depth up, and imported.scale, now "
            f"{scale:g}, by the same factor",
            file=path,
            field="imported.scale",
        )


def _scale_statements(given: Scene, sequence: EndoscopicSequence, scale: float, path: Path) -> list[str]:
    """Refuse a scale that the frames contradict; returns what has to be known of one that they do not.

    Args:
        given: in the unit of its file.
        sequence: posed frames.
        scale: units of the sequence in one of the file.
        path: the file, for messages.

    Raises:
        SourceError: another scale is clearly better, and was rendered; or none fits.
    """
    search = ScaleSearch(given, sequence)
    found = search.at(scale)
    if found.correlation is None and found.depth_error is None:
        return ["the frames have neither depth nor contrast: nothing tells its scale"]
    statements = []
    if found.misfit > _CERTAIN_MISFIT or found.depth_error is None or not found.fits:
        tried = search.along()
        best = search.refined(min(tried, key=lambda fit: fit.misfit))
        if best.fits and (best.clearly_better_than(found) or not found.possible):
            raise SourceError(
                f"with imported.scale {scale:g}, the training views {found.words}; with {best.scale:g}, "
                f"which fits, they {best.words}",
                file=path,
                field="imported.scale",
            )
        if not found.possible:
            span = f"from {SMALLEST_SCALE:g} to {LARGEST_SCALE:g}"
            told = (
                f"Scales {span} could not be searched finely enough: the cameras are too far from the origin "
                "for what is near them, and the scale that fits may lie between those that were tried. Is "
                "imported.scale right? An origin near the cameras would tell. With the best"
                if search.may_have_missed(tried)
                else f"No scale {span} puts it where the frames show it: with the best"
            )
            raise SourceError(
                f"{_elsewhere(_scaled(given, scale), sequence, found.shown_share)}. {told}, {best.scale:g}, "
                f"they {best.words}. Were other cameras used, other axes, or another light?",
                file=path,
                field="means",
            )
        # The steps may miss what the given scale and the refined one show.
        possible = [fit for fit in (found, best, *tried) if fit.possible]
        least = min(possible, key=lambda fit: fit.misfit)
        alike = [scale, *(fit.scale for fit in possible if not least.clearly_better_than(fit))]
        if found.depth_error is None and max(alike) > _LOOSE_SCALE * min(alike):
            statements.append(
                "its scale was taken as given: the frames have no depth, and their pictures fit alike from "
                f"{min(alike):.2g} to {max(alike):.2g}"
            )
    if found.correlation is not None and found.correlation < _LOW_CORRELATION:
        statements.append(
            f"its pictures and the training frames correlate by {found.correlation:.2f} only: its cameras, "
            "its light or its colours may be others"
        )
    return statements


def _scaled(scene: Scene, scale: float) -> Scene:
    if scale == 1:
        return scene
    values = scene.gaussians.parameters()
    light = scene.light
    if light is not None:
        light = replace(light, reference_distance=light.reference_distance * scale)
    return Scene(
        Gaussians(
            **{**values, "means": values["means"] * scale, "scales": values["scales"] + math.log(scale)}
        ),
        light,
    )


def _in_range(scene: Scene, path: Path) -> Scene:
    gaussians = scene.gaussians
    far = gaussians.means.abs().amax(dim=1)
    if bool((far > _FARTHEST).any()):
        raise SourceError(
            f"{int((far > _FARTHEST).sum())} of {len(gaussians)} Gaussians lie farther than {_FARTHEST:g} "
            f"units from the origin, the farthest {float(far.max()):.3g}",
            file=path,
            field="means",
        )
    large = gaussians.scales.amax(dim=1)
    if bool((large > _LARGEST_LOG_SCALE).any()):
        raise SourceError(
            f"{int((large > _LARGEST_LOG_SCALE).sum())} of {len(gaussians)} Gaussians have scales above "
            f"{_LARGEST_LOG_SCALE:g}, the largest {float(large.max()):.3g}; scales are natural logarithms",
            file=path,
            field="scales",
        )
    return scene


def _typical_depth(scene: Scene, sequence: EndoscopicSequence) -> float | None:
    """Median depth of the training frames, or of the Gaussians in their views; None where there are none."""
    known = sequence.depth_mm
    if known is not None:
        given = median_of_frames(
            lambda: (known[k][(known[k] > 0) & sequence.mask[k]] for k in sequence.train.tolist())
        )
        if given is not None:
            return given
    means = scene.gaussians.means.numpy().astype(np.float64)
    points = means[:: -(-len(means) // _SAMPLE)]
    cameras, found = sequence.training_cameras, [np.zeros(0)]
    for index in range(len(cameras)):
        pixels, depth = cameras[index].project(points)
        found.append(depth[cameras.contains(pixels)])
    depths = np.concatenate(found)
    return float(np.median(depths)) if len(depths) else None


def _compared(scene: Scene, sequence: EndoscopicSequence) -> tuple[float, float, float | None]:
    """Share of the training pixels that show the scene, mean squared error there, and ratio of depths."""
    from torch.nn import functional

    train = sequence.train
    cameras = sequence.training_cameras.at_most_width(_WIDTH_PX)
    size = cameras.height, cameras.width
    exposures = None if scene.light is None else scene.light.exposures()
    shown, total, error, count = 0, 0, 0.0, 0
    ratios: list[Float[np.ndarray, "k"]] = []
    for begun in range(0, len(train), _VIEWS_PER_BATCH):
        frames = train[begun : begun + _VIEWS_PER_BATCH]
        part = slice(begun, begun + len(frames))
        with torch.no_grad():
            rendering = scene.render(
                cameras[part], exposure=None if exposures is None else exposures[part], median_depth=True
            )
        images = torch.from_numpy(sequence.rgb[frames]).permute(0, 3, 1, 2).float() / 255
        images = functional.interpolate(images, size, mode="area").permute(0, 2, 3, 1)
        # Nearest pixels: depth and masks are not averaged over edges.
        rows = ((np.arange(size[0]) + 0.5) * sequence.height / size[0]).astype(np.int64)
        columns = ((np.arange(size[1]) + 0.5) * sequence.width / size[1]).astype(np.int64)
        mask = sequence.mask[frames][:, rows][:, :, columns]
        hit = (rendering.alpha.numpy() > 0.5) & mask
        shown, total = shown + int(hit.sum()), total + int(mask.sum())
        error += float(((rendering.rgb.clamp(0, 1) - images) ** 2).mean(dim=-1).numpy()[hit].sum())
        count += int(hit.sum())
        if sequence.depth_mm is not None:
            known = sequence.depth_mm[frames][:, rows][:, :, columns]
            both = hit & (known > 0)
            ratios.append((np.asarray(rendering.median_depth)[both] / known[both]).astype(np.float64))
    ratio = np.concatenate(ratios) if ratios else np.zeros(0)
    return (
        shown / max(1, total),
        error / max(1, count),
        float(np.median(ratio)) if len(ratio) else None,
    )


def _elsewhere(scene: Scene, sequence: EndoscopicSequence, seen: float) -> str:
    means = scene.gaussians.means.numpy().astype(np.float64)
    centers = sequence.training_cameras.centers

    def place(points: Float[np.ndarray, "p 3"]) -> str:
        center = np.median(points, axis=0)
        spread = float(np.median(np.linalg.norm(points - center, axis=1)))
        return f"({', '.join(f'{value:.3g}' for value in center)}), half of them within {spread:.3g}"

    return (
        f"the training views of {sequence.name} show it in {100 * seen:.1f} % of their pixels; its Gaussians "
        f"are around {place(means)}, the cameras around {place(centers)} units"
    )
