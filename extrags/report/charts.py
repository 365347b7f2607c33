"""Charts of a report: training curves, views compared, coverage gains, methods, run time against error.

Drawn by matplotlib without its global figure state, as SVG whose bytes depend on the input only.
"""

from __future__ import annotations

import io
import logging
import re
import textwrap
import threading
import warnings
from collections import Counter
from collections.abc import Collection, Iterator, Mapping, Sequence
from contextlib import contextmanager
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float

from extrags.errors import ConfigError, reason_of
from extrags.output_files import whole_file
from extrags.report.chart_labels import drawable, row_labels
from extrags.report.downloads import Cell, Chart, file_name
from extrags.report.encode import data_uri

__all__ = [
    "COARSE_COLOR",
    "FINAL_COLOR",
    "drawing_style",
    "gain_chart",
    "history_chart",
    "method_colors",
    "method_marks",
    "methods_chart",
    "pairs_chart",
    "run_colors",
    "sequences_chart",
    "svg_image",
    "views_chart",
    "write_figure",
]

logger = logging.getLogger(__name__)

COARSE_COLOR = "#8794a3"
FINAL_COLOR = "#0b6e75"
WORSE_COLOR = "#b4481e"
METHOD_COLORS = (FINAL_COLOR, "#c2702a", "#6b4ea0", "#3d7dbd", "#9a3b5b", "#7a7f2a")
METHOD_MARKS = ("o", "s", "^", "D", "v", "P", "X", "*")
"""Of methods that share a colour."""
LEGEND_COLUMNS = 4
INK = "#1d2733"
QUIET = "#5b6774"
RULE = "#d9dee4"

# matplotlib keeps its style in one global dictionary; figures of parallel tasks take turns.
_STYLE_LOCK = threading.Lock()
_FONT = "DejaVu Sans"
"""Ships with matplotlib: the same everywhere."""
_FURTHER_FONTS = (
    "Noto Sans CJK SC",
    "Noto Sans CJK JP",
    "Source Han Sans SC",
    "Source Han Sans JP",
    "WenQuanYi Micro Hei",
    "WenQuanYi Zen Hei",
    "Droid Sans Fallback",
    "IPAGothic",
    "Microsoft YaHei",
    "Yu Gothic",
    "Malgun Gothic",
    "PingFang SC",
    "Hiragino Sans",
    "Arial Unicode MS",
)
"""With the letters of Chinese, Japanese and Korean, which `_FONT` lacks; systems come with one or another."""
_STYLE: Any = {
    "font.size": 9.0,
    "text.parse_math": False,  # names of sequences may have any letters
    "axes.edgecolor": RULE,
    "axes.labelcolor": QUIET,
    "axes.titlecolor": INK,
    "axes.titlesize": 9.5,
    "axes.titleweight": "bold",
    "axes.titlelocation": "left",
    "axes.spines.top": False,
    "axes.spines.right": False,
    "axes.grid": True,
    "axes.grid.axis": "y",
    "axes.axisbelow": True,
    "grid.color": "#e9edf1",
    "grid.linewidth": 0.8,
    "xtick.color": QUIET,
    "ytick.color": QUIET,
    "xtick.major.size": 0.0,
    "xtick.minor.size": 0.0,
    "ytick.major.size": 0.0,
    "ytick.minor.size": 0.0,
    "legend.frameon": False,
    "legend.fontsize": 8.5,
    "text.color": INK,
    "svg.fonttype": "path",
    "svg.hashsalt": "extrags",
    "path.simplify": True,
}
# Outlines carry six digits behind the point; two are finer than any screen and halve the page's share.
_LONG_PATHS = re.compile(r' d="[^"]*"')
_LONG_FRACTION = re.compile(r"(\.\d\d)\d+")
SMOOTHING_SHARE = 0.08
"""Training figures are of one view each and jump; the line is a running mean over this share of them."""

_HISTORY_PANELS = (
    ("loss", "Loss", "log"),
    ("psnr", "PSNR of the training view (dB)", "linear"),
    ("n_gaussians", "Gaussians", "linear"),
)


@contextmanager
def drawing_style() -> Iterator[None]:
    """Draw in the report's style, one figure at a time, and leave matplotlib as it was."""
    import matplotlib

    with _STYLE_LOCK, matplotlib.rc_context({**_STYLE, "font.family": _families()}):
        yield


@cache
def _families() -> list[str]:
    """The font of charts, and those of this machine that have letters which it lacks.

    matplotlib takes each letter from the first that has it, so that other text is the same everywhere.
    """
    from matplotlib.font_manager import get_font_names

    return [_FONT, *(name for name in _FURTHER_FONTS if name in get_font_names())]


