"""The front door: what `import extrags` offers, guarded by a checked-in list.

Whoever takes a name away, or changes what a function asks for, edits `api_surface.json` in the same change:
`python -m tests.test_api_surface` writes it anew.
"""

from __future__ import annotations

import inspect
import json
import re
import subprocess
import sys
from pathlib import Path

import pytest

import extrags
from extrags import api

SURFACE = Path(__file__).with_name("api_surface.json")


def surface() -> dict[str, str]:
    """Every public name with its kind and, for functions, its parameters."""
    found = {}
    for name in sorted(api.__all__):
        value = getattr(api, name)
        if inspect.isclass(value):
            found[name] = "class"
        elif callable(value):
            found[name] = (
                f"({', '.join(_parameter(one) for one in inspect.signature(value).parameters.values())})"
            )
        else:
            found[name] = type(value).__name__
    return found


def _parameter(parameter: inspect.Parameter) -> str:
    mark = "*" if parameter.kind is inspect.Parameter.KEYWORD_ONLY else ""
    return f"{mark}{parameter.name}{'' if parameter.default is inspect.Parameter.empty else '='}"


def test_the_surface_is_as_recorded() -> None:
    assert surface() == json.loads(SURFACE.read_text(encoding="utf-8")), (
        "the public names have changed; where that is meant, run `python -m tests.test_api_surface`"
    )


@pytest.mark.parametrize("name", sorted(api.__all__))
def test_every_name_is_there_and_documented(name: str) -> None:
    value = getattr(extrags, name)
    assert value is getattr(api, name)
    if callable(value):
        assert inspect.getdoc(value), f"{name} has no docstring"


def test_the_page_on_python_tells_every_name_with_the_first_sentence_of_its_docstring() -> None:
    page = (Path(__file__).parents[1] / "docs" / "python.md").read_text(encoding="utf-8")
    rows = dict(re.findall(r"^\| `(\w+)` \| (.+) \|$", page, flags=re.MULTILINE))
    assert sorted(rows) == sorted(api.__all__)
    for name, said in rows.items():
        value = getattr(api, name)
        if callable(value):
            assert said == (inspect.getdoc(value) or "").split("\n\n")[0].replace("\n", " "), name


def test_the_front_door_opens_late_and_wrong_names_are_refused() -> None:
    code = (
        "import sys, extrags\n"
        "assert 'torch' not in sys.modules\n"
        "assert 'run_pipeline' in dir(extrags)\n"
        "assert extrags.explore.__name__ == 'explore' and extrags.evaluate.__name__ == 'evaluate'\n"
        "try:\n    extrags.reconstrct\n"
        "except AttributeError as error:\n    print(error)"
    )
    result = subprocess.run(
        [sys.executable, "-c", code], capture_output=True, text=True, check=True, timeout=120
    )
    assert (
        result.stdout.strip() == "module 'extrags' has no attribute 'reconstrct'; did you mean reconstruct?"
    )


if __name__ == "__main__":
    SURFACE.write_text(json.dumps(surface(), indent=1) + "\n", encoding="utf-8")
