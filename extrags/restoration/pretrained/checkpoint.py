"""DynamiCrafter-type checkpoints, the paper's among them, run by the user's own clone of their code.

Neither code nor weights of these models come with this package: the published ones are a research fork
and a file behind a link. The user names a clone, a config and a checkpoint; everything that can be
missing is looked for by name before anything starts, and the model runs in a process of its own, perhaps
with another interpreter, that exchanges arrays with this one.

No real checkpoint has been run by this project. The tests run a tiny random model through the same
driver; its interface was read from the published callers.

Source: Kim et al.: ExploreGS, 2025 (interface of `enhancer.ckpt`); Xing et al.: DynamiCrafter, 2023.
"""

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
from jaxtyping import Float

from extrags.config import CheckpointConfig, EnhanceConfig
from extrags.errors import (
    ConfigError,
    ExtragsError,
    MissingDependencyError,
    NonFiniteError,
    WeightsError,
)
from extrags.restoration.clips import keep_known
from extrags.restoration.pretrained import checkpoint_driver
from extrags.restoration.pretrained.canvas import Canvas
from extrags.restoration.pretrained.captions import KEY_VARIABLE, caption_of
from extrags.restoration.pretrained.fingerprint import files_fingerprint
from extrags.restoration.pretrained.inputs import clip_inputs, ranked_references, window_seed
from extrags.restoration.pretrained.real_views import RealViews
from extrags.restoration.pretrained.windows import cross_faded, padded_to, plan_windows
from extrags.restoration.protocol import Clip, Restoration
from extrags.scene import Scene
from extrags.sequence import EndoscopicSequence

__all__ = ["CheckpointEnhancer", "check_clone", "check_interpreter", "clone_fingerprint", "relative_poses"]

FORMAT = 2
"""Raised when a saved restorer cannot be read by newer code."""
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
class _Clone:
    """Everything that was found, as absolute paths."""

    root: Path
    config: Path
    checkpoint: Path
    target: str
    python: str


