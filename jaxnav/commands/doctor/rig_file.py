"""Checks of the rig file: are places, directions and lenses of its cameras plausible?"""

from collections.abc import Iterator

import jax
import jax.numpy as jnp
import jaxlie
import numpy as np
from jaxtyping import Bool, Float

from jaxnav.calibrate.rig.views import Ts_vehicle_camera
from jaxnav.commands.doctor.findings import Finding, found, listed
from jaxnav.core.models.camera import Camera
from jaxnav.core.models.rig import CameraRig

_LEAST_HEIGHT_M, _MOST_HEIGHT_M = 0.01, 2.5
_MOST_DISTANCE_M = 4.0  # from the middle of the vehicle: a van
_SAME_PLACE_M, _SAME_DIRECTION = 0.02, np.cos(np.deg2rad(5))
_MAX_OFF_CENTER = 0.1  # of the image's size
_MAX_ASPECT = 1.05  # fx : fy; pixels are squares
_FIELD_DEG = (20.0, 220.0)  # of lenses that see markers from a vehicle
_LENS_PX = 0.5  # a ray that lands farther than this from its pixel belongs to another one
_ALONG = 64  # pixels from the centre to each corner of the image
_FAR_M = 1e6
_SAME_RAY = 1e-3  # between a ray and the ray of its pixel, where the lens is one-to-one


def rig_file(rig: CameraRig) -> Iterator[Finding]:
    """Run all checks of a rig that was loaded from a file."""
    yield found("rig.cameras", count=len(rig), names=listed(rig.names))
    yield from places(rig)
    yield from lenses(rig)
    yield from bearings(rig)


def places(rig: CameraRig) -> Iterator[Finding]:
    """Check where the cameras are and how they are turned."""
    T = Ts_vehicle_camera(rig)
    for name, position_m, R in zip(rig.names, T[:, :3, 3], T[:, :3, :3], strict=True):
        height_m, distance_m = position_m[2], np.hypot(*position_m[:2])
        if not _LEAST_HEIGHT_M < height_m < _MOST_HEIGHT_M:
            level = "error" if height_m <= 0 else None
            yield found("rig.height", level, camera=name, height_m=height_m)
        elif distance_m > _MOST_DISTANCE_M:
            yield found("rig.far", camera=name, distance_m=distance_m)
        else:
            yaw_deg, elevation_deg = np.rad2deg(
                [np.arctan2(R[1, 2], R[0, 2]), np.arcsin(np.clip(R[2, 2], -1, 1))]
            )
            yield found(
                "rig.place", camera=name, height_m=height_m, yaw_deg=round(yaw_deg),
                elevation_deg=round(elevation_deg),
            )  # fmt: skip
        if R[2, 1] > 0:
            yield found("rig.upside_down", camera=name)
    for i in range(len(rig)):
        for j in range(i):
            near = np.linalg.norm(T[i, :3, 3] - T[j, :3, 3]) < _SAME_PLACE_M
            if near and T[i, :3, 2] @ T[j, :3, 2] > _SAME_DIRECTION:
                yield found("rig.copied", one=rig.names[j], other=rig.names[i])


