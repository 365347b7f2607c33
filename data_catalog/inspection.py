"""Inspection of a source: facts, findings, and a contact sheet of its frames."""

from __future__ import annotations

import logging
import math
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float, UInt8
from pydantic import BaseModel, ConfigDict

from data_catalog.catalog import read, resolve
from data_catalog.dataset import Source
from data_catalog.diagnostics import diagnose
from data_catalog.findings import Finding, warning
from data_catalog.folder_reader import FolderReader
from data_catalog.folders import find_reader
from data_catalog.pose_conventions import OPENCV
from data_catalog.specular import specular_masks
from extrags.config import IngestConfig
from extrags.errors import ExtragsError, SourceError, UnknownSequenceError
from extrags.frame_quantiles import quantile_of_frames
from extrags.observed_surface import never_observed
from extrags.sequence import EndoscopicSequence, saturated_mask

__all__ = ["Finding", "Inspection", "contact_sheet", "facts", "inspect"]

LOGGERS = ("data_catalog", "extrags")
"""Of what looks at a source while it is read."""
_TILE_WIDTH = 240
_MAX_TILES = 30


class Inspection(BaseModel):
    """What `data check` says about a source."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    name: str
    format: str | None
    """None where the source was not even recognised."""
    conventions: str
    """Axes and units the reader assumes."""
    notes: tuple[str, ...]
    """What reading found out, e.g. the polarity of masks and assumed intrinsics."""
    findings: tuple[Finding, ...]
    facts: dict[str, Any] | None
    """Numbers of `facts`; None where the source cannot be read."""

    @property
    def ok(self) -> bool:
        """Whether nothing was found."""
        return not self.findings


def inspect(name_or_path: str | Path, config: IngestConfig | None = None) -> Inspection:
    """Read a source and report everything that is wrong with it.

    Args:
        name_or_path: what `data_catalog.catalog.resolve` takes.
        config: settings it is read with.

    Raises:
        UnknownSequenceError: neither a known name nor an existing path.
    """
    source: Source | None = None
    reader: FolderReader | None = None
    sequence: EndoscopicSequence | None = None
    conventions = ""
    notes: tuple[str, ...] = ()
    refused: ExtragsError | None = None
    with _HeardWarnings() as heard:
        try:
            source = resolve(name_or_path)
            reader = find_reader(source.format)
            conventions = "OpenCV camera axes, camera to world; mm" if reader is None else reader.conventions
            if reader is not None and reader.notes is not None:
                notes = reader.notes(Path(str(source.path)))
            sequence = read(source, config)
        except UnknownSequenceError:
            raise
        except ExtragsError as error:
            refused = error
    place = str(name_or_path) if source is None else source.path or source.name
    findings = [] if refused is None else [_as_finding(refused, place)]
    if sequence is not None and source is not None:
        # Of footage the reader itself chooses frames.
        chosen = reader is not None and reader.is_footage
        thinned = chosen or (config is not None and config.max_frames is not None)
        # What reading has warned of is said once.
        said = {item.topic for item in heard.findings}
        stored = OPENCV if reader is None else reader.poses
        found = diagnose(sequence, source.path or source.name, thinned=thinned, stored=stored)
        findings = [item for item in found if item.topic not in said]
    # Also where reading then failed: what it has warned of may be why.
    findings += [item.model_copy(update={"file": place}) for item in heard.findings]
    return Inspection(
        name=source.name if source is not None else str(name_or_path),
        format=source.format if source is not None else None,
        conventions=conventions,
        notes=(*notes, *heard.messages),
        findings=tuple(findings),
        facts=None if sequence is None else facts(sequence),
    )


def facts(sequence: EndoscopicSequence) -> dict[str, Any]:
    """Numbers that describe a sequence, ready for JSON.

    Lengths are millimetres where the sequence is metric.
    """
    K = sequence.K
    inside = max(1, int(sequence.mask.sum()))
    # Frame by frame: what is made of all of them at once would be as large as they are.
    frames = zip(sequence.rgb, sequence.mask, strict=True)
    saturated = sum(int((saturated_mask(image) & mask).sum()) for image, mask in frames)
    specular = specular_masks(sequence.rgb, sequence.mask) if sequence.specular is None else sequence.specular
    result: dict[str, Any] = {
        "frames": len(sequence),
        "train": len(sequence.train),
        "test": len(sequence.test),
        "split": f"{sequence.split.name} (version {sequence.split.version})",
        "recordings": 1 if sequence.recording is None else len(np.unique(sequence.recording)),
        "width": sequence.width,
        "height": sequence.height,
        "fx": float(K[0, 0, 0]),
        "fy": float(K[0, 1, 1]),
        "cx": float(K[0, 0, 2]),
        "cy": float(K[0, 1, 2]),
        "intrinsics": len(np.unique(K.reshape(len(K), -1), axis=0)),
        "field_of_view_deg": _field_of_view_deg(sequence),
        "length_unit": "mm" if sequence.metric else "arbitrary",
        "has_poses": sequence.world_from_camera is not None,
        "has_depth": sequence.depth_mm is not None,
        "points": 0 if sequence.points is None else len(sequence.points),
        "masked_share": float(1 - sequence.mask.mean()),
        "specular_share": float(specular.sum() / inside),
        "saturated_share": saturated / inside,
    }
    if sequence.stereo_camera is not None:
        result["stereo_camera"] = sequence.stereo_camera
    if sequence.world_from_camera is not None:
        centers = sequence.cameras.centers
        result["path_length"] = float(np.linalg.norm(np.diff(centers, axis=0), axis=1).sum())
        result["reach"] = float(np.linalg.norm(np.ptp(centers, axis=0)))
    if sequence.depth_mm is not None:
        depths = sequence.depth_mm
        known = zip(depths, sequence.mask, strict=True)
        result["depth_known_share"] = sum(int(((depth > 0) & mask).sum()) for depth, mask in known) / inside
        result["depth"] = {
            name: quantile_of_frames(lambda: _known_depths(sequence), share) or 0.0
            for name, share in (("p1", 0.01), ("median", 0.5), ("p99", 0.99))
        }
    if sequence.observed is not None and len(sequence.test):
        seen = sum(int((sequence.observed[index] & sequence.mask[index]).sum()) for index in sequence.test)
        unseen = sum(int(never_observed(sequence, int(index)).sum()) for index in sequence.test)
        if seen + unseen:
            result["observed_share"] = seen / (seen + unseen)
    return result


def _known_depths(sequence: EndoscopicSequence) -> Iterator[Float[np.ndarray, "n"]]:
    """Those inside the mask, of one frame after the other: what lies beyond is no tissue."""
    assert sequence.depth_mm is not None
    for depth, mask in zip(sequence.depth_mm, sequence.mask, strict=True):
        yield depth[(depth > 0) & mask]


def contact_sheet(sequence: EndoscopicSequence) -> UInt8[np.ndarray, "h w 3"]:
    """Frames spread over the sequence: masked pixels blue, highlights green, held-out frames framed.

    Where there is depth, it stands below each frame (near is bright).
    """
    import cv2

    count = min(len(sequence), _MAX_TILES)
    chosen = np.round(np.linspace(0, len(sequence) - 1, count)).astype(int)
    specular = (
        specular_masks(sequence.rgb[chosen], sequence.mask[chosen])
        if sequence.specular is None
        else sequence.specular[chosen]
    )
    farthest = 1.0
    if sequence.depth_mm is not None:
        farthest = quantile_of_frames(lambda: _known_depths(sequence), 0.99) or farthest
    height = round(_TILE_WIDTH * sequence.height / sequence.width)
    tiles = []
    for index, shine in zip(chosen.tolist(), specular, strict=True):
        picture = sequence.rgb[index].copy()
        outside = ~sequence.mask[index]
        picture[outside] = picture[outside] // 2 + np.array([0, 0, 90], dtype=np.uint8)
        picture[shine] = (0, 255, 0)
        parts = [picture]
        if sequence.depth_mm is not None:
            near = 1 - np.clip(sequence.depth_mm[index] / farthest, 0, 1)
            grey = np.where(sequence.depth_mm[index] > 0, 40 + 215 * near, 0).astype(np.uint8)
            parts.append(np.repeat(grey[..., None], 3, axis=2))
        tile = np.vstack(
            [cv2.resize(part, (_TILE_WIDTH, height), interpolation=cv2.INTER_AREA) for part in parts]
        )
        if index in sequence.test:
            cv2.rectangle(tile, (1, 1), (_TILE_WIDTH - 2, tile.shape[0] - 2), (255, 210, 0), 2)
        label = sequence.frame_name(index)
        # Dark below light, to be read on any picture.
        for color, width in (((0, 0, 0), 3), ((255, 255, 255), 1)):
            cv2.putText(tile, label, (6, 16), cv2.FONT_HERSHEY_SIMPLEX, 0.45, color, width, cv2.LINE_AA)
        tiles.append(tile)
    columns = min(count, max(1, round(math.sqrt(count * tiles[0].shape[0] * 1.6 / _TILE_WIDTH))))
    blank = np.zeros_like(tiles[0])
    tiles += [blank] * (-count % columns)
    rows = [np.hstack(tiles[start : start + columns]) for start in range(0, len(tiles), columns)]
    return np.asarray(np.vstack(rows), dtype=np.uint8)


def _as_finding(error: ExtragsError, place: str) -> Finding:
    """Why a source cannot be read; settings, which name no file, are wrong for this one."""
    if isinstance(error, SourceError):
        return Finding(
            kind="error",
            topic="cannot be read",
            sentence=error.problem,
            file=error.file or place,
            frame=error.frame,
            field=error.field,
        )
    return Finding(kind="error", topic="cannot be read", sentence=str(error), file=place)


class _HeardWarnings(logging.Handler):
    """Collects what readers warn of while a source is read: assumptions a user should know."""

    def __init__(self) -> None:
        super().__init__(logging.WARNING)
        self.messages: list[str] = []
        self.findings: list[Finding] = []
        """Of warnings that have a topic: what a sequence does not show any more."""

    def emit(self, record: logging.LogRecord) -> None:
        topic = getattr(record, "topic", None)
        if topic is None:
            self.messages.append(record.getMessage())
        else:
            field = getattr(record, "field", "K")
            found = warning(topic, record.getMessage(), field=field)
            self.findings.append(found.model_copy(update={"kind": getattr(record, "kind", "warning")}))

    def __enter__(self) -> _HeardWarnings:
        for name in LOGGERS:
            logging.getLogger(name).addHandler(self)
        return self

    def __exit__(self, *_: object) -> None:
        for name in LOGGERS:
            logging.getLogger(name).removeHandler(self)


def _field_of_view_deg(sequence: EndoscopicSequence) -> float:
    """Horizontal, of the first frame."""
    K, lens = sequence.K[0], sequence.lens
    if lens is None:
        return float(np.degrees(2 * np.arctan(sequence.width / 2 / K[0, 0])))
    edges = np.array([K[0, 2], sequence.width - K[0, 2]]) / K[0, 0]
    return float(np.degrees(np.minimum(lens.angle(edges), lens.max_angle_rad).sum()))
