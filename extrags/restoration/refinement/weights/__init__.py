"""Weights of the refiner: trained by this project, `restorer.json` tells how."""

from __future__ import annotations

from functools import lru_cache
from importlib.resources import files
from pathlib import Path

from extrags.errors import WeightsError
from extrags.restoration.description import DESCRIPTION
from extrags.restoration.diffusion.weights import files_digest
from extrags.restoration.refinement.refiner import WEIGHTS, Refiner

__all__ = ["bundled_refiner", "refiner_digest"]


def bundled_refiner(*, half_precision: bool = False) -> Refiner:
    """The refiner of the package.

    Args:
        half_precision: convolutions in bfloat16.

    Raises:
        WeightsError: when the installation is incomplete.
    """
    return Refiner.load(_files()[0].parent, half_precision=half_precision)


@lru_cache(maxsize=1)
def refiner_digest() -> str:
    """Digest of its weights and description, for cache keys.

    Raises:
        WeightsError: when the installation is incomplete.
    """
    return files_digest(_files())


def _files() -> tuple[Path, Path]:
    folder = Path(str(files(__name__)))
    found = folder / WEIGHTS, folder / DESCRIPTION
    for file in found:
        if not file.is_file():
            raise WeightsError(f"there is no file {file}: this installation is incomplete, reinstall extrags")
    return found
