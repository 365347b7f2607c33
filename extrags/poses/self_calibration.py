"""Intrinsics from the frames themselves: mapping with a free focal length, then the lens model that fits.

Runs in COLMAP's process (`extrags.poses.colmap`). Nothing is known of the lens but a guess, so pairs are
verified by fundamental matrices. A map is made whose focal length is free and whose distortion is zero:
with few frames the two are exchangeable, and a map that frees both at once often loses its way. Bundle
adjustment of that map with each of `LENS_MODELS` then says which lens it was. A distorted lens is held
while the map is made once more, which brings back the observations near the border that no pinhole
explained, and refined again.

An estimate is taken only where it is determined: `extrags.poses.intrinsics_covariance`.
"""

from __future__ import annotations

import shutil
from collections.abc import Callable
from copy import deepcopy
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from extrags.lens import LENS_PARAMETERS, Lens
from extrags.poses.features import read_adjusted
from extrags.poses.intrinsics_covariance import IntrinsicsCovariance, intrinsics_covariance
from extrags.poses.job import PoseJobResult
from extrags.poses.lens_calibration import LensCalibration

__all__ = ["LENS_MODELS", "MappedLens", "map_with_unknown_lens"]

LENS_MODELS = (
    ("SIMPLE_PINHOLE",),
    ("SIMPLE_RADIAL", "SIMPLE_RADIAL_FISHEYE"),
    ("RADIAL", "RADIAL_FISHEYE"),
)
"""Lens families tried, by the number of their distortion parameters."""
MIN_GAIN = 0.01
"""A model with more parameters must lower the sum of squared residuals by this share: thousands of
observations make any gain significant, but what features and moving light do wrong is not what a lens
does."""
FURTHER_STARTS = (("SIMPLE_RADIAL_FISHEYE", 120.0), ("SIMPLE_PINHOLE", 60.0), ("SIMPLE_PINHOLE", 120.0))
"""Where a free focal length leads to too small a map, or to no endoscope's lens, maps are made with lenses
that are held: the guess, then these (family and field of view). The largest map is refined."""
ENOUGH_SHARE = 0.75
"""Of the training frames: a map with fewer is tried again from another start."""
FIELDS_OF_VIEW_DEG = (30.0, 175.0)
"""An estimate outside is no endoscope's."""
_FOCAL_RATIOS = (0.1, 2.0)
"""Focal lengths that mapping may pass through, in longer image sides."""


@dataclass(frozen=True)
class MappedLens:
    """A map and the lens it was made with.

    Args:
        model: COLMAP's reconstruction, or None where there is none.
        calibration: the lens, and whether it is an estimate.
        model_sizes: registered frames of each model of the last mapping, descending.
    """

    model: Any
    calibration: LensCalibration
    model_sizes: list[int]


@dataclass(frozen=True)
class _Adjusted:
    """A map after bundle adjustment with a lens model.

    Args:
        model: COLMAP's.
        lens: its lens.
        found: its poses, points and observations.
        squares: mean squared residual of the observations, in pixels squared.
    """

    model: Any
    lens: Lens
    found: PoseJobResult
    squares: float


@dataclass(frozen=True)
class _Fit:
    model: Any
    lens: Lens
    covariance: IntrinsicsCovariance
    focal_std_px: float

    def free(self) -> tuple[str, ...]:
        return _free(self.lens.model)


