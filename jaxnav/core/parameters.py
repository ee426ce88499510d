"""The numbers of a navigator that a file of parameters may hold, by name.

    values = parameters_of(navigator)                 # {"motion.odometry_sigma": ..., ...}
    navigator = with_parameters(navigator, values)    # others stay as they are

A name is the path of the attribute. Drives and recordings can teach all but the guards. Everything
else about a navigator is known otherwise: cameras and wheelbase are measured, limits are the
vehicle's. Of cameras and sensors only how far off they may be is a parameter; by how much they are
is a state of the filter.
"""

import math
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from functools import reduce
from typing import Any, TypeVar

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

Whole = TypeVar("Whole", bound=eqx.Module)  # a `Navigator`


@dataclass(frozen=True)
class Tunable:
    """What a number of a navigator means.

    Attributes:
        meaning: one line.
        unit: of its entries.
        typical: what it may be where nothing better is known; tuning starts there where the
            number is 0 or infinite.
        matrix: None for numbers that are positive each by itself. Else the number may be a matrix,
            symmetric and positive definite, instead of the vector whose entries are, "sigma", the
            square roots of its diagonal or, "variance", that diagonal itself.
        rows: whether it is a table, a row for each camera.
        most: the largest that its entries, or those of a row, may be; beyond it nothing is known.
        guard: whether it only bounds what is believed. No gradient teaches such a number, and a
            file may hold an infinite one, which bounds nothing.
    """

    meaning: str
    unit: str
    typical: float
    matrix: str | None = None
    rows: bool = False
    most: tuple[float, ...] = ()
    guard: bool = False

    def largest(self, shape: tuple[int, ...]) -> Float[np.ndarray, "..."]:
        """The largest that the entries of a number of this shape may be; inf without a bound."""
        most = np.reshape(self.most, shape[-1:]) if self.most else np.inf
        return np.broadcast_to(most, shape)


