"""A calibrated vehicle in the runtime: sensor readings are corrected on entry and commands on exit
to the servo; a vehicle without calibration changes no bit."""

import dataclasses

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from jaxnav.drive.compiled_step import _jitted
from jaxnav.drive.corrections import Corrections
from jaxnav.drive.estimator import advance_packed
from jaxnav.drive.frames import FrameDetections
from jaxnav.drive.guard import Guard
from jaxnav.drive.interfaces import Odometry
from jaxnav.drive.limits import Limits
from jaxnav.drive.pilot import Input
from jaxnav.vehicles.conformance.lockstep import BEGIN_NS
from jaxnav.vehicles.sim import SimVehicle
from jaxnav.vehicles.world import SimWorld
from tests import worlds
from tests.drive.test_guard import Car
from tests.helpers.simulated import make_setup, simulated

CORRECTIONS = {
    "speed_scale": 1.06,
    "steering_gain": 0.93,
    "steering_offset_rad": 0.02,
    "camera_delay_s": 0.035,
}


def vehicle(**changes: float):
    return dataclasses.replace(worlds.qcar(), **(CORRECTIONS | changes))


numbers = st.floats(-5, 5)
corrections = st.builds(
    Corrections, st.floats(0.5, 2), st.floats(0.5, 2), st.floats(-0.1, 0.1), st.floats(-0.2, 0.2)
)


@given(corrections, numbers, numbers, st.integers(0, 2**62))
def test_what_is_read_is_corrected_back(corrections, speed_mps, steering_rad, true_ns):
    stamp_ns = true_ns + corrections.reading_late_ns
    read = Odometry(stamp_ns, *corrections.read(speed_mps, steering_rad))
    true = corrections.correct_reading(read)
    assert true.speed_mps == pytest.approx(speed_mps, rel=1e-12, abs=1e-12)
    assert true.steering_rad == pytest.approx(steering_rad, rel=1e-12, abs=1e-12)
    assert true.stamp_ns == true_ns
    seen = corrections.correct_frame(FrameDetections(0, true_ns + corrections.frame_late_ns, None))
    assert seen.stamp_ns == true_ns
    assert corrections.true_rad(corrections.servo_rad(steering_rad)) == pytest.approx(
        steering_rad, rel=1e-12, abs=1e-12
    )


@given(corrections, st.integers(0, 2**62), st.integers(0, 2**62))
def test_stamps_differ_by_the_delay_and_none_is_moved_ahead(corrections, frame_ns, reading_ns):
    frame = corrections.correct_frame(FrameDetections(0, frame_ns, None)).stamp_ns
    reading = corrections.correct_reading(Odometry(reading_ns, 1.0, 0.0)).stamp_ns
    assert frame <= frame_ns
    assert reading <= reading_ns
    moved_ns = (frame - frame_ns) - (reading - reading_ns)
    assert moved_ns == pytest.approx(-corrections.camera_delay_s * 1e9, abs=1)


@given(st.floats(), st.floats(), st.integers(0, 2**62))
def test_without_a_calibration_nothing_is_touched(speed_mps, steering_rad, stamp_ns):
    neutral = Corrections.from_vehicle(worlds.qcar())
    read = Odometry(stamp_ns, speed_mps, steering_rad)
    seen = FrameDetections(0, stamp_ns, None)
    assert neutral.correct_reading(read) is read
    assert neutral.correct_frame(seen) is seen
    told = neutral.servo_rad(steering_rad)
    assert told is steering_rad
    assert neutral.read(speed_mps, steering_rad)[1] is steering_rad


def test_the_servo_turns_no_further_than_its_limit():
    corrections = Corrections.from_vehicle(vehicle(steering_gain=0.5))
    assert [corrections.servo_rad(rad) for rad in (0.5, -0.5, 0.02)] == [0.5, -0.5, 0.0]


def test_the_guard_tells_the_servo_what_makes_the_angle_true():
    car = Car()
    clock = iter(range(0, 10**12, 10**8))  # 0.1 s between two looks at it
    limits, told = Limits(0.5, 1e3, 0.3), Corrections.from_vehicle(vehicle())
    guard = Guard(car, limits, 1e3, now_ns=lambda: next(clock), corrections=told)
    guard.arm()
    guard.write(0.3, 0.1)
    guard.close()
    assert car.steered == [pytest.approx((0.3 - 0.02) / 0.93)]


@pytest.mark.long
def test_a_pilot_whose_sensors_are_off_believes_the_same():
    """As one whose sensors are not, at the same drive, and by the same program."""
    setup = make_setup()
    steps = simulated(setup, 1.0)
    programs = _jitted(advance_packed)._cache_size()
    calibrated = dataclasses.replace(setup, vehicle=vehicle())
    corrections = Corrections.from_vehicle(calibrated.vehicle)
    pilot = calibrated.pilot(None)
    for step in steps:
        outcome = pilot.handle(_as_sensed(step.input, corrections))
        expected = step.outcome
        assert outcome.stamp_ns == expected.stamp_ns
        np.testing.assert_allclose(outcome.output.pose, expected.output.pose, atol=1e-9)
        assert outcome.steering_rad == pytest.approx(expected.steering_rad, abs=1e-9)
    assert steps[-1].outcome.output.located
    assert _jitted(advance_packed)._cache_size() == programs


def _as_sensed(given: Input, corrections: Corrections) -> Input:
    frames = tuple(
        dataclasses.replace(frame, stamp_ns=frame.stamp_ns + corrections.frame_late_ns)
        for frame in given.frames
    )
    reading = given.odometry
    if reading is not None:
        read = corrections.read(reading.speed_mps, reading.steering_rad)
        reading = Odometry(reading.stamp_ns, *read)
    return dataclasses.replace(given, odometry=reading, frames=frames)


def test_the_simulated_car_is_off_as_its_file_says():
    world = SimWorld(
        worlds.qcar_rig(), worlds.paper_markers(), vehicle(), worlds.FRONT_VIEW, BEGIN_NS
    )
    told = []
    world.write = lambda *command: told.append(command)
    world.odometry = lambda at_ns: (1.0, 0.2)
    car = SimVehicle(world)
    read = car.read()
    assert read.speed_mps == pytest.approx(1 / 1.06)
    assert read.steering_rad == pytest.approx((0.2 - 0.02) / 0.93)
    car.write((0.2 - 0.02) / 0.93, 0.1)
    assert told[-1][:2] == (pytest.approx(0.2), 0.1)
