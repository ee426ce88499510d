"""Render printed markers, exact to their edges, as a moving camera sees them.

A pixel that may see an edge of the print during its exposure is the mean of 64 samples
(x, y, t), each an exact look-up of the module it falls on, at the pose of its instant; any other
pixel of the paper has a single grey. The samples form a lattice, shifted differently in each pixel,
so that the remaining error (0.6 % of the contrast, RMS) does not add up along an edge.

Source: Cranley and Patterson (1976), "Randomization of number theoretic methods".
"""

from dataclasses import dataclass

import cv2
import numpy as np
from jaxtyping import Float

from jaxnav.sim.background import meet
from jaxnav.sim.scene import QUIET_ZONE_MODULES, Scene, Surface
from jaxnav.sim.viewing import CELL_PX, MovingCamera

# 64 points (x, y, t) of a rank-1 lattice: each coordinate takes each of its 64 values once, and
# so, nearly, do the diagonals. Of all generators this one is best for edges, still and moving.
_SAMPLES = 64
_LATTICE = (1, 19, 41)
_CHUNK = 512  # pixels sampled at a time: few enough for the processor's cache
_AHEAD = np.float32(1e-6)  # the least cosine between a ray and the normal of what it meets


@dataclass(frozen=True)
class Print:
    """A sheet of paper printed with a marker or any other grid of modules."""

    T_world_marker: Float[np.ndarray, "4 4"]
    T_world_sheet: Float[np.ndarray, "4 4"]  # x right, y down, z into the paper, from its top left
    module_m: float
    radius_m: float  # of the paper, from the marker's centre
    sheet: Float[np.ndarray, "rows columns"]  # grey

    @staticmethod
    def centred(
        T_world_marker: Float[np.ndarray, "4 4"],
        module_m: float,
        sheet: Float[np.ndarray, "rows columns"],
    ) -> "Print":
        """The print whose middle is the origin of a marker's or a board's frame."""
        half_height_m, half_width_m = module_m * np.array(sheet.shape) / 2
        T_marker_sheet = np.diag([1.0, -1, -1, 1])
        T_marker_sheet[:2, 3] = -half_width_m, half_height_m
        radius_m = float(np.hypot(half_width_m, half_height_m))
        return Print(T_world_marker, T_world_marker @ T_marker_sheet, module_m, radius_m, sheet)


def prints_of(scene: Scene) -> list[Print]:
    """The prints of a scene's markers, in the map's order."""
    Ts_world_marker = np.asarray(scene.markers.Ts_world_marker.as_matrix(), float)
    sizes_m = np.asarray(scene.markers.size_m, float)
    return [
        Print.centred(T_world_marker, size_m / (len(sheet) - 2 * QUIET_ZONE_MODULES), sheet)
        for T_world_marker, size_m, sheet in zip(
            Ts_world_marker, sizes_m, scene.sheets, strict=True
        )
    ]


def render_print(
    marker: Print,
    surfaces: tuple[Surface, ...],
    view: MovingCamera,
    image: Float[np.ndarray, "rows columns"],
) -> None:
    """Render one marker into an image of light, (H, W) float32, in place."""
    _, position = view.pose_at(np.zeros(()))
    distance_m = float(np.linalg.norm(marker.T_world_marker[:3, 3] - position))
    blur_px = view.blur_px(max(distance_m - marker.radius_m, 0.05))
    # Four instants for each pixel of blur; from 16 px on as many as there are samples.
    count = int(2 ** np.clip(np.ceil(np.log2(max(4 * blur_px, 0.5))), 0, 6))
    instants = (np.arange(count) + 0.5) / count - 0.5
    region = _region_of(marker, view, blur_px)
    if region is not None:
        before = [surface for surface in surfaces if _may_hide(surface, marker, position)]
        _print_region(marker, before, view, image, region, instants)


def _region_of(marker: Print, view: MovingCamera, blur_px: float) -> tuple[slice, slice] | None:
    """The image rows and columns that contain a marker's whole paper; None if out of sight."""
    lens = view.lens
    nodes_y, nodes_x = lens.nodes_y, lens.nodes_x
    R_world_camera, position = view.pose_at(view.row_times_s[nodes_y])
    to_marker = marker.T_world_marker[:3, 3] - position
    distance_m = np.linalg.norm(to_marker, axis=-1)
    direction = np.einsum("nji,nj->ni", R_world_camera, to_marker) / distance_m[:, None]
    cosine = np.einsum("nc,ncx->nx", direction, lens.rays[nodes_y][:, :, nodes_x])
    # A node farther off than the paper, a cell's diagonal and the blur has no paper near it.
    reach_rad = np.arcsin(np.clip(marker.radius_m / distance_m, 0, 1))
    reach_rad = reach_rad + 1.5 * lens.pixel_rad * (1.5 * CELL_PX + blur_px)
    near = cosine > np.cos(np.minimum(reach_rad, np.pi))[:, None]
    rows, columns = np.flatnonzero(near.any(1)), np.flatnonzero(near.any(0))
    if not len(rows):
        return None
    top, left = nodes_y[rows[0]] - CELL_PX, nodes_x[columns[0]] - CELL_PX
    bottom, right = nodes_y[rows[-1]] + CELL_PX, nodes_x[columns[-1]] + CELL_PX
    return (
        slice(max(top, 0), min(bottom, lens.rows)),
        slice(max(left, 0), min(right, lens.columns)),
    )


