"""Messages between the caller and COLMAP's process: files in a scratch folder; and how the process is run."""

from __future__ import annotations

import json
import os
import subprocess
import sys
import threading
from dataclasses import dataclass
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np

from extrags.array_files import load_npz
from extrags.errors import CaptureError
from extrags.events import Progress, emit

__all__ = ["PoseJob", "PoseJobResult", "end_with_parent", "reserve_stdout", "run_job"]


@dataclass(frozen=True)
class PoseJob:
    """Input of the process; arrays as in `extrags.sequence.EndoscopicSequence`.

    Args:
        rgb: uint8, [F, H, W, 3].
        mask: pixels features may come from, [F, H, W].
        K: [F, 3, 3].
        recording: [F].
        train: indices of frames the map is made of.
        test: indices of frames registered afterwards.
        settings: fields of `PosesConfig`.
        unknown_lens: whether `K`, then the same for all frames, is a guess and the lens is to be estimated.
        world_from_camera: known poses, [F, 4, 4]; None where they are to be found.
        lenient: whether this is the second attempt, with guided matching and lower thresholds.
    """

    rgb: np.ndarray
    mask: np.ndarray
    K: np.ndarray
    recording: np.ndarray
    train: np.ndarray
    test: np.ndarray
    settings: dict[str, Any]
    unknown_lens: bool = False
    world_from_camera: np.ndarray | None = None
    lenient: bool = False

    def save(self, folder: Path) -> None:
        """Write the job."""
        known: dict[str, Any] = {}
        if self.world_from_camera is not None:
            known["world_from_camera"] = self.world_from_camera
        # Stacks as files of their own, which are mapped: a long recording is in memory in neither process.
        np.save(folder / "rgb.npy", self.rgb)
        np.save(folder / "mask.npy", self.mask)
        np.savez(
            folder / "job.npz",
            **known,
            K=self.K,
            recording=self.recording,
            train=self.train,
            test=self.test,
        )
        content = {
            "settings": self.settings,
            "unknown_lens": self.unknown_lens,
            "lenient": self.lenient,
        }
        (folder / "job.json").write_text(json.dumps(content))

    @classmethod
    def load(cls, folder: Path) -> PoseJob:
        """Read the job."""
        fields: dict[str, Any] = {**load_npz(folder / "job.npz")}
        for name in ("rgb", "mask"):
            fields[name] = np.load(folder / f"{name}.npy", mmap_mode="r", allow_pickle=False)
        return cls(**fields, **json.loads((folder / "job.json").read_text()))


@dataclass(frozen=True)
class PoseJobResult:
    """Output of the process, in COLMAP's unit.

    Args:
        world_from_camera: [F, 4, 4], NaN for frames without a pose.
        points: [P, 3] float64.
        points_rgb: [P, 3] uint8.
        observed_frame: [O], training frames only.
        observed_point: [O], index into `points`.
        observed_px: [O, 2].
        report: counts, ready for JSON.
    """

    world_from_camera: np.ndarray
    points: np.ndarray
    points_rgb: np.ndarray
    observed_frame: np.ndarray
    observed_point: np.ndarray
    observed_px: np.ndarray
    report: dict[str, Any]

    def save(self, folder: Path) -> None:
        """Write the result."""
        np.savez(
            folder / "result.npz",
            world_from_camera=self.world_from_camera,
            points=self.points,
            points_rgb=self.points_rgb,
            observed_frame=self.observed_frame,
            observed_point=self.observed_point,
            observed_px=self.observed_px,
        )
        # Written last: its presence says that the result is whole.
        (folder / "result.json").write_text(json.dumps(self.report))

    @classmethod
    def load(cls, folder: Path) -> PoseJobResult:
        """Read the result."""
        return cls(**load_npz(folder / "result.npz"), report=json.loads((folder / "result.json").read_text()))


def reserve_stdout() -> None:
    """Keep the process's standard output for progress; what native code prints joins the log.

    COLMAP's solver now and then prints a line of its own, which would stand among the JSON.
    """
    sys.stdout = os.fdopen(os.dup(1), "w")
    os.dup2(2, 1)


def end_with_parent() -> None:
    """End this process as soon as its standard input does: the caller has ended, killed perhaps."""

    def watch() -> None:
        while os.read(0, 1):
            pass
        os._exit(1)

    threading.Thread(target=watch, daemon=True, name="end-with-parent").start()


def run_job(module: str, job: PoseJob, name: str, *, stage: str) -> PoseJobResult:
    """Run a job in a process of its own and pass its progress on.

    Args:
        module: run as `python -m MODULE FOLDER`.
        job: its input.
        name: of the sequence, for errors.
        stage: named in progress events.

    Raises:
        CaptureError: when the process ends on its own, with its last words.
    """
    with TemporaryDirectory(prefix="extrags-poses-") as scratch:
        folder = Path(scratch)
        job.save(folder)
        log = folder / "colmap.log"
        # The child must find this very package, installed or not.
        root = str(Path(__file__).resolve().parents[2])
        paths = [root, *filter(None, [os.environ.get("PYTHONPATH")])]
        with (
            log.open("wb") as log_file,
            subprocess.Popen(
                [sys.executable, "-m", module, scratch],
                # Nothing is written: its end tells the process that nobody waits any more.
                stdin=subprocess.PIPE,
                stdout=subprocess.PIPE,
                stderr=log_file,
                text=True,
                # Ctrl-C is for the caller, which then ends this process.
                start_new_session=True,
                # Pairs are matched in threads of their own: more of them in each product are in the way.
                env=os.environ | {"PYTHONPATH": os.pathsep.join(paths), "OPENBLAS_NUM_THREADS": "1"},
            ) as process,
        ):
            try:
                for line in process.stdout or ():
                    told = json.loads(line)
                    emit(Progress(stage, told["done"], told["total"], told["values"]))
                code = process.wait()
            except BaseException:
                process.kill()
                raise
        if code != 0 or not (folder / "result.json").exists():
            last = log.read_text(errors="replace").strip().splitlines()[-8:]
            raise CaptureError(f"{name}: COLMAP's process ended with code {code}:\n" + "\n".join(last))
        return PoseJobResult.load(folder)
