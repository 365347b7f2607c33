"""Whether a run shows its progress on a page of the server; imports no Prefect, which it is asked before."""

from __future__ import annotations

import os

from extrags.errors import ConfigError

__all__ = ["PAGE_VARIABLE", "page_chosen"]

PAGE_VARIABLE = "EXTRAGS_RUN_PAGE"
"""Environment variable: `0` for no progress and no pictures on the run's page, `1` (the default) for both."""


def page_chosen() -> bool:
    """What `EXTRAGS_RUN_PAGE` says.

    Raises:
        ConfigError: for another value than 0 and 1.
    """
    chosen = os.environ.get(PAGE_VARIABLE) or "1"
    if chosen not in ("0", "1"):
        raise ConfigError(f"{PAGE_VARIABLE} is {chosen!r}; expected 0 or 1")
    return chosen == "1"
