"""Messages of recorded drives: every number is read back, and other tools can read them."""

import dataclasses
import json
import math
from pathlib import Path

import equinox as eqx
import jsonschema
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from jaxnav.detection.types import Detections
from jaxnav.drive.flags import Fault, Health, Reject
from jaxnav.drive.frames import FrameDetections
from jaxnav.drive.interfaces import GyroReading, Odometry, TwistOdometry
from jaxnav.drive.pilot import Input
from jaxnav.errors import BadInput
from jaxnav.files.validation import validate
from jaxnav.recordings.drive_format import decode, encode, header_metadata, header_of
from jaxnav.recordings.records import (
    MESSAGES,
    REPORTED,
    ImageMessage,
    digest,
    input_message,
    json_schema,
    outcome_message,
)
from tests.helpers.drives import make_input, make_outcome, same_input

PATH = Path("drive.mcap")
FAULTS = st.integers(0, 2 ** len(Fault) - 1).map(Fault)
FLOATS = st.floats(width=64) | st.floats(width=32)
# Words that stand for numbers are text all the same where they are not beside the finite ones.
VALUES = st.recursive(
    FLOATS | st.integers() | st.booleans() | st.none() | st.sampled_from(["", "nan", "front"]),
    lambda inner: st.dictionaries(st.sampled_from("abc"), inner),
    max_leaves=6,
) | st.lists(FLOATS | st.integers())


def _same(one, other) -> bool:
    if isinstance(one, dict):
        return one.keys() == other.keys() and all(_same(one[key], other[key]) for key in one)
    if isinstance(one, list):
        return len(one) == len(other) and all(map(_same, one, other))
    if isinstance(one, float) and math.isnan(one):
        return math.isnan(other)
    return (type(one), repr(one)) == (type(other), repr(other))


@settings(max_examples=100)
@given(st.dictionaries(st.text(max_size=5).filter(lambda key: key != "not_finite"), VALUES))
def test_what_is_encoded_comes_back(message):
    raw = encode(message)
    assert _same(message, decode(raw))
    json.loads(raw, parse_constant=pytest.fail)  # NaN is no JSON


def test_what_is_not_finite_stands_aside_in_words():
    raw = encode({"x": 1.5, "costs": np.array([2.0, -np.inf]), "inner": [{"nis": math.nan}]})
    assert json.loads(raw) == {
        "x": 1.5,
        "inner": [{"not_finite": {"nis": "nan"}}],
        "not_finite": {"costs": [2.0, "-inf"]},
    }


def test_what_is_no_message_is_refused():
    for message in ({"not_finite": 1}, {"a": {"not_finite": {}}}):
        with pytest.raises(ValueError, match="not_finite"):
            encode(message)
    for raw in (
        b"", b"[1]", b"\xff", b'{"a": NaN}', b'{"a": -Infinity}', b'{"not_finite": 1}',
        b'{"a": 1, "not_finite": {"a": "inf"}}', b'{"a": ' + b"[" * 100_000,
        b'{"a": ' + b"1" * 10_000 + b"}",
    ):  # fmt: skip
        with pytest.raises(ValueError):  # noqa: PT011  (of whatever the parser says)
            decode(raw)


def _sighted(seed: int) -> FrameDetections:
    """Any bits at all as numbers: NaN, infinite, tiny and ordinary ones."""
    rng = np.random.default_rng(seed)
    count = int(rng.integers(0, 4))

    def numbers(*shape: int) -> np.ndarray:
        anything = np.frombuffer(rng.bytes(8 * int(np.prod(shape))), float).reshape(shape)
        special = rng.choice([0.0, -0.0, math.nan, math.inf, -math.inf, 5e-324, 0.1], shape)
        return np.where(rng.random(shape) < 0.5, anything, special)

    found = Detections(
        ids=rng.integers(-(2**63), 2**63, count),
        corners_px=numbers(count, 4, 2),
        sigma_px=numbers(count, 4),
        refined=rng.random(count) < 0.5,
        families=("tag36h11", "nan", "\u00fc")[:count],
    )
    faults = Fault(int(rng.integers(2 ** len(Fault))))
    return FrameDetections(count, seed - 1000, found if rng.random() < 0.8 else None, faults)


