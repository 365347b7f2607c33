"""What a viewer gets to see: half resolution while anything changes, then exactly what the scene renders."""

from __future__ import annotations

import threading
import time
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

from extrags.cameras import Cameras
from extrags.errors import ConfigError
from extrags.export import read_camera_path, write_camera_path
from extrags.radial_lens import RadialLens
from extrags.scene import Scene
from extrags.view import RateMeter, SceneRenderer, ViewSession, ViewSettings
from tests.extrags.lit_tube import build_tube, tube_cameras


class Clock:
    """Time that passes when it is told to."""

    def __init__(self) -> None:
        self.now = 100.0

    def __call__(self) -> float:
        return self.now


@pytest.fixture(scope="module")
def scene() -> Scene:
    return build_tube().scene


@pytest.fixture(scope="module")
def renderer(scene: Scene) -> SceneRenderer:
    return SceneRenderer(scene, train=tube_cameras(4))


def rendered(scene: Scene, camera: Cameras) -> np.ndarray:
    with torch.no_grad():
        rgb = scene.render(camera).rgb[0]
    return np.rint(rgb.clamp(0, 1).numpy() * 255).astype(np.uint8)


@pytest.fixture
def clock() -> Clock:
    return Clock()


@pytest.fixture
def session(renderer: SceneRenderer, clock: Clock) -> ViewSession:
    return ViewSession(renderer, tube_cameras(4)[0], width=64, clock=clock)


def test_the_first_picture_is_what_the_scene_renders(session: ViewSession, scene: Scene) -> None:
    picture = session.next_picture(0.0)
    assert picture is not None
    assert picture.full
    np.testing.assert_array_equal(picture.rgb, rendered(scene, tube_cameras(4)[0]))
    assert session.next_picture(0.0) is None


def test_half_resolution_while_moving_then_full(session: ViewSession, scene: Scene, clock: Clock) -> None:
    session.next_picture(0.0)
    for index in (1, 2):
        clock.now += 0.1
        session.look(tube_cameras(4)[index])
        moving = session.next_picture(0.0)
        assert moving is not None
        assert not moving.full
        np.testing.assert_array_equal(moving.rgb, rendered(scene, tube_cameras(4)[index].resized(32, 24)))
    assert session.next_picture(0.0) is None, "nothing new until it rests"
    clock.now += 0.2
    still = session.next_picture(0.0)
    assert still is not None
    assert still.full
    np.testing.assert_array_equal(still.rgb, rendered(scene, tube_cameras(4)[2]))
    assert session.next_picture(0.0) is None


def test_only_the_last_of_many_movements_is_rendered(session: ViewSession, clock: Clock) -> None:
    session.next_picture(0.0)
    for index in (1, 2, 3):
        session.look(tube_cameras(4)[index])
    picture = session.next_picture(0.0)
    assert picture is not None
    np.testing.assert_array_equal(picture.camera.world_from_camera, tube_cameras(4)[3].world_from_camera)
    assert session.next_picture(0.0) is None


def test_the_same_camera_again_is_no_movement(session: ViewSession) -> None:
    session.next_picture(0.0)
    session.look(tube_cameras(4)[0])
    session.change(ViewSettings())
    session.resize(64)
    assert session.next_picture(0.0) is None


def test_the_same_camera_through_a_lens_is_another(session: ViewSession, scene: Scene, clock: Clock) -> None:
    through = replace(session.camera, lens=RadialLens((-0.1, 0.0, 0.0, 0.0), np.radians(60)))
    session.look(through)
    clock.now += 1
    picture = session.next_picture(0.0)
    assert picture is not None
    np.testing.assert_array_equal(picture.rgb, rendered(scene, through))


def test_the_width_is_the_sessions_and_the_aspect_the_cameras(session: ViewSession, clock: Clock) -> None:
    session.look(tube_cameras(4)[1].resized(400, 200))
    session.resize(128)
    clock.now += 1
    picture = session.next_picture(0.0)
    assert picture is not None
    assert picture.rgb.shape == (64, 128, 3)
    with pytest.raises(ConfigError, match="8 pixels wide; expected 16 to 8192"):
        session.resize(8)


def test_rates_are_those_of_movements(session: ViewSession, clock: Clock) -> None:
    session.next_picture(0.0)
    rates = []
    for index in (1, 2, 3):
        clock.now += 0.1
        session.look(tube_cameras(4)[index])
        picture = session.next_picture(0.0)
        assert picture is not None
        rates.append(picture.rate)
    assert rates == [None, pytest.approx(10), pytest.approx(10)]


def test_a_pause_begins_a_new_rate() -> None:
    meter = RateMeter(window_s=2.0, pause_s=1.0)
    assert [meter.add(at) for at in (0.0, 0.5, 1.0)] == [None, 2.0, 2.0]
    assert [meter.add(at) for at in (9.0, 9.25)] == [None, 4.0]
    assert [meter.add(9.25 + 0.125 * step) for step in range(1, 40)][-1] == 8.0, "what was before the window"


