"""Markers in the world: corner order, frames, look-up."""

import cv2
import jax.numpy as jnp
import numpy as np

from jaxnav.core.models.markers import FAMILY_SIZES, corners_marker_m, opencv_dictionary_name
from tests import worlds


def test_the_paper_s_corners(precision):
    """Caption of the paper's X-Y figure, in metres, top-left first and clockwise."""
    expected = [
        [-0.086, 1.47, 0.312],
        [0.086, 1.47, 0.312],
        [0.086, 1.47, 0.14],
        [-0.086, 1.47, 0.14],
    ]
    markers = worlds.paper_markers()
    assert markers.corners_world_m.dtype == precision
    np.testing.assert_allclose(markers.corners_world_m, [expected], atol=1e-6)


def test_corners_run_clockwise_for_the_reader():
    corners = np.asarray(corners_marker_m(jnp.asarray(0.2)))
    np.testing.assert_allclose(corners[0], [-0.1, 0.1, 0])
    edges = np.roll(corners, -1, axis=0) - corners
    # The reader looks along -z, so clockwise is negative about z.
    assert np.all(np.cross(edges, np.roll(edges, -1, axis=0))[:, 2] < 0)


def test_sides_have_the_marker_s_size():
    markers = worlds.room_markers()
    corners = np.asarray(markers.corners_world_m)
    sides = np.linalg.norm(np.roll(corners, -1, axis=1) - corners, axis=2)
    np.testing.assert_allclose(sides, np.repeat(np.asarray(markers.size_m)[:, None], 4, axis=1))


def test_an_image_shows_the_corners_clockwise():
    """y points down in an image: the signed area of TL TR BR BL is positive there."""
    rig, markers = worlds.qcar_rig(), worlds.room_markers()
    seen = worlds.observe(rig, markers, worlds.planar(0.2, 0.1, 0.6))
    corners = np.asarray(seen.corners_px)[np.asarray(seen.visible)]
    assert len(corners) >= 4
    x, y = corners[..., 0], corners[..., 1]
    area = np.sum(x * np.roll(y, -1, axis=1) - y * np.roll(x, -1, axis=1), axis=1)
    assert np.all(area > 0)


def test_index_needs_both_id_and_family():
    markers = worlds.room_markers()
    assert markers.index(2, "tag36h11") == 2
    assert markers.index(4, "tag36h11") is None
    assert markers.index(2, "tag16h5") is None


def test_families_are_opencv_s():
    for family, count in FAMILY_SIZES.items():
        code = getattr(cv2.aruco, opencv_dictionary_name(family))
        assert len(cv2.aruco.getPredefinedDictionary(code).bytesList) == count, family
