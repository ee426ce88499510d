"""Disagreement between corners and wheels, and motion that no slip explains."""

import functools
import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from jaxnav.drive.chassis import Motion, car_motion
from jaxnav.drive.ways import Corridor, Fix, Ranges, Ways
from jaxnav.errors import BadInput
from jaxnav.files import Route, load_route

MS = 1_000_000
WHEELBASE_M = 0.256


class Drive:
    """Straight ahead at 50 Hz, a fix with every reading; what the corners add can be chosen."""

    def __init__(self, speed_mps: float, scale: float = 1.0):
        self.ways = Ways(WHEELBASE_M)
        self.speed_mps, self.scale = speed_mps, scale
        self.now_ns, self.x_m, self.off_m = 10**9, 0.0, 0.0

    def step(self, drag_mps: float = 0.0, looks: bool = True) -> bool:
        """20 ms; whether the ways are disputed then."""
        self.now_ns += 20 * MS
        self.x_m += 0.02 * self.speed_mps
        self.off_m += 0.02 * drag_mps
        told_mps = self.scale * self.speed_mps
        self.ways.add_odometry(Motion(told_mps, 0.0, 0.0), abs(told_mps), 0.0, 0.02)
        if looks:
            self.ways.note_corners(self.now_ns)
            self.ways.add_fix(self.now_ns, self.fix())
        return self.ways.disputed

    def fix(self, by_m: float = 0.0, turn_rad: float = 0.0) -> Fix:
        return Fix(self.x_m, self.off_m + by_m, turn_rad, 0.005, 0.005)

    def seconds(self, seconds: float, **how) -> list[bool]:
        return [self.step(**how) for _ in range(round(seconds * 50))]


@pytest.mark.parametrize("speed_mps", [0.0, 0.3, 1.5])
@pytest.mark.parametrize("scale", [0.93, 1.07])
def test_wheels_within_their_calibration_dispute_nothing(speed_mps, scale):
    assert not any(Drive(speed_mps, scale).seconds(30))


@pytest.mark.parametrize(
    ("drag_mps", "speed_mps", "within_s"),
    [(0.5, 0.3, 0.5), (0.1, 0.3, 2.5), (0.05, 0.0, 4.0), (0.05, 0.2, 5.0), (-0.5, 1.5, 0.7)],
)
def test_a_marker_that_is_carried_along_is_disputed_for_as_long_as_it_is(
    drag_mps, speed_mps, within_s
):
    drive = Drive(speed_mps)
    drive.seconds(3)
    disputed = drive.seconds(20, drag_mps=drag_mps)
    assert 0 <= disputed.index(True) / 50 < within_s
    assert all(disputed[disputed.index(True) :])
    settled = drive.seconds(2)
    assert settled[0]
    assert not settled[-1]


def test_slip_is_disputed_and_over_soon():
    drive = Drive(0.4)
    drive.seconds(3)
    drive.scale = 1.3
    assert drive.seconds(3)[-1]
    drive.scale = 1.0
    assert not drive.seconds(1.5)[-1]
    drive.scale = 1.3
    drive.seconds(4, looks=False)
    assert not drive.step()  # what was driven blind is not held against the corners


@given(st.floats(-1, 1), st.floats(0, 0.5))
def test_a_pose_within_the_way_is_in_reach_whatever_has_slipped(share, seconds):
    drive = Drive(1.0)
    drive.seconds(1)
    drive.seconds(seconds, looks=False)
    way_m = drive.ways.since_fix_m
    assert way_m == pytest.approx(round(seconds * 50) * 0.02)
    anywhere = Fix(drive.x_m - way_m + share * way_m, 0.0, share * way_m, 0.0, 0.0)
    assert not drive.ways.out_of_reach(anywhere)


