"""The setup of a drive is restored from its header bit for bit, or not at all."""

import dataclasses
import math
from pathlib import Path

import jax
import jax.numpy as jnp
import jaxlie
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from jaxnav.core.models.camera import Camera
from jaxnav.core.models.lenses import LENSES
from jaxnav.core.models.rig import CameraRig
from jaxnav.core.models.vehicle import Vehicle
from jaxnav.core.parameters import TUNABLES, parameters_of
from jaxnav.drive.health import Timeouts
from jaxnav.errors import BadInput
from jaxnav.files import Params, Route
from jaxnav.files.markers import marker_map
from jaxnav.recordings.drive_format import decode, encode
from jaxnav.recordings.drive_setup import (
    PILOT_SELECTORS,
    DriveSetup,
    made_here,
    needs_float64,
)
from tests import worlds
from tests.helpers.bad_input import problem

WHERE = Path("drive.mcap")
ROUTE = Route(((1.3, 0.1), (0.5, 0.65)), 0.15, (2.0, -1.0, 2.18))


def qcar_setup(**changes) -> DriveSetup:
    parts = worlds.qcar_rig(), worlds.paper_markers(), worlds.qcar(), ROUTE
    return dataclasses.replace(DriveSetup(*parts, float64=True), **changes)


def bits(setup: DriveSetup) -> list:
    """Everything in a setup, comparable."""
    arrays = setup.rig, setup.markers, setup.vehicle
    leaves, structure = jax.tree.flatten(arrays)
    names = ("route", "selector", "corner_sigma_px", "timeouts", "parameters")
    plain = [getattr(setup, name) for name in names]
    told = [(leaf.dtype.name, leaf.shape, np.asarray(leaf).tobytes()) for leaf in leaves]
    return [str(structure), told, plain, setup.float64, setup.relocate]


small = st.floats(-10, 10)
positive = st.floats(0.01, 100)
quaternions = st.lists(st.floats(-0.4, 0.4), min_size=4, max_size=4)
poses = st.tuples(quaternions, st.lists(small, min_size=3, max_size=3))
cameras = st.sampled_from(sorted(LENSES)).flatmap(
    lambda lens: st.tuples(
        st.tuples(st.floats(66, 6e4), st.floats(66, 6e4)),
        st.tuples(st.floats(-60, 120), st.floats(-60, 120)),
        st.just(lens),
        st.tuples(
            *(
                st.floats(least, min(most, 10))
                for least, most in (
                    LENSES[lens].within.get(name, (-10, 10)) for name in LENSES[lens].coefficients
                )
            )
        ),
    )
)
sizes_px = st.tuples(st.integers(60, 65536), st.integers(60, 65536))
placed_markers = st.tuples(
    poses, positive, st.integers(0, 29), st.sampled_from(["tag36h11", "4x4_50"])
)
vehicles = st.tuples(positive, st.floats(0.01, 1.5), *[positive] * 4)
routes = st.builds(
    Route,
    st.lists(st.tuples(small, small), min_size=1, max_size=4).map(tuple),
    positive,
    st.tuples(small, small, small),
    st.none() | positive,
)
sound = st.floats(1e-18, 1e9)
parameters = st.fixed_dictionaries(
    {},
    optional={
        "controller.proportional_per_m": sound,
        "motion.gate_nis": sound | st.just(math.inf),
        "motion.odometry_sigma": st.lists(sound, min_size=3, max_size=3),
        "motion.vision_floor": st.tuples(sound, sound, sound).map(lambda d: np.diag(d).tolist()),
    },
)
timeouts = st.builds(Timeouts, *[st.floats(0, allow_infinity=True)] * 8)


def wxyz_xyz(pose: tuple[list[float], list[float]]) -> np.ndarray:
    wxyz = np.array([1.0, 0, 0, 0]) + pose[0]
    return np.concatenate([wxyz / np.linalg.norm(wxyz), pose[1]])


@pytest.mark.parametrize("double", [False, True])
def test_a_setup_comes_back_bit_for_bit(double):
    @settings(max_examples=25, derandomize=True)
    @given(
        st.lists(st.tuples(cameras, poses, sizes_px), min_size=1, max_size=3),
        st.lists(placed_markers, min_size=1, max_size=3, unique_by=lambda marker: marker[2:]),
        vehicles,
        st.tuples(routes, st.sampled_from(PILOT_SELECTORS), st.none() | positive, timeouts),
        parameters,
        st.booleans(),
        st.booleans(),
    )
    def check(rig, markers, vehicle, others, parameters, relocate, drives) -> None:
        lenses, placed, images = zip(*rig, strict=True)
        setup = DriveSetup(
            CameraRig.create(
                [Camera.create(*lens) for lens in lenses],
                [jaxlie.SE3(jnp.asarray(wxyz_xyz(pose), float)) for pose in placed],
                ["front", "a/b", "c.d"][: len(rig)],
                images,
            ),
            marker_map(
                np.stack([wxyz_xyz(pose) for pose, *_ in markers]),
                *map(list, zip(*(marker[1:] for marker in markers), strict=True)),
            ),
            Vehicle.create(*vehicle),
            *others,
            double,
            parameters,
            relocate,
            drives,
        )
        back = DriveSetup.from_header(decode(encode(setup.header())), WHERE)
        assert bits(back) == bits(setup)

    with jax.enable_x64(double):
        check()


def test_a_header_says_who_recorded_it():
    setup = qcar_setup(timeouts=Timeouts(stop_s=math.inf), corner_sigma_px=0.25)
    header = decode(encode(setup.header()))
    assert header["made_by"]["jax"] == jax.__version__
    assert made_here(header)
    assert needs_float64(header, WHERE)
    assert not made_here(header | {"made_by": header["made_by"] | {"jaxlib": "0.0"}})
    assert not made_here({})


