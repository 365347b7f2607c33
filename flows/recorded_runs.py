"""Runs that a store has on record, as the pages that compare them show them."""

from __future__ import annotations

import hashlib
import os
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any
from urllib.parse import quote

from data_catalog.names import comparable_name, path_of
from data_catalog.patterns import is_named
from extrags.errors import ConfigError, StoreError, UnknownSequenceError, did_you_mean
from extrags.pipeline import HELD_OUT_TRAINED_ON
from extrags.report.leaderboard import BoardRow
from extrags.store import Manifest, Ref, Store
from extrags.user_paths import expanded
from flows.outcome_records import (
    OutcomeRecord,
    held_out_trained_on,
    outcome_records,
    recorded_name,
    recorded_page,
    report_key,
    setting_text,
    told_apart,
)

if TYPE_CHECKING:
    from data_catalog.dataset import Descriptor
    from extrags.report.gallery import GalleryRun
    from extrags.report.run_comparison import ComparedRun
    from extrags.sequence import EndoscopicSequence

__all__ = [
    "RecordedRun",
    "board_rows",
    "chosen_runs",
    "compared_run",
    "gallery_run",
    "held_out_digest",
    "last_runs",
    "run_names",
]

DEFAULT_SEED = "default seeds"
"""In words: each stage has its own."""


@dataclass(frozen=True)
class RecordedRun:
    """A run that went through to its page.

    Args:
        report: manifest of the page, which knows what was shown on it.
        record: how the run ended; None for a page that was named itself and is on no record.
    """

    report: Manifest
    record: OutcomeRecord | None = None

    @property
    def sequence(self) -> str:
        """Its sequence."""
        return self.report.label if self.record is None else str(self.record["sequence"])

    @property
    def shown_name(self) -> str:
        """What pages call its sequence; of a path the last part, since pages are sent to other machines.

        Frames of equal content are one artefact, which knows the name of the source that was read first.
        """
        kept = self.report.config.get("name")
        if kept:
            return str(kept)
        # Pages of earlier versions.
        path = path_of(self.sequence) if self.record is None else self.record.get("path")
        return Path(self.sequence).name if path else self.sequence

    @property
    def place(self) -> str:
        """What the names of its sequence have in common."""
        return comparable_name(self.report.label) if self.record is None else recorded_name(self.record)

    def traits(self) -> dict[str, str]:
        """What tells it from other runs of its sequence: method, profile, seed and settings of a matrix."""
        if self.record is None:
            return {"profile": str(self.report.config.get("profile", "")), "page": self.report.key}
        seed = self.record["seed"]
        return {
            "method": str(self.record["method"]),
            "profile": str(self.record["profile"]),
            "seed": DEFAULT_SEED if seed is None else f"seed {seed}",
            "settings": setting_text(self.record["variant"]),
        }

    def ref(self, store: Store, part: str) -> Ref | None:
        """An artefact that the page shows, by the names of `extrags.stages.Part`; None where it shows none.

        Raises:
            StoreError: when it is gone from the store.
        """
        key = self.report.input_keys.get(f"parts.{part}")
        if key is None:
            return None
        found = store.find(key)
        if found is None:
            raise StoreError(f"{self.sequence}: {key} is gone from the store; run it again")
        return found


def chosen_runs(
    store: Store,
    names: Sequence[str],
    *,
    methods: Sequence[str] = (),
    profiles: Sequence[str] = (),
    seeds: Sequence[int] = (),
) -> list[RecordedRun]:
    """The runs of one sequence that are to be compared, the oldest first.

    Args:
        store: where they are.
        names: a sequence, which stands for all of its runs on record, or pages: their files, folders or keys.
        methods: only runs of these; all without any.
        profiles: the same.
        seeds: the same.

    Raises:
        ConfigError: when fewer than two are found, or they are of different sequences.
        StoreError: for a page that is not in the store.
    """
    records = sorted(outcome_records(store).values(), key=lambda record: str(record["ended"]))
    found: dict[str, RecordedRun] = {}
    unfinished = 0
    for name in names:
        key = report_key(name)
        if key is not None:
            manifest = _manifest(store, key)
            if manifest is None:
                raise StoreError(f"the page {key} is not in the store {store.root}")
            record = next((item for item in records if _key_of(item) == key), None)
            found[key] = RecordedRun(manifest, record)
            continue
        for record in records:
            same = recorded_name(record) == comparable_name(name)
            if not same or not _wanted(record, methods, profiles, seeds):
                continue
            key = _key_of(record)
            manifest = None if key is None else _manifest(store, key)
            if record["status"] == "ok" and key is not None and manifest is not None:
                found[key] = RecordedRun(manifest, record)
            else:
                unfinished += 1
    runs = list(found.values())
    sequences = sorted({run.place: run.sequence for run in runs}.values())
    if len(sequences) > 1:
        raise ConfigError(
            f"runs of one sequence are compared; these are of {', '.join(sequences)} "
            "(extrags leaderboard compares sequences)"
        )
    if len(runs) < 2:
        more = f", and {unfinished} that did not come to a page" if unfinished else ""
        meant = nearest_on_record(store, names)
        then = f"{meant} A" if meant else "; a"
        raise ConfigError(
            f"{', '.join(names)}: {len(runs)} finished run{'s' * (len(runs) != 1)} on record in "
            f"{store.root}{more}{then} comparison takes two. Of runs that differ in settings alone the last "
            "one is on record; to compare them, run once with each value in a matrix (extrags run ... "
            "--matrix coarse.iterations=150,300), or name the pages of two runs"
        )
    return runs


