"""Plug-ins by name: a plug-in that is found is opened, and any error is one line."""

import sys
import tomllib
from importlib.metadata import EntryPoint
from pathlib import Path
from types import ModuleType, SimpleNamespace

import pytest

from jaxnav.drive import plugins
from jaxnav.drive.interfaces import Vehicle
from jaxnav.drive.plugins import CAMERAS, VEHICLES, load_factory, open_cameras, open_vehicle
from jaxnav.errors import BadInput
from tests.helpers.setups import GoodCamera, GoodVehicle, good_cameras, setup_with

ROOT = Path(__file__).resolve().parents[2]
SETUP = setup_with()
HERE = "tests.helpers.setups"


@pytest.fixture(autouse=True)
def installed(monkeypatch):
    """Entry points as an installation has them."""
    points = [
        EntryPoint("good", f"{HERE}:GoodVehicle", VEHICLES),
        EntryPoint("gone", "no_such_package.cars:open_vehicle", VEHICLES),
        EntryPoint("good", f"{HERE}:good_cameras", CAMERAS),
    ]
    monkeypatch.setattr(
        plugins, "entry_points", lambda group: [point for point in points if point.group == group]
    )


@pytest.fixture
def module(monkeypatch):
    """A module of somebody's: what it holds is set by the test."""
    module = ModuleType("somebodys")
    monkeypatch.setitem(sys.modules, "somebodys", module)
    return module


def test_a_vehicle_is_found_by_its_entry_point_or_by_module_and_name(module):
    module.cars = SimpleNamespace(fast=GoodVehicle)
    for name in ("good", f"{HERE}:GoodVehicle", "somebodys:cars.fast"):
        assert isinstance(open_vehicle(name, SETUP), GoodVehicle)


def test_cameras_are_found_and_told_of_the_vehicle(module):
    told = []
    module.opens = lambda setup, vehicle: told.append(vehicle) or good_cameras(setup, vehicle)
    vehicle = open_vehicle("good", SETUP)
    assert [camera.name for camera in open_cameras("good", SETUP, vehicle)] == list(SETUP.rig.names)
    assert len(open_cameras("somebodys:opens", SETUP, vehicle)) == len(SETUP.rig)
    assert told == [vehicle]


@pytest.mark.parametrize(
    ("name", "problem"),
    [
        ("best", "there is no 'best': expected gone, good or module:name"),
        ("", "there is no '': expected gone, good or module:name"),
        (":open", "there is no ':open'"),
        ("somebodys:", "there is no 'somebodys:'"),
        ("gone", "gone needs the module no_such_package, which is missing: is it installed, or"),
        ("nowhere.to:be", "nowhere.to:be needs the module nowhere, which is missing"),
        ("somebodys:lost", "somebodys:lost: the module somebodys has no 'lost'"),
        ("somebodys:number.x", "the module somebodys has no 'number.x'"),
        ("somebodys:number", "somebodys:number is an object of the class int, expected a function"),
        ("somebodys:nothing", "somebodys:nothing gives None, which has no timeout_s, read()"),
        ("somebodys:needs_pal", "needs the module pal, which is missing: it comes with Quanser's"),
        ("somebodys:old", "could not be imported: ImportError: cannot import name 'x' from 'y'"),
        ("somebodys:unplugged", "could not be opened: FileNotFoundError: [Errno 2] no /dev/car"),
        ("somebodys:refuses", "--option speed: expected a number"),
        ("somebodys:broken", "could not be opened: IndexError: list index out of range (test_plug"),
        ("somebodys:leaves", "could not be opened: SystemExit: 3 (test_plugins.py:"),
    ],
)
def test_what_is_wrong_with_a_vehicle_is_one_line(module, name, problem):
    def raises(error):
        def factory(setup):
            raise error

        return factory

    module.number = 3
    module.nothing = lambda setup: None
    module.needs_pal = raises(ModuleNotFoundError("No", name="pal"))
    module.old = raises(ImportError("cannot import name 'x' from 'y'"))
    module.unplugged = raises(FileNotFoundError(2, "no /dev/car"))
    module.refuses = raises(BadInput("--option speed", "expected a number"))
    module.broken = lambda setup: [][0]
    module.leaves = raises(SystemExit(3))
    with pytest.raises(BadInput) as raised:
        open_vehicle(name, SETUP)
    assert problem in str(raised.value)
    assert str(raised.value).startswith("--")


