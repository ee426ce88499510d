"""What a drive has learnt of the errors of its sensors and cameras, in the units of their files."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from jaxnav.core.filter.bank import Bank
from jaxnav.core.filter.errors import EACH
from jaxnav.core.filter.estimate import Belief
from jaxnav.core.filter.odometry import LEARNT, SENSORS_END
from jaxnav.core.models.rig import CameraRig
from jaxnav.core.models.vehicle import SENSOR_ERRORS, TWIST_ERRORS, TwistBase, Vehicle
from jaxnav.files import poses

_SURE = 3.0  # an error of less than so many of its sigmas is not worth a word
_CONTRADICTS = 3.0  # an error of more sigmas of its file is more than that allows for
_LEARNT = 0.7  # share of its prior's sigma below which an error's sigma tells of a drive
# About a camera's own axes, x right, y down, z forward: a positive turn and a negative one.
_WORDS = (
    ("looks {} too high", "looks {} too low"),
    ("looks {} too far right", "looks {} too far left"),
    ("is rolled by {} clockwise", "is rolled by {} anticlockwise"),
)


def errors_of(bank: Bank) -> tuple[Float[np.ndarray, " e"], Float[np.ndarray, " e"]]:
    """The errors that the heaviest hypothesis of a vehicle keeps, and their sigmas.

    (k, g, o, tau) of `sensor_errors`, then three turns a camera in units of their prior's sigma,
    then the errors of a gyro's scale, delay and bias, where there is one. Empty where the bank
    keeps none.

    Args:
        bank: of NumPy, with its leading axis (K,).
    """
    best = heaviest_slot(bank)
    count, states = bank.mean.shape[1], bank.covariance.shape[1]
    variances = np.diagonal(np.asarray(bank.covariance)[best])[LEARNT:]
    errors = np.asarray(bank.mean)[best, count - states + LEARNT :]
    return errors.astype(float), np.sqrt(np.maximum(variances, 0)).astype(float)


def heaviest_slot(bank: Bank) -> int:
    """The slot of the heaviest hypothesis of a bank of NumPy."""
    return int(np.argmax(np.where(bank.initialised, bank.log_weight, -np.inf)))


def as_filed(
    errors: Float[np.ndarray, " e"], rig: CameraRig | None
) -> tuple[Float[np.ndarray, " sensors"], Float[np.ndarray, " turns"]]:
    """The errors against the files: those of the sensors, and three turns a camera.

    The filter keeps the turn that takes a camera back to where its file has it. A gyro's errors are
    left out, and without a rig, or with exact cameras, there are no turns.
    """
    of_sensors = SENSORS_END - LEARNT
    turned = 0 if rig is None or rig.extrinsics_sigma is None else EACH * len(rig)
    return errors[:of_sensors], -errors[of_sensors : of_sensors + turned]


def sensor_errors(vehicle: Vehicle | TwistBase) -> tuple[str, ...]:
    """The names of the errors of a vehicle's sensors, in their order."""
    return TWIST_ERRORS if isinstance(vehicle, TwistBase) else SENSOR_ERRORS


