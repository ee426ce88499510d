"""Checks of rig, markers, vehicle and route: each finds its mistake, and passes the QCar."""

import dataclasses
from pathlib import Path

import equinox as eqx
import jax.numpy as jnp
import jaxlie
import numpy as np
import pytest
import yaml
from jaxnav.commands.doctor.markers_file import measured_corners, placed
from jaxnav.commands.doctor.rig_file import bearings, lenses, places
from jaxnav.commands.doctor.route_file import sight_along, turning_radius_m, vehicle_file

from jaxnav.commands.doctor import rig_file, route_file
from jaxnav.core.models.camera import Camera
from jaxnav.core.models.lenses import MOST_COEFFICIENTS
from jaxnav.core.models.rig import CameraRig
from jaxnav.core.models.vehicle import TwistBase, Vehicle
from jaxnav.files import Route, calib_dir, load_route
from tests.helpers.findings import all_well, the_problem
from tests.worlds import marker_map, paper_markers, qcar, qcar_rig, upright

QCAR = calib_dir() / "qcar"
RIG, MARKERS, VEHICLE = qcar_rig(), paper_markers(), qcar()
ROUTE = load_route(QCAR / "route.yaml")


def with_camera(number: int, turn: jaxlie.SE3) -> CameraRig:
    """The QCar's rig with a camera moved and turned in its own frame."""
    wxyz_xyz = RIG.Ts_camera_vehicle.wxyz_xyz
    moved = (turn @ jaxlie.SE3(wxyz_xyz[number])).wxyz_xyz
    return eqx.tree_at(
        lambda rig: rig.Ts_camera_vehicle.wxyz_xyz, RIG, wxyz_xyz.at[number].set(moved)
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


def test_the_qcars_rig_is_in_order():
    assert all_well(rig_file.rig_file(RIG))


@pytest.mark.parametrize(
    ("turn", "level", "words"),
    [
        (jaxlie.SE3.from_translation(jnp.array([0, -0.2, 0])), "error", "front is -0.105 m above"),
        (jaxlie.SE3.from_translation(jnp.array([0, 95.0, 0])), "warning", "front is 95.1 m above"),
        (jaxlie.SE3.from_translation(jnp.array([0, 0, -19.0])), "warning", "19.2 m from the mid"),
        (
            jaxlie.SE3.from_rotation(jaxlie.SO3.from_z_radians(np.pi)),
            "warning",
            "front is mounted upside down",
        ),
    ],
)
def test_cameras_in_impossible_places(turn, level, words):
    # A camera that moves by +y of its own frame sinks: T_camera_vehicle holds the inverse.
    assert words in the_problem(places(with_camera(0, turn)), level).what


def test_a_copied_camera_is_noticed():
    wxyz_xyz = RIG.Ts_camera_vehicle.wxyz_xyz
    copied = eqx.tree_at(
        lambda rig: rig.Ts_camera_vehicle.wxyz_xyz, RIG, wxyz_xyz.at[2].set(wxyz_xyz[0])
    )
    assert "front and rear look the same way" in the_problem(places(copied), "warning").what


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
    two = RIG.first(2)  # front and right
    found = the_problem(bearings(two), "note")
    # Each sees 147 degrees, half of it to either side; their middles are 90 apart.
    begin, end = (int(word) for word in found.what.split()[3:6:2])
    assert begin == pytest.approx(147 / 2, abs=2)
    assert end == pytest.approx(-90 - 147 / 2, abs=4)
    assert f"{end + 360 - begin + 1} of 360 deg" in found.what


def test_runs_of_bearings():
    flags = np.zeros(360, bool)
    flags[[358, 359, 0, 1, 90, 91]] = True
    assert rig_file.spans(flags) == [(-2, 1), (90, 91)]
    assert rig_file.spans(~np.zeros(360, bool)) == [(-179, 180)]
    assert rig_file.spans(np.zeros(360, bool)) == []


def test_a_rig_that_sees_the_sky_alone():
    camera = Camera.create((800.0, 800.0), (320.0, 240.0))
    up = jaxlie.SE3.from_translation(jnp.array([0.0, 0.0, -0.1]))
    rig = CameraRig.create([camera], [up], ["sky"], [(640, 480)])
    assert "no camera sees -179 to 180 deg" in the_problem(bearings(rig), "error").what


def map_file(folder: Path, corners, size_m=0.172) -> Path:
    marker = {"id": 3, "family": "tag36h11", "size_m": size_m, "corners_world_m": corners}
    (folder / "markers.yaml").write_text(yaml.safe_dump({"markers": [marker]}))
    return folder / "markers.yaml"


SQUARE = [[-0.086, 1.47, 0.312], [0.086, 1.47, 0.312], [0.086, 1.47, 0.14], [-0.086, 1.47, 0.14]]
SHEARED = [[x + (0.006 if z > 0.2 else 0), y, z] for x, y, z in SQUARE]


@pytest.mark.parametrize(
    ("corners", "size_m", "level", "words"),
    [
        (SQUARE, 0.19, "error", "0.1720 m apart, size_m says 0.1900 (+10.5%)"),
        (SQUARE, 0.175, "warning", "(+1.7%)"),
        ([SQUARE[k] for k in (0, 2, 1, 3)], 0.172, "error", "a bow tie"),
        ([*SQUARE[:3], [-0.086, 1.462, 0.14]], 0.172, "warning", "off a plane"),
        (SHEARED, 0.172, "warning", "its diagonals by 8.5 mm"),
    ],
)
def test_corners_that_are_no_such_square(tmp_path, corners, size_m, level, words):
    found = the_problem(measured_corners(map_file(tmp_path, corners, size_m)), level)
    assert found.what.startswith("marker 3: its ")
    assert words in found.what


@pytest.mark.parametrize("text", ["{", "markers: 3", "markers: [1, {id: 2, size_m: x}]", "a: b"])
def test_of_a_file_that_holds_no_corners_nothing_is_said(tmp_path, text):
    (tmp_path / "markers.yaml").write_text(text)
    assert list(measured_corners(tmp_path / "markers.yaml")) == []
    assert list(measured_corners(tmp_path / "gone.yaml")) == []


def test_the_papers_marker_is_in_order():
    assert all_well(measured_corners(QCAR / "markers.yaml"))
    assert all_well(placed(MARKERS))


@pytest.mark.parametrize(
    ("R", "position", "size_m", "level", "words"),
    [
        (upright(-np.pi / 2), [0, 1, 0.05], 0.172, "warning", "0.04 m below the ground"),
        (upright(-np.pi / 2), [0, 1, 120.0], 172.0, "warning", "172 m wide"),
        (
            upright(-np.pi / 2) @ np.array([[0, -1, 0], [1, 0, 0], [0, 0, 1]]),
            [0, 1, 0.2],
            0.172,
            "note",
            "hangs turned by 90 deg",
        ),
    ],
)
def test_markers_that_hang_oddly(R, position, size_m, level, words):
    assert words in the_problem(placed(marker_map([(R, position)], [size_m])), level).what


def test_a_marker_on_the_floor_is_in_order():
    assert all_well(placed(marker_map([(np.eye(3), [1, 1, 0])], [0.2])))


def test_the_qcar_and_its_route_are_in_order():
    assert all_well(vehicle_file(VEHICLE))
    assert all_well(route_file.route_file(ROUTE, VEHICLE, MARKERS))
    found = list(sight_along(RIG, MARKERS, ROUTE))
    assert all_well(found)
    # The paper's figure: a marker of 17.2 cm, 3.2 m away, 17 px wide.
    assert found[0].what.startswith("the start: marker 0 is 16 px wide in front, at 3.0 m")


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"speed_per_throttle_mps": 1000.0}, "full throttle (0.3) is 300 m/s"),
        ({"speed_per_throttle_mps": 0.1}, "is 0.03 m/s"),
        ({"speed_time_constant_s": 300.0}, "speed_time_constant_s is 300"),
        ({"wheelbase_m": 25.6}, "wheelbase_m is 25.6"),
        ({"steering_limit_rad": 0.009}, "steering_limit_rad is 0.009, 0.52 deg"),
    ],
)
def test_figures_of_no_small_car(change, words):
    figures = {field.name: getattr(VEHICLE, field.name) for field in dataclasses.fields(Vehicle)}
    vehicle = Vehicle(**{**figures, **{key: jnp.asarray(v) for key, v in change.items()}})
    assert words in the_problem(vehicle_file(vehicle), "warning").what


