"""Coordinates near zero for maps that are far from it, so that float32 holds them.

float32 has 7 digits: it resolves 0.06 mm at 1 km from zero, 8 mm at 100 km, half a metre at
5 000 km (UTM). So coordinates of a `MarkerMap`, and of waypoints, beliefs, outputs and simulated
cars, count from its `origin_m`, a round place near its markers. Files and people count from the
world's zero in float64. The functions here convert one to the other:

    route = route.relative_to(markers.origin_m)                  # on the way in
    x_m, y_m, psi_rad = planar_in_world(out.pose, markers.origin_m)   # on the way out

The axes are the same, and so are angles, velocities and covariances. At the zero origin, that of
every map within `NEAR_M`, values are returned as they are.
"""

from typing import Any

import numpy as np
from jaxtyping import Float

Origin = tuple[float, float, float]  # x_m, y_m, z_m in the world

ZERO: Origin = (0.0, 0.0, 0.0)
# float32's spacing there, 0.06 mm, is a thirtieth of the position error of the best drives.
NEAR_M = 1000.0
# Round for a reader, and near: coordinates then stay below 50 m plus the map's own size.
GRID_M = 100.0


def origin_near(positions_m: Float[np.ndarray, "N 3"]) -> Origin:
    """The origin for places (N, 3): on each axis zero within `NEAR_M`, else a multiple of `GRID_M`.

    A car's ground, z = 0 of its coordinates, is thus at the origin's z.
    """
    middle_m = np.mean(np.asarray(positions_m, float), axis=0)
    rounded_m = GRID_M * np.round(middle_m / GRID_M)
    x_m, y_m, z_m = np.where(np.abs(middle_m) > NEAR_M, rounded_m, 0.0).tolist()
    return x_m, y_m, z_m


def points_in_world(points_m: Any, origin_m: Origin) -> Any:
    """Points (..., 2) or (..., 3) of a map's coordinates in the world's, float64."""
    if origin_m == ZERO:
        return points_m
    points = np.asarray(points_m, float)
    return points + np.array(origin_m)[: points.shape[-1]]


def planar_in_world(poses: Any, origin_m: Origin) -> Any:
    """Planar poses (..., 3), x_m y_m psi_rad, of a map's coordinates in the world's, float64."""
    return _shifted(poses, (*origin_m[:2], 0.0))


def poses_in_world(Ts_map_body: Any, origin_m: Origin) -> Any:
    """Poses (..., 7), wxyz_xyz, of a map's coordinates in the world's, float64."""
    return _shifted(Ts_map_body, (0.0, 0.0, 0.0, 0.0, *origin_m))


def inverses_in_world(Ts_body_map: Any, origin_m: Origin) -> Any:
    """Poses `T_body_map` (..., 7), wxyz_xyz, converted to `T_body_world`, float64.

    The quaternions are normalised to float64's last digit, since the distance of the origin
    multiplies their error.
    """
    if origin_m == ZERO:
        return Ts_body_map
    Ts = np.array(Ts_body_map, float)
    Ts[..., :4] /= np.linalg.norm(Ts[..., :4], axis=-1, keepdims=True)
    # The translation less the rotated origin; q = (w, q) rotates p to p + 2 q x (q x p + w p).
    w, q = Ts[..., :1], Ts[..., 1:4]
    origin = np.broadcast_to(np.array(origin_m), q.shape)
    Ts[..., 4:] -= origin + 2 * np.cross(q, np.cross(q, origin) + w * origin)
    return Ts


def opposite(origin_m: Origin) -> Origin:
    """The origin for the inverse conversion, from the world's coordinates to the map's."""
    x_m, y_m, z_m = origin_m
    return (-x_m, -y_m, -z_m) if origin_m != ZERO else ZERO


def _shifted(values: Any, shift: tuple[float, ...]) -> Any:
    return values if not any(shift) else np.asarray(values, float) + np.array(shift)