def test_waiting_ends_with_a_movement_or_the_end(renderer: SceneRenderer) -> None:
    session = ViewSession(renderer, tube_cameras(4)[0], width=64, still_after_s=30.0)
    session.next_picture()
    found = []

    def wait() -> None:
        while (picture := session.next_picture()) is not None:
            found.append(picture.full)

    thread = threading.Thread(target=wait)
    thread.start()
    session.look(tube_cameras(4)[1])
    end = time.monotonic() + 60
    while not found and time.monotonic() < end:
        time.sleep(0.01)
    session.close()
    thread.join(60)
    assert not thread.is_alive()
    assert found == [False]


def test_full_resolution_comes_by_itself(renderer: SceneRenderer) -> None:
    session = ViewSession(renderer, tube_cameras(4)[0], width=64, still_after_s=0.02)
    session.next_picture()
    session.look(tube_cameras(4)[1])
    pictures = [session.next_picture(60.0)]
    if pictures[-1] is not None and not pictures[-1].full:
        pictures.append(session.next_picture(60.0))
    assert pictures[-1] is not None
    assert pictures[-1].full


class TestRecording:
    def test_a_recorded_path_is_the_one_read_back(
        self, session: ViewSession, clock: Clock, tmp_path: Path
    ) -> None:
        cameras = tube_cameras(4)
        session.record(True)
        for index in (1, 2, 3):
            clock.now += 0.125
            session.look(cameras[index])
        session.record(False)
        session.look(cameras[0])
        path = session.path(fps=8.0)
        write_camera_path(path, tmp_path / "path.json")
        back = read_camera_path(tmp_path / "path.json")
        assert (back.cameras.width, back.cameras.height, back.fps) == (64, 48, 8.0)
        np.testing.assert_allclose(back.cameras.world_from_camera, path.cameras.world_from_camera, atol=1e-12)
        np.testing.assert_allclose(back.cameras.K, path.cameras.K, atol=1e-12)
        # Flown at eight views per second, it is what was looked at.
        np.testing.assert_allclose(back.cameras.world_from_camera, cameras.world_from_camera, atol=1e-9)

    def test_views_with_the_way_between_them(self, session: ViewSession, clock: Clock) -> None:
        cameras = tube_cameras(4)
        for index in range(4):
            session.look(cameras[index])
            session.add_view(after_s=0.5)
        assert session.recorded == (4, 1.5)
        path = session.path(fps=10.0)
        np.testing.assert_allclose(
            path.cameras.world_from_camera, cameras.interpolated(5).world_from_camera, atol=1e-9
        )
        session.clear_path()
        assert session.recorded == (0, 0.0)
        with pytest.raises(ConfigError, match="no view was recorded"):
            session.path()

    def test_views_through_a_lens_are_recorded_as_pinholes(self, session: ViewSession) -> None:
        """Camera paths have no lens."""
        through = replace(session.camera, lens=RadialLens((-0.1, 0.0, 0.0, 0.0), np.radians(60)))
        session.look(through)
        session.add_view()
        recorded, pinhole = session.path().cameras, through.as_pinholes()
        np.testing.assert_allclose(recorded.K, pinhole.K)
        assert np.abs(recorded.K - through.K).max() > 1

    def test_nothing_is_recorded_unasked(self, session: ViewSession, clock: Clock) -> None:
        session.look(tube_cameras(4)[1])
        assert session.recorded == (0, 0.0)

    def test_standing_still_is_recorded_as_such(self, session: ViewSession, clock: Clock) -> None:
        cameras = tube_cameras(4)
        session.record(True)
        clock.now += 3.0
        session.look(cameras[1])
        session.record(False)
        centers = session.path(fps=10.0).cameras.centers
        assert len(centers) == 31
        np.testing.assert_allclose(centers[:30], np.tile(cameras.centers[0], (30, 1)), atol=1e-9)
        np.testing.assert_allclose(centers[30], cameras.centers[1], atol=1e-9)

    def test_an_hour_is_the_most(self, session: ViewSession, clock: Clock) -> None:
        session.next_picture(0.0)
        session.record(True)
        clock.now += 4000.0
        with pytest.raises(ConfigError, match="longer than 60 minutes"):
            session.look(tube_cameras(4)[1])
        assert not session.recording
        assert session.next_picture(0.0) is not None, "the view goes on"
        assert session.recorded == (1, 0.0)

    def test_a_recording_that_stood_still_for_more_than_an_hour_ends(
        self, session: ViewSession, clock: Clock
    ) -> None:
        session.record(True)
        clock.now += 4000.0
        with pytest.raises(ConfigError, match="longer than 60 minutes"):
            session.record(False)
        assert not session.recording
        assert session.recorded == (1, 0.0)
        session.record(False)
