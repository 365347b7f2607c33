"""What callers pass in place of a sequence or of settings, refused in a sentence that says what to pass."""

from __future__ import annotations

from extrags.errors import ConfigError
from extrags.sequence import EndoscopicSequence
from extrags.sequence_checks import check_arrays

__all__ = ["check_sequence_argument", "check_settings_argument"]


def check_sequence_argument(sequence: object, function: str) -> None:
    """Refuse what is no sequence, or one whose arrays no stage could use.

    Args:
        sequence: what was given.
        function: that it was given to, for the message.

    Raises:
        TypeError: it is no `EndoscopicSequence`; says how one is made.
        SourceError: as `check_arrays`.
    """
    if not isinstance(sequence, EndoscopicSequence):
        how = f"extrags.read({sequence!r})" if isinstance(sequence, str) else "extrags.read(name or path)"
        raise TypeError(
            f"{function} was given {_given(sequence)} as its sequence; pass {how}, or "
            "extrags.sequence_from_arrays(...)"
        )
    check_arrays(sequence)


def check_settings_argument(config: object, expected: type[object], function: str, example: str) -> None:
    """Refuse settings of another kind, such as the name of a profile.

    Args:
        config: what was given.
        expected: class of the settings.
        function: that they were given to, for the message.
        example: an expression that gives such settings.

    Raises:
        ConfigError: says what to pass.
    """
    if not isinstance(config, expected):
        article = "an" if expected.__name__[0] in "AEIOU" else "a"
        raise ConfigError(
            f"{function} was given {_given(config)} as its config; pass {article} {expected.__name__}, "
            f"such as {example}"
        )


def _given(value: object) -> str:
    return repr(value) if isinstance(value, str) else f"an object of type {type(value).__name__}"