MOST_NS = 2**62 - 1
NOW_NS = st.integers(0, MOST_NS)
STAMPS = st.integers(-MOST_NS, MOST_NS)
READINGS = st.builds(Odometry, STAMPS, FLOATS, FLOATS, st.booleans()) | st.builds(
    TwistOdometry, STAMPS, FLOATS, FLOATS, FLOATS, st.booleans()
)
GYRO = st.lists(st.builds(GyroReading, STAMPS, FLOATS), max_size=3).map(tuple)
FRAMES = st.lists(st.integers(0, 2**32).map(_sighted), min_size=1, max_size=3).map(tuple)
INPUTS = st.builds(Input, NOW_NS, st.none() | READINGS, st.just(()), FAULTS, GYRO) | st.builds(
    Input, NOW_NS, st.none(), FRAMES, FAULTS, GYRO
)


@settings(max_examples=150)
@given(INPUTS)
def test_inputs_come_back_bit_for_bit(given):
    topic, _, message = input_message(given)
    back = validate(MESSAGES[topic][1], decode(encode(message)), PATH).input()
    assert same_input(given, back)


@pytest.mark.parametrize("dtype", [np.float32, np.float64])
def test_an_outcome_is_recorded_whole(dtype):
    outcome = dataclasses.replace(
        make_outcome(3, seed=1, dtype=dtype), outvoted=(7,), outvoted_cameras=("rear",)
    )
    got = validate(MESSAGES["/outcome"][1], decode(encode(outcome_message(outcome))), PATH)
    assert (got.now_ns, got.stamp_ns) == (outcome.now_ns, outcome.stamp_ns)
    assert (got.health, got.faults, got.rejects) == (
        Health.DEGRADED,
        Fault.NO_MARKER | Fault.CAMERA_STALE,
        Reject.TOO_LATE,
    )
    assert (got.steering_rad, got.throttle) == (outcome.steering_rad, outcome.throttle)
    assert (got.restarts, got.reason, got.digest) == (2, "the loop was away", digest(outcome))
    output, belief = outcome.output, outcome.belief.bank
    np.testing.assert_array_equal(got.pose, output.pose)
    np.testing.assert_array_equal(got.covariance, output.covariance)
    np.testing.assert_array_equal(got.hypotheses, belief.mean[1:3, :3])
    np.testing.assert_array_equal(got.log_weight, belief.log_weight[1:3])
    Ts = np.asarray(output.candidates.T_vehicle_world.wxyz_xyz)
    np.testing.assert_array_equal(got.Ts_vehicle_world, Ts[[0, 2]])
    np.testing.assert_array_equal(got.costs, [0.5, np.inf])
    assert got.selected == 1  # the third candidate is the second of those that are valid
    assert (got.nis, got.flip_probability) == (output.nis, output.flip_probability)
    assert (got.located, got.decided, got.done, got.hypothesis) == (True, True, False, 7)
    assert (got.outvoted, got.outvoted_cameras) == ([7], ["rear"])
    assert got.repeated_share == np.clip(outcome.belief.repeats.share, 0, 1)


NOT_REPORTED = {*REPORTED, "located", "decided", "done"}


def _next(array: np.ndarray) -> np.ndarray:
    return np.nextafter(array, np.inf)


def test_a_digest_tells_any_two_drives_apart():
    outcome = make_outcome(3)
    assert digest(outcome) == digest(make_outcome(3))
    changes = {
        "steering_rad": np.nextafter(outcome.steering_rad, 1),
        "output": eqx.tree_at(lambda o: o.pose, outcome.output, replace_fn=_next),
        "belief": eqx.tree_at(lambda b: b.bank.log_weight, outcome.belief, replace_fn=_next),
    }
    other = {digest(dataclasses.replace(outcome, **{key: changes[key]})) for key in changes}
    assert len(other | {digest(outcome)}) == 4


def _examples():
    yield from (input_message(make_input(index))[::2] for index in range(6))
    lost = Odometry(-5, math.nan, -math.inf, False)
    yield input_message(Input(1, lost))[::2]
    blurred = Detections(
        np.array([3]), np.full((1, 4, 2), np.nan), np.ones((1, 4)), np.array([True]), ("a",)
    )
    yield input_message(Input(1, frames=(FrameDetections(0, 1, blurred),)))[::2]
    message = outcome_message(make_outcome(1))
    yield "/outcome", message
    yield "/outcome", {key: value for key, value in message.items() if key not in NOT_REPORTED}


