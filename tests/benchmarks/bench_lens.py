"""Native lens against pinhole, on a phantom seen through a fisheye: `python -m tests.benchmarks.bench_lens`.

A development phantom is photographed with the lens of C3VDv2's endoscope. The frames are reconstructed
twice: in their own pixels (`ingest.lens=native`), and resampled to the pinhole of 100 degrees. Both scenes
render the held-out frames through the lens; printed are their errors inside the pinhole's field and outside
it, the share of the source's pixels that each uses, and processor time per iteration. `--sequence` takes a
source on disk whose frames have distortion instead. `--write FOLDER` writes the phantom as a COLMAP workspace
and stops.
"""

from __future__ import annotations

import argparse
import json
import time
from dataclasses import replace
from pathlib import Path

import numpy as np
import torch

from data_catalog import read, resolve
from data_catalog.phantom import recording
from data_catalog.phantom.config import PhantomConfig
from data_catalog.readers.colmap_model import write_colmap
from extrags.cameras import Cameras
from extrags.config import PROFILES, IngestConfig
from extrags.evaluation import render
from extrags.lens import distortion_of_pinhole
from extrags.metrics.filters import filter_separable, gaussian_weights
from extrags.radial_lens import RadialLens
from extrags.raster.native import set_num_threads
from extrags.sequence import EndoscopicSequence
from extrags.training import reconstruct

LENS = RadialLens((-0.2093, 0.03965, 0.007875, -0.003337), float(np.radians(85)))
"""Of C3VDv2, as `ingest.lens=native` fits it."""
FOCAL_SHARE = 0.571
"""Its focal length as a share of the image's width."""


class _FisheyePhantom(recording.Phantom):
    """The same colon through the lens."""

    def cameras(self, recording: str, share: np.ndarray, *, width: int = 0, height: int = 0) -> Cameras:
        views = super().cameras(recording, share, width=width, height=height)
        K = views.K.copy()
        K[:, 0, 0] = K[:, 1, 1] = FOCAL_SHARE * views.width
        return Cameras(K, views.world_from_camera, views.width, views.height, LENS)


def fisheye_phantom(scene: int, setting: str, **settings: object) -> EndoscopicSequence:
    """A phantom's frames in the lens's own pixels."""
    pinhole_phantom = recording.Phantom
    recording.Phantom = _FisheyePhantom  # type: ignore[misc]
    try:
        config = PhantomConfig.model_validate({"scene": scene, "setting": setting, **settings})
        found = recording.record(config, f"fisheye-phantom/{scene}@{setting}")
    finally:
        recording.Phantom = pinhole_phantom  # type: ignore[misc]
    cameras = Cameras(found.K, found.cameras.world_from_camera, found.width, found.height, LENS)
    return replace(found, lens=LENS, mask=found.mask & cameras.field)


def pixel_errors(image: np.ndarray, truth: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Squared error and SSIM of each pixel, mean over the channels."""
    x, y = (torch.from_numpy(part.astype(np.float64)).permute(2, 0, 1)[:, None] for part in (image, truth))
    window = gaussian_weights(1.5, 5)

    def blurred(part: torch.Tensor) -> torch.Tensor:
        return filter_separable(part, window, window)

    mx, my = blurred(x), blurred(y)
    vx, vy, vxy = blurred(x * x) - mx * mx, blurred(y * y) - my * my, blurred(x * y) - mx * my
    ssim = (2 * mx * my + 1e-4) * (2 * vxy + 9e-4) / ((mx * mx + my * my + 1e-4) * (vx + vy + 9e-4))
    return ((image - truth) ** 2).mean(axis=2), ssim[:, 0].mean(dim=0).numpy()


def figures(scene: object, native: EndoscopicSequence, pinhole_K: np.ndarray) -> dict[str, float]:
    """Errors of the held-out frames in their own pixels, inside the pinhole's field and outside it."""
    views = render(scene, native)  # type: ignore[arg-type]
    assert native.lens is not None
    sums: dict[str, list[float]] = {"inside": [0, 0, 0], "outside": [0, 0, 0]}
    for place, frame in enumerate(native.test):
        back = distortion_of_pinhole(native.K[frame], native.lens, pinhole_K, native.width, native.height)
        square, ssim = pixel_errors(np.clip(views.rgb[place], 0, 1), native.rgb[frame] / 255.0)
        for name, field in (("inside", back.valid), ("outside", ~back.valid)):
            chosen = field & native.mask[frame]
            for k, part in enumerate((square[chosen].sum(), ssim[chosen].sum(), chosen.sum())):
                sums[name][k] += float(part)
    found = {}
    for name, (square_sum, ssim_sum, count) in sums.items():
        found[f"{name}_psnr"] = -10 * float(np.log10(square_sum / count))
        found[f"{name}_ssim"] = ssim_sum / count
        found[f"{name}_share"] = count / sum(part[2] for part in sums.values())
    return found


def main() -> None:
    """Parse the command line."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--scene", type=int, default=11)
    parser.add_argument("--setting", default="sparse")
    parser.add_argument("--width", type=int, default=160)
    parser.add_argument("--sequence", help="a source with distortion instead of the phantom")
    parser.add_argument("--iterations", type=int, default=1500)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--write", type=Path, help="write the phantom as a COLMAP workspace, and stop")
    given = parser.parse_args()
    set_num_threads(1)
    if given.sequence is None:
        size = {"width": given.width, "height": round(0.8 * given.width)}
        native = fisheye_phantom(given.scene, given.setting, **size)
        if given.write is not None:
            write_colmap(native, given.write)
            return
        pinhole = native.as_pinhole()
        wide = native.cameras[[0]].as_pinholes()
        back = distortion_of_pinhole(native.K[0], LENS, wide.K[0], native.width, native.height)
        used = {"native": float(native.mask.mean()), "pinhole": float((native.mask & back.valid).mean())}
    else:
        settings = {"width": given.width}
        native, pinhole = (
            read(resolve(given.sequence), IngestConfig.model_validate({**settings, "lens": lens}))
            for lens in ("native", "pinhole")
        )
        assert native.lens is not None
        back = distortion_of_pinhole(native.K[0], native.lens, pinhole.K[0], native.width, native.height)
        used = {"native": float(native.mask.mean()), "pinhole": float((native.mask & back.valid).mean())}
    coarse = PROFILES["quick"].coarse.model_copy(update={"iterations": given.iterations, "seed": given.seed})
    for name, frames in (("native", native), ("pinhole", pinhole)):
        started = time.process_time()
        found = reconstruct(frames.training_part(), coarse)
        seconds = (time.process_time() - started) / given.iterations
        row = {
            "sequence": native.name,
            "lens": name,
            "pixels_used": used[name],
            "gaussians": len(found.scene.gaussians),
            "iteration_ms": 1e3 * seconds,
            **figures(found.scene, native, pinhole.K[0]),
        }
        print(json.dumps({k: round(v, 4) if isinstance(v, float) else v for k, v in row.items()}), flush=True)


if __name__ == "__main__":
    main()
