"""A visit of the page with headless Chromium, which draws in software."""

from __future__ import annotations

import base64
import io
from collections.abc import Callable, Iterator
from dataclasses import replace

import numpy as np
import pytest
import torch
from PIL import Image
from torch.nn import functional

from extrags.cameras import Cameras, look_at, pixel_rays
from extrags.config import ReportConfig
from extrags.facing import one_sided_rendering
from extrags.raster.light import apply_response, light_gain, shortest_axes, specular_gain
from extrags.raster.spherical_harmonics import sh_basis
from extrags.report import ReportInputs, build_report
from extrags.sequence import EndoscopicSequence
from tests.browser import Browser, browser

pytestmark = pytest.mark.slow

VIEWER = "extragsViewer.viewer"


@pytest.fixture(scope="module")
def tab(drawn: ReportInputs, tmp_path_factory: pytest.TempPathFactory) -> Iterator[Browser]:
    """The page, its scene read."""
    folder = tmp_path_factory.mktemp("page")
    page = folder / "report.html"
    page.write_text(build_report(drawn, ReportConfig(held_out_views=3, virtual_views=4)), encoding="utf-8")
    with browser(folder / "profile") as opened:
        opened.window(1280, 900)
        opened.open(page)
        opened.run("extragsViewer.ready.then(() => true)")
        yield opened


@pytest.fixture(autouse=True)
def no_errors(tab: Browser) -> Iterator[None]:
    yield
    assert tab.errors == []
    assert all(request.startswith(("file:", "blob:", "data:")) for request in tab.requests)


def do(tab: Browser, call: str) -> None:
    tab.run(f"{VIEWER}.{call}.then(() => true)")


def picture(tab: Browser) -> np.ndarray:
    """The canvas with the pixels of the run's images, [H, W, 3] in [0, 1]."""
    url = tab.run(f"{VIEWER}.picture(true)")
    raw = base64.b64decode(url.split(",", 1)[1])
    return np.asarray(Image.open(io.BytesIO(raw)).convert("RGB")) / 255


def psnr(image: np.ndarray, other: np.ndarray) -> float:
    return float(-10 * np.log10(max(np.square(image - other).mean(), 1e-12)))


@pytest.mark.parametrize("name", ["coarse", "final"])
def test_held_out_views_agree_with_the_rasteriser(tab: Browser, drawn: ReportInputs, name: str) -> None:
    scene = drawn.coarse_scene if name == "coarse" else drawn.final_scene
    sequence, frames = drawn.sequence, drawn.frames
    gains = scene.light.interpolated_exposures(frames, sequence.train)
    do(tab, f"setScene('{name}')")
    for place in (0, len(frames) - 1):
        do(tab, f"jump(1, {place})")
        expected = scene.render(sequence.cameras[int(frames[place])], exposure=gains[place : place + 1])
        drawn_here = picture(tab)
        assert psnr(drawn_here, expected.rgb[0].clamp(0, 1).numpy()) >= 45
        assert drawn_here.std() > 0.02


def test_training_cameras_have_their_own_exposure(tab: Browser, drawn: ReportInputs) -> None:
    scene = drawn.final_scene
    do(tab, "setScene('final')")
    do(tab, "jump(0, 4)")
    camera = drawn.sequence.cameras[int(drawn.sequence.train[4])]
    own = scene.render(camera, exposure=scene.light.exposures()[4:5]).rgb[0].clamp(0, 1).numpy()
    mean = scene.render(camera).rgb[0].clamp(0, 1).numpy()
    assert psnr(picture(tab), own) >= 45 > psnr(picture(tab), mean)


def outside(sequence: EndoscopicSequence) -> Cameras:
    """A camera beside the tube that looks at its axis."""
    middle = np.median(sequence.cameras.centers, axis=0) * [1, 0, 0]
    pose = look_at(
        middle + np.array([6, -30, 18]), middle + np.array([12, 0, 0]), up=np.array([0.0, 0.0, 1.0])
    )
    return replace(sequence.cameras[int(sequence.train[0])], world_from_camera=pose[None])