def test_a_module_that_fails_on_import_is_one_line(tmp_path, monkeypatch):
    (tmp_path / "halfcar.py").write_text("import\n")
    monkeypatch.syspath_prepend(tmp_path)
    with pytest.raises(BadInput, match="--car: halfcar:x: importing halfcar failed: SyntaxErr"):
        open_vehicle("halfcar:x", SETUP)


@pytest.mark.parametrize("lacking", ["timeout_s", "read", "write", "stop", "close"])
def test_a_method_that_a_vehicle_lacks_is_named_and_it_is_closed(module, lacking):
    opened = []

    def factory(setup):
        good = GoodVehicle(setup)
        members = {n: getattr(good, n) for n in vars(Vehicle) if not n.startswith("_")}
        del members[lacking]
        opened.append(good)
        return SimpleNamespace(**members)

    module.opens = factory
    shown = "timeout_s" if lacking == "timeout_s" else rf"{lacking}\(\)"
    with pytest.raises(BadInput, match=f"an object of the class SimpleNamespace, .*no {shown}$"):
        open_vehicle("somebodys:opens", SETUP)
    assert opened[0].closed == (lacking != "close")


@pytest.mark.parametrize(
    ("change", "problem"),
    [
        (lambda cameras: cameras[::-1], "gives the cameras left, rear, right, front, expected"),
        (lambda cameras: cameras[:3], "those of the rig: front, right, rear, left"),
        (lambda cameras: None, "gives None, expected a sequence of cameras"),
        (lambda cameras: iter(cameras), "of the class list_iterator, expected a sequence"),
        (lambda cameras: [*cameras[:2], "rear", cameras[3]], "class str as camera 2, which"),
    ],
)
def test_cameras_that_are_not_the_rigs_are_refused_and_closed(module, change, problem):
    cameras = good_cameras(SETUP, None)
    given = change(cameras)
    module.opens = lambda setup, vehicle: given
    with pytest.raises(BadInput) as raised:
        open_cameras("somebodys:opens", SETUP, GoodVehicle(SETUP))
    assert problem in str(raised.value)
    assert str(raised.value).startswith("--cameras: somebodys:opens gives")
    kept = given if isinstance(given, list) else []
    assert all(camera.closed.is_set() for camera in kept if isinstance(camera, GoodCamera))


def test_cameras_that_need_no_vehicle_are_tried_and_closed(module):
    cameras = good_cameras(SETUP, None)
    told = []
    module.opens = lambda setup, vehicle: told.append(vehicle) or cameras
    plugins.try_cameras("somebodys:opens", SETUP)
    assert told == []
    module.opens.needs_no_vehicle = True
    plugins.try_cameras("somebodys:opens", SETUP)
    assert told == [None]
    assert all(camera.closed.is_set() for camera in cameras)


def test_an_error_while_closing_does_not_hide_the_reason(module):
    def unplugged():
        raise OSError("no cable")

    module.opens = lambda setup: SimpleNamespace(close=unplugged)
    with pytest.raises(BadInput, match="which has no timeout_s"):
        open_vehicle("somebodys:opens", SETUP)


def declared():
    project = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]
    for group in (VEHICLES, CAMERAS):
        for target in project["entry-points"][group].values():
            yield group, target


@pytest.mark.parametrize(("group", "target"), list(declared()))
def test_what_jaxnav_declares_is_there(group, target):
    """Without the makers' software: it is imported when something is opened."""
    assert load_factory("--car", group, target).__name__ == target.partition(":")[2]
