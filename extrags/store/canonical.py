"""Cache keys: the canonical JSON form of a value, and its digest."""

from __future__ import annotations

import hashlib
import json
import math
from typing import Any

from pydantic import BaseModel, ConfigDict

from extrags.errors import ConfigError

__all__ = ["Ref", "canonical", "digest_of"]

DIGEST_BYTES = 16


class Ref(BaseModel):
    """Reference to an immutable artefact: its location and the digest of its content.

    Only the digest is part of cache keys: a moved or copied artefact is the same input.
    """

    model_config = ConfigDict(frozen=True, extra="forbid")

    uri: str
    """Directory, or URL prefix, of the artefact."""
    digest: str
    """Digest over the artefact's files (names and bytes); the manifest is not part of it."""


def canonical(value: Any) -> Any:
    """Canonical JSON form of a value, independent of process, platform and insertion order.

    Floats are represented exactly (`float.hex`), pydantic models by their fields (but for those in
    their `not_in_keys`, and those of `not_in_keys_where` that have the value given there), refs by their
    digest alone.
    Tuples and lists are equivalent; `1`, `1.0` and `True` are distinct.

    Args:
        value: None, bool, int, float, str, `Ref`, a pydantic model, or lists, tuples and string-keyed
            dicts of these.

    Returns:
        The value as plain JSON types.

    Raises:
        ConfigError: for other types (sets, paths, arrays, functions, ...), which have no canonical form that
            determines a result, and for NaN and infinity.
    """
    return _canonical(value, "value")


def _canonical(value: Any, where: str) -> Any:
    if value is None or isinstance(value, bool | str):
        return value
    if type(value) is int:
        return value
    if type(value) is float:
        if not math.isfinite(value):
            raise ConfigError(f"{where}: {value} cannot be part of a cache key; expected a finite number")
        # + 0.0 turns -0.0 into 0.0: they compare equal, so their keys must be equal.
        return {"$float": (value + 0.0).hex()}
    if isinstance(value, Ref):
        return {"$ref": value.digest}
    if isinstance(value, BaseModel):
        left_out: frozenset[str] = getattr(type(value), "not_in_keys", frozenset())
        usual: dict[str, Any] = getattr(type(value), "not_in_keys_where", {})
        return {
            name: _canonical(getattr(value, name), f"{where}.{name}")
            for name in type(value).model_fields
            if name not in left_out and not (name in usual and getattr(value, name) == usual[name])
        }
    if isinstance(value, list | tuple):
        return [_canonical(item, f"{where}[{index}]") for index, item in enumerate(value)]
    if isinstance(value, dict):
        for name in value:
            if not isinstance(name, str) or name.startswith("$"):
                raise ConfigError(f"{where}: key {name!r} cannot be part of a cache key; expected a string")
        return {name: _canonical(item, f"{where}.{name}") for name, item in value.items()}
    raise ConfigError(
        f"{where}: a {type(value).__name__} cannot be part of a cache key; expected numbers, strings, "
        "lists, dicts, settings or refs"
    )


def digest_of(value: Any) -> str:
    """Digest of the canonical form, 32 hexadecimal digits.

    Raises:
        ConfigError: as `canonical`.
    """
    text = json.dumps(canonical(value), sort_keys=True, separators=(",", ":"), allow_nan=False)
    return hashlib.blake2b(text.encode(), digest_size=DIGEST_BYTES).hexdigest()
