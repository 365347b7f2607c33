"""Texture where nothing was seen: detail of the scene's own frames, laid onto the surface.

The mean of all that could be there is smooth. What tissue looks like close up is known from the frames of
the same scene: tiles of their detail, cut along the surface at one scale in millimetres, are laid onto the
three planes of a world lattice, and a pixel takes the detail of the place of the surface that it shows. A
tile belongs to a place in space, so that all views of it show the same texture, whatever order they are
made in.

Source: tiles that are blended so that their variance stays follow [Heitz2018], see docs/references.md;
projection from three sides is common in graphics.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from functools import cached_property

import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor
from torch.nn import functional

from extrags.cameras import Cameras, pixel_rays
from extrags.metrics.filters import filter_separable, gaussian_weights
from extrags.view_synthesis.filling import completed_depth
from extrags.view_synthesis.references import ReferenceViews
from extrags.view_synthesis.warp import depth_normals

__all__ = ["LaidTexture", "SurfaceTexture", "invented_share"]

TILE_TEXELS = 32
MARGIN_TEXELS = 8
"""Around a tile while it is cut: detail near its border needs to know its surroundings."""
DETAIL_SIGMA = 5.0
"""In texels, and in pixels of a view. Detail is what a Gaussian of this width takes away."""
DETAIL_RADIUS = 12
LATTICE_SPACING = 0.75
"""Distance of neighbouring tiles, relative to a tile's side: the rest overlaps."""
MOST_TILES = 256
MOST_FRAMES = 24
MIN_BRIGHTNESS = 0.1
DARKNESS = 0.05
"""Added to the brightness that detail is relative to: in the dark it is noise."""
MOST_DETAIL = 0.5
"""Relative detail beyond this is a highlight or an edge of depth, not texture."""
MIN_FACING = 0.45
"""Cosine of ray and normal below which a frame shows the wall too flatly."""
FINEST_QUANTILE = 0.2
"""Of the sizes on the surface of the frames' pixels: a texel."""
COARSEST_PIXEL = 1.3
"""In texels. A place whose pixels are larger gives no tile."""
DEPTH_TOLERANCE = 0.12
"""Ratio of depths, as a logarithm, beyond which a pixel shows another surface than the tile's plane."""
SIDE_EXPONENT = 6
"""The three projections are mixed by this power of the normal: rarely more than one counts."""
DEPTH_SIGMA_PX, DEPTH_RADIUS_PX = 2.0, 5
STRENGTH = 0.8
"""Of the frames' contrast: what is laid down wrongly costs less than it would at full contrast."""
UNCONFIRMED_FROM, UNCONFIRMED_TO = 0.2, 0.6
"""Texture sets in where a pixel is this much to be invented, and is complete from the second number on."""
MIP_LEVELS = 4
TILES_AT_ONCE = 64
MIN_SOLID = 0.99
"""Share of a texel's area that must be on the surface."""


@dataclass(frozen=True)
class LaidTexture:
    """Texture that was laid onto the surface that V views show.

    Args:
        change: what it adds to their colours; zero where nothing is invented.
        share: how much of each pixel counts as invented, 0 to 1.
        facing: cosine between a pixel's ray and the normal of the surface, 0 to 1.
        texels: width of a pixel on the surface, in texels.
    """

    change: Float[Tensor, "v 3 h w"]
    share: Float[Tensor, "v 1 h w"]
    facing: Float[Tensor, "v 1 h w"]
    texels: Float[Tensor, "v 1 h w"]