def nearest_on_record(store: Store, names: Sequence[str]) -> str:
    """`; did you mean A?` of the first name that no run on record has; empty where there is none like it."""
    records = list(outcome_records(store).values())
    known = {recorded_name(record) for record in records}
    unknown = (name for name in names if comparable_name(name) not in known)
    hints = (did_you_mean(name, dict.fromkeys(told_apart(records))) for name in unknown)
    return next(filter(None, hints), "")


def run_names(runs: Sequence[RecordedRun]) -> list[str]:
    """What sets the runs apart: the traits in which they differ, numbered where those are the same."""
    traits = [run.traits() for run in runs]
    keys = list(dict.fromkeys(key for own in traits for key in own))
    telling = [key for key in keys if len({own.get(key, "") for own in traits}) > 1]
    names = []
    for own in traits:
        words = [own[key] for key in telling if own.get(key) and key != "page"]
        names.append(", ".join(words) or own.get("page", "") or "run")
    return [
        f"{name} ({names[: place + 1].count(name)})" if names.count(name) > 1 else name
        for place, name in enumerate(names)
    ]


def compared_run(store: Store, run: RecordedRun, name: str, target: str = "") -> ComparedRun:
    """A run with what is shown of it; where nothing was fine-tuned, its coarse scene.

    Args:
        store: where it is.
        run: with its page.
        name: what it is called.
        target: the page that links to it; empty for one that lies nowhere yet.

    Raises:
        StoreError: when an artefact is gone, or the run was not evaluated.
    """
    # Here, because they load torch, which a leaderboard needs not.
    from extrags.metrics.protocol import RenderedViews
    from extrags.report.run_comparison import ComparedRun
    from extrags.report.run_tables import plain_value
    from tasks.evaluate import METRICS_FILE
    from tasks.report import PAGE

    renders = run.ref(store, "renders_final") or run.ref(store, "renders_coarse")
    metrics = run.ref(store, "metrics_final") or run.ref(store, "metrics_coarse")
    if renders is None or metrics is None:
        raise StoreError(f"{run.sequence}: the page {run.report.key} was made without an evaluation")
    settings = _flat(run.report.config["config"])
    stages = [] if run.record is None else run.record["stages"]
    page = store.find(run.report.key)
    return ComparedRun(
        name=name,
        rgb=store.load(RenderedViews, renders).rgb,
        result=store.load_json(METRICS_FILE, metrics),
        settings={key: plain_value(value) for key, value in settings.items()},
        seconds=sum(float(stage["made_seconds"]) for stage in stages) if stages else None,
        link="" if page is None else _address(f"{page.uri}/{PAGE}", target),
        held_out_trained_on=run.record is not None and held_out_trained_on(run.record),
        imported=_is_imported(run),
    )


def held_out_digest(sequence: EndoscopicSequence) -> str:
    """Digest of the images and masks of the held-out frames, by which runs are told to be of the same."""
    digest = hashlib.sha256()
    for frame in sequence.test:
        digest.update(sequence.rgb[frame].tobytes())
        digest.update(sequence.mask[frame].tobytes())
    return digest.hexdigest()


def last_runs(
    store: Store,
    patterns: Sequence[str] = (),
    *,
    methods: Sequence[str] = (),
    profiles: Sequence[str] = (),
) -> list[RecordedRun]:
    """The last finished run of each sequence that has a page, by name.

    Args:
        store: where they are.
        patterns: of sequences; all without any.
        methods: only runs of these; all without any.
        profiles: the same.

    Raises:
        StoreError: when the store cannot be read.
    """
    found: dict[str, RecordedRun] = {}
    records = sorted(outcome_records(store).values(), key=lambda item: str(item["ended"]))
    for record, sequence in zip(records, told_apart(records), strict=True):
        if not (_matches(sequence, patterns) or _matches(str(record["sequence"]), patterns)):
            continue
        key = _key_of(record) if record["status"] == "ok" and _wanted(record, methods, profiles, ()) else None
        manifest = None if key is None else _manifest(store, key)
        if manifest is not None:
            found[sequence] = RecordedRun(manifest, record)
    return [found[sequence] for sequence in sorted(found)]


