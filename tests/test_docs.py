"""What README and docs say is held against the code: links, commands, settings, modules, citations."""

from __future__ import annotations

import importlib
import inspect
import json
import re
import shlex
import unicodedata
from collections.abc import Iterator
from dataclasses import replace
from functools import cache
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from pydantic import BaseModel

from data_catalog.catalog import describe
from extrags.config import PipelineConfig
from tests.documented_json import tables, undocumented, undocumented_items

REPOSITORY = Path(__file__).resolve().parents[1]
PROTOCOL = REPOSITORY / "extrags" / "metrics" / "PROTOCOL.md"
PAGES = sorted([REPOSITORY / "README.md", *(REPOSITORY / "docs").rglob("*.md")])
REFERENCES = REPOSITORY / "docs" / "references.md"
ROOTS = ("extrags", "data_catalog", "tasks", "flows")

_FENCE = re.compile(
    r"(?P<mark><!-- runnable -->\n)?^ *```(?P<language>\w*)\n(?P<body>.*?)^ *```$", re.MULTILINE | re.DOTALL
)
_INLINE = re.compile(r"`([^`\n]+)`")
_LINK = re.compile(
    r"\[(?:[^\[\]]|\[[^\]]*\])*\]\((?P<target>[^)\s]+)\)|^\[[^\]]+\]: (?P<named>\S+)$", re.MULTILINE
)


def name_of(page: Path) -> str:
    return page.relative_to(REPOSITORY).as_posix()


def blocks(page: Path, *languages: str) -> Iterator[tuple[str, bool]]:
    """Fenced blocks in a language, and whether they are marked to be run."""
    for found in _FENCE.finditer(page.read_text(encoding="utf-8")):
        if found["language"] in languages:
            yield inspect.cleandoc("\n" + found["body"]), found["mark"] is not None


def prose(page: Path) -> str:
    """A page without its fenced blocks and formulas."""
    text = _FENCE.sub("", page.read_text(encoding="utf-8"))
    return re.sub(r"\$\$.*?\$\$", "", text, flags=re.DOTALL)


def inline_code(page: Path) -> list[str]:
    return _INLINE.findall(prose(page))


@cache
def anchors(page: Path) -> frozenset[str]:
    """Anchors of a page: its headings as GitHub spells them, and explicit ones."""
    text = _FENCE.sub("", page.read_text(encoding="utf-8"))
    found = set(re.findall(r'<a id="([^"]+)"></a>', text))
    for heading in re.findall(r"^#+ +(.+?) *$", text, re.MULTILINE):
        plain = re.sub(r"\[([^\]]*)\]\([^)]*\)", r"\1", heading).replace("`", "").lower()
        kept = [c for c in plain if c in " -_" or unicodedata.category(c)[0] in "LN"]
        found.add("".join(kept).replace(" ", "-"))
    return frozenset(found)


@cache
def sources() -> str:
    """All sources of the four packages."""
    files = sorted(file for root in ROOTS for file in (REPOSITORY / root).rglob("*.py"))
    files += sorted((REPOSITORY / "extrags" / "raster" / "kernels").iterdir())
    return "\n".join(file.read_text(encoding="utf-8") for file in files)


@pytest.mark.parametrize("page", [*PAGES, PROTOCOL], ids=name_of)
def test_links_and_anchors_resolve(page: Path) -> None:
    broken = []
    for found in _LINK.finditer(prose(page)):
        target = found["target"] or found["named"]
        if re.match(r"[a-z]+:", target):
            continue
        file, _, anchor = target.partition("#")
        place = (page.parent / file).resolve() if file else page
        if not place.exists() or (anchor and anchor not in anchors(place)):
            broken.append(target)
    assert not broken


def test_every_stage_has_a_page() -> None:
    from extrags.stages import STAGES

    rows = re.findall(
        r"^\| ([a-z, ]+) \| .*\]\((\S+?)(?:#\S*)?\)", (REPOSITORY / "docs/index.md").read_text(), re.MULTILINE
    )
    pages = {stage: page for stages, page in rows for stage in stages.split(", ")}
    assert set(STAGES) <= set(pages)
    assert all((REPOSITORY / "docs" / page).is_file() for page in pages.values())


