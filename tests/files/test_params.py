"""Tuned parameters are read back bit for bit and reach the navigator, or one line says why not."""

import json
import math
from pathlib import Path

import jax.numpy as jnp
import numpy as np
import pytest
import yaml
from hypothesis import given, settings
from hypothesis import strategies as st

from jaxnav.core.filter.choose import PaperCost, Ungated
from jaxnav.core.navigator import Navigator
from jaxnav.core.parameters import TUNABLES, parameters_of
from jaxnav.files import Params, apply_params, calib_dir, load_params, write_params
from tests import worlds
from tests.helpers.bad_input import problem

RIG, MARKERS, QCAR = worlds.qcar_rig_by_hand(), worlds.paper_markers(), worlds.qcar_by_hand()
CAR = Navigator(RIG, MARKERS, QCAR, worlds.WAYPOINTS_M)
PARKED = Navigator(RIG, MARKERS, QCAR)  # a car that goes nowhere has no controller
FREE = Navigator(RIG, MARKERS)
NAVIGATORS = {"car": CAR, "parked": PARKED, "free": FREE}
WHERE = Path("p.yaml")


def written(folder: Path, text: str) -> Path:
    path = folder / "p.yaml"
    path.write_text(text)
    return path


def bits(values) -> dict:
    arrays = {name: np.asarray(value, np.float64) for name, value in values.items()}
    return {name: (array.shape, array.tobytes()) for name, array in arrays.items()}


positive = st.floats(1e-18, 1e9)


def covariances(size: int) -> st.SearchStrategy[np.ndarray]:
    """Of any scale, and never nearly singular."""
    entries = st.lists(st.floats(-1, 1), min_size=size * size, max_size=size * size)
    scales = st.lists(st.floats(1e-9, 1e4), min_size=size, max_size=size)

    def covariance(drawn) -> np.ndarray:
        A, scale = np.reshape(drawn[0], (size, size)), np.array(drawn[1])
        matrix = (A @ A.T + 0.1 * np.eye(size)) * np.outer(scale, scale)
        return (matrix + matrix.T) / 2

    return st.tuples(entries, scales).map(covariance)


def tuned(navigator: Navigator) -> st.SearchStrategy[dict]:
    """Some of a navigator's parameters, in any form that they may have."""
    known = {}
    for name, value in parameters_of(navigator).items():
        count = value.size
        most = TUNABLES[name].most
        known[name] = st.lists(
            st.floats(1e-18, min(most)) if most else positive, min_size=count, max_size=count
        ).map(lambda entries, shape=value.shape: np.reshape(entries, shape))
        if TUNABLES[name].matrix is not None:
            known[name] |= covariances(value.shape[0])
        if TUNABLES[name].guard:
            known[name] |= st.just(np.array(math.inf))
    return st.fixed_dictionaries({}, optional=known).filter(len)


@pytest.mark.parametrize("kind", NAVIGATORS)
def test_numbers_come_back_bit_for_bit_and_reach_the_navigator(kind, tmp_path):
    navigator, path = NAVIGATORS[kind], tmp_path / "p.yaml"
    before = bits(parameters_of(navigator))

    @settings(max_examples=40, derandomize=True)
    @given(tuned(navigator))
    def check(values: dict) -> None:
        write_params(path, values)
        params = load_params(path)
        assert bits(params.values) == bits(values)
        assert list(params.values) == [name for name in TUNABLES if name in values]
        again = Params.from_values(json.loads(json.dumps(params.plain())), path)
        assert bits(again.values) == bits(values)
        changed = parameters_of(apply_params(navigator, params))
        assert bits(changed) == before | bits(values)

    check()


def test_a_navigator_keeps_its_precision(precision, tmp_path):
    rig, car = worlds.qcar_rig_by_hand(), worlds.qcar_by_hand()
    navigator = Navigator(rig, MARKERS, car, worlds.WAYPOINTS_M)
    known = parameters_of(navigator)
    bounded = {
        name: value for name, value in known.items() if np.all(np.isfinite(value) & (value > 0))
    }
    # lookahead_m and slows_at_rad are infinite, repeated_errors.least_share is 0
    assert len(bounded) == len(known) - 3
    write_params(tmp_path / "p.yaml", bounded)
    changed = parameters_of(apply_params(navigator, load_params(tmp_path / "p.yaml")))
    assert bits(changed) == bits(known)
    assert {value.dtype for value in changed.values()} == {precision}