@dataclass(frozen=True)
class CheckpointEnhancer:
    """A user's clone and checkpoint, a scene's caption and its real views.

    Args:
        settings: of the user.
        seed: of the noise, together with clip and window.
        views: training frames.
        caption: text the model is told.
        model_digest: fingerprint of checkpoint, config and code the restorer was prepared with.
        record: for the provenance.
    """

    settings: CheckpointConfig
    seed: int
    views: RealViews
    caption: str
    model_digest: str
    record: dict[str, Any]

    name = "dynamicrafter"

    @classmethod
    def prepare(cls, scene: Scene, sequence: EndoscopicSequence, config: EnhanceConfig) -> CheckpointEnhancer:
        """Check every precondition, gather the scene's real views. Nothing is trained.

        Args:
            scene: the coarse scene, trained on `sequence.train`.
            sequence: posed frames; only training frames are used.
            config: clone, checkpoint and caption.

        Raises:
            ConfigError: when a setting is missing or does not fit.
            WeightsError: when the checkpoint is not there.
            MissingDependencyError: when the interpreter lacks a package of the clone.
            ExtragsError: when the process ends otherwise than it should.
        """
        check_interpreter(config.checkpoint)
        clone = check_clone(config.checkpoint)
        caption = caption_of(sequence, config.caption)
        record = {
            "interface": config.checkpoint.interface,
            "checkpoint": clone.checkpoint.name,
            "checkpoint_bytes": clone.checkpoint.stat().st_size,
            "caption": caption.as_dict(),
        }
        return cls(
            config.checkpoint,
            config.seed,
            RealViews.gather(scene, sequence),
            caption.text,
            clone_fingerprint(config.checkpoint),
            record,
        )

    def restore(self, clip: Clip) -> Restoration:
        """Restore all views of a clip, in one process for all its windows.

        Every window begins with the real view that sees most of the same surface, at its own pose.

        Raises:
            ConfigError: when a setting is missing or does not fit.
            WeightsError: when the checkpoint is gone, another one than the restorer was prepared with, does
                not fit, or is a pickle nobody vouched for.
            MissingDependencyError: when the interpreter lacks a package of the clone.
            ExtragsError: when the process fails or takes too long; with the end of what it wrote.
            NonFiniteError: when the model returns NaN.
        """
        settings = self.settings
        clone = check_clone(settings)
        if clone_fingerprint(settings) != self.model_digest:
            raise WeightsError(
                f"{clone.checkpoint}, its config or its code is another one than when this restorer was "
                "prepared; run the stage enhance-train again (--refresh)"
            )
        base, unknown = clip_inputs(clip, 0.5, 0)
        rendered = clip.layers.get("rendered").clamp(0, 1).permute(0, 2, 3, 1).contiguous().numpy()
        uncertainty = clip.layers.get("uncertainty")[:, 0, :, :, None].numpy()
        restores = settings.interface == "enhancer"
        # The enhancer was trained on renders with all their flaws; the other is held to what it is given.
        images = rendered if restores else base
        holes = uncertainty if restores else unknown[..., None].astype(np.float32)
        canvas = Canvas.stretched(clip.cameras.width, clip.cameras.height, settings.width, settings.height)
        spans = plan_windows(len(clip), settings.frames - 1, settings.overlap)
        frames, masks, poses, seeds = [], [], [], []
        for number, span in enumerate(spans):
            chosen = slice(span.start, span.stop)
            lead = ranked_references(clip.reference[chosen])[:1]
            window = np.concatenate([self.views.images(lead), images[chosen]])
            covered = np.concatenate([np.zeros_like(holes[:1]), holes[chosen]])
            path = np.concatenate(
                [self.views.world_from_camera[lead], clip.cameras.world_from_camera[chosen]]
            )
            frames.append(padded_to(canvas.placed(window), settings.frames).transpose(0, 3, 1, 2))
            masks.append(padded_to(canvas.placed(covered), settings.frames).transpose(0, 3, 1, 2))
            poses.append(relative_poses(padded_to(path, settings.frames), self.views.world_from_camera))
            seeds.append(window_seed(self.seed, clip.index, number))
        request: dict[str, np.ndarray] = {
            "frames": np.stack(frames).astype(np.float32),
            "unknown": np.stack(masks).astype(np.float32),
            "poses": np.stack(poses).astype(np.float32),
            "seeds": np.array(seeds, dtype=np.int64),
        }
        result = _start(clone, settings, {"caption": self.caption}, request, check=False)
        if result.shape != request["frames"].shape or not np.isfinite(result).all():
            raise NonFiniteError(
                f"{clone.checkpoint} gave {result.shape} images, finite: {bool(np.isfinite(result).all())}; "
                f"expected {request['frames'].shape}"
            )
        parts = [
            window.transpose(0, 2, 3, 1)[1 : 1 + len(span)]
            for window, span in zip(result, spans, strict=True)
        ]
        rgb = canvas.cut(cross_faded(spans, parts, settings.overlap))
        if not restores:
            rgb = keep_known(base, rgb, unknown.astype(np.float32))[0]
        provenance = {
            "backend": self.name,
            "steps": settings.steps,
            "eta": settings.eta,
            "guidance_scale": _guidance(settings),
            "seed": self.seed,
            "model_digest": self.model_digest,
            **self.record,
        }
        return Restoration(rgb, None, provenance)

    def save(self, path: Path) -> None:
        """Write `restorer.json` and `references/`; clone and checkpoint stay where they are."""
        path.mkdir(parents=True, exist_ok=True)
        self.views.save(path / "references")
        description = {
            "backend": self.name,
            "format": FORMAT,
            "settings": self.settings.model_dump(mode="json"),
            "seed": self.seed,
            "caption": self.caption,
            "model_digest": self.model_digest,
            "record": self.record,
        }
        (path / "restorer.json").write_text(json.dumps(description, indent=2) + "\n")

    @classmethod
    def load(cls, path: Path) -> CheckpointEnhancer:
        """Read what `save` wrote.

        Raises:
            WeightsError: when a file is missing, or does not fit this version.
        """
        file = path / "restorer.json"
        for needed in (file, path / "references"):
            if not needed.exists():
                raise WeightsError(f"{needed}: not there; prepare the restorer first (stage enhance)")
        description = json.loads(file.read_text())
        if description.get("format") != FORMAT:
            raise WeightsError(
                f"{file}: format {description.get('format')}, this version reads {FORMAT}; "
                "prepare the restorer again"
            )
        return cls(
            CheckpointConfig.model_validate(description["settings"]),
            int(description["seed"]),
            RealViews.load(path / "references"),
            description["caption"],
            description["model_digest"],
            description["record"],
        )