def test_json_that_is_not_as_documented_is_found() -> None:
    """What writes the JSON is held against the tables where it is tested."""
    shares = {"never_seen": 0.5, "never_seen_well": None, "badly_seen": 0.1, "held_out": 0}
    assert undocumented(shares, "shares") == []
    assert undocumented({**shares, "seen": 1.0}, "shares") == ["$.seen is not documented"]
    assert undocumented({**shares, "held_out": "0"}, "shares") == ["$.held_out is str, not number or null"]
    assert undocumented_items([shares, {**shares, "seen": 1.0}], "shares") == ["$.1.seen is not documented"]
    assert undocumented_items([], "shares") == ["$ is no list with items"]
    del shares["badly_seen"]
    assert undocumented(shares, "shares") == ["$.badly_seen is not there"]
    costs = {"stage": "coarse", "processor_seconds": 1.0, "seconds": None}
    found = undocumented(
        {
            "processor_seconds": 1.0,
            "seconds": None,
            "peak_mib": 7,
            "source": "probe",
            "records": True,
            "unknown": [],
            "stages": [costs],
        },
        "a-prediction",
    )
    assert found == ["$.records is bool, not integer", "$.stages.0.peak_mib is not there"]


def test_documented_json_names_tables_that_are_there() -> None:
    named = {anchor for table in tables().values() for kind in table.values() for anchor in linked(kind)}
    assert len(named) > 30
    assert named <= set(tables())


def linked(kind: str) -> list[str]:
    return re.findall(r"\(#(.*?)\)", kind)


def test_licences_name_whatever_is_bundled() -> None:
    """Every file of weights, and the pictures of each sequence."""
    text = (REPOSITORY / "docs/licences.md").read_text()
    files = [*(REPOSITORY / "extrags").rglob("*.safetensors"), REPOSITORY / ".github/overview.jpg"]
    assert len(files) == 6
    wanted = {file.relative_to(REPOSITORY).as_posix() for file in files}
    for folder in {file.parent for file in (REPOSITORY / "docs").rglob("*.jpg")}:
        here = folder.relative_to(REPOSITORY).as_posix()
        pictures = folder.glob("*.jpg")
        wanted |= (
            {f"{here}/{re.sub('(view|virtual)_[0-9]+.jpg$', '*.jpg', file.name)}" for file in pictures}
            if folder.name == "gallery"
            else {f"{here}/*"}
        )
    assert {name for name in wanted if f"`{name}`" not in text} == set()


def test_the_gallery_says_whose_its_pictures_are() -> None:
    sections = (REPOSITORY / "docs/gallery/index.md").read_text().split("\n## ")[1:]
    for section in sections:
        known = describe(section.partition("\n")[0])
        assert f"Pictures derive from: {known.description}. Licence: {known.licence}.\n" in section


def test_every_kind_of_artefact_is_in_the_index() -> None:
    stages = set(json.loads((REPOSITORY / "tests/stage_inventory.json").read_text())["stages"])
    text = (REPOSITORY / "docs/index.md").read_text()
    listed = re.findall(r"^\| (`[a-z`, -]+`) \| .*\]\(", text, re.MULTILINE)
    assert stages == {name.strip("`") for names in listed for name in names.split(", ")}


def test_every_page_can_be_reached_from_the_index() -> None:
    reached, waiting = set(), [REPOSITORY / "docs" / "index.md"]
    while waiting:
        page = waiting.pop()
        if page in reached or page.suffix != ".md" or not page.exists():
            continue
        reached.add(page)
        for found in _LINK.finditer(prose(page)):
            target = (found["target"] or found["named"]).partition("#")[0]
            if target and not re.match(r"[a-z]+:", target):
                waiting.append((page.parent / target).resolve())
    assert set(PAGES) <= reached


@pytest.mark.parametrize("page", PAGES, ids=name_of)
def test_python_blocks_compile_and_their_imports_exist(page: Path) -> None:
    for code, _ in blocks(page, "python"):
        compile(code, name_of(page), "exec")
        for line in code.splitlines():
            if re.match(r"(import|from) ", line):
                exec(line, {})
        for name in set(re.findall(r"\bextrags(?:\.\w+)+", code)):
            assert importable(name), name