def _print_region(
    marker: Print,
    before: list[Surface],
    view: MovingCamera,
    image: np.ndarray,
    region: tuple[slice, slice],
    instants: np.ndarray,
) -> None:
    lens, modules = view.lens, np.array(marker.sheet.shape[::-1])[:, None]
    rows, columns = region
    # The sheet's z axis points into the wall: a camera that sees the print has q_z < 0.
    H_middle, height = _to_modules(marker, view, rows, np.zeros(1))
    if not np.any(height < 0):
        return
    H_middle, in_front = H_middle[:, 0], height < 0
    centre = H_middle @ lens.rays[rows, :, columns]
    along_x = H_middle @ lens.rays_dx[rows, :, columns]
    along_y = H_middle @ lens.rays_dy[rows, :, columns]

    # What each pixel covers on the sheet during the exposure: a box in modules.
    ahead = in_front & (centre[:, 2] > _AHEAD)
    W = np.where(ahead, centre[:, 2], 1)[:, None]
    place = centre[:, :2] / W
    reach = sum(np.abs(along[:, :2] - place * along[:, 2:]) / W for along in (along_x, along_y))
    low, high = place - 0.55 * reach, place + 0.55 * reach
    if len(instants) > 1:
        drift_low, drift_high = _drift(marker, view, region, instants)
        low, high = low + drift_low, high + drift_high
    touched = ahead & np.all((high > 0) & (low < modules), axis=1)
    if not touched.any():
        return
    if before:
        touched &= _unhidden(marker, before, view, region)
    low, high = np.floor(low), np.floor(high)
    on_paper = np.all((low >= 0) & (high < modules), axis=1)
    one_module = touched & on_paper & np.all(low == high, axis=1)
    part = image[region]
    column, row = np.moveaxis(low, 1, 0)[:, one_module].astype(int)
    part[one_module] = marker.sheet[row, column]

    edge_rows, edge_columns = np.nonzero(touched & ~one_module)
    H, _ = _to_modules(marker, view, rows, instants)
    H = np.ascontiguousarray(np.moveaxis(H, (2, 3), (0, 1)))
    for start in range(0, len(edge_rows), _CHUNK):
        r, c = edge_rows[start : start + _CHUNK], edge_columns[start : start + _CHUNK]
        pixels = np.stack([c + columns.start, r + rows.start])
        rays = lens.rays[pixels[1], :, pixels[0]].T[:, :, None]
        # (3, N, K); written out because neither matmul nor einsum is fast on matrices so small.
        centres = H[:, 0, r] * rays[0] + H[:, 1, r] * rays[1] + H[:, 2, r] * rays[2]
        light, cover = _sample_edges(
            marker.sheet, pixels, centres, along_x[r, :, c].T, along_y[r, :, c].T
        )
        part[r, c] = part[r, c] * (1 - cover) + light