@cache
def _letters() -> frozenset[int]:
    """Code points that charts can be drawn with here."""
    from matplotlib.font_manager import findfont, get_font

    return frozenset().union(*(get_font(findfont(name)).get_charmap() for name in _families()))


def _lacks_letters(figure: Any) -> bool:
    from matplotlib.text import Text

    texts = "".join(text.get_text() for text in figure.findobj(Text))
    return not {ord(letter) for letter in texts if letter.isprintable()} <= _letters()


def svg_image(figure: Any) -> Chart:
    """A figure as an SVG data URI without date or random names; call inside `drawing_style`.

    Text is outlines. Where no font of this machine has all of its letters, such as those of Chinese, it stays
    text, and whoever looks at the figure has it in a font of their own.
    """
    buffer = io.StringIO()
    with _with_all_letters(figure):
        figure.savefig(buffer, format="svg", metadata={"Date": None, "Creator": None}, transparent=True)
    text = _LONG_PATHS.sub(lambda path: _LONG_FRACTION.sub(r"\1", path.group()), buffer.getvalue())
    text = text.replace(f"'{_FONT}'", f"'{_FONT}', sans-serif")
    width, height = (round(float(inches) * 72) for inches in figure.get_size_inches())
    return Chart(data_uri(text.encode("utf-8"), "image/svg+xml"), width, height)


def write_figure(figure: Any, path: Path) -> None:
    """A figure as an image file, whose letters are those of `svg_image`; call inside `drawing_style`.

    Letters that no font of this machine has are boxes in all formats but SVG; a warning says so.

    Args:
        figure: to write.
        path: its suffix (`.png`, `.svg`, `.pdf`) names the format.

    Raises:
        ConfigError: when it cannot be written.
    """
    # Without a date, so that the same numbers are the same file.
    metadata = {"Date": None} if path.suffix == ".svg" else None
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        with whole_file(path) as partial, _with_all_letters(figure) as there:
            figure.savefig(partial, dpi=150, facecolor="white", metadata=metadata)
    except (OSError, ValueError) as error:
        raise ConfigError(f"{path} cannot be written: {reason_of(error)}") from error
    if not there and path.suffix != ".svg":
        logger.warning("%s: no font here has all letters of its names, which an .svg would keep", path)


@contextmanager
def _with_all_letters(figure: Any) -> Iterator[bool]:
    """Save a figure inside: as text where no font has all of its letters. Whether one has."""
    import matplotlib
    from matplotlib.text import Text

    for text in figure.findobj(Text):
        text.set_text(drawable(text.get_text()))
    there = not _lacks_letters(figure)
    as_text: Any = {} if there else {"svg.fonttype": "none"}
    with warnings.catch_warnings(), matplotlib.rc_context(as_text):
        if not there:
            warnings.filterwarnings("ignore", message="Glyph .* missing from font")
        yield there


def history_chart(history: Mapping[str, Sequence[Mapping[str, Any]]]) -> Chart:
    """Training curves of the stages, one after the other on one axis of iterations.

    Args:
        history: by stage, a list of `{iteration, loss, psnr, n_gaussians}`.
    """
    from matplotlib.ticker import FormatStrFormatter, LogLocator, NullLocator

    stages = [(stage, entries) for stage, entries in history.items() if entries]
    panels = [panel for panel in _HISTORY_PANELS if any(panel[0] in entries[0] for _, entries in stages)]
    with drawing_style():
        figure = _figure(9.6, 2.5)
        for place, (key, title, scale) in enumerate(panels):
            axes = figure.add_subplot(1, len(panels), place + 1)
            offset = 0.0
            for index, (stage, entries) in enumerate(stages):
                if key not in entries[0]:
                    continue
                iteration = offset + np.array([entry["iteration"] for entry in entries], dtype=np.float64)
                values = np.array([entry[key] for entry in entries], dtype=np.float64)
                color = COARSE_COLOR if index == 0 else FINAL_COLOR
                smooth = _running_mean(values) if key != "n_gaussians" else values
                axes.plot(iteration, values, color=color, linewidth=0.7, alpha=0.35)
                axes.plot(iteration, smooth, color=color, linewidth=1.8, label=stage)
                if index > 0:
                    axes.axvline(offset, color=RULE, linewidth=1, zorder=0)
                offset = float(iteration[-1]) + 1
            if scale == "log":
                axes.set_yscale("log")
                axes.yaxis.set_major_locator(LogLocator(subs=(1, 2, 5)))
                axes.yaxis.set_minor_locator(NullLocator())
                axes.yaxis.set_major_formatter(FormatStrFormatter("%g"))
            axes.set_title(title)
            axes.set_xlabel("iteration")
            axes.margins(x=0.01)
            if key == "n_gaussians":
                axes.set_ylim(bottom=0)
            if place == 0 and len(stages) > 1:
                axes.legend(handlelength=1.4)
        chart = svg_image(figure)
    keys = [key for key, _, _ in panels]
    rows = [
        [stage, entry["iteration"], *(entry.get(key) for key in keys)]
        for stage, entries in stages
        for entry in entries
    ]
    return chart.with_numbers("training", ["stage", "iteration", *keys], rows)


