"""One camera: a pinhole behind a lens.

Pixel (0, 0) is the centre of the top-left pixel. The camera frame is x right, y down, z
forward. Three lenses, in the conventions of OpenCV and Kalibr:

    none         no distortion
    radtan       k1 k2 p1 p2 k3 (Brown 1966; OpenCV's order)
    equidistant  k1 k2 k3 k4    (Kannala and Brandt 2006; OpenCV's fisheye)
"""

from collections.abc import Callable, Sequence

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from jaxnav.models.geometry import on_last_axis, safe_norm

LENSES = ("none", "radtan", "equidistant")
LENS_COEFFICIENTS = {"none": 0, "radtan": 5, "equidistant": 4}

# Points nearer to the camera's plane than this multiple of their distance are projected as
# if they lay there: finite and far outside of any image instead of infinite or mirrored.
MIN_DEPTH_RATIO = 1e-3
# Where an inverse lens starts: 96 angles from the axis, up to 89 (radtan) or 180 degrees.
_TABLE_SIZE = 96
_NEWTON_STEPS = 4


class Camera(eqx.Module):
    """Intrinsic parameters of one camera, or of several with a leading axis.

    Several cameras share one `lenses` tuple; each says with `lens_index` which one is its own,
    so a rig may mix lenses and costs nothing extra when it does not.
    """

    focal_px: Float[Array, "*batch 2"]  # fx fy
    center_px: Float[Array, "*batch 2"]  # cx cy
    distortion: Float[Array, "*batch 5"]  # as the lens counts them, zero-padded
    lens_index: Int[Array, "*batch"]
    lenses: tuple[str, ...] = eqx.field(static=True)

    @staticmethod
    def create(
        focal_px: Sequence[float],
        center_px: Sequence[float],
        lens: str = "none",
        distortion: Sequence[float] = (),
    ) -> "Camera":
        """One camera from plain numbers.

        Args:
            focal_px: fx, fy in pixels.
            center_px: cx, cy in pixels.
            lens: "none", "radtan" or "equidistant".
            distortion: the lens's coefficients; missing ones are zero.

        Raises:
            ValueError: unknown lens or too many coefficients.
        """
        if lens not in LENSES:
            raise ValueError(f"unknown lens {lens!r}: expected one of {', '.join(LENSES)}")
        if len(distortion) > LENS_COEFFICIENTS[lens]:
            raise ValueError(
                f"lens {lens!r} has at most {LENS_COEFFICIENTS[lens]} coefficients, "
                f"got {len(distortion)}"
            )
        padded = list(distortion) + [0.0] * (5 - len(distortion))
        return Camera(
            focal_px=jnp.asarray(focal_px, float),
            center_px=jnp.asarray(center_px, float),
            distortion=jnp.asarray(padded, float),
            lens_index=jnp.asarray(0),
            lenses=(lens,),
        )

    @property
    def K(self) -> Float[Array, "*batch 3 3"]:
        """The pinhole matrix."""
        (fx, fy), (cx, cy) = jnp.moveaxis(self.focal_px, -1, 0), jnp.moveaxis(self.center_px, -1, 0)
        zero, one = jnp.zeros_like(fx), jnp.ones_like(fx)
        rows = [[fx, zero, cx], [zero, fy, cy], [zero, zero, one]]
        return jnp.stack([jnp.stack(row, axis=-1) for row in rows], axis=-2)

    def project(self, points_camera: Float[Array, "*batch 3"]) -> Float[Array, "*batch 2"]:
        """Pixels of points in the camera frame (m). Of one camera; vmap over several.

        Finite everywhere. Behind a `none` or `radtan` camera the result is a far-away
        pixel on the right side of the image; `in_front` tells whether it means anything.

        Source: Liu, Schofield, Shan (2023), Eq. 1; lenses as in the module's docstring.
        """
        distorted = self._select(
            [_DISTORT[lens](points_camera, self.distortion) for lens in self.lenses]
        )
        focal_px, center_px = (
            on_last_axis(pair, distorted) for pair in (self.focal_px, self.center_px)
        )
        return distorted * focal_px + center_px

    def unproject(self, pixels: Float[Array, "*batch 2"]) -> Float[Array, "*batch 3"]:
        """Unit vectors in the camera frame through the given pixels. Of one camera.

        Converges wherever the lens is one-to-one, starting at the axis; a pixel that no ray
        reaches gets the outermost ray in its direction (project it to notice). The
        derivative is that of the exact inverse.
        """
        focal_px, center_px = (
            on_last_axis(pair, pixels) for pair in (self.focal_px, self.center_px)
        )
        normalised = (pixels - center_px) / focal_px
        return self._select([_UNDISTORT[lens](normalised, self.distortion) for lens in self.lenses])

    def in_front(self, points_camera: Float[Array, "*batch 3"]) -> Array:
        """Whether a point can be seen through this lens at all, (*batch) bool."""
        depth_ratio = points_camera[..., 2] / jnp.maximum(safe_norm(points_camera), 1e-12)
        return self._select(
            [depth_ratio > (-0.99 if lens == "equidistant" else MIN_DEPTH_RATIO)
             for lens in self.lenses]
        )  # fmt: skip

    def _select(self, per_lens: list[Array]) -> Array:
        if len(per_lens) == 1:
            return per_lens[0]
        return jnp.stack(per_lens)[self.lens_index]


