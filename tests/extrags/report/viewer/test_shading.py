"""The light of the page's shader, evaluated here: that of the rasteriser, and what only the page can do."""

from __future__ import annotations

import re
from typing import Any

import numpy as np
import pytest
import torch

from extrags.cameras import invert_poses, look_at
from extrags.raster.light import CameraLight, lit_colors
from extrags.report.viewer.content import script_text

EXPOSURE, SHOULDER, REFERENCE = 1.3, 0.7, 12.0
FALLOFF = {"softening": 0.3, "exponent": 1.1, "spread": 0.8, "cosine": 0.6}
GLOSS = {"specular": 0.5, "roughness": 0.2}
GLARE = (0.08, 0.02, 0.05)
OWN = (0.15, -0.1, 0.05)
UP = np.array([0.0, -1.0, 0.0])
HERE = look_at(np.array([1.0, 2.0, -3.0]), np.array([2.0, 1.0, 15.0]), UP)
THERE = look_at(np.array([-6.0, 3.0, 1.0]), np.array([2.0, 1.0, 15.0]), UP)


class Vector(np.ndarray):
    """As GLSL has it: components by letter, and a row times a matrix."""

    def __new__(cls, *values: Any) -> Vector:
        return np.concatenate([np.ravel(value) for value in values]).astype(np.float64).view(cls)

    def __getattr__(self, name: str) -> Any:
        if set(name) <= set("xyzw"):
            picked = [float(self["xyzw".index(letter)]) for letter in name]
            return picked[0] if len(picked) == 1 else Vector(picked)
        raise AttributeError(name)

    def __mul__(self, other: Any) -> Any:
        return Vector(np.asarray(other).T @ self) if isinstance(other, Matrix) else super().__mul__(other)


class Matrix(np.ndarray):
    """Times a vector it is a product of matrices."""

    def __new__(cls, values: np.ndarray) -> Matrix:
        return np.asarray(values, dtype=np.float64).view(cls)

    def __mul__(self, other: Any) -> Any:
        return Vector(np.asarray(self) @ other)


GLSL: dict[str, Any] = {
    "vec3": Vector,
    "vec4": Vector,
    "mat3": lambda m: Matrix(np.asarray(m)[:3, :3]),
    "dot": lambda a, b: float(np.dot(a, b)),
    "sqrt": np.sqrt,
    "inversesqrt": lambda x: x**-0.5,
    "log2": np.log2,
    "exp2": np.exp2,
    "clamp": lambda x, low, high: min(max(x, low), high),
}


def under_light(uniforms: dict[str, Any], albedo: np.ndarray, mean: np.ndarray, normal: np.ndarray) -> Any:
    """What the shader's function of this name returns."""
    source = re.search(r"^vec3 under_light\(.*?\) \{(.*?)^\}", str(script_text("splat.vert")), re.S | re.M)
    assert source is not None
    scope = {**GLSL, **uniforms, "a": Vector(albedo), "mean": Vector(mean), "normal": Vector(normal)}
    for statement in re.sub(r"//.*", "", source[1]).split(";"):
        words = " ".join(statement.split())
        if words.startswith("return "):
            return eval(words.removeprefix("return "), scope)
        exec(re.sub(r"^(float|vec3) ", "", words), scope)
    raise AssertionError("it returns nothing")


def uniforms(
    *, view: np.ndarray, lamp: np.ndarray, offset: tuple[float, ...], home: tuple[float, ...]
) -> dict[str, Any]:
    viewmats = invert_poses(np.stack([view, lamp]))
    return {
        "view": Matrix(viewmats[0]),
        "lamp": Matrix(viewmats[1]),
        "exposure": EXPOSURE,
        "falloff": Vector(list(FALLOFF.values())),
        "place": Vector(offset, REFERENCE),
        "home": Vector(home),
        "shoulder": SHOULDER,
        "gloss": Vector(list(GLOSS.values())),
        "glare": Vector(GLARE),
    }


def surfaces() -> list[tuple[np.ndarray, np.ndarray, np.ndarray]]:
    """Albedo, centre and unit normal of some, most of them nearly facing the camera."""
    random = np.random.default_rng(4)
    found = []
    for _ in range(40):
        mean = np.array([2.0, 1.0, 15.0]) + random.normal(0, 4, 3)
        normal = mean - HERE[:3, 3] + random.normal(0, 4, 3)
        found.append((random.uniform(0, 1, 3), mean, normal / np.linalg.norm(normal)))
    return found