def route(*waypoints_m, radius_m=0.15, start=ROUTE.start_pose, leave_m=None) -> Route:
    return Route(waypoints_m, radius_m, start, leave_m)


@pytest.mark.parametrize(
    ("given", "level", "words"),
    [
        (route((1.3, 0.0), (1.3, 0.1)), "warning", "waypoint 2 is 0.10 m from the place before"),
        (route((1.3, 0.0), radius_m=0.01), "warning", "waypoint_radius_m is 0.01"),
        (route((1.3, 0.0), leave_m=0.5), "warning", "leave_m is 0.5: a car that turns round stops"),
        (route((0.0, 1.3)), "warning", "past marker 0 at 0.17 m"),
    ],
)
def test_routes_that_can_not_be_driven(given, level, words):
    assert words in the_problem(route_file.route_file(given, VEHICLE, MARKERS), level).what


def test_a_waypoint_inside_the_turning_circle():
    beside = route((0.3, 0.45), start=(0.3, 0.0, 0.0))
    found = the_problem(route_file.route_file(beside, VEHICLE, MARKERS), "note")
    assert "inside the smallest circle (0.49 m)" in found.what
    # Twice the radius to the side is reached by a half circle.
    radius_m = turning_radius_m(VEHICLE)
    opposite = route((0.3, -1 + 2 * radius_m), start=(0.3, -1.0, 0.0))
    assert all_well(route_file.route_file(opposite, VEHICLE, MARKERS))


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
    assert side_px >= route_file.READABLE_PX
    assert "along 1." in found[1].what or "along 2." in found[1].what


