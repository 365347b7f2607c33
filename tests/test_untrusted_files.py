"""No file from outside can run code: no loader of pickles in the code, and malicious files are refused."""

from __future__ import annotations

import ast
import io
import pickle
import zipfile
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from data_catalog.images import read_depth
from data_catalog.readers.endonerf import read_llff
from extrags.array_files import load_npy, load_npz, load_safetensors, load_state_dict
from extrags.depth.weights import load_completion
from extrags.errors import ExtragsError
from extrags.metrics.lpips_weights import read_weights
from extrags.restoration.diffusion.embedded import EmbeddedEnhancer
from extrags.restoration.pretrained import checkpoint_driver

ROOT = Path(__file__).parents[1]
PACKAGES = ("extrags", "data_catalog", "tasks", "flows")

NEVER = {
    "pickle.load",
    "pickle.loads",
    "pickle.Unpickler",
    "cloudpickle.load",
    "cloudpickle.loads",
    "joblib.load",
    "dill.load",
    "dill.loads",
    "marshal.load",
    "marshal.loads",
    "shelve.open",
    "yaml.load",
    "yaml.safe_load",
    "yaml.unsafe_load",
    "yaml.full_load",
    "pandas.read_pickle",
    "pydicom.read_file",
    "scipy.io.loadmat",
    "shutil.unpack_archive",
    "tarfile.open",
    "zipfile.ZipFile",
    "eval",
    "exec",
    "os.system",
    "torch.hub.load",
}
"""Calls that run what a file says, or unpack it: none is needed here."""

TELLING = {"allow_pickle", "weights_only", "trust_remote_code", "shell"}
"""Arguments by which a call is safe or not."""

OPTED_IN = {
    ("extrags/restoration/pretrained/checkpoint_driver.py", "_content"),
    ("extrags/splat_files/sog.py", "write_sog"),
    ("extrags/store/integrity.py", "_metadata_at"),
    ("extrags/yaml_text.py", "read_yaml"),
    ("extrags/zarr_io.py", "new_group"),
}
"""`enhance.checkpoint.trust_pickle=true` alone comes to the first (docs/algorithms/restoration.md).
`read_yaml` takes safe loaders alone. The others list what is in a file or write one: nothing is unpacked."""


def calls(module: ast.Module) -> Iterator[tuple[str, str, ast.Call]]:
    """Calls by their full name, and the function they stand in."""
    names = {"np": "numpy"}
    for node in ast.walk(module):
        if isinstance(node, ast.Import):
            names |= {item.asname or item.name: item.name for item in node.names}
        elif isinstance(node, ast.ImportFrom):
            names |= {item.asname or item.name: f"{node.module}.{item.name}" for item in node.names}

    def visit(node: ast.AST, function: str) -> Iterator[tuple[str, str, ast.Call]]:
        inside = node.name if isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef) else function
        if isinstance(node, ast.Call):
            first, *rest = written(node.func).split(".")
            yield ".".join([names.get(first, first), *rest]), inside, node
        for child in ast.iter_child_nodes(node):
            yield from visit(child, inside)

    return visit(module, "")


def written(node: ast.expr) -> str:
    """An expression as it stands in the source; names with dots, nearly all, without `ast.unparse`."""
    if isinstance(node, ast.Name):
        return node.id
    if isinstance(node, ast.Attribute):
        return f"{written(node.value)}.{node.attr}"
    return ast.unparse(node)


def unsafe_calls(source: str, file: str = "given") -> list[str]:
    found = []
    for name, function, call in calls(ast.parse(source)):
        given = {item.arg: ast.unparse(item.value) for item in call.keywords if item.arg in TELLING}
        wrong = name in NEVER
        wrong |= name == "numpy.load" and given.get("allow_pickle") != "False"
        wrong |= name == "torch.load" and given.get("weights_only") != "True"
        wrong |= given.get("allow_pickle", "False") != "False"
        wrong |= given.get("trust_remote_code", "False") != "False" or given.get("shell", "False") != "False"
        if wrong and (file, function) not in OPTED_IN:
            found.append(f"{file}:{call.lineno}: {name}")
    return found


def test_no_code_loads_what_can_run_code() -> None:
    files = [file for package in PACKAGES for file in sorted((ROOT / package).rglob("*.py"))]
    assert len(files) > 200
    found = [
        line
        for file in files
        for line in unsafe_calls(file.read_text(encoding="utf-8"), file.relative_to(ROOT).as_posix())
    ]
    assert found == []


