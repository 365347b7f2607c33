"""`extrags view`: what is refused, what a browser is shown, and a real server with a real connection."""

from __future__ import annotations

import asyncio
import importlib.util
import json
import shutil
import socket
import sys
import threading
import time
import types
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation

from extrags.cameras import Cameras
from extrags.errors import ConfigError, MissingDependencyError, StoreError
from extrags.export import read_camera_path
from extrags.scene import Scene
from extrags.splat_files import write_ply_scene
from extrags.store import Store
from extrags.view import SceneRenderer
from flows import view_server
from flows.cli import main, parser
from flows.commands import view as command
from flows.outcome import SequenceOutcome
from flows.view_server import ViewServer, check_installed
from tests.extrags.lit_tube import build_tube, from_outside, seen_from_inside, tube_cameras
from tests.flows import viser_stand_in
from tests.flows.tiny import SEQUENCE, TINY

pytestmark = pytest.mark.usefixtures("untouched_environment")

Finished = tuple[str, SequenceOutcome]
SETTINGS = [part for name, value in TINY.items() for part in ("--set", f"{name}={json.dumps(value)}")]
REAL = importlib.util.find_spec("viser") is not None


@pytest.fixture(scope="module")
def renderer() -> SceneRenderer:
    return SceneRenderer(build_tube().scene, train=tube_cameras(6))


@pytest.fixture
def stand_in(monkeypatch: pytest.MonkeyPatch) -> type[viser_stand_in.ViserServer]:
    module = types.ModuleType("viser")
    module.ViserServer = viser_stand_in.ViserServer  # type: ignore[attr-defined]
    monkeypatch.setitem(sys.modules, "viser", module)
    monkeypatch.setattr(viser_stand_in.ViserServer, "made", [])
    # It listens nowhere, so that no program is in its way.
    monkeypatch.setattr(view_server, "_check_address", lambda *_: None)
    return viser_stand_in.ViserServer


@pytest.fixture
def client(
    stand_in: type[viser_stand_in.ViserServer], renderer: SceneRenderer
) -> Iterator[viser_stand_in.Client]:
    server = ViewServer(renderer, width=160)
    browser = viser_stand_in.Client(7)
    stand_in.made[0].connect(browser)
    yield browser
    server.stop()


def eventually(condition: Callable[[], Any]) -> Any:
    """What a condition gives once it is true; fails after a minute."""
    end = time.monotonic() + 60
    while not (found := condition()):
        assert time.monotonic() < end, "it did not come true"
        time.sleep(0.01)
    return found


