"""Describe the scene before the simulated cameras: printed markers, textured walls and a floor.

Everything is flat. A `Surface` is a rectangle, or a whole plane, that carries a tileable
texture; a marker is a sheet of paper with a border square of exactly `size_m` and a white
quiet zone of one module. Grey is linear in light: 0 is black, 255 saturates at unit gain.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import lru_cache
from typing import Any

import cv2
import numpy as np
from jaxtyping import Float

from jaxnav.core.models.markers import FAMILY_SIZES, MarkerMap, opencv_dictionary_name
from jaxnav.errors import BadInput

PAPER_GREY, INK_GREY = 215.0, 25.0
QUIET_ZONE_MODULES = 1

# The texture's side in texels; level l of the pyramid has a side of TEXTURE_SIZE / 2**l texels.
TEXTURE_LEVELS = 10
TEXTURE_SIZE = 2 ** (TEXTURE_LEVELS - 1)


@dataclass(frozen=True)
class Surface:
    """A textured part of a plane, opaque from both sides.

    Its frame is x right, y up, z out of the plane towards the viewer, as a marker's.
    """

    T_world_surface: Float[np.ndarray, "4 4"]
    bounds_m: tuple[float, float, float, float]  # x_min, x_max, y_min, y_max in its own frame
    mean_grey: float
    contrast_grey: float  # standard deviation of the texture
    texel_m: float  # the finest structure is about four of them wide
    atlas: Float[np.ndarray, "rows columns"]  # see `texture_atlas`
    offset_m: tuple[float, float] = (0.0, 0.0)


@dataclass(frozen=True)
class Scene:
    """Markers and the surfaces around them. Immutable: create it once."""

    markers: MarkerMap
    surfaces: tuple[Surface, ...]
    # Per marker, grey, row 0 on top.
    sheets: tuple[Float[np.ndarray, "modules modules"], ...]
    sky_grey: float = 165.0

    @staticmethod
    def create(
        markers: MarkerMap,
        walls: Sequence[Surface] | None = None,
        floor: bool = True,
        seed: int = 0,
    ) -> "Scene":
        """A scene around a marker map, the floor being the world's plane z = 0.

        Args:
            markers: the printed markers.
            walls: surfaces; by default a wall behind each marker, `walls_behind`.
            floor: whether there is a tiled floor in the plane z = 0.
            seed: seed of the textures.

        Raises:
            BadInput: a family or an id that OpenCV does not know.
        """
        rng = np.random.default_rng(seed)
        if walls is None:
            walls = walls_behind(markers, floor=floor, atlas=texture_atlas(plaster(rng)))
        surfaces = list(walls)
        if floor:
            whole_plane = (-np.inf, np.inf, -np.inf, np.inf)
            atlas = texture_atlas(tiles(rng))
            surfaces.append(Surface(np.eye(4), whole_plane, 105.0, 14.0, 2.5e-3, atlas))
        sheets = tuple(
            marker_sheet(family, marker_id)
            for family, marker_id in zip(markers.families, markers.ids, strict=True)
        )
        return Scene(markers, tuple(surfaces), sheets)


def walls_behind(
    markers: MarkerMap,
    margin_m: float = 3.0,
    height_m: float = 2.5,
    floor: bool = True,
    atlas: Float[np.ndarray, "rows columns"] | None = None,
) -> list[Surface]:
    """One wall in the plane of each marker; markers in one plane share a wall.

    A wall reaches `margin_m` beyond its markers on both sides, and from the floor up to
    `height_m`. If it would hide another marker, or its marker faces up or down, it is a panel that
    ends 0.1 m beyond the paper; a marker that lies on the floor has no wall.

    Args:
        markers: the printed markers.
        margin_m: how far a wall extends beyond its markers.
        height_m: height of a wall above the floor, or above the marker without a floor.
        floor: whether the walls begin at z = 0.
        atlas: texture of the walls; plaster when left out.
    """
    if atlas is None:
        atlas = texture_atlas(plaster(np.random.default_rng(0)))
    Ts_world_marker = np.asarray(markers.Ts_world_marker.as_matrix(), float)
    sizes_m = np.asarray(markers.size_m, float)
    walls: list[Surface] = []
    for index, T_world_marker in enumerate(Ts_world_marker):
        normal, position = T_world_marker[:3, 2], T_world_marker[:3, 3]
        upright = abs(normal[2]) < 0.9
        if floor and not upright and abs(position[2]) < 0.01:
            continue
        up = np.array([0.0, 0, 1]) if upright else T_world_marker[:3, 1]
        y_axis = up - normal * (normal @ up)
        y_axis /= np.linalg.norm(y_axis)
        T_world_surface = np.eye(4)
        T_world_surface[:3] = np.stack([np.cross(y_axis, normal), y_axis, normal, position], -1)

        paper_m = 0.75 * sizes_m[index] * np.sqrt(2)
        others = Ts_world_marker[:, :3, 3] - position
        hides_another = bool(np.any(others @ normal < -0.02))
        margin = 0.1 if hides_another or not upright else margin_m
        x_min, x_max = -paper_m - margin, paper_m + margin
        y_min, y_max = x_min, x_max
        if upright and floor:
            y_min = min(-position[2] / y_axis[2], -paper_m)
        if upright and not hides_another:
            y_max = max((height_m - floor * position[2]) / y_axis[2], paper_m + 0.1)
        bounds_m = (x_min, x_max, y_min, y_max)

        coplanar = next(
            (i for i, wall in enumerate(walls) if _coplanar(wall, normal, position)), None
        )
        if coplanar is None:
            grain = (0.731 * index, 0.377 * index)
            # A lamp above one corner, so that walls that meet can be distinguished.
            grey = 128 + 14 * float(normal @ [0.6, -0.4, 0.7])
            walls.append(Surface(T_world_surface, bounds_m, grey, 9.0, 4e-3, atlas, grain))
        else:
            walls[coplanar] = _widened(walls[coplanar], position, bounds_m)
    return walls


def _coplanar(wall: Surface, normal: np.ndarray, position: np.ndarray) -> bool:
    T_surface_world = np.linalg.inv(wall.T_world_surface)
    out_of_plane_m = T_surface_world[2, :3] @ position + T_surface_world[2, 3]
    return bool(T_surface_world[2, :3] @ normal > 1 - 1e-6 and abs(out_of_plane_m) < 1e-3)


def _widened(
    wall: Surface, position: np.ndarray, bounds_m: tuple[float, float, float, float]
) -> Surface:
    x, y = (position - wall.T_world_surface[:3, 3]) @ wall.T_world_surface[:3, :2]
    low = np.minimum(wall.bounds_m[::2], (bounds_m[0] + x, bounds_m[2] + y))
    high = np.maximum(wall.bounds_m[1::2], (bounds_m[1] + x, bounds_m[3] + y))
    return replace(wall, bounds_m=(low[0], high[0], low[1], high[1]))


@lru_cache(maxsize=256)
def _black_and_white(family: str, marker_id: int) -> np.ndarray:
    if family not in FAMILY_SIZES:
        raise BadInput("markers", f"unknown family {family!r}: tag36h11, 4x4_50, ... are known")
    name = opencv_dictionary_name(family)
    dictionary = cv2.aruco.getPredefinedDictionary(getattr(cv2.aruco, name))
    count = FAMILY_SIZES[family]
    if not 0 <= marker_id < count:
        raise BadInput("markers", f"family {family} has ids 0 to {count - 1}, not {marker_id}")
    modules = dictionary.markerSize + 2
    return cv2.aruco.generateImageMarker(dictionary, marker_id, modules) > 0


def marker_sheet(family: str, marker_id: int) -> Float[np.ndarray, "modules modules"]:
    """The printed sheet of a marker in grey: one element per module, quiet zone included.

    Args:
        family: tag16h5, tag25h9, tag36h10, tag36h11, or a dictionary of OpenCV's in lower case
            without DICT_, as in 4x4_50 and aruco_original. AprilTags stand as OpenCV draws them.
        marker_id: id within the family.

    Raises:
        BadInput: unknown family or id.
    """
    pattern = np.pad(_black_and_white(family, marker_id), QUIET_ZONE_MODULES, constant_values=True)
    return np.where(pattern, PAPER_GREY, INK_GREY).astype(np.float32)


def plaster(rng: np.random.Generator) -> Float[np.ndarray, "side side"]:
    """A tileable texture of a rough wall: 1 / frequency noise, (TEXTURE_SIZE,) * 2."""
    frequency = _frequency_cycles()
    spectrum = np.fft.fft2(rng.standard_normal((TEXTURE_SIZE, TEXTURE_SIZE)))
    # From half the tile's side down to four texels, the finest that bilinear interpolation keeps.
    band = (frequency >= 2) & (frequency <= TEXTURE_SIZE / 4)
    return np.fft.ifft2(np.where(band, spectrum / np.maximum(frequency, 1), 0)).real


def tiles(rng: np.random.Generator, per_side: int = 4) -> Float[np.ndarray, "side side"]:
    """A tileable texture of square floor tiles with dark joints, each of its own brightness."""
    side = TEXTURE_SIZE // per_side
    tone = np.kron(0.5 * rng.standard_normal((per_side, per_side)), np.ones((side, side)))
    along = np.arange(TEXTURE_SIZE) % side < 4
    tone[along[:, None] | along[None, :]] = -4.0
    grain = plaster(rng)
    sharp = tone + 0.7 * grain / grain.std()
    return np.fft.ifft2(np.fft.fft2(sharp) * _gaussian_response(_frequency_cycles(), 1.0)).real


def texture_atlas(texture: Float[np.ndarray, "side side"]) -> Float[np.ndarray, "rows columns"]:
    """All levels of a texture below one another in one image: zero mean, unit deviation.

    Level l is the texture without the detail that its texels cannot represent. Its texel i is at
    i * 2**l, it has one more row and column that repeat the first, and begins at row
    2 * (TEXTURE_SIZE - TEXTURE_SIZE / 2**l) + l. Float32.
    """
    spectrum = np.fft.fft2((texture - texture.mean()) / texture.std())
    levels = []
    for level in range(TEXTURE_LEVELS):
        sigma_texels = 0.5 * 2**level if level else 0.0
        smooth = np.fft.ifft2(spectrum * _gaussian_response(_frequency_cycles(), sigma_texels)).real
        padded = np.pad(smooth[:: 2**level, :: 2**level], (0, 1), mode="wrap")
        levels.append(np.pad(padded, ((0, 0), (0, TEXTURE_SIZE + 1 - padded.shape[1]))))
    return np.concatenate(levels).astype(np.float32)


def _frequency_cycles() -> np.ndarray:
    axis = np.fft.fftfreq(TEXTURE_SIZE, 1 / TEXTURE_SIZE)
    return np.hypot(axis[:, None], axis[None, :])


def _gaussian_response(frequency_cycles: np.ndarray, sigma_texels: float) -> Any:
    return np.exp(-2 * (np.pi * sigma_texels * frequency_cycles / TEXTURE_SIZE) ** 2)