def test_walls_seen_from_behind_stand_back(tab: Browser, drawn: ReportInputs) -> None:
    """As in `extrags.facing`, and unlike the rasteriser where the switch is off."""
    scene, camera = drawn.final_scene, outside(drawn.sequence)
    exposure = torch.tensor([6.0])
    expected, plain = (
        rendering.rgb[0].clamp(0, 1).numpy()
        for rendering in (
            one_sided_rendering(scene, camera, exposure=exposure),
            scene.render(camera, exposure=exposure),
        )
    )
    assert psnr(expected, plain) < 30
    do(tab, "setScene('final')")
    do(tab, "jump(0, 0)")
    tab.run(f"{VIEWER}.pose = {camera.world_from_camera[0, :3].ravel().tolist()}, true")
    do(tab, "left()")
    do(tab, "setLight({exposure: 6})")
    assert psnr(picture(tab), expected) >= 45
    do(tab, "show('one_sided', false)")
    assert psnr(picture(tab), plain) >= 45
    do(tab, "show('one_sided', true)")
    assert psnr(picture(tab), expected) >= 45
    do(tab, "resetLight()")


def test_the_switch_of_sides(tab: Browser) -> None:
    """By key and by box; at rest where the scene shown knows no sides."""
    box = "document.querySelector('#viewer [data-show=one_sided]')"
    shown = f"{VIEWER}.shown.one_sided"
    do(tab, "setScene('final')")
    assert tab.run(f"{box}.checked && !{box}.disabled && {shown}")
    tab.run("document.querySelector('#viewer canvas').focus()")
    tab.key("b")
    assert not tab.run(f"{box}.checked || {shown}")
    tab.run(f"{box}.click()")
    assert tab.run(f"{box}.checked && {shown}")
    do(tab, "setScene('coarse')")
    assert tab.run(f"{box}.disabled")
    tab.run("document.querySelector('#viewer canvas').focus()")
    tab.key("b")
    assert tab.run(shown)
    do(tab, "setScene('final')")


def test_the_light_moves(tab: Browser, drawn: ReportInputs) -> None:
    do(tab, "jump(0, 0)")
    # `home`: as if the scene had been made with a lamp there, which is what the rasteriser draws.
    place = "offset: [0.3, 0.1, 0], home: [0.3, 0.1, 0]"
    do(tab, f"setLight({{exposure: 1, exponent: 1.4, cosine: 1.2, {place}}})")
    do(tab, "setLight({specular: 0.5, roughness: 0.3})")
    scene = drawn.final_scene
    light = replace(
        scene.light,
        log_exponent=torch.tensor(1.4).log(),
        cosine=torch.tensor(1.2),
        log_specular=torch.tensor(0.5).log(),
        log_roughness=torch.tensor(0.3).log(),
        offset=torch.tensor([0.3, 0.1, 0]),
    )
    camera = drawn.sequence.cameras[int(drawn.sequence.train[0])]
    expected = replace(scene, light=light).render(camera).rgb[0].clamp(0, 1).numpy()
    moved = picture(tab)
    assert psnr(moved, expected) >= 45
    do(tab, "resetLight()")
    assert psnr(picture(tab), moved) < 35


def test_a_lamp_left_behind_does_not_follow(tab: Browser, drawn: ReportInputs) -> None:
    do(tab, "jump(0, 0)")
    do(tab, "setLight({exposure: 1, specular: 2, roughness: 0.6})")
    riding = picture(tab)
    do(tab, "pinLamp(true)")
    # It stays where it was: that alone changes nothing.
    assert psnr(picture(tab), riding) > 60
    do(tab, "jump(0, 3)")
    do(tab, "setLight({exposure: 1})")
    behind = picture(tab)
    for half_way in (True, False):
        expected = lit_from_elsewhere(drawn, specular=2.0, roughness=0.6, half_way=half_way)
        assert (psnr(behind, expected) >= 45) == half_way
    do(tab, "pinLamp(false)")
    assert psnr(picture(tab), behind) < 35
    do(tab, "resetLight()")