def gallery_run(store: Store, run: RecordedRun) -> GalleryRun:
    """A run with what a gallery shows of it.

    Raises:
        StoreError: when an artefact is gone, or the run was not evaluated.
    """
    from extrags.metrics.protocol import RenderedViews
    from extrags.pseudo_views import PseudoViews
    from extrags.report.gallery import KINDS, GalleryRun
    from extrags.sequence import EndoscopicSequence
    from tasks.evaluate import METRICS_FILE

    frames, enhance = run.ref(store, "sequence"), run.ref(store, "enhance")
    rgb, results = {}, {}
    for kind in KINDS:
        renders, metrics = run.ref(store, f"renders_{kind}"), run.ref(store, f"metrics_{kind}")
        if renders is not None and metrics is not None:
            rgb[kind] = store.load(RenderedViews, renders).rgb
            results[kind] = store.load_json(METRICS_FILE, metrics)
    if frames is None or not rgb:
        raise StoreError(f"{run.sequence}: the page {run.report.key} was made without an evaluation")
    traits = run.traits()
    known = _described(run.sequence)
    return GalleryRun(
        sequence=replace(store.load(EndoscopicSequence, frames), name=run.shown_name),
        rgb=rgb,
        results=results,
        method=traits.get("method", ""),
        profile=traits.get("profile", ""),
        pseudo=None if enhance is None else store.load(PseudoViews, enhance),
        held_out=_knowledge(run),
        source="" if known is None else known.description,
        licence="" if known is None else known.licence,
    )


def _described(sequence: str) -> Descriptor | None:
    """What the catalogue knows of a sequence; None of a path."""
    from data_catalog import catalog

    try:
        return catalog.describe(sequence)
    except UnknownSequenceError:
        return None


def _knowledge(run: RecordedRun) -> str:
    """What is to be said of a scene that may have seen the held-out frames; empty of one that has not."""
    if run.record is not None and held_out_trained_on(run.record):
        return HELD_OUT_TRAINED_ON.capitalize()
    unknown = "The scene is imported: whether it has seen the held-out frames is not known"
    return unknown if _is_imported(run) else ""


def _is_imported(run: RecordedRun) -> bool:
    return bool(run.report.config["config"].get("imported", {}).get("scene"))


def board_rows(store: Store, patterns: Sequence[str] = (), target: str = "") -> list[BoardRow]:
    """Every run on record whose sequence matches one of the patterns; all without patterns.

    Args:
        store: where they are.
        patterns: of sequences.
        target: the page that links to them; empty for one that lies nowhere yet.

    Raises:
        StoreError: when the store cannot be read.
    """
    rows = []
    there = set(store.keys())
    records = list(outcome_records(store).values())
    for record, sequence in zip(records, told_apart(records), strict=True):
        if not (_matches(sequence, patterns) or _matches(str(record["sequence"]), patterns)):
            continue
        seed, tree = record["seed"], record["metrics"]
        page = recorded_page(store, record, there)
        rows.append(
            BoardRow(
                sequence=sequence,
                method=str(record["method"]),
                profile=str(record["profile"]),
                seed="" if seed is None else str(seed),
                settings=setting_text(record["variant"]),
                further=setting_text(
                    {
                        name: value
                        # Records of earlier versions have none.
                        for name, value in record.get("settings", {}).items()
                        if name not in record["variant"]
                    }
                ),
                status=record["status"],
                reason=f"{record['stage']}: {record['reason']}" if record["status"] == "failed" else "",
                ended=str(record["ended"]),
                seconds=sum(float(stage["made_seconds"]) for stage in record["stages"]),
                metrics=tree.get("final") or tree.get("coarse"),
                protocol=record.get("protocol"),
                held_out_trained_on=held_out_trained_on(record),
                imported=bool(record["variant"].get("imported.scene")),
                link="" if page is None else _address(page, target),
            )
        )
    return sorted(rows, key=lambda row: (row.sequence, row.method, row.profile, row.seed, row.settings))


def _matches(sequence: str, patterns: Sequence[str]) -> bool:
    return not patterns or any(is_named(sequence, pattern) for pattern in patterns)


def _wanted(
    record: Mapping[str, Any], methods: Sequence[str], profiles: Sequence[str], seeds: Sequence[int]
) -> bool:
    return (
        (not methods or record["method"] in methods)
        and (not profiles or record["profile"] in profiles)
        and (not seeds or record["seed"] in seeds)
    )


def _key_of(record: Mapping[str, Any]) -> str | None:
    return report_key(record["report"]) if record["report"] else None


def _manifest(store: Store, key: str) -> Manifest | None:
    ref = store.find(key)
    return None if ref is None else store.manifest(ref)


def _flat(tree: Mapping[str, Any], prefix: str = "") -> dict[str, Any]:
    """Values of a tree of settings by dotted name."""
    found: dict[str, Any] = {}
    for name, value in tree.items():
        found |= _flat(value, f"{prefix}{name}.") if isinstance(value, Mapping) else {prefix + name: value}
    return found


def _address(place: str, target: str) -> str:
    """Of a page, for a link from another one.

    Relative where both lie in one folder, however deep, so that this folder can be moved or sent; else the
    address on this machine.
    """
    if "://" in place:
        return place
    page = Path(place).absolute()
    if target:
        folder = expanded(target).absolute().parent
        shared = os.path.commonpath([page, folder]) if page.anchor == folder.anchor else page.anchor
        if shared != page.anchor:
            return quote(Path(os.path.relpath(page, folder)).as_posix())
    return page.as_uri()