TUNABLES: dict[str, Tunable] = {
    "motion.acceleration_density": Tunable(
        "Q: power spectral density of the acceleration, in the body's axes",
        "(m/s^2)^2/Hz, (rad/s^2)^2/Hz",
        0.1,
        "variance",
    ),
    "motion.vision_floor": Tunable(
        "R: what a pose gets wrong beside its corners' noise; not looked at by multi-hypothesis",
        "m, rad",
        0.005,
        "sigma",
    ),
    "motion.odometry_sigma": Tunable(
        "R: odometry, along and across the vehicle, and its turn rate",
        "m/s, m/s, rad/s",
        0.01,
        "sigma",
    ),
    "motion.slip_sigma": Tunable(
        "Q: slip of the wheels, a share of their speed; not looked at where their scale is exact",
        "1",
        0.05,
        most=(0.5,),
    ),
    "motion.slip_length_m": Tunable("Q: way after which a slip has faded to 1/e", "m", 0.2),
    "motion.gyro_slip_length_m": Tunable("Q: the same while a gyro tells the turn", "m", 0.5),
    "motion.odometry_drift": Tunable(
        "Q: random walk of a free body's odometry, per way, angle, and time",
        "m/sqrt(m), rad/sqrt(rad), m/sqrt(s), rad/sqrt(s)",
        0.01,
    ),
    "motion.odometry_errors.sigma": Tunable(
        "P0: scale of a free body's odometry, and its direction on the body",
        "1, rad",
        0.02,
        most=(0.5, *3 * (math.radians(15.0),)),
    ),
    "motion.initial_velocity_sigma": Tunable(
        "P0: the velocity before anything tells it", "m/s, rad/s", 1.0
    ),
    "motion.tilt_sigma_rad": Tunable("roll and pitch of the cameras", "rad", 0.005),
    "motion.height_sigma_m": Tunable("height of the cameras", "m", 0.002),
    "motion.vehicle.sensor_sigma": Tunable(
        "P0: scale of the odometer, gain and offset of the steering, delay of the cameras",
        "1, 1, rad, s",
        0.02,
        most=(0.5, 0.5, 0.35, 0.5),
    ),
    "motion.vehicle.gyro.noise_density": Tunable(
        "R: of a gyro's turn rate", "rad/s/sqrt(Hz)", 2.5e-4, most=(1.0,)
    ),
    "motion.vehicle.gyro.bias_sigma_radps": Tunable(
        "P0: bias of a gyro", "rad/s", 0.02, most=(10.0,)
    ),
    "motion.vehicle.gyro.bias_walk": Tunable(
        "Q: random walk of that bias", "rad/s/sqrt(s)", 2e-5, most=(1.0,)
    ),
    "motion.vehicle.gyro.scale_sigma": Tunable("P0: scale of a gyro", "1", 0.01, most=(0.5,)),
    "motion.vehicle.gyro.delay_sigma_s": Tunable("P0: delay of a gyro", "s", 5e-3, most=(0.5,)),
    "rig.extrinsics_sigma": Tunable(
        "P0: place and direction of each camera, in the vehicle's axes",
        "m, rad",
        0.01,
        rows=True,
        most=(0.5, 0.5, 0.5, *3 * (math.radians(15.0),)),
    ),
    "motion.gate_nis": Tunable(
        "largest NIS of a pose that is fused; .inf: no gate, and no restart", "1", 20.0, guard=True
    ),
    "selector.floor_m": Tunable("R: what successive frames get wrong alike", "m", 1e-3),
    "selector.floor_rad": Tunable("R: what successive frames get wrong alike", "rad", 1e-3),
    "corner_sigma_px": Tunable("R: corners that come without a sigma of their own", "px", 1.0),
    "model_sigma_px": Tunable("R: added to the sigma that corners come with", "px", 0.15),
    "repeated_errors.least_share": Tunable(
        "R: share of the corners' variance that repeats, before any corner has shown it",
        "1",
        0.05,
        most=(0.9,),
    ),
    "controller.proportional_per_m": Tunable("p1: throttle per distance", "1/m", 0.03),
    "controller.integral_per_ms": Tunable("p2: throttle per distance and time", "1/(m s)", 0.005),
    "controller.integral_limit_ms": Tunable("bound of the integral", "m s", 5.0),
    "controller.lookahead_m": Tunable("steers as if no waypoint were farther", "m", 10.0),
    "controller.slows_at_rad": Tunable("halves the throttle this far off the course", "rad", 5.0),
    "controller.speed_mps": Tunable("of a base that is no car, at most", "m/s", 0.5),
    "controller.slows_per_s": Tunable("its speed per distance, near a waypoint", "1/s", 1.0),
    "controller.turns_per_s": Tunable("its turn rate per angle, on the spot", "1/s", 2.0),
    "controller.exploration.speed_mps": Tunable("speed while the pose is undecided", "m/s", 0.5),
    "controller.exploration.settle_s": Tunable("how soon it is at that speed", "s", 0.1),
    "controller.exploration.angle_rad": Tunable("course to the line of sight", "rad", 1.0),
    "controller.exploration.reach_m": Tunable("how sharply it turns onto it", "m", 0.4),
}


def parameters_of(navigator: eqx.Module) -> dict[str, Float[Array, "*shape"]]:
    """What can be tuned of a navigator, in the order of `TUNABLES`."""
    return {name: jnp.asarray(_get(navigator, name), float) for name in _names(navigator)}


def with_parameters(navigator: Whole, values: Mapping[str, Float[Array, "*shape"]]) -> Whole:
    """The navigator with other numbers.

    Raises:
        ValueError: a name that this navigator does not have, or numbers of another shape.
    """
    known = parameters_of(navigator)
    for name, value in values.items():
        if name not in known:
            raise ValueError(f"{name}: unknown: expected one of {', '.join(known)}")
        shapes = allowed_shapes(name, known[name].shape)
        if jnp.shape(value) not in shapes:
            expected = " or ".join(str(shape) for shape in shapes)
            raise ValueError(f"{name}: must have the shape {expected}, got {jnp.shape(value)}")
    if not values:
        return navigator
    names = list(values)
    changed: Whole = eqx.tree_at(
        lambda n: [_get(n, name) for name in names],
        navigator,
        [jnp.asarray(values[name], known[name].dtype) for name in names],
    )
    return changed


def allowed_shapes(name: str, shape: tuple[int, ...]) -> list[tuple[int, ...]]:
    """What shapes a number may have that has one of them in a navigator."""
    if TUNABLES[name].matrix is None:
        return [shape]
    return [shape[:1], (*shape[:1], *shape[:1])]


def _names(navigator: eqx.Module) -> Iterator[str]:
    for name in TUNABLES:
        if _get(navigator, name) is not None:
            yield name


def _get(navigator: Any, name: str) -> Any:
    return reduce(lambda part, key: getattr(part, key, None), name.split("."), navigator)