def lit_from_elsewhere(
    drawn: ReportInputs, *, specular: float, roughness: float, half_way: bool
) -> np.ndarray:
    """The final scene from training camera 3, its lamp on camera 0, [H, W, 3].

    Highlights lie half-way between lamp and camera, or, as on a lamp that rides, in the lamp's direction.
    """
    scene, sequence = drawn.final_scene, drawn.sequence
    gaussians, light = scene.gaussians, scene.light
    here, there = (sequence.cameras[int(sequence.train[k])] for k in (3, 0))
    means = gaussians.means.double()
    normals = shortest_axes(gaussians.quats, gaussians.scales).double()
    row = replace(light, log_specular=torch.tensor(specular).log(), log_roughness=torch.tensor(1.0).log())
    row = row.camera_light(torch.ones(1)).packed()[0].double()
    turn, shift = (torch.from_numpy(part) for part in (there.viewmats[0, :3, :3], there.viewmats[0, :3, 3]))
    from_lamp = means @ turn.T + shift, normals @ turn.T
    toward = []
    for camera in (there, here):
        pose = torch.from_numpy(camera.world_from_camera[0])
        # Seen from where the scene has the lamp of either camera.
        offset = means - pose[:3, 3] - light.reference_distance * pose[:3, :3] @ row[7:10]
        toward.append(functional.normalize(offset, dim=1))
    direction = functional.normalize(toward[0] + toward[1], dim=1) if half_way else toward[0]
    squared = roughness**2
    missed = 1 - (normals * direction).sum(1).square()
    lobe = (squared / (squared + (1 - squared) * missed)).square()
    seen = functional.normalize(means - torch.from_numpy(here.centers[0]), dim=1)
    basis = sh_basis(seen, gaussians.sh_degree)
    albedo = (torch.einsum("nk,nkc->nc", basis, gaussians.sh.double()) + 0.5).clamp_min(0)
    # A roughness of one has the peak of its lobe in all directions.
    signal = albedo * light_gain(*from_lamp, row)[:, None] + (lobe * specular_gain(*from_lamp, row))[:, None]
    colors = apply_response(signal, row[10]).float()
    return scene.render_attributes(here, colors)[0][0].clamp(0, 1).numpy()


def test_orbit_by_pointer_and_keys(tab: Browser) -> None:
    do(tab, "jump(0, 1)")
    tab.run("document.querySelector('#viewer canvas').scrollIntoView({block: 'center', behavior: 'instant'})")
    box = tab.run(
        "(b => [b.x, b.y, b.width, b.height])(document.querySelector('canvas').getBoundingClientRect())"
    )
    middle = (box[0] + box[2] / 2, box[1] + box[3] / 2)
    before = tab.run(f"{VIEWER}.pose")
    about = tab.run(f"{VIEWER}.target")
    tab.drag(middle, (middle[0] + 80, middle[1] + 30))
    do(tab, "change()")
    after = tab.run(f"{VIEWER}.pose")
    assert np.abs(np.subtract(before, after)).max() > 0.05
    assert np.allclose(tab.run(f"{VIEWER}.target"), about, atol=1e-3)
    turn = np.reshape(after, (3, 4))[:, :3]
    assert np.allclose(turn.T @ turn, np.eye(3), atol=1e-5)
    for key, change in (("w", "moved"), ("ArrowLeft", "turned"), ("n", "next")):
        pose = tab.run(f"{VIEWER}.pose")
        tab.run("document.querySelector('#viewer canvas').focus()")
        tab.key(key)
        do(tab, "change()")
        assert not np.allclose(tab.run(f"{VIEWER}.pose"), pose), change
    assert tab.run(f"{VIEWER}.camera") == {"group": 0, "index": 2}
    assert tab.run("document.querySelector('#viewer [data-part=status]').textContent") == "Training, b_002"


def test_a_drawn_camera_can_be_clicked(tab: Browser) -> None:
    do(tab, "jump(0, 0)")
    do(tab, "show('held_out', true)")
    lines = picture(tab)
    found = tab.run(
        f"(v => {{ const s = v.state(), c = v.data.groups[1].cameras[4].pose, p = [c[3], c[7], c[11]];"
        "const m = s.view;"
        "const t = [0, 1, 2].map(k => m[k] * p[0] + m[4 + k] * p[1] + m[8 + k] * p[2] + m[12 + k]);"
        f"return v.pick(s.K[0] * t[0] / t[2] + s.K[2], s.K[1] * t[1] / t[2] + s.K[3], 3); }})({VIEWER})"
    )
    assert found["group"] == 1
    do(tab, "show('held_out', false)")
    assert psnr(picture(tab), lines) < 45


@pytest.mark.parametrize("what", ["mesh", "train", "virtual", "free", "slice"])
def test_overlays_are_drawn(tab: Browser, what: str) -> None:
    do(tab, "jump(0, 2)")
    do(tab, "move([0, 0, -0.3])")
    bare = picture(tab)
    do(tab, f"show('{what}', true)")
    assert psnr(picture(tab), bare) < 50
    do(tab, f"show('{what}', false)")
    assert psnr(picture(tab), bare) > 60


