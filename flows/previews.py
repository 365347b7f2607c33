"""Small pictures of held-out views for the page of a run."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any

from extrags.store import Store
from flows.outcome import Part, SequenceOutcome

if TYPE_CHECKING:
    import numpy as np

__all__ = ["LARGEST_BYTES", "preview"]

LARGEST_BYTES = 30_000
"""Of a picture, as text: Prefect keeps it in its database."""
TILE_PX = 160
"""Width of each view."""


def preview(outcome: SequenceOutcome, store: Store) -> tuple[str, str] | None:
    """The middle held-out view: as recorded, from the coarse scene, and from the final one.

    Args:
        outcome: of a sequence that has been evaluated, or not.
        store: its artefacts.

    Returns:
        A `data:` URI and what it shows; None where nothing was rendered.
    """
    if "sequence" not in outcome.refs or "renders_coarse" not in outcome.refs:
        return None
    # Here, because they load torch, which looking up a deployment must not.
    import numpy as np

    from extrags.metrics.protocol import RenderedViews
    from extrags.report.encode import as_uint8, fitted_image
    from extrags.sequence import EndoscopicSequence

    frames = _group(store.open(outcome.refs["sequence"]) / EndoscopicSequence.stored_as)
    held_out = np.asarray(frames["split/test"][:])
    if len(held_out) == 0:
        return None
    view = len(held_out) // 2
    frame = int(held_out[view])
    shown, words = [_tile(as_uint8(np.asarray(frames["rgb"][frame])))], ["recorded"]
    scenes: dict[Part, str] = {
        "renders_coarse": "coarse scene",
        "renders_final": "final scene",
        "renders_restored": "the same, restored",
    }
    for part, word in scenes.items():
        if part in outcome.refs:
            renders = _group(store.open(outcome.refs[part]) / RenderedViews.stored_as)
            shown.append(_tile(as_uint8(np.asarray(renders["rgb"][view]))))
            words.append(word)
    height = min(tile.shape[0] for tile in shown)
    strip = np.concatenate([tile[:height] for tile in shown], axis=1)
    return (
        fitted_image(strip, LARGEST_BYTES).uri,
        f"{outcome.name}, held-out frame {frame}: {', '.join(words)}",
    )


def _group(path: Path) -> Any:
    from extrags.zarr_io import open_group

    return open_group(path)


def _tile(image: np.ndarray) -> np.ndarray:
    """At most `TILE_PX` wide, by leaving out rows and columns."""
    step = max(1, -(-image.shape[1] // TILE_PX))
    return image[::step, ::step]
