"""A gallery: of each run a held-out view and a virtual view, as a Markdown page with images beside it."""

from __future__ import annotations

import base64
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Bool, UInt8

from extrags.errors import ConfigError
from extrags.metrics.registry import Metric
from extrags.observed_surface import never_observed
from extrags.output_files import write_file
from extrags.report.downloads import file_name
from extrags.report.encode import UNSEEN_RGB, as_uint8
from extrags.report.image_table import ImageCell, Judged, image_cell, judged_table
from extrags.report.inputs import PseudoLike
from extrags.report.views import virtual_rows
from extrags.report.wording import metric_of, number, shown_metrics
from extrags.sequence import EndoscopicSequence

__all__ = ["GalleryRun", "build_gallery"]

KINDS = ("coarse", "final", "restored")
LABELS = {"coarse": "Coarse", "final": "Final", "restored": "Restored in the image"}
IMAGES_OF_A_RUN = 16
"""At most: seven of a held-out view, six of a virtual one, and some to spare."""


@dataclass(frozen=True)
class GalleryRun:
    """One finished run.

    Args:
        sequence: frames, masks, and what of the held-out frames was observed.
        rgb: renders of the held-out frames by scene: `coarse`, `final`, `restored`; [T, H, W, 3] each.
        results: `EvaluationResult` as JSON by the same names.
        method: of the run.
        profile: of its settings.
        pseudo: its virtual views; None where there are none.
        held_out: what is to be said of a scene that has seen held-out frames, or may have; else empty.
        source: what the frames are, in words; empty where the catalogue does not know them.
        licence: of the frames, from which all pictures derive; empty where it is not known.
    """

    sequence: EndoscopicSequence
    rgb: Mapping[str, np.ndarray]
    results: Mapping[str, Mapping[str, Any]]
    method: str = ""
    profile: str = ""
    pseudo: PseudoLike | None = None
    held_out: str = ""
    source: str = ""
    licence: str = ""


def build_gallery(
    runs: Sequence[GalleryRun], folder: Path, *, title: str, command: str, largest_bytes: int, made: str = ""
) -> Path:
    """Write `index.md` and the images of a gallery; what else lies in the folder stays.

    Of each run the held-out view whose last scene has the median PSNR, and the middle one of all virtual
    views are shown: neither is picked by how good it looks.

    Args:
        runs: in the order in which they are shown.
        folder: for the page and its images; made when it is not there.
        title: of the page.
        command: that makes it again, for the page.
        largest_bytes: bound on all images together.
        made: by which version and when, in words; nothing is said when empty.

    Returns:
        The page.

    Raises:
        ConfigError: without runs, or when so few bytes are allowed that not even thumbnails fit.
    """
    if not runs:
        raise ConfigError("a gallery takes one run or more")
    # An image is bounded by the length of its base64.
    each = largest_bytes * 4 // (3 * IMAGES_OF_A_RUN * len(runs))
    folder.mkdir(parents=True, exist_ok=True)
    strips = [_strip(run, folder, each, place) for place, run in enumerate(runs)]
    page = folder / "index.md"
    write_file(page, "\n".join([_head(title, command, made), *strips]))
    return page


def _head(title: str, command: str, made: str) -> str:
    # Longer than any in a name, which could else end the block.
    fence = "`" * max([3, *(len(found) + 1 for found in re.findall("`+", command))])
    return (
        f"# {title}\n\nMade by{f' {made}' if made else ''}\n\n{fence}bash\n{command}\n{fence}\n\n"
        "Each run is shown by the held-out view whose PSNR is the median of all, and the middle one of its "
        "virtual views: none is picked by its looks. Figures below an image are those of this view alone. "
        "Unless said otherwise, no stage has seen the held-out frames. Cyan in *never observed* is surface "
        "that no training frame saw: what the scenes show there is invented.\n"
    )


