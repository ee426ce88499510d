"""Inputs and outcomes of a drive made by hand: nothing is estimated, nothing is compiled."""

import dataclasses
import functools
from typing import Any

import jax
import jax.numpy as jnp
import jaxlie
import numpy as np

from jaxnav.core.control import Command
from jaxnav.core.filter.bank import Bank, Rejections
from jaxnav.core.filter.errors import Repeats
from jaxnav.core.filter.estimate import Belief
from jaxnav.core.navigator import Output
from jaxnav.core.pose.refine import Candidates
from jaxnav.detection.types import Detections
from jaxnav.drive.flags import Fault, Health, Reject
from jaxnav.drive.frames import FrameDetections
from jaxnav.drive.interfaces import GyroReading, Odometry, TwistOdometry
from jaxnav.drive.pilot import Input, Outcome
from jaxnav.recordings.records import input_message, outcome_message

BEGIN_NS = 5_000_000_123
PERIOD_NS = 10_000_000
# Messages of an outcome without a report, and what a report adds.
OUTCOME: dict[str, Any] = {
    "now_ns": 1,
    "health": "OK",
    "faults": [],
    "rejects": [],
    "steering_rad": 0.0,
    "throttle": 0.0,
    "restarts": 0,
    "reason": "",
    "digest": "",
}
REPORTED: dict[str, Any] = {
    "pose": [0.0] * 3,
    "covariance": [0.0] * 9,
    "flip_probability": 0.0,
    "nis": 0.0,
    "hypothesis": 0,
    "hypotheses": [],
    "log_weight": [],
    "Ts_vehicle_world": [],
    "costs": [],
    "selected": -1,
}


def make_detections(rng: np.random.Generator, count: int) -> Detections:
    return Detections(
        ids=rng.integers(0, 500, count),
        corners_px=rng.normal(300, 100, (count, 4, 2)),
        sigma_px=rng.uniform(0.05, 0.5, (count, 4)),
        refined=rng.random(count) < 0.5,
        families=("tag36h11", "DICT_4X4_50")[:count],
    )


def make_input(index: int) -> Input:
    """Odometry, frames of two cameras of which one is not usable, and ticks, in turn."""
    now_ns, rng = BEGIN_NS + index * PERIOD_NS, np.random.default_rng(index)
    if index % 3 == 0:
        reading = Odometry(now_ns - 7, *rng.normal(size=2).tolist(), valid=index % 2 == 0)
        return Input(now_ns, reading, faults=Fault.DEADLINE_MISSED)
    if index % 3 == 1:
        seen = make_detections(rng, index % 4 % 3)
        frames = (
            FrameDetections(0, now_ns - 30_000_001, seen),
            FrameDetections(3, now_ns - 30_000_001, None, Fault.FRAME_UNUSABLE),
        )
        return Input(now_ns, frames=frames)
    return Input(now_ns)


def make_base_input(index: int) -> Input:
    """A twist and what a gyro has told, or that alone, in turn."""
    now_ns, rng = BEGIN_NS + index * PERIOD_NS, np.random.default_rng(index)
    rates = rng.normal(size=2).tolist()
    gyro = tuple(GyroReading(now_ns - 9 + k, rate) for k, rate in enumerate(rates))
    reading = TwistOdometry(now_ns - 7, *rng.normal(size=3).tolist(), valid=index % 4 == 0)
    return Input(now_ns, reading if index % 2 == 0 else None, gyro=gyro)


def make_output(rng: np.random.Generator, dtype: type = float) -> Output:
    """Two of three candidates valid, the second of these taken."""

    def random(*shape: int) -> jax.Array:
        return jnp.asarray(rng.normal(size=shape).astype(dtype))

    candidates = Candidates(
        T_vehicle_world=jaxlie.SE3(jnp.asarray(_poses(rng, 3).astype(dtype))),
        e1_px2=random(3),
        cost=random(3),
        covariance=random(3, 6, 6),
        valid=jnp.asarray([True, False, True]),
        converged=jnp.asarray([True] * 3),
        steps=jnp.asarray([5] * 3),
    )
    output = Output(
        pose=random(3),
        pose_covariance=random(3, 3),
        velocity=random(3),
        velocity_covariance=random(3, 3),
        covariance=random(6, 6),
        T_world_vehicle=jaxlie.SE3(random(7)),
        located=jnp.asarray(True),
        hypothesis=jnp.asarray(7),
        flip_probability=random(),
        decided=jnp.asarray(True),
        candidates=candidates,
        costs=jnp.asarray(np.array([0.5, np.inf, np.inf], dtype)),
        selected=jnp.asarray(2),
        accepted=jnp.asarray(True),
        nis=random(),
        gate_nis=random(),
        outvoted=jnp.zeros(1, bool),
        log_likelihood=random(),
        command=Command(random(), random()),
        done=jnp.asarray(False),
        control_log=None,
    )
    return _as_numpy(output)


