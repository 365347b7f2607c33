"""The layers of the house, and the speed of its front door, as tests."""

from __future__ import annotations

import ast
import re
import subprocess
import sys
import tomllib
from collections.abc import Iterator
from pathlib import Path

import yaml

import extrags

REPOSITORY = Path(__file__).resolve().parents[1]
PROJECT = tomllib.loads((REPOSITORY / "pyproject.toml").read_text())


def test_imports_run_one_way() -> None:
    result = subprocess.run(
        [str(Path(sys.executable).with_name("lint-imports")), "--no-cache"],
        cwd=REPOSITORY,
        capture_output=True,
        text=True,
        timeout=120,
    )
    assert result.returncode == 0, result.stdout + result.stderr


def test_importing_the_library_loads_nothing_heavy() -> None:
    code = (
        "import sys, extrags, extrags.config, extrags.errors, extrags.store\n"
        "heavy = {'torch', 'open3d', 'pycolmap', 'prefect', 'kornia', 'matplotlib', 'cv2'}\n"
        "print(sorted(heavy & set(sys.modules)))"
    )
    result = subprocess.run(
        [sys.executable, "-c", code], cwd=REPOSITORY, capture_output=True, text=True, check=True
    )
    assert result.stdout.strip() == "[]"


def test_packages_say_that_they_are_typed() -> None:
    """The wheel holds their folders as they are tracked; checkers pass over those without the mark."""
    tracked = subprocess.run(
        ["git", "ls-files"], cwd=REPOSITORY, capture_output=True, text=True, check=True
    ).stdout.split("\n")
    packages = PROJECT["tool"]["scikit-build"]["wheel"]["packages"]
    assert set(packages) == set(PROJECT["tool"]["mypy"]["packages"])
    assert {f"{package}/py.typed" for package in packages} <= set(tracked)


def test_the_version_is_the_project_s() -> None:
    assert extrags.__version__ == PROJECT["project"]["version"]


def test_the_citation_is_of_this_version() -> None:
    citation = yaml.safe_load((REPOSITORY / "CITATION.cff").read_text())
    assert {"cff-version", "message", "title", "authors", "type"} <= set(citation)
    assert citation["cff-version"] == "1.2.0"
    for key, name in (("version", "version"), ("title", "name"), ("license", "license")):
        assert citation[key] == PROJECT["project"][name]
    assert citation["keywords"] == PROJECT["project"]["keywords"]
    assert citation["authors"] == [{"name": "extrags developers"}]
    (paper,) = citation["references"]
    names = ", ".join(f"{author['given-names']} {author['family-names']}" for author in paper["authors"])
    cited = (REPOSITORY / "docs" / "references.md").read_text()
    number = paper["identifiers"][0]["value"]
    assert f"{names}: *{paper['title']}*. {paper['conference']['name']}, {number}." in cited


def test_the_changelog_is_of_this_version() -> None:
    changelog = (REPOSITORY / "CHANGELOG.md").read_text()
    assert re.findall(r"^## (\S+?),? ", changelog, re.MULTILINE)[0] == PROJECT["project"]["version"]
    assert len(changelog.splitlines()) <= 150
    for link in re.findall(r"\]\(([^)#]+)", changelog):
        assert link.startswith("https://") or (REPOSITORY / link).is_file(), link


def test_root_holds_only_what_belongs_there() -> None:
    tracked = subprocess.run(
        ["git", "ls-files"], cwd=REPOSITORY, capture_output=True, text=True, check=True
    ).stdout.split("\n")
    roots = {name.split("/")[0] for name in tracked if name and not name.startswith(".")}
    assert roots <= {
        "extrags", "tasks", "flows", "data_catalog", "tests", "docs", "examples",
        "CHANGELOG.md", "CITATION.cff",
        "pyproject.toml", "README.md", "LICENSE", "Makefile", "CMakeLists.txt", "prefect.yaml",
        "requirements.lock", "deploy",
    }  # fmt: skip


def test_messages_hold_no_text_of_the_operating_system_as_python_puts_it() -> None:
    """`[Errno 21] Is a directory: /tmp`: they name the file themselves; `reason_of` has the rest."""
    files = [
        path
        for package in ("extrags", "data_catalog", "tasks", "flows")
        for path in (REPOSITORY / package).rglob("*.py")
    ]
    assert [place for file in files for place in _bare_reasons(file)] == []


def _bare_reasons(file: Path) -> Iterator[str]:
    for handler in ast.walk(ast.parse(file.read_text(encoding="utf-8"))):
        if not isinstance(handler, ast.ExceptHandler) or handler.type is None:
            continue
        caught = ast.unparse(handler.type)
        if "OSError" in caught or caught == "Exception":
            yield from (f"{file}:{line}" for line in _logged_bare(handler))
        if "OSError" not in caught:
            continue
        for node in ast.walk(handler):
            if not isinstance(node, ast.Raise):
                continue
            for part in ast.walk(node):
                if isinstance(part, ast.FormattedValue) and ast.unparse(part.value) == handler.name:
                    yield f"{file}:{part.lineno}"


def _logged_bare(handler: ast.ExceptHandler) -> Iterator[int]:
    """Lines of messages that are given the error itself, without its kind before it."""
    for node in ast.walk(handler):
        if isinstance(node, ast.Call) and ast.unparse(node.func).split(".")[0] in ("log", "logger", "_log"):
            given = [ast.unparse(argument) for argument in node.args]
            if handler.name in given and f"type({handler.name}).__name__" not in given:
                yield node.lineno
