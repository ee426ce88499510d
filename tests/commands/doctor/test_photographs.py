"""Rendered pictures of a standing car, compared with maps and rigs that contain a mistake."""

import equinox as eqx
import jax.numpy as jnp
import jaxlie
import numpy as np
import pytest

from jaxnav.commands.doctor.photographs import Sighted, examine_pictures, in_their_order
from jaxnav.core.models.markers import MarkerMap
from jaxnav.core.models.rig import CameraRig
from jaxnav.detection import CornerLanes
from jaxnav.files import Route
from jaxnav.sim.rendering import Renderer
from jaxnav.sim.scene import Scene
from jaxnav.sim.sensor import Sensor
from tests.helpers.findings import all_well, the_problem
from tests.worlds import marker_map, observe, planar, qcar_rig, upright

RIG = qcar_rig()
POSE = (0.2, 0.3, 1.3)
ROUTE = Route(((0.4, 0.6),), 0.15, POSE)
SIZES_M = [0.172, 0.172, 0.25]
# Two of them low ahead, the third high on the left.
ROOM = marker_map(
    [
        (upright(-np.pi / 2), [0.1, 1.6, 0.25]),
        (upright(-np.pi / 2 - 0.5), [0.9, 1.5, 0.3]),
        (upright(0.2), [-0.9, 0.4, 0.55]),
    ],
    SIZES_M,
)
LOW, HIGH = 0, 2
SENSOR = Sensor(psf_sigma_px=0.7, read_noise_grey=2.0, full_well_e=6000.0)
Turn = jaxlie.SE3.from_rotation


@pytest.fixture(scope="module")
def images() -> dict[str, np.ndarray]:
    renderer = Renderer(Scene.create(ROOM, seed=0), RIG, sensor=SENSOR)
    pictures = renderer.render_still(np.asarray(planar(*POSE).wxyz_xyz), np.random.default_rng(0))
    return dict(zip(RIG.names, pictures, strict=True))


def moved(marker: int, T_old_new: jaxlie.SE3) -> MarkerMap:
    """The map with one marker elsewhere, in its own frame."""
    wxyz_xyz = ROOM.Ts_world_marker.wxyz_xyz
    there = jaxlie.SE3(wxyz_xyz[marker]) @ T_old_new
    return eqx.tree_at(
        lambda m: m.Ts_world_marker.wxyz_xyz, ROOM, wxyz_xyz.at[marker].set(there.wxyz_xyz)
    )


def sized(*factors: float) -> MarkerMap:
    return eqx.tree_at(lambda m: m.size_m, ROOM, ROOM.size_m * jnp.asarray(factors))


def alone(markers: MarkerMap, index: int) -> MarkerMap:
    """A map of one marker."""
    return MarkerMap(
        jaxlie.SE3(markers.Ts_world_marker.wxyz_xyz[index : index + 1]),
        markers.size_m[index : index + 1],
        markers.ids[index : index + 1],
        markers.families[index : index + 1],
    )


def examine(images, markers=ROOM, rig: CameraRig = RIG, route: Route | None = ROUTE):
    return list(examine_pictures(rig, markers, route, images))


def test_a_true_map_is_in_order(images):
    found = examine(images)
    assert all_well(found)
    told = [finding.what for finding in found]
    assert "0 in front" in told[0]
    assert "2 in left" in told[0]
    assert "the car stands at x 0.20 m, y 0.30 m, psi 74 deg: 0.00 m and +0 deg" in told[-2]
    assert told[-1].startswith("3 markers together: corners are 0.0")


@pytest.mark.parametrize(
    ("turn", "words", "right"),
    [
        (jaxlie.SO3.from_z_radians(np.pi / 2), "by 270 deg: the first one in the map is the"
         " printed bottom-left", "2 3 4 1"),
        (jaxlie.SO3.from_z_radians(np.pi), "by 180 deg", "3 4 1 2"),
        (jaxlie.SO3.from_y_radians(np.pi), "the wrong way round", "2 1 4 3"),
    ],
)  # fmt: skip
def test_corners_in_another_order_are_named(images, turn, words, right):
    found = [f for f in examine(images, moved(LOW, Turn(turn))) if f.level != "ok"]
    (problem,) = found  # and the markers agree once their corners are in order
    assert problem.level == "error"
    assert problem.what.startswith("marker 0: the corners are ")
    assert words in problem.what
    assert f"in the order of the present entries {right};" in problem.do
    # What is said, done to the corners.
    entries = [int(word) - 1 for word in right.split()]
    corners = np.asarray(moved(LOW, Turn(turn)).corners_world_m)[LOW][entries]
    np.testing.assert_allclose(corners, np.asarray(ROOM.corners_world_m)[LOW], atol=1e-12)


