"""A `ViewSession` per browser, by way of viser: its page sends where it looks, and is sent pictures.

viser's page steers the camera and has the controls; what it shows is rendered here, as the page's background.
"""

from __future__ import annotations

import contextlib
import errno
import io
import logging
import socket
import tempfile
import threading
import time
import warnings
from collections.abc import Iterator, Sequence
from dataclasses import replace
from http import HTTPStatus
from ipaddress import ip_address
from pathlib import Path
from typing import Any
from urllib.parse import urlsplit

import numpy as np
from scipy.spatial.transform import Rotation

from extrags.cameras import Cameras
from extrags.errors import ConfigError, ExtragsError, MissingDependencyError, StoreError, installed_with
from extrags.export import write_camera_path
from extrags.view import Picture, SceneRenderer, ViewSession, overview, pinhole, typical_depth

__all__ = ["ViewServer", "check_installed"]

logger = logging.getLogger(__name__)

_QUALITY_MOVING, _QUALITY_STILL = 75, 92
"""Of JPEG, in per cent."""
_LEAST_WIDTH_PX = 16
_SAY_EVERY_S = 0.25
_KEYS_PER_DEPTH = 2.0
"""The page's keys move the camera by two of its units in a second: one typical depth of the scene."""


def check_installed() -> Any:
    """The module viser.

    Raises:
        MissingDependencyError: when it is not installed.
    """
    try:
        import viser
    except ImportError as error:
        raise MissingDependencyError(
            f"extrags view needs the package viser: {installed_with('view')}"
        ) from error
    return viser


class ViewServer:
    """Serves one scene to browsers until it is stopped.

    Args:
        renderer: of the scene.
        title: of the page.
        host: address to listen at; 127.0.0.1 is this machine alone. Nobody is asked for a password.
        port: to listen at; 0 takes a free one.
        width: of a picture at full resolution, in pixels; of a picture that is taller than wide, its height.

    Raises:
        ConfigError: when this machine cannot listen at the address.
        MissingDependencyError: without viser.
        StoreError: when the port is taken.
    """

    def __init__(
        self,
        renderer: SceneRenderer,
        *,
        title: str = "extrags",
        host: str = "127.0.0.1",
        port: int = 8080,
        width: int = 640,
    ) -> None:
        viser = check_installed()
        _check_address(host, port)
        # A page may leave while a picture is made for it.
        warnings.filterwarnings("ignore", r"Queued a \w+ on a closed connection", UserWarning)
        self._renderer, self._width = renderer, width
        self._start = overview(renderer.scene, width) if renderer.train is None else renderer.train[0]
        self._viewers: dict[int, _Viewer] = {}
        self._left: set[int] = set()
        self._guard = threading.Lock()
        with _silent(), refusing_other_sites(host):
            self._server = viser.ViserServer(host=host, port=port, label=title, verbose=False)
        # A page can ask viser for a tunnel that shows the scene to the world by way of viser's own servers.
        self._server.request_share_url = _not_shared
        self._server.gui.configure_theme(show_share_button=False)
        found = int(self._server.get_port())
        if port not in (0, found):
            # Taken since it was tried: viser goes on to the next that is free, where nobody looks for it.
            self._stop()
            raise _taken(host, port)
        self.url = f"http://{_named(host)}:{found}"
        self._server.on_client_connect(self._connected)
        self._server.on_client_disconnect(self._gone)

    def _connected(self, client: Any) -> None:
        viewer = _Viewer(client, self._renderer, self._start, self._width)
        with self._guard:
            # viser tells of both from a pool of threads: a page that is closed at once has left before.
            left = client.client_id in self._left
            if not left:
                self._viewers[client.client_id] = viewer
        if left:
            viewer.end()

    def _gone(self, client: Any) -> None:
        with self._guard:
            self._left.add(client.client_id)
            viewer = self._viewers.pop(client.client_id, None)
        if viewer is not None:
            viewer.end()

    def stop(self) -> None:
        """Close all sessions, and the server."""
        for viewer in list(self._viewers.values()):
            viewer.end()
        self._stop()

    def _stop(self) -> None:
        with _silent():
            self._server.stop()