def test_the_slice_shows_clearance(tab: Browser, drawn: ReportInputs) -> None:
    """It is drawn where the grid is free, in the colours of its clearance."""
    do(tab, "jump(0, 2)")
    bare = picture(tab)
    do(tab, "setSlice(16.0)")
    found = picture(tab)
    camera = drawn.sequence.cameras[int(drawn.sequence.train[2])]
    points = camera.centers[:, None, None] + 16.0 * pixel_rays(camera)
    inside = np.hypot(points[0, ..., 1], points[0, ..., 2])
    changed = np.abs(found - bare).max(-1) > 0.02
    # The wall of the free voxels is blocky: nothing is asked within a voxel of it.
    assert changed[inside < 7].mean() > 0.97
    assert changed[inside > 11].mean() < 0.03
    # From dark blue at the wall to yellow in the middle.
    yellow = (found - bare)[..., 1] - (found - bare)[..., 2]
    assert yellow[inside < 3].mean() > 0.1 + yellow[(inside > 5) & (inside < 7)].mean()
    do(tab, "show('slice', false)")


def test_free_space_by_keys(tab: Browser) -> None:
    tab.run("document.querySelector('#viewer canvas').focus()")
    legend = "!document.querySelector('#viewer [data-legend={}]').hidden"
    for key, what in (("f", "free"), ("x", "slice")):
        assert not tab.run(legend.format(what))
        tab.key(key)
        assert tab.run(legend.format(what))
        assert tab.run(f"document.querySelector('#viewer [data-show={what}]').checked")
    depth = tab.run(f"{VIEWER}.sliceDepth")
    tab.key("]")
    assert tab.run(f"{VIEWER}.sliceDepth") == pytest.approx(1.1 * depth)
    assert "free space, clearance at" in tab.run(
        "document.querySelector('#viewer [data-part=status]').textContent"
    )
    tab.key("f")
    tab.key("x")
    assert not tab.run(legend.format("free"))
    do(tab, "change()")


@pytest.mark.parametrize("name", ["observed", "directions", "uncertainty", "expected_error"])
def test_quantities_are_shown(tab: Browser, name: str) -> None:
    do(tab, "jump(0, 2)")
    do(tab, "setQuantity('')")
    plain = picture(tab)
    do(tab, f"setQuantity('{name}')")
    assert psnr(picture(tab), plain) < 30
    do(tab, "setQuantity('')")


@pytest.mark.parametrize("path", [0, 1])
def test_flight_ends_at_the_last_pose(tab: Browser, path: int) -> None:
    tab.run(f"{VIEWER}.play({path}, 0, 60).then(() => true)")
    last = tab.run(f"{VIEWER}.data.paths[{path}].poses.at(-1)")
    assert np.allclose(tab.run(f"{VIEWER}.pose"), last, atol=1e-6)


def test_views_lie_on_each_other(tab: Browser) -> None:
    chosen = "document.querySelector('#compare [data-part={}]')"
    labels = tab.run(f"[...{chosen.format('left')}.options].map(option => option.text)")
    assert labels[:3] == ["Coarse", "Final", "Truth"]
    tab.run(
        f"(([slider, right]) => {{ slider.value = 25; slider.dispatchEvent(new Event('input'));"
        f"right.value = 2; right.dispatchEvent(new Event('change')); }})"
        f"([{chosen.format('divide')}, {chosen.format('right')}])"
    )
    assert tab.run(f"{chosen.format('over')}.style.clipPath") == "inset(0px 75% 0px 0px)"
    assert tab.run(f"{chosen.format('under')}.firstChild.alt").endswith("as recorded")


@pytest.mark.parametrize(("width", "height"), [(1280, 900), (820, 1180), (420, 900)])
def test_nothing_is_wider_than_the_window(tab: Browser, width: int, height: int) -> None:
    tab.window(width, height, dark=width == 820)
    wider = tab.run(
        "[...document.querySelectorAll('body *')].filter("
        "item => !item.closest('nav, .scroll, .chart, details')"
        " && item.getBoundingClientRect().right > window.innerWidth).map(item => item.outerHTML.slice(0, 90))"
    )
    assert wider == []
    assert tab.run("document.documentElement.scrollWidth <= window.innerWidth")
    tab.window(1280, 900)


def test_speed_is_known(tab: Browser, record_property: Callable[[str, object], None]) -> None:
    per_second = tab.run(f"{VIEWER}.speed(6)")
    record_property("pictures_per_second", per_second)
    assert per_second > 0.1
