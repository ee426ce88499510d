"""Detection in pictures that share no assumption with the package: another renderer drew them."""

import numpy as np
import pytest

from jaxnav.detection import make_detector
from tests.helpers.other_pictures import SETS, other_pictures


def test_clean_markers_are_found_where_another_renderer_drew_them():
    detector = make_detector("aruco")
    errors = []
    for image, truth in other_pictures("clean"):
        found = detector.detect(image)
        assert found.ids.tolist() == [truth.id]
        errors.append(found.corners_px[0] - truth.corners_px)
    assert np.sqrt(np.mean(np.square(errors))) < 0.05
    assert np.abs(np.mean(errors, axis=(0, 1))).max() < 0.02  # no half pixel, nor a part of one


def test_no_marker_is_read_where_there_is_none():
    detector = make_detector("aruco")
    for image, truth in other_pictures("negatives"):
        shown = [truth.more["shown_id"]] if truth.more.get("shown_family") == truth.family else []
        assert set(detector.detect(image).ids.tolist()) <= set(shown)


@pytest.mark.parametrize("kind", SETS)
def test_the_truth_agrees_with_itself(kind):
    """The pose through the camera gives the corners; what is said of blur and sides holds."""
    for image, truth in other_pictures(kind):
        h = truth.size_m / 2
        corners = np.array([[-h, h, 0, 1], [h, h, 0, 1], [h, -h, 0, 1], [-h, -h, 0, 1]])
        x, y, z, _ = np.array(truth.more["T_camera_marker"]) @ corners.T
        ahead = np.stack([x / z, y / z], axis=1)
        seen = np.asarray(truth.camera.focal_px) * ahead + np.asarray(truth.camera.center_px)
        np.testing.assert_allclose(seen, truth.corners_px, atol=1e-3)
        blur_px = float(np.linalg.norm(truth.streak_px))
        assert kind == "negatives" or abs(blur_px - {"blur4": 4, "blur8": 8}.get(kind, 0)) < 0.01
        assert image.shape == (100, 120)
        assert image.dtype == np.uint8
