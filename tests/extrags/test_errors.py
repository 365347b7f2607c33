from __future__ import annotations

import inspect
import pickle

import pytest

from extrags import errors


def test_every_error_has_the_common_root_and_a_builtin_kind() -> None:
    for name in errors.__all__:
        kind = getattr(errors, name)
        if not inspect.isclass(kind):
            continue
        assert issubclass(kind, errors.ExtragsError)
        builtin = [
            base for base in inspect.getmro(kind) if base.__module__ == "builtins" and base not in
            (object, BaseException, Exception)
        ]  # fmt: skip
        assert builtin or kind is errors.ExtragsError, name


def test_source_error_names_file_frame_and_field() -> None:
    error = errors.SourceError("expected 16 numbers, found 15", file="pose.txt", frame=3, field="pose")
    assert str(error) == "file pose.txt, frame 3, field pose: expected 16 numbers, found 15"


@pytest.mark.parametrize("kind", [errors.SourceError, errors.PoseError, errors.SourceNotFoundError])
def test_source_errors_survive_pickling(kind: type[errors.SourceError]) -> None:
    error = kind("wrong", file="a", frame="b", field="c")
    copy = pickle.loads(pickle.dumps(error))
    assert type(copy) is kind
    assert (str(copy), copy.frame) == (str(error), "b")


def test_source_not_found_is_a_file_not_found_error() -> None:
    with pytest.raises(FileNotFoundError, match=r"file x\.png: no such file"):
        raise errors.SourceNotFoundError("no such file", file="x.png")