@pytest.mark.parametrize(
    ("by_m", "turn_rad", "out"),
    [(0.0, 0.0, False), (0.2, 0.0, False), (0.4, 0.0, True), (0.0, 2.0, True), (0.0, 0.7, False)],
)
def test_a_pose_beyond_the_way_is_out_of_reach(by_m, turn_rad, out):
    drive = Drive(0.4)
    drive.seconds(1)
    drive.seconds(0.34, looks=False)  # the ten frames of a restart
    assert drive.ways.out_of_reach(drive.fix(by_m, turn_rad)) == out
    assert not drive.ways.out_of_reach(drive.fix(by_m, turn_rad), slack_m=1.0)


def test_before_the_first_pose_and_after_forgetting_everything_is_in_reach():
    drive = Drive(0.4)
    assert not drive.ways.out_of_reach(drive.fix(9.0))
    drive.seconds(1)
    assert drive.ways.out_of_reach(drive.fix(9.0))
    drive.ways.forget()
    assert not drive.ways.out_of_reach(drive.fix(9.0))


def test_a_turn_is_the_bicycles():
    ways = Ways(WHEELBASE_M)
    ways.add_fix(0, Fix(0.0, 0.0, 0.0, 0.0, 0.0))
    for _ in range(50):
        ways.add_odometry(car_motion(-0.5, 0.4, WHEELBASE_M), 0.5, 0.0, 0.02)
    curvature_per_m = math.cos(math.atan(math.tan(0.4) / 2)) * math.tan(0.4) / WHEELBASE_M
    assert ways._turned_rad == pytest.approx(0.5 * curvature_per_m)


def test_a_silent_odometer_disputes_nothing_when_it_is_back():
    drive = Drive(0.4)
    drive.seconds(3)
    assert drive.seconds(3, drag_mps=0.5)[-1]
    drive.ways.add_odometry(Motion(0.4, 0.0, 0.0), 0.4, 0.0, 0.2)
    assert not drive.ways.disputed
    assert not drive.step()


def looks(
    ranges: Ranges,
    scale: float = 1.0,
    wheels: float = 1.0,
    toward: float = 1.0,
    way_m: float = 1.0,
    begin_m: float = 2.5,
    noise: float = 0.005,
    lane: tuple[int, int] = (0, 0),
    late_s: float = 0.0,
) -> float | None:
    """Drive past a marker at 0.5 m/s and 30 Hz; the way after which the files are contradicted.

    Args:
        scale: of every range.
        wheels: what the odometer tells of every way.
        toward: 1 ahead of the vehicle, -1 behind it by a rig that is turned.
        noise: share of a range, one sigma.
        late_s: the camera's stamps, while the car speeds up in a third of a second.
    """
    rng, told_m, first = np.random.default_rng(0), 0.0, None
    for index in range(1, round(way_m * 60) + 1):
        gone_m, speed = index / 60, min(index / 10, 1.0) * 0.5
        ahead_m, left_m = begin_m - (gone_m - speed * late_s), 0.3 * begin_m
        factor = toward * scale * (1 + noise * rng.standard_normal())
        place_m = (factor * ahead_m, factor * left_m, 0.2)
        ranges.add_way(wheels / 60)
        if ranges.add_place(lane, place_m, (wheels * gone_m - told_m, 0.0, 0.0)):
            told_m = wheels * gone_m
        if ranges.contradicted and first is None:
            first = gone_m
    return first


@pytest.mark.parametrize(
    ("scale", "within_m"), [(2.0, 0.3), (0.5, 0.3), (1.5, 0.4), (0.7, 0.5), (1.2, 2.0), (0.8, 2.0)]
)
@pytest.mark.parametrize("wheels", [0.97, 1.0, 1.03])
def test_a_size_that_is_not_as_the_file_says_is_named(scale, within_m, wheels):
    ranges = Ranges()
    named_m = looks(ranges, scale, wheels, way_m=2.0)
    assert named_m is not None
    assert named_m < within_m
    assert ranges.slope == pytest.approx(scale / wheels, rel=0.1)