def _check_address(host: str, port: int) -> None:
    """Listen where viser will: it takes every refusal for a taken port, and after a thousand waits for ever.

    Raises:
        ConfigError: when this machine cannot listen there.
        StoreError: when the port is taken.
    """
    if not host:
        raise ConfigError("no host is named; 0.0.0.0 listens at every address of this machine")
    try:
        found = socket.getaddrinfo(host, port, type=socket.SOCK_STREAM, flags=socket.AI_PASSIVE)
    except (socket.gaierror, UnicodeError) as error:
        raise ConfigError(f"the host {host} is not found: {getattr(error, 'strerror', error)}") from error
    for family, kind, protocol, _, address in found:
        with socket.socket(family, kind, protocol) as trial:
            trial.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
            if family == socket.AF_INET6:
                trial.setsockopt(socket.IPPROTO_IPV6, socket.IPV6_V6ONLY, 1)
            try:
                trial.bind(address)
            except OSError as error:
                if error.errno == errno.EADDRINUSE:
                    raise _taken(host, port) from error
                raise ConfigError(f"cannot listen at port {port} of {host}: {error.strerror}") from error


def _taken(host: str, port: int) -> StoreError:
    return StoreError(f"port {port} of {host} is taken; choose another one with --port")


def _named(host: str) -> str:
    """The host as an address in a browser on this machine names it."""
    try:
        address = ip_address(host)
    except ValueError:
        return host
    if address.is_unspecified:
        return "localhost"
    return f"[{host}]" if address.version == 6 else host


@contextlib.contextmanager
def refusing_other_sites(host: str) -> Iterator[None]:
    """Servers of web sockets that are started inside the block refuse pages of other sites.

    Browsers let any page connect to this machine, and viser asks none where it comes from: it would be sent
    the pictures of the scene. A page of a name that is made to lead here counts as another site.

    Args:
        host: address that the server listens at.
    """
    from websockets.asyncio import server as sockets

    serve, told = sockets.serve, set[str]()

    def guarded(*given: Any, process_request: Any = None, **options: Any) -> Any:
        def check(connection: Any, request: Any) -> Any:
            origins, names = request.headers.get_all("Origin"), request.headers.get_all("Host")
            if not all(_is_own_page(origin, names, host) for origin in origins):
                shown = ", ".join(origins)
                if shown not in told:
                    told.add(shown)
                    logger.warning("a page of %s asked for the scene, and was refused", shown)
                return connection.respond(HTTPStatus.FORBIDDEN, "a page of another site\n")
            return None if process_request is None else process_request(connection, request)

        return serve(*given, process_request=check, **options)

    # Viser looks `serve` up when it starts, and has no setting for this.
    sockets.serve = guarded  # type: ignore[misc,assignment]
    try:
        yield
    finally:
        sockets.serve = serve  # type: ignore[misc]


def _is_own_page(origin: str, names: Sequence[str], host: str) -> bool:
    """Whether a page comes from this server.

    Args:
        origin: that the browser tells.
        names: of the server, as the browser knows it.
        host: address that the server listens at.
    """
    try:
        page = urlsplit(origin)
        name = page.hostname or ""
    except ValueError:
        return False
    return [page.netloc] == list(names) and (_is_this_machine(name) or not _is_this_machine(host))


def _is_this_machine(name: str) -> bool:
    try:
        return ip_address(name).is_loopback
    except ValueError:
        return name == "localhost" or name.endswith(".localhost")


def _silent() -> contextlib.redirect_stdout[io.StringIO]:
    """Without what viser prints it is to be verbose or not: where it listens, and that it ends."""
    return contextlib.redirect_stdout(io.StringIO())


