"""One camera: a pinhole behind a lens.

Pixel (0, 0) is the centre of the top-left pixel. The camera frame is x right, y down, z
forward. The lenses are the rows of `jaxnav.core.models.lenses.LENSES`, in the conventions of OpenCV
(`rational` is ROS's rational_polynomial) and Kalibr.
"""

from collections.abc import Sequence

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from jaxnav.core.models.geometry import on_last_axis
from jaxnav.core.models.lenses import LENSES, MOST_COEFFICIENTS, bearing_of, can_be_seen, image_of

LENS_COEFFICIENTS = {name: len(lens.coefficients) for name, lens in LENSES.items()}


class Camera(eqx.Module):
    """Intrinsic parameters of one camera, or of several with a leading axis.

    Several cameras share one `lenses` tuple; `lens_index` selects the lens of each, so a rig may
    mix lenses. A rig of one lens costs nothing extra.
    """

    focal_px: Float[Array, "*batch 2"]  # fx fy
    center_px: Float[Array, "*batch 2"]  # cx cy
    distortion: Float[Array, "*batch 12"]  # in the order of the lens, zero-padded
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
            lens: a name of `jaxnav.core.models.lenses.LENSES`.
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
        padded = list(distortion) + [0.0] * (MOST_COEFFICIENTS - len(distortion))
        return Camera(
            focal_px=jnp.asarray(focal_px, float),
            center_px=jnp.asarray(center_px, float),
            distortion=jnp.asarray(padded, float),
            lens_index=jnp.asarray(0),
            lenses=(lens,),
        )

    @property
    def K(self) -> Float[Array, "*batch 3 3"]:
        """The pinhole matrix [fx, 0, cx; 0, fy, cy; 0, 0, 1], px."""
        (fx, fy), (cx, cy) = jnp.moveaxis(self.focal_px, -1, 0), jnp.moveaxis(self.center_px, -1, 0)
        zero, one = jnp.zeros_like(fx), jnp.ones_like(fx)
        rows = [[fx, zero, cx], [zero, fy, cy], [zero, zero, one]]
        return jnp.stack([jnp.stack(row, axis=-1) for row in rows], axis=-2)

    @property
    def axis_px(self) -> Float[Array, "2"]:
        """Pixels a radian on the axis, along x and y, for one camera; vmap over several.

        They are fx and fy, but for a lens with xi, whose files have 1 + xi times as much.
        """
        one = jnp.ones_like(self.focal_px)
        xi = self.distortion[0]  # where the lens has one
        times = [1 + xi if "xi" in LENSES[lens].coefficients else 1 for lens in self.lenses]
        return self.focal_px / self._select([one * factor for factor in times])

    def project(self, points_camera: Float[Array, "*batch 3"]) -> Float[Array, "*batch 2"]:
        """Pixels of points in the camera frame, m, for one camera; vmap over several.

            u = f * lens(p) + c                                                      (Eq. 1)

        The result is finite everywhere. Behind a camera whose lens does not see backwards it is
        a far-away pixel in the direction of the point; `in_front` tells which points can be seen.

        Source: Liu, Schofield, Shan (2023), Eq. 1; for the lenses see `lenses.py`.
        """
        return self.project_with_slope(points_camera)[0]

    def project_with_slope(
        self, points_camera: Float[Array, "*batch 3"]
    ) -> tuple[Float[Array, "*batch 2"], Float[Array, "*batch 2 3"]]:
        """`project`, and its derivative (..., 2, 3) by the point, px per m."""
        points = jnp.moveaxis(points_camera, -1, 0)
        images, slopes = zip(
            *(image_of(lens, points, self.distortion) for lens in self.lenses), strict=True
        )
        image = self._select([jnp.moveaxis(image, 0, -1) for image in images])
        slope = self._select([jnp.moveaxis(slope, (0, 1), (-1, -2)) for slope in slopes])
        focal_px, center_px = (
            on_last_axis(pair, image) for pair in (self.focal_px, self.center_px)
        )
        return image * focal_px + center_px, slope * focal_px[..., None]

    def unproject(self, pixels: Float[Array, "*batch 2"]) -> Float[Array, "*batch 3"]:
        """Unit vectors in the camera frame through the given pixels, for one camera.

        It converges wherever the lens is one-to-one, starting at the axis; a pixel that no ray
        reaches gets the outermost ray in its direction, whose projection differs from it. The
        derivative is that of the exact inverse.
        """
        focal_px, center_px = (
            on_last_axis(pair, pixels) for pair in (self.focal_px, self.center_px)
        )
        normalised = (pixels - center_px) / focal_px
        return self._select([bearing_of(lens, normalised, self.distortion) for lens in self.lenses])

    def in_front(self, points_camera: Float[Array, "*batch 3"]) -> Bool[Array, "*batch"]:
        """Whether a point lies before the lens and before it folds: `unproject` finds its ray."""
        points = jnp.moveaxis(points_camera, -1, 0)
        return self._select([can_be_seen(lens, points, self.distortion) for lens in self.lenses])

    def _select(self, per_lens: list[Array]) -> Array:
        if len(per_lens) == 1:
            return per_lens[0]
        return jnp.stack(per_lens)[self.lens_index]


def stack_cameras(cameras: Sequence[Camera]) -> Camera:
    """Cameras stacked along a leading axis, with one tuple of all their lenses."""
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
