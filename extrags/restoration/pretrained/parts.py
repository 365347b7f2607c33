"""Completeness of a saved pipeline: an interrupted download is found before the reconstruction."""

from __future__ import annotations

from collections.abc import Collection, Mapping
from pathlib import Path
from typing import Any

from extrags.model_files import lacking_weights

__all__ = ["lacking_part"]

STEMS = {"diffusers": "diffusion_pytorch_model", "transformers": "model"}
"""Name of the weights by the library a part belongs to."""


def lacking_part(
    folder: Path, index: Mapping[str, Any], with_weights: Collection[str], absent: Collection[str]
) -> str | None:
    """What a saved pipeline lacks first: a part that is missing or incomplete.

    Args:
        folder: of the pipeline.
        index: content of its `model_index.json`: `{part: [library, class]}` among other things.
        with_weights: parts that hold weights, if they have a `config.json`; tokenizers have none.
        absent: parts that are never loaded.

    Returns:
        Such as "unet/ is missing"; None when all is there.
    """
    for part, described in index.items():
        if part in absent or not isinstance(described, list) or described[0] is None:
            continue
        if not (folder / part).is_dir() or not any((folder / part).iterdir()):
            return f"{part}/ is missing"
        if part in with_weights and (folder / part / "config.json").is_file() and described[0] in STEMS:
            lacking = lacking_weights(folder / part, f"{STEMS[described[0]]}.safetensors")
            if lacking is not None:
                return f"{part}/{lacking}"
    return None
