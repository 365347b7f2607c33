"""Templates of the pages."""

from __future__ import annotations

from functools import cache
from typing import Any

__all__ = ["rendered_page"]


def rendered_page(template: str, **values: Any) -> str:
    """A page from a template of this package; every value is escaped, an unknown name is an error."""
    return str(_environment().get_template(template).render(**values))


@cache
def _environment() -> Any:
    import jinja2

    return jinja2.Environment(
        loader=jinja2.PackageLoader("extrags.report", "templates"),
        autoescape=True,
        undefined=jinja2.StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
        keep_trailing_newline=True,
    )
