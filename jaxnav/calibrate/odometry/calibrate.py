"""Calibration of the odometry's parameters from drives past markers, each with its uncertainty.

    found = calibrate_odometry(drives, rig, markers, before)
    found.value["speed_scale"], found.sigma["speed_scale"]

All poses of all drives are unknown, one for each reading, and are eliminated: dead reckoning from
one pose would drift away within seconds, and cutting a drive in pieces would lose the information
between them. With the readings' errors as unknowns too (see `model`) the parameters are those of
maximum likelihood, and the Schur complement of all other unknowns is their information.

A parameter that a drive doesn't determine is kept as it was, and named. Speed scale and course come
from markers passed at a known distance. Steering and wheelbase enter the turning as
gain * steering / wheelbase; only the car's sideslip, and the bend of the tangent at large angles,
tell one from the other. The delay shows where speed or steering change.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float

from jaxnav.calibrate.odometry.drive import (
    Course,
    Drive,
    Intervals,
    ReadingSigma,
    lay_out,
    reading_sigma,
)
from jaxnav.calibrate.odometry.fit import OdometryFit, Prior, fit
from jaxnav.calibrate.odometry.model import NAMES, Model
from jaxnav.calibrate.odometry.start import LOOSE, TIGHT, start
from jaxnav.calibrate.robust import FAR, variance_inflation
from jaxnav.core.models.markers import MarkerMap
from jaxnav.core.models.rig import CameraRig
from jaxnav.errors import BadInput

_CIRCLES = "drive circles at full lock both ways"
_UNSURE = "the drive does not tell it:"
# What to do where a parameter's sigma is larger than accepted. Of two that can't be told apart, the
# first here stays as it was: measured by tape, or less vital. Without the last there is nothing.
_LEAST_SURE = {
    "wheelbase_m": f"steering gain and wheelbase can't be told apart: {_CIRCLES}, or measure the "
    "wheelbase with a tape",
    "camera_delay_s": f"{_UNSURE} stop and start more often in view of a marker",
    "steering_gain": f"{_UNSURE} {_CIRCLES}, near a marker",
    "steering_offset_rad": f"{_UNSURE} drive longer in view of a marker",
    "speed_scale": "",
}
_ABSOLUTE = ("camera_delay_s", "steering_offset_rad")
_ACCEPTED, _ACCEPTED_RELATIVE = 0.01, 0.02  # sigma, in s or rad, and over the value
_STEERED_LITTLE = (
    "the steering hardly changed while the car moved: drive eights, at full lock both ways, to "
    "find it"
)
_TURNED_LITTLE = f"the car hardly turned: {_CIRCLES} to find it"
_CHANGED_LITTLE = "neither speed nor steering changed: stop and start, or drive eights, to find it"
_GIVEN = "as given by --fix"
_VARIED_RAD, _VARIED_MPS = 0.03, 0.03  # below, noise could pass for steering or driving
_VARIED_SHARE = 0.2  # of the speed: a single start shows little of the delay
_ASIDE_RAD = 0.05  # at a constant steering this far from straight, gain and offset are one
_BLOCK = 15  # readings to average, some 0.3 s
_GAIN_SIGMA = 0.1  # of a gain that was kept, for its effect on the offset's sigma
_LEAST_WAY_M = 1.0
_NOTICED = 1.5  # a smaller inflation counts as none: 20 parts can't show it
_REFUSED_CHI2, _AGAIN_CHI2 = 4.0, 1.2  # per degree of freedom
_MOST_OUTLIERS, _AGAIN_OUTLIERS = 0.3, 0.05
_OTHER = (0.1, TIGHT, TIGHT)  # errors of the odometry, for further starts


@dataclass(frozen=True)
class OdometryCalibration:
    """The calibrated parameters of the odometry, with their uncertainty and the fitted course."""

    before: dict[str, float]  # name -> value at the start, see `model.NAMES`
    value: dict[str, float]  # name -> value; fixed parameters are as before
    sigma: dict[str, float]  # name -> standard deviation, of the parameters found
    fixed: dict[str, str]  # name -> why it was not fitted
    correlation: Float[np.ndarray, "p p"]  # between the parameters found, in the order of `sigma`
    chi2_per_dof: float  # 1 if the sigmas of readings and corners are right
    # of the variances, where parts of the drives disagree; else 1. The sigmas have grown by the
    # root of the larger one of the two.
    inflation: float
    rms_px: float  # RMS residual of corners along one axis, without outliers
    outliers: Bool[np.ndarray, " V"]  # true for views that count less because they are far off
    views_px: Float[np.ndarray, "V 4 2"]  # residuals
    view_times_s: Float[np.ndarray, " V"]  # on the time axis of the course
    node_times_s: Float[np.ndarray, " nodes"]
    poses: Float[np.ndarray, "nodes 3"]  # x_m y_m psi_rad
    read: Float[np.ndarray, "nodes-1 2"]  # speed and steering as read, m/s and rad
    reading_sigma: ReadingSigma  # the noise of the readings
    way_m: float  # distance driven while markers were in view
    duration_s: float
    advice: tuple[str, ...]  # sentences on what to drive next


def calibrate_odometry(
    drives: Sequence[Drive],
    rig: CameraRig,
    markers: MarkerMap,
    before: Mapping[str, float],
    fixed: Sequence[str] = (),
    wheelbase_sigma_m: float | None = None,
    progress: Callable[[], object] = lambda: None,
) -> OdometryCalibration:
    """Find the parameters that explain the drives best.

    Args:
        drives: the drives of one car.
        before: name -> present value; see `model.NAMES`.
        fixed: names of parameters that are not fitted.
        wheelbase_sigma_m: sigma of the present wheelbase, if it was measured, say by tape.
        progress: called at every evaluation.

    Raises:
        BadInput: too little was seen, the car did not move, or odometry and cameras contradict
            each other; the message names the drives and says what to do.
    """
    where = ", ".join(drive.name for drive in drives)
    theta = np.array([before[name] for name in NAMES])
    course = lay_out(drives)
    sigma = reading_sigma(course.intervals)
    speed_mps, size = _block_means(course.intervals, course.intervals.speed_mps)
    dt_s, _ = _block_means(course.intervals, course.intervals.dt_s)
    way_m = float(theta[0] * np.sum(np.abs(speed_mps) * dt_s * size))  # noise adds no length
    if way_m < _LEAST_WAY_M:
        problem = (
            f"by its odometry the car drove {way_m:.2f} m in view of markers, at least "
            f"{_LEAST_WAY_M:g} m are needed: drive eights in front of a marker for a minute"
        )
        raise BadInput(where, problem)
    undetermined, steering_rad = _undetermined(course.intervals, sigma, where, fixed)
    why = dict.fromkeys(fixed, _GIVEN) | undetermined
    information = np.zeros(len(NAMES))
    if wheelbase_sigma_m is not None:
        information[NAMES.index("wheelbase_m")] = wheelbase_sigma_m**-2
    prior = Prior(theta, information)
    model = Model(course, rig, markers, sigma)

    def fitted(nodes: np.ndarray, theta: np.ndarray) -> OdometryFit:
        free = np.array([name not in why for name in NAMES])
        return fit(model, nodes, theta, free, prior, progress)

    fits: dict[bytes, OdometryFit] = {}  # several errors may lead to the same start

    def started(theta: np.ndarray, error: float) -> OdometryFit:
        nodes = start(course, rig, markers, theta, error)
        key = nodes.tobytes() + theta.tobytes()
        if key not in fits:
            fits[key] = fitted(nodes, theta)
        return fits[key]

    try:
        solution = started(theta, LOOSE)
        # Where that ends badly: other ways through the poses of single views, other parameters.
        for again, error in enumerate(_OTHER):
            chi2, outliers = _chi2_per_dof(solution, course)
            if solution.converged and chi2 < _AGAIN_CHI2 and np.mean(outliers) < _AGAIN_OUTLIERS:
                break
            other = started(solution.theta if again == 1 else theta, error)
            solution = min(solution, other, key=lambda one: one.blocks.cost)
        chi2, outliers = _chi2_per_dof(solution, course)
        _refuse_contradiction(where, solution, chi2, outliers)
        while (name := _least_sure(solution, why, max(chi2, 1.0))) is not None:
            if name == "speed_scale":
                problem = (
                    "the drive does not tell the scale of the speed to 2 %: drive further, along "
                    "and around a marker, in view of the cameras"
                )
                raise BadInput(where, problem)
            why[name] = _LEAST_SURE[name]
            kept = np.array([name in why for name in NAMES])
            solution = fitted(solution.nodes, np.where(kept, theta, solution.theta))
            chi2, outliers = _chi2_per_dof(solution, course)
        _refuse_contradiction(where, solution, chi2, outliers)
        covariance = np.linalg.inv(solution.information)
    except np.linalg.LinAlgError:
        problem = (
            "odometry, cameras and map have no course of a car in common that can be computed: "
            "check --markers, --rig and --vehicle"
        )
        raise BadInput(where, problem) from None
    free = [name for name in NAMES if name not in why]
    inflation = variance_inflation(solution.scores, covariance, len(free), _NOTICED)
    covariance = covariance * max(chi2, inflation, 1.0)
    if why.get("steering_gain") == _STEERED_LITTLE and "steering_offset_rad" in free:
        row = free.index("steering_offset_rad")
        covariance[row, row] += (_GAIN_SIGMA * steering_rad) ** 2
    deviation = np.sqrt(np.diag(covariance))
    return OdometryCalibration(
        before={name: float(before[name]) for name in NAMES},
        value=dict(zip(NAMES, solution.theta.tolist(), strict=True)),
        sigma=dict(zip(free, deviation.tolist(), strict=True)),
        fixed=why,
        correlation=covariance / np.outer(deviation, deviation),
        chi2_per_dof=chi2,
        inflation=inflation,
        rms_px=float(np.sqrt(np.mean(solution.blocks.views_px[~outliers] ** 2))),
        outliers=outliers,
        views_px=solution.blocks.views_px,
        view_times_s=course.views.time_s,
        node_times_s=course.node_times_s,
        poses=solution.nodes[:, :3],
        read=np.column_stack([course.intervals.speed_mps, course.intervals.steering_rad]),
        reading_sigma=sigma,
        way_m=way_m,
        duration_s=course.duration_s,
        advice=_advice(why, chi2, inflation, outliers, wheelbase_sigma_m),
    )


def _block_means(intervals: Intervals, values: np.ndarray) -> tuple[np.ndarray, int]:
    """Means of blocks of readings, and the number of readings in each."""
    linked = values[intervals.linked > 0]
    size = min(_BLOCK, len(linked))
    return linked[: len(linked) // size * size].reshape(-1, size).mean(axis=1), size


def _undetermined(
    intervals: Intervals, sigma: ReadingSigma, where: str, fixed: Sequence[str]
) -> tuple[dict[str, str], float]:
    """Name -> why this motion can't determine the parameter, whatever was seen; and the mean
    steering, rad.

    Mean and spread of speed and steering, the latter weighted by distance, are those of means of
    blocks of readings, which have little noise; what noise they have is subtracted.

    Raises:
        BadInput: the steering was turned and constant, so its gain and its offset are one.
    """
    speed, size = _block_means(intervals, intervals.speed_mps)
    steering, _ = _block_means(intervals, intervals.steering_rad)
    weight = np.abs(speed) / np.sum(np.abs(speed))

    def beyond_noise(variance: float, noise: float) -> float:
        return float(np.sqrt(max(variance - noise**2 / size, 0.0)))

    steering_rad, speed_mps = float(weight @ steering), float(np.mean(np.abs(speed)))
    varied_mps = beyond_noise(float(np.var(speed)), sigma.speed_mps)
    varied_rad = beyond_noise(float(weight @ (steering - steering_rad) ** 2), sigma.steering_rad)
    steered, aside = varied_rad >= _VARIED_RAD, abs(steering_rad) >= _ASIDE_RAD
    if aside and not steered and not {"steering_gain", "steering_offset_rad"} & set(fixed):
        problem = (
            f"the steering stood at {steering_rad:.2f} rad all the time, where its gain "
            "and its offset are one: drive eights, to both sides, or give --fix "
            "steering_offset_rad"
        )
        raise BadInput(where, problem)
    reasons: dict[str, str] = {}
    if not steered and not aside:
        reasons |= {"steering_gain": _STEERED_LITTLE, "wheelbase_m": _TURNED_LITTLE}
    if not steered and varied_mps < max(_VARIED_MPS, _VARIED_SHARE * speed_mps):
        reasons["camera_delay_s"] = _CHANGED_LITTLE
    return {name: why for name, why in reasons.items() if name not in fixed}, steering_rad


def _chi2_per_dof(solution: OdometryFit, course: Course) -> tuple[float, np.ndarray]:
    """Chi-square per degree of freedom, and which views are outliers, which count in neither."""
    chi2 = solution.blocks.view_chi2
    outliers = chi2 > FAR
    extra = float(np.sum(FAR * (1 + np.log(chi2[outliers] / FAR))))
    dof = 8 * int(np.sum(~outliers)) - 3 * course.stretches - len(solution.information)
    return (float(solution.blocks.cost) - extra) / max(dof, 1), outliers


def _least_sure(solution: OdometryFit, fixed: Mapping[str, str], scale: float) -> str | None:
    """The name of the parameter to fix next; None if all are sure enough.

    The weakest direction of the information, with every parameter in units of its largest accepted
    sigma, shows which can't be told apart.
    """
    free = [name for name in NAMES if name not in fixed]
    asked = np.array(
        [
            _ACCEPTED if name in _ABSOLUTE else _ACCEPTED_RELATIVE * abs(value)
            for name, value in zip(NAMES, solution.theta, strict=True)
            if name in free
        ]
    )
    weakest, directions = np.linalg.eigh(solution.information * np.outer(asked, asked) / scale)
    if not len(free) or weakest[0] >= 1.0:
        return None
    share = np.abs(directions[:, 0])
    involved = [name for name, part in zip(free, share, strict=True) if part > 0.5 * share.max()]
    return next(name for name in _LEAST_SURE if name in involved)


def _refuse_contradiction(
    where: str, solution: OdometryFit, chi2: float, outliers: np.ndarray
) -> None:
    if outliers.mean() > _MOST_OUTLIERS:
        problem = (
            f"{outliers.mean():.0%} of the markers seen are not where the map says: check "
            "--markers and --rig, with calibrate check"
        )
    elif not solution.converged:
        problem = (
            "no figures explain the drive best, whatever the search tries: drive eights in view of "
            "a marker, or keep some by --fix"
        )
    elif chi2 > _REFUSED_CHI2:
        problem = (
            f"odometry and cameras contradict each other (chi-square per degree of freedom "
            f"{chi2:.1f}): check --rig, --markers and --vehicle, drive slowly enough that no "
            "wheel slips, and keep a marker in view"
        )
    else:
        return
    raise BadInput(where, problem)


def _advice(
    fixed: Mapping[str, str],
    chi2: float,
    inflation: float,
    outliers: np.ndarray,
    wheelbase_sigma_m: float | None,
) -> tuple[str, ...]:
    lines = [f"{name}: {why}" for name, why in fixed.items() if why != _GIVEN]
    slower = "calibrate the cameras and the rig first, and drive more slowly"
    if "wheelbase_m" in fixed and "steering_gain" not in fixed and wheelbase_sigma_m is None:
        lines.append("steering_gain: 1 % off for 1 % that the wheelbase, taken as exact, is off")
    if inflation > max(chi2, 1.0):
        lines.append(
            f"parts of the drives disagree {np.sqrt(inflation):.1f} times as far as their noise "
            f"explains, and all sigma are larger by that: {slower}"
        )
    elif chi2 > 1.5:
        lines.append(
            f"residuals are {np.sqrt(chi2):.1f} times as large as readings and corners say of "
            f"themselves, and all sigma are larger by that: {slower}"
        )
    if outliers.mean() > 0.02:
        lines.append(f"{outliers.mean():.0%} of the views are far off: reflections, moved markers?")
    return tuple(lines) or ("nothing: every figure is found",)