def test_a_file_as_a_person_writes_it(tmp_path):
    text = """
    parameters:
      controller.proportional_per_m: 1   # a whole number is one
      motion.odometry_sigma: [1e-2, 0.02, .03]
      motion.vision_floor:
        - [1, 0.5, 0]
        - [0.5, 1, 0]
        - [0, 0, 1e-8]
    """
    params = load_params(written(tmp_path, text))
    assert params.values["controller.proportional_per_m"].shape == ()
    assert params.values["motion.odometry_sigma"].tolist() == [0.01, 0.02, 0.03]
    assert params.values["motion.vision_floor"][2, 2] == 1e-8
    assert {value.dtype for value in params.values.values()} == {np.dtype(np.float64)}
    assert (params.provenance, params.path) == ({}, tmp_path / "p.yaml")
    assert params.describe() == f"3 parameters from {tmp_path / 'p.yaml'}"


def test_what_is_written_says_what_it_means(tmp_path):
    values = {"controller.proportional_per_m": 0.05, "corner_sigma_px": jnp.asarray(0.25)}
    write_params(tmp_path / "p.yaml", values, {"command": "jaxnav tune", "loss": np.float32(0.5)})
    assert (tmp_path / "p.yaml").read_text() == (
        "parameters:\n"
        "  # R: corners that come without a sigma of their own [px]\n"
        "  corner_sigma_px: 0.25\n"
        "  # p1: throttle per distance [1/m]\n"
        "  controller.proportional_per_m: 0.05\n"
        "provenance:\n"
        "  command: jaxnav tune\n"
        "  loss: 0.5\n"
    )


def test_a_gate_may_be_none_and_stays_none(tmp_path):
    """In a file that a person writes, in one that is written, and of a rule that has none."""
    assert [name for name, tunable in TUNABLES.items() if tunable.guard] == ["motion.gate_nis"]
    params = load_params(written(tmp_path, "parameters: {motion.gate_nis: .inf}"))
    for navigator in NAVIGATORS.values():
        assert apply_params(navigator, params).motion.gate_nis == np.inf
    write_params(tmp_path / "p.yaml", {"motion.gate_nis": jnp.asarray(jnp.inf)})
    assert "restart [1]\n  motion.gate_nis: .inf\n" in (tmp_path / "p.yaml").read_text()
    values = {"motion.gate_nis": 30, "model_sigma_px": 0.2}
    for selector, gate_nis in ((PaperCost(), 30), (Ungated(PaperCost()), np.inf)):
        navigator = apply_params(
            Navigator(RIG, MARKERS, QCAR, selector=selector), Params.from_values(values, WHERE)
        )
        assert float(navigator.motion.gate_nis) == gate_nis
        assert float(navigator.model_sigma_px) == 0.2


plain = st.recursive(
    st.none() | st.booleans() | st.integers(-(10**20), 10**20) | st.text(max_size=8)
    | st.floats(allow_nan=False, allow_infinity=False)
    | st.sampled_from(["1e-5", "08", "0o17", "yes", "null", "~", "", ".inf", "# no", "a: b", "<<"]),
    lambda inner: st.lists(inner, max_size=3) | st.dictionaries(st.text(max_size=5), inner,
                                                                max_size=3),
    max_leaves=6,
)  # fmt: skip


def test_the_shipped_gains_are_for_the_shipped_car():
    params = load_params(calib_dir() / "qcar/tuned.yaml")
    reached = parameters_of(apply_params(CAR, params))
    assert all(name.startswith("controller.") for name in params.values)
    for name, value in params.values.items():
        np.testing.assert_allclose(reached[name], value)


def test_provenance_is_kept_and_shown(tmp_path):
    path, values = tmp_path / "p.yaml", {"corner_sigma_px": 0.3}

    @settings(max_examples=150, derandomize=True)
    @given(st.dictionaries(st.text(max_size=5), plain, max_size=4))
    def check(provenance: dict) -> None:
        write_params(path, values, provenance)
        params = load_params(path)
        assert params.provenance == provenance
        assert params.describe().isprintable()
        # Another reader of YAML sees the same names at least.
        assert yaml.safe_load(path.read_text())["parameters"] == values

    check()
    shared = ["1.0"]  # YAML has names for such, which are not read
    write_params(path, values, {"a": shared, "b": shared, "c": math.nan, "d": Path("x"), 5: 1})
    provenance = {"a": ["1.0"], "b": ["1.0"], "c": None, "d": "x", "5": 1}
    assert load_params(path).provenance == provenance
    write_params(path, values, {"command": "tune \x1b[2J", "seed": 1, "log": "x" * 999})
    told = load_params(path).describe()
    assert told.startswith(f'1 parameter from {path} (command: "tune \\u001b[2J"; seed: 1; log: "x')
    assert len(told) < 400 + len(str(path))


