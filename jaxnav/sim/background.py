"""Render walls, floor and sky as a moving camera sees them.

Four samples a pixel, more where the picture moves fast. The texture is band-limited to the area
that a pixel covers: a sample reads the level of an image pyramid whose texels have that size.

Source: Williams (1983), "Pyramidal parametrics".
"""

from dataclasses import dataclass

import cv2
import numpy as np
from jaxtyping import Float

from jaxnav.sim.scene import TEXTURE_LEVELS, TEXTURE_SIZE, Scene, Surface
from jaxnav.sim.viewing import BACKGROUND_PX, CELL_PX, MovingCamera

_BAND_PX = 32  # rows shaded at a time: few enough for the processor's cache
_TINY = np.float32(1e-12)


def render_background(scene: Scene, view: MovingCamera) -> Float[np.ndarray, "rows columns"]:
    """Render surfaces and sky: light (H, W) float32."""
    lens = view.lens
    image = np.full((lens.rows, lens.columns), np.float32(scene.sky_grey))
    # The distance is taken as one metre: a wrong guess costs only a little smoothness here.
    blur_px = view.blur_px(1.0)
    groups = int(np.clip(np.ceil(blur_px / 4), 1, 4))
    samples = len(BACKGROUND_PX)
    in_sight = _cells_in_sight(scene.surfaces, view, margin_cells=1 + int(blur_px / CELL_PX))
    for group in range(groups):
        # Every group of samples is spread over the whole exposure, between the others.
        fractions = (np.arange(samples) * groups + group + 0.5) / (samples * groups)
        planes = [
            _Plane.create(surface, cells, view, fractions)
            for surface, cells in zip(scene.surfaces, in_sight, strict=True)
            if cells.any()
        ]
        for top in range(0, lens.rows, _BAND_PX):
            rows = slice(top, min(top + _BAND_PX, lens.rows))
            band = _shade_band(planes, lens.background_rays[rows], rows, scene.sky_grey)
            if band is not None:
                image[rows] += (band - scene.sky_grey) / np.float32(groups)
    return image


def _cells_in_sight(
    surfaces: tuple[Surface, ...], view: MovingCamera, margin_cells: int
) -> list[np.ndarray]:
    """The cells of the image in which each surface may be nearest, (H / 8, W / 8) bool each."""
    lens = view.lens
    nodes_y, nodes_x = lens.nodes_y, lens.nodes_x
    rays = lens.rays[nodes_y][:, :, nodes_x]
    nearness = np.zeros((len(surfaces) + 1, len(nodes_y), len(nodes_x)), np.float32)
    for index, surface in enumerate(surfaces):
        H, height = view.homographies(surface.T_world_surface, np.s_[:], np.zeros(1))
        _, _, _, nearness[index + 1] = meet(surface, H[nodes_y, 0], height[nodes_y, 0], rays)
    nearest = np.argmax(nearness, axis=0) - 1
    kernel = np.ones((2 * margin_cells + 1,) * 2, np.uint8)
    return [
        # A cell belongs to the node at its top left; the margin reaches the other three.
        cv2.dilate((nearest == index).astype(np.uint8), kernel)[:-1, :-1] > 0
        for index in range(len(surfaces))
    ]


@dataclass(frozen=True)
class _Plane:
    """The intersection of one surface with one group of samples of one camera."""

    surface: Surface
    cells: np.ndarray  # (H / 8, W / 8) bool: cells in which the surface may be visible
    H: np.ndarray  # (rows, samples, 3, 3)
    height: np.ndarray  # (rows, samples)
    span: np.ndarray  # (rows, samples): texels that a pixel covers, times (n.r)^2

    @staticmethod
    def create(
        surface: Surface, cells: np.ndarray, view: MovingCamera, fractions: np.ndarray
    ) -> "_Plane":
        H, height = view.homographies(surface.T_world_surface, np.s_[:], fractions - 0.5)
        # A pixel covers |q_z| * angle / (n.r)^2 along the slope; four samples share it. Levels
        # of the pyramid are rounded differently in each sample, which blends them.
        span = np.abs(height) * np.float32(view.lens.pixel_rad / surface.texel_m / 2)
        return _Plane(surface, cells, H, height, span * np.exp2(fractions).astype(np.float32))