def _runnable() -> list[tuple[str, str]]:
    return [(name_of(page), code) for page in PAGES for code, run in blocks(page, "python") if run]


@pytest.fixture
def registered_for_one_test() -> Iterator[None]:
    """Take back what a block registers."""
    from data_catalog import folders
    from extrags.config.backends import BACKENDS
    from extrags.metrics.registry import added_metrics, unregister_metric

    backends, readers = dict(BACKENDS), list(folders._registered)
    yield
    for added in added_metrics():
        unregister_metric(added.partition("@")[0])
    for name in BACKENDS.keys() - backends.keys():
        del BACKENDS[name]
    folders._registered[:] = readers


@pytest.mark.usefixtures("registered_for_one_test")
@pytest.mark.parametrize(("page", "code"), _runnable())
def test_runnable_blocks_run(page: str, code: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    exec(compile(code, page, "exec"), {"__name__": "__main__"})


def test_the_first_program_is_right_for_frames_without_poses(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """It asked the frames for cameras that only the result has."""
    import extrags

    posed = extrags.read("phantom/0@sparse", extrags.IngestConfig(width=48, max_frames=4))
    assert posed.world_from_camera is not None
    points = posed.world_from_camera[:, :3, 3] + 20 * posed.world_from_camera[:, :3, 2]
    scene = extrags.Scene(
        extrags.Gaussians.from_points(points, np.full_like(points, 0.5), np.ones(len(points)))
    )
    result = SimpleNamespace(sequence=posed, scene=scene)
    monkeypatch.setattr(extrags, "read", lambda *_: replace(posed, world_from_camera=None, observed=None))
    monkeypatch.setattr(extrags, "run_pipeline", lambda *_, **__: result)
    monkeypatch.chdir(tmp_path)
    code, _ = next(blocks(REPOSITORY / "docs" / "python.md", "python"))
    made: dict[str, Any] = {}
    exec(compile(code, "python.md", "exec"), made)
    assert made["image"].shape == (1, posed.height, posed.width, 3)
    assert (tmp_path / "scene.ply").is_file()


def commands() -> Iterator[tuple[str, str]]:
    """Every `extrags ...` of the pages, without what the shell makes of it."""
    for page in PAGES:
        lines = [line for code, _ in blocks(page, "bash", "") for line in code.splitlines()]
        for line in [*lines, *inline_code(page)]:
            text = line.split("  #")[0].strip()
            if text.startswith("extrags ") and not re.search(r"\.\.\.|…|\||\bVERB\b|--help", text):
                yield name_of(page), text


@pytest.mark.parametrize(("page", "command"), sorted(set(commands())))
def test_commands_are_understood_by_the_parser(page: str, command: str) -> None:
    words = shlex.split(command)[1:]
    if all(word.isalpha() and word.islower() for word in words):
        # The verb alone, as a sentence names it.
        with pytest.raises(SystemExit, match="0"):
            parser_of(words[0]).parse_args([*words, "--help"])
        return
    # Wrong usage raises, with the option that was perhaps meant.
    given = parser_of(words[0]).parse_args(words)
    assert callable(given.command), page
    for name in getattr(given, "settings", {}):
        assert setting_exists(name), name


@cache
def parser_of(verb: str) -> Any:
    """The parser of a verb, which takes longer to make than all of its commands to parse."""
    from flows.cli import parser

    return parser(verb)


def setting_exists(path: str) -> bool:
    """Whether `stage.name` is a setting, or `stage.*` a group of them."""
    model: type[BaseModel] | None = PipelineConfig
    for part in path.removesuffix(".*").split("."):
        if model is None or part not in model.model_fields:
            return False
        kind = model.model_fields[part].annotation
        model = kind if isinstance(kind, type) and issubclass(kind, BaseModel) else None
    return path.endswith(".*") == (model is not None)


@pytest.mark.parametrize("page", PAGES, ids=name_of)
def test_settings_exist(page: Path) -> None:
    stages = "|".join(PipelineConfig.model_fields)
    named = [
        code.partition("=")[0].strip()
        for code in inline_code(page)
        if re.match(rf"({stages})\.[\w.*]+( ?=.*)?$", code) and not code.endswith((".py", ".json", ".txt"))
    ]
    assert not [path for path in named if not setting_exists(path)]


def importable(path: str) -> bool:
    """Whether a dotted path is a module, or something in one."""
    parts = path.split(".")
    for length in range(len(parts), 0, -1):
        try:
            found: object = importlib.import_module(".".join(parts[:length]))
        except ModuleNotFoundError:
            continue
        for part in parts[length:]:
            # Fields of a dataclass or model have annotations, and need no default.
            if not hasattr(found, part) and part not in getattr(found, "__annotations__", {}):
                return False
            found = getattr(found, part, None)
        return True
    return False


@pytest.mark.parametrize("page", PAGES, ids=name_of)
def test_modules_and_files_exist(page: Path) -> None:
    missing = []
    for code in inline_code(page):
        dotted = re.match(rf"(({'|'.join(ROOTS)})(\.\w+)+)(\(.*\))?$", code)
        if dotted and not code.endswith(".py") and not importable(dotted[1]):
            missing.append(code)
        is_file = re.match(rf"({'|'.join(ROOTS)}|docs|tests|examples)/[\w./]+$", code)
        if is_file and not (REPOSITORY / code).exists():
            missing.append(code)
    assert not missing


@pytest.mark.parametrize("page", PAGES, ids=name_of)
def test_environment_variables_are_read_somewhere(page: Path) -> None:
    named = set(re.findall(r"\bEXTRAGS_[A-Z_]+\b", page.read_text(encoding="utf-8")))
    assert not {name for name in named if f'"{name}"' not in sources()}


class TestReferences:
    """Citations and the list of publications hold each other."""

    @pytest.fixture
    def entries(self) -> dict[str, tuple[str, ...]]:
        """What a citation may name, by key: the key, the first author, the title."""
        text = REFERENCES.read_text(encoding="utf-8")
        entry = r'<a id="(\w+)"></a>\s*\*\*\[(\w+)\]\*\* ([^:,]+?)(?: and others)?[,:][^*]*\*([^*]+)\*'
        found = re.findall(entry, text)
        assert len(found) == text.count("**[")
        assert all(anchor == key.lower() for anchor, key, *_ in found)
        return {key: (f"[{key}", author.split()[-1], title) for _, key, author, title in found}

    def test_every_publication_is_cited(self, entries: dict[str, tuple[str, ...]]) -> None:
        pages = "".join(page.read_text(encoding="utf-8") for page in PAGES if page != REFERENCES)
        everything = pages + sources()
        assert not [key for key, names in entries.items() if not any(name in everything for name in names)]

    def test_every_source_of_a_docstring_is_listed(self, entries: dict[str, tuple[str, ...]]) -> None:
        cited = re.findall(r"\bSources?: (.*?)(?:\n\s*\n|\"\"\")", sources(), re.DOTALL)
        assert len(cited) > 40
        known = [name for names in entries.values() for name in names] + ["https://"]
        assert not [text for text in cited if not any(name in text for name in known)]

    def test_the_paper_is_cited_by_its_key(self) -> None:
        vague = re.compile(r"\bpaper(?:'s|,)? eq(?:uation|s?\.)|Source: paper\b")
        assert not [line for line in sources().splitlines() if "paper" in line and vague.search(line)]

    def test_keys_in_docstrings_are_listed(self, entries: dict[str, tuple[str, ...]]) -> None:
        cited = set(re.findall(r"\[([A-Z][A-Za-z]+\d*), (?:eq|section)", sources()))
        assert "ExtraGS" in cited
        assert cited <= set(entries)

    def test_equation_numbers_of_the_paper_exist(self) -> None:
        pages = "".join(page.read_text(encoding="utf-8") for page in PAGES)
        cited = re.findall(r"\[ExtraGS, eq\. ([^\]]+)\]", pages + sources())
        numbers = [int(number) for text in cited for number in re.findall(r"\d+", text)]
        assert numbers
        assert all(1 <= number <= 25 for number in numbers)
