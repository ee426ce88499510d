"""Square markers at known places in the world.

Corners are counted top-left, top-right, bottom-right, bottom-left, as a reader of the marker
sees them. The marker frame is x right, y up, z out of the paper towards the reader.
"""

import dataclasses

import equinox as eqx
import jax
import jax.numpy as jnp
import jaxlie
import numpy as np
from jaxtyping import Array, Float

from jaxnav.core.models.geometry import rotation_matrix, transform_points
from jaxnav.core.models.origin import ZERO, Origin

# How many markers each family has. AprilTag's keep AprilTag's names; ArUco's are OpenCV's, in lower
# case without DICT_.
FAMILY_SIZES = {
    "tag16h5": 30,
    "tag25h9": 35,
    "tag36h10": 2320,
    "tag36h11": 587,
    "aruco_original": 1024,
    "aruco_mip_36h12": 250,
} | {f"{bits}x{bits}_{count}": count for bits in (4, 5, 6, 7) for count in (50, 100, 250, 1000)}

CORNER_SIGNS = np.array([[-1, 1, 0], [1, 1, 0], [1, -1, 0], [-1, -1, 0]], float)


def corners_marker_m(size_m: Float[Array, "*batch"]) -> Float[Array, "*batch 4 3"]:
    """Corners of a marker of the given side in its own frame, m."""
    signs = jnp.asarray(CORNER_SIGNS, size_m.dtype)
    return size_m[..., None, None] / 2 * signs.reshape((1,) * size_m.ndim + signs.shape)


def opencv_dictionary_name(family: str) -> str:
    """The name of OpenCV's predefined dictionary of a family, DICT_APRILTAG_36h11 for tag36h11."""
    if family.startswith("tag"):
        return f"DICT_APRILTAG_{family.removeprefix('tag')}"
    return f"DICT_{family.upper()}".replace("MIP_36H12", "MIP_36h12")


class MarkerMap(eqx.Module):
    """M markers: identity, size and pose. The order of the map is the order of every M axis.

    Coordinates in the world, here and in all that computes with the map, count from `origin_m`, a
    place of the files' world near the markers; see `jaxnav.core.models.origin`.
    """

    Ts_world_marker: jaxlie.SE3  # batch axis (M,)
    size_m: Float[Array, " M"]
    ids: tuple[int, ...] = eqx.field(static=True)
    families: tuple[str, ...] = eqx.field(static=True)
    origin_m: Origin = eqx.field(static=True, default=ZERO)

    @property
    def corners_world_m(self) -> Float[Array, "M 4 3"]:
        """Corners (M, 4, 3) of all markers in the world, m."""
        corners = corners_marker_m(self.size_m)
        R = jax.vmap(rotation_matrix)(self.Ts_world_marker.rotation())
        turned = jnp.sum(R[:, None] * corners[:, :, None], axis=3)
        return turned + self.Ts_world_marker.translation()[:, None]

    def nearest_m(self, T_world_vehicle: jaxlie.SE3) -> Float[Array, " 2"]:
        """(x, y), m, in vehicle axes, of the centre of the marker that is nearest on the ground."""
        centers_world_m = self.Ts_world_marker.translation()
        centers_m = transform_points(T_world_vehicle.inverse(), centers_world_m)[:, :2]
        return centers_m[jnp.argmin(jnp.sum(centers_m**2, axis=1))]

    def without_names(self) -> "MarkerMap":
        """The map with the same numbers, its ids counted from 0, no families and `origin_m` zero:
        nothing is computed with them, so that all maps of so many markers share a program."""
        ids = tuple(range(len(self.ids)))
        return dataclasses.replace(self, ids=ids, families=("",) * len(ids), origin_m=ZERO)

    def index(self, marker_id: int, family: str) -> int | None:
        """Index of a marker along the M axis, None if the map lacks it."""
        for index, key in enumerate(zip(self.ids, self.families, strict=True)):
            if key == (marker_id, family):
                return index
        return None
