"""Which source each stage rests on: `python -m tests.stage_inventory` writes `stage_inventory.json` anew.

A stage's version is raised by hand whenever the same inputs give another artefact; who forgets it serves old
results from every store. So the inventory holds, for each stage, its version and a digest of the code behind
it: the task's body and, by name, every function, class and constant of this project that it reaches, without
comments and docstrings. When that code changes, `test_stage_inventory` fails until either the version is
raised or somebody says that results are the same; `make same-results` records either.

Not counted: settings (they are part of the key), errors, events, and the machinery of stages and store. What
is looked up by a dotted name in a string counts with its whole module; the native kernels count with
everything that calls them.
"""

from __future__ import annotations

import ast
import hashlib
import json
from collections.abc import Iterator
from dataclasses import dataclass, field
from functools import cache
from pathlib import Path
from typing import Any

REPOSITORY = Path(__file__).resolve().parents[1]
INVENTORY = Path(__file__).with_name("stage_inventory.json")
ROOTS = ("extrags", "data_catalog", "tasks")
NOT_COUNTED = (
    "extrags.config",
    "extrags.errors",
    "extrags.events",
    "extrags.store",
    "tasks.divergence",
    "tasks.locks",
    "tasks.memory",
    "tasks.progress",
    "tasks.stage",
)
COUNTED = ("extrags.config.backends",)
"""Of the settings: where the restorers are named that `enhance-train` looks up."""
NATIVE = "extrags.raster._native"

Symbol = tuple[str, str]
"""Module and name; an empty name stands for the whole module."""


@dataclass
class Module:
    """Definitions and imports at the top of a module, and its imports anywhere in it."""

    definitions: dict[str, list[ast.stmt]] = field(default_factory=dict)
    imports: dict[str, Symbol] = field(default_factory=dict)


@cache
def file_of(module: str) -> Path | None:
    """Source of one of this project's modules, or None."""
    if module.split(".")[0] not in ROOTS:
        return None
    path = REPOSITORY.joinpath(*module.split("."))
    return next((file for file in (path.with_suffix(".py"), path / "__init__.py") if file.is_file()), None)


@cache
def parsed(module: str) -> Module:
    """A module's definitions and imports."""
    file = file_of(module)
    found = Module()
    if file is None:
        return found
    tree = ast.parse(file.read_text(encoding="utf-8"))
    for node in tree.body:
        for name in _defined(node):
            found.definitions.setdefault(name, []).append(node)
    for node in ast.walk(tree):
        if isinstance(node, ast.ImportFrom) and node.module is not None:
            found.imports |= {name.asname or name.name: (node.module, name.name) for name in node.names}
        elif isinstance(node, ast.Import):
            found.imports |= {name.asname or name.name: (name.name, "") for name in node.names}
    return found


def _defined(node: ast.stmt) -> Iterator[str]:
    if isinstance(node, ast.Try | ast.If | ast.With):
        for part in ast.iter_child_nodes(node):
            inner = part.body if isinstance(part, ast.ExceptHandler) else [part]
            for line in inner:
                if isinstance(line, ast.stmt):
                    yield from _defined(line)
    if isinstance(node, ast.FunctionDef | ast.ClassDef):
        yield node.name
    targets = node.targets if isinstance(node, ast.Assign) else [getattr(node, "target", None)]
    for target in targets:
        for part in ast.walk(target) if target is not None else ():
            # `TABLE[name] = value` belongs to TABLE as much as its first assignment.
            if isinstance(part, ast.Name):
                yield part.id


@cache
def resolved(module: str, name: str) -> Symbol | None:
    """Where a name that is used in a module is defined; None outside this project."""
    seen = set()
    while (module, name) not in seen:
        seen.add((module, name))
        if file_of(module) is None and module != NATIVE:
            return None
        if name == "" or name in parsed(module).definitions:
            return module, name
        if name in parsed(module).imports:
            module, name = parsed(module).imports[name]
        elif file_of(f"{module}.{name}") is not None:
            return f"{module}.{name}", ""
        else:
            return (NATIVE, "") if NATIVE in (module, f"{module}.{name}") else None
    return None


def used(node: ast.AST, module: str) -> Iterator[Symbol]:
    """This project's symbols that a definition names."""
    for part in ast.walk(node):
        found = None
        if isinstance(part, ast.Name):
            found = resolved(module, part.id)
        elif isinstance(part, ast.Attribute) and isinstance(part.value, ast.Name):
            # `training.finetune` with `from extrags import training`.
            owner = resolved(module, part.value.id)
            found = resolved(owner[0], part.attr) if owner is not None and owner[1] == "" else None
        elif isinstance(part, ast.Constant) and isinstance(part.value, str):
            dotted = part.value.partition(":")[0]
            if "." in dotted and " " not in dotted and file_of(dotted) is not None:
                found = dotted, ""
        if found is not None:
            yield found


