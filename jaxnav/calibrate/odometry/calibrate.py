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

from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float

from jaxnav.calibrate.odometry.drive import (
    Course,
    Drive,
    ReadingSigma,
    lay_out,
    reading_sigma,
)
from jaxnav.calibrate.odometry.fit import OdometryFit, Prior, fit
from jaxnav.calibrate.odometry.model import FULL_WEIGHT, NAMES, Model
from jaxnav.calibrate.odometry.motion import STEERED_LITTLE, cannot_tell, driven_m
from jaxnav.calibrate.odometry.start import LOOSE, TIGHT, start
from jaxnav.calibrate.parts import variance_inflation
from jaxnav.core.models.markers import MarkerMap
from jaxnav.core.models.rig import CameraRig
from jaxnav.errors import BadInput

# Largest accepted sigma of each parameter: relative, in rad and in s.
_LEAST_SURE = {
    "speed_scale": 0.02,
    "steering_gain": 0.02,
    "steering_offset_rad": 0.01,
    "wheelbase_m": 0.02,
    "camera_delay_s": 0.01,
}
_RELATIVE = ("speed_scale", "steering_gain", "wheelbase_m")
# Of two that can't be told apart, the first here stays as it was: measured by tape, or less vital.
_KEPT_FIRST = ("wheelbase_m", "camera_delay_s", "steering_gain", "steering_offset_rad")
_GAIN_SIGMA = 0.1  # of a gain that was kept, for its effect on the offset's sigma
_LEAST_WAY_M = 1.0
_NOTICED = 1.5  # a smaller inflation counts as none: 20 parts tell no better
_REFUSED_CHI2, _AGAIN_CHI2 = 4.0, 1.2  # per degree of freedom
_MOST_OUTLIERS, _AGAIN_OUTLIERS = 0.3, 0.05
_OTHER = (0.1, TIGHT, TIGHT)  # errors of the odometry, for further starts

_WHY = {
    "wheelbase_m": "steering gain and wheelbase can't be told apart: drive circles at full lock "
    "both ways, or measure the wheelbase with a tape",
    "camera_delay_s": "the drive does not tell it: stop and start more often in view of a marker",
    "steering_gain": "the drive does not tell it: drive circles at full lock both ways, near a "
    "marker",
    "steering_offset_rad": "the drive does not tell it: drive longer in view of a marker",
}


