"""Vehicle files of bases that are no cars, and of gyros."""

from pathlib import Path

import jax
import numpy as np
import pytest
import yaml

from jaxnav.core.models.imu import GYROS
from jaxnav.core.models.vehicle import DEFAULT_TWIST_SIGMA, TwistBase
from jaxnav.errors import BadInput
from jaxnav.files import calib_dir, load_car, load_vehicle, save_vehicle

DIFFERENTIAL = {
    "base": "differential",
    "forward_limit_mps": 1.2,
    "turn_limit_radps": 3.0,
    "time_constant_s": 0.15,
}
OMNI = DIFFERENTIAL | {"base": "mecanum", "left_limit_mps": 0.7}
CAR = yaml.safe_load((calib_dir() / "qcar" / "vehicle.yaml").read_text())


def written(folder: Path, data: dict) -> Path:
    path = folder / "vehicle.yaml"
    path.write_text(yaml.safe_dump(data))
    return path


def test_a_base_as_its_file_says(tmp_path):
    base = load_vehicle(written(tmp_path, DIFFERENTIAL | {"sigma": {"turn_gain": 0.1}}))
    assert isinstance(base, TwistBase)
    np.testing.assert_allclose(base.limits, [1.2, 0.0, 3.0])
    np.testing.assert_allclose(
        base.sensor_sigma, [DEFAULT_TWIST_SIGMA[0], 0.1, *DEFAULT_TWIST_SIGMA[2:]]
    )
    assert base.gyro is None
    exact = dict.fromkeys(("speed_scale", "turn_gain", "turn_offset_radpm", "camera_delay_s"), 0.0)
    assert load_vehicle(written(tmp_path, OMNI | {"sigma": exact})).sensor_sigma is None


@pytest.mark.parametrize("data", [DIFFERENTIAL, OMNI, CAR], ids=["differential", "omni", "car"])
@pytest.mark.parametrize("gyro", [None, {"class": "tactical", "delay_s": 0.004}])
def test_what_is_saved_is_read_back_bit_for_bit(data, gyro, tmp_path):
    given = data if gyro is None else data | {"gyro": gyro}
    vehicle = load_vehicle(written(tmp_path, given))
    save_vehicle(tmp_path / "saved.yaml", vehicle)
    again = load_vehicle(tmp_path / "saved.yaml")
    assert jax.tree.structure(again) == jax.tree.structure(vehicle)
    for one, other in zip(jax.tree.leaves(again), jax.tree.leaves(vehicle), strict=True):
        np.testing.assert_array_equal(one, other)
    if gyro is not None:
        assert vehicle.gyro.delay_s == 0.004
        assert vehicle.gyro.noise_density == GYROS["tactical"].noise_density


@pytest.mark.parametrize(
    ("changes", "told"),
    [
        ({"base": "hovercraft"}, "base: must be"),
        ({"turn_limit_radps": -1.0}, "turn_limit_radps: must be > 0"),
        ({"forward_limit_mps": 1e5}, "forward_limit_mps: must be from"),
        ({"left_limit_mps": 0.5}, "can't move to its left"),
        ({"base": "omni"}, "needs left_limit_mps"),
        ({"wheelbase_m": 0.3}, "wheelbase_m: unknown key"),
        ({"sigma": {"steering_gain": 0.1}}, "sigma: unknown steering_gain"),
        ({"sigma": {"turn_offset_radpm": 0.9}}, "at most 0.35"),
        ({"gyro": {"class": "best"}}, "gyro.class: must be"),
        ({"gyro": {"noise_density": 0.0}}, "gyro.noise_density: must be"),
        ({"gyro": {"delay_s": 3.0}}, "gyro.delay_s: must be"),
        ({"gyro": {"bias": 3.0}}, "gyro.bias: unknown key"),
    ],
)
def test_bad_input_is_one_line(changes, told, tmp_path):
    with pytest.raises(BadInput) as bad:
        load_vehicle(written(tmp_path, DIFFERENTIAL | changes))
    message = str(bad.value)
    assert told in message
    assert "vehicle.yaml" in message
    assert "\n" not in message


def test_where_only_cars_drive_other_vehicles_are_refused(tmp_path):
    with pytest.raises(BadInput, match=r"vehicle\.yaml: base: must be ackermann here"):
        load_car(written(tmp_path, DIFFERENTIAL))
    with pytest.raises(BadInput, match=r"vehicle\.yaml: gyro: must be left out here"):
        load_car(written(tmp_path, CAR | {"gyro": {"class": "consumer"}}))
    assert float(load_car(written(tmp_path, CAR | {"base": "ackermann"})).wheelbase_m) > 0
