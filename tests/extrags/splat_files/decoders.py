"""Readers of the formats that share no code with the writers: plain loops over what the formats define."""

from __future__ import annotations

import gzip
import io
import json
import math
import struct
import zipfile
from pathlib import Path

import numpy as np
import torch
from PIL import Image
from plyfile import PlyData

from extrags.gaussians import Gaussians

SH_C0 = 0.28209479177387814


def gaussians(**columns: list[object]) -> Gaussians:
    tensors = {
        name: torch.tensor(np.array(values, dtype=np.float64), dtype=torch.float32)
        for name, values in columns.items()
    }
    count = len(tensors["means"])
    return Gaussians(
        **{
            **tensors,
            "sh0": tensors["sh0"].reshape(count, 1, 3),
            "shN": tensors["shN"].reshape(count, -1, 3),
        }
    )


def logit(share: float) -> float:
    share = min(max(share, 1e-6), 1 - 1e-6)
    return math.log(share / (1 - share))


def smallest_three(which: int, rest: list[float]) -> list[float]:
    """Four components from three and the place of the one left out, which is not negative."""
    whole = list(rest)
    whole.insert(which, math.sqrt(max(0.0, 1 - sum(value**2 for value in rest))))
    return whole


def ply(path: Path) -> Gaussians:
    """The names that 3DGS gave its properties."""
    vertex = PlyData.read(str(path))["vertex"]
    rest = sum(item.name.startswith("f_rest_") for item in vertex.properties) // 3

    def columns(names: list[str]) -> list[object]:
        return np.stack([vertex[name] for name in names], axis=1).tolist()

    channels = [[f"f_rest_{rest * channel + k}" for channel in range(3)] for k in range(rest)]
    shN = np.array([columns(names) for names in channels]).reshape(rest, len(vertex), 3)
    return gaussians(
        means=columns(["x", "y", "z"]),
        quats=columns([f"rot_{k}" for k in range(4)]),
        scales=columns([f"scale_{k}" for k in range(3)]),
        opacities=vertex["opacity"].tolist(),
        sh0=columns([f"f_dc_{k}" for k in range(3)]),
        shN=shN.transpose(1, 0, 2).tolist(),
    )