def test_a_map_as_seen_from_behind():
    behind = marker_map([(upright(np.pi / 2), [0, 1.47, 0.226])], [0.172])
    found = the_problem(sight_along(RIG, behind, ROUTE), "error")
    assert found.what == "start and route lie behind all markers"


def test_markers_that_are_out_of_sight():
    high = marker_map([(upright(-np.pi / 2), [0, 1.47, 30.0])], [0.172])
    found = list(sight_along(RIG, high, ROUTE))
    assert [f.level for f in found] == ["warning", "error"]
    assert "29.9 m and more above or below the cameras" in found[0].what
    assert "no marker of 0 is seen from the start or along the route" in found[1].what


def test_a_waypoint_without_a_view():
    past = route((1.3, 0.0), (1.0, 3.0))  # beyond the wall
    found = list(sight_along(RIG, MARKERS, past))
    assert any(f.level == "note" and f.what == "waypoint 2: no marker is in view" for f in found)
    turned = route((1.0, 0.0), start=(0.0, 3.0, 0.0))
    (first, *_) = sight_along(RIG, MARKERS, turned)
    assert (first.level, first.what) == ("warning", "the start: no marker is in view")


BASE = TwistBase.create(1.0, 4.0, 0.15)


def test_a_small_base_and_its_route_are_in_order():
    assert all_well(vehicle_file(BASE))
    assert turning_radius_m(BASE) == 0
    assert all_well(route_file.route_file(ROUTE, BASE, MARKERS))


@pytest.mark.parametrize(
    ("figures", "words"),
    [
        ((100.0, 4.0, 0.15), "forward_limit_mps is 100"),
        ((1.0, 229.0, 0.15), "turn_limit_radps is 229"),  # degrees
        ((1.0, 4.0, 150.0), "time_constant_s is 150"),  # milliseconds
    ],
)
def test_figures_of_no_small_base(figures, words):
    assert words in the_problem(vehicle_file(TwistBase.create(*figures)), "warning").what
