"""What verbs share: settings from the command line, JSON out, the log."""

from __future__ import annotations

import argparse
import json
import logging
import sys
from pathlib import Path
from typing import Any

import yaml

from extrags.errors import ConfigError, StoreError
from flows.settings import default_store

__all__ = ["parsed_settings", "set_up_logging", "store_root", "write_json"]


def parsed_settings(assignments: list[str]) -> dict[str, Any]:
    """`["coarse.iterations=500"]` to `{"coarse.iterations": 500}`; values are JSON or YAML.

    Raises:
        ConfigError: for an assignment without `=`, or a value that is no YAML.
    """
    settings: dict[str, Any] = {}
    for assignment in assignments:
        name, separator, text = assignment.partition("=")
        if not separator or not name:
            raise ConfigError(f"--set {assignment}: expected NAME=VALUE, e.g. coarse.iterations=500")
        settings[name.strip()] = _value(assignment, text)
    return settings


def _value(assignment: str, text: str) -> Any:
    try:
        # First, because YAML takes 1e-3 for a word.
        return json.loads(text)
    except ValueError:
        pass
    try:
        return yaml.safe_load(text)
    except yaml.YAMLError as error:
        raise ConfigError(f"--set {assignment}: the value is neither JSON nor YAML") from error


def store_root(given: argparse.Namespace) -> str:
    """Root of the store as an absolute path or a URL."""
    root: str = given.store or default_store()
    return root if "://" in root else str(Path(root).expanduser().absolute())


def write_json(value: Any, target: str | None) -> None:
    """Write to a file, or to standard output for `-`; nothing for None.

    Raises:
        StoreError: when the file cannot be written.
    """
    if target is None:
        return
    text = json.dumps(value, indent=1, allow_nan=False) + "\n"
    if target == "-":
        sys.stdout.write(text)
        return
    try:
        Path(target).parent.mkdir(parents=True, exist_ok=True)
        Path(target).write_text(text, encoding="utf-8")
    except OSError as error:
        raise StoreError(f"{target} cannot be written: {error.strerror or error}") from error


def set_up_logging(*, debug: bool, terminal: bool) -> None:
    """Log lines to standard error: everything with `debug`, progress where there is no terminal."""
    logging.basicConfig(
        level=logging.INFO if debug or not terminal else logging.WARNING,
        format="%(asctime)s %(message)s",
        datefmt="%H:%M:%S",
        stream=sys.stderr,
    )
    for noisy in ("httpx", "httpcore", "prefect", "distributed", "distributed.scheduler", "asyncio"):
        logging.getLogger(noisy).setLevel(logging.WARNING if debug else logging.CRITICAL)
