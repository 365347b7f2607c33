"""Arrays from files of others: npy, npz, PLY, safetensors and PyTorch, never with code in them.

Pickles are refused: they can run any code. What is wrong with a file is a ValueError, whatever the library
below raised; callers add file and remedy.
"""

from __future__ import annotations

import io
import stat
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from extrags.output_files import whole_file

if TYPE_CHECKING:
    from PIL.Image import Image
    from torch import Tensor

__all__ = [
    "COLORED_PALETTE",
    "MOST_PIXELS",
    "TOO_MANY_PIXELS",
    "image_numbers",
    "load_npy",
    "load_npz",
    "load_ply_vertices",
    "load_safetensors",
    "load_state_dict",
    "save_npy",
    "save_safetensors",
]

MOST_PIXELS = 178_956_970
"""Of an image or a depth map that is read. Pillow takes a larger one for a file made to fill the memory."""
TOO_MANY_PIXELS = f"too large: more than the {MOST_PIXELS} pixels that are read"
COLORED_PALETTE = "colours of a palette; expected one number per pixel, not depth in false colours"
_PLY_HEADER_BYTES = 1 << 16
_MOST_UNPACKED_BYTES = 1 << 30
_MOST_UNPACKED_SHARE = 100
"""Of its own size: numbers that were measured or trained are packed to no less than a tenth."""


def image_numbers(image: Image) -> np.ndarray | None:
    """Pixels of an opened image that holds numbers, such as depth; a palette of greys is undone.

    Args:
        image: of any mode.

    Returns:
        [H, W], or [H, W, C] where pixels have several; None for a palette of colours, whose places say
        nothing (`COLORED_PALETTE`).
    """
    if image.mode not in ("P", "PA"):
        return np.asarray(image)
    # Programs that make files smaller store grey of few values as places in a palette.
    colors = np.asarray(image.convert("RGB"))
    return None if (colors != colors[..., :1]).any() else colors[..., 0]


def load_npy(file: Path, *, most: int | None = None) -> np.ndarray:
    """One array.

    Args:
        file: to read.
        most: numbers that it may hold, looked at before any is read; None for any.

    Raises:
        OSError: when the file cannot be read.
        ValueError: when it is damaged, holds Python objects, or announces more than there is or may be.
    """
    try:
        with file.open("rb") as stream:
            version = np.lib.format.read_magic(stream)
            read = (
                np.lib.format.read_array_header_1_0
                if version == (1, 0)
                else np.lib.format.read_array_header_2_0
            )
            shape, _, kind = read(stream)
            announced = kind.itemsize
            for length in shape:
                announced *= int(length)
            there = file.stat().st_size - stream.tell()
        if kind.hasobject:
            raise ValueError("it holds Python objects (a pickle), which are never loaded")
        if most is not None and announced > most * kind.itemsize:
            raise ValueError(f"{' x '.join(map(str, shape))} numbers, more than the {most} that are read")
        if announced > there:
            raise ValueError(f"{announced} bytes of values announced, {there} there: it is truncated")
        return np.asarray(np.load(file, allow_pickle=False))
    except (ValueError, OSError):
        raise
    except Exception as error:
        # Headers are parsed as Python literals, which fail in many ways.
        raise ValueError(f"no npy file, or damaged: {type(error).__name__}: {error}") from error


def load_npz(file: Path) -> dict[str, np.ndarray]:
    """All arrays of an archive, by name.

    Raises:
        OSError: when the file cannot be read.
        ValueError: when it is damaged, holds Python objects, or would fill the memory from few bytes.
    """
    try:
        with np.load(file, allow_pickle=False) as archive:
            unpacked = sum(member.file_size for member in archive.zip.infolist())
            if unpacked > max(_MOST_UNPACKED_BYTES, _MOST_UNPACKED_SHARE * file.stat().st_size):
                raise ValueError(
                    f"{file.stat().st_size} bytes that unpack to {unpacked}: made to fill the memory"
                )
            found = {name: archive[name] for name in archive.files}
        # Members that are no npy files come back as bytes.
        if not all(isinstance(value, np.ndarray) for value in found.values()):
            raise ValueError("the archive holds other things than arrays")
        return found
    except (ValueError, OSError):
        raise
    except Exception as error:
        raise ValueError(f"no npz file, or damaged: {type(error).__name__}: {error}") from error


def load_safetensors(file: Path) -> dict[str, Tensor]:
    """All tensors, by name.

    Raises:
        OSError: when the file cannot be read.
        ValueError: when it is damaged.
    """
    from safetensors.torch import load_file

    try:
        return load_file(file)
    except (ValueError, OSError):
        raise
    except Exception as error:
        raise ValueError(f"no safetensors file, or damaged: {error}") from error


def save_npy(file: Path, array: np.ndarray) -> None:
    """Write an npy file.

    Raises:
        OSError: it cannot be written. numpy, given a file, says how many values it wrote and not that the
            disk is full.
    """
    content = io.BytesIO()
    np.save(content, array)
    file.write_bytes(content.getbuffer())


def save_safetensors(file: Path, tensors: dict[str, Tensor], metadata: dict[str, str] | None = None) -> None:
    """Write tensors by name; the file is there whole, or as it was before.

    Args:
        file: its folder is made.
        tensors: of any layout.
        metadata: text beside them.
    """
    from safetensors.torch import save_file

    file.parent.mkdir(parents=True, exist_ok=True)
    with whole_file(file) as partial:
        partial.touch()
        usual = stat.S_IMODE(partial.stat().st_mode)
        save_file({name: value.contiguous() for name, value in tensors.items()}, str(partial), metadata)
        # safetensors makes files that their owner alone may read, whatever the umask says.
        partial.chmod(usual)


def load_state_dict(file: Path) -> dict[str, Tensor]:
    """Tensors that `torch.save` wrote, by name.

    Raises:
        OSError: when the file cannot be read.
        ValueError: when it is damaged, or holds anything but tensors.
    """
    import torch

    try:
        found = torch.load(file, map_location="cpu", weights_only=True)
    except OSError:
        raise
    except Exception as error:
        # Damaged archives and pickles raise almost anything.
        raise ValueError(f"no file of PyTorch weights, damaged, or a pickle of more: {error}") from error
    if not isinstance(found, dict) or not all(isinstance(value, torch.Tensor) for value in found.values()):
        raise ValueError("it holds no state dictionary")
    return found


def load_ply_vertices(file: Path) -> np.ndarray:
    """The table of vertices of a PLY file, one column per property.

    Raises:
        OSError: when the file cannot be read.
        ValueError: when it is no PLY, damaged, without vertices, or announces more than there is.
    """
    from plyfile import PlyData

    try:
        with file.open("rb") as stream:
            header = stream.read(_PLY_HEADER_BYTES).partition(b"end_header")[0]
        counts = [int(line.split()[-1]) for line in header.splitlines() if line.startswith(b"element ")]
        if min(counts, default=0) < 0:
            raise ValueError(f"{min(counts)} elements announced")
        if sum(counts) > file.stat().st_size:
            raise ValueError("more elements announced than the file has bytes: it is truncated")
        # Mapped, and copied at once: without a map plyfile makes every number on its own, a million a second.
        return np.array(PlyData.read(str(file), mmap="r")["vertex"].data)
    except (ValueError, OSError):
        raise
    except Exception as error:
        raise ValueError(f"no PLY with vertices, or damaged: {type(error).__name__}: {error}") from error