@pytest.mark.parametrize(("topic", "message"), list(_examples()))
def test_messages_obey_their_json_schema(topic, message):
    schema = json.loads(json_schema(MESSAGES[topic][1]))
    validator = jsonschema.Draft202012Validator(schema)
    validator.check_schema(schema)
    plain = json.loads(encode(message))
    validator.validate(plain)
    for key in schema["required"]:  # and the schema is no empty one
        assert not validator.is_valid({k: v for k, v in plain.items() if k != key})
    for key in plain:
        assert not validator.is_valid(plain | {key: None})
    assert not validator.is_valid(plain | {"other": 1})


@pytest.mark.parametrize("model", [model for _, model in MESSAGES.values()] + [ImageMessage])
def test_foxglove_understands_the_schemas(model):
    """Its reader wants one word for each type, and neither lists of lists nor references."""

    def check(schema):
        assert schema["type"] == "object"
        for field in schema["properties"].values():
            kind = field["items"] if field["type"] == "array" else field
            assert kind["type"] in ("boolean", "string", "number", "integer", "object")
            if kind["type"] == "object":
                check(kind)

    check(json.loads(json_schema(model)))


def test_a_wrong_outcome_is_named():
    message = json.loads(encode(outcome_message(make_outcome(1))))
    del message["not_finite"]
    message["costs"] = [1.0]
    validate(MESSAGES["/outcome"][1], message, PATH, "/outcome")
    for change, problem in [
        ({"pose": [1.0, 2.0]}, ".pose: must hold 3 values"),
        ({"pose": ["1", "2", "3"]}, r".pose\[0\]: must be a number, got the text '1'"),
        ({"hypotheses": [1.0] * 4}, ".hypotheses: must hold 3 values a row"),
        ({"covariance": [1.0] * 5}, ".covariance: must be a square matrix"),
        ({"health": "FINE"}, ".health: unknown word 'FINE'"),
        ({"health": {}}, ".health: unknown word '{}'"),
        ({"faults": [[]]}, r".faults: unknown word '\[\]'"),
        ({"faults": "NO_MARKER"}, ".faults: must be a list"),
        ({"now_ns": 1.0}, ".now_ns: must be a whole number"),
        ({"now_ns": 2**63}, ".now_ns: must be < "),
        ({"nis": None}, ": must have all of pose"),
        ({"other": 1}, ".other: unknown key"),
    ]:
        with pytest.raises(BadInput, match=f"^drive.mcap: /outcome{problem}"):
            validate(MESSAGES["/outcome"][1], message | change, PATH, "/outcome")


def test_a_wrong_frame_is_named():
    empty = Input(1, frames=(FrameDetections(0, 1, Detections.concatenate([])),))
    for of, change, problem in [
        (empty, {"ids": [1]}, "must agree in number"),
        (empty, {"families": ["a"]}, "must agree in number"),
        (empty, {"ids": [1], "families": ["a"], "refined": [True]}, "must agree"),
        (empty, {"refined": [1]}, r"refined\[0\]: must be true or false, got 1"),
        (empty, {"ids": [1.5]}, r"ids\[0\]: must be a whole number, got 1.5"),
        (empty, {"camera": -1}, "must be >= 0"),
        (make_input(1), {"usable": False}, "has no detections"),
    ]:
        message = json.loads(encode(input_message(of)[2]))
        message["frames"][0] |= change
        with pytest.raises(BadInput, match=problem):
            validate(MESSAGES["/frames"][1], message, PATH, "/frames")


def test_the_header_comes_back_or_is_named():
    header = {"rig": "cameras: ...", "route": np.array([[1.3, 0.0], [0.5, np.nan]]), "n": {"a": 1}}
    back = header_of(header_metadata(header), PATH)
    assert back["rig"] == header["rig"]
    np.testing.assert_array_equal(back["route"], header["route"])
    assert back["n"] == {"a": 1}
    for change, problem in [
        ({"format_version": "2"}, "format_version: this program reads format 1, the file has 2"),
        ({"format_version": "one"}, "format_version: must be a whole number"),
        ({"format_version": "\u0663"}, "format_version: must be a whole number"),
        ({"header": "{}"}, "header: is damaged"),
        ({"header": "[]", "crc32": "b7061ebe"}, "header: is damaged"),
        ({"crc32": ""}, "header: is damaged"),
    ]:
        with pytest.raises(BadInput, match=f"^drive.mcap: {problem}"):
            header_of(header_metadata({"a": 1}) | change, PATH)