@dataclass(frozen=True)
class OdometryCalibration:
    """The calibrated parameters of the odometry, with their uncertainty and the fitted course.

    Attributes:
        before: name -> value at the start, see `model.NAMES`.
        value: name -> value; fixed parameters are as before.
        sigma: name -> standard deviation, of the parameters found.
        fixed: name -> why it was not fitted.
        correlation: between the parameters found, in the order of `sigma`.
        chi2_per_dof: 1 if the sigmas of readings and corners are right.
        inflation: of the variances, where parts of the drives disagree; else 1. The sigmas have
            grown by the root of the larger one of the two.
        rms_px: RMS residual of corners along one axis, without outliers.
        outliers: (V,) bool, true for views that count less because they are far off.
        views_px: (V, 4, 2), residuals.
        view_times_s: (V,), on the time axis of the course.
        node_times_s: (N + 1,).
        poses: (N + 1, 3), x_m y_m psi_rad.
        read: (N, 2), speed and steering as read, m/s and rad.
        reading_sigma: the noise of the readings.
        way_m: distance driven while markers were in view.
        advice: sentences on what to drive next.
    """

    before: dict[str, float]
    value: dict[str, float]
    sigma: dict[str, float]
    fixed: dict[str, str]
    correlation: Float[np.ndarray, "p p"]
    chi2_per_dof: float
    inflation: float
    rms_px: float
    outliers: Bool[np.ndarray, " V"]
    views_px: Float[np.ndarray, "V 4 2"]
    view_times_s: Float[np.ndarray, " V"]
    node_times_s: Float[np.ndarray, " nodes"]
    poses: Float[np.ndarray, "nodes 3"]
    read: Float[np.ndarray, "nodes-1 2"]
    reading_sigma: ReadingSigma
    way_m: float
    duration_s: float
    advice: tuple[str, ...]


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
    way_m = theta[0] * driven_m(course.intervals)
    if way_m < _LEAST_WAY_M:
        problem = (
            f"by its odometry the car drove {way_m:.2f} m in view of markers, at least "
            f"{_LEAST_WAY_M:g} m are needed: drive eights in front of a marker for a minute"
        )
        raise BadInput(where, problem)
    why = dict.fromkeys(fixed, "as told by --fix")
    untold, steering_rad = cannot_tell(course.intervals, sigma, where, fixed)
    why |= untold
    information = np.zeros(len(NAMES))
    if wheelbase_sigma_m is not None:
        information[NAMES.index("wheelbase_m")] = wheelbase_sigma_m**-2
    prior = Prior(theta, information)
    search = _Search(Model(course, rig, markers, sigma), course, rig, markers, prior, progress)
    with _computable(where):
        solution = search.best(theta, why)
        chi2 = _chi2_per_dof(solution, course)
        outliers = solution.blocks.view_chi2 > FULL_WEIGHT
        _refuse_contradiction(where, solution, chi2, outliers)
        while (name := _least_sure(solution, why, max(chi2, 1.0))) is not None:
            if name == "speed_scale":
                problem = (
                    "the drive does not tell the scale of the speed to 2 %: drive further, along "
                    "and around a marker, in view of the cameras"
                )
                raise BadInput(where, problem)
            why[name] = _WHY[name]
            solution = search.again(solution, why)
            chi2 = _chi2_per_dof(solution, course)
            outliers = solution.blocks.view_chi2 > FULL_WEIGHT
        _refuse_contradiction(where, solution, chi2, outliers)
        free = [name for name in NAMES if name not in why]
        covariance = np.linalg.inv(solution.information)
        inflation = variance_inflation(solution.scores, covariance, len(free), _NOTICED)
        covariance = covariance * max(chi2, inflation, 1.0)
        if why.get("steering_gain") == STEERED_LITTLE and "steering_offset_rad" in free:
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


@contextmanager
def _computable(where: str) -> Iterator[None]:
    """Turn equations that can't be solved into `BadInput`."""
    try:
        yield
    except np.linalg.LinAlgError:
        problem = (
            "odometry, cameras and map have no course of a car in common that can be computed: "
            "check --markers, --rig and --vehicle"
        )
        raise BadInput(where, problem) from None


@dataclass(frozen=True)
class _Search:
    """The search for the best fit of one course, from several starts."""

    model: Model
    course: Course
    rig: CameraRig
    markers: MarkerMap
    prior: Prior
    progress: Callable[[], object]

    def best(self, theta: np.ndarray, fixed: Mapping[str, str]) -> OdometryFit:
        """Fit from the present odometry; if that ends badly, also from other ways through the poses
        of single views, and from the parameters found."""
        solution = self._started(theta, fixed, LOOSE)
        for again in range(3):
            outliers = float(np.mean(solution.blocks.view_chi2 > FULL_WEIGHT))
            chi2 = _chi2_per_dof(solution, self.course)
            if solution.converged and chi2 < _AGAIN_CHI2 and outliers < _AGAIN_OUTLIERS:
                break
            other = self._started(solution.theta if again == 1 else theta, fixed, _OTHER[again])
            solution = min(solution, other, key=lambda one: one.blocks.cost)
        return solution

    def _started(self, theta: np.ndarray, fixed: Mapping[str, str], error: float) -> OdometryFit:
        nodes = start(self.course, self.rig, self.markers, theta, error)
        return self._from(nodes, theta, fixed)

    def again(self, solution: OdometryFit, fixed: Mapping[str, str]) -> OdometryFit:
        """Fit again from a fit, with more parameters fixed at their values before."""
        kept = np.array([name in fixed for name in NAMES])
        return self._from(solution.nodes, np.where(kept, self.prior.mean, solution.theta), fixed)

    def _from(self, nodes: np.ndarray, theta: np.ndarray, fixed: Mapping[str, str]) -> OdometryFit:
        free = np.array([name not in fixed for name in NAMES])
        return fit(self.model, nodes, theta, free, self.prior, self.progress)


