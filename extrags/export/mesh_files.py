"""Meshes as GLB, OBJ and PLY, with texture where the format has one and with what was invented."""

from __future__ import annotations

import io
import json
import struct
from contextlib import ExitStack
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import UInt8

from extrags.errors import ConfigError
from extrags.export.textured import ColoredMesh
from extrags.output_files import whole_file, write_file
from extrags.surface import write_triangle_ply

__all__ = ["MESH_FORMATS", "write_mesh"]

MESH_FORMATS = (".glb", ".obj", ".ply")
_FLOAT, _UINT = 5126, 5125
_ARRAY, _ELEMENTS = 34962, 34963
_METRES = 0.001


def write_mesh(colored: ColoredMesh, path: Path, *, metric: bool = True) -> tuple[Path, ...]:
    """Write a mesh in the format that the name ends with.

    * `.glb`: texture, or colours of vertices without one; vertex attribute `_INVENTED`; metres (a scaled
      node) where the world's unit is millimetres, world units otherwise.
    * `.obj`: where there is a texture, its material and image beside it, `NAME_texture.mtl` and
      `NAME_texture.png`, with white space in the name as underscores; colours behind the positions;
      groups `observed` and `invented`, since the format has no attributes; world units.
    * `.ply`: colours and `invented` of vertices; the format has no texture that viewers agree on; world
      units.

    Args:
        colored: the mesh.
        path: its suffix chooses the format.
        metric: the world's unit is millimetres.

    Returns:
        The files written, `path` first.

    Raises:
        ConfigError: for another suffix.
    """
    suffix = path.suffix.lower()
    if suffix == ".glb":
        write_file(path, _glb(colored, metric))
    elif suffix == ".obj":
        return path, *_write_obj(colored, path)
    elif suffix == ".ply":
        _write_ply(colored, path)
    else:
        raise ConfigError(
            f"a mesh is written as {', '.join(MESH_FORMATS)}; {path.name} ends in none of these"
        )
    return (path,)


def _write_ply(colored: ColoredMesh, path: Path) -> None:
    mesh = colored.mesh
    vertex = np.empty(
        len(mesh.vertices),
        dtype=[(axis, "f4") for axis in "xyz"]
        + [(name, "u1") for name in ("red", "green", "blue")]
        + [("invented", "f4")],
    )
    for index, axis in enumerate("xyz"):
        vertex[axis] = mesh.vertices[:, index]
    for index, name in enumerate(("red", "green", "blue")):
        vertex[name] = colored.colors[:, index]
    vertex["invented"] = colored.invented
    write_triangle_ply(path, vertex, mesh.triangles)


def _write_obj(colored: ColoredMesh, path: Path) -> tuple[Path, ...]:
    """Write the mesh; returns what was written beside it."""
    mesh, uv = colored.mesh, colored.uv
    beside: tuple[Path, ...] = ()
    contents: dict[Path, bytes] = {}
    lines = ["# extrags; v: x y z red green blue"]
    if colored.texture is not None:
        # Both formats end a name at white space. Pictures called as the mesh are often there already.
        stem = "_".join([*path.stem.split(), "texture"])
        material, picture = beside = path.with_name(f"{stem}.mtl"), path.with_name(f"{stem}.png")
        contents[picture] = _png(colored.texture)
        contents[material] = (
            f"newmtl surface\nKa 0 0 0\nKd 1 1 1\nKs 0 0 0\nillum 1\nmap_Kd {picture.name}\n".encode()
        )
        lines.append(f"mtllib {material.name}")
    for position, color in zip(mesh.vertices.tolist(), (colored.colors / 255).tolist(), strict=True):
        lines.append("v " + " ".join(f"{value:.7g}" for value in position + color))
    if uv is not None:
        lines += [f"vt {u:.7g} {v:.7g}" for u, v in uv.reshape(-1, 2).tolist()]
        lines.append("usemtl surface")
    # A triangle is invented as soon as one of its corners is.
    invented = (colored.invented[mesh.triangles] > 0).any(axis=1)
    for name, chosen in (("observed", ~invented), ("invented", invented)):
        if not chosen.any():
            continue
        lines.append(f"g {name}")
        for index in np.flatnonzero(chosen).tolist():
            corners = (mesh.triangles[index] + 1).tolist()
            if uv is None:
                lines.append("f " + " ".join(str(corner) for corner in corners))
            else:
                lines.append(
                    "f " + " ".join(f"{corner}/{3 * index + k + 1}" for k, corner in enumerate(corners))
                )
    contents[path] = ("\n".join(lines) + "\n").encode()
    # All are written before the first takes its place, that of the mesh last: together they are one mesh.
    with ExitStack() as unfinished:
        partials = {file: unfinished.enter_context(whole_file(file)) for file in reversed(contents)}
        for file, content in contents.items():
            partials[file].write_bytes(content)
    return beside


