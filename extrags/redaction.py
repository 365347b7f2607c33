"""Credentials taken out of text before it is shown, logged or stored.

Recognised are the user and password of a URL (`s3://KEY:SECRET@bucket`), values of query fields whose names
speak of keys, tokens, signatures or passwords, HTTP authorisation headers by their name (and `Bearer` before
what can only be a token), and the values of environment variables that hold such things
(`EXTRAGS_CAPTION_KEY`, `AWS_SECRET_ACCESS_KEY`, `HF_TOKEN`, ...).
"""

from __future__ import annotations

import logging
import os
import re
from functools import cache
from typing import Any

__all__ = ["HIDDEN", "CredentialFilter", "has_credentials", "without_credentials", "without_credentials_in"]

HIDDEN = "***"
"""Stands where a credential was."""

# Secrets may hold slashes; what follows a colon as a number is a port, though. Lengths are bounded, and the
# scheme is not looked at: names in files of others could otherwise make this take the square of their length.
_USER = re.compile(
    r"""://(?:[^\s/@:"'<>]{0,1024}:(?!\d{1,5}(?:[/?#]|$))[^\s@"'<>]{0,2048}|[^\s/@"'<>?#]{1,2048})@"""
)
_QUERY = re.compile(
    r"""(?P<name>[?&;][^=&;\s"'<>]{0,64}(?:key|token|secret|pass|pwd|sig|auth|credential)"""
    r"""[^=&;\s"'<>]{0,64}=)[^&;\s"'<>#]+""",
    re.IGNORECASE,
)
# `basic` and `bearer` are words, and folders are called `basic colonoscopies`: they count behind the name of
# the header, and where `http.client` refuses one (`Invalid header value b'Bearer ...'`).
_HEADER = re.compile(
    r"""(?P<name>(?:authorization["']?\s*[:=,]|\bheader\s+value:?)\s*b?["']?(?:bearer|basic)\s+)"""
    r"""[A-Za-z0-9+/_.~=-]{12,}""",
    re.IGNORECASE,
)
# Elsewhere a long text of digits and both cases before any slash is a token, behind the rarer word.
_BEARER = re.compile(
    r"(?P<name>\b(?i:bearer)\s+)(?=[\w+.~=-]*\d)(?=[\w+.~=-]*[a-z])(?=[\w+.~=-]*[A-Z])"
    r"[A-Za-z0-9+_.~=-]{20,}[A-Za-z0-9+/_.~=-]*"
)
_SECRET_VARIABLE = re.compile(
    r"(SECRET|TOKEN|PASSWORD|PASSWD|API_?KEY|ACCESS_KEY|CAPTION_KEY|CREDENTIALS?)", re.IGNORECASE
)
_SHORTEST = 8
"""Shorter values of variables are found in harmless text by chance."""


def without_credentials(text: str) -> str:
    """The text with `***` in place of each credential; text without any comes back as it was."""
    if len(text) >= _SHORTEST:
        for value in _secret_values():
            if value in text:
                text = text.replace(value, HIDDEN)
    if "://" in text:
        text = _USER.sub(f"://{HIDDEN}@", text)
        text = _QUERY.sub(rf"\g<name>{HIDDEN}", text)
    for header in (_HEADER, _BEARER):
        text = header.sub(rf"\g<name>{HIDDEN}", text)
    return text


def has_credentials(text: str) -> bool:
    """Whether anything would be taken out."""
    return without_credentials(text) != text


def without_credentials_in(value: Any) -> Any:
    """The same for all text inside JSON-like lists and dicts, keys included."""
    if isinstance(value, str):
        return without_credentials(value)
    if isinstance(value, list | tuple):
        return [without_credentials_in(item) for item in value]
    if isinstance(value, dict):
        return {without_credentials(str(key)): without_credentials_in(item) for key, item in value.items()}
    return value


class CredentialFilter(logging.Filter):
    """For handlers and loggers: takes credentials out of messages and tracebacks; drops nothing."""

    def filter(self, record: logging.LogRecord) -> bool:
        """Change the record in place."""
        text = record.getMessage()
        shown = without_credentials(text)
        if shown != text:
            record.msg, record.args = shown, ()
        if record.exc_info and not record.exc_text:
            traceback = logging.Formatter().formatException(record.exc_info)
            # Formatters take this text instead of formatting the exception themselves.
            if has_credentials(traceback):
                record.exc_text = without_credentials(traceback)
        return True


def _secret_values() -> list[str]:
    """The longest first: one may hold another."""
    values = {os.environ.get(name, "") for name in os.environ if _names_a_secret(name)}
    found = [value for value in values if len(value) >= _SHORTEST and not os.path.exists(value)]
    return sorted(found, key=len, reverse=True)


@cache
def _names_a_secret(variable: str) -> bool:
    # Asked for every variable at every text: of every setting, and of every line that is logged.
    return _SECRET_VARIABLE.search(variable) is not None
