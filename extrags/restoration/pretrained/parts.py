"""Completeness of a saved pipeline: an interrupted download is found before the reconstruction."""

from __future__ import annotations

from collections.abc import Collection, Mapping
from pathlib import Path
from typing import Any

from extrags.model_files import missing_weights

__all__ = ["missing_part"]

STEMS = {"diffusers": "diffusion_pytorch_model", "transformers": "model"}
"""Name of the weights by the library a part belongs to."""


def missing_part(
    folder: Path, index: Mapping[str, Any], with_weights: Collection[str], absent: Collection[str]
) -> str | None:
    """The first part of a saved pipeline that is missing or incomplete.

    Args:
        folder: of the pipeline.
        index: content of its `model_index.json`: `{part: [library, class]}` among other things.
        with_weights: parts that hold weights, if they have a `config.json`; tokenizers have none.
        absent: parts that are never loaded.

    Returns:
        What is missing, by its path; None when all is there.
    """
    for part, described in index.items():
        if part in absent or not isinstance(described, list) or described[0] is None:
            continue
        if not (folder / part).is_dir() or not any((folder / part).iterdir()):
            return f"{part}/"
        if part in with_weights and (folder / part / "config.json").is_file() and described[0] in STEMS:
            missing = missing_weights(folder / part, f"{STEMS[described[0]]}.safetensors")
            if missing is not None:
                return f"{part}/{missing}"
    return None
