"""What commands load before they do anything: seconds that somebody waits for.

Modules are named, not timed. A program runs in a process of its own and prints which of them it has loaded.
"""

from __future__ import annotations

import subprocess
import sys

import pytest

HEAVY = "torch prefect scipy open3d matplotlib kornia cv2 dask zarr numpy pydantic pandas"
RARE = "scipy.optimize open3d matplotlib kornia torch._dynamo sympy distributed prefect.server diffusers"


def loaded(program: str, modules: str) -> list[str]:
    """Those of the modules that the program loads."""
    after = f"\nimport sys; print('loaded', *(set({modules.split()!r}) & set(sys.modules)))"
    said = subprocess.run([sys.executable, "-c", program + after], capture_output=True, text=True, check=True)
    return sorted(said.stdout.splitlines()[-1].split()[1:])


def command(*words: str) -> str:
    """A program that runs a command to its end."""
    return (
        "from flows.cli import main\n"
        f"try: main({list(words)!r})\n"
        "except SystemExit as end: assert end.code == 0"
    )


@pytest.mark.parametrize(
    ("program", "modules"),
    [
        pytest.param("import flows.cli", HEAVY, id="import flows.cli"),
        pytest.param(command("--help"), HEAVY, id="--help"),
        pytest.param(command("--version"), HEAVY, id="--version"),
        # Settings are pydantic models, and verbs describe them.
        *(
            pytest.param(command(verb, "--help"), HEAVY.replace(" pydantic", ""), id=f"{verb} --help")
            for verb in ("plan", "run", "bench", "status")
        ),
        # Of tables of commands.
        pytest.param("from extrags.report.wording import duration", f"torch {RARE}", id="words of pages"),
        # Keys of artefacts are computed with the wiring alone.
        pytest.param(
            "import flows.wiring, flows.dataset",
            f"torch scipy {RARE}",
            id="import flows.wiring, flows.dataset",
        ),
        pytest.param(
            "from extrags.config import EnhanceConfig\n"
            "from tasks.enhance import keyed_settings\n"
            "from tasks.weights import restorer_digest\n"
            "assert keyed_settings(EnhanceConfig()) and restorer_digest(EnhanceConfig())",
            "scipy extrags.training extrags.restoration.diffusion.embedded " + RARE,
            id="key of a restorer",
        ),
        # COLMAP's process, once or twice a run.
        pytest.param(
            "import extrags.poses.colmap, extrags.poses.colmap_triangulation",
            HEAVY.replace(" numpy pydantic", ""),
            id="COLMAP's process",
        ),
        # One step of the training is as good as many.
        pytest.param(
            "import torch\n"
            "from extrags.restoration.diffusion.adamw import AdamW\n"
            "from extrags.restoration.diffusion.network import build_network\n"
            "network = build_network(4, (8, 8, 16), torch.Generator())\n"
            "AdamW(network.parameters(), 1e-4).step(1e-3)",
            RARE,
            id="training of a restorer",
        ),
    ],
)
def test_nothing_is_loaded_that_is_not_needed(program: str, modules: str) -> None:
    assert loaded(program, modules) == []


def test_what_is_loaded_is_seen() -> None:
    assert loaded("import flows.wiring", "prefect open3d") == ["prefect"]


def test_the_process_ends_with_the_code_and_all_that_was_printed() -> None:
    """`flows.process_end` skips Python's own end."""
    program = [sys.executable, "-m", "flows.cli", "status", "--store", "/dev/null/none"]
    failed = subprocess.run(program, capture_output=True, text=True, check=False)
    assert failed.returncode == 1
    assert failed.stderr.startswith("extrags: ")
    helped = subprocess.run([*program[:3], "--version"], capture_output=True, text=True, check=False)
    assert (helped.returncode, len(helped.stdout.split())) == (0, 1)
