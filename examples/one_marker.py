"""One square marker, four corners, two poses: which of them is the true one?

A flat square seen from afar has two poses that explain its corners nearly as well. This script
projects a marker whose pose is known, adds noise, and prints both poses that come back.

    python examples/one_marker.py
"""

import jax
import jax.numpy as jnp
import jaxlie
import numpy as np

import jaxnav as jn
from jaxnav.core.models.geometry import rotation_error_rad
from jaxnav.core.models.markers import CORNER_SIGNS

SIZE_M = 0.172  # side of the marker
FOCAL_PX = 600.0


def main(range_m: float = 2.0, tilt_deg: float = 35.0, noise_px: float = 0.3, seed: int = 0):
    """Solve one noisy view.

    Returns:
        rms_px (2,), error_deg (2,) and error_m (2,) of both poses, the likelier one first.
    """
    # A marker that faces the camera is turned by pi about x: its z points at the viewer.
    R_camera_marker = jaxlie.SO3.from_x_radians(jnp.pi) @ jaxlie.SO3.from_y_radians(
        jnp.deg2rad(tilt_deg)
    )
    position_m = jnp.array([0.3, 0.1, range_m])
    T_camera_marker = jaxlie.SE3.from_rotation_and_translation(R_camera_marker, position_m)

    corners_marker_m = SIZE_M / 2 * jnp.asarray(CORNER_SIGNS, float)  # (4, 3), TL TR BR BL
    corners_camera_m = jax.vmap(T_camera_marker.apply)(corners_marker_m)
    corners_n = corners_camera_m[:, :2] / corners_camera_m[:, 2:]
    noise_n = noise_px / FOCAL_PX * jax.random.normal(jax.random.key(seed), (4, 2))

    # `jn.ippe_square` is the closed form; `jn.solve_marker` refines both of its poses.
    pair = jax.jit(jn.solve_marker)(corners_n + noise_n, SIZE_M)

    found = [jaxlie.SE3(wxyz_xyz) for wxyz_xyz in pair.T_camera_marker.wxyz_xyz]
    error_deg = np.array([np.rad2deg(rotation_error_rad(T, T_camera_marker)) for T in found])
    error_m = np.array([jnp.linalg.norm(T.translation() - position_m) for T in found])
    rms_px = FOCAL_PX * np.asarray(pair.reprojection_error)
    print(f"a marker of {100 * SIZE_M:.1f} cm, {range_m:.1f} m away, tilted by {tilt_deg:.0f} deg:")
    for name, rms, deg, m in zip(("likelier", "other"), rms_px, error_deg, error_m, strict=True):
        print(f"{name:9} corners off by {rms:.3f} px, pose by {deg:5.1f} deg, {100 * m:.1f} cm")
    return {"rms_px": rms_px, "error_deg": error_deg, "error_m": error_m}


if __name__ == "__main__":
    main()