# --- what is wrong with a file by itself ----------------------------------------------------------

NEAREST = f"of {len(TUNABLES)} names the nearest are"
FLOOR, GATE = ".motion.vision_floor", ".motion.gate_nis"


SQUARE = "must have 3 numbers, as the matrix has 3 rows, got 2 numbers"
LEAST = "must be positive definite: the least eigenvalue of its correlations is"
SIGMA = "corner_sigma_px"
BAD = [
    ("{}", ": must have at least 1 entries, got 0"),
    ("{speed: 1}", f".speed: unknown: {NEAREST} controller.speed_mps, selector.floor_rad, sel"),
    ("{motion: {vision_floor: 1}}", f".motion: unknown: {NEAREST} motion."),
    (f"{{{SIGMA}: big}}", f".{SIGMA}: must be a number, got the text"),
    (f"{{{SIGMA}: {{a: 1}}}}", f".{SIGMA}: must be a number, got {{'a'"),
    (f"{{{SIGMA}: 0}}", f".{SIGMA}: must be > 0, got 0"),
    (f"{{{SIGMA}: 1e-19}}", f".{SIGMA}: must be at least 1e-18, got 1e"),
    (f"{{{SIGMA}: 2e9}}", f".{SIGMA}: must be from -1e+09 to 1e+09, got"),
    (f"{{{SIGMA}: .nan}}", f".{SIGMA}: must be finite, got nan"),
    ("{motion.gate_nis: .nan}", f"{GATE}: must be > 0 and finite, or .inf for none, got nan"),
    ("{motion.gate_nis: 0}", f"{GATE}: must be > 0, got 0"),
    ("{motion.gate_nis: [1, .inf]}", f"{GATE}[1]: must be finite, got inf"),
    ("{motion.vision_floor: []}", f"{FLOOR}: must have 1 to 64 entries, got 0"),
    (f"{{motion.vision_floor: {[1] * 65}}}", f"{FLOOR}: must have 1 to 64 entries, got 65"),
    ("{motion.vision_floor: [1, -1, 1]}", f"{FLOOR}[1]: must be > 0, got -1"),
    ("{motion.vision_floor: [[1, 0], [0, 1], [0, 0]]}", f"{FLOOR}[0]: {SQUARE}"),
    ("{motion.vision_floor: [[1, 0], 1]}", f"{FLOOR}[1]: must have 2 numbers, as the matrix"),
    ("{motion.vision_floor: [[[1]]]}", f"{FLOOR}[0][0]: must be a number, got [1]"),
    ("{motion.vision_floor: [[1, 0], [0, 0]]}", f"{FLOOR}[1][1]: a variance must be at least"),
    ("{motion.vision_floor: [[1, 0.5], [0.4, 1]]}",
     f"{FLOOR}[0][1]: must equal [1][0], 0.4, in a symmetric matrix, got 0.5"),
    ("{motion.vision_floor: [[1e-6, 2e-3], [2e-3, 1]]}", f"{FLOOR}: {LEAST} -1,"),
    ("{motion.vision_floor: [[1e-6, 1e-3], [1e-3, 1]]}", f"{FLOOR}: {LEAST} 0,"),
    ("{motion.initial_velocity_sigma: [[1, 0], [0, 1]]}",
     ".motion.initial_velocity_sigma: can't be a matrix: it is a number, or a"),
    ("{rig.extrinsics_sigma: [[0.01, 0.01, 0.01, 0.02, 0.02]]}",
     ".rig.extrinsics_sigma[0]: must have 6 numbers, got 5"),
    ("{motion.vehicle.sensor_sigma: [0.03, 0.03, 0.5, 0.02]}",
     ".motion.vehicle.sensor_sigma[2]: must be at most 0.35, got 0.5"),
]  # fmt: skip
BAD_FILES = [
    ("", "the file is empty"),
    (f"parameters: {{{SIGMA}: 1}}\nprovenance: me", "provenance: must be a mapping"),
    (f"parameters: {{{SIGMA}: 1}}\ndate: 1", "date: unknown key: expected parameters, "),
    (f"parameters: {{{SIGMA}: 1, {SIGMA}: 2}}", "is not valid YAML: line 1: dupl"),
]


