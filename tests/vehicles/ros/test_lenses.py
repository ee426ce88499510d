"""Lenses of a rig from camera_info."""

from types import SimpleNamespace

import numpy as np
import pytest

from jaxnav.errors import BadInput
from jaxnav.vehicles.ros.lenses import read_lens, with_lenses
from tests.worlds import qcar_rig

K = [400.0, 0.0, 310.0, 0.0, 410.0, 230.0, 0.0, 0.0, 1.0]
P = [380.0, 0.0, 305.0, -45.6, 0.0, 390.0, 225.0, 0.0, 0.0, 0.0, 1.0, 0.0]


def info(**changes) -> SimpleNamespace:
    told = {
        "width": 640,
        "height": 480,
        "distortion_model": "plumb_bob",
        "k": K,
        "d": [-0.3, 0.1, 0.001, -0.002, 0.0],
        "p": P,
    }
    return SimpleNamespace(**told | changes)


def test_an_image_as_it_comes_has_k_and_d():
    lens = read_lens("/front/camera_info", info(), rectified=False)
    assert (lens.lens, lens.focal_px, lens.center_px) == ("radtan", [400.0, 410.0], [310.0, 230.0])
    np.testing.assert_allclose(lens.distortion[:4], [-0.3, 0.1, 0.001, -0.002])
    assert lens.image_size_px == [640, 480]
    wide = info(distortion_model="equidistant", d=[0.1, 0.2, 0.3, 0.4])
    assert read_lens("/front", wide, rectified=False).lens == "equidistant"
    ideal = read_lens("/front", info(distortion_model="", d=[]), rectified=False)
    assert set(ideal.distortion) == {0.0}


def test_a_rectified_image_has_p_and_no_distortion():
    lens = read_lens("/front/camera_info", info(), rectified=True)
    assert (lens.focal_px, lens.center_px) == ([380.0, 390.0], [305.0, 225.0])
    assert set(lens.distortion) == {0.0}


@pytest.mark.parametrize(
    ("changes", "rectified", "expected"),
    [
        ({"k": [0.0] * 9}, False, "/front/camera_info: camera_matrix.data"),
        ({"p": [0.0] * 12}, True, "/front/camera_info: camera_matrix.data"),
        ({"distortion_model": "fov"}, False, "/front/camera_info: distortion_model"),
        ({"width": 0}, False, "/front/camera_info: image_width"),
    ],
)
def test_a_camera_that_is_not_calibrated_is_named(changes, rectified, expected):
    with pytest.raises(BadInput, match=expected):
        read_lens("/front/camera_info", info(**changes), rectified)


def test_the_rig_keeps_all_else():
    rig = qcar_rig()
    lens = read_lens("/front/camera_info", info(), rectified=False)
    changed = with_lenses(rig, {"rear": lens})
    at = rig.names.index("rear")
    assert changed.names == rig.names
    assert changed.image_sizes_px[at] == (640, 480)
    np.testing.assert_allclose(changed.camera(at).focal_px, [400.0, 410.0])
    others = [c for c in range(len(rig)) if c != at]
    np.testing.assert_array_equal(
        changed.cameras.focal_px[np.array(others)], rig.cameras.focal_px[np.array(others)]
    )
    np.testing.assert_array_equal(
        changed.Ts_camera_vehicle.wxyz_xyz, rig.Ts_camera_vehicle.wxyz_xyz
    )
