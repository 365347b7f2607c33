"""What is looked at before sequences are run, so that it is said at once and not by each run."""

from __future__ import annotations

import logging
from collections.abc import Sequence
from typing import TYPE_CHECKING

from extrags.errors import ConfigError, ExtragsError, PoseError, SourceError, UnknownSequenceError
from flows.outcome import SequenceOutcome, StageRow

if TYPE_CHECKING:
    from extrags.stages import StageName
    from flows.cases import SequenceCase

__all__ = ["check_names", "check_working_distance", "wrong_source"]

log = logging.getLogger(__name__)


def check_names(sequences: list[str]) -> None:
    """An unknown name is wrong usage and stops everything; a source that is wrong concerns its own run.

    Raises:
        UnknownSequenceError: for a name that is neither in the catalogue nor a path.
    """
    from data_catalog.catalog import resolve

    for sequence in sequences:
        try:
            resolve(sequence)
        except UnknownSequenceError:
            raise
        except (ExtragsError, OSError):
            continue


def check_working_distance(cases: Sequence[SequenceCase]) -> None:
    """Refuse `poses.working_distance_mm` where no poses are estimated, and warn where some are not.

    Only the poses stage looks at it, which sources with poses of their own skip.

    Raises:
        ConfigError: every sequence that it is given for has poses.
    """
    from data_catalog import describe, glance

    given, posed = set(), []
    for case in cases:
        config = case.config()
        if config.poses.working_distance_mm is None or config.poses.replace_given or case.sequence in given:
            continue
        given.add(case.sequence)
        try:
            about = glance(case.sequence, config.ingest) or describe(case.sequence)
        except (ConfigError, SourceError, UnknownSequenceError, OSError):
            # What is wrong with a source is said by the run, for each by itself.
            continue
        if about.has_poses:
            posed.append(case.sequence)
    if not posed:
        return
    first = posed[0] if len(posed) == 1 else f"{posed[0]} and {len(posed) - 1} more"
    problem = (
        f"{first}: poses.working_distance_mm makes estimated poses metric, and these are the source's own; "
        "ingest.scale_mm_per_unit (--scale) says what their unit is where it is arbitrary, and "
        "poses.replace_given estimates others in their place"
    )
    if len(posed) == len(given):
        raise ConfigError(problem)
    log.warning("%s", problem)


def wrong_source(case: SequenceCase, until: StageName) -> SequenceOutcome | None:
    """How a run would fail whose source can be seen to be wrong without reading pictures; else None."""
    from data_catalog import glance
    from extrags.stages import stages_until

    config = case.config()
    try:
        seen = glance(case.sequence, config.ingest)
    except SourceError as error:
        return _failed(case, until, "ingest", error)
    if seen is not None and not seen.has_poses and "poses" in stages_until(until):
        try:
            config.check_imported_has_cameras()
        except PoseError as error:
            return _failed(case, until, "poses", error)
    return None


def _failed(case: SequenceCase, until: StageName, stage: StageName, error: SourceError) -> SequenceOutcome:
    """A run that fails in a stage before any has run."""
    from data_catalog.names import plain_name
    from extrags.stages import stages_until

    rows = [
        StageRow(stage, "failed", reason=str(error))
        if other == stage
        else StageRow(other, "skipped", reason=f"{stage} failed")
        for other in stages_until(until)
    ]
    return SequenceOutcome(plain_name(case.sequence), "failed", rows, error=error)