class TestRefused:
    @pytest.mark.parametrize(
        ("arguments", "message"),
        [
            (["phantom/0@sparse", "--width", "8"], "--width is 8; expected 16 to 8192"),
            (["phantom/0@sparse", "--port", "70000"], "--port is 70000; expected 0 to 65535"),
            (["a.ply", "--scene", "coarse"], "--scene does not apply to a file of Gaussians"),
            (["a.ply", "--method", "coarse"], "--method does not apply to a file of Gaussians"),
            (["a.ply", "--profile", "quick"], "--profile does not apply to a file of Gaussians"),
            (["a.ply", "--store", "s"], "--store does not apply to a file of Gaussians"),
            (["a.spz", "--seed", "1"], "--seed does not apply to a file of Gaussians"),
            (["a.ply", "--coarse.iterations", "5"], "--coarse.iterations does not apply to a file"),
            (["phantom/0@sparse", "--scene", "fine"], "invalid choice: 'fine'"),
            (["phantom/0@sparse", "--method", "uc-nerf"], "uc-nerf makes no Gaussians"),
        ],
    )
    @pytest.mark.usefixtures("stand_in")
    def test_usage(self, arguments: list[str], message: str, capsys: pytest.CaptureFixture[str]) -> None:
        assert main(["view", *arguments]) == 2
        assert message in capsys.readouterr().err

    @pytest.mark.usefixtures("stand_in")
    def test_a_file_that_is_not_there(self, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
        assert main(["view", str(tmp_path / "none.ply")]) == 1
        assert "no such file" in capsys.readouterr().err
        (tmp_path / "a.sog").write_bytes(b"PK\x03\x04")
        assert main(["view", str(tmp_path / "a.sog")]) == 1
        assert "export the scene as PLY or SPZ" in capsys.readouterr().err

    @pytest.mark.usefixtures("stand_in")
    def test_a_run_that_is_not_in_the_store(self, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
        assert main(["view", SEQUENCE, *SETTINGS, "--store", str(tmp_path / "store")]) == 1
        assert "run it first" in capsys.readouterr().err

    def test_the_device_of_a_picture_is_not_that_of_the_run(self) -> None:
        given = parser("view").parse_args(["view", "a.ply", "--device", "cpu", "--set", "device=cuda"])
        assert (given.device, given.settings) == ("cpu", {"device": "cuda"})

    @pytest.mark.usefixtures("stand_in")
    def test_cuda_where_there_is_none(self, capsys: pytest.CaptureFixture[str]) -> None:
        if torch.cuda.is_available():
            pytest.skip("there is a CUDA device")
        assert main(["view", "a.ply", "--device", "cuda"]) == 2
        assert "no CUDA device" in capsys.readouterr().err

    def test_without_the_package(
        self, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
    ) -> None:
        monkeypatch.setitem(sys.modules, "viser", None)
        with pytest.raises(MissingDependencyError):
            check_installed()
        assert main(["view", "a.ply"]) == 1
        assert "pip install -e '.[view]' in a checkout" in capsys.readouterr().err

    def test_a_port_that_is_taken(
        self,
        stand_in: type[viser_stand_in.ViserServer],
        renderer: SceneRenderer,
        monkeypatch: pytest.MonkeyPatch,
    ) -> None:
        monkeypatch.setattr(stand_in, "taken", 8080)
        with pytest.raises(StoreError, match=r"port 8080 of 127\.0\.0\.1 is taken"):
            ViewServer(renderer)
        assert stand_in.made[0].stopped


class TestAddress:
    """Where viser could not listen, it would try a thousand ports and wait for ever."""

    @pytest.mark.parametrize("host", ["127.0.0.1", "0.0.0.0"])
    def test_a_port_that_is_taken(self, host: str) -> None:
        with socket.create_server(("127.0.0.1", 0)) as other:
            port = other.getsockname()[1]
            with pytest.raises(StoreError, match=f"port {port} of {host} is taken"):
                view_server._check_address(host, port)
        view_server._check_address(host, port)

    @pytest.mark.parametrize(
        ("host", "message"),
        [
            ("", "no host is named"),
            ("station.invalid", "the host station.invalid is not found"),
            ("a" * 70, "is not found"),
            # Of addresses for documentation, which no machine has.
            ("203.0.113.7", r"cannot listen at port 0 of 203\.0\.113\.7"),
        ],
    )
    def test_no_address_of_this_machine(self, host: str, message: str) -> None:
        with pytest.raises(ConfigError, match=message):
            view_server._check_address(host, 0)

    @pytest.mark.parametrize(
        ("host", "url"),
        [
            ("127.0.0.1", "http://127.0.0.1:8080"),
            ("station.lab", "http://station.lab:8080"),
            ("0.0.0.0", "http://localhost:8080"),
            ("::", "http://localhost:8080"),
            ("::1", "http://[::1]:8080"),
        ],
    )
    @pytest.mark.usefixtures("stand_in")
    def test_it_is_told_as_a_browser_takes_it(self, renderer: SceneRenderer, host: str, url: str) -> None:
        server = ViewServer(renderer, host=host)
        assert server.url == url
        server.stop()


class TestServed:
    """The command, up to the point where it waits for its end."""

    @pytest.fixture
    def shown(self, monkeypatch: pytest.MonkeyPatch) -> list[Scene]:
        """The scenes that are served."""
        found: list[Scene] = []

        def served(renderer: SceneRenderer, **options: Any) -> ViewServer:
            found.append(renderer.scene)
            return ViewServer(renderer, **options)

        monkeypatch.setattr("flows.view_server.ViewServer", served)
        monkeypatch.setattr(command, "until_told_to_stop", lambda: None)
        return found

    def test_a_file(
        self,
        stand_in: type[viser_stand_in.ViserServer],
        shown: list[Scene],
        tmp_path: Path,
        capsys: pytest.CaptureFixture[str],
    ) -> None:
        scene = build_tube().scene
        write_ply_scene(scene, tmp_path / "tube.ply")
        assert main(["view", str(tmp_path / "tube.ply"), "--device", "cpu"]) == 0
        (server,) = stand_in.made
        assert (server.host, server.port, server.stopped) == ("127.0.0.1", 8080, True)
        assert "http://127.0.0.1:8080: tube.ply, 4" in capsys.readouterr().out
        assert server.label == "tube.ply (extrags)"
        torch.testing.assert_close(shown[0].gaussians.means, scene.gaussians.means)
        assert shown[0].light is not None, "a PLY of ours keeps it"

    @pytest.mark.parametrize(("which", "stage"), [("final", "finetune"), ("coarse", "coarse")])
    @pytest.mark.usefixtures("stand_in")
    def test_a_run(self, finished: Finished, shown: list[Scene], which: str, stage: str) -> None:
        store, outcome = finished
        arguments = ["view", SEQUENCE, "--profile", "quick", "--store", store, *SETTINGS]
        assert main([*arguments, "--scene", which, "--port", "0", "--device", "cpu"]) == 0
        expected = Store(store).load(Scene, outcome.refs[stage])
        torch.testing.assert_close(shown[0].gaussians.means, expected.gaussians.means)

    @pytest.mark.usefixtures("stand_in")
    def test_a_scene_whose_artefact_goes_meanwhile_is_shown_to_its_end(
        self,
        finished: Finished,
        shown: list[Scene],
        tmp_path: Path,
        monkeypatch: pytest.MonkeyPatch,
        capsys: pytest.CaptureFixture[str],
    ) -> None:
        """It is in memory; who asks for it later is told that it is not in the store."""
        root, outcome = finished
        keys = {key for row in outcome.stages for key in row.made}
        for key in keys:
            shutil.copytree(Path(root) / "artefacts" / key, tmp_path / "store" / "artefacts" / key)
        store, pictures = Store(tmp_path / "store"), []

        def removed() -> None:
            store.rm("finetune*")
            scene = shown[0]
            pictures.append(scene.render(build_tube().sequence.cameras[0]).rgb)

        monkeypatch.setattr(command, "until_told_to_stop", removed)
        given = ["view", SEQUENCE, "--profile", "quick", "--store", store.root, *SETTINGS, "--device", "cpu"]
        assert main([*given, "--port", "0"]) == 0
        assert bool(torch.isfinite(pictures[0]).all())
        capsys.readouterr()
        assert main(given) == 1
        assert "--scene coarse" in capsys.readouterr().err


class TestBrowser:
    def test_sessions_end_with_their_browsers(
        self, stand_in: type[viser_stand_in.ViserServer], renderer: SceneRenderer
    ) -> None:
        server = ViewServer(renderer, width=160)

        def threads() -> set[str]:
            return {thread.name for thread in threading.enumerate() if thread.name.startswith("view-")}

        first, second, third = (viser_stand_in.Client(number) for number in (1, 2, 3))
        stand_in.made[0].connect(first)
        stand_in.made[0].connect(second)
        assert threads() == {"view-1", "view-2"}
        stand_in.made[0].disconnect(first)
        assert threads() == {"view-2"}
        # viser tells of both from threads of a pool: the end may come first.
        stand_in.made[0].disconnect(third)
        stand_in.made[0].connect(third)
        assert threads() == {"view-2"}
        server.stop()
        assert threads() == set()

    def test_it_starts_at_the_first_training_view(
        self, client: viser_stand_in.Client, renderer: SceneRenderer
    ) -> None:
        start = tube_cameras(6)[0]
        # A typical depth is two of the page's units.
        np.testing.assert_allclose(client.camera.position * 10.0, start.centers[0])
        np.testing.assert_allclose((client.camera.look_at - client.camera.position) / 2, start.forward[0])
        np.testing.assert_allclose(client.camera.up_direction, -start.world_from_camera[0, :3, 1])
        assert np.tan(client.camera.fov / 2) == pytest.approx(24 / 34)

    def test_it_is_shown_what_it_looks_at(
        self, client: viser_stand_in.Client, renderer: SceneRenderer
    ) -> None:
        eventually(lambda: client.pictures)
        client.camera.move(position=np.array([0.1, 0.0, 0.5]), fov=1.2, aspect=2.0)
        last = eventually(lambda: [p for p in client.pictures if p.shape == (80, 160, 3)])[-1]
        eventually(lambda: "still: 160 x 80" in client.gui.controls["status"].content)
        last = client.pictures[-1]
        K = np.array([[[40 / np.tan(0.6), 0, 80], [0, 40 / np.tan(0.6), 40], [0, 0, 1]]])
        pose = np.eye(4)
        pose[:3, 3] = [1.0, 0.0, 5.0]
        with torch.no_grad():
            rgb = renderer.scene.render(Cameras(K, pose[None], 160, 80)).rgb[0]
        expected = np.rint(rgb.clamp(0, 1).numpy() * 255)
        assert np.abs(last.astype(float) - expected).max() <= 1

    def test_its_controls(self, client: viser_stand_in.Client, renderer: SceneRenderer) -> None:
        controls = client.gui.controls
        eventually(lambda: client.pictures)
        controls["lamp (%)"].set(0)
        eventually(lambda: client.pictures[-1].max() == 0)
        controls["lamp (%)"].set(100)
        controls["exposure (stops)"].set(1.0)
        controls["fall-off"].set(False)
        eventually(lambda: client.pictures[-1].max() > 100)
        controls["layer"].set("alpha")
        eventually(lambda: (np.ptp(client.pictures[-1].astype(int), axis=2) == 0).all())
        controls["width (px)"].set(320)
        eventually(lambda: client.pictures[-1].shape[1] == 320)
        controls["training view"].set(3)
        np.testing.assert_allclose(client.camera.position * 10.0, tube_cameras(6).centers[3])
        controls["back to the start"].set()
        np.testing.assert_allclose(client.camera.position * 10.0, tube_cameras(6).centers[0])
        assert controls["training view"].value == 0
        assert client.told == []

    def test_what_no_slider_reaches_is_its_end(self, client: viser_stand_in.Client) -> None:
        """The number beside a slider takes any until it is left."""
        controls = client.gui.controls
        eventually(lambda: client.pictures)
        controls["training view"].set(999)
        assert controls["training view"].value == 5
        np.testing.assert_allclose(client.camera.position * 10.0, tube_cameras(6).centers[5])
        controls["exposure (stops)"].set(2000.0)
        assert controls["exposure (stops)"].value == 5.0
        controls["width (px)"].set(-7)
        eventually(lambda: client.pictures[-1].shape[1] == 160)
        assert client.told == []

    def test_a_narrow_window_has_no_larger_pictures(self, client: viser_stand_in.Client) -> None:
        eventually(lambda: client.pictures)
        client.camera.move(aspect=0.5)
        eventually(lambda: client.pictures[-1].shape == (160, 80, 3))
        client.gui.controls["width (px)"].set(320)
        eventually(lambda: client.pictures[-1].shape == (320, 160, 3))
        client.camera.move(aspect=0.01)
        eventually(lambda: client.pictures[-1].shape[1] == 16)
        client.camera.move(aspect=2.0)
        eventually(lambda: client.pictures[-1].shape == (160, 320, 3))

    def test_a_control_that_fails_says_so(
        self,
        client: viser_stand_in.Client,
        monkeypatch: pytest.MonkeyPatch,
        caplog: pytest.LogCaptureFixture,
    ) -> None:
        def fails(*_: Any) -> None:
            raise OSError("no space left")

        client.gui.controls["add view"].set()
        assert "path: 1 view," in client.gui.controls["status"].content
        monkeypatch.setattr(view_server, "write_camera_path", fails)
        client.gui.controls["save"].set()
        assert client.told == ["OSError: no space left"]
        assert "a control of the page failed" in caplog.text

    def test_a_path_is_saved(self, client: viser_stand_in.Client, tmp_path: Path) -> None:
        controls = client.gui.controls
        controls["save"].set()
        assert client.told == ["no view was recorded"]
        positions = [np.array([0.0, 0.0, 0.1 * step]) for step in range(3)]
        for position in positions:
            client.camera.move(position=position)
            controls["add view"].set()
        assert "path: 3 views, 4.0 s" in controls["status"].content
        controls["frames per second"].set(10)
        controls["save"].set()
        (tmp_path / "path.json").write_bytes(client.files["camera_path.json"])
        path = read_camera_path(tmp_path / "path.json")
        assert (len(path.cameras), path.fps, path.cameras.width) == (41, 10.0, 160)
        np.testing.assert_allclose(path.cameras.centers[::20], 10.0 * np.stack(positions), atol=1e-9)
        controls["record"].set(True)
        controls["clear"].set()
        assert controls["record"].value is False
        controls["save"].set()
        assert client.told[1:] == ["no view was recorded"]

    def test_a_window_without_height_is_said(self, client: viser_stand_in.Client) -> None:
        client.camera.move(aspect=0.0)
        assert "no camera has" in client.told[0]

    def test_what_fails_in_a_picture_is_said(
        self, client: viser_stand_in.Client, renderer: SceneRenderer, monkeypatch: pytest.MonkeyPatch
    ) -> None:
        eventually(lambda: client.pictures)

        def fails(*_: Any) -> None:
            raise RuntimeError("out of memory")

        with monkeypatch.context() as patched:
            patched.setattr(SceneRenderer, "render", fails)
            client.camera.move(fov=0.9)
            assert eventually(lambda: client.told)[0] == "RuntimeError: out of memory"
        shown = len(client.pictures)
        eventually(lambda: len(client.pictures) > shown)

    def test_a_scene_without_lamp_has_no_lamp_to_change(
        self, stand_in: type[viser_stand_in.ViserServer]
    ) -> None:
        server = ViewServer(SceneRenderer(Scene(build_tube().scene.gaussians)), width=160)
        browser = viser_stand_in.Client()
        stand_in.made[0].connect(browser)
        controls = browser.gui.controls
        assert "exposure (stops)" in controls
        assert not {"lamp (%)", "fall-off", "training view"} & set(controls)
        assert "uncertainty" not in browser.gui.options["layer"]["options"]
        stand_in.made[0].disconnect(browser)
        server.stop()

    def test_walls_stand_where_they_are_if_that_is_wanted(
        self, client: viser_stand_in.Client, stand_in: type[viser_stand_in.ViserServer]
    ) -> None:
        """Where the scene knows from which side its walls were seen; the other one has no such box."""
        box = "walls seen from behind stand back"
        assert box not in client.gui.controls
        server = ViewServer(SceneRenderer(seen_from_inside(build_tube().scene)), width=160)
        browser = viser_stand_in.Client()
        stand_in.made[-1].connect(browser)

        def differs(picture: np.ndarray) -> bool:
            """Whether the last picture is one of full resolution and another one."""
            last = browser.pictures[-1].astype(float) if browser.pictures else picture
            return last.shape == picture.shape and bool(np.abs(last - picture).mean() > 1)

        pose = from_outside().world_from_camera[0]
        turn = Rotation.from_matrix(pose[:3, :3]).as_quat()[[3, 0, 1, 2]]
        browser.camera.move(wxyz=turn, position=pose[:3, 3] / 10.0)
        # Colours are dark that far from the lamp.
        browser.gui.controls["layer"].set("depth")
        eventually(lambda: differs(np.zeros((120, 160, 3))))
        through = browser.pictures[-1].astype(float)
        browser.gui.controls[box].set(False)
        eventually(lambda: differs(through))
        stand_in.made[-1].disconnect(browser)
        server.stop()


@pytest.mark.parametrize(
    ("host", "origin", "name", "own"),
    [
        ("127.0.0.1", "http://127.0.0.1:8080", "127.0.0.1:8080", True),
        # By way of a tunnel that begins at another port.
        ("127.0.0.1", "http://localhost:9000", "localhost:9000", True),
        ("127.0.0.1", "http://evil.example", "127.0.0.1:8080", False),
        ("127.0.0.1", "http://localhost:3000", "localhost:8080", False),
        # A name that its owner has made to lead to this machine.
        ("127.0.0.1", "http://evil.example:8080", "evil.example:8080", False),
        ("127.0.0.1", "null", "127.0.0.1:8080", False),
        ("::1", "http://[::1]:8080", "[::1]:8080", True),
        ("0.0.0.0", "http://station.lab:8080", "station.lab:8080", True),
        ("0.0.0.0", "http://evil.example", "station.lab:8080", False),
    ],
)
def test_whose_pages_are_shown_the_scene(host: str, origin: str, name: str, own: bool) -> None:
    assert view_server._is_own_page(origin, [name], host) == own


def test_pages_of_other_sites_are_refused(caplog: pytest.LogCaptureFixture) -> None:
    from websockets import Origin
    from websockets.asyncio import client, server
    from websockets.exceptions import InvalidStatus

    async def told(origin: str | None) -> str:
        async with client.connect(address, origin=None if origin is None else Origin(origin)) as browser:
            return str(await browser.recv())

    async def serve() -> None:
        nonlocal address
        with view_server.refusing_other_sites("127.0.0.1"):
            serving = server.serve(lambda connection: connection.send("the scene"), "127.0.0.1", 0)
        async with serving as listening:
            port = next(iter(listening.sockets)).getsockname()[1]
            address = f"ws://127.0.0.1:{port}"
            assert await told(None) == await told(f"http://127.0.0.1:{port}") == "the scene"
            for _ in range(2):
                with pytest.raises(InvalidStatus, match="403"):
                    await told("http://evil.example")

    address = ""
    asyncio.run(serve())
    refused = [record.message for record in caplog.records if record.name == "flows.view_server"]
    assert refused == ["a page of http://evil.example asked for the scene, and was refused"]


@pytest.mark.skipif(not REAL, reason="viser is not installed: pip install -e '.[view]'")
def test_a_real_server_answers_a_real_browser(
    renderer: SceneRenderer,
    caplog: pytest.LogCaptureFixture,
    capsys: pytest.CaptureFixture[str],
    recwarn: pytest.WarningsRecorder,
) -> None:
    import cv2
    import msgspec.msgpack
    import viser
    import zstandard
    from websockets.exceptions import InvalidStatus
    from websockets.sync.client import connect

    server = ViewServer(renderer, port=0, width=160)
    try:
        protocol = f"viser-v{viser.__version__}"
        with pytest.raises(InvalidStatus, match="403"):
            connect(server.url.replace("http", "ws"), subprotocols=[protocol], origin="http://evil.example")  # type: ignore[list-item, arg-type]
        with connect(server.url.replace("http", "ws"), subprotocols=[protocol], max_size=None) as browser:  # type: ignore[list-item]

            def look(height: float) -> None:
                message = {
                    "type": "ViewerCameraMessage",
                    "wxyz": (1.0, 0.0, 0.0, 0.0),
                    "position": (0.0, 0.0, height),
                    "fov": 1.2,
                    "near": 0.01,
                    "far": 1000.0,
                    "image_height": 300,
                    "image_width": 600,
                    "look_at": (0.0, 0.0, height + 1),
                    "up_direction": (0.0, -1.0, 0.0),
                }
                browser.send(msgspec.msgpack.encode(message))

            def pictures() -> Iterator[np.ndarray]:
                while True:
                    sent = browser.recv(timeout=60)
                    size = int.from_bytes(sent[8:16], "little")
                    told = zstandard.ZstdDecompressor().decompress(sent[16 : 16 + size])
                    for message in msgspec.msgpack.decode(told)["messages"]:
                        # The first one clears the background.
                        if message["type"] == "BackgroundImageMessage" and message["rgb_data"]:
                            yield cv2.imdecode(np.frombuffer(message["rgb_data"], np.uint8), 1)[..., ::-1]

            # Nobody can have the scene shown to the world.
            browser.send(msgspec.msgpack.encode({"type": "ShareUrlRequest"}))
            look(0.0)
            (viewer,) = eventually(lambda: list(server._viewers.values()))
            shown = pictures()
            assert next(picture for picture in shown if picture.shape == (80, 160, 3)).mean() > 10
            look(0.4)
            assert next(shown).shape == (40, 80, 3), "half while it moves"
            assert next(picture for picture in shown if picture.shape == (80, 160, 3)).mean() > 10
        assert "a page asked for a public address" in eventually(lambda: caplog.text)
        # It has left while a picture is made for it.
        eventually(lambda: not server._viewers)
        viewer._client.scene.set_background_image(np.zeros((4, 4, 3), np.uint8))
    finally:
        server.stop()
    told = capsys.readouterr()
    assert (told.out, told.err) == ("", "")
    assert [str(warning.message) for warning in recwarn] == []
