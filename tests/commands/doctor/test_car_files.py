"""Checks of rig, markers, vehicle and route: each finds its mistake, and passes the QCar."""

import dataclasses

import equinox as eqx
import jax.numpy as jnp
import jaxlie
import numpy as np
import pytest

from jaxnav.commands.doctor import car_files
from jaxnav.commands.doctor.car_files import (
    bearings,
    lenses,
    placed,
    places,
    route_file,
    sight_along,
    turning_radius_m,
    vehicle_file,
)
from jaxnav.core.models.camera import Camera
from jaxnav.core.models.lenses import MOST_COEFFICIENTS
from jaxnav.core.models.rig import CameraRig
from jaxnav.core.models.vehicle import TwistBase, Vehicle
from jaxnav.files import Route, calib_dir, load_route
from tests.helpers.findings import all_well, the_problem
from tests.worlds import marker_map, paper_markers, qcar, qcar_rig, upright

RIG, MARKERS, VEHICLE = qcar_rig(), paper_markers(), qcar()
ROUTE = load_route(calib_dir() / "qcar" / "route.yaml")
BASE = TwistBase.create(1.0, 4.0, 0.15)


def with_camera(number: int, turn: jaxlie.SE3 | None = None, copy_of: int = 0) -> CameraRig:
    """The QCar's rig with a camera moved and turned in its own frame, or a copy of another."""
    wxyz_xyz = RIG.Ts_camera_vehicle.wxyz_xyz
    placed = wxyz_xyz[copy_of] if turn is None else (turn @ jaxlie.SE3(wxyz_xyz[number])).wxyz_xyz
    return eqx.tree_at(
        lambda rig: rig.Ts_camera_vehicle.wxyz_xyz, RIG, wxyz_xyz.at[number].set(placed)
    )


def with_lens(**changes) -> CameraRig:
    """The QCar's rig with other figures for the first camera's lens."""
    cameras = RIG.cameras
    for name, value in changes.items():
        array = getattr(cameras, name)
        cameras = eqx.tree_at(
            lambda c, name=name: getattr(c, name), cameras, array.at[0].set(jnp.asarray(value))
        )
    return eqx.tree_at(lambda rig: rig.cameras, RIG, cameras)


def moved(x_m: float, y_m: float, z_m: float) -> CameraRig:
    return with_camera(0, jaxlie.SE3.from_translation(jnp.array([x_m, y_m, z_m])))


def car(**figures) -> Vehicle:
    return dataclasses.replace(VEHICLE, **{name: jnp.asarray(v) for name, v in figures.items()})


def route(*waypoints_m, radius_m=0.15, start=ROUTE.start_pose, leave_m=None) -> Route:
    return Route(waypoints_m, radius_m, start, leave_m)


def marker(R, position_m, size_m=0.172):
    return marker_map([(R, position_m)], [size_m])


def test_the_qcar_and_a_small_base_are_in_order():
    assert all_well(car_files.rig_file(RIG))
    assert all_well(placed(MARKERS))
    assert all_well(placed(marker(np.eye(3), [1, 1, 0], 0.2)))  # on the floor
    for vehicle in (VEHICLE, BASE):
        assert all_well(vehicle_file(vehicle))
        assert all_well(route_file(ROUTE, vehicle, MARKERS))
    assert turning_radius_m(BASE) == 0
    # A waypoint at twice the radius is reached by a half circle.
    opposite = route((0.3, -1 + 2 * turning_radius_m(VEHICLE)), start=(0.3, -1.0, 0.0))
    assert all_well(route_file(opposite, VEHICLE, MARKERS))
    found = list(sight_along(RIG, MARKERS, ROUTE))
    assert all_well(found)
    # The paper's figure: a marker of 17.2 cm, 3.2 m away, 17 px wide.
    assert found[0].what.startswith("the start: marker 0 is 16 px wide in front, at 3.0 m")


UPSIDE_DOWN = jaxlie.SE3.from_rotation(jaxlie.SO3.from_z_radians(np.pi))
ON_ITS_SIDE = upright(-np.pi / 2) @ np.array([[0, -1, 0], [1, 0, 0], [0, 0, 1]])
SKY = CameraRig.create(
    [Camera.create((800.0, 800.0), (320.0, 240.0))],
    [jaxlie.SE3.from_translation(jnp.array([0.0, 0.0, -0.1]))],
    ["sky"],
    [(640, 480)],
)
BEHIND = marker(upright(np.pi / 2), [0, 1.47, 0.226])
# What is wrong, and the only finding that is not ok: its level and some of its words.
MISTAKES = [
    # A camera that moves by +y of its own frame sinks: T_camera_vehicle holds the inverse.
    (places(moved(0, -0.2, 0)), "error", "front is -0.105 m above"),
    (places(moved(0, 95.0, 0)), "warning", "front is 95.1 m above"),
    (places(moved(0, 0, -19.0)), "warning", "19.2 m from the mid"),
    (places(with_camera(0, UPSIDE_DOWN)), "warning", "front is mounted upside down"),
    (places(with_camera(2)), "warning", "front and rear look the same way"),
    (bearings(SKY), "error", "no camera sees -179 to 180 deg"),
    (placed(marker(upright(-np.pi / 2), [0, 1, 0.05])), "warning", "0.04 m below the ground"),
    (placed(marker(upright(-np.pi / 2), [0, 1, 120.0], 172.0)), "warning", "172 m wide"),
    (placed(marker(ON_ITS_SIDE, [0, 1, 0.2])), "note", "hangs turned by 90 deg"),
    (vehicle_file(car(speed_per_throttle_mps=1000.0)), "warning", "full throttle (0.3) is 300 m/s"),
    (vehicle_file(car(speed_per_throttle_mps=0.1)), "warning", "is 0.03 m/s"),
    (vehicle_file(car(speed_time_constant_s=300.0)), "warning", "speed_time_constant_s is 300"),
    (vehicle_file(car(wheelbase_m=25.6)), "warning", "wheelbase_m is 25.6"),
    (vehicle_file(car(steering_limit_rad=0.009)), "warning", "steering_limit_rad is 0.009, 0.52"),
    (vehicle_file(TwistBase.create(100.0, 4.0, 0.15)), "warning", "forward_limit_mps is 100"),
    (vehicle_file(TwistBase.create(1.0, 229.0, 0.15)), "warning", "turn_limit_radps is 229"),
    (vehicle_file(TwistBase.create(1.0, 4.0, 150.0)), "warning", "time_constant_s is 150"),
    (route_file(route((1.3, 0.0), (1.3, 0.1)), VEHICLE, MARKERS), "warning",
     "waypoint 2 is 0.10 m from the place before"),
    (route_file(route((1.3, 0.0), radius_m=0.01), VEHICLE, MARKERS), "warning",
     "waypoint_radius_m is 0.01"),
    (route_file(route((1.3, 0.0), leave_m=0.5), VEHICLE, MARKERS), "warning",
     "leave_m is 0.5: a car that turns round stops"),
    (route_file(route((0.0, 1.3)), VEHICLE, MARKERS), "warning", "past marker 0 at 0.17 m"),
    (route_file(route((0.3, 0.45), start=(0.3, 0.0, 0.0)), VEHICLE, MARKERS), "note",
     "inside the smallest circle (0.49 m)"),
    (sight_along(RIG, BEHIND, ROUTE), "error", "start and route lie behind all markers"),
]  # fmt: skip


