"""Characters that cannot be shown, as Python writes them."""

from __future__ import annotations

import re

__all__ = ["escaped"]


def escaped(text: str, hidden: re.Pattern[str]) -> str:
    r"""The text with `\x1b`, as Python writes it, in place of each such character.

    Args:
        text: of any kind.
        hidden: matches the characters, one at a time.
    """
    return hidden.sub(lambda found: found[0].encode("unicode_escape").decode("ascii"), text)
