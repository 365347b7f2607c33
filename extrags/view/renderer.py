"""One scene, rendered over and over: from any camera, under the viewer's light, as one of several layers."""

from __future__ import annotations

import math
import threading
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
import torch
from jaxtyping import Bool, Float, Int, UInt8
from torch import Tensor

from extrags.cameras import Cameras
from extrags.errors import ConfigError
from extrags.export.video import unobserved
from extrags.facing import laid_over, seen_from_behind, sides
from extrags.raster import CameraLight, Rendering, rasterize
from extrags.scene import NEAR, SHALLOWEST, Scene
from extrags.view.viewpoints import overview, typical_depth

__all__ = ["LAYERS", "SceneRenderer", "ViewSettings"]

LAYERS = ("color", "alpha", "depth", "uncertainty")
"""What can be shown."""

_HIT = 0.5
"""Where alpha is lower, no depth is shown."""


@dataclass(frozen=True)
class ViewSettings:
    """What a viewer can change while looking.

    Args:
        exposure: gain of the camera, above 0; 1 is the mean of the training frames.
        lamp: brightness of the lamp, 0 is off; 1 is that of the recording. It multiplies as the exposure
            does; a scene without a lamp has none to change.
        falloff: False lights everything as on the axis at the light's reference distance, facing the lamp,
            without highlights and glare: albedo under the camera's response.
        layer: color; alpha, how opaque; depth, from near (red) to far (blue); uncertainty, how little the
            training views say (black: well known, yellow: unknown).
        mix: share of a layer other than colour, the rest of which is colour, 0 to 1.
        one_sided: whether Gaussians seen from behind stand behind all others
            (`extrags.facing.one_sided_rendering`); of no matter to a scene that does not know its sides.

    Raises:
        ConfigError: for a value out of range.
    """

    exposure: float = 1.0
    lamp: float = 1.0
    falloff: bool = True
    layer: str = "color"
    mix: float = 1.0
    one_sided: bool = True

    def __post_init__(self) -> None:
        if not 0 < self.exposure < math.inf:
            raise ConfigError(f"exposure is {self.exposure:g}; expected a number above 0")
        if not 0 <= self.lamp < math.inf:
            raise ConfigError(f"lamp is {self.lamp:g}; expected a number from 0")
        if self.layer not in LAYERS:
            raise ConfigError(f"layer is {self.layer!r}; expected {', '.join(LAYERS)}")
        if not 0 <= self.mix <= 1:
            raise ConfigError(f"mix is {self.mix:g}; expected 0 to 1")


