"""A run whose store is on an object store."""

from __future__ import annotations

from collections import Counter
from pathlib import Path

import pytest

from extrags.store import Store
from flows.outcome import SequenceOutcome
from flows.runners import DirectRunner
from flows.wiring import run_sequence
from tests.flows.tiny import SEQUENCE, tiny_config
from tests.s3 import BUCKET, SECRET, s3_server


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore::pytest.PytestUnraisableExceptionWarning")
def test_a_whole_run_and_the_same_from_another_machine(
    finished: tuple[str, SequenceOutcome], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    _, whole = finished
    root = f"s3://{BUCKET}/tiny"
    with s3_server():
        for machine, state in (("first", "ran"), ("second", "cached")):
            # Nothing is shared but the URL.
            monkeypatch.setenv("EXTRAGS_CACHE", str(tmp_path / machine))
            outcome = run_sequence(SEQUENCE, tiny_config(), root, DirectRunner(root), profile="quick")
            assert outcome.status == "ok", outcome.error
            assert {row.state for row in outcome.stages} == {state, "skipped"}
            assert outcome.digests == whole.digests
        store = Store(root)
        assert not any(map(store.examine, store.keys()))
        backend = store.backend
        objects = backend.fs.find(backend.prefix)  # type: ignore[union-attr]
        # However many stages there are, each makes few objects: every one is a request.
        parts = Counter(name.removeprefix(f"{backend.prefix}/").split("/")[0] for name in objects)  # type: ignore[union-attr]
        assert len(parts) > 20
        assert max(parts.values()) <= 6, parts.most_common(3)
        assert not any(SECRET.encode() in backend.fs.cat_file(name) for name in objects)  # type: ignore[union-attr]
