"""How far a vehicle may leave its route, and what happens beyond."""

import dataclasses

import numpy as np
import pytest

from jaxnav.drive.flags import Fault, Health
from jaxnav.drive.leaving import Corridor
from jaxnav.errors import BadInput
from jaxnav.files import Route, load_route
from jaxnav.vehicles.conformance.lockstep import BEGIN_NS, drive
from jaxnav.vehicles.world import SimWorld
from tests.helpers.simulated import make_setup

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


def test_a_route_of_one_place_where_it_stands_is_a_circle():
    corridor = Corridor([(0.0, 0.0)], 1.0)
    assert [corridor.is_left(np.array(at, float)) for at in ((0, 0), (0.9, 0), (0, 1.1))] == [
        0,
        0,
        1,
    ]


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


def test_who_leaves_the_route_stands():
    """Carried away by a metre, it knows where it is again, and does not drive from there."""
    setup = make_setup()
    setup = dataclasses.replace(setup, route=dataclasses.replace(setup.route, leave_m=0.5))
    world = SimWorld(
        setup.rig, setup.markers, setup.vehicle, setup.route.start_pose, BEGIN_NS
    )  # fmt: skip
    carried = [(1.2, -0.8, 0.0)]

    def happens(now_ns: int, world: SimWorld) -> None:
        if now_ns > BEGIN_NS + 2_000_000_000 and carried:
            world.carry_off(carried.pop())

    outcomes = [step.outcome for step in drive(setup.pilot(None), world, 6.0, happens=happens)]
    left = [outcome for outcome in outcomes if Fault.LEFT_ROUTE in outcome.faults]
    assert left
    assert {outcome.health for outcome in left} == {Health.STOP}
    assert left[-1].command[1] == 0.0
    assert not any(Fault.LEFT_ROUTE in o.faults for o in outcomes if o.now_ns < BEGIN_NS + 2e9)
