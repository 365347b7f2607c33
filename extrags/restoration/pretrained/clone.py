"""The user's clone of a DynamiCrafter-type model: found, checked, and run in a process of its own."""

from __future__ import annotations

import json
import os
import subprocess
import sys
import tempfile
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from extrags.array_files import load_npz
from extrags.config import CheckpointConfig
from extrags.errors import ConfigError, ExtragsError, MissingDependencyError, WeightsError, reason_of
from extrags.model_files import files_fingerprint
from extrags.restoration.pretrained import checkpoint_driver
from extrags.restoration.pretrained.captions import KEY_VARIABLE
from extrags.user_paths import expanded
from extrags.yaml_text import read_yaml

__all__ = ["Clone", "check_clone", "check_interpreter", "clone_fingerprint", "guidance_scale", "run_clone"]

CLONE_FILES = ("utils/utils.py", "lvdm/models/samplers/ddim.py")
"""What the driver imports besides the model's own class."""
SIZE_MULTIPLE = 16
STDERR_LINES = 25
CHECK_TIMEOUT_S = 300.0
GUIDANCE_SCALE = {"enhancer": 1.0, "dynamicrafter": 7.5}
_KINDS: dict[str, type[ExtragsError]] = {
    "weights": WeightsError,
    "dependency": MissingDependencyError,
    "config": ConfigError,
}


@dataclass(frozen=True)
class Clone:
    """Where the parts of a clone are, as absolute paths.

    Args:
        root: the clone.
        config: YAML file of the model.
        checkpoint: weights.
        target: the model's class, package.module.Class.
        python: interpreter with the clone's packages.
    """

    root: Path
    config: Path
    checkpoint: Path
    target: str
    python: str


def check_clone(settings: CheckpointConfig) -> Clone:
    """Look for everything the driver needs.

    Raises:
        ConfigError: when a setting is missing, or something in the clone is not what it should be.
        WeightsError: when the checkpoint is not there.
    """
    for name in ("root", "config", "checkpoint"):
        if getattr(settings, name) is None:
            raise ConfigError(
                f"enhance.backend=dynamicrafter needs enhance.checkpoint.{name}; set root (your clone of the "
                "model's code), config (its YAML file) and checkpoint (its weights)"
            )
    root = expanded(str(settings.root)).resolve()
    if not root.is_dir():
        raise ConfigError(f"enhance.checkpoint.root={settings.root}: no such folder")
    for file in CLONE_FILES:
        if not (root / file).is_file():
            raise ConfigError(
                f"enhance.checkpoint.root={root}: {file} is missing, so this is no clone of DynamiCrafter "
                "or of a fork (submodules not checked out?)"
            )
    # An absolute path stays what it is.
    config = root / expanded(str(settings.config))
    if not config.is_file():
        raise ConfigError(f"enhance.checkpoint.config={settings.config}: no file {config}")
    target = _target(config)
    module = root / (target.rsplit(".", 1)[0].replace(".", "/") + ".py")
    if not module.is_file():
        raise ConfigError(f"{config} names {target}, but the clone has no {module.relative_to(root)}")
    checkpoint = expanded(str(settings.checkpoint)).resolve()
    if not checkpoint.is_file() or not checkpoint.stat().st_size:
        raise WeightsError(
            f"enhance.checkpoint.checkpoint={settings.checkpoint}: no such file, or it is empty. extrags "
            "downloads no checkpoints; get it where its authors publish it"
        )
    if settings.width % SIZE_MULTIPLE or settings.height % SIZE_MULTIPLE:
        raise ConfigError(
            f"enhance.checkpoint.width and height are {settings.width} and {settings.height}; "
            f"expected multiples of {SIZE_MULTIPLE}"
        )
    if settings.frames - 1 <= settings.overlap:
        raise ConfigError(
            f"enhance.checkpoint.overlap={settings.overlap} leaves no new frame in windows of "
            f"{settings.frames}, the first of which is a real view"
        )
    return Clone(root, config, checkpoint, target, settings.python or sys.executable)


def check_interpreter(settings: CheckpointConfig) -> None:
    """As `check_clone`, and import the clone's modules in a process of their own, which takes seconds.

    Raises:
        ConfigError: as `check_clone`, or when the interpreter cannot be run.
        WeightsError: as `check_clone`.
        MissingDependencyError: when the interpreter lacks a package of the clone.
        ExtragsError: when the process ends otherwise than it should.
    """
    run_clone(check_clone(settings), settings, {}, {}, check=True)