def check_clone(settings: CheckpointConfig) -> _Clone:
    """Look for everything the driver needs, by name.

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
    root = Path(str(settings.root)).expanduser().resolve()
    if not root.is_dir():
        raise ConfigError(f"enhance.checkpoint.root={settings.root}: no such folder")
    for file in CLONE_FILES:
        if not (root / file).is_file():
            raise ConfigError(
                f"enhance.checkpoint.root={root}: {file} is missing, so this is no clone of DynamiCrafter "
                "or of a fork (submodules not checked out?)"
            )
    # An absolute path stays what it is.
    config = root / Path(str(settings.config)).expanduser()
    if not config.is_file():
        raise ConfigError(f"enhance.checkpoint.config={settings.config}: no file {config}")
    target = _target(config)
    module = root / (target.rsplit(".", 1)[0].replace(".", "/") + ".py")
    if not module.is_file():
        raise ConfigError(f"{config} names {target}, but the clone has no {module.relative_to(root)}")
    checkpoint = Path(str(settings.checkpoint)).expanduser().resolve()
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
    return _Clone(root, config, checkpoint, target, settings.python or sys.executable)


def check_interpreter(settings: CheckpointConfig) -> None:
    """As `check_clone`, and import the clone's modules in a process of their own, which takes seconds.

    Raises:
        ConfigError: as `check_clone`, or when the interpreter cannot be run.
        WeightsError: as `check_clone`.
        MissingDependencyError: when the interpreter lacks a package of the clone.
        ExtragsError: when the process ends otherwise than it should.
    """
    _start(check_clone(settings), settings, {}, {}, check=True)


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
    import yaml

    try:
        description = yaml.safe_load(config.read_text(encoding="utf-8"))
        target = description["model"]["target"]
        description["model"]["params"]
    except yaml.YAMLError as error:
        raise ConfigError(f"{config}: not readable as YAML ({error})") from error
    except (KeyError, TypeError) as error:
        raise ConfigError(f"{config}: expected model.target and model.params ({error})") from error
    if not isinstance(target, str) or "." not in target:
        raise ConfigError(f"{config}: model.target is {target!r}, expected package.module.Class")
    return target


def relative_poses(
    world_from_camera: Float[np.ndarray, "t 4 4"], training: Float[np.ndarray, "r 4 4"]
) -> Float[np.ndarray, "t 4 4"]:
    """Poses in the first camera's frame, with lengths as the paper's enhancer was given them.

    Its published caller divides by the largest, over the three axes, norm of all training positions about
    their mean. That grows with the number of frames; the checkpoint was used so, and is used so here.

    Args:
        world_from_camera: of a window.
        training: of all training frames.
    """
    centers = training[:, :3, 3]
    mean = centers.mean(axis=0)
    scale = max(float(np.linalg.norm(centers - mean, axis=0).max()), 1e-9)
    scaled = world_from_camera.astype(np.float64).copy()
    scaled[:, :3, 3] = (scaled[:, :3, 3] - mean) / scale
    return np.asarray(np.linalg.inv(scaled[0]) @ scaled)


def _guidance(settings: CheckpointConfig) -> float:
    return GUIDANCE_SCALE[settings.interface] if settings.guidance_scale is None else settings.guidance_scale


def _start(
    clone: _Clone,
    settings: CheckpointConfig,
    further: dict[str, Any],
    arrays: dict[str, Any],
    *,
    check: bool,
) -> np.ndarray:
    """Run the driver; its images, or none with `check`."""
    described = {
        **settings.model_dump(mode="json"),
        "root": str(clone.root),
        "config": str(clone.config),
        "checkpoint": str(clone.checkpoint),
        "target": clone.target,
        "guidance_scale": _guidance(settings),
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
            raise ConfigError(f"enhance.checkpoint.python={clone.python}: cannot be run ({error})") from error
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
        with np.load(result) as archive:
            return np.asarray(archive["frames"], dtype=np.float32)


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
