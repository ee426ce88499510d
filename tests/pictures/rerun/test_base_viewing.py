"""What Rerun shows of a base that is no car: its twist, and the names of its errors."""

import dataclasses
from unittest.mock import MagicMock

import numpy as np

from jaxnav.core.models.vehicle import SENSOR_ERRORS, TWIST_ERRORS
from jaxnav.pictures.rerun.scene import RerunScene
from jaxnav.recordings.records import Outcomes
from tests.helpers.drives import make_outcome


def shown(outcomes: Outcomes) -> tuple[set[str], list[list[str]]]:
    """The plots that get a value, and the names that the sensors' errors are given."""
    rerun, stream = MagicMock(), MagicMock()
    scene = RerunScene(rerun, stream, None, None, np.zeros((0, 2)))
    scene.show(outcomes, 0)
    scene.show(outcomes, 0)
    plots = {call.args[0] for call in stream.log.call_args_list if "plots/" in call.args[0]}
    return plots, [call.kwargs["names"] for call in rerun.SeriesLines.call_args_list]


def test_a_base_shows_its_twist_and_a_car_its_throttle():
    car = Outcomes.from_outcome(make_outcome(1))
    base = Outcomes.from_outcome(dataclasses.replace(make_outcome(1), twist=(0.1, 0.2, 0.3)))
    of_base = {"plots/forward_mps", "plots/left_mps", "plots/turn_radps"}
    of_car = {"plots/throttle", "plots/steering_rad"}
    plots, names = shown(base)
    assert of_base <= plots
    assert not of_car & plots
    assert names == [list(SENSOR_ERRORS), list(TWIST_ERRORS)]
    plots, names = shown(car)
    assert of_car <= plots
    assert not of_base & plots
    assert names == [list(SENSOR_ERRORS)]