def map_with_unknown_lens(
    pycolmap: Any,
    database: Path,
    guess: Lens,
    settings: dict[str, Any],
    n_train: int,
    make_map: Callable[[Path, Any], dict[int, Any]],
    options: Callable[[], Any],
    read_model: Callable[[Any], PoseJobResult],
    fitted: Callable[[], None],
) -> MappedLens:
    """Map frames of one unknown lens.

    Args:
        pycolmap: the module.
        database: with features and verified pairs; its cameras are changed in copies of it only.
        guess: a pinhole.
        settings: fields of `PosesConfig`.
        n_train: training frames.
        make_map: database and options to COLMAP's models.
        options: fresh options of mapping with fixed intrinsics.
        read_model: poses, points and observations of a model.
        fitted: called after each lens model that was fitted to a map.

    Returns:
        The largest map with the estimated lens, or with the guess where the frames do not determine it.
    """
    work = database.with_name("calibration.db")

    def mapped(lens: Lens, *, free: bool) -> tuple[Any, list[int]]:
        shutil.copy(database, work)
        store = pycolmap.Database.open(work)
        try:
            for camera in store.read_all_cameras():
                _set_lens(pycolmap, camera, lens)
                # Without a prior the first pair's focal length comes from its fundamental matrix.
                camera.has_prior_focal_length = not free
                store.update_camera(camera)
        finally:
            store.close()
        chosen = options()
        chosen.ba_refine_focal_length = free
        for part in (chosen, chosen.mapper):
            part.min_focal_length_ratio, part.max_focal_length_ratio = _FOCAL_RATIOS
        models = make_map(work, chosen)
        return largest_model(models), model_sizes(models)

    best: _Fit | None = None
    for start, free in (
        (guess, True),
        (guess, False),
        *((_with_field_of_view(guess, *family), False) for family in FURTHER_STARTS),
    ):
        model, _ = mapped(start, free=free)
        if model is None:
            continue
        found = _fitted(pycolmap, model, start, read_model, fitted)
        if best is None or _rank(found) > _rank(best):
            best = found
        # Another start helps where this one went astray, not where the motion leaves the lens open.
        enough = best.model.num_reg_images() >= ENOUGH_SHARE * n_train
        if enough and not _implausible(best):
            break
    reason = "no map could be made" if best is None else _why_not(best, settings)
    if best is None or reason:
        model, sizes = mapped(guess, free=False)
        return MappedLens(model, _kept_guess(guess, best, reason), sizes)
    if not best.lens.is_pinhole:
        model, _ = mapped(best.lens, free=False)
        if model is not None and model.num_reg_images() >= best.model.num_reg_images():
            # Simpler families were ruled out; richer ones tell the uncertainty.
            known = next(k for k, names in enumerate(LENS_MODELS) if best.lens.model in names)
            again = _fitted(pycolmap, model, best.lens, read_model, fitted, LENS_MODELS[known:])
            # The lens that was held must come out again; else the first answer stands.
            best = best if _why_not(again, settings) else again
    std = {name: best.covariance.std(name) for name in best.free()} | {"f": best.focal_std_px}
    calibration = LensCalibration(
        lens=best.lens,
        determined=True,
        estimated_focal_px=best.lens.value("f"),
        std={name: _finite(value) for name, value in std.items()},
        residual_px=_finite(best.covariance.residual_px),
    )
    return MappedLens(best.model, calibration, [best.model.num_reg_images()])


def largest_model(models: dict[int, Any]) -> Any:
    """The model with most frames, then most points; None without any."""
    if not models:
        return None
    # Ties go to the first model, whatever the order of the dictionary.
    return models[max(models, key=lambda key: (*_size(models[key]), -key))]


def model_sizes(models: dict[int, Any]) -> list[int]:
    """Registered frames of each model, descending."""
    return sorted((model.num_reg_images() for model in models.values()), reverse=True)


def _rank(fit: _Fit) -> tuple[int, int, int]:
    return int(not _implausible(fit)), *_size(fit.model)


def _size(model: Any) -> tuple[int, int]:
    return model.num_reg_images(), model.num_points3D()


def _fitted(
    pycolmap: Any,
    model: Any,
    start: Lens,
    read_model: Callable[[Any], PoseJobResult],
    fitted: Callable[[], None],
    families: tuple[tuple[str, ...], ...] = LENS_MODELS,
) -> _Fit:
    """The simplest lens that explains the map, and how far its focal length may be off.

    That is taken from the model with one distortion parameter more: which of them are zero is itself only
    estimated, and what a little distortion can pass for, the focal length is uncertain by.
    """
    before = read_model(model)
    tried = []
    for names in families:
        adjusted = []
        for name in names:
            adjusted.append(_adjusted(pycolmap, model, name, start, before, read_model))
            fitted()
        tried.append(min(adjusted, key=lambda found: found.squares))
    chosen = 0
    for richer in range(1, len(tried)):
        if tried[richer].squares < (1 - MIN_GAIN) * tried[chosen].squares:
            chosen = richer
    covariances = [_covariance(found) for found in tried[chosen : chosen + 2]]
    focal_std_px = max(covariance.std("f") for covariance in covariances)
    return _Fit(tried[chosen].model, tried[chosen].lens, covariances[0], focal_std_px)


