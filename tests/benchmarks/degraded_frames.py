"""Real frames with holes and blur, and no view to borrow from: what restorers make of them, on sheets."""

from __future__ import annotations

import sys
from pathlib import Path

import numpy as np
import torch
from scipy.ndimage import gaussian_filter

from data_catalog.content import content_circle
from extrags.cameras import Cameras, pixel_rays
from extrags.config import EnhanceConfig
from extrags.data_directories import data_roots
from extrags.errors import CaptureError
from extrags.metrics.lpips import LpipsByNet
from extrags.restoration.benchmark.comparison import (
    with_suffix,
)
from extrags.restoration.benchmark.evaluation import (
    RestorerBenchmark,
    TrueViews,
)
from extrags.restoration.protocol import Clip, Enhancer, Restoration
from extrags.view_synthesis.conditioning import LAYER_CHANNELS, Layers
from extrags.view_synthesis.references import LightTransfer, ReferenceViews

LAPAROSCOPY = "laparoscopy_frames_40"
TISSUE_PX = (192, 160)
SHEET_ROWS = 8


class FromItself:
    """A method whose texture, if its name asks for any, is that of what the clip itself shows."""

    def __init__(self, name: str, enhancer: Enhancer, config: EnhanceConfig) -> None:
        self.name, self.enhancer, self.config = name, enhancer, config

    def restore(self, clip: Clip) -> Restoration:
        layers = clip.layers
        known = (layers.get("alpha") > 0.98).float()
        packed = torch.cat(
            [layers.get("rendered"), known, 1 / layers.get("depth_mm").clamp_min(1e-9), known], 1
        )
        nothing = torch.zeros(len(clip), 0, dtype=torch.bool)
        own = ReferenceViews(
            np.arange(len(clip)), clip.cameras, packed, torch.ones(len(clip)), nothing, clip.transfer
        )
        try:
            method = with_suffix(self.name, self.enhancer, own, self.config)
        except CaptureError as error:
            # As restored renders do where no frame shows enough tissue between holes.
            sys.stderr.write(f"{self.name}: clip {clip.index} stays without texture: {error}\n")
            return self.enhancer.restore(clip)
        return method.restore(clip)

    def save(self, path: Path) -> None:
        self.enhancer.save(path)


def laparoscopy_benchmark(frames: int, seed: int, lpips: LpipsByNet) -> RestorerBenchmark:
    """Real frames with holes and blur, at a constant depth, without any real view to borrow from."""
    from PIL import Image

    files = sorted(file for root in data_roots() for file in (root / LAPAROSCOPY).glob("*.jpg"))
    if not files:
        raise SystemExit(f"no frames in a folder {LAPAROSCOPY} below {' or '.join(map(str, data_roots()))}")
    chosen = [files[i] for i in np.unique(np.linspace(0, len(files) - 1, frames).round().astype(int))]
    images = []
    for file in chosen:
        picture = Image.open(file).convert("RGB")
        part = picture.resize(TISSUE_PX, Image.Resampling.BOX, box=tissue_box(np.asarray(picture)))
        images.append(np.asarray(part, np.float32) / 255)
    rgb = np.stack(images)
    mask = np.ones(rgb.shape[:3], bool)
    clips = [degraded_clip(image, index, seed) for index, image in enumerate(rgb)]
    return RestorerBenchmark(clips, TrueViews(rgb, mask), lpips)


def tissue_box(picture: np.ndarray) -> tuple[float, float, float, float]:
    """The largest box of the wanted shape inside the round picture: no dark frame, no overlay text."""
    height, width = picture.shape[:2]
    circle = content_circle(picture[None])
    x, y, radius = width / 2, height / 2, height / 2
    if circle is not None:
        x, y, radius = circle.center_x, circle.center_y, circle.radius_px
    shape = np.array(TISSUE_PX) / np.hypot(*TISSUE_PX)
    half = 0.95 * radius * shape
    half *= min(1.0, min(x, width - x) / half[0], min(y, height - y) / half[1])
    return x - half[0], y - half[1], x + half[0], y + half[1]


def degraded_clip(image: np.ndarray, index: int, seed: int) -> Clip:
    """One frame as a rendering that has lost an eighth of its pixels and the detail of half of the rest."""
    height, width = image.shape[:2]
    generator = np.random.default_rng([seed, index])

    def blobs(share: float, size_px: float) -> np.ndarray:
        field = gaussian_filter(generator.standard_normal((height, width)), size_px)
        edge = np.quantile(field, 1 - share)
        return np.asarray(np.clip((field - edge) / (0.15 * field.std()) + 0.5, 0, 1), np.float32)

    hole, soft = blobs(0.125, 0.04 * width), blobs(0.5, 0.06 * width)
    blurred = gaussian_filter(image, (2.5, 2.5, 0))
    seen = image + soft[..., None] * (blurred - image)
    depth = 50.0
    K = np.array([[[float(width), 0, width / 2], [0, float(width), height / 2], [0, 0, 1]]])
    camera = Cameras(K, np.eye(4)[None], width, height)
    layers = Layers(torch.zeros(1, LAYER_CHANNELS, height, width))
    planes = {
        "alpha": 1 - hole,
        "depth_mm": depth * (hole < 0.98),
        "uncertainty": 1 - (1 - 0.6 * soft) * (1 - hole),
        "ray_length": np.linalg.norm(pixel_rays(camera)[0], axis=-1),
    }
    for name, plane in planes.items():
        layers.get(name)[0, 0] = torch.from_numpy(np.asarray(plane, np.float32))
    layers.get("rendered")[0] = torch.from_numpy(seen * (1 - hole[..., None])).permute(2, 0, 1)
    return Clip(index, camera, layers, LightTransfer(None, 0.0, depth), np.zeros(1, int), np.ones(1))


def contact_sheet(columns: dict[str, np.ndarray], file: Path) -> None:
    from PIL import Image, ImageDraw

    views, height, width = next(iter(columns.values())).shape[:3]
    rows = np.unique(np.linspace(0, views - 1, min(views, SHEET_ROWS)).round().astype(int))
    margin, title = 4, 16
    sheet = Image.new(
        "RGB", (len(columns) * (width + margin), title + len(rows) * (height + margin)), "white"
    )
    pen = ImageDraw.Draw(sheet)
    for column, (name, images) in enumerate(columns.items()):
        pen.text((column * (width + margin) + 2, 2), name, fill="black")
        for row, view in enumerate(rows):
            picture = Image.fromarray(np.rint(255 * np.clip(images[view], 0, 1)).astype(np.uint8))
            sheet.paste(picture, (column * (width + margin), title + row * (height + margin)))
    file.parent.mkdir(parents=True, exist_ok=True)
    sheet.save(file)