def views_chart(
    coarse: Float[np.ndarray, "t"],
    final: Float[np.ndarray, "t"] | None,
    unobserved_share: Float[np.ndarray, "t"] | None,
    names: Sequence[str] = (),
) -> Chart:
    """PSNR of every held-out view, coarse to final, and the gain against how much was never seen.

    Args:
        coarse: PSNR per view in dB; NaN where there is none.
        final: the same after fine-tuning, or None.
        unobserved_share: share of each view's pixels that training did not see, or None.
        names: of the views, for the numbers; their places by default.
    """
    with drawing_style():
        scatter = final is not None and unobserved_share is not None
        figure = _figure(9.6, 2.7)
        grid = figure.add_gridspec(1, 2 if scatter else 1, width_ratios=[2.4, 1] if scatter else [1])
        axes = figure.add_subplot(grid[0])
        order = np.arange(len(coarse)) + 1
        if final is not None:
            better = final >= coarse
            for side, color in ((better, FINAL_COLOR), (~better, WORSE_COLOR)):
                axes.vlines(order[side], coarse[side], final[side], color=color, linewidth=2.2, alpha=0.35)
            axes.scatter(order, final, s=20, color=FINAL_COLOR, label="final", zorder=3)
        axes.scatter(
            order, coarse, s=16, facecolor="white", edgecolor=COARSE_COLOR, linewidth=1.4, label="coarse"
        )
        axes.set_title("PSNR of each held-out view (dB)")
        axes.set_xlabel("held-out view, in the order of the recording")
        axes.set_xlim(0.3, len(coarse) + 0.7)
        axes.xaxis.get_major_locator().set_params(integer=True)
        axes.legend(ncols=2, loc="lower right", bbox_to_anchor=(1, 1), borderaxespad=0.1, handletextpad=0.1)
        if final is not None and unobserved_share is not None:
            axes = figure.add_subplot(grid[1])
            gain = final - coarse
            axes.axhline(0, color=QUIET, linewidth=0.8)
            axes.scatter(
                100 * unobserved_share,
                gain,
                s=18,
                alpha=0.85,
                color=[FINAL_COLOR if value >= 0 else WORSE_COLOR for value in gain],
            )
            axes.set_title("Gain (dB) by unseen surface")
            axes.set_xlabel("pixels training never saw (%)")
        chart = svg_image(figure)
    columns = {"coarse_psnr_db": coarse, "final_psnr_db": final, "unobserved_share": unobserved_share}
    known = {name: values for name, values in columns.items() if values is not None}
    rows = [
        [names[place] if len(names) else place + 1, *(float(values[place]) for values in known.values())]
        for place in range(len(coarse))
    ]
    return chart.with_numbers("held_out_views", ["view", *known], rows)


def gain_chart(percent: Sequence[float], colors: Sequence[str], *, title: str) -> Chart:
    """What each trajectory added, in the order of acceptance.

    Args:
        percent: what each of them adds.
        colors: of the trajectories, as in the figures of the scene.
        title: of what it is a share.
    """
    with drawing_style():
        figure = _figure(9.6, 1.9)
        axes = figure.add_subplot()
        order = np.arange(len(percent)) + 1
        axes.bar(order, np.asarray(percent, dtype=np.float64), color=list(colors), width=0.7)
        axes.set_title(title)
        axes.set_xlabel("trajectory, in the order of acceptance")
        axes.set_xlim(0.4, max(len(percent), 8) + 0.6)
        axes.xaxis.get_major_locator().set_params(integer=True)
        chart = svg_image(figure)
    rows = [[place + 1, float(value)] for place, value in enumerate(percent)]
    return chart.with_numbers("trajectories", ["trajectory", "adds_percent"], rows)


