"""`jaxnav stop` tells a vehicle to stop that nobody drives any more, and whether it has heard.

See docs/promises.md, It stops.
"""

import errno
import os
import time
from pathlib import Path

import pytest

from jaxnav.cli import main
from jaxnav.commands.drive import stop
from jaxnav.files import calib_dir
from tests.helpers import plain_base, plain_car
from tests.helpers.processes import ROOT, python

BASE = "base: differential\nforward_limit_mps: 1\nturn_limit_radps: 3.0\ntime_constant_s: 0.15\n"


def open_busy(setup):
    """A car that another process holds."""
    raise OSError(errno.EBUSY, os.strerror(errno.EBUSY), "/dev/ttyACM0")


def open_held(setup):
    """A car whose driver never comes back."""
    time.sleep(60.0)


def test_a_car_hears_it_and_neither_jax_nor_opencv_is_loaded(tmp_path):
    script = (
        "import sys; from jaxnav.cli import main; assert main(sys.argv[1:]) == 0;"
        "heavy = {'jax', 'cv2', 'pydantic', 'scipy'} & set(sys.modules); assert not heavy, heavy"
    )
    told = ["stop", "--car", plain_car.NAME, "--option", f"log={tmp_path / 'log'}"]
    ran = python("-c", script, *told)
    assert ran.communicate()[0] == f"{plain_car.NAME} has heard that it must stop\n"
    assert ran.returncode == 0
    words = plain_car.words(tmp_path / "log")
    assert words
    assert {(word.steering_rad, word.throttle) for word in words} == {(0.0, 0.0)}


def test_a_base_hears_zero_in_all_its_parts(tmp_path, capsys):
    (tmp_path / "base.yaml").write_text(BASE)
    told = ["--option", f"log={tmp_path / 'log'}", "--vehicle", str(tmp_path / "base.yaml")]
    assert main(["stop", "--car", plain_base.NAME, *told]) == 0
    assert {word.twist for word in plain_base.words(tmp_path / "log")} == {(0.0, 0.0, 0.0)}
    assert capsys.readouterr().out == f"{plain_base.NAME} has heard that it must stop\n"


def test_it_is_said_until_it_is_heard_and_who_does_not_hear_is_named(tmp_path, capsys, monkeypatch):
    deaf = tmp_path / "deaf"
    deaf.touch()
    told = ["--option", f"log={tmp_path / 'log'}", "--option", f"deaf={deaf}"]
    monkeypatch.setattr(stop.Guard.close, "__defaults__", (0.2,))
    assert main(["stop", "--car", plain_car.NAME, *told]) == 1
    line = f"{plain_car.NAME} HAS NOT HEARD THAT IT MUST STOP: OSError: the bus is out\n"
    assert capsys.readouterr().out == line
    assert plain_car.words(tmp_path / "log") == []


def test_who_can_not_be_opened_has_not_heard(capsys):
    """Another process has it: the guard's, perhaps, which stops it itself."""
    assert main(["stop", "--car", f"{__name__}:open_busy"]) == 1
    out = capsys.readouterr().out
    assert "HAS NOT HEARD THAT IT MUST STOP: --car: " in out
    assert "could not be opened: OSError: [Errno 16]" in out
    assert out.count("\n") == 1


def test_a_driver_that_hangs_is_not_waited_for(tmp_path):
    script = (
        "import sys; from jaxnav.commands.drive import stop; from jaxnav.cli import main;"
        "stop._OPENS_WITHIN_S = stop.HEARD_WITHIN_S = 0.2; main(sys.argv[1:])"
    )
    name = f"{Path(__file__).relative_to(ROOT).with_suffix('').as_posix().replace('/', '.')}"
    ran = python("-c", script, "stop", "--car", f"{name}:open_held")
    told, _ = ran.communicate(timeout=50.0)
    assert ran.returncode == 1
    assert told.endswith("HAS NOT HEARD THAT IT MUST STOP: its driver hangs\n")


def test_a_plug_in_finds_the_same_numbers_as_in_a_drive(tmp_path):
    """What is read here without JAX, against the loader that has it."""
    from jaxnav.files import load_vehicle

    (tmp_path / "base.yaml").write_text(BASE)
    for path in (calib_dir() / "qcar" / "vehicle.yaml", tmp_path / "base.yaml"):
        vehicle, numbers = load_vehicle(path), stop.numbers_of(path)
        assert numbers.keys() == vars(vehicle).keys() - {"sensor_sigma", "gyro"}
        for key, number in numbers.items():
            assert number == pytest.approx(float(getattr(vehicle, key)), rel=1e-6), key
