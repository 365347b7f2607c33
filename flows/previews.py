"""Small pictures of what a run has made: for its page, and for who watches it in a terminal."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

from extrags.output_files import whole_file
from extrags.store import Ref, Store
from flows.outcome import SequenceOutcome
from tasks.run_page import plain_letters

if TYPE_CHECKING:
    import numpy as np

__all__ = ["LARGEST_BYTES", "preview", "stage_preview"]

LARGEST_BYTES = 30_000
"""Of a picture, as text: Prefect keeps it in its database."""
TILE_PX = 160
"""Width of each view on the page of a run."""
FILE_TILE_PX = 480
"""The same in a file."""
LARGEST_SEQUENCE_BYTES = 500_000_000
"""Longer sequences are not read for the sake of a picture."""


def preview(outcome: SequenceOutcome, store: Store) -> tuple[str, str] | None:
    """The middle held-out view: as recorded, from the coarse scene, and from the final one.

    Args:
        outcome: of a sequence that has been evaluated, or not.
        store: its artefacts.

    Returns:
        A `data:` URI and what it shows; None where nothing was rendered.
    """
    # Here, because it loads torch, which looking up a deployment must not.
    from extrags.report.encode import fitted_image

    found = _evaluated(outcome.refs, store, TILE_PX)
    if found is None:
        return None
    strip, words = found
    return fitted_image(strip, LARGEST_BYTES).uri, f"{outcome.name}, {words}"


def stage_preview(label: str, stage: str, made: Mapping[str, Ref], store: Store) -> tuple[Path, str] | None:
    """A picture of what a stage has made, as a file in the store's local directory; the last one is kept.

    Args:
        label: name of the sequence.
        stage: the stage that has ended.
        made: what the sequence has, by the names of `extrags.stages.Part`.
        store: its artefacts.

    Returns:
        Where it is and what it shows; None for a stage that makes nothing to be looked at.

    Raises:
        ExtragsError: for an artefact that cannot be read.
        OSError: for a directory that cannot be written.
    """
    found = PICTURES[stage](made, store) if stage in PICTURES else None
    if found is None:
        return None
    strip, words = found
    from PIL import Image

    folder = store.state / "previews"
    folder.mkdir(parents=True, exist_ok=True)
    path = folder / f"{plain_letters(label, 'A-Za-z0-9@.')}.jpg"
    with whole_file(path) as unfinished:
        Image.fromarray(strip).save(unfinished, format="JPEG", quality=90)
    return path, words


def _recorded(made: Mapping[str, Ref], store: Store) -> tuple[np.ndarray, str]:
    """The middle frame of a sequence."""
    from extrags.report.encode import as_uint8
    from extrags.sequence import EndoscopicSequence

    frames = _group(store.open(made["sequence"]) / EndoscopicSequence.stored_as)["rgb"]
    frame = frames.shape[0] // 2
    return _tile(as_uint8(_array(frames[frame])), FILE_TILE_PX), f"frame {frame} as recorded"


def _rendered(made: Mapping[str, Ref], store: Store) -> tuple[np.ndarray, str] | None:
    """The middle held-out frame, or training frame, and what the scenes show there."""
    import numpy as np

    from extrags.evaluation import render
    from extrags.report.encode import as_uint8
    from extrags.scene import Scene
    from extrags.sequence import EndoscopicSequence

    if store.manifest(made["sequence"]).bytes > LARGEST_SEQUENCE_BYTES:
        return None
    sequence = EndoscopicSequence.load(store.open(made["sequence"]) / EndoscopicSequence.stored_as)
    known, kind = (
        (sequence.test, "held-out") if len(sequence.test) else (np.asarray(sequence.train), "training")
    )
    frame = int(known[len(known) // 2])
    shown, words = [_tile(as_uint8(sequence.rgb[frame]), FILE_TILE_PX)], ["recorded"]
    for part, word in (("coarse", "coarse scene"), ("finetune", "final scene")):
        stored = store.open(made[part]) / Scene.stored_as if part in made else None
        # UC-NeRF keeps a field there, not Gaussians.
        if stored is not None and stored.exists():
            views = render(Scene.load(stored), sequence, np.array([frame]))
            shown.append(_tile(as_uint8(views.rgb[0]), FILE_TILE_PX))
            words.append(word)
    if len(shown) == 1:
        return None
    return np.concatenate(shown, axis=1), f"{kind} frame {frame}: {', '.join(words)}"


def _restored(made: Mapping[str, Ref], store: Store) -> tuple[np.ndarray, str]:
    """The middle virtual view before and after restoration."""
    import numpy as np

    from extrags.pseudo_views import PseudoViews
    from extrags.report.encode import as_uint8

    group = _group(store.open(made["enhance"]) / PseudoViews.stored_as)
    view = group["rendered"].shape[0] // 2
    shown = [_tile(as_uint8(_array(group[name][view])), FILE_TILE_PX) for name in ("rendered", "restored")]
    return np.concatenate(shown, axis=1), f"virtual view {view}: rendered, restored"


def _evaluated(refs: Mapping[Any, Ref], store: Store, tile_px: int) -> tuple[np.ndarray, str] | None:
    """The middle held-out view as recorded, from the coarse scene, and from the final one."""
    if "sequence" not in refs or "renders_coarse" not in refs:
        return None
    import numpy as np

    from extrags.metrics.protocol import RenderedViews
    from extrags.report.encode import as_uint8
    from extrags.sequence import EndoscopicSequence

    frames = _group(store.open(refs["sequence"]) / EndoscopicSequence.stored_as)
    held_out = _array(frames["split/test"][:])
    if len(held_out) == 0:
        return None
    view = len(held_out) // 2
    frame = int(held_out[view])
    shown, words = [_tile(as_uint8(_array(frames["rgb"][frame])), tile_px)], ["recorded"]
    scenes = {
        "renders_coarse": "coarse scene",
        "renders_final": "final scene",
        "renders_restored": "the same, restored",
    }
    for part, word in scenes.items():
        if part in refs:
            renders = _group(store.open(refs[part]) / RenderedViews.stored_as)
            shown.append(_tile(as_uint8(_array(renders["rgb"][view])), tile_px))
            words.append(word)
    height = min(tile.shape[0] for tile in shown)
    strip = np.concatenate([tile[:height] for tile in shown], axis=1)
    return strip, f"held-out frame {frame}: {', '.join(words)}"


PICTURES: dict[str, Callable[[Mapping[str, Ref], Store], tuple[np.ndarray, str] | None]] = {
    "ingest": _recorded,
    "coarse": _rendered,
    "enhance": _restored,
    "finetune": _rendered,
    "evaluate": partial(_evaluated, tile_px=FILE_TILE_PX),
}
"""By stage: a picture of what it has made, with words; others make nothing to be looked at."""


def _array(values: Any) -> np.ndarray:
    import numpy as np

    return np.asarray(values)


def _group(path: Path) -> Any:
    from extrags.zarr_io import open_group

    return open_group(path)


def _tile(image: np.ndarray, width: int) -> np.ndarray:
    """At most so wide, by leaving out rows and columns."""
    step = max(1, -(-image.shape[1] // width))
    return image[::step, ::step]
