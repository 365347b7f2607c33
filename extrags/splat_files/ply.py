"""Scenes as 3DGS PLY whose header can keep the light, so that nothing is lost on the way back.

The light stands in one comment line, `comment extrags_light {...}`, with the parameters of
`extrags.illumination.NearFieldLight` as JSON. Viewers skip comments and show albedo.
"""

from __future__ import annotations

import json
import math
from dataclasses import replace
from pathlib import Path
from typing import Any

import torch

from extrags.errors import SourceError
from extrags.gaussians import Gaussians
from extrags.illumination import INITIAL_ROUGHNESS, NearFieldLight
from extrags.scene import Scene

__all__ = ["read_ply_scene", "write_ply_scene"]

_MARK = "extrags_light "
_LINE_BYTES = 200
_BY_VALUE = ("exponent", "shoulder", "specular", "glare")
"""Written as they are, not as logarithms: light without fall-off has an exponent of zero, a linear response a
shoulder of zero, a surface without highlights a strength of zero, a clean lens a glare of zero, and JSON
cannot say minus infinity."""
_HEADER_BYTES = 1 << 22


def write_ply_scene(scene: Scene, path: Path) -> None:
    """Write the Gaussians as stored and, where there is one, the light into the header.

    A rotation of length zero is rendered as none, and written as such: readers take it for damage.

    Args:
        scene: its colours are albedo where it has a light.
        path: file to write.
    """
    gaussians = _with_rotations(scene.gaussians)
    if scene.light is None:
        gaussians.write_ply(path)
        return
    values: dict[str, Any] = {
        name: value.tolist() for name, value in scene.light.detached().parameters().items()
    }
    for name in _BY_VALUE:
        values[name] = scene.light.detached().parameters()[f"log_{name}"].double().exp().tolist()
        del values[f"log_{name}"]
    values["reference_distance"] = scene.light.reference_distance
    text = json.dumps(values, allow_nan=False, separators=(",", ":"))
    # In several lines: readers keep a line of the header in a buffer of about a thousand bytes.
    starts = range(0, len(text), _LINE_BYTES)
    gaussians.write_ply(path, comments=[_MARK + text[start : start + _LINE_BYTES] for start in starts])


def _with_rotations(gaussians: Gaussians) -> Gaussians:
    null = gaussians.quats.norm(dim=1) == 0
    if not bool(null.any()):
        return gaussians
    identity = gaussians.quats.new_tensor([1.0, 0.0, 0.0, 0.0])
    return replace(gaussians, quats=torch.where(null[:, None], identity, gaussians.quats))


def read_ply_scene(path: Path) -> Scene:
    """Read a 3DGS PLY, with the light if its header has one.

    Raises:
        SourceNotFoundError: when there is no such file.
        SourceError: when it is damaged, or a field is missing.
    """
    gaussians = Gaussians.read_ply(path)
    with path.open("rb") as stream:
        header = stream.read(_HEADER_BYTES).partition(b"end_header")[0]
    mark = f"comment {_MARK}".encode("ascii")
    parts = [line.removeprefix(mark) for line in header.splitlines() if line.startswith(mark)]
    return Scene(gaussians, _light(b"".join(parts), path) if parts else None)


_COLORS = ("glare",)
"""Those of `_BY_VALUE` that have one value per colour."""
_SHAPES: dict[str, tuple[int, ...] | None] = {
    "log_softening": (),
    "log_exposure": None,
    "spread": (),
    "cosine": (),
    "offset": (3,),
    "log_roughness": (),
}
"""Parameters of the light, and how many numbers each is; None: any, one after the other."""
_LATER = {"specular": 0.0, "log_roughness": math.log(INITIAL_ROUGHNESS), "glare": [0.0, 0.0, 0.0]}
"""What files of before there were highlights, or glare, leave out, and what it was then."""


def _light(text: bytes, path: Path) -> NearFieldLight:
    try:
        values = _LATER | json.loads(text)
        if "log_exponent" in values:  # as files of before have it
            values["exponent"] = math.exp(values.pop("log_exponent"))
        reference = float(values.pop("reference_distance"))
        strengths = {name: torch.tensor(values.pop(name), dtype=torch.float64) for name in _BY_VALUE}
        tensors = {name: torch.tensor(value, dtype=torch.float32) for name, value in values.items()}
    except (ValueError, TypeError, KeyError, AttributeError, RuntimeError, OverflowError) as error:
        raise SourceError(
            f"the light in the header cannot be read: {error}", file=path, field="extrags_light"
        ) from error
    for name in sorted(_SHAPES.keys() ^ tensors.keys()):
        what = "is missing" if name in _SHAPES else "is unknown"
        raise SourceError(f"the light's {name} {what}", file=path, field="extrags_light")
    for name, tensor in tensors.items():
        shape = _SHAPES[name]
        fits = tensor.ndim == 1 if shape is None else tuple(tensor.shape) == shape
        if not fits or not bool(torch.isfinite(tensor).all()):
            raise SourceError(
                f"the light's {name} has shape {tuple(tensor.shape)} or is not finite",
                file=path,
                field=f"extrags_light.{name}",
            )
    if not (math.isfinite(reference) and reference > 0):
        raise SourceError(
            f"the light's reference distance is {reference:g}, expected a positive number",
            file=path,
            field="extrags_light.reference_distance",
        )
    for name, value in strengths.items():
        shape, most = ((3,), 1.0) if name in _COLORS else ((), math.inf)
        fits = tuple(value.shape) == shape and bool((value.isfinite() & (value >= 0) & (value <= most)).all())
        if not fits:
            expected = "three numbers from 0 to 1" if name in _COLORS else "a number from 0 on"
            raise SourceError(
                f"the light's {name} is {str(value.tolist())[:80]}, expected {expected}",
                file=path,
                field=f"extrags_light.{name}",
            )
        tensors[f"log_{name}"] = value.log().float()
    return NearFieldLight(**tensors, reference_distance=reference)