def stack_cameras(cameras: Sequence[Camera]) -> Camera:
    """Cameras with a leading axis, sharing the set of lenses that occur."""
    lenses = tuple(sorted({lens for camera in cameras for lens in camera.lenses}))
    return Camera(
        focal_px=jnp.stack([camera.focal_px for camera in cameras]),
        center_px=jnp.stack([camera.center_px for camera in cameras]),
        distortion=jnp.stack([camera.distortion for camera in cameras]),
        lens_index=jnp.asarray(
            [lenses.index(camera.lenses[int(camera.lens_index)]) for camera in cameras]
        ),
        lenses=lenses,
    )


def _pinhole(points: Array, distortion: Array) -> Array:
    del distortion
    depth = points[..., 2:]
    # The gradient of the clamp may vanish; that of a division by zero may not.
    nearest = MIN_DEPTH_RATIO * jnp.maximum(safe_norm(points)[..., None], 1e-12)
    return points[..., :2] / jnp.maximum(depth, nearest)


def _radtan(points: Array, distortion: Array) -> Array:
    return _radtan_distort(_pinhole(points, distortion), distortion)


def _radtan_distort(xy: Array, distortion: Array) -> Array:
    _, _, p1, p2, _ = distortion
    x, y = xy[..., 0], xy[..., 1]
    r2 = x**2 + y**2
    radial = _radtan_gain(distortion)(r2)
    return jnp.stack(
        [
            x * radial + 2 * p1 * x * y + p2 * (r2 + 2 * x**2),
            y * radial + p1 * (r2 + 2 * y**2) + 2 * p2 * x * y,
        ],
        axis=-1,
    )


def _radtan_gain(distortion: Array) -> Callable[[Array], Array]:
    k1, k2, _, _, k3 = distortion
    return lambda r2: 1 + r2 * (k1 + r2 * (k2 + r2 * k3))


def _equidistant(points: Array, distortion: Array) -> Array:
    radius = safe_norm(points[..., :2])
    theta = jnp.arctan2(radius, jnp.where(radius > 0, points[..., 2], 1))
    gain = _equidistant_gain(distortion)(theta)
    # theta / radius, which tends to 1 / z on the axis
    off_axis = radius > 1e-7 * jnp.abs(points[..., 2])
    safe_depth = jnp.where(off_axis, 1, jnp.where(points[..., 2] > 0, points[..., 2], 1))
    ratio = jnp.where(off_axis, theta / jnp.where(off_axis, radius, 1), 1 / safe_depth)
    return points[..., :2] * (ratio * gain)[..., None]


def _equidistant_gain(distortion: Array) -> Callable[[Array], Array]:
    k1, k2, k3, k4, _ = distortion

    def gain(theta: Array) -> Array:
        t2 = theta**2
        return 1 + t2 * (k1 + t2 * (k2 + t2 * (k3 + t2 * k4)))

    return gain


def _bearing(xy: Array) -> Array:
    ray = jnp.concatenate([xy, jnp.ones_like(xy[..., :1])], axis=-1)
    return ray / jnp.sqrt(jnp.sum(ray**2, axis=-1, keepdims=True))


def _pinhole_bearing(xy: Array, distortion: Array) -> Array:
    del distortion
    return _bearing(xy)