def test_a_size_that_is_wrong_by_10_percent_is_told_by_its_height(images):
    found = examine(images, alone(sized(1, 1, 1.1), HIGH))
    problem = [f for f in found if f.level == "warning"][-1]
    factor, sigma = (float(problem.what.split()[i].strip("()")) for i in (3, 5))
    assert abs(factor - 1 / 1.1) < 0.02
    assert sigma < 0.04
    assert "instead of 0.2750?" in problem.do


def test_one_true_marker_is_content_and_says_how_sure_it_is(images):
    found = examine(images, alone(ROOM, HIGH))
    assert [f.level for f in found if f.level != "ok"] == ["note"]  # two that the map lacks
    assert found[-1].what.startswith("marker 2 is 1.00 (+- 0.0")
    assert "markers that are not in the map: 0 of tag36h11 in front, 1 of" in found[0].what


def rig_with(camera: str, turn: jaxlie.SO3) -> CameraRig:
    index = RIG.names.index(camera)
    wxyz_xyz = RIG.Ts_camera_vehicle.wxyz_xyz
    turned = (Turn(turn) @ jaxlie.SE3(wxyz_xyz[index])).wxyz_xyz
    return eqx.tree_at(
        lambda rig: rig.Ts_camera_vehicle.wxyz_xyz, RIG, wxyz_xyz.at[index].set(turned)
    )


def test_a_camera_that_looks_8_degrees_up_lifts_the_car(images):
    up = rig_with("left", jaxlie.SO3.from_x_radians(np.deg2rad(8.0)))
    problem, *_ = (f for f in examine(images, alone(ROOM, HIGH), up) if f.level == "warning")
    assert problem.what.startswith("marker 2 alone: the car is ")
    tilt_deg = float(problem.what.split("tilted by ")[1].split()[0])
    assert tilt_deg == pytest.approx(8, abs=0.5)


SHIFTED = moved(LOW, jaxlie.SE3.from_translation(jnp.array([0.05, 0.0, 0.0])))


@pytest.mark.parametrize(
    ("markers", "rig"),
    [
        (sized(1, 1.1, 1), RIG),
        (SHIFTED, RIG),
        (ROOM, rig_with("left", jaxlie.SO3.from_y_radians(np.deg2rad(5.0)))),
    ],
)
def test_markers_that_contradict_each_other(images, markers, rig):
    problem = the_problem(examine(images, markers, rig), "error")
    assert problem.what.startswith("3 markers together: corners are ")
    assert "`jaxnav calibrate check` of a drive past them names the marker" in problem.do


def test_pictures_without_markers_of_another_size_or_shown_twice(images):
    other = MarkerMap(ROOM.Ts_world_marker, ROOM.size_m, (7, 8, 9), ROOM.families)
    note, warning = examine(images, other)
    assert (note.level, warning.level) == ("note", "warning")
    assert "no marker of the map (7, 8, 9 of tag36h11) is found" in warning.what

    grey = {"front": np.full((410, 820), 90, np.uint8)}
    assert "is found" in the_problem(examine(grey), "warning").what

    small = {"front": np.zeros((205, 410), np.uint8), "left": images["left"]}
    problem = the_problem(examine(small), "error")
    assert problem.what == "front: 410 x 205 px, the rig says 820 x 410"

    halves = {"front": np.tile(images["front"][:, 210:620], (1, 2))}
    problems = [f for f in examine(halves) if "twice" in f.what]
    assert "seen twice in one picture: 0 in front" in the_problem(problems, "warning").what


def test_corners_of_curled_paper_are_those_of_no_square():
    markers = alone(ROOM, HIGH)
    seen = observe(RIG, markers, planar(*POSE))
    for bent_px, level in ((0.0, "ok"), (3.0, "warning")):
        corners_px = np.array(seen.corners_px)
        corners_px[:, :, 0] += bent_px
        told = CornerLanes(corners_px, np.asarray(seen.visible), np.full((4, 1, 4), 0.1), 0, 0, 0)
        _, (pose,), findings = in_their_order(Sighted(RIG, markers, told), ROUTE)
        assert findings[-1].level == level
        assert ("off those of any square" in findings[-1].what) == (level == "warning")
        assert (pose.error_px < 1e-6) == (level == "ok")