class SceneRenderer:
    """Renders one scene for any number of viewers, from any thread, one picture at a time.

    With the settings that hold at first a picture is exactly that of `extrags.facing.one_sided_rendering`,
    through a lens as well; that is `Scene.render` for a scene that does not know its sides. What they make of
    the parameters for every picture is made once here, and lies on the device that renders.

    One exception: a scene without light whose typical depth is below `SHALLOWEST`, which reconstruction and
    import refuse, is rendered from a hundredth of that depth on. `Scene.render` would leave surface out.

    Args:
        scene: the scene.
        train: the views it was made from, which the layer `uncertainty` needs.
        masks: pixels of these views that show tissue; None: all.
        device: a CUDA device renders with gsplat, the processor with the native kernels.
    """

    def __init__(
        self,
        scene: Scene,
        *,
        train: Cameras | None = None,
        masks: Sequence[Bool[np.ndarray, "h w"]] | None = None,
        device: torch.device | str = "cpu",
    ) -> None:
        self.scene = scene
        self.train, self.masks = train, masks
        self.device = torch.device(device)
        self._lock = threading.Lock()
        gaussians = scene.gaussians
        with torch.no_grad():
            self._means = gaussians.means.to(self.device)
            self._quats = gaussians.quats.to(self.device)
            self._scales = gaussians.scales.exp().to(self.device)
            self._opacities = gaussians.opacities.sigmoid().to(self.device)
            self._sh = gaussians.sh.to(self.device)
            normals = sides(scene)
            self._sides = None if normals is None else normals.to(self.device)

    @property
    def layers(self) -> tuple[str, ...]:
        """The layers that this scene has."""
        return LAYERS if self.train is not None else tuple(name for name in LAYERS if name != "uncertainty")

    def render(self, camera: Cameras, settings: ViewSettings) -> UInt8[np.ndarray, "h w 3"]:
        """One picture.

        Args:
            camera: one camera, with the size of the picture.
            settings: light and layer. The first picture of the layer `uncertainty` waits for what the
                training views saw to be counted; the later ones do not.

        Raises:
            ConfigError: for more cameras than one, or the layer `uncertainty` without training views.
        """
        if len(camera) != 1:
            raise ConfigError(f"a picture is that of one camera, not of {len(camera)}")
        if settings.layer not in self.layers:
            raise ConfigError("the layer uncertainty needs the views that the scene was made from")
        with self._lock, torch.inference_mode():
            if settings.layer == "color" or settings.mix == 0:
                return _eight_bit(self._lit(camera, settings).rgb[0])
            if settings.layer == "uncertainty":
                share = self._unknown(camera, settings)
                color = None if settings.mix == 1 else self._lit(camera, settings).rgb[0]
            else:
                rendering = self._lit(camera, settings)
                color = rendering.rgb[0]
                share = rendering.alpha[0] if settings.layer == "alpha" else self._nearness(camera, rendering)
            shown = _palettes()[settings.layer][_eight_bit(share)]
            if color is None or settings.mix == 1:
                return np.asarray(shown)
            mixed = (1 - settings.mix) * _eight_bit(color) + settings.mix * shown
            return np.asarray(np.rint(mixed).astype(np.uint8))

    def _lit(self, camera: Cameras, settings: ViewSettings) -> Rendering:
        return self._rasterized(camera, settings, self._sh, light=self._light(settings))

    def _rasterized(
        self,
        camera: Cameras,
        settings: ViewSettings,
        sh: Float[Tensor, "n k 3"] | None,
        *,
        colors: Float[Tensor, "n 3"] | None = None,
        light: CameraLight | None = None,
    ) -> Rendering:
        behind = self._behind(camera) if settings.one_sided else None
        if behind is None:
            return self._drawn(camera, self._opacities, sh, colors, light)
        # Of opacity 0 they are culled, at less than it takes to copy all others.
        front = self._drawn(camera, torch.where(behind, 0, self._opacities), sh, colors, light)
        back = self._drawn(camera, self._opacities, sh, colors, light, which=behind.nonzero()[:, 0])
        return laid_over(front, back)

    def _behind(self, camera: Cameras) -> Bool[Tensor, "n"] | None:
        """Which Gaussians the camera sees from behind; None where it is none."""
        if self._sides is None:
            return None
        eye = torch.from_numpy(camera.centers[0].astype(np.float32)).to(self.device)
        behind = seen_from_behind(self._means, self._sides, eye)
        return behind if bool(behind.any()) else None

    def _drawn(
        self,
        camera: Cameras,
        opacities: Float[Tensor, "n"],
        sh: Float[Tensor, "n k 3"] | None,
        colors: Float[Tensor, "n 3"] | None,
        light: CameraLight | None,
        *,
        which: Int[Tensor, "m"] | None = None,
    ) -> Rendering:
        """Some of the Gaussians; None draws all."""

        def some(values: Tensor) -> Tensor:
            return values if which is None else values[which]

        return rasterize(
            some(self._means),
            some(self._quats),
            some(self._scales),
            some(opacities),
            None if sh is None else some(sh),
            torch.from_numpy(camera.viewmats.astype(np.float32)).to(self.device),
            torch.from_numpy(camera.K.astype(np.float32)).to(self.device),
            camera.width,
            camera.height,
            colors=None if colors is None else some(colors),
            light=light,
            near=self._near,
            lens=camera.lens,
        )

    @cached_property
    def _near(self) -> float:
        if self.scene.light is not None or not len(self.scene.gaussians):
            return self.scene.near
        depth = self._depth_unit
        # As `Scene.near` has it of the light's reference distance.
        return self.scene.near if depth >= SHALLOWEST else NEAR * depth

    def _light(self, settings: ViewSettings) -> CameraLight | None:
        light = self.scene.light
        zero, one = torch.zeros(()), torch.ones(())
        if light is None:
            if settings.exposure == 1:
                return None
            gain = torch.full((1, 3), settings.exposure)
            made = CameraLight(gain, one, zero, zero, zero, torch.zeros(3), zero, 1.0)
        else:
            if not settings.falloff:
                none = torch.tensor(-math.inf)
                light = replace(
                    light,
                    log_exponent=none,
                    spread=zero,
                    cosine=zero,
                    log_specular=none,
                    log_glare=none.expand(3),
                )
            # What the lens scatters is the lamp's light.
            light = replace(light, log_glare=light.log_glare + torch.tensor(settings.lamp).log())
            made = light.camera_light(torch.tensor([settings.exposure * settings.lamp]))
        moved = {
            name: value.to(self.device) for name, value in vars(made).items() if name != "reference_distance"
        }
        return replace(made, **moved)

    def _unknown(self, camera: Cameras, settings: ViewSettings) -> Float[Tensor, "h w"]:
        rendering = self._rasterized(camera, settings, None, colors=self._lacking)
        # Where the scene holds nothing, nothing is known.
        return rendering.rgb[0, ..., 0] + 1 - rendering.alpha[0]

    @cached_property
    def _lacking(self) -> Float[Tensor, "n 3"]:
        assert self.train is not None
        lacking = unobserved(self.scene, self.train, self.masks)
        return lacking[:, None].expand(-1, 3).contiguous().to(self.device)

    def _nearness(self, camera: Cameras, rendering: Rendering) -> Float[Tensor, "h w"]:
        # One scale for all pictures: colours that follow each picture's own range flicker while it moves.
        depth, alpha = rendering.depth[0], rendering.alpha[0]
        return torch.where(alpha < _HIT, 0.0, self._depth_unit / (self._depth_unit + depth))

    @cached_property
    def _depth_unit(self) -> float:
        start = overview(self.scene, 64) if self.train is None else self.train[0]
        return typical_depth(self.scene, start)


def _eight_bit(values: Float[Tensor, "*shape"]) -> UInt8[np.ndarray, "*shape"]:
    return np.asarray(np.rint(values.clamp(0, 1).cpu().numpy() * 255).astype(np.uint8))


_made: dict[str, np.ndarray] = {}


def _palettes() -> dict[str, UInt8[np.ndarray, "256 3"]]:
    """Colours of the values 0 to 255 of each layer; nothing at all is black."""
    if not _made:
        from matplotlib import colormaps

        share = np.linspace(0, 1, 256)
        for name, colors in (
            ("alpha", np.repeat(share[:, None], 3, axis=1)),
            ("depth", colormaps["turbo"](share)[:, :3]),
            ("uncertainty", colormaps["hot"](share * 0.85)[:, :3]),
        ):
            _made[name] = np.rint(colors * 255).astype(np.uint8)
        _made["depth"][0] = 0
    return _made
