"""Checks of a base that is no car: its file, its route, and what its odometer reads at rest."""

import pytest

from jaxnav.commands.doctor.plug_ins import Reading, judge_odometry
from jaxnav.commands.doctor.route_file import route_file, turning_radius_m, vehicle_file
from jaxnav.core.models.vehicle import TwistBase
from jaxnav.drive.chassis import chassis_of
from jaxnav.drive.interfaces import Odometry, TwistOdometry
from jaxnav.files import calib_dir, load_route
from tests.helpers.findings import all_well, the_problem
from tests.worlds import paper_markers

BASE = TwistBase.create(1.0, 4.0, 0.15)
BEGIN_NS, PERIOD_NS = 10**12, 20_000_000


def test_a_small_base_and_its_route_are_in_order():
    assert all_well(vehicle_file(BASE))
    assert turning_radius_m(BASE) == 0
    route = load_route(calib_dir() / "qcar" / "route.yaml")
    assert all_well(route_file(route, BASE, paper_markers()))


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


def readings(*values, kind=TwistOdometry):
    stamps = [BEGIN_NS + PERIOD_NS * n for n in range(20)]
    return [Reading(kind(stamp_ns, *values), stamp_ns + 5_000_000, 0.001) for stamp_ns in stamps]


def test_a_base_at_rest_is_in_order():
    (found,) = judge_odometry(readings(0.0, 0.0, 0.01), [], chassis_of(BASE))
    assert found.level == "ok"
    assert found.what.endswith("+0.00 m/s ahead, +0.00 to the left, turns +0.01 rad/s")


@pytest.mark.parametrize(
    ("given", "level", "words"),
    [
        (readings(0.0, 0.0, 0.5), "warning", "turns +0.50 rad/s, 20 times the very same"),
        (readings(0.0, 0.3, 0.0), "warning", "+0.30 to the left"),
        (readings(0.0, 0.0, float("nan")), "error", "20 of 20 valid readings are no numbers"),
        (readings(0.0, 0.0, kind=Odometry), "error", "readings are of the kind Odometry"),
    ],
)
def test_a_base_that_reads_what_can_not_be(given, level, words):
    assert words in the_problem(judge_odometry(given, [], chassis_of(BASE)), level).what