def _strip(run: GalleryRun, folder: Path, largest_bytes: int, number_of_run: int) -> str:
    """A section: words, a held-out view, a virtual view."""
    sequence = run.sequence
    # Numbered: different sequences may have the same letters, or be of the same name.
    name = f"{number_of_run:03d}_{file_name(sequence.name)}".rstrip("_")
    kinds = [kind for kind in KINDS if kind in run.rgb]
    metrics = shown_metrics(*(run.results[kind]["metrics"] for kind in kinds))
    place = _median_view(run.results["final" if "final" in kinds else kinds[0]])
    frame = int(sequence.test[place])
    table = judged_table(
        sequence,
        np.array([frame]),
        [Judged(kind, LABELS[kind], as_uint8(run.rgb[kind][[place]])) for kind in kinds],
        [""],
        len(sequence.test),
        largest_bytes,
    )
    *renders, truth = table.rows[0].cells[: len(kinds) + 1]
    said = {LABELS[kind]: _figures(run.results[kind]["per_view"][place], metrics) for kind in kinds}
    cells = [truth, *renders]
    if sequence.observed is not None:
        unseen = never_observed(sequence, frame)
        share = 100 * float(unseen.sum() / max(1, sequence.mask[frame].sum()))
        alt = f"Frame {sequence.frame_name(frame)}, never observed: {share:.0f} %"
        seen = _tinted(sequence.rgb[frame], unseen)
        cells.append(image_cell(seen, sequence.mask[frame], "Never observed", alt, largest_bytes))
        said["Never observed"] = f"{share:.0f} % of the view"
    errors = table.rows[0].cells[len(kinds) + 1 :]
    if "final" in kinds:
        error = errors[kinds.index("final")]
        cells.append(ImageCell(error.image, "Error, final", error.alt))
        said["Error, final"] = f"{table.scales[0].low} dark to {table.scales[0].high} pale"
    said["Truth"] = f"frame {sequence.frame_name(frame)}"
    lines = [f"## {_plain(sequence.name)}\n", _summary(run, kinds, metrics) + "\n", _terms(run) + "\n"]
    lines.append(_table(cells, said, folder, f"{name}_view"))
    if run.pseudo is not None and len(run.pseudo.rendered):
        virtual = virtual_rows(run.pseudo, sequence, 1, largest_bytes)
        row, ends = virtual.rows[0], [f"{scale.low} dark to {scale.high} pale" for scale in virtual.scales]
        said = dict(zip(("Uncertainty", "Expected error"), ends, strict=False))
        # The name of a frame stands in the note.
        lines.append(f"{_plain(row.title)} of {len(run.pseudo.rendered)}: {_plain(row.note)}.\n")
        lines.append(_table(row.cells, said, folder, f"{name}_virtual"))
    return "\n".join(lines)


def _summary(run: GalleryRun, kinds: Sequence[str], metrics: Sequence[Metric]) -> str:
    views = len(run.sequence.test)
    made = " ".join(part for part in (run.method, f"({run.profile})" if run.profile else "") if part)
    text = f"{made}. " if made else ""
    changes = []
    for metric in (item for item in metrics if item.key in ("psnr", "ssim") or item.lpips_net):
        values = [metric_of(run.results[kind]["metrics"], metric.key) for kind in kinds]
        if all(value is not None for value in values):
            figures = " → ".join(number(value, metric.digits) for value in values)
            changes.append(f"{metric.label} {figures} {metric.unit}".strip())
    scenes = " → ".join(LABELS[kind].lower() for kind in kinds)
    said = f" {run.held_out}." if run.held_out else ""
    return f"{text}Means of {views} held-out views, {scenes}: {', '.join(changes)}.{said}"


def _terms(run: GalleryRun) -> str:
    """Where the pictures come from, and under which licence that is."""
    if not run.licence:
        return "The catalogue knows no licence of these frames: ask whose they are before pictures are shown."
    return f"Pictures derive from: {_plain(run.source)}. Licence: {_plain(run.licence)}."


def _figures(view: Mapping[str, Any], metrics: Sequence[Metric]) -> str:
    """PSNR and LPIPS of one view."""
    said = []
    for metric in metrics:
        value = metric_of(view, metric.key)
        if value is not None and (metric.key == "psnr" or metric.lpips_net):
            said.append(f"{metric.label} {number(value, metric.digits)} {metric.unit}".strip())
    return ", ".join(said)


def _median_view(result: Mapping[str, Any]) -> int:
    """The view in the middle of all, ordered by PSNR."""
    values = [metric_of(view, "psnr") for view in result["per_view"]]
    known = [place for place, value in enumerate(values) if value is not None]
    known.sort(key=lambda place: (values[place], place))
    return known[len(known) // 2] if known else 0


def _tinted(image: UInt8[np.ndarray, "h w 3"], region: Bool[np.ndarray, "h w"]) -> UInt8[np.ndarray, "h w 3"]:
    """The image in grey, a region of it in colour."""
    grey = image.astype(np.float64).mean(-1, keepdims=True)
    tint = (0.35 + 0.65 * grey / 255) * np.array(UNSEEN_RGB)
    return np.asarray(np.rint(np.where(region[..., None], tint, grey)).astype(np.uint8))


def _table(cells: Sequence[ImageCell], said: Mapping[str, str], folder: Path, stem: str) -> str:
    """A table of images with their labels above and their figures below; the images are written."""
    shown = []
    for place, cell in enumerate(cells, start=1):
        kind, content = cell.image.uri.split(",", 1)
        file = f"{stem}_{place}.{'png' if 'image/png' in kind else 'jpg'}"
        write_file(folder / file, base64.b64decode(content))
        shown.append(f"![{_plain(cell.alt)}]({file})")
    rows = [[_plain(cell.label) for cell in cells], ["---"] * len(cells), shown]
    if said:
        rows.append([_plain(said.get(cell.label, "")) for cell in cells])
    return "\n".join(f"| {' | '.join(row)} |" for row in rows) + "\n"


def _plain(text: str) -> str:
    """Words that no name in them can end a cell or a link of, or make a part of a page of."""
    return "".join(" " if letter in "|[]<>`\\" or not letter.isprintable() else letter for letter in text)