def rendered(pose: np.ndarray, offset: tuple[float, ...], albedo: Any, mean: Any, normal: Any) -> np.ndarray:
    """What the rasteriser makes of one surface."""
    values = {name: torch.tensor(value) for name, value in {**FALLOFF, **GLOSS, "shoulder": SHOULDER}.items()}
    light = CameraLight(
        exposure=torch.full((1, 3), EXPOSURE),
        offset=torch.tensor(offset),
        glare=torch.tensor(GLARE),
        reference_distance=REFERENCE,
        **values,
    )
    viewmat = invert_poses(pose[None])[0]
    arrays = (albedo, viewmat[:3, :3] @ mean + viewmat[:3, 3], viewmat[:3, :3] @ normal)
    rows = [torch.from_numpy(array)[None].float() for array in arrays]
    return np.asarray(lit_colors(*rows, light.packed()[0])[0])


def strength(given: dict[str, Any], mean: np.ndarray, normal: np.ndarray) -> float:
    """The lobe's value: what black shines, over what it shines at the peak of the lobe."""

    def signal(roughness: float) -> float:
        gloss = Vector([GLOSS["specular"], roughness])
        shown = float(
            under_light(
                {**given, "gloss": gloss, "glare": Vector([0.0] * 3), "shoulder": 0.0},
                np.zeros(3),
                mean,
                normal,
            )[0]
        )
        return shown

    # A roughness of one has its peak in all directions.
    return signal(GLOSS["roughness"]) / signal(1.0)


def unit(vector: np.ndarray) -> np.ndarray:
    return np.asarray(vector / np.linalg.norm(vector))


@pytest.mark.parametrize("offset", [(0.0, 0.0, 0.0), OWN])
def test_the_lamp_of_the_scene_is_that_of_the_rasteriser(offset: tuple[float, ...]) -> None:
    given = uniforms(view=HERE, lamp=HERE, offset=offset, home=offset)
    for surface in surfaces():
        np.testing.assert_allclose(
            under_light(given, *surface), rendered(HERE, offset, *surface), rtol=2e-5, atol=1e-6
        )


@pytest.mark.parametrize("left_behind", [True, False])
def test_highlights_of_a_lamp_elsewhere_lie_half_way_to_the_camera(left_behind: bool) -> None:
    """Left behind where another camera was, or moved aside on the camera that looks."""
    aside = (0.5, 0.2, 0.0)
    if left_behind:
        given = uniforms(view=HERE, lamp=THERE, offset=(0, 0, 0), home=(0, 0, 0))
        lamp = THERE[:3, 3]
    else:
        given = uniforms(view=HERE, lamp=HERE, offset=aside, home=(0, 0, 0))
        lamp = HERE[:3, 3] + REFERENCE * HERE[:3, :3] @ aside
    squared = GLOSS["roughness"] ** 2
    for _, mean, normal in surfaces():
        half_way = unit(unit(mean - lamp) + unit(mean - HERE[:3, 3]))
        missed = 1 - (normal @ half_way) ** 2
        expected = (squared / (squared + (1 - squared) * missed)) ** 2
        assert strength(given, mean, normal) == pytest.approx(expected, rel=1e-9)
        assert strength(given, mean, half_way) == pytest.approx(1)
        assert strength(given, mean, unit(mean - lamp)) < 0.9


def test_highlights_follow_the_camera_away_from_a_lamp_left_behind() -> None:
    (_, mean, _), *_ = surfaces()
    normal = unit(mean - THERE[:3, 3])
    seen = [
        strength(uniforms(view=pose, lamp=THERE, offset=OWN, home=OWN), mean, normal)
        for pose in (THERE, HERE)
    ]
    assert seen[0] > 2 * seen[1]


def test_every_uniform_is_set() -> None:
    """One that is not is zero, without a word."""
    declared = re.findall(r"^uniform \w+ (\w+);", str(script_text("splat.vert")), re.M)
    textures = {"geometry", "harmonics", "quantities"}
    set_here = set(re.findall(r"gl\.uniform\w+\(places\.(\w+)", str(script_text("renderer.js"))))
    assert len(declared) > 15
    assert set(declared) - textures <= set_here
