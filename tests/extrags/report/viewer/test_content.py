"""The viewer's part of the page."""

from __future__ import annotations

import base64
import json
import re
from dataclasses import replace

import numpy as np
import pytest
import torch

from extrags.config import PipelineConfig, ReportConfig
from extrags.redaction import has_credentials
from extrags.report import ReportInputs, build_report
from extrags.report.viewer import viewer_content
from extrags.report.viewer.content import SCRIPTS, SHADERS, SORTER, encoded_within, script_text
from extrags.report.viewer.encoding import EncodedScene, decoded_scene
from extrags.scene import Scene
from tests.extrags.report.pages import Page

CONFIG = ReportConfig(held_out_views=3, virtual_views=4)


@pytest.fixture(scope="module")
def html(drawn: ReportInputs) -> str:
    return build_report(drawn, CONFIG)


def test_page_loads_nothing_from_outside(html: str) -> None:
    page = Page(html)
    assert all(load.startswith("data:image/") for load in page.loads)
    assert "://" not in html.replace("http://www.w3.org/", "")
    assert not re.search(r"\b(fetch|importScripts|XMLHttpRequest|EventSource|sendBeacon)\b", html)
    assert not has_credentials(html)
    assert len(page.ids) == len(set(page.ids))


def test_every_control_has_words(html: str) -> None:
    labelled = re.sub(r"<label.*?</label>", "", html, flags=re.DOTALL)
    for tag in re.findall(r"<(?:input|select|canvas)\b[^>]*>", labelled):
        assert "aria-label" in tag, f"outside of a label and without words: {tag}"
    assert "<noscript>" in html


def test_scenes_in_the_page_are_those_of_the_run(html: str, drawn: ReportInputs) -> None:
    data = json.loads(re.search(r'id="viewer-data">(.*?)</script>', html)[1])
    assert [scene["name"] for scene in data["scenes"]] == ["coarse", "final"]
    for header, scene in zip(data["scenes"], (drawn.coarse_scene, drawn.final_scene), strict=True):
        body = base64.b64decode(re.search(rf'id="{header["element"]}">(.*?)</script>', html)[1])
        quantities = tuple(header["quantities"])
        encoded = EncodedScene(body, header["count"], header["degree"], quantities, header["sided"])
        found, levels, facing = decoded_scene(encoded)
        assert len(found) == len(scene.gaussians)
        if scene.facing is None:
            assert facing is None
        else:
            assert torch.equal(facing.sort().values, scene.facing.sort().values)
        assert set(levels) == {"observed", "directions", "uncertainty", "expected_error"}
        assert header["light"]["reference"] == 12.0
        assert np.allclose(header["light"]["offset"], [0.1, -0.05, 0])
        assert header["light"]["shoulder"] == pytest.approx(1)
        assert header["light"]["specular"] == pytest.approx(0.1)
        assert header["light"]["roughness"] == pytest.approx(0.2)
        assert header["light"]["glare"] == pytest.approx([0.02] * 3)


def test_cameras_have_the_exposures_of_the_evaluation(html: str, drawn: ReportInputs) -> None:
    data = json.loads(re.search(r'id="viewer-data">(.*?)</script>', html)[1])
    groups = {group["name"]: group["cameras"] for group in data["groups"]}
    assert {name: len(cameras) for name, cameras in groups.items()} == {
        "train": 6, "held_out": 5, "virtual-1": 7, "virtual-2": 7,
    }  # fmt: skip
    light, sequence = drawn.coarse_scene.light, drawn.sequence
    gains = light.interpolated_exposures(drawn.frames, sequence.train)
    for camera, frame, gain in zip(groups["held_out"], drawn.frames, gains, strict=True):
        assert camera["exposure"]["coarse"] == pytest.approx(float(gain), rel=1e-5)
        assert np.allclose(np.reshape(camera["pose"], (3, 4)), sequence.world_from_camera[frame][:3])
    assert [len(path["poses"]) for path in data["paths"]] == [6, 7, 7]


def test_names_cannot_end_a_script(drawn: ReportInputs) -> None:
    names = tuple(f"</script><script>alert({k})" for k in range(11))
    named = replace(drawn, sequence=replace(drawn.sequence, frame_names=names))
    content = viewer_content(named, 10**7)
    assert "</script" not in content.data
    assert json.loads(content.data)["groups"][0]["cameras"][0]["name"] == names[0]