def lenses(rig: CameraRig) -> Iterator[Finding]:
    """Check principal points, focal lengths and fields of view against the size of the images, and
    that every pixel belongs to one ray: lens models may fold back before the corners."""
    sizes_px = np.array(rig.image_sizes_px, float)
    centers_px, focals_px = np.asarray(rig.cameras.center_px), np.asarray(rig.cameras.focal_px)
    ends_px = (sizes_px - 1)[:, None] * np.array([[0, 0], [1, 0], [1, 1], [0, 1]])
    share = np.arange(1, _ALONG + 1)[:, None, None] / _ALONG
    centers = centers_px[:, None]
    diagonals_px = centers[:, None] + share * (ends_px - centers)[:, None]
    edges_px = ends_px[:, :2].copy()
    edges_px[..., 1] = centers_px[:, 1:]
    pixels = np.concatenate([edges_px, diagonals_px.reshape(len(rig), -1, 2)], axis=1)
    rays, error_px = jax.device_get(_through_lens(rig.cameras, jnp.asarray(pixels, float)))
    fields_deg = np.rad2deg(np.arccos(np.clip(rays[:, :2, 2], -1, 1)).sum(axis=1))
    good = (error_px[:, 2:] < _LENS_PX).reshape(len(rig), _ALONG, 4)
    reach = np.cumprod(good, axis=1).sum(axis=1).min(axis=1) / _ALONG
    for name, size_px, center, focal, field_deg, part in zip(
        rig.names, sizes_px, centers_px, focals_px, fields_deg, reach, strict=True
    ):
        off = np.abs(center - (size_px - 1) / 2) / size_px
        figures = {
            "camera": name, "x_px": center[0], "y_px": center[1], "fx": focal[0], "fy": focal[1],
            "field_deg": field_deg, "width": round(size_px[0]), "height": round(size_px[1]),
            "calibrated_width": 2 * center[0] + 1, "calibrated_height": 2 * center[1] + 1,
        }  # fmt: skip
        if off.max() > _MAX_OFF_CENTER:
            outside = bool(np.any((center < 0) | (center > size_px - 1)))
            yield found("rig.off_center", "error" if outside else None, **figures)
        if max(focal) > _MAX_ASPECT * min(focal):
            yield found("rig.aspect", **figures)
        if not _FIELD_DEG[0] < field_deg < _FIELD_DEG[1]:
            yield found("rig.field", **figures)
        elif off.max() <= _MAX_OFF_CENTER:
            yield found("rig.lens", **figures)
        if part < 1:
            yield found("rig.folds", "error" if part < 0.5 else None, camera=name, reach=part)
    if np.all(reach == 1):
        yield found("rig.unfolded")


@jax.jit
def _through_lens(
    cameras: Camera, pixels: Float[jax.Array, "C N 2"]
) -> tuple[Float[jax.Array, "C N 3"], Float[jax.Array, "C N"]]:
    """Unit rays of pixels, and how far from its pixel the lens model projects each, px: next to
    nothing where it can be inverted."""

    def one(camera: Camera, pixels: jax.Array) -> tuple[jax.Array, jax.Array]:
        rays = camera.unproject(pixels)
        return rays, jnp.linalg.norm(camera.project(rays) - pixels, axis=-1)

    return jax.vmap(one)(cameras, pixels)


def bearings(rig: CameraRig) -> Iterator[Finding]:
    """Report the bearings on the horizon at which a far marker is seen by no or by two cameras."""
    radians = np.deg2rad(np.arange(360))
    horizon = np.stack([np.cos(radians), np.sin(radians), np.zeros(360)], axis=1)
    count = np.asarray(_sees_directions(rig, jnp.asarray(horizon, float))).sum(axis=0)
    if count.all():
        yield found("rig.all_round", twice=int((count > 1).sum()))
        return
    blind = listed(f"{begin} to {end} deg" for begin, end in spans(count == 0))
    level = None if count.any() else "error"
    yield found("rig.blind", level, bearings=blind, count=int((count == 0).sum()))


@jax.jit
def _sees_directions(
    rig: CameraRig, directions_vehicle: Float[jax.Array, "N 3"]
) -> Bool[jax.Array, "C N"]:
    """Which cameras see far objects in unit directions of the vehicle."""
    there, far_m = jaxlie.SE3.identity(), _FAR_M * directions_vehicle

    def again(camera: Camera, T_camera_vehicle: jaxlie.SE3, pixels: jax.Array) -> jax.Array:
        rays = jax.vmap(T_camera_vehicle.rotation().apply)(directions_vehicle)
        return jnp.linalg.norm(camera.unproject(pixels) - rays, axis=-1) < _SAME_RAY

    # A lens that folds sends rays from far outside into the image again.
    same = jax.vmap(again)(rig.cameras, rig.Ts_camera_vehicle, rig.project(there, far_m))
    return rig.sees(there, far_m) & same


def spans(bearings: Bool[np.ndarray, " 360"]) -> list[tuple[int, int]]:
    """Runs of True on the circle: the first and last whole degree of each, in (-180, 180].

    Args:
        bearings: (360,) bool, one for each degree from 0 on.
    """
    if bearings.all():
        return [(-179, 180)]
    begins = np.flatnonzero(bearings & ~np.roll(bearings, 1))
    ends = np.flatnonzero(bearings & ~np.roll(bearings, -1))
    if len(begins) and ends[0] < begins[0]:
        ends = np.roll(ends, -1)
    wrapped = (np.stack([begins, ends], axis=1) + 179) % 360 - 179
    return sorted((int(begin), int(end)) for begin, end in wrapped)