@dataclass(frozen=True)
class SurfaceTexture:
    """Tiles of relative detail on a lattice in space.

    Args:
        tiles: detail over brightness, each of mean zero, [E, 3, T, T].
        texel_mm: side of a texel on the surface, in the unit of the scene.
        seed: which tile lies where.
    """

    tiles: Float[Tensor, "e 3 t t"]
    texel_mm: float
    seed: int = 0

    @classmethod
    def of_references(cls, references: ReferenceViews, *, seed: int = 0) -> SurfaceTexture | None:
        """Cut tiles out of the real views of a scene.

        Args:
            references: its real views.
            seed: which tile will lie where.

        Returns:
            The texture; None where no place is seen closely and evenly enough.
        """
        chosen = np.unique(np.linspace(0, len(references) - 1, MOST_FRAMES).round().astype(np.int64))
        views = references.subset(chosen)
        known = views.packed[:, 5:6]
        if not bool((known > 0).any()):
            return None
        depth = _depth_without_gaps(views.packed[:, 4:5], known)
        places = _places(views, depth, known)
        if len(places.view) == 0:
            return None
        texel_mm = float(places.pixel_mm.quantile(FINEST_QUANTILE))
        tiles = _cut_tiles(
            views, depth, places.subset(places.pixel_mm <= COARSEST_PIXEL * texel_mm), texel_mm
        )
        return None if len(tiles) == 0 else cls(tiles, texel_mm, seed)

    def applied(
        self,
        rgb: Float[Tensor, "v 3 h w"],
        cameras: Cameras,
        depth_mm: Float[Tensor, "v h w"],
        unconfirmed: Float[Tensor, "v h w"],
    ) -> Float[Tensor, "v 3 h w"]:
        """Views with texture where they are invented.

        Args:
            rgb: restored views in [0, 1].
            cameras: of these.
            depth_mm: z-depth without gaps.
            unconfirmed: share of each pixel that is invented.
        """
        return (rgb + self.laid(rgb, cameras, depth_mm, unconfirmed).change).clamp(0, 1)

    def laid(
        self,
        rgb: Float[Tensor, "v 3 h w"],
        cameras: Cameras,
        depth_mm: Float[Tensor, "v h w"],
        unconfirmed: Float[Tensor, "v h w"],
    ) -> LaidTexture:
        """What `applied` adds to views, and how the surface lies that it is laid onto; arguments as there."""
        window = gaussian_weights(DETAIL_SIGMA, DETAIL_RADIUS)
        brightness = filter_separable(rgb, window, window) + DARKNESS
        share = invented_share(unconfirmed)
        changes, facing, texels = [], [], []
        for view in range(len(rgb)):
            surface = _Surface.of_view(cameras[[view]], depth_mm[view], self.texel_mm)
            detail = self._detail(surface, share[view] > 0)
            changes.append(STRENGTH * share[view] * detail * brightness[view])
            facing.append(surface.facing)
            texels.append(surface.texels)
        return LaidTexture(
            torch.stack(changes), share[:, None], torch.stack(facing)[:, None], torch.stack(texels)[:, None]
        )

    def detail(
        self, camera: Cameras, depth_mm: Float[Tensor, "h w"], wanted: Bool[Tensor, "h w"]
    ) -> Float[Tensor, "3 h w"]:
        """Relative detail of the places that one view shows.

        Args:
            camera: of the view.
            depth_mm: z-depth without gaps.
            wanted: where detail is wanted; it is zero elsewhere.
        """
        return self._detail(_Surface.of_view(camera, depth_mm, self.texel_mm), wanted)

    def _detail(self, surface: _Surface, wanted: Bool[Tensor, "h w"]) -> Float[Tensor, "3 h w"]:
        detail = torch.zeros(*wanted.shape, 3)
        detail[wanted] = self._at(surface.points[wanted], surface.normals[wanted], surface.texels[wanted])
        return detail.permute(2, 0, 1)

    def _at(
        self, points: Float[Tensor, "n 3"], normals: Float[Tensor, "n 3"], texels: Float[Tensor, "n"]
    ) -> Float[Tensor, "n 3"]:
        """Detail of places, mixed from the three planes; `texels` is the width of a pixel there."""
        sides = normals.abs().pow(SIDE_EXPONENT)
        sides = sides / sides.sum(-1, keepdim=True).clamp_min(1e-9)
        total, squares = torch.zeros(len(points), 3), torch.zeros(len(points), 1)
        for axis in range(3):
            counts = sides[:, axis] > 0.05
            if not bool(counts.any()):
                continue
            place = points[counts][:, [other for other in range(3) if other != axis]] / self.texel_mm
            value, square = self._on_plane(place, texels[counts], axis)
            share = sides[counts, axis : axis + 1]
            total[counts] += share * value
            squares[counts] += share.square() * square
        # Independent tiles: dividing by the root of the squared weights keeps their variance.
        return total / squares.clamp_min(1e-6).sqrt()

    def _on_plane(
        self, place: Float[Tensor, "n 2"], texels: Float[Tensor, "n"], axis: int
    ) -> tuple[Float[Tensor, "n 3"], Float[Tensor, "n 1"]]:
        """Weighted sum of the tiles that overlap at a place, and the sum of their squared weights."""
        side = self.tiles.shape[-1]
        spacing = LATTICE_SPACING * side
        first = torch.floor(place / spacing - 0.5)
        value, square = torch.zeros(len(place), 3), torch.zeros(len(place), 1)
        for step in ((0, 0), (1, 0), (0, 1), (1, 1)):
            cell = first + torch.tensor(step, dtype=torch.float32)
            local = place - (cell + 0.5) * spacing
            ramp = ((side / 2 - local.abs()) / (side - spacing)).clamp(0, 1)
            weight = (ramp * ramp * (3 - 2 * ramp)).prod(-1, keepdim=True)
            value += weight * self._looked_up(_hashed(cell.long(), axis, self.seed), local, texels)
            square += weight.square()
        return value, square

    def _looked_up(
        self, code: Int[Tensor, "n"], local: Float[Tensor, "n 2"], texels: Float[Tensor, "n"]
    ) -> Float[Tensor, "n 3"]:
        """Detail at a place of the tile that a code names, in one of its eight symmetries."""
        symmetry, tile = code % 8, (code // 8) % len(self.tiles)
        x, y = local.unbind(-1)
        x = torch.where(symmetry % 2 == 1, -x, x)
        y = torch.where((symmetry // 2) % 2 == 1, -y, y)
        x, y = torch.where(symmetry >= 4, y, x), torch.where(symmetry >= 4, x, y)
        level = texels.clamp_min(1e-6).log2().clamp(0, MIP_LEVELS - 1)
        finer = level.floor().long()
        share = (level - finer)[:, None]
        coarser = (finer + 1).clamp(max=MIP_LEVELS - 1)
        return (1 - share) * self._sampled(tile, x, y, finer) + share * self._sampled(tile, x, y, coarser)

    @cached_property
    def _levels(self) -> list[Float[Tensor, "e t t 3"]]:
        """The tiles at falling resolution, so that a far wall does not flicker."""
        levels = [self.tiles]
        for _ in range(1, MIP_LEVELS):
            levels.append(functional.avg_pool2d(levels[-1], 2))
        return [level.permute(0, 2, 3, 1).contiguous() for level in levels]

    def _sampled(
        self,
        tile: Int[Tensor, "n"],
        x: Float[Tensor, "n"],
        y: Float[Tensor, "n"],
        level: Int[Tensor, "n"],
    ) -> Float[Tensor, "n 3"]:
        """Bilinear samples of tiles; x and y count texels of the finest level from a tile's centre."""
        sampled = torch.zeros(len(tile), 3)
        for index, tiles in enumerate(self._levels):
            here = level == index
            if not bool(here.any()):
                continue
            side = tiles.shape[1]
            u, v = (
                (part[here] * side / self.tiles.shape[-1] + side / 2 - 0.5).clamp(0, side - 1)
                for part in (x, y)
            )
            left, top = u.floor().long().clamp(max=side - 2), v.floor().long().clamp(max=side - 2)
            across, down = (u - left)[:, None], (v - top)[:, None]
            texel = (tile[here] * side + top) * side + left
            flat = tiles.reshape(-1, 3)
            upper = (1 - across) * flat[texel] + across * flat[texel + 1]
            lower = (1 - across) * flat[texel + side] + across * flat[texel + side + 1]
            sampled[here] = (1 - down) * upper + down * lower
        return sampled


def invented_share(unconfirmed: Float[Tensor, "*b"]) -> Float[Tensor, "*b"]:
    """How much of a pixel counts as invented, 0 to 1.

    Args:
        unconfirmed: share of each pixel that neither the rendering nor a real view confirms, in [0, 1].
    """
    return ((unconfirmed - UNCONFIRMED_FROM) / (UNCONFIRMED_TO - UNCONFIRMED_FROM)).clamp(0, 1)


@dataclass(frozen=True)
class _Surface:
    """What a view shows of the surface: places, how they lie, and how many texels wide a pixel is there."""

    points: Float[Tensor, "h w 3"]
    normals: Float[Tensor, "h w 3"]
    facing: Float[Tensor, "h w"]
    texels: Float[Tensor, "h w"]

    @classmethod
    def of_view(cls, camera: Cameras, depth_mm: Float[Tensor, "h w"], texel_mm: float) -> _Surface:
        rays = torch.from_numpy(pixel_rays(camera).astype(np.float32))[0]
        normals = depth_normals(rays, _smoothed(depth_mm[None]))
        center = torch.from_numpy(camera.centers.astype(np.float32))[0]
        return cls(
            center + rays * depth_mm[..., None],
            normals,
            (functional.normalize(rays, dim=-1) * normals).sum(-1).abs(),
            depth_mm / float(camera.K[0, 0, 0]) / texel_mm,
        )


def _smoothed(depth_mm: Float[Tensor, "*v h w"]) -> Float[Tensor, "*v h w"]:
    """Depth whose slope is kept up to the border of the image, within the range of each view."""
    window = gaussian_weights(DEPTH_SIGMA_PX, DEPTH_RADIUS_PX)
    least, most = torch.aminmax(depth_mm.flatten(-2), dim=-1)
    fitted = filter_separable(depth_mm, window, window, "linear")
    return torch.minimum(torch.maximum(fitted, least[..., None, None]), most[..., None, None])


@dataclass(frozen=True)
class _Places:
    """Places of the surface that real views show: the view, where, how it lies, how wide a pixel is there."""

    view: Int[Tensor, "n"]
    points: Float[Tensor, "n 3"]
    normals: Float[Tensor, "n 3"]
    pixel_mm: Float[Tensor, "n"]

    def subset(self, index: Bool[Tensor, "n"] | Int[Tensor, "m"]) -> _Places:
        return _Places(self.view[index], self.points[index], self.normals[index], self.pixel_mm[index])


def _depth_without_gaps(
    inverse_depth: Float[Tensor, "r 1 h w"], known: Float[Tensor, "r 1 h w"]
) -> Float[Tensor, "r 1 h w"]:
    depth = torch.where(known > 0, 1 / inverse_depth.clamp_min(1e-9), torch.zeros(()))
    return completed_depth(depth, known, float(depth[known > 0].median()))


def _places(
    views: ReferenceViews, depth: Float[Tensor, "r 1 h w"], known: Float[Tensor, "r 1 h w"]
) -> _Places:
    """Candidates for tiles on a grid of pixels, where the wall is known, trusted and seen face on."""
    rays = torch.from_numpy(pixel_rays(views.cameras).astype(np.float32))
    smooth = _smoothed(depth)
    stride = TILE_TEXELS // 3
    grid = (slice(stride // 2, None, stride), slice(stride // 2, None, stride))
    found = []
    for view in range(len(views)):
        normals = depth_normals(rays[view], smooth[view])[grid]
        direction = functional.normalize(rays[view][grid], dim=-1)
        facing = -(normals * direction).sum(-1)
        normals = torch.where(facing[..., None] < 0, -normals, normals)
        here = smooth[view, 0][grid]
        good = (facing.abs() > MIN_FACING) & (known[view, 0][grid] > 0) & (views.packed[view, 3][grid] > 0.5)
        points = views.centers[view] + rays[view][grid] * here[..., None]
        pixel_mm = (here / views.K[view, 0, 0])[good]
        found.append((torch.full((len(pixel_mm),), view), points[good], normals[good], pixel_mm))
    return _Places(*(torch.cat(part) for part in zip(*found, strict=True)))


def _cut_tiles(
    views: ReferenceViews, depth: Float[Tensor, "r 1 h w"], places: _Places, texel_mm: float
) -> Float[Tensor, "e 3 t t"]:
    """Relative detail of the views around places, seen along the normal, where the wall is nearly plane.

    Of more than `MOST_TILES` places that give a tile, so many evenly spaced ones.
    """
    maps = torch.cat([views.packed[:, :4], depth], dim=1)

    def shown(chosen: _Places) -> Iterator[tuple[Tensor, Tensor]]:
        for view in chosen.view.unique_consecutive().tolist():
            for part in (chosen.view == view).nonzero()[:, 0].split(TILES_AT_ONCE):
                yield _seen_on(_planes(chosen.subset(part), texel_mm), views, maps, view)

    found = [torch.zeros(0, dtype=torch.bool), *(_is_whole(*place) for place in shown(places))]
    whole = torch.cat(found).nonzero()[:, 0]
    if not len(whole):
        return torch.zeros(0, 3, TILE_TEXELS, TILE_TEXELS)
    kept = np.unique(np.linspace(0, len(whole) - 1, MOST_TILES).round().astype(np.int64))
    return torch.cat([_detail_of(*place) for place in shown(places.subset(whole[kept]))])


def _planes(places: _Places, texel_mm: float) -> Float[Tensor, "n s s 3"]:
    """Points of the planes that touch the surface in these places, twice as fine as texels."""
    helper = torch.eye(3)[places.normals.abs().argmin(-1)]
    across = functional.normalize(torch.linalg.cross(places.normals, helper), dim=-1)
    down = torch.linalg.cross(places.normals, across)
    side = TILE_TEXELS + 2 * MARGIN_TEXELS
    # They are averaged later: a texel is an area, not a point.
    steps = ((torch.arange(2 * side) + 0.5) / 2 - side / 2) * texel_mm
    points: Tensor = (
        places.points[:, None, None]
        + steps[None, None, :, None] * across[:, None, None]
        + steps[None, :, None, None] * down[:, None, None]
    )
    return points


def _seen_on(
    plane: Float[Tensor, "n s s 3"],
    views: ReferenceViews,
    maps: Float[Tensor, "r 5 h w"],
    view: int,
) -> tuple[Float[Tensor, "n 3 s2 s2"], Float[Tensor, "n 1 s2 s2"]]:
    """Colours that a view shows at points of planes, and where these are on the surface, at half the size."""
    height, width = maps.shape[-2:]
    pose, K = views.viewmats[view], views.K[view]
    local = torch.einsum("ij,nhwj->nhwi", pose[:3, :3], plane) + pose[:3, 3]
    depth = local[..., 2].clamp_min(1e-6)
    u = local[..., 0] / depth * K[0, 0] + K[0, 2]
    v = local[..., 1] / depth * K[1, 1] + K[1, 2]
    grid = torch.stack([2 * u / width - 1, 2 * v / height - 1], dim=-1)
    # Expanded, not indexed: that would copy the view for each of the planes.
    image = maps[view].expand(len(plane), -1, -1, -1)
    shown = functional.grid_sample(image, grid, mode="bilinear", align_corners=False)
    near = (shown[:, 4].clamp_min(1e-9) / depth).log().abs() < DEPTH_TOLERANCE
    solid = near & (shown[:, 3] > 0.5) & (local[..., 2] > 1e-6)
    return functional.avg_pool2d(shown[:, :3], 2), functional.avg_pool2d(solid[:, None].float(), 2)


def _is_whole(rgb: Float[Tensor, "n 3 s s"], solid: Float[Tensor, "n 1 s s"]) -> Bool[Tensor, "n"]:
    """Which tiles are on the surface, and bright enough."""
    bright = rgb.mean(dim=1, keepdim=True) > MIN_BRIGHTNESS
    return torch.stack(
        [_inner(part.float()).mean(dim=(1, 2, 3)) > 0.95 for part in (solid > MIN_SOLID, bright)]
    ).all(0)


def _detail_of(rgb: Float[Tensor, "n 3 s s"], solid: Float[Tensor, "n 1 s s"]) -> Float[Tensor, "n 3 t t"]:
    """Relative detail of tiles."""
    solid = (solid > MIN_SOLID).float()
    window = gaussian_weights(DETAIL_SIGMA, DETAIL_RADIUS)
    mass = filter_separable(solid, window, window).clamp_min(1e-3)
    low = filter_separable(rgb * solid, window, window) / mass
    detail = _inner((rgb - low) / (low + DARKNESS) * solid).clamp(-MOST_DETAIL, MOST_DETAIL)
    return detail - detail.mean(dim=(2, 3), keepdim=True)


def _inner(maps: Float[Tensor, "n c s s"]) -> Float[Tensor, "n c t t"]:
    """Tiles without their margins."""
    return maps[..., MARGIN_TEXELS:-MARGIN_TEXELS, MARGIN_TEXELS:-MARGIN_TEXELS]


def _hashed(cell: Int[Tensor, "n 2"], axis: int, seed: int) -> Int[Tensor, "n"]:
    """A number for each cell of a plane's lattice that its neighbours say nothing about."""
    mask = 0x7FFFFFFF
    # The seed's product in Python, where a large one does not overflow
    constant = ((axis + 1) * 83492791) ^ ((seed * 2654435761) & mask)
    mixed = (cell[:, 0] * 73856093) ^ (cell[:, 1] * 19349663) ^ constant
    for factor in (0x2C1B3C6D, 0x297A2D39):
        mixed = mixed & mask
        mixed = ((mixed >> 15) ^ mixed) * factor
    mixed = mixed & mask
    return (mixed >> 15) ^ mixed