def _adjusted(
    pycolmap: Any,
    model: Any,
    name: str,
    start: Lens,
    before: PoseJobResult,
    read_model: Callable[[Any], PoseJobResult],
) -> _Adjusted:
    """A copy of the map after bundle adjustment with another lens model; `before` is the map as it was."""
    copy = deepcopy(model)
    for camera in copy.cameras.values():
        focal = float(np.sqrt(np.prod([camera.focal_length_x, camera.focal_length_y])))
        bent = {"k1": start.value("k1"), "k2": start.value("k2")} if name == start.model else {}
        values = {"f": focal, "cx": start.value("cx"), "cy": start.value("cy"), **bent}
        parameters = tuple(values.get(key, 0.0) for key in LENS_PARAMETERS[name])
        _set_lens(pycolmap, copy.camera(camera.camera_id), Lens(name, parameters, start.width, start.height))
    options = pycolmap.BundleAdjustmentOptions()
    options.refine_principal_point = False
    options.print_summary = False
    options.ceres.solver_options.num_threads = 1
    # COLMAP's 0 goes on to the last of 100 iterations wherever the lens is poorly determined.
    options.ceres.solver_options.function_tolerance = 1e-8
    pycolmap.bundle_adjustment(copy, options)
    # Bundle adjustment drops points behind their cameras first, where there are any.
    same = copy.compute_num_observations() == len(before.observed_point)
    found = (
        read_adjusted(copy, before)
        if same and copy.num_points3D() == len(before.points)
        else read_model(copy)
    )
    lens = _lens_of(copy, start)
    return _Adjusted(copy, lens, found, _mean_square_px(lens, found))


def _set_lens(pycolmap: Any, camera: Any, lens: Lens) -> None:
    camera.model = getattr(pycolmap.CameraModelId, lens.model)
    camera.params = list(lens.parameters)


def _lens_of(model: Any, like: Lens) -> Lens:
    camera = next(iter(model.cameras.values()))
    return Lens(camera.model.name, tuple(float(p) for p in camera.params), like.width, like.height)


def _mean_square_px(lens: Lens, found: PoseJobResult) -> float:
    """Mean squared residual of the observations of points before their cameras, in pixels squared."""
    frames, frame = np.unique(found.observed_frame, return_inverse=True)
    camera_from_world = np.linalg.inv(found.world_from_camera[frames])[frame]
    points = found.points[found.observed_point]
    moved = np.einsum("oij,oj->oi", camera_from_world[:, :3, :3], points) + camera_from_world[:, :3, 3]
    before = moved[:, 2] > 0
    moved, observed = moved[before], found.observed_px[before]
    projected = np.stack(lens.project(moved[:, 0] / moved[:, 2], moved[:, 1] / moved[:, 2]), axis=1)
    return float(((projected - observed) ** 2).sum() / max(1, len(observed)))


def _covariance(adjusted: _Adjusted) -> IntrinsicsCovariance:
    lens, found = adjusted.lens, adjusted.found
    return intrinsics_covariance(
        lens,
        _free(lens.model),
        found.world_from_camera,
        found.points,
        found.observed_frame,
        found.observed_point,
        found.observed_px,
    )


def _free(model: str) -> tuple[str, ...]:
    return tuple(name for name in LENS_PARAMETERS[model] if name not in ("cx", "cy"))


def _with_field_of_view(lens: Lens, model: str, angle_deg: float) -> Lens:
    half = np.radians(angle_deg) / 2
    focal = lens.width / 2 / (half if model.endswith("FISHEYE") else np.tan(half))
    values = {"f": float(focal), "cx": lens.value("cx"), "cy": lens.value("cy")}
    parameters = tuple(values.get(name, 0.0) for name in LENS_PARAMETERS[model])
    return Lens(model, parameters, lens.width, lens.height)


def _why_not(fit: _Fit, settings: dict[str, Any]) -> str:
    """Why an estimate cannot be taken; empty where it can."""
    if problem := _implausible(fit):
        return problem
    focal = fit.lens.value("f")
    share = fit.focal_std_px / focal
    if share <= settings["max_focal_std_share"]:
        return ""
    spread = f" \N{PLUS-MINUS SIGN} {fit.focal_std_px:.0f}" if np.isfinite(share) else ""
    return f"this motion does not determine it (estimate {focal:.0f}{spread} px)"


def _implausible(fit: _Fit) -> str:
    """Why an estimate is no endoscope's lens; empty where it may be."""
    focal = fit.lens.value("f")
    if not np.isfinite(focal) or focal <= 0:
        return "bundle adjustment found no focal length"
    angle = float(np.degrees(2 * np.arctan(fit.lens.width / 2 / focal)))
    lowest, highest = FIELDS_OF_VIEW_DEG
    if not lowest <= angle <= highest:
        return f"the estimate of {focal:.0f} px (field of view {angle:.0f} degrees) is no endoscope's"
    return ""


def _kept_guess(guess: Lens, fit: _Fit | None, reason: str) -> LensCalibration:
    if fit is None:
        return LensCalibration(guess, determined=False, reason=reason)
    return LensCalibration(
        lens=guess,
        determined=False,
        estimated_focal_px=_finite(fit.lens.value("f")),
        std={"f": _finite(fit.focal_std_px)},
        residual_px=_finite(fit.covariance.residual_px),
        reason=reason,
    )


def _finite(value: float) -> float | None:
    return float(value) if np.isfinite(value) else None