@pytest.mark.parametrize(("check", "level", "words"), MISTAKES, ids=lambda one: str(one)[:30])
def test_each_mistake_is_found(check, level, words):
    assert words in the_problem(check, level).what


@pytest.mark.parametrize(
    ("change", "level", "words"),
    [
        ({"center_px": [201.0, 101.0]}, "warning", "center_px (201, 101) is far from the middle"),
        ({"center_px": [-5.0, 202.0]}, "error", "far from the middle of 820 x 410"),
        ({"focal_px": [319.0, 380.0]}, "warning", "fx 319 and fy 380 px differ"),
        ({"focal_px": [3190.0, 3190.0]}, "warning", "sees 14.7 deg of the horizon"),
        ({"focal_px": [3.6, 3.6]}, "warning", "focal_px 4 sees 360 deg"),
    ],
)
def test_lenses_of_other_images(change, level, words):
    found, *folds = (f for f in lenses(with_lens(**change)) if f.level != "ok")
    assert found.level == level
    assert {fold.key for fold in folds} <= {"rig.folds"}  # beyond a half circle it must
    assert words in found.what
    if "middle" in words:
        assert "calibrated at" in found.do


@pytest.mark.parametrize(("k1", "level"), [(-0.13, "warning"), (-0.6, "error")])
def test_a_lens_that_folds_within_the_image(k1, level):
    folded = with_lens(distortion=[k1, *[0] * (MOST_COEFFICIENTS - 1)])
    (found,) = (found for found in lenses(folded) if found.key == "rig.folds")
    assert found.level == level
    assert found.what.startswith("front: the lens model can be inverted up to")


def test_bearings_that_no_camera_sees_are_listed():
    found = the_problem(bearings(RIG.first(2)), "note")  # front and right
    # Each sees 147 degrees, half of it to either side; their middles are 90 apart.
    begin, end = (int(word) for word in found.what.split()[3:6:2])
    assert begin == pytest.approx(147 / 2, abs=2)
    assert end == pytest.approx(-90 - 147 / 2, abs=4)
    assert f"{end + 360 - begin + 1} of 360 deg" in found.what
    flags = np.zeros(360, bool)
    flags[[358, 359, 0, 1, 90, 91]] = True
    assert car_files.spans(flags) == [(-2, 1), (90, 91)]


def test_a_start_that_is_too_far_is_told_from_where_it_can_be_read():
    far = route((1.3, 0.0), start=(4.0, -4.0, np.deg2rad(125.0)))
    found = [f for f in sight_along(RIG, MARKERS, far) if f.level != "ok"]
    assert found[0].level == "warning"
    assert found[0].what.startswith("the start: marker 0 is 7 px wide in front, at 6.6 m")
    range_m = float(found[0].what.split("from ")[1].split()[0])
    nearer = route((1.3, 0.0), start=(0.0, 1.47 - range_m, np.pi / 2))
    (first, *_) = sight_along(RIG, MARKERS, nearer)
    side_px = float(first.what.split(" is ")[1].split()[0])
    # It is seen at an angle from the start, and from the front there.
    assert side_px >= car_files.READABLE_PX
    assert "along 1." in found[1].what or "along 2." in found[1].what


def test_markers_that_are_out_of_sight():
    high = marker(upright(-np.pi / 2), [0, 1.47, 30.0])
    found = list(sight_along(RIG, high, ROUTE))
    assert [f.level for f in found] == ["warning", "error"]
    assert "29.9 m and more above or below the cameras" in found[0].what
    assert "no marker of 0 is seen from the start or along the route" in found[1].what
    beyond_the_wall = list(sight_along(RIG, MARKERS, route((1.3, 0.0), (1.0, 3.0))))
    assert ("note", "waypoint 2: no marker is in view") in {(f.level, f.what) for f in
                                                            beyond_the_wall}  # fmt: skip
    turned = route((1.0, 0.0), start=(0.0, 3.0, 0.0))
    (first, *_) = sight_along(RIG, MARKERS, turned)
    assert (first.level, first.what) == ("warning", "the start: no marker is in view")