def sequences_chart(
    names: Sequence[str],
    coarse: Float[np.ndarray, "s"],
    final: Float[np.ndarray, "s"],
    seconds: Float[np.ndarray, "s"],
) -> Chart:
    """PSNR of each sequence, coarse to final, and PSNR against run time.

    Args:
        names: of the sequences.
        coarse: PSNR in dB; NaN where there is none.
        final: the same after fine-tuning.
        seconds: run time of each.
    """
    with drawing_style():
        figure = _figure(9.6, max(2.4, 0.9 + 0.24 * len(names)))
        left, right = figure.subplots(1, 2, width_ratios=[1.6, 1])
        row = np.arange(len(names))[::-1]
        known = np.isfinite(coarse) & np.isfinite(final)
        better = final >= coarse
        for side, color in ((known & better, FINAL_COLOR), (known & ~better, WORSE_COLOR)):
            left.hlines(row[side], coarse[side], final[side], color=color, linewidth=2.2, alpha=0.35)
        left.scatter(final, row, s=22, color=FINAL_COLOR, label="final", zorder=3)
        left.scatter(
            coarse, row, s=18, facecolor="white", edgecolor=COARSE_COLOR, linewidth=1.4, label="coarse"
        )
        left.set_yticks(row, row_labels(names))
        left.set_ylim(-0.6, len(names) - 0.4)
        left.grid(axis="x")
        left.set_title("PSNR on held-out views (dB)")
        left.legend(ncols=2, loc="lower right", bbox_to_anchor=(1, 1), borderaxespad=0.1, handletextpad=0.1)
        has_final = np.isfinite(final)
        if has_final.any():
            right.scatter(seconds[has_final], final[has_final], s=22, color=FINAL_COLOR)
        if not has_final.all():
            # Nothing was fine-tuned there.
            alone = ~has_final
            right.scatter(
                seconds[alone], coarse[alone], s=18, facecolor="white", edgecolor=COARSE_COLOR, linewidth=1.4
            )
        right.set_title("PSNR (dB) by run time")
        right.set_xlabel("seconds")
        right.set_xlim(left=0)
        chart = svg_image(figure)
    header = ["sequence", "coarse_psnr_db", "final_psnr_db", "seconds"]
    rows: list[list[Cell]] = [
        [name, float(coarse[place]), float(final[place]), float(seconds[place])]
        for place, name in enumerate(names)
    ]
    return chart.with_numbers("sequences", header, rows)


def method_colors(methods: Sequence[str], baseline: str) -> dict[str, str]:
    """A colour per method: grey for the baseline, the accent for the first of the others."""
    return {baseline: COARSE_COLOR, **run_colors([method for method in methods if method != baseline])}


def run_colors(names: Sequence[str]) -> dict[str, str]:
    """A colour per run or method, none of them a baseline; they repeat, see `method_marks`."""
    return {name: METHOD_COLORS[index % len(METHOD_COLORS)] for index, name in enumerate(names)}


def method_marks(colors: Mapping[str, str]) -> dict[str, str]:
    """A mark of each method, by which those that share a colour differ."""
    taken: Counter[str] = Counter()
    marks = {}
    for method, color in colors.items():
        marks[method] = METHOD_MARKS[taken[color] % len(METHOD_MARKS)]
        taken[color] += 1
    return marks


