"""The simulated base and the simulated gyro: they move and tell as their file says."""

import dataclasses
import math

import numpy as np
import pytest

from jaxnav.core.models.imu import Gyro
from jaxnav.core.models.vehicle import TwistBase
from jaxnav.drive.interfaces import TwistOdometry
from jaxnav.vehicles.world import SimWorld
from tests import worlds

BEGIN_NS, S = 10**12, 10**9
SPIN_RADPS = 2.0
EXACT = Gyro(1e-9, 1e-9, 1e-9, 30.0)


def world_of(gyro: Gyro | None = None, seed: int = 0, **how) -> SimWorld:
    base = TwistBase.create(1.0, 4.0, 0.15, gyro=gyro, **how)
    rig, markers = worlds.qcar_rig(), worlds.paper_markers()
    return SimWorld(rig, markers, base, (0.0, 0.0, 0.0), BEGIN_NS, seed=seed)


def told(world: SimWorld, command, seconds: float, begin_ns: int = BEGIN_NS) -> int:
    """Tell a command every 20 ms; return the end."""
    now_ns = begin_ns
    for _ in range(round(seconds / 0.02)):
        world.write(*command, now_ns)
        now_ns += 20_000_000
    return now_ns


def test_it_turns_on_the_spot_and_stops_by_itself_without_commands():
    world = world_of()
    end_ns = told(world, (0.0, 0.0, SPIN_RADPS), 1.0)
    x_m, y_m, psi_rad, *twist = world.state(end_ns)
    assert (x_m, y_m) == (0.0, 0.0)
    assert psi_rad == pytest.approx(SPIN_RADPS * (1.0 - 0.15 - 0.01), abs=0.02)
    assert twist == pytest.approx([0.0, 0.0, SPIN_RADPS], abs=0.01)
    timeout_ns = int(world.settings.vehicle_timeout_s * S)
    later = world.state(end_ns + timeout_ns + 2 * S)
    assert later[3:] == pytest.approx([0.0, 0.0, 0.0], abs=1e-4)


def test_held_fast_or_carried_off_it_is_where_it_was_put():
    world = world_of(left_limit_mps=0.5)
    world.hold(True)
    end_ns = told(world, (0.5, 0.5, 1.0), 0.5)
    assert not world.state(end_ns).any()
    world.carry_off((1.0, 2.0, 0.5))
    assert world.state(end_ns + 1)[:3] == pytest.approx([1.0, 2.0, 0.5])
    world.hold(False)
    end_ns = told(world, (0.0, 0.5, 0.0), 1.0, end_ns + 1)
    off_m = world.state(end_ns)[:2] - [1.0, 2.0]
    assert math.atan2(*off_m[::-1]) == pytest.approx(0.5 + math.pi / 2, abs=0.01)


def test_its_odometer_reads_its_twist():
    world = world_of()
    end_ns = told(world, (0.3, 0.0, -1.0), 1.5)
    reading = world.reading(end_ns)
    assert isinstance(reading, TwistOdometry)
    assert reading.values == pytest.approx(world.state(end_ns)[3:], abs=0.05)
    assert reading.values != tuple(world.state(end_ns)[3:])


def test_an_exact_gyro_tells_the_turn():
    world = world_of(EXACT)
    end_ns = told(world, (0.0, 0.0, SPIN_RADPS), 0.4)
    readings = world.gyro(end_ns)
    assert len(readings) == 40
    stamps_ns = [one.stamp_ns for one in readings]
    assert np.all(np.diff(stamps_ns) == 10_000_000)
    assert world.gyro(end_ns) == world_of().gyro(BEGIN_NS + S) == ()
    assert len(world_of(EXACT).gyro(BEGIN_NS + 3 * S)) == 50  # half a second is kept
    turned_rad = sum(0.01 * one.turn_radps for one in readings)
    assert turned_rad == pytest.approx(world.state(end_ns)[2], abs=1e-6)


def test_beyond_its_range_it_tells_its_limit():
    world = world_of(dataclasses.replace(EXACT, saturation_radps=1.0))
    end_ns = told(world, (0.0, 0.0, SPIN_RADPS), 0.5)
    assert world.gyro(end_ns)[-1].turn_radps == 1.0