def clone_fingerprint(settings: CheckpointConfig) -> str:
    """Digest of everything that makes the model: checkpoint, config, and the code it is run by.

    Raises:
        ConfigError: as `check_clone`.
        WeightsError: as `check_clone`.
    """
    clone = check_clone(settings)
    packages = {*(file.split("/")[0] for file in CLONE_FILES), clone.target.split(".")[0]}
    code = [file for package in packages for file in (clone.root / package).rglob("*.py")]
    named = {file.relative_to(clone.root).as_posix(): file for file in code if file.is_file()}
    return files_fingerprint({**named, "config": clone.config, "checkpoint": clone.checkpoint})


def _target(config: Path) -> str:
    try:
        description = read_yaml(config.read_text(encoding="utf-8"))
        target = description["model"]["target"]
        description["model"]["params"]
    except ValueError as error:
        raise ConfigError(f"{config}: not readable as YAML ({error})") from error
    except (KeyError, TypeError) as error:
        raise ConfigError(f"{config}: expected model.target and model.params ({error})") from error
    if not isinstance(target, str) or "." not in target:
        raise ConfigError(f"{config}: model.target is {target!r}, expected package.module.Class")
    return target


def guidance_scale(settings: CheckpointConfig) -> float:
    """Weight of the text: the setting, else the interface's usual one."""
    return GUIDANCE_SCALE[settings.interface] if settings.guidance_scale is None else settings.guidance_scale


def run_clone(
    clone: Clone,
    settings: CheckpointConfig,
    further: dict[str, Any],
    arrays: dict[str, Any],
    *,
    check: bool,
) -> np.ndarray:
    """Run the driver.

    Args:
        clone: checked.
        settings: of the user.
        further: more settings of the driver.
        arrays: request of `checkpoint_driver`.
        check: only import the clone's modules.

    Returns:
        Restored windows [W, T, 3, H, W]; none with `check`.

    Raises:
        ConfigError: when the interpreter cannot be run.
        ExtragsError: when the process fails or takes too long; of the kind the driver names, if it does.
    """
    described = {
        **settings.model_dump(mode="json"),
        "root": str(clone.root),
        "config": str(clone.config),
        "checkpoint": str(clone.checkpoint),
        "target": clone.target,
        "guidance_scale": guidance_scale(settings),
        **further,
    }
    limit_s = min(settings.timeout_s, CHECK_TIMEOUT_S) if check else settings.timeout_s
    mode = ["--check"] if check else []
    with tempfile.TemporaryDirectory(prefix="extrags-") as folder:
        request, result = Path(folder) / "request.npz", Path(folder) / "result.npz"
        np.savez(request, settings=np.array(json.dumps(described)), **arrays)
        command = [clone.python, str(Path(checkpoint_driver.__file__)), *mode, str(request), str(result)]
        try:
            ended = subprocess.run(
                command,
                env=_environment(clone.python),
                capture_output=True,
                text=True,
                errors="replace",
                timeout=limit_s,
                check=False,
            )
        except subprocess.TimeoutExpired as error:
            raise ExtragsError(
                f"the clone {clone.root} took longer than {limit_s:g} s and was stopped "
                f"(enhance.checkpoint.timeout_s). {_tail(error.stderr)}"
            ) from error
        except OSError as error:
            raise ConfigError(
                f"enhance.checkpoint.python={clone.python}: cannot be run ({reason_of(error)})"
            ) from error
        failure = Path(f"{result}.json")
        if ended.returncode == checkpoint_driver.KNOWN_FAILURE and failure.is_file():
            told = json.loads(failure.read_text())
            raise _KINDS[told["kind"]](told["message"])
        if ended.returncode or (not check and not result.is_file()):
            raise ExtragsError(
                f"the clone {clone.root} failed with exit code {ended.returncode}. {_tail(ended.stderr)}"
            )
        if check:
            return np.zeros(0, np.float32)
        try:
            return np.asarray(load_npz(result)["frames"], dtype=np.float32)
        except (OSError, KeyError, ValueError) as error:
            raise ExtragsError(
                f"the clone {clone.root} wrote no readable result: {reason_of(error)}"
            ) from error


def _environment(python: str) -> dict[str, str]:
    variables = dict(os.environ)
    # The clone's code has no business with this key, nor with packages of another interpreter.
    variables.pop(KEY_VARIABLE, None)
    if python != sys.executable:
        variables.pop("PYTHONPATH", None)
    # Its encoders would fetch weights that the checkpoint overwrites.
    variables.update(HF_HUB_OFFLINE="1", PYTHONUNBUFFERED="1")
    return variables


def _tail(stderr: str | bytes | None) -> str:
    text = stderr.decode(errors="replace") if isinstance(stderr, bytes) else stderr or ""
    lines = text.strip().splitlines()[-STDERR_LINES:]
    return "The end of what it wrote:\n" + "\n".join(lines) if lines else "It wrote nothing."