def test_a_bad_parameter_is_named_with_its_key(tmp_path):
    texts = [(f"parameters: {values}\n", f"parameters{line}") for values, line in BAD]
    for text, line in [*texts, *BAD_FILES]:
        path = written(tmp_path, text)
        assert problem(load_params, path).startswith(f"{path}: {line}")


def test_what_could_not_be_read_is_not_written(tmp_path):
    path = tmp_path / "p.yaml"
    for values, line in [
        ({"corner_sigma_px": jnp.asarray(jnp.nan)}, "parameters.corner_sigma_px: must be finite"),
        ({"speed": 1.0}, "parameters.speed: unknown: of "),
        ({}, "parameters: must have at least 1 entries"),
    ]:
        assert problem(write_params, path, values).startswith(f"{path}: {line}")
    assert "must not be called .json" in problem(
        write_params, tmp_path / "p.json", {"corner_sigma_px": 1.0}
    )
    assert list(tmp_path.iterdir()) == []


def test_what_float32_leaves_of_a_symmetric_matrix_is_one(tmp_path):
    rng = np.random.default_rng(0)
    L = rng.normal(size=(3, 3)) * [[1e-4], [1.0], [1e3]]
    matrix = np.float32(L @ L.T)
    matrix[0, 1] = np.nextafter(matrix[0, 1], np.float32(1))
    write_params(tmp_path / "p.yaml", {"motion.vision_floor": matrix})
    read = load_params(tmp_path / "p.yaml").values["motion.vision_floor"]
    assert np.array_equal(read, matrix)


# --- what does not fit a navigator ----------------------------------------------------------------


def test_one_file_serves_every_selector_and_what_is_not_driven():
    values = {"controller.lookahead_m": 2.0, "selector.floor_m": 1e-3, "model_sigma_px": 0.2}
    params = Params.from_values(values, WHERE)
    paper = Navigator(RIG, MARKERS, QCAR, worlds.WAYPOINTS_M, selector=PaperCost())
    exact = Navigator(worlds.qcar_rig(), MARKERS, worlds.qcar())
    priors = {"motion.vehicle.sensor_sigma": [0.1] * 4, "rig.extrinsics_sigma": [[0.1] * 6] * 4}
    assert parameters_of(apply_params(exact, Params.from_values(priors, WHERE))).keys() == (
        parameters_of(exact).keys()
    )
    for navigator, taken in [
        (CAR, set(values)),
        (PARKED, {"selector.floor_m", "model_sigma_px"}),
        (FREE, {"selector.floor_m", "model_sigma_px"}),
        (paper, {"controller.lookahead_m", "model_sigma_px"}),
    ]:
        found = parameters_of(apply_params(navigator, params))
        assert {name: float(found[name]) for name in values if name in found} == {
            name: values[name] for name in taken
        }


MISFITS = [
    ("free", "motion.odometry_sigma", [1, 1, 1],
     "this navigator has no such number (its motion model is ConstantVelocity): expected one of "
     "motion.acceleration_density, motion.vision_floor,"),
    ("free", "motion.vision_floor", [1] * 3, "must have 6 entries or 6 rows of 6, got 3 entries"),
    ("car", "motion.initial_velocity_sigma", [1] * 6, "must have 3 entries, got 6 entries"),
    ("car", "motion.acceleration_density", np.eye(6),
     "must have 3 entries or 3 rows of 3, got 6 rows of 6"),
    ("car", "motion.vision_floor", 1, "must have 3 entries or 3 rows of 3, got a number"),
    ("car", "rig.extrinsics_sigma", [[0.01] * 6] * 3, "must have 4 rows of 6, got 3 rows of 6"),
    ("free", "motion.vehicle.sensor_sigma", [0.01] * 4, "this navigator has no such number"),
    ("car", "corner_sigma_px", [1], "must be a number, got 1 entry"),
]  # fmt: skip


def test_what_does_not_fit_is_named_with_its_key():
    for kind, name, value, line in MISFITS:
        found = problem(apply_params, NAVIGATORS[kind], Params.from_values({name: value}, WHERE))
        assert found.startswith(f"p.yaml: parameters.{name}: {line}")
