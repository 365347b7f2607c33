"""The part of viser that `flows.view_server` uses, without a network: a browser is moved by hand."""

from __future__ import annotations

import contextlib
from collections.abc import Callable, Iterator
from types import SimpleNamespace
from typing import Any

import numpy as np


class Control:
    """A slider, checkbox, dropdown, button or text; a value that is assigned calls as viser's does."""

    def __init__(self, value: Any = None) -> None:
        self._value = value
        self.content = value
        self.called: list[Callable[[Any], None]] = []

    @property
    def value(self) -> Any:
        return self._value

    @value.setter
    def value(self, value: Any) -> None:
        if value != self._value:
            self.set(value)

    def on_update(self, call: Callable[[Any], None]) -> None:
        self.called.append(call)

    on_click = on_update

    def set(self, value: Any = True) -> None:
        """What a person does to it, who can type what no slider reaches."""
        self._value = value
        for call in self.called:
            call(SimpleNamespace(target=self))


class Gui:
    """Controls by name."""

    def __init__(self) -> None:
        self.controls: dict[str, Control] = {}
        self.options: dict[str, dict[str, Any]] = {}

    @contextlib.contextmanager
    def add_folder(self, label: str) -> Iterator[None]:
        yield

    def _add(self, label: str, **options: Any) -> Control:
        self.options[label] = options
        self.controls[label] = Control(options.get("initial_value"))
        return self.controls[label]

    def add_slider(self, label: str, *, min: float, max: float, step: float, initial_value: float) -> Control:
        assert min <= initial_value <= max
        slider = self._add(label, min=min, max=max, step=step, initial_value=initial_value)
        slider.min, slider.max = min, max  # type: ignore[attr-defined]
        return slider

    def add_checkbox(self, label: str, *, initial_value: bool) -> Control:
        return self._add(label, initial_value=initial_value)

    def add_dropdown(self, label: str, options: Any, *, initial_value: str) -> Control:
        assert initial_value in options
        return self._add(label, options=options, initial_value=initial_value)

    def add_button(self, label: str) -> Control:
        return self._add(label)

    def add_markdown(self, content: str) -> Control:
        return self._add("status", initial_value=content)


class Camera:
    """The page's camera; moved by hand with `move`."""

    def __init__(self) -> None:
        self.wxyz = np.array([1.0, 0, 0, 0])
        self.position, self.look_at, self.up_direction = (
            np.zeros(3),
            np.array([0.0, 0, 1]),
            np.array([0, -1.0, 0]),
        )
        self.fov, self.aspect = 1.0, 4 / 3
        self.called: list[Callable[[Any], None]] = []

    def on_update(self, call: Callable[[Any], None]) -> None:
        self.called.append(call)

    def move(self, **changed: Any) -> None:
        vars(self).update(changed)
        for call in self.called:
            call(self)


class Client:
    """One browser: what it was shown, told and sent."""

    def __init__(self, number: int = 0) -> None:
        self.client_id = number
        self.camera, self.gui = Camera(), Gui()
        self.pictures: list[np.ndarray] = []
        self.told: list[str] = []
        self.files: dict[str, bytes] = {}
        self.scene = SimpleNamespace(set_background_image=self._shown)

    def _shown(self, image: np.ndarray, *, format: str, jpeg_quality: int) -> None:
        assert format == "jpeg"
        assert 0 < jpeg_quality <= 100
        self.pictures.append(image)

    def add_notification(self, title: str, body: str, *, color: str) -> None:
        self.told.append(body)

    def send_file_download(self, name: str, content: bytes) -> None:
        self.files[name] = content


class ViserServer:
    """Browsers come and go by hand; `taken` is a port that another program has."""

    taken: int | None = None
    made: list[ViserServer] = []  # noqa: RUF012

    def __init__(self, *, host: str, port: int, label: str, verbose: bool) -> None:
        self.host, self.port, self.label = host, port + 1 if port == self.taken else port or 49152, label
        self.gui = SimpleNamespace(configure_theme=lambda *, show_share_button: None)
        self.stopped = False
        self.made.append(self)

    def get_port(self) -> int:
        return self.port

    def on_client_connect(self, call: Callable[[Client], None]) -> None:
        self.connect = call

    def on_client_disconnect(self, call: Callable[[Client], None]) -> None:
        self.disconnect = call

    def stop(self) -> None:
        self.stopped = True