def _chi2_per_dof(solution: OdometryFit, course: Course) -> float:
    """Chi-square per degree of freedom; outliers among the views count in neither."""
    chi2 = solution.blocks.view_chi2
    good = chi2 <= FULL_WEIGHT
    far = chi2[~good]
    extra = float(np.sum(FULL_WEIGHT * (1 + np.log(far / FULL_WEIGHT))))
    dof = 8 * int(good.sum()) - 3 * course.stretches - solution.information.shape[0]
    return (float(solution.blocks.cost) - extra) / max(dof, 1)


def _least_sure(solution: OdometryFit, fixed: Mapping[str, str], scale: float) -> str | None:
    """The name of the parameter to fix next; None if all are sure enough.

    The weakest direction of the information, with every parameter in units of its largest accepted
    sigma, shows which can't be told apart.
    """
    free = [name for name in NAMES if name not in fixed]
    values = dict(zip(NAMES, solution.theta, strict=True))
    asked = np.array(
        [_LEAST_SURE[name] * (abs(values[name]) if name in _RELATIVE else 1.0) for name in free]
    )
    weakest, directions = np.linalg.eigh(solution.information * np.outer(asked, asked) / scale)
    if not len(free) or weakest[0] >= 1.0:
        return None
    share = np.abs(directions[:, 0])
    involved = [name for name, part in zip(free, share, strict=True) if part > 0.5 * share.max()]
    return next((name for name in _KEPT_FIRST if name in involved), "speed_scale")


def _refuse_contradiction(
    where: str, solution: OdometryFit, chi2: float, outliers: np.ndarray
) -> None:
    if outliers.mean() > _MOST_OUTLIERS:
        problem = (
            f"{outliers.mean():.0%} of the markers seen are not where the map says: check "
            "--markers and --rig, with calibrate check"
        )
        raise BadInput(where, problem)
    if not solution.converged:
        problem = (
            "no figures explain the drive best, whatever the search tries: drive eights in view of "
            "a marker, or keep some by --fix"
        )
        raise BadInput(where, problem)
    if chi2 > _REFUSED_CHI2:
        problem = (
            f"odometry and cameras contradict each other (chi-square per degree of freedom "
            f"{chi2:.1f}): check --rig, --markers and --vehicle, drive slowly enough that no "
            "wheel slips, and keep a marker in view"
        )
        raise BadInput(where, problem)


def _advice(
    fixed: Mapping[str, str],
    chi2: float,
    inflation: float,
    outliers: np.ndarray,
    wheelbase_sigma_m: float | None,
) -> tuple[str, ...]:
    lines = [f"{name}: {why}" for name, why in fixed.items() if not why.startswith("as told")]
    if "wheelbase_m" in fixed and "steering_gain" not in fixed and wheelbase_sigma_m is None:
        lines.append(
            "The steering gain is as sure as the wheelbase that was taken as exact: an error of "
            "1 % there is one of 1 % here."
        )
    if inflation > max(chi2, 1.0):
        lines.append(
            f"Parts of the drives disagree {np.sqrt(inflation):.1f} times as far as their noise "
            "explains; all sigma are larger by that. Wheels that slip, or cameras that are off, "
            "are the likely cause: drive more slowly, and calibrate the cameras and the rig first."
        )
    elif chi2 > 1.5:
        lines.append(
            f"Residuals are {np.sqrt(chi2):.1f} times as large as readings and corners say of "
            "themselves; all sigma are larger by that. Calibrate the cameras and the rig first, "
            "and drive more slowly."
        )
    if outliers.mean() > 0.02:
        lines.append(
            f"{outliers.mean():.0%} of the views are far off: look for reflections, and for "
            "markers that were moved."
        )
    return tuple(lines) or ("Nothing: every figure is found.",)
