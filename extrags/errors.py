"""All exceptions that the library raises.

They share one root class, and each also derives from the fitting builtin exception, so that
`except ValueError` keeps working. A message names the file, the frame and the field, what was found and
what was expected.
"""

from __future__ import annotations

from collections.abc import Iterable

from extrags.redaction import without_credentials

__all__ = [
    "ArtefactGoneError",
    "CaptureError",
    "ConfigError",
    "DamagedArtefactError",
    "DivergedError",
    "ExtragsError",
    "MissingDependencyError",
    "NonFiniteError",
    "PoseError",
    "ShapeError",
    "SourceError",
    "SourceNotFoundError",
    "StoreError",
    "UnknownSequenceError",
    "WeightsError",
    "did_you_mean",
    "installed_with",
    "reason_of",
]


def installed_with(extra: str) -> str:
    """How an optional part is installed, to be appended to a message; no package index has extrags.

    Args:
        extra: as `pyproject.toml` names it.
    """
    return f"pip install -e '.[{extra}]' in a checkout of extrags"


def did_you_mean(name: str, known: Iterable[str]) -> str:
    """`; did you mean A or B?`, to be appended to a message about an unknown name; empty without a match.

    Args:
        name: the unknown name.
        known: valid names. The last part of a dotted name matches, too: `iterations` finds
            `coarse.iterations`.
    """
    from difflib import get_close_matches

    known = list(known)
    ending = f".{name.lstrip('-')}"
    near = [other for other in known if other.endswith(ending)] or get_close_matches(name, known, n=1)
    return f"; did you mean {' or '.join(near)}?" if near else ""


def reason_of(error: BaseException) -> str:
    """What an error says, to be appended to a message that names the file.

    Args:
        error: of the operating system: without its number and file; any other: as it is.
    """
    return getattr(error, "strerror", None) or str(error)


class ExtragsError(Exception):
    """Root of all errors raised by extrags; messages never hold credentials (`extrags.redaction`)."""

    def __init__(self, *args: object) -> None:
        super().__init__(*(without_credentials(item) if isinstance(item, str) else item for item in args))


class ShapeError(ExtragsError, ValueError):
    """An array has the wrong number of dimensions, size or dtype."""


class NonFiniteError(ExtragsError, ValueError):
    """An array or setting holds NaN or infinity; names the array."""


class ConfigError(ExtragsError, ValueError):
    """A setting is unknown, out of range, or incompatible with other settings."""


class SourceError(ExtragsError, ValueError):
    """An input file exists, but its content is invalid.

    Args:
        problem: what is wrong and what was expected, as a sentence.
        file: the file it was found in.
        frame: the frame it belongs to, by name or index.
        field: the field of the file, e.g. `K` or `world_from_camera`.
    """

    def __init__(
        self,
        problem: str,
        *,
        file: object | None = None,
        frame: object | None = None,
        field: str | None = None,
    ) -> None:
        self.problem = problem = without_credentials(problem)
        self.file = None if file is None else without_credentials(str(file))
        self.frame = None if frame is None else str(frame)
        self.field = field
        where = [
            f"{label} {value}"
            for label, value in (("file", self.file), ("frame", self.frame), ("field", field))
            if value is not None
        ]
        super().__init__(f"{', '.join(where)}: {problem}" if where else problem)

    def __reduce__(self) -> tuple[object, ...]:
        """Pickle with all fields, for errors that cross process boundaries."""
        return (
            _rebuild_source_error,
            (type(self), self.problem, self.file, self.frame, self.field),
        )


def _rebuild_source_error(
    kind: type[SourceError], problem: str, file: str | None, frame: str | None, field: str | None
) -> SourceError:
    return kind(problem, file=file, frame=frame, field=field)


class SourceNotFoundError(SourceError, FileNotFoundError):
    """A file or folder of the input is missing."""

    def __str__(self) -> str:
        return str(self.args[0])


class PoseError(SourceError):
    """A camera pose is not a rigid motion, or is missing or misplaced."""


class CaptureError(ExtragsError, RuntimeError):
    """The recording is not sufficient for a step: too few frames, no parallax, no visible surface."""


class UnknownSequenceError(ExtragsError, KeyError):
    """No sequence of this name in the catalogue, and no such path on disk."""

    def __str__(self) -> str:
        return str(self.args[0])


class StoreError(ExtragsError, OSError):
    """The artefact store cannot be read or written."""


class ArtefactGoneError(StoreError):
    """An artefact that a ref names is not in the store any more, or other content has replaced it.

    Args:
        message: which one.
        key: its key.
    """

    def __init__(self, message: str, key: str = "") -> None:
        super().__init__(message)
        self.key = key

    def __reduce__(self) -> tuple[object, ...]:
        """Pickle with all fields, for errors that cross process boundaries."""
        return (type(self), (str(self), self.key))


class DamagedArtefactError(StoreError):
    """Files of an artefact are missing, truncated or changed since they were stored.

    Args:
        problem: what is wrong.
        file: the file, below the artefact where that is known.
        stage: the stage that made it; empty where a file was read without the store.
        key: its key.
        store: root of its store.
    """

    def __init__(
        self, problem: str, *, file: object = "", stage: str = "", key: str = "", store: str = ""
    ) -> None:
        self.problem = problem
        self.file = str(file)
        self.stage = stage
        self.key = key
        self.store = store
        what = f"{self.file}: {problem}" if self.file else problem
        if key:
            what = (
                f"artefact {key} of stage {stage} is damaged: {what}; `extrags cache verify --repair "
                f"--store {store}` sets it aside, and the next run recomputes it"
            )
        super().__init__(what)

    def __reduce__(self) -> tuple[object, ...]:
        """Pickle with all fields, for errors that cross process boundaries."""
        return (_rebuild_damage, (self.problem, self.file, self.stage, self.key, self.store))


def _rebuild_damage(problem: str, file: str, stage: str, key: str, store: str) -> DamagedArtefactError:
    return DamagedArtefactError(problem, file=file, stage=stage, key=key, store=store)


class WeightsError(ExtragsError, FileNotFoundError):
    """Weights of a network are missing or belong to another network; says how to get them."""


class MissingDependencyError(ExtragsError, ImportError):
    """An optional package is not installed; names the extra that brings it."""


class DivergedError(ExtragsError, ArithmeticError):
    """An optimisation produced NaN or infinity; names the iteration and the parameter group.

    Args:
        message: which stage, iteration and parameter group.
        last_good: the last finite state of what was optimised, for debugging.
    """

    def __init__(self, message: str, last_good: object = None) -> None:
        super().__init__(message)
        self.last_good = last_good