def _poses(rng: np.random.Generator, count: int) -> np.ndarray:
    """(count, 7) wxyz_xyz."""
    poses = rng.normal(size=(count, 7))
    poses[:, :4] /= np.linalg.norm(poses[:, :4], axis=1, keepdims=True)
    return poses


def make_belief(rng: np.random.Generator, dtype: type = float) -> Belief:
    """Two of four hypotheses alive."""

    def random(*shape: int) -> jax.Array:
        return jnp.asarray(rng.normal(size=shape).astype(dtype))

    bank = Bank(
        mean=random(4, 8),
        covariance=random(4, 6, 6),
        log_weight=random(4),
        initialised=jnp.asarray([False, True, True, False]),
        rejections=Rejections(jnp.zeros(4, int), random(4, 3), random(4), jnp.zeros(4, dtype)),
        number=jnp.arange(4),
        velocity_lead=random(4, 3),
        parent=jnp.arange(4),
    )
    decided, restarts = jnp.asarray(True), jnp.asarray(1, jnp.int32)
    count = random(2, 3)
    repeats = Repeats(random(2, 3, 2, 2), count, random(2, 3, 2), count, random(), random())
    return _as_numpy(Belief(bank, decided, random(), restarts, repeats))


@functools.cache
def _told(seed: int, dtype: type) -> tuple[Output, Belief]:
    rng = np.random.default_rng(seed)
    return make_output(rng, dtype), make_belief(rng, dtype)


def _as_numpy(tree):
    """As the pilot tells it."""
    return jax.tree.map(np.asarray, tree)


def make_outcome(index: int, seed: int = 0, dtype: type = float) -> Outcome:
    """What is reported of it depends on the seed alone."""
    now_ns = BEGIN_NS + index * PERIOD_NS
    output, belief = _told(seed, dtype)
    return Outcome(
        now_ns=now_ns,
        health=Health.DEGRADED,
        faults=Fault.NO_MARKER | Fault.CAMERA_STALE,
        rejects=Reject.TOO_LATE,
        steering_rad=0.1 * index,
        throttle=-0.1 / (index + 1),
        output=output,
        belief=belief,
        data=None,
        stamp_ns=now_ns - 3,
        restarts=2,
        restart_reason="the loop was away",
    )


def record_drive(recorder, count: int) -> None:
    """Inputs and outcomes, and a picture every tenth."""
    for index in range(count):
        given = make_input(index)
        recorder.put(*input_message(given))
        message = outcome_message(make_outcome(index)) | {"digest": f"digest {index}"}
        recorder.put("/outcome", given.now_ns, message)
        if index % 10 == 0:
            recorder.image("/camera/front", given.now_ns, make_picture(index))


def make_picture(index: int) -> np.ndarray:
    """(24, 32, 3) of one colour."""
    return np.full((24, 32, 3), 20 + index % 200, np.uint8)


def same_input(one: Input, other: Input) -> bool:
    """Bit for bit, one NaN being as good as another."""
    return _bits(one) == _bits(other)


def _bits(value):
    if dataclasses.is_dataclass(value):
        return {
            field.name: _bits(getattr(value, field.name)) for field in dataclasses.fields(value)
        }
    if isinstance(value, list | tuple):
        return [_bits(inner) for inner in value]
    if isinstance(value, np.ndarray):
        same_nan = np.where(np.isnan(value), np.nan, value) if value.dtype.kind == "f" else value
        return value.dtype.str, value.shape, same_nan.tobytes()
    return repr(value) if isinstance(value, float) else value