def test_scripts_do_not_end_themselves() -> None:
    for name in (*SCRIPTS, *SHADERS, SORTER):
        assert "</" not in script_text(name)


def test_budget(scene: Scene) -> None:
    """First the harmonics go, then what shows least."""
    gaussians = scene.gaussians
    whole, said = encoded_within(gaussians, {}, 10**7)
    assert (whole.count, whole.degree, said) == (len(gaussians), 2, "")
    less, said = encoded_within(gaussians, {}, round(0.7 * len(whole.body)))
    assert (less.count, less.degree) == (len(gaussians), 1)
    assert said == "harmonics up to degree 1 of 2"
    least, said = encoded_within(gaussians, {}, 8000)
    assert len(least.body) <= 8000
    assert 200 < least.count < len(gaussians)
    assert said.startswith(f"{least.count} of {len(gaussians)} Gaussians")


def test_sides_stay_with_the_gaussians_that_are_kept(scene: Scene) -> None:
    """Those that show most are kept; here they are the ones with sides."""
    gaussians = scene.gaussians
    large = torch.arange(len(gaussians)) % 2 == 0
    solid = replace(
        gaussians,
        opacities=torch.where(large, 5.0, -4.0),
        scales=gaussians.scales + torch.where(large, 2.0, -2.0)[:, None],
    )
    cut, _ = encoded_within(solid, {}, 8000, facing=large.to(torch.int8))
    facing = decoded_scene(cut)[2]
    assert facing is not None
    assert cut.count < int(large.sum())
    assert (facing == 1).all()


def test_the_switch_is_there_where_a_scene_knows_its_sides(drawn: ReportInputs) -> None:
    switch = '<input type="checkbox" data-show="one_sided"'
    html = build_report(drawn, CONFIG)
    assert switch in html
    assert "B whether walls seen from behind stand back" in html
    neither = build_report(replace(drawn, final_scene=replace(drawn.final_scene, facing=None)), CONFIG)
    assert switch not in neither
    assert "seen from behind" not in Page(neither).text


def test_page_keeps_to_its_budget(drawn: ReportInputs) -> None:
    content = viewer_content(drawn, 40_000)
    assert sum(len(body) for body in content.bodies.values()) <= 40_000


def test_left_out_where_asked_for(drawn: ReportInputs) -> None:
    page = Page(build_report(drawn, CONFIG.model_copy(update={"viewer_mb": 0.0})))
    assert "viewer" not in page.ids
    assert "The settings leave the viewer out (report.viewer_mb is 0)." in page.text
    assert viewer_content(replace(drawn, coarse_scene=None, final_scene=None), 10**7) is None


def test_left_out_where_there_are_no_gaussians(drawn: ReportInputs) -> None:
    field = replace(
        drawn,
        coarse_scene=None,
        final_scene=None,
        config=PipelineConfig().with_overrides({"uc_nerf.enabled": True}),
    )
    text = Page(build_report(field, CONFIG)).text
    assert "The scene is a radiance field, and the viewer draws Gaussians." in text
    assert "Nothing from the stage coarse" not in text


def test_gaussians_that_show_in_no_picture_are_counted(drawn: ReportInputs) -> None:
    gaussians = drawn.coarse_scene.gaussians
    opacities = gaussians.opacities.clone()
    opacities[:10] = -9.0
    faint = Scene(replace(gaussians, opacities=opacities))
    text = Page(build_report(replace(drawn, coarse_scene=faint), CONFIG)).text
    assert f"are left out: 10 of {len(gaussians):,} in the coarse scene".replace(",", " ") in text
    assert "too transparent" not in Page(build_report(drawn, CONFIG)).text


def test_a_scene_without_light(drawn: ReportInputs) -> None:
    assert "with the light at the camera" in build_report(drawn, CONFIG)
    unlit = replace(drawn, final_scene=None, coarse_scene=Scene(drawn.coarse_scene.gaussians))
    html = build_report(unlit, CONFIG)
    assert "with the light at the camera" not in html
    assert 'data-light="exposure"' not in html
    data = json.loads(re.search(r'id="viewer-data">(.*?)</script>', html)[1])
    assert data["scenes"][0]["light"] is None
    assert data["distance"] > 0