def compressed_ply(path: Path) -> Gaussians:
    """PlayCanvas: chunks of 256 with bounds; words of 11-10-11, 2-10-10-10 and 8-8-8-8 bits."""
    data = PlyData.read(str(path))
    chunk, vertex = data["chunk"], data["vertex"]
    found: dict[str, list[object]] = {name: [] for name in ("means", "quats", "scales", "opacities", "sh0")}
    for index in range(len(vertex)):
        bounds = chunk[index // 256]

        def between(word: int, names: list[str], bits: list[int], bounds: np.void = bounds) -> list[float]:
            values, shift = [], sum(bits)
            for name, width in zip(names, bits, strict=True):
                shift -= width
                share = ((word >> shift) & ((1 << width) - 1)) / ((1 << width) - 1)
                low, high = float(bounds[f"min_{name}"]), float(bounds[f"max_{name}"])
                values.append(low + share * (high - low))
            return values

        row = vertex[index]
        found["means"].append(between(int(row["packed_position"]), ["x", "y", "z"], [11, 10, 11]))
        found["scales"].append(
            between(int(row["packed_scale"]), ["scale_x", "scale_y", "scale_z"], [11, 10, 11])
        )
        color = int(row["packed_color"])
        rgb = between(color >> 8, ["r", "g", "b"], [8, 8, 8])
        found["sh0"].append([(value - 0.5) / SH_C0 for value in rgb])
        found["opacities"].append(logit((color & 255) / 255))
        word = int(row["packed_rotation"])
        rest = [(((word >> shift) & 1023) / 1023 - 0.5) * math.sqrt(2) for shift in (20, 10, 0)]
        found["quats"].append(smallest_three(word >> 30, rest))
    count = len(vertex)
    names = [item.name for item in data["sh"].properties]
    table = np.stack([data["sh"][name] for name in names], axis=1).astype(np.float64)
    # A byte stands for the middle of its interval.
    shN = ((table + 0.5) / 256 - 0.5) * 8
    return gaussians(**found, shN=shN.reshape(count, 3, -1).transpose(0, 2, 1).tolist())


def spz(path: Path) -> Gaussians:
    """Niantic, version 3: axes right, up, back."""
    data = gzip.decompress(path.read_bytes())
    magic, version, count, degree, bits = struct.unpack("<4sIIBB", data[:14])
    assert (magic, version) == (b"NGSP", 3)
    stream = io.BytesIO(data[16:])
    means = [
        [int.from_bytes(stream.read(3), "little", signed=True) / 2**bits for _ in range(3)]
        for _ in range(count)
    ]
    opacities = [logit(byte / 255) for byte in stream.read(count)]
    sh0 = [[(byte / 255 - 0.5) / 0.15 for byte in stream.read(3)] for _ in range(count)]
    scales = [[byte / 16 - 10 for byte in stream.read(3)] for _ in range(count)]
    quats = []
    for _ in range(count):
        (word,) = struct.unpack("<I", stream.read(4))
        rest = [
            (-1) ** ((word >> shift + 9) & 1) * ((word >> shift) & 511) / 511 * math.sqrt(0.5)
            for shift in (20, 10, 0)
        ]
        x, y, z, w = smallest_three(word >> 30, rest)
        # Half a turn about x from the format's axes to ours.
        quats.append([w, x, -y, -z])
    per_gaussian = ((degree + 1) ** 2 - 1) * 3
    shN = [[(byte - 128) / 128 for byte in stream.read(per_gaussian)] for _ in range(count)]
    assert not stream.read(1)
    # Real harmonics by degree l and order m: half a turn about x takes y to -y and z to -z.
    orders = [
        (order, degree_of) for degree_of in range(1, degree + 1) for order in range(-degree_of, degree_of + 1)
    ]
    signs = [(-1.0) ** (degree_of + order) * (-1.0 if order < 0 else 1.0) for order, degree_of in orders]
    turned = np.array(shN).reshape(count, -1, 3) * np.array(signs)[:, None]
    return gaussians(
        means=[[x, -y, -z] for x, y, z in means],
        quats=quats,
        scales=scales,
        opacities=opacities,
        sh0=sh0,
        shN=turned.tolist(),
    )


def sog(path: Path) -> Gaussians:
    """PlayCanvas, version 2, bundled."""
    with zipfile.ZipFile(path) as bundle:
        meta = json.loads(bundle.read("meta.json"))
        assert meta["version"] == 2
        count = meta["count"]

        def pixels(name: str) -> np.ndarray:
            with Image.open(io.BytesIO(bundle.read(name))) as image:
                assert image.format == "WEBP"
                return np.asarray(image.convert("RGBA")).astype(np.int64)

        low, high = (pixels(name).reshape(-1, 4)[:count] for name in meta["means"]["files"])
        fixed = low[:, :3] + 256 * high[:, :3]
        least, most = np.array(meta["means"]["mins"]), np.array(meta["means"]["maxs"])
        logs = least + fixed / 65535 * (most - least)
        quats = []
        for r, g, b, a in pixels(meta["quats"]["files"][0]).reshape(-1, 4)[:count].tolist():
            rest = [(byte / 255 - 0.5) * math.sqrt(2) for byte in (r, g, b)]
            quats.append(smallest_three(a - 252, rest))
        scales = np.array(meta["scales"]["codebook"])[
            pixels(meta["scales"]["files"][0]).reshape(-1, 4)[:count, :3]
        ]
        color = pixels(meta["sh0"]["files"][0]).reshape(-1, 4)[:count]
        labels = pixels(meta["shN"]["files"][1]).reshape(-1, 4)[:count]
        label = labels[:, 0] + 256 * labels[:, 1]
        coefficients = (meta["shN"]["bands"] + 1) ** 2 - 1
        centroids = pixels(meta["shN"]["files"][0])
        assert centroids.shape[1] == 64 * coefficients
        shN = [
            [centroids[which // 64, which % 64 * coefficients + k, :3] for k in range(coefficients)]
            for which in label.tolist()
        ]
        return gaussians(
            means=(np.sign(logs) * (np.exp(np.abs(logs)) - 1)).tolist(),
            quats=quats,
            scales=scales.tolist(),
            opacities=[logit(value / 255) for value in color[:, 3].tolist()],
            sh0=np.array(meta["sh0"]["codebook"])[color[:, :3]].tolist(),
            shN=np.array(meta["shN"]["codebook"])[np.array(shN)].tolist(),
        )