@pytest.mark.parametrize(
    "source",
    [
        "import numpy as np\nnp.load(file)",
        "import numpy\nnumpy.load(file, allow_pickle=True)",
        "from numpy import load\nload(file)",
        "import torch\ntorch.load(file)",
        "import torch as t\nt.load(file, weights_only=flag)",
        "import pickle\npickle.loads(data)",
        "from pickle import load as read\nread(file)",
        "import yaml\nyaml.load(text, Loader=yaml.Loader)",
        "import tarfile\ntarfile.open(file).extractall()",
        "eval(text)",
        "import subprocess\nsubprocess.run(text, shell=True)",
    ],
)
def test_and_would_be_found(source: str) -> None:
    assert len(unsafe_calls(source)) >= 1


class Payload:
    """Unpickling it makes a file."""

    def __init__(self, trace: Path) -> None:
        self.trace = trace

    def __reduce__(self) -> tuple[Any, ...]:
        return (Path.touch, (self.trace,))


def _npy(file: Path, payload: Payload) -> None:
    np.save(file, np.array([payload], dtype=object), allow_pickle=True)


def _npz(file: Path, payload: Payload) -> None:
    with file.open("wb") as stream:
        np.savez(stream, **{"features.0.weight": np.array([payload], dtype=object)})


def _torch(file: Path, payload: Payload) -> None:
    torch.save({"state_dict": payload}, file)


def _bare_pickle(file: Path, payload: Payload) -> None:
    file.write_bytes(pickle.dumps(payload, protocol=2))


def _zipped(file: Path, payload: Payload) -> None:
    with zipfile.ZipFile(file, "w") as archive:
        content = io.BytesIO()
        np.save(content, np.array([payload], dtype=object), allow_pickle=True)
        archive.writestr("../../escaped.npy", content.getvalue())
        archive.writestr("data.pkl", pickle.dumps(payload))


MAKERS = (_npy, _npz, _torch, _bare_pickle, _zipped)


def _restorer(file: Path) -> object:
    file.with_suffix(".json").write_text("{}")
    return EmbeddedEnhancer.load(file)


def _checkpoint(file: Path) -> object:
    try:
        return checkpoint_driver._weights(str(file), False, torch)
    except checkpoint_driver.Failure as error:
        # The process that runs the driver raises it as one of ours.
        raise ExtragsError(str(error)) from error


READERS: dict[str, tuple[str, Callable[[Path], object]]] = {
    "depth map": (".npy", lambda file: read_depth(file)),
    "poses_bounds": (".npy", lambda file: read_llff(file)),
    "LPIPS in one file": (".npz", lambda file: read_weights((file,), "alex")),
    "LPIPS in two files": (".pth", lambda file: read_weights((file, file), "alex")),
    "depth completion": (".safetensors", lambda file: load_completion(str(file))),
    "restorer": (".safetensors", _restorer),
    "checkpoint": (".ckpt", _checkpoint),
}


@pytest.mark.parametrize("reader", READERS)
@pytest.mark.parametrize("make", MAKERS)
def test_a_malicious_file_is_refused(
    reader: str, make: Callable[[Path, Payload], None], tmp_path: Path
) -> None:
    suffix, read = READERS[reader]
    trace, file = tmp_path / "payload-ran", tmp_path / f"file{suffix}"
    make(tmp_path / "made.npy", Payload(trace))
    (tmp_path / "made.npy").rename(file)
    with pytest.raises(ExtragsError, match=r"file\.|pickle"):
        read(file)
    assert not trace.exists()
    assert not (tmp_path.parent / "escaped.npy").exists()


@pytest.mark.parametrize("load", [load_npy, load_npz, load_safetensors, load_state_dict])
@pytest.mark.parametrize("make", MAKERS)
def test_loaders_say_value_error(load: Callable[[Path], object], make: Any, tmp_path: Path) -> None:
    trace = tmp_path / "payload-ran"
    make(tmp_path / "made.npy", Payload(trace))
    with pytest.raises((ValueError, OSError)):
        load(tmp_path / "made.npy")
    assert not trace.exists()


def test_the_payload_would_run(tmp_path: Path) -> None:
    trace = tmp_path / "payload-ran"
    pickle.loads(pickle.dumps(Payload(trace)))
    assert trace.exists()