def test_a_camera_that_looks_the_other_way_is_named_at_once():
    assert looks(ranges := Ranges(), toward=-1.0) < 0.2
    assert ranges.slope == pytest.approx(-1.0, abs=0.1)
    assert ranges.lasting


@pytest.mark.parametrize("wheels", [0.93, 0.97, 1.03, 1.07])
@pytest.mark.parametrize("noise", [0.002, 0.02, 0.05])
@pytest.mark.parametrize("late_s", [-0.05, 0.05])
def test_wheels_noise_and_delays_as_they_are_contradict_nothing(wheels, noise, late_s):
    ranges = Ranges()
    assert looks(ranges, 1.02, wheels, noise=noise, late_s=late_s, way_m=2.0) is None


def test_wheels_that_slip_later_leave_the_files_alone():
    ranges = Ranges()
    looks(ranges)
    assert looks(ranges, wheels=1.4, begin_m=1.5) is None
    assert ranges.slope < 0.9
    # Another camera's file has not agreed with any way yet.
    assert looks(ranges, wheels=1.4, lane=(1, 0)) is not None


@pytest.mark.parametrize("scale", [0.6, 1.4, 1.5])
def test_cameras_that_see_a_marker_in_turns_tell_it_together(scale):
    ranges = Ranges()
    look = functools.partial(looks, scale=scale, way_m=0.2, begin_m=1.0, noise=0.02)
    named_m = [look(ranges, lane=(camera, 0)) for camera in range(4)]
    assert named_m[0] is None
    assert named_m[-1] is not None


def test_it_lasts_while_nothing_is_seen_and_is_forgotten_once_the_files_agree():
    ranges = Ranges()
    looks(ranges, scale=2.0, way_m=0.5)
    assert ranges.contradicted
    assert not ranges.lasting
    ranges.add_way(0.5)
    assert ranges.lasting
    looks(ranges, lane=(1, 0))
    assert not ranges.contradicted


def test_who_stands_or_is_carried_off_is_told_nothing():
    ranges = Ranges()
    for _ in range(1000):
        ranges.add_place((0, 0), (2.0, 0.1, 0.2), (0.001, 0.0, 0.0))
    assert not ranges.contradicted
    assert ranges.sigma == math.inf
    assert looks(ranges, begin_m=2.0, way_m=0.05) is None
    assert looks(ranges, begin_m=1.4, way_m=0.5) is None  # from one look to the next


SQUARE = ((2.0, 0.0), (2.0, 2.0), (0.0, 2.0))


@pytest.mark.parametrize(
    ("place_m", "is_left"),
    [((1.0, 0.9), False), ((1.0, -0.9), False), ((1.0, -1.1), True), ((3.5, 1.0), True),
     ((-1.1, 0.0), True), ((1.0, 1.0), False), ((-0.9, 2.0), False), ((2.8, 2.8), True)],
)  # fmt: skip
def test_all_within_a_distance_of_a_leg_is_inside(place_m, is_left):
    corridor = Corridor(SQUARE, 1.0)
    assert not corridor.is_left(np.zeros(2))  # where it begins
    assert corridor.is_left(np.array(place_m)) == is_left


def test_by_default_it_is_one_and_a_half_legs_and_a_metre(tmp_path):
    assert Route(SQUARE, 0.1, (0.0, 0.0, 0.0)).leaves_at_m == 4.0
    assert Route(SQUARE, 0.1, (-2.0, 0.0, 0.0)).leaves_at_m == 7.0  # the leg from the start counts
    path = tmp_path / "route.yaml"
    told = "start: {x_m: 0, y_m: 0, psi_deg: 0}\nwaypoints_m: [[1, 0]]\nwaypoint_radius_m: 0.1\n"
    path.write_text(told + "leave_m: 2.5\n")
    assert load_route(path).relative_to((1e6, 0.0, 0.0)).leaves_at_m == 2.5
    path.write_text(told + "leave_m: -1\n")
    with pytest.raises(BadInput, match="leave_m"):
        load_route(path)
