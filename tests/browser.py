"""Headless Chromium over its DevTools protocol, as far as tests of pages need it.

Only what is installed anyway is used: Debian's `chromium` (or what `EXTRAGS_CHROMIUM` names) and the package
`websockets`, which Prefect needs.
"""

from __future__ import annotations

import base64
import json
import os
import shutil
import subprocess
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any
from urllib.request import urlopen

import pytest

__all__ = ["Browser", "browser"]

START_SECONDS = 60.0
SOFTWARE_RENDERING = ("--use-gl=angle", "--use-angle=swiftshader", "--enable-unsafe-swiftshader")


class Browser:
    """One tab. `errors` holds console errors and exceptions of the page, `requests` what it asked for."""

    def __init__(self, address: str) -> None:
        from websockets.sync.client import connect

        self._socket = connect(address, max_size=None, ping_interval=None)
        self._sent = 0
        self.errors: list[str] = []
        self.requests: list[str] = []
        for domain in ("Page", "Runtime", "Log", "Network"):
            self.send(f"{domain}.enable")

    def send(self, method: str, timeout_s: float = 120, **parameters: Any) -> dict[str, Any]:
        """Call a method; events that arrive meanwhile are noted."""
        self._sent += 1
        self._socket.send(json.dumps({"id": self._sent, "method": method, "params": parameters}))
        until = time.monotonic() + timeout_s
        while True:
            answer = json.loads(self._socket.recv(timeout=max(0.1, until - time.monotonic())))
            if answer.get("id") == self._sent:
                assert "error" not in answer, answer["error"]
                return dict(answer["result"])
            self._note(answer)

    def _note(self, event: dict[str, Any]) -> None:
        method, said = event.get("method"), event.get("params", {})
        if method == "Runtime.exceptionThrown":
            details = said["exceptionDetails"]
            self.errors.append(str(details.get("exception", {}).get("description", details["text"])))
        elif method == "Runtime.consoleAPICalled" and said["type"] in ("error", "assert"):
            self.errors.append(str([argument.get("value") for argument in said["args"]]))
        elif method == "Log.entryAdded" and said["entry"]["level"] == "error":
            self.errors.append(said["entry"]["text"])
        elif method == "Network.requestWillBeSent":
            self.requests.append(said["request"]["url"])

    def open(self, page: Path) -> None:
        """Load a page and wait until it is complete."""
        self.send("Page.navigate", url=page.absolute().as_uri())
        until = time.monotonic() + START_SECONDS
        # Right after the call the old document may still answer.
        ready = "document.readyState === 'complete' && location.href !== 'about:blank'"
        while not self.run(ready):
            assert time.monotonic() < until, "the page did not load"
            time.sleep(0.1)

    def run(self, expression: str, timeout_s: float = 120) -> Any:
        """Value of an expression in the page; promises are awaited."""
        found = self.send(
            "Runtime.evaluate", timeout_s, expression=expression, awaitPromise=True, returnByValue=True
        )
        assert "exceptionDetails" not in found, found["exceptionDetails"]
        return found["result"].get("value")

    def window(self, width: int, height: int, *, dark: bool = False, touch: bool = False) -> None:
        """Size and colours of the window."""
        self.send(
            "Emulation.setDeviceMetricsOverride",
            width=width, height=height, deviceScaleFactor=1, mobile=touch,
        )  # fmt: skip
        scheme = {"name": "prefers-color-scheme", "value": "dark" if dark else "light"}
        self.send("Emulation.setEmulatedMedia", features=[scheme])

    def screenshot(self, place: Path) -> None:
        """The window as PNG."""
        place.write_bytes(base64.b64decode(self.send("Page.captureScreenshot", format="png")["data"]))

    def drag(self, start: tuple[float, float], end: tuple[float, float]) -> None:
        """Press the left button, move and let go."""
        for kind, (x, y) in (
            ("mousePressed", start), ("mouseMoved", end), ("mouseReleased", end),
        ):  # fmt: skip
            self.send("Input.dispatchMouseEvent", type=kind, x=x, y=y, button="left", buttons=1, clickCount=1)

    def key(self, key: str) -> None:
        """Press and release a key."""
        for kind in ("keyDown", "keyUp"):
            self.send("Input.dispatchKeyEvent", type=kind, key=key)


@contextmanager
def browser(profile: Path) -> Iterator[Browser]:
    """A headless browser without network that draws in software; the test is skipped where there is none.

    Args:
        profile: empty folder for its files.
    """
    program = (
        os.environ.get("EXTRAGS_CHROMIUM") or shutil.which("chromium") or shutil.which("chromium-browser")
    )
    if program is None:
        pytest.skip("no Chromium is installed (chromium, or EXTRAGS_CHROMIUM)")
    pytest.importorskip("websockets", reason="the browser is driven through a web socket")
    options = ["--headless=new", "--no-first-run", "--disable-extensions", "--disable-background-networking"]
    # Its sandbox needs rights that root in a container does not have; the page is our own.
    options += ["--no-sandbox", "--disable-dev-shm-usage", "--remote-debugging-port=0", *SOFTWARE_RENDERING]
    process = subprocess.Popen(
        [program, *options, f"--user-data-dir={profile}", "about:blank"],
        stdout=subprocess.DEVNULL,
        stderr=subprocess.DEVNULL,
    )
    try:
        port = profile / "DevToolsActivePort"
        until = time.monotonic() + START_SECONDS
        while not (port.exists() and port.read_text().count("\n")):
            assert process.poll() is None, "the browser ended at once"
            assert time.monotonic() < until, "the browser did not start"
            time.sleep(0.1)
        with urlopen(f"http://127.0.0.1:{port.read_text().splitlines()[0]}/json/list", timeout=20) as reply:
            tab = next(item for item in json.load(reply) if item["type"] == "page")
        opened = Browser(tab["webSocketDebuggerUrl"])
        yield opened
        opened._socket.close()
    finally:
        process.terminate()
        process.wait(20)