def _to_modules(
    marker: Print, view: MovingCamera, rows: slice | np.ndarray, instants: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """`MovingCamera.homographies` to coordinates on the sheet in modules."""
    H, height = view.homographies(marker.T_world_sheet, rows, instants)
    H[..., :2, :] /= np.float32(marker.module_m)
    return H, height


def _drift(
    marker: Print, view: MovingCamera, region: tuple[slice, slice], instants: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """The displacement of each pixel's point on the sheet from mid-exposure, in modules.

    Minimum and maximum, (rows, 2, columns) each. Computed on a grid of nodes; a pixel takes the
    extremes of the nodes around it.
    """
    rows, columns = (np.arange(part.start, part.stop) for part in region)
    nodes_y, nodes_x = (np.append(axis[::CELL_PX], axis[-1]) for axis in (rows, columns))
    rays = view.lens.rays[nodes_y][:, None, :, nodes_x]
    H, _ = _to_modules(marker, view, nodes_y, np.append(instants, 0.0))
    hit = np.moveaxis(H @ rays, 1, 0)
    place = hit[:, :, :2] / np.maximum(hit[:, :, 2:], _AHEAD)
    drift = place[:-1] - place[-1]
    around = np.ones((3, 3), np.uint8)
    cell_y, cell_x = (np.arange(len(axis)) // CELL_PX for axis in (rows, columns))
    extremes = []
    for extreme, spread in ((drift.min(axis=0), cv2.erode), (drift.max(axis=0), cv2.dilate)):
        x, y = (spread(np.ascontiguousarray(extreme[:, axis]), around) for axis in (0, 1))
        extremes.append(np.stack([x, y], axis=1)[cell_y][:, :, cell_x])
    return extremes[0], extremes[1]


def _sample_edges(
    sheet: np.ndarray,
    pixels: np.ndarray,
    centre: np.ndarray,
    along_x: np.ndarray,
    along_y: np.ndarray,
) -> tuple[np.ndarray, np.ndarray]:
    """The light of the print and its coverage in N pixels, from 64 samples each.

    Args:
        sheet: (rows, columns) grey.
        pixels: (2, N) column and row, which shift the lattice.
        centre: (3, N, K) homogeneous points on the sheet of the pixels' centres at K instants.
        along_x, along_y: (3, N) the change of those points one pixel to the right and down.

    Returns:
        The light of the print and the fraction of each pixel that the sheet covers, (N,) each.
    """
    samples = np.arange(_SAMPLES)[:, None] * _LATTICE % _SAMPLES
    # Square roots of primes fill the unit square evenly along any line of pixels.
    shift = pixels.T @ np.sqrt([[2, 5], [3, 7]]) % 1
    offsets = ((samples[:, :2] + 0.5) / _SAMPLES).T[:, None].astype(np.float32)
    offsets = offsets + shift.T[:, :, None].astype(np.float32)
    dx, dy = offsets - np.floor(offsets) - np.float32(0.5)
    instant = samples[:, 2] * centre.shape[2] // _SAMPLES
    X, Y, W = (
        centre[i][:, instant] + dx * along_x[i, :, None] + dy * along_y[i, :, None]
        for i in range(3)
    )
    inverse = 1 / np.maximum(W, _AHEAD)
    middle = centre[:, :, centre.shape[2] // 2]
    column, row = (
        _soft_edges(
            place * inverse,
            _change_per_pixel(axis, middle, along_x, along_y),
            sheet.shape[1 - axis],
        )
        for axis, place in enumerate((X, Y))
    )
    # Off the sheet there is neither light nor cover.
    print_and_cover = np.stack([sheet, np.ones_like(sheet)], axis=-1)
    seen = cv2.remap(print_and_cover, column, row, cv2.INTER_LINEAR, None, cv2.BORDER_CONSTANT, 0)
    light, cover = cv2.reduce(seen, 1, cv2.REDUCE_AVG).reshape(-1, 2).T
    return light, cover


def _change_per_pixel(
    axis: int, middle: np.ndarray, along_x: np.ndarray, along_y: np.ndarray
) -> np.ndarray:
    """The norm of the image gradient of one coordinate on the sheet: modules/px, (N,)."""
    W = np.maximum(middle[2], _AHEAD)
    right, down = ((a[axis] - middle[axis] / W * a[2]) / W for a in (along_x, along_y))
    return np.hypot(right, down)


def _soft_edges(modules: np.ndarray, change_per_pixel: np.ndarray, count: int) -> np.ndarray:
    """Coordinates for linear interpolation in the sheet: edges as wide as a sample's cell.

    A sample's cell is 1 / 64 of the pixel. A linear ramp with that cell's standard deviation,
    instead of a step, halves the error of the mean and leaves no direction worse than others.
    """
    sharpness = np.sqrt(_SAMPLES) / np.maximum(change_per_pixel, np.float32(1e-6))
    boundary = np.rint(modules)
    ramp = (modules - boundary) * sharpness[:, None].astype(np.float32)
    np.clip(ramp, -0.5, 0.5, out=ramp)
    boundary += ramp
    # Texel centres of the sheet are its modules' centres; far off the sheet is off the sheet.
    return np.clip(boundary - np.float32(0.5), -2, count + 1)


def _may_hide(surface: Surface, marker: Print, position: np.ndarray) -> bool:
    """Whether the plane of a surface passes between a camera and some of a marker's paper."""
    T = surface.T_world_surface
    signs = np.array([[-1, -1], [-1, 1], [1, 1], [1, -1]]) * marker.radius_m / np.sqrt(2)
    corners = marker.T_world_marker[:3, 3] + signs @ marker.T_world_marker[:3, :2].T
    heights = (corners - T[:3, 3]) @ T[:3, 2]
    side = np.sign((position - T[:3, 3]) @ T[:3, 2])
    # The wall that carries the marker does not.
    return bool(np.any(heights * side < -1e-3))


def _unhidden(
    marker: Print, before: list[Surface], view: MovingCamera, region: tuple[slice, slice]
) -> np.ndarray:
    """The pixels where no surface hides the marker's plane, (rows, columns) bool."""
    rows, columns = region
    rays = view.lens.rays[rows, :, columns]
    H, height = view.homographies(marker.T_world_marker, rows, np.zeros(1))
    own_nearness = np.maximum((H[:, 0] @ rays)[:, 2] * (-1 / height), 0)
    free = np.ones(own_nearness.shape, bool)
    for surface in before:
        H, height = view.homographies(surface.T_world_surface, rows, np.zeros(1))
        _, _, _, nearness = meet(surface, H[:, 0], height[:, 0], rays)
        free &= nearness <= own_nearness
    return free