def _radtan_bearing(xy_distorted: Array, distortion: Array) -> Array:
    radius_distorted = safe_norm(xy_distorted)
    table = np.tan(np.linspace(0, np.deg2rad(89), _TABLE_SIZE))
    gain = _radtan_gain(distortion)
    radius = _invert(lambda r: r * gain(r**2), radius_distorted, table)
    safe = jnp.where(radius_distorted > 0, radius_distorted, 1)
    start = xy_distorted * jnp.where(radius_distorted > 0, radius / safe, 1)[..., None]

    def newton(xy: Array) -> Array:
        # Columns of the Jacobian by forward mode; the tangential terms only bend the start a
        # little, so a long step means that there is no such ray.
        value, along_x = jax.jvp(
            lambda p: _radtan_distort(p, distortion), (xy,), (jnp.zeros_like(xy).at[..., 0].set(1),)
        )
        _, along_y = jax.jvp(
            lambda p: _radtan_distort(p, distortion), (xy,), (jnp.zeros_like(xy).at[..., 1].set(1),)
        )
        (a, c), (b, d) = jnp.moveaxis(along_x, -1, 0), jnp.moveaxis(along_y, -1, 0)
        residual_x, residual_y = jnp.moveaxis(value - xy_distorted, -1, 0)
        determinant = a * d - b * c
        inverse = jnp.where(
            determinant > 1e-6, 1 / jnp.where(determinant > 1e-6, determinant, 1), 0
        )
        step = jnp.stack(
            [d * residual_x - b * residual_y, a * residual_y - c * residual_x], axis=-1
        )
        step = step * inverse[..., None]
        reachable = safe_norm(step) < 0.2 * (1 + safe_norm(xy))
        return jnp.where(reachable[..., None], xy - step, xy)

    xy = start
    for _ in range(_NEWTON_STEPS):
        xy = newton(xy)
    return _bearing(newton(jax.lax.stop_gradient(xy)))


def _equidistant_bearing(xy_distorted: Array, distortion: Array) -> Array:
    theta_distorted = safe_norm(xy_distorted)
    table = np.linspace(0, np.pi, _TABLE_SIZE)
    gain = _equidistant_gain(distortion)
    theta = _invert(lambda t: t * gain(t), theta_distorted, table)
    # sin(theta) / theta_distorted, which tends to 1 on the axis
    off_axis = theta_distorted > 1e-7
    ratio = jnp.where(off_axis, jnp.sin(theta) / jnp.where(off_axis, theta_distorted, 1), 1)
    return jnp.concatenate([xy_distorted * ratio[..., None], jnp.cos(theta)[..., None]], axis=-1)


def _invert(profile: Callable[[Array], Array], target: Array, table: np.ndarray) -> Array:
    """The smallest x >= 0 with profile(x) = target: table look-up, then Newton in its cell.

    The table ends where the profile stops rising, which is as far as the lens is one-to-one.
    The last Newton step alone carries the gradient, and it is the implicit one.
    """
    grid = jnp.asarray(table, target.dtype)
    values = profile(grid)
    rising = jnp.concatenate([jnp.ones(1, bool), jnp.cumprod(jnp.diff(values) > 0).astype(bool)])
    last = jnp.sum(rising) - 1
    reached = on_last_axis(values, target[..., None]) <= target[..., None]
    below = jnp.sum(on_last_axis(rising, reached) & reached, axis=-1) - 1
    cell = jnp.clip(below, 0, jnp.maximum(last - 1, 0))
    low, high = grid[cell], grid[jnp.minimum(cell + 1, last)]
    value_low, value_high = values[cell], values[jnp.minimum(cell + 1, last)]
    span = jnp.where(value_high > value_low, value_high - value_low, 1)
    x = low + (high - low) * jnp.clip((target - value_low) / span, 0, 1)

    def newton(x: Array) -> Array:
        value, slope = jax.jvp(profile, (x,), (jnp.ones_like(x),))
        return x - (value - target) / jnp.where(slope > 1e-6, slope, 1)

    for _ in range(_NEWTON_STEPS):
        x = jnp.clip(newton(x), low, high)
    x = jax.lax.stop_gradient(x)
    inside = (target >= value_low) & (target <= value_high)
    return jnp.where(inside, newton(x), x)


_DISTORT = {"none": _pinhole, "radtan": _radtan, "equidistant": _equidistant}
_UNDISTORT = {
    "none": _pinhole_bearing,
    "radtan": _radtan_bearing,
    "equidistant": _equidistant_bearing,
}
