from __future__ import annotations

import base64
import io
import json
import logging
import threading
from collections.abc import Iterator
from dataclasses import dataclass, field
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from extrags.config import CaptionConfig
from extrags.errors import ConfigError, ExtragsError, SourceError, SourceNotFoundError
from extrags.events import Event, MetricRecorded, subscribed
from extrags.restoration.pretrained.captions import (
    CACHE_VARIABLE,
    KEY_VARIABLE,
    URL_VARIABLE,
    Caption,
    caption_of,
)
from extrags.sequence import EndoscopicSequence, Split

GOOD = {
    "choices": [{"message": {"content": " Pink mucosa,\n haustral folds. "}}],
    "usage": {"prompt_tokens": 3000, "completion_tokens": 20},
}


@dataclass
class Endpoint:
    """A server that plays back what it is told, and keeps what it was asked."""

    replies: list[tuple[int, Any]] = field(default_factory=list)
    asked: list[dict[str, Any]] = field(default_factory=list)
    keys: list[str | None] = field(default_factory=list)
    paths: list[str] = field(default_factory=list)


@pytest.fixture
def endpoint(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> Iterator[Endpoint]:
    played = Endpoint()

    class Handler(BaseHTTPRequestHandler):
        def do_POST(self) -> None:
            body = self.rfile.read(int(self.headers["Content-Length"]))
            played.asked.append(json.loads(body))
            played.keys.append(self.headers.get("Authorization"))
            played.paths.append(self.path)
            status, answer = played.replies.pop(0)
            if status == 0:
                # Closed without a word: the other side sees a broken connection.
                return
            content = answer if isinstance(answer, bytes) else json.dumps(answer).encode()
            self.send_response(status)
            self.send_header("Content-Length", str(len(content)))
            self.end_headers()
            self.wfile.write(content)

        def log_message(self, *_: Any) -> None:
            """Silent."""

    server = ThreadingHTTPServer(("127.0.0.1", 0), Handler)
    thread = threading.Thread(target=server.serve_forever, kwargs={"poll_interval": 0.02})
    thread.start()
    monkeypatch.setenv(URL_VARIABLE, f"http://127.0.0.1:{server.server_port}/v1/")
    monkeypatch.setenv(KEY_VARIABLE, "a-key")
    monkeypatch.setenv(CACHE_VARIABLE, str(tmp_path / "cache"))
    monkeypatch.setenv("no_proxy", "*")
    yield played
    server.shutdown()
    thread.join()
    server.server_close()


def sequence(seed: int = 0) -> EndoscopicSequence:
    rgb = np.random.default_rng(seed).integers(0, 256, (8, 24, 32, 3), dtype=np.uint8)
    return EndoscopicSequence(
        name="test/scene@sparse",
        rgb=rgb,
        K=np.tile(np.array([[30.0, 0, 16], [0, 30.0, 12], [0, 0, 1]]), (8, 1, 1)),
        mask=np.ones((8, 24, 32), bool),
        split=Split("test", np.array([0, 2, 4, 6]), np.array([1, 3, 5, 7])),
    )


def asking(**further: Any) -> CaptionConfig:
    return CaptionConfig(source="endpoint", model="seer-1", frames=3, retry_wait_s=0.01, **further)


class TestConstantAndFile:
    def test_constant_is_the_default(self) -> None:
        caption = caption_of(sequence(), CaptionConfig())
        assert caption.source == "constant"
        assert "colon" in caption.text

    @pytest.mark.parametrize("name", ["test/scene", "test/scene@sparse"])
    def test_text_per_scene(self, tmp_path: Path, name: str) -> None:
        file = tmp_path / "texts.yaml"
        file.write_text(json.dumps({name: "a\n sinus ", "other": "x"}))
        caption = caption_of(sequence(), CaptionConfig(source="file", file=str(file)))
        assert caption == Caption("a sinus", "file")

    def test_what_can_be_wrong_with_the_file(self, tmp_path: Path) -> None:
        with pytest.raises(ConfigError, match=r"needs enhance\.caption\.file"):
            caption_of(sequence(), CaptionConfig(source="file"))
        with pytest.raises(SourceNotFoundError, match=r"texts\.yaml"):
            caption_of(sequence(), CaptionConfig(source="file", file=str(tmp_path / "texts.yaml")))
        for text, told in (("[1", "not readable"), ("- a", "found a list"), ("other: x", "no text for")):
            (tmp_path / "texts.yaml").write_text(text)
            with pytest.raises(SourceError, match=told):
                caption_of(sequence(), CaptionConfig(source="file", file=str(tmp_path / "texts.yaml")))

    def test_a_file_in_another_encoding_is_named(self, tmp_path: Path) -> None:
        file = tmp_path / "texts.yaml"
        file.write_bytes("test/scene: mucosa, folds 5 \xb5m apart".encode("latin-1"))
        with pytest.raises(SourceError, match=r"texts\.yaml: not readable as YAML or JSON \('utf-8'"):
            caption_of(sequence(), CaptionConfig(source="file", file=str(file)))


class TestEndpoint:
    def test_asks_once_shows_the_cost_and_keeps_the_answer(
        self, endpoint: Endpoint, caplog: pytest.LogCaptureFixture
    ) -> None:
        endpoint.replies = [(200, GOOD)]
        events: list[Event] = []
        config = asking(prompt_price=2.0, completion_price=10.0)
        with subscribed(events.append), caplog.at_level(logging.INFO):
            first = caption_of(sequence(), config)
            again = caption_of(sequence(), config)
        assert first.text == "Pink mucosa, haustral folds."
        assert first.cost == pytest.approx(0.0062)
        assert (first.prompt_tokens, first.completion_tokens, first.cached) == (3000, 20, False)
        assert again.cached
        assert again.as_dict() == first.as_dict()
        assert len(endpoint.asked) == 1
        assert endpoint.paths == ["/v1/chat/completions"]
        assert endpoint.keys == ["Bearer a-key"]
        recorded = {event.name: event.value for event in events if isinstance(event, MetricRecorded)}
        assert recorded["caption_prompt_tokens"] == 3000
        assert recorded["caption_cost"] == pytest.approx(0.0062)
        assert "3000 tokens sent, 20 received, cost 0.0062" in caplog.text
        assert "nothing spent" in caplog.text
        assert "a-key" not in caplog.text

    def test_is_shown_training_frames_only(self, endpoint: Endpoint) -> None:
        from PIL import Image

        endpoint.replies = [(200, GOOD)]
        scene = sequence()
        caption_of(scene, asking())
        question = endpoint.asked[0]
        assert question["model"] == "seer-1"
        assert question["max_tokens"] == 70
        shown = []
        for part in question["messages"][1]["content"]:
            head, data = part["image_url"]["url"].split(",")
            assert head == "data:image/png;base64"
            shown.append(np.asarray(Image.open(io.BytesIO(base64.b64decode(data)))))
        assert len(shown) == 3
        for image, frame in zip(shown, (0, 4, 6), strict=True):
            assert np.array_equal(image, scene.rgb[frame])

    def test_other_frames_are_another_question(self, endpoint: Endpoint) -> None:
        endpoint.replies = [(200, GOOD), (200, GOOD)]
        caption_of(sequence(0), asking())
        caption_of(sequence(1), asking())
        assert len(endpoint.asked) == 2

    def test_passing_faults_are_tried_again(
        self, endpoint: Endpoint, caplog: pytest.LogCaptureFixture
    ) -> None:
        endpoint.replies = [(503, {"error": "busy"}), (0, None), (200, b"<html>"), (429, {}), (200, GOOD)]
        assert caption_of(sequence(), asking(retries=4)).text == "Pink mucosa, haustral folds."
        assert len(endpoint.asked) == 5
        assert "try 1: HTTP 503" in caplog.text

    def test_gives_up_after_all_tries(self, endpoint: Endpoint) -> None:
        endpoint.replies = [(500, {"error": "broken"})] * 3
        with pytest.raises(ExtragsError, match=r"no answer in 3 tries, the last: HTTP 500"):
            caption_of(sequence(), asking(retries=2))

    def test_refusals_are_not_tried_again(self, endpoint: Endpoint) -> None:
        endpoint.replies = [(401, {"error": "bad key"})]
        with pytest.raises(ExtragsError, match=r"refused: HTTP 401.*bad key"):
            caption_of(sequence(), asking())
        assert len(endpoint.asked) == 1

    @pytest.mark.parametrize("answer", [{}, {"choices": []}, {"choices": [{"message": {"content": " "}}]}])
    def test_answers_without_text_are_refused_and_not_kept(self, endpoint: Endpoint, answer: Any) -> None:
        endpoint.replies = [(200, answer), (200, GOOD)]
        with pytest.raises(SourceError, match=r"choices\[0\]"):
            caption_of(sequence(), asking())
        assert caption_of(sequence(), asking()).text == "Pink mucosa, haustral folds."

    def test_silence_times_out(self, monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
        import socket

        monkeypatch.setenv("no_proxy", "*")
        monkeypatch.setenv(CACHE_VARIABLE, str(tmp_path))
        with socket.socket() as deaf:
            deaf.bind(("127.0.0.1", 0))
            deaf.listen()
            monkeypatch.setenv(URL_VARIABLE, f"http://127.0.0.1:{deaf.getsockname()[1]}/v1")
            with pytest.raises(ExtragsError, match=r"in 1 tries, the last: TimeoutError"):
                caption_of(sequence(), asking(retries=0, timeout_s=0.1))

    def test_what_the_environment_must_hold(self, monkeypatch: pytest.MonkeyPatch) -> None:
        monkeypatch.delenv(URL_VARIABLE, raising=False)
        with pytest.raises(ConfigError, match=URL_VARIABLE):
            caption_of(sequence(), asking())
        monkeypatch.setenv(URL_VARIABLE, "file:///etc/passwd")
        with pytest.raises(ConfigError, match=URL_VARIABLE):
            caption_of(sequence(), asking())
        monkeypatch.setenv(URL_VARIABLE, "http://127.0.0.1:1/v1")
        with pytest.raises(ConfigError, match=r"needs enhance\.caption\.model"):
            caption_of(sequence(), CaptionConfig(source="endpoint"))
