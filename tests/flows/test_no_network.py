"""Nothing but this machine is ever connected to, unless it was asked for."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]
WATCH = Path(__file__).with_name("no_network")
"""Holds a `sitecustomize.py`, which Python imports before anything else, in child processes as well."""

SECRETS = {
    "EXTRAGS_CAPTION_KEY": "sk-never-to-be-seen-1",
    "AWS_SECRET_ACCESS_KEY": "aws/never+to-be-seen-2",
    "HF_TOKEN": "hf_never_to_be_seen_3",
}


def run(folder: Path, *command: str) -> subprocess.CompletedProcess[str]:
    """A command whose connections are noted."""
    environment = {name: value for name, value in os.environ.items() if not name.startswith("PREFECT_")}
    environment |= SECRETS
    environment |= {
        "PYTHONPATH": f"{WATCH}{os.pathsep}{ROOT}",
        "EXTRAGS_NETWORK_LOG": str(folder / "network.jsonl"),
        "EXTRAGS_STORE": str(folder / "store"),
        "HOME": str(folder),
        "XDG_CACHE_HOME": str(folder / "cache"),
        "OMP_NUM_THREADS": "1",
    }
    return subprocess.run(
        [sys.executable, *command],
        capture_output=True,
        text=True,
        env=environment,
        cwd=folder,
        timeout=400,
        check=False,
    )


def connections(folder: Path) -> list[dict[str, object]]:
    """What was noted, connections to this machine left out."""
    file = folder / "network.jsonl"
    noted = [json.loads(line) for line in file.read_text().splitlines()] if file.exists() else []
    return [item for item in noted if not item["local"]]


def test_a_connection_would_be_seen(tmp_path: Path) -> None:
    asked = "import socket\ntry:\n socket.create_connection(('203.0.113.1', 9), 1)\nexcept OSError:\n pass"
    assert run(tmp_path, "-c", asked).returncode == 0
    assert [item["to"] for item in connections(tmp_path)] == ["203.0.113.1"]
    in_a_child = "import subprocess, sys\nsubprocess.run([sys.executable, '-c', 'import socket; "
    in_a_child += 'socket.getaddrinfo("example.invalid", 80)\'], capture_output=True)'
    run(tmp_path, "-c", in_a_child)
    assert connections(tmp_path)[-1]["to"] == "example.invalid"


def test_listing_data_connects_to_nothing(tmp_path: Path) -> None:
    ended = run(tmp_path, "-m", "flows.cli", "data", "list")
    assert ended.returncode == 0, ended.stderr
    assert connections(tmp_path) == []


@pytest.mark.slow
def test_importing_everything_connects_to_nothing(tmp_path: Path) -> None:
    everything = (
        "import importlib, pkgutil\n"
        "for name in ('extrags', 'data_catalog', 'tasks', 'flows'):\n"
        "    package = importlib.import_module(name)\n"
        "    for module in pkgutil.walk_packages(package.__path__, f'{name}.'):\n"
        "        if not module.name.endswith('__main__'):\n"
        "            importlib.import_module(module.name)\n"
        "print('imported')\n"
    )
    ended = run(tmp_path, "-c", everything)
    assert ended.stdout.strip().endswith("imported"), ended.stderr
    assert connections(tmp_path) == []


@pytest.mark.slow
def test_a_run_connects_to_nothing_and_tells_no_secret(tmp_path: Path) -> None:
    from tests.flows.tiny import TINY

    settings = [f"--{name}={_text(value)}" for name, value in TINY.items() if not name.startswith("uc_nerf.")]
    secret_url = "s3://AKIAX:url/never+to-be-seen-4@bucket"
    commands = (
        ("run", "phantom/0@sparse", "--profile", "quick", *settings),
        ("plan", "phantom/0@sparse", "--profile", "quick", *settings),
        ("report", "phantom/0@sparse", "--profile", "quick", *settings),
        ("data", "list"),
        ("cache", "ls"),
    )
    said = ""
    for command in commands:
        ended = run(tmp_path, "-m", "flows.cli", *command)
        assert ended.returncode == 0, (command, ended.stderr)
        said += ended.stdout + ended.stderr
    for wrong in (
        ("run", "phantom/0@sparse", "--store", secret_url),
        ("run", "https://user:url%2Fnever-to-be-seen-5@host/video.mp4"),
        ("run", "phantom/0@sparse", "--enhance.pretrained.model", "https://user:never-to-be-seen-6@hub/x"),
    ):
        ended = run(tmp_path, "-m", "flows.cli", *wrong)
        assert ended.returncode == 2, (wrong, ended.stderr)
        said += ended.stdout + ended.stderr
    assert connections(tmp_path) == []
    assert (tmp_path / "store" / "prefect" / "prefect.db").is_file()
    hidden = [value.encode() for value in SECRETS.values()]
    for file in [path for path in tmp_path.rglob("*") if path.is_file()]:
        content = file.read_bytes()
        assert b"to-be-seen" not in content, file
        assert not any(value in content for value in hidden), file
    assert "to-be-seen" not in said


def _text(value: object) -> str:
    return str(value).lower() if isinstance(value, bool) else str(value)