def _not_shared(**_: Any) -> None:
    logger.warning("a page asked for a public address of the scene; extrags gives none")


class _Viewer:
    """One browser: its session, its controls, and the thread that renders for it."""

    def __init__(self, client: Any, renderer: SceneRenderer, start: Cameras, width: int) -> None:
        self._client = client
        # Scenes are in any unit; the page's keys, wheel and limits are made for a few units.
        self._unit = typical_depth(renderer.scene, start) / _KEYS_PER_DEPTH
        self.session = ViewSession(renderer, start, width=width)
        self._start, self._width = start, width
        self._said_at = -np.inf
        self._moving = self._still = ""
        self._controls()
        self._place(start)
        self._look(client.camera)
        client.camera.on_update(self._look)
        self._thread = threading.Thread(target=self._render, name=f"view-{client.client_id}", daemon=True)
        self._thread.start()

    def end(self) -> None:
        """Close the session, and wait for the picture that is being made."""
        self.session.close()
        self._thread.join(timeout=5)

    def _place(self, camera: Cameras) -> None:
        """Put the page's camera where this one is; a principal point off the middle is not kept."""
        pose, page = camera.world_from_camera[0], self._client.camera
        page.up_direction = -pose[:3, 1]
        page.position = pose[:3, 3] / self._unit
        # What the camera turns about: a point of the scene, roughly.
        page.look_at = pose[:3, 3] / self._unit + pose[:3, 2] * _KEYS_PER_DEPTH
        page.fov = float(2 * np.arctan(camera.height / 2 / camera.K[0, 1, 1]))

    def _look(self, page: Any) -> None:
        pose = np.eye(4)
        pose[:3, :3] = Rotation.from_quat(np.asarray(page.wxyz)[[1, 2, 3, 0]]).as_matrix()
        pose[:3, 3] = np.asarray(page.position) * self._unit
        aspect = float(page.aspect)
        # A narrow window would have pictures of far more pixels than it shows.
        width = max(_LEAST_WIDTH_PX, round(self._width * aspect)) if 0 < aspect < 1 else self._width
        try:
            camera = pinhole(pose, float(page.fov), aspect, width)
            self.session.resize(width)
            self.session.look(camera)
        except ExtragsError as error:
            # E.g. a window without height, or an hour of recording, which ends it.
            self._say(str(error))
            self._record.value = self.session.recording

    def _render(self) -> None:
        while not self.session.closed:
            try:
                picture = self.session.next_picture(timeout_s=1.0)
                if picture is None:
                    continue
                self._client.scene.set_background_image(
                    picture.rgb,
                    format="jpeg",
                    jpeg_quality=_QUALITY_STILL if picture.full else _QUALITY_MOVING,
                )
                self._report(picture)
            except Exception as error:
                # A thread that dies leaves a page that stands still without a word.
                logger.exception("a picture could not be made")
                self._say(f"{type(error).__name__}: {error}")
                time.sleep(1.0)

    def _report(self, picture: Picture) -> None:
        height, width = picture.rgb.shape[:2]
        took = f"{width} x {height}, {1000 * picture.seconds:.0f} ms"
        if picture.full:
            self._still = f"still: {took}"
        else:
            rate = "" if picture.rate is None else f", {picture.rate:.1f} frames/s"
            self._moving = f"moving: {took}{rate}"
        # Words that change with every picture cannot be read, and cost as much as the picture.
        if picture.full or time.monotonic() - self._said_at > _SAY_EVERY_S:
            self._said_at = time.monotonic()
            self._tell()

    def _tell(self) -> None:
        count, seconds = self.session.recorded
        path = f"path: {count} {'view' if count == 1 else 'views'}, {seconds:.1f} s"
        self._status.content = "  \n".join(line for line in (self._moving, self._still, path) if line)

    def _say(self, message: str) -> None:
        self._client.add_notification("extrags", message, color="red")

    def _controls(self) -> None:
        gui, session = self._client.gui, self.session
        self._status = gui.add_markdown("")
        with gui.add_folder("Light"):
            exposure = gui.add_slider("exposure (stops)", min=-5.0, max=5.0, step=0.1, initial_value=0.0)
            self._on_value(exposure, lambda stops: self._change(exposure=2.0**stops))
            if session.renderer.scene.light is not None:
                lamp = gui.add_slider("lamp (%)", min=0, max=400, step=5, initial_value=100)
                self._on_value(lamp, lambda percent: self._change(lamp=percent / 100))
                falloff = gui.add_checkbox("fall-off", initial_value=True)
                self._on_value(falloff, lambda on: self._change(falloff=on))
        with gui.add_folder("Shown"):
            layer = gui.add_dropdown("layer", session.renderer.layers, initial_value="color")
            self._on_value(layer, lambda name: self._change(layer=name))
            mix = gui.add_slider("over colour (%)", min=0, max=100, step=5, initial_value=100)
            self._on_value(mix, lambda percent: self._change(mix=percent / 100))
            if session.renderer.scene.facing is not None:
                one_sided = gui.add_checkbox("walls seen from behind stand back", initial_value=True)
                self._on_value(one_sided, lambda on: self._change(one_sided=on))
            width = gui.add_slider(
                "width (px)", min=160, max=1920, step=32, initial_value=self._width_shown()
            )
            self._on_value(width, lambda pixels: self._resize(int(pixels)))
        with gui.add_folder("Camera"):
            train, frame = session.renderer.train, None
            if train is not None and len(train) > 1:
                frame = gui.add_slider("training view", min=0, max=len(train) - 1, step=1, initial_value=0)
                self._on_value(frame, lambda index: self._place(train[int(index)]))

            def go_back() -> None:
                if frame is not None:
                    frame.value = 0
                self._place(self._start)

            self._on_click(gui.add_button("back to the start"), go_back)
        with gui.add_folder("Path"):
            self._record = gui.add_checkbox("record", initial_value=False)
            self._on_value(self._record, session.record)
            self._on_click(gui.add_button("add view"), session.add_view)
            fps = gui.add_slider("frames per second", min=1, max=60, step=1, initial_value=24)
            self._on_click(gui.add_button("save"), lambda: self._save(float(fps.value)))

            def clear() -> None:
                session.clear_path()
                self._record.value = False

            self._on_click(gui.add_button("clear"), clear)

    def _width_shown(self) -> int:
        return int(np.clip(self._width, 160, 1920))

    def _resize(self, width: int) -> None:
        self._width = width
        self._look(self._client.camera)

    def _change(self, **changed: Any) -> None:
        self.session.change(replace(self.session.settings, **changed))

    def _on_value(self, control: Any, do: Any) -> None:
        def changed(_: Any) -> None:
            value = control.value
            if hasattr(control, "min"):
                # What is typed beside a slider is held to its ends only when it is left.
                value = min(max(value, control.min), control.max)
                if value != control.value:
                    # This calls again.
                    control.value = value
                    return
            self._guarded(do, value)

        control.on_update(changed)

    def _on_click(self, button: Any, do: Any) -> None:
        button.on_click(lambda _: self._guarded(do))

    def _guarded(self, do: Any, *values: Any) -> None:
        try:
            do(*values)
        except ExtragsError as error:
            self._say(str(error))
        except Exception as error:
            # Viser would print it, and the page say nothing.
            logger.exception("a control of the page failed")
            self._say(f"{type(error).__name__}: {error}")
        self._tell()

    def _save(self, fps: float) -> None:
        path = self.session.path(fps=fps)
        with tempfile.TemporaryDirectory() as folder:
            file = Path(folder) / "camera_path.json"
            write_camera_path(path, file)
            self._client.send_file_download(file.name, file.read_bytes())
