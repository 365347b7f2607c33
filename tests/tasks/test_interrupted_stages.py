"""Stages after an interruption of the command."""

from __future__ import annotations

import logging
import threading
from pathlib import Path

import pytest

import tasks.progress
from extrags.store import Store
from tasks.progress import StageProgress, interrupt_stages, notify
from tests.tasks.toy import double, source


def test_a_stage_ends_at_its_next_event_and_leaves_nothing(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(tasks.progress, "_interrupted", threading.Event())
    store = str(tmp_path / "store")
    number = source.fn(store=store, seed=2)
    interrupt_stages()
    with pytest.raises(KeyboardInterrupt):
        double.fn(store=store, number=number)
    assert [manifest.stage for manifest in Store(store).ls()] == ["toy-source"]
    assert list((tmp_path / "store" / "scratch").iterdir()) == []


def test_nothing_more_is_said(monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture) -> None:
    monkeypatch.setattr(tasks.progress, "_interrupted", threading.Event())
    caplog.set_level(logging.INFO, "extrags.progress")
    notify(StageProgress("phantom/0", "coarse", "running"))
    interrupt_stages()
    notify(StageProgress("phantom/0", "coarse", "failed", detail="COLMAP's process ended with code -2"))
    assert caplog.messages == ["phantom/0 coarse: starts"]
