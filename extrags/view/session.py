"""One viewer of a scene: where it looks and what it wants to see, in; pictures, out."""

from __future__ import annotations

import threading
import time
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from jaxtyping import UInt8

from extrags.cameras import Cameras
from extrags.errors import ConfigError
from extrags.export import CameraPath
from extrags.view.recording import PathRecorder
from extrags.view.renderer import SceneRenderer, ViewSettings

__all__ = ["Picture", "RateMeter", "ViewSession"]

WIDTHS_PX = (16, 8192)
STILL_AFTER_S = 0.2


@dataclass(frozen=True)
class Picture:
    """What a viewer sees.

    Args:
        rgb: eight bits per channel.
        camera: the camera that it is the picture of, at full resolution.
        full: whether it has full resolution; otherwise half.
        seconds: what rendering it took.
        rate: pictures per second of the movement it belongs to; None for the first.
    """

    rgb: UInt8[np.ndarray, "h w 3"]
    camera: Cameras
    full: bool
    seconds: float
    rate: float | None


class RateMeter:
    """Pictures per second while they follow one another; a pause begins anew.

    Args:
        window_s: over which the rate is taken.
        pause_s: between two pictures that belong to different movements.
    """

    def __init__(self, window_s: float = 2.0, pause_s: float = 1.0) -> None:
        self._window_s, self._pause_s = window_s, pause_s
        self._times: deque[float] = deque()

    def add(self, at_s: float) -> float | None:
        """Count a picture; the rate up to it, None where it is the first."""
        if self._times and at_s - self._times[-1] > self._pause_s:
            self._times.clear()
        self._times.append(at_s)
        while len(self._times) > 2 and at_s - self._times[0] > self._window_s:
            self._times.popleft()
        passed = at_s - self._times[0]
        return (len(self._times) - 1) / passed if passed > 0 else None