def reached(start: Symbol) -> dict[Symbol, str]:
    """Digest of every symbol that a stage's body reaches, itself included."""
    found: dict[Symbol, str] = {}
    waiting = [start]
    while waiting:
        symbol = waiting.pop()
        counts = symbol[0] in COUNTED or not symbol[0].startswith(NOT_COUNTED)
        if symbol not in found and counts:
            found[symbol], named = examined(symbol)
            waiting += named
    return found


@cache
def examined(symbol: Symbol) -> tuple[str, tuple[Symbol, ...]]:
    """Digest of a symbol's own code, and the symbols it names."""
    module, name = symbol
    if module == NATIVE:
        return _kernels(), ()
    parts = [*parsed(module).definitions] if name == "" else [name]
    nodes = [node for part in parts for node in parsed(module).definitions.get(part, [])]
    # A module that is only what an attribute is taken from does not count whole: the attribute does.
    named = {one for node in nodes for one in used(node, module) if one[1] or not _is_owner(one, node)}
    return _digest("".join(_code(node) for node in nodes)), tuple(sorted(named))


def forget() -> None:
    """Read every source anew."""
    for remembered in (file_of, parsed, resolved, examined, _kernels):
        remembered.cache_clear()


def _is_owner(symbol: Symbol, node: ast.AST) -> bool:
    """Whether a module is named only as what an attribute is taken from."""
    last = symbol[0].rpartition(".")[2]
    return symbol[0] != NATIVE and any(
        isinstance(part, ast.Attribute) and isinstance(part.value, ast.Name) and part.value.id == last
        for part in ast.walk(node)
    )


def _code(node: ast.stmt) -> str:
    """The node without comments and docstrings."""
    copy = ast.parse(ast.unparse(node))
    for part in ast.walk(copy):
        body = getattr(part, "body", None)
        if isinstance(body, list):
            part.body = [line for line in body if not _is_text(line)] or [ast.Pass()]  # type: ignore[attr-defined]
    return ast.dump(copy)


def _is_text(node: ast.AST) -> bool:
    return (
        isinstance(node, ast.Expr)
        and isinstance(node.value, ast.Constant)
        and isinstance(node.value.value, str)
    )


@cache
def _kernels() -> str:
    files = sorted((REPOSITORY / "extrags" / "raster" / "kernels").iterdir())
    return _digest("".join(file.read_text(encoding="utf-8") for file in files))


def _digest(text: str) -> str:
    return hashlib.blake2b(text.encode(), digest_size=8).hexdigest()


def stages() -> dict[str, tuple[Symbol, int]]:
    """Every stage: its body and its version, read from the decorators in `tasks`."""
    found = {}
    for file in sorted((REPOSITORY / "tasks").glob("*.py")):
        module = f"tasks.{file.stem}"
        for name, nodes in parsed(module).definitions.items():
            for node in nodes:
                for call in getattr(node, "decorator_list", []):
                    if isinstance(call, ast.Call) and ast.unparse(call.func) == "stage":
                        version = next(word.value for word in call.keywords if word.arg == "version")
                        found[ast.literal_eval(call.args[0])] = (module, name), _constant(module, version)
    return found


def _constant(module: str, node: ast.expr) -> int:
    if isinstance(node, ast.Constant):
        return int(node.value)  # type: ignore[arg-type]
    if isinstance(node, ast.BinOp):
        left, right = _constant(module, node.left), _constant(module, node.right)
        return left * right if isinstance(node.op, ast.Mult) else left + right
    found = resolved(module, ast.unparse(node))
    assert found is not None, f"{module}: {ast.unparse(node)} is no constant of this project"
    (assigned,) = parsed(found[0]).definitions[found[1]]
    return _constant(found[0], assigned.value)  # type: ignore[attr-defined]


def inventory() -> dict[str, Any]:
    """`{stages: {name: {version, digest}}, modules: {name: digest}}` of the source as it stands."""
    every: dict[Symbol, str] = {}
    rows = {}
    for name, (body, version) in sorted(stages().items()):
        found = reached(body)
        every |= found
        text = json.dumps(sorted((*symbol, digest) for symbol, digest in found.items()))
        rows[name] = {"version": version, "digest": _digest(text)}
    modules: dict[str, list[str]] = {}
    for (module, name), digest in sorted(every.items()):
        modules.setdefault(module, []).append(f"{name} {digest}")
    return {"stages": rows, "modules": {name: _digest("\n".join(lines)) for name, lines in modules.items()}}


def recorded() -> dict[str, Any]:
    """The inventory that is checked in."""
    found: dict[str, Any] = json.loads(INVENTORY.read_text(encoding="utf-8"))
    return found


def changed_modules() -> list[str]:
    """Modules whose counted code is not as recorded."""
    now, then = inventory()["modules"], recorded()["modules"]
    return sorted(name for name in {*now, *then} if now.get(name) != then.get(name))


if __name__ == "__main__":
    INVENTORY.write_text(json.dumps(inventory(), indent=1) + "\n", encoding="utf-8")