def test_parameters_reach_the_navigator_and_come_with_the_header():
    setup = qcar_setup()
    assert "parameters" not in setup.header()  # as older programs read it
    values = {"motion.odometry_sigma": [0.1, 0.2, 0.3], "selector.floor_m": 1e-3}
    tuned = setup.with_params(Params.from_values(values, WHERE))
    back = DriveSetup.from_header(decode(encode(tuned.header())), WHERE)
    for one in (tuned, back):
        found = parameters_of(one.navigator())
        np.testing.assert_array_equal(found["motion.odometry_sigma"], [0.1, 0.2, 0.3])
        assert float(found["selector.floor_m"]) == 1e-3
        assert float(found["motion.tilt_sigma_rad"]) == 0.005
        np.testing.assert_array_equal(one.navigator().controller.waypoints_m, ROUTE.waypoints_m)
    # Another selector may lack a number; another file takes the place of the whole one.
    assert dataclasses.replace(back, selector="paper-cost").navigator()
    assert back.with_params(Params.from_values({"corner_sigma_px": 2}, WHERE)).parameters == {
        "corner_sigma_px": 2.0
    }
    with pytest.raises(BadInput, match=r"^drive.mcap: parameters.motion.vision_floor: must have 3"):
        setup.with_params(Params.from_values({"motion.vision_floor": [1] * 6}, WHERE))


def test_what_parameters_say_of_cameras_and_sensors_the_setup_says_itself():
    """Also where it is read back; a rule that takes one pose has no use for the sensors'."""
    sigma, turned = [0.05, 0.04, 0.03, 0.02], [[0.01] * 3 + [0.02] * 3] * 4
    values = {"motion.vehicle.sensor_sigma": sigma, "rig.extrinsics_sigma": turned}
    tuned = dataclasses.replace(
        qcar_setup(), rig=worlds.qcar_rig_by_hand(), vehicle=worlds.qcar_by_hand()
    ).with_params(Params.from_values(values, WHERE))
    rule = dataclasses.replace(tuned, selector="paper-cost")
    for one in (tuned, rule):
        for setup in (one, DriveSetup.from_header(decode(encode(one.header())), WHERE)):
            np.testing.assert_allclose(setup.vehicle.sensor_sigma, sigma, rtol=1e-12)
            np.testing.assert_allclose(setup.rig.extrinsics_sigma, turned, rtol=1e-12)
            known = parameters_of(setup.navigator())
            np.testing.assert_allclose(known["rig.extrinsics_sigma"], turned, rtol=1e-12)
            assert ("motion.vehicle.sensor_sigma" in known) == (one is tuned)


def test_a_rule_without_a_gate_drives_without_one():
    """Also where its header has the gate that other rules were given."""
    tuned = qcar_setup().with_params(Params.from_values({"motion.gate_nis": 30}, WHERE))
    for selector, gate_nis in (("paper-cost", 30), ("paper-cost-ungated", math.inf)):
        header = dataclasses.replace(tuned, selector=selector).header()
        navigator = DriveSetup.from_header(decode(encode(header)), WHERE).navigator()
        assert type(navigator.selector).__name__ == "PaperCost"
        assert float(navigator.motion.gate_nis) == gate_nis


def test_a_bad_header_is_named_with_its_key():
    h = decode(encode(qcar_setup().header()))
    camera = h["rig"]["cameras"][0]
    of_odometry = "parameters.motion.odometry_sigma"
    for key, value, line in [
        ("setup_version", 2, "setup_version: this program reads 1, the file has 2"),
        ("setup_version", None, "setup_version: missing"),
        ("rig", None, "rig: missing"),
        ("colour", "red", "colour: unknown key: expected setup_version, rig"),
        ("selector", "oracle", "selector: unknown 'oracle': expected one of multi"),
        ("corner_sigma_px", 0, "corner_sigma_px: must be > 0, got 0"),
        ("float64", 1, "float64: "),
        ("parameters", [1], "parameters: must be a mapping, got [1]"),
        ("parameters", {"motion.speed": 1},
         f"parameters.motion.speed: unknown: of {len(TUNABLES)} names the nearest are motion."),
        ("parameters", {"motion.odometry_sigma": [1, -1, 1]},
         f"{of_odometry}[1]: must be > 0, got -1"),
        ("parameters", {"motion.odometry_sigma": [1, 1]},
         f"{of_odometry}: must have 3 entries or 3 rows of 3, got 2 entries"),
        ("timeouts", h["timeouts"] | {"stop_s": math.nan},
         "timeouts.stop_s: must be >= 0, got nan"),
        ("rig", {"cameras": [camera | {"lens": "fish"}]},
         "rig.cameras.front.lens: must be 'none', 'radtan', 'rational', 'thin_prism', "),
        ("route", h["route"] | {"start_pose": [1.0]},
         "route.start_pose: must have at least 3 entries, got 1"),
    ]:  # fmt: skip
        header = h | {key: value}
        if value is None:
            del header[key]
        found = problem(DriveSetup.from_header, header, WHERE)
        assert found.startswith(f"drive.mcap: header.{line}")


@pytest.mark.parametrize("name", ["relocate", "drives"])
def test_only_a_drive_that_must_not_says_so(name):
    """So that older programs read what they can replay, and older drives are read."""
    assert name not in qcar_setup().header()
    header = qcar_setup(**{name: False}).header()
    assert header[name] is False
    assert not getattr(DriveSetup.from_header(header, WHERE), name)
    with pytest.raises(BadInput, match=rf"drive.mcap: header.{name}"):
        DriveSetup.from_header(header | {name: "no"}, WHERE)