@dataclass(frozen=True)
class Learnt:
    """What a drive has taught of the errors that repeat, beside what the files had said.

    Attributes:
        sensors: (4,) errors of the vehicle's sensors, by which a car's file is to be corrected.
        sensor_names: what they are called; see `sensor_errors`.
        turns_rad: (C, 3) by which each camera is turned, against the rig's file, about the
            vehicle's axes x, y, z.
        sensors_sigma, turns_sigma_rad: standard deviations now.
        sensors_prior, turns_prior_rad: those of the files.
        rig: whose cameras they are.
    """

    sensors: Float[np.ndarray, " 4"]
    sensors_sigma: Float[np.ndarray, " 4"]
    sensors_prior: Float[np.ndarray, " 4"]
    turns_rad: Float[np.ndarray, "C 3"]
    turns_sigma_rad: Float[np.ndarray, "C 3"]
    turns_prior_rad: Float[np.ndarray, "C 3"]
    rig: CameraRig
    sensor_names: tuple[str, ...] = SENSOR_ERRORS

    @staticmethod
    def from_errors(
        errors: Float[np.ndarray, " e"],
        sigma: Float[np.ndarray, " e"],
        rig: CameraRig,
        vehicle: Vehicle | TwistBase,
    ) -> "Learnt | None":
        """What `errors_of` a bank says for this rig and vehicle; None if the bank keeps none."""
        if not errors.size:
            return None
        cameras = len(rig)
        sensors, turned = as_filed(errors, rig)
        sensors_sigma = sigma[: len(sensors)]
        turned_sigma = sigma[len(sensors) : len(sensors) + len(turned)]
        exact = np.zeros(4) if vehicle.sensor_sigma is None else np.asarray(vehicle.sensor_sigma)
        prior = np.zeros((cameras, 3))
        turns, turns_sigma = np.zeros((2, cameras, 3))
        if rig.extrinsics_sigma is not None:
            prior = np.asarray(rig.extrinsics_sigma, float)[:, 3:]
            turns = turned.reshape(cameras, EACH) * prior
            # Of a camera that has seen nothing the filter's is the prior's but for rounding.
            turns_sigma = np.minimum(turned_sigma, 1.0).reshape(cameras, EACH) * prior
        of_sensors = sensors, sensors_sigma, exact.astype(float)
        return Learnt(*of_sensors, turns, turns_sigma, prior, rig, sensor_errors(vehicle))

    def sentences(self) -> list[str]:
        """One line for each error that is clearly not zero."""
        return list(self.found().values())

    def found(self) -> dict[tuple[str, str], str]:
        """The sentence of each error, by the camera or `sensors`, and what is wrong with it."""
        sentences = {}
        for camera, T in enumerate(np.asarray(self.rig.Ts_camera_vehicle.wxyz_xyz, float)):
            R = poses.matrix(T)[:3, :3]
            turns = R @ self.turns_rad[camera]
            sigmas, priors = (
                np.sqrt(R**2 @ of[camera] ** 2)
                for of in (self.turns_sigma_rad, self.turns_prior_rad)
            )
            for axis, words in enumerate(_WORDS):
                if _is_learnt(turns[axis], sigmas[axis], priors[axis]):
                    turn_deg, sigma_deg = np.rad2deg([abs(turns[axis]), sigmas[axis]])
                    name, does = self.rig.names[camera], words[int(turns[axis] < 0)]
                    turned = does.format(f"{turn_deg:.2f} deg")
                    text = f"camera {name} {turned} (sigma {sigma_deg:.2f})"
                    sentences[name, does] = text + _contradiction(turns[axis], priors[axis])
        of_sensors = self.sensors, self.sensors_sigma, self.sensors_prior
        rows = zip(self.sensor_names, *of_sensors, strict=True)
        for name, value, sigma, prior in rows:
            if _is_learnt(value, sigma, prior):
                text = f"{name} is off by {value:+.4f} (sigma {sigma:.4f})"
                sentences["sensors", name] = text + _contradiction(value, prior)
        return sentences


def _is_learnt(value: float, sigma: float, prior: float) -> bool:
    return bool(prior > 0 and sigma < _LEARNT * prior and abs(value) > _SURE * sigma)


def _contradiction(value: float, prior: float) -> str:
    """What to add where an error is larger than its file allows for."""
    ratio = abs(value) / prior
    return f", {ratio:.1f} times the sigma of its file" if ratio > _CONTRADICTS else ""


def repeated_share(belief: Belief) -> float | None:
    """The part of the corners' variance that repeats, 0 to 1; None where none is taken to."""
    repeats = belief.repeats
    return None if repeats is None else min(max(float(repeats.share), 0.0), 1.0)