def meet(
    surface: Surface,
    H: Float[np.ndarray, "*batch 3 3"],
    height: Float[np.ndarray, "*batch"],
    rays: Float[np.ndarray, "*batch 3 W"],
) -> tuple[
    Float[np.ndarray, "*batch W"],
    Float[np.ndarray, "*batch W"],
    Float[np.ndarray, "*batch W"],
    Float[np.ndarray, "*batch W"],
]:
    """Intersect rays (..., 3, W) with a surface: x, y in m, 1 / n.r, 1 / distance (0: no hit)."""
    hit = H @ rays
    W = hit[..., 2, :]
    inverse = 1 / np.where(np.abs(W) < _TINY, _TINY, W)
    x, y = hit[..., 0, :] * inverse, hit[..., 1, :] * inverse
    nearness = np.maximum(W * (-1 / height[..., None]), 0)
    for bound, beyond, values in zip(
        surface.bounds_m, (np.less, np.greater) * 2, (x, x, y, y), strict=True
    ):
        if np.isfinite(bound):
            nearness[beyond(values, np.float32(bound))] = 0
    return x, y, inverse, nearness


def _shade_band(
    planes: list[_Plane], rays: np.ndarray, rows: slice, sky_grey: float
) -> np.ndarray | None:
    """The mean over one group of samples of a band of rows, (rows, W); None if all is sky."""
    cell_rows = slice(rows.start // CELL_PX, -(-rows.stop // CELL_PX))
    shape = (rays.shape[0], rays.shape[1], rays.shape[3])
    grey, nearest = np.full(shape, np.float32(sky_grey)), np.zeros(shape, np.float32)
    empty = True
    for plane in planes:
        cells = np.flatnonzero(plane.cells[cell_rows].any(axis=0))
        if not len(cells):
            continue
        empty = False
        columns = slice(cells[0] * CELL_PX, (cells[-1] + 1) * CELL_PX)
        x, y, inverse, nearness = meet(
            plane.surface, plane.H[rows], plane.height[rows], rays[..., columns]
        )
        shade = _texture(plane.surface, x, y, plane.span[rows, :, None] * np.square(inverse))
        closer = nearness > nearest[..., columns]
        np.copyto(nearest[..., columns], nearness, where=closer)
        np.copyto(grey[..., columns], shade, where=closer)
    return None if empty else grey.mean(axis=1)


def _texture(
    surface: Surface, x_m: np.ndarray, y_m: np.ndarray, span_texels: np.ndarray
) -> np.ndarray:
    """The grey values of a surface at points on it, without detail finer than a span in texels."""
    tile_m = surface.texel_m * TEXTURE_SIZE
    u = x_m * np.float32(1 / tile_m) + np.float32(surface.offset_m[0] / tile_m)
    v = y_m * np.float32(1 / tile_m) + np.float32(surface.offset_m[1] / tile_m)
    u -= np.floor(u)
    v -= np.floor(v)
    # The exponent of a float is the floor of its binary logarithm: the level, from 127 on.
    exponent = np.clip(span_texels.view(np.int32) >> 23, 127, 126 + TEXTURE_LEVELS)
    size = ((253 + TEXTURE_LEVELS - exponent) << 23).view(np.float32)
    u *= size
    v -= 2
    v *= size
    v += (exponent - (127 - 2 * TEXTURE_SIZE)).astype(np.float32)
    flat = (-1, u.shape[-1])
    value = cv2.remap(surface.atlas, u.reshape(flat), v.reshape(flat), cv2.INTER_LINEAR)
    shade = np.float32(surface.mean_grey) + np.float32(surface.contrast_grey) * value
    return shade.reshape(u.shape)