class ViewSession:
    """One viewer: `look` and `change` say what it wants, from any thread; `next_picture` renders it.

    While anything changes, pictures have half the resolution, a quarter of the pixels; once nothing has
    changed for `still_after_s`, one more follows at full resolution. What changes during a picture is made up
    for by the next one: nothing queues up.

    Args:
        renderer: of the scene; viewers share it.
        camera: where it looks first; its aspect is that of the pictures.
        width: of a picture at full resolution, in pixels.
        settings: light and layer at first.
        still_after_s: how long nothing changes before full resolution.
        clock: seconds that never go back.
    """

    def __init__(
        self,
        renderer: SceneRenderer,
        camera: Cameras,
        *,
        width: int = 640,
        settings: ViewSettings | None = None,
        still_after_s: float = STILL_AFTER_S,
        clock: Callable[[], float] = time.monotonic,
    ) -> None:
        self.renderer = renderer
        self._clock, self._still_after_s = clock, still_after_s
        self._state = threading.Condition()
        self._width = _checked_width(width)
        self._camera = _sized(camera, width)
        self._settings = ViewSettings() if settings is None else settings
        self._changed, self._shown = 1, 0
        """How often something has changed, and what of it is shown."""
        self._shown_full = False
        self._changed_at = -np.inf
        self._closed = False
        self._meter = RateMeter()
        self._recorder = PathRecorder()
        self._recording = False
        self._recorded_at = 0.0

    @property
    def camera(self) -> Cameras:
        """Where the viewer looks, at full resolution."""
        return self._camera

    @property
    def settings(self) -> ViewSettings:
        """Light and layer."""
        return self._settings

    def look(self, camera: Cameras) -> None:
        """Look from one camera; only its aspect counts of its size. The same camera again changes nothing.

        Raises:
            ConfigError: when more than an hour would be recorded; recording ends, and the camera moves.
        """
        with self._state:
            sized = _sized(camera, self._width)
            if _same(sized, self._camera):
                return
            self._camera = sized
            self._touched()
            if self._recording:
                try:
                    self._record_view()
                except ConfigError:
                    self._recording = False
                    raise

    def change(self, settings: ViewSettings) -> None:
        """Show another layer, or under another light."""
        with self._state:
            if settings != self._settings:
                self._settings = settings
                self._touched()

    def resize(self, width: int) -> None:
        """Make pictures of another width, in pixels.

        Raises:
            ConfigError: for a width that no picture has.
        """
        with self._state:
            if _checked_width(width) != self._width:
                self._width = width
                self._camera = _sized(self._camera, width)
                self._touched()

    def next_picture(self, timeout_s: float | None = None) -> Picture | None:
        """Wait until there is something to show, and render it.

        Args:
            timeout_s: how long to wait; None waits for ever.

        Returns:
            None when nothing has changed in that time, or the session is closed.
        """
        until = None if timeout_s is None else self._clock() + timeout_s
        with self._state:
            while (full := self._wanted()) is None:
                if self._closed or (until is not None and self._clock() >= until):
                    return None
                self._state.wait(self._patience(until))
            camera, settings, change = self._camera, self._settings, self._changed
        small = camera if full else _sized(camera, max(1, camera.width // 2))
        begun = self._clock()
        rgb = self.renderer.render(small, settings)
        ended = self._clock()
        with self._state:
            self._shown, self._shown_full = change, full
            # The last picture, which follows a pause, belongs to no movement.
            rate = None if full else self._meter.add(ended)
        return Picture(rgb, camera, full, ended - begun, rate)

    def _wanted(self) -> bool | None:
        """Whether the next picture is one of full resolution; None while none is wanted."""
        if self._closed:
            return None
        still = self._clock() - self._changed_at >= self._still_after_s
        if still:
            return None if self._shown == self._changed and self._shown_full else True
        return None if self._shown == self._changed else False

    def _patience(self, until: float | None) -> float | None:
        """Seconds until something is wanted without further ado, or the caller's patience ends."""
        ends = [] if until is None else [until]
        if not (self._shown == self._changed and self._shown_full):
            ends.append(self._changed_at + self._still_after_s)
        return max(0.0, min(ends) - self._clock()) if ends else None

    def _touched(self) -> None:
        self._changed += 1
        self._changed_at = self._clock()
        self._state.notify_all()

    def close(self) -> None:
        """End all waiting in `next_picture`."""
        with self._state:
            self._closed = True
            self._state.notify_all()

    @property
    def closed(self) -> bool:
        """Whether `close` was called."""
        return self._closed

    @property
    def recording(self) -> bool:
        """Whether the camera's way is recorded."""
        return self._recording

    @property
    def recorded(self) -> tuple[int, float]:
        """How many views are recorded, and the seconds from the first to the last."""
        with self._state:
            return len(self._recorder), self._recorder.seconds

    def record(self, on: bool) -> None:
        """Begin or end recording the camera's way, as fast as it is flown.

        Beginning again goes on after what is recorded; the way in between takes a second.

        Raises:
            ConfigError: when more than an hour would be recorded; nothing is recorded from then on.
        """
        with self._state:
            if on == self._recording:
                return
            if on:
                self._recorder.add(self._camera, 1.0)
                self._recorded_at = self._clock()
                self._recording = True
                return
            # First: what cannot be added at the end must not keep the recording from ending.
            self._recording = False
            if self._clock() > self._recorded_at:
                self._record_view()

    def add_view(self, after_s: float = 2.0) -> None:
        """Record the camera as it is now; the path glides there from the view before in `after_s` seconds."""
        with self._state:
            self._recorder.add(self._camera, after_s)
            self._recorded_at = self._clock()

    def clear_path(self) -> None:
        """Forget what is recorded, and end recording."""
        with self._state:
            self._recorder.clear()
            self._recording = False

    def path(self, *, fps: float = 24.0) -> CameraPath:
        """What is recorded, as a camera path of the pictures' size.

        Raises:
            ConfigError: when nothing is recorded.
        """
        with self._state:
            return self._recorder.path(self._camera.width, self._camera.height, fps=fps)

    def _record_view(self) -> None:
        now = self._clock()
        self._recorder.add(self._camera, max(now - self._recorded_at, 1e-4), rests=True)
        self._recorded_at = now


def _checked_width(width: int) -> int:
    if not WIDTHS_PX[0] <= width <= WIDTHS_PX[1]:
        raise ConfigError(f"pictures {width} pixels wide; expected {WIDTHS_PX[0]} to {WIDTHS_PX[1]}")
    return width


def _sized(camera: Cameras, width: int) -> Cameras:
    if len(camera) != 1:
        raise ConfigError(f"a viewer looks from one camera, not from {len(camera)}")
    return camera.resized(width, max(1, round(camera.height * width / camera.width)))


def _same(first: Cameras, second: Cameras) -> bool:
    return (
        (first.width, first.height, first.lens) == (second.width, second.height, second.lens)
        and np.array_equal(first.world_from_camera, second.world_from_camera)
        and np.array_equal(first.K, second.K)
    )