def methods_chart(
    groups: Sequence[str],
    values: Mapping[str, Mapping[str, Sequence[float]]],
    seconds: Mapping[str, Mapping[str, Sequence[float]]],
    colors: Mapping[str, str],
    title: str,
) -> Chart:
    """A figure of every run by group, one line per group and one mark per run, and the same by run time.

    Args:
        groups: names of the lines, from the top.
        values: by method and group, the figure of each run.
        seconds: the same for the run times.
        colors: of the methods.
        title: name and unit of the figure.
    """
    with drawing_style():
        figure = _figure(9.6, max(2.6, 1.0 + (0.1 + 0.13 * len(colors)) * len(groups)))
        left, right = figure.subplots(1, 2, width_ratios=[1.6, 1])
        row = np.arange(len(groups))[::-1]
        marks = method_marks(colors)
        for place, (method, color) in enumerate(colors.items()):
            mark = marks[method]
            # Methods of a group stand below each other; their runs share a height.
            height = (0.5 - (place + 0.5) / len(colors)) * 0.7
            for index, group in enumerate(groups):
                found = np.asarray(values.get(method, {}).get(group, ()), dtype=np.float64)
                if not found.size:
                    continue
                at = np.full(found.size, row[index] + height)
                left.hlines(at[0], found.min(), found.max(), color=color, linewidth=2.2, alpha=0.35)
                left.scatter(found, at, s=14, color=color, alpha=0.8, linewidth=0, marker=mark)
                left.scatter([found.mean()], at[:1], s=40, marker="|", color=color, linewidth=1.8)
                took = np.asarray(seconds[method][group], dtype=np.float64)
                right.scatter(took, found, s=16, color=color, alpha=0.8, linewidth=0, marker=mark)
            left.scatter([], [], s=22, color=color, label=method, marker=mark)
        left.set_yticks(row, row_labels(groups))
        left.set_ylim(-0.6, len(groups) - 0.4)
        left.grid(axis="x")
        left.set_title(title)
        if len(colors) <= LEGEND_COLUMNS:
            left.legend(
                ncols=len(colors),
                loc="lower right",
                bbox_to_anchor=(1, 1),
                borderaxespad=0.1,
                handletextpad=0.1,
            )
        else:
            figure.legend(ncols=LEGEND_COLUMNS, loc="outside lower center", handletextpad=0.1)
        right.set_title("The same by run time")
        right.set_xlabel("seconds")
        right.set_xlim(left=0)
        chart = svg_image(figure)
    rows: list[list[Cell]] = [
        [group, method, float(value), float(took)]
        for method in colors
        for group in groups
        for value, took in zip(
            values.get(method, {}).get(group, ()), seconds.get(method, {}).get(group, ()), strict=True
        )
    ]
    return chart.with_numbers(file_name(title), ["sequence", "method", title, "seconds"], rows)


def pairs_chart(
    panels: Sequence[tuple[str, bool]],
    rows: Sequence[tuple[str, Sequence[tuple[float, float | None, float | None] | None]]],
    unjudged: Collection[tuple[int, int]] = (),
) -> Chart:
    """Paired differences with their 95 % intervals, one panel per figure, zero marked.

    Args:
        panels: title of each figure, and whether more is better.
        rows: name of each line, from the top, and by panel mean, low and high; None where there is no
            difference, no interval for a single pair.
        unjudged: row and panel of differences that are not called better or worse.
    """
    from matplotlib.ticker import MaxNLocator

    with drawing_style():
        figure = _figure(9.6, max(1.8, 0.95 + 0.2 * len(rows)))
        axes = figure.subplots(1, len(panels), sharey=True, squeeze=False)[0]
        place = np.arange(len(rows))[::-1]
        for column, (panel, (title, higher_is_better)) in enumerate(zip(axes, panels, strict=True)):
            panel.axvline(0, color=QUIET, linewidth=0.8)
            for line, (at, (_, cells)) in enumerate(zip(place, rows, strict=True)):
                cell = cells[column]
                if cell is None:
                    continue
                mean, low, high = cell
                color = FINAL_COLOR if (mean > 0) == higher_is_better else WORSE_COLOR
                if mean == 0 or (line, column) in unjudged:
                    color = COARSE_COLOR
                if low is not None and high is not None:
                    panel.hlines(at, low, high, color=color, linewidth=2.2, alpha=0.4)
                panel.scatter([mean], [at], s=22, color=color, zorder=3)
            panel.set_title(textwrap.fill(title, 22))
            panel.set_ylim(-0.6, len(rows) - 0.4)
            panel.xaxis.set_major_locator(MaxNLocator(4, min_n_ticks=2))
            panel.grid(axis="x")
            panel.grid(visible=False, axis="y")
        axes[0].set_yticks(place, row_labels([name for name, _ in rows]))
        chart = svg_image(figure)
    numbers: list[list[Cell]] = [
        [name, title, *cell]
        for name, cells in rows
        for (title, _), cell in zip(panels, cells, strict=True)
        if cell is not None
    ]
    header = ["run", "figure", "mean_difference", "low", "high"]
    return chart.with_numbers("differences", header, numbers)


def _figure(width_in: float, height_in: float) -> Any:
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    figure = Figure(figsize=(width_in, height_in), layout="constrained")
    FigureCanvasAgg(figure)
    return figure


def _running_mean(values: np.ndarray) -> np.ndarray:
    half = max(1, round(SMOOTHING_SHARE * len(values) / 2))
    total = np.cumsum(np.insert(values, 0, 0.0))
    index = np.arange(len(values))
    # Windows shrink alike on both sides towards the ends, so that a line does not bend there.
    reach = np.minimum(np.minimum(index, len(values) - 1 - index), half)
    return np.asarray((total[index + reach + 1] - total[index - reach]) / (2 * reach + 1))