def _glb(colored: ColoredMesh, metric: bool) -> bytes:
    indices, attributes = _corners(colored)
    buffer = _Buffer()
    placed = {name: buffer.accessor(values, _FLOAT, _ARRAY) for name, values in attributes.items()}
    corners = buffer.accessor(indices, _UINT, _ELEMENTS)
    surface: dict[str, Any] = {"metallicFactor": 0.0, "roughnessFactor": 1.0}
    # Unlit: the light is in the colours already.
    material = {
        "pbrMetallicRoughness": surface,
        "doubleSided": True,
        "extensions": {"KHR_materials_unlit": {}},
    }
    content: dict[str, Any] = {
        "asset": {"version": "2.0", "generator": "extrags"},
        "extensionsUsed": ["KHR_materials_unlit"],
        "scene": 0,
        "scenes": [{"nodes": [0]}],
        "nodes": [{"mesh": 0, "name": "surface"} | ({"scale": [_METRES] * 3} if metric else {})],
        "meshes": [{"primitives": [{"attributes": placed, "indices": corners, "material": 0}]}],
        "materials": [material],
        "accessors": buffer.accessors,
    }
    if colored.texture is not None:
        picture = buffer.view(_png(colored.texture))
        surface["baseColorTexture"] = {"index": 0}
        content |= {
            "images": [{"bufferView": picture, "mimeType": "image/png"}],
            "samplers": [{"magFilter": 9729, "minFilter": 9729, "wrapS": 33071, "wrapT": 33071}],
            "textures": [{"source": 0, "sampler": 0}],
        }
    content["bufferViews"] = buffer.views
    content["buffers"] = [{"byteLength": len(buffer.content)}]
    return _container(json.dumps(content, separators=(",", ":")).encode(), buffer.content)


def _corners(colored: ColoredMesh) -> tuple[np.ndarray, dict[str, np.ndarray]]:
    """Vertices of the triangles' corners, and the attributes of vertices by their names in glTF."""
    mesh = colored.mesh
    corners = mesh.triangles.reshape(-1)
    if colored.uv is None:
        return corners, {
            "POSITION": mesh.vertices,
            "COLOR_0": _linear(colored.colors),
            "_INVENTED": colored.invented,
        }
    # A vertex has one place in the texture in each of its triangles, so every corner is a vertex.
    return np.arange(len(corners)), {
        "POSITION": mesh.vertices[corners],
        "TEXCOORD_0": colored.uv.reshape(-1, 2) * [1, -1] + [0, 1],
        "_INVENTED": colored.invented[corners],
    }


class _Buffer:
    """The binary part of a GLB file, and how its JSON describes it."""

    def __init__(self) -> None:
        self.content = bytearray()
        self.views: list[dict[str, Any]] = []
        self.accessors: list[dict[str, Any]] = []

    def view(self, content: bytes, target: int | None = None) -> int:
        """Append bytes; returns the number of the view."""
        self.views.append(
            {"buffer": 0, "byteOffset": len(self.content), "byteLength": len(content)}
            | ({} if target is None else {"target": target})
        )
        self.content += content + b"\0" * (-len(content) % 4)
        return len(self.views) - 1

    def accessor(self, values: np.ndarray, kind: int, target: int) -> int:
        """Append an array of scalars or vectors; returns the number of the accessor."""
        values = np.ascontiguousarray(values, dtype="<f4" if kind == _FLOAT else "<u4")
        self.accessors.append(
            {
                "bufferView": self.view(values.tobytes(), target),
                "componentType": kind,
                "count": len(values),
                "type": "SCALAR" if values.ndim == 1 else f"VEC{values.shape[1]}",
                "min": np.atleast_1d(values.min(axis=0)).tolist(),
                "max": np.atleast_1d(values.max(axis=0)).tolist(),
            }
        )
        return len(self.accessors) - 1


def _container(text: bytes, body: bytes | bytearray) -> bytes:
    """A GLB file of its JSON and of its buffer, whose length is a multiple of four."""
    text += b" " * (-len(text) % 4)
    return (
        struct.pack("<4sII", b"glTF", 2, 12 + 8 + len(text) + 8 + len(body))
        + struct.pack("<I4s", len(text), b"JSON")
        + text
        + struct.pack("<I4s", len(body), b"BIN\0")
        + body
    )


def _linear(colors: UInt8[np.ndarray, "v 3"]) -> np.ndarray:
    """Colours of vertices in glTF are linear, textures are sRGB."""
    share = colors.astype(np.float64) / 255
    return np.where(share <= 0.04045, share / 12.92, ((share + 0.055) / 1.055) ** 2.4)


def _png(image: UInt8[np.ndarray, "h w 3"]) -> bytes:
    from PIL import Image

    buffer = io.BytesIO()
    Image.fromarray(image).save(buffer, "PNG")
    return buffer.getvalue()
