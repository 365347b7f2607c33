"""The kernels on a 64-bit Arm processor, emulated: the portable code becomes NEON there.

`training_step.cpp` runs one lit training step through the kernels' table; built for this machine and
for Arm, it has to give the same numbers up to rounding. On Arm multiplications and additions are fused, in
portable code for x86-64 they are not.
"""

from __future__ import annotations

import shutil
import subprocess
from pathlib import Path

import numpy as np
import pytest

import extrags.raster
from extrags.raster.light import ROW_LENGTH

KERNELS = Path(extrags.raster.__file__).parent / "kernels"
STEP = Path(__file__).with_name("training_step.cpp")
# -O1: neither the results nor the instruction set depend on it, and a cross build takes a minute less.
OPTIONS = ("-std=c++17", "-O1", "-fno-math-errno", "-fno-trapping-math", "-ffp-contract=off", "-Wno-psabi")
GAUSSIANS, PIXELS, COEFFICIENTS = 1500, 97 * 61, 16
RESULTS = {
    "losses": 3,
    "rgb": 3 * PIXELS,
    "alpha": PIXELS,
    "depth": PIXELS,
    "median_depth": PIXELS,
    "means2d": 2 * GAUSSIANS,
    "radius": GAUSSIANS,
    "visibility_max": GAUSSIANS,
    "visibility_sum": GAUSSIANS,
    "gradient of rgb": 3 * PIXELS,
    "gradient of depth": PIXELS,
    "gradient of means": 3 * GAUSSIANS,
    "gradient of quats": 4 * GAUSSIANS,
    "gradient of scales": 3 * GAUSSIANS,
    "gradient of opacities": GAUSSIANS,
    "gradient of sh": 3 * COEFFICIENTS * GAUSSIANS,
    "gradient of viewmat": 16,
    "gradient of light": ROW_LENGTH,
    "gradient of means2d": 2 * GAUSSIANS,
    "absolute gradient of means2d": 2 * GAUSSIANS,
    "transmittance": 64,
    "means after Adam": 3 * GAUSSIANS,
    "first moment": 3 * GAUSSIANS,
    "second moment": 3 * GAUSSIANS,
}
"""What the program writes, in its order."""
ALLOWED = 64 * float(np.finfo(np.float32).eps)
"""Of an array's largest entry. Hundreds of terms are summed, each rounded; the most seen is 27."""


def results(
    compiler: str, folder: Path, *options: str, run_by: tuple[str, ...] = ()
) -> dict[str, np.ndarray]:
    folder.mkdir()
    program, written = folder / "training_step", folder / "results"
    sources = [STEP, KERNELS / "isa_portable.cpp", KERNELS / "runtime.cpp"]
    subprocess.run(
        [compiler, *OPTIONS, *options, "-pthread", f"-I{KERNELS}", "-o", program, *sources], check=True
    )
    subprocess.run([*run_by, program, written], check=True)
    values = np.fromfile(written, np.float32)
    assert len(values) == sum(RESULTS.values())
    parts = np.split(values, np.cumsum(list(RESULTS.values()))[:-1])
    return dict(zip(RESULTS, parts, strict=True))


@pytest.mark.slow
@pytest.mark.timeout(900)
def test_a_training_step_is_that_of_this_machine(tmp_path: Path) -> None:
    needed = ("g++", "aarch64-linux-gnu-g++", "qemu-aarch64-static")
    missing = [name for name in needed if shutil.which(name) is None]
    if missing:
        pytest.skip(f"{', '.join(missing)} missing; Debian: g++-aarch64-linux-gnu qemu-user-static")
    here = results("g++", tmp_path / "here")
    arm = results("aarch64-linux-gnu-g++", tmp_path / "arm", "-static", run_by=("qemu-aarch64-static",))
    for name, expected in here.items():
        found = arm[name]
        # Queries that the camera does not see have no transmittance.
        assert np.array_equal(np.isnan(found), np.isnan(expected)), name
        known = ~np.isnan(expected)
        assert name == "transmittance" or known.all(), name
        assert expected[known].any(), name
        off = np.abs(found[known].astype(np.float64) - expected[known]).max()
        assert off <= ALLOWED * np.abs(expected[known]).max(), name
