"""Robust fit of a lens to views of which some corners, and some whole views, may be wrong.

First corners count less the further off they are (Cauchy), so that outliers are found without
leading the fit astray. Then outliers are left out and plain least squares fits the rest, so that
its covariance is right; this is repeated until nothing changes. Views that are worse than the
others count less only where that changes the lens by more than chance would: which views are right
is a guess where few disagree, and a lens that is led by it explains unseen views no better.

Source: Rousseeuw and Leroy (1987), "Robust regression and outlier detection", chapter 5.2
(reweighted least squares). Hausman (1978), "Specification tests in econometrics".
"""

from dataclasses import dataclass, replace

import jax.numpy as jnp
import numpy as np
from jaxtyping import Bool, Float
from scipy import stats

from jaxnav.calibrate.board.views import BoardViews
from jaxnav.calibrate.lens import bundle as lens_bundle
from jaxnav.calibrate.lens.bundle import COUNT, NAMES, NO_CUT, BoardCorners, Bundle, LensUnknowns
from jaxnav.calibrate.lens.start import board_poses, lens_start
from jaxnav.core.models.camera import Camera

_CUT = 2.0  # in sigmas, of Cauchy's cost
_FAR = 5.0  # in sigmas: Gaussian noise takes one corner in 270 000 there
_WEAK, _WRONG = 1.5, 4.0  # a view whose corners are this many times as far off counts less, or not
_CHANCE = 1e-6  # probability that a good view is taken for a worse one
_ROBUST_ROUNDS, _ROUNDS = 3, 10
_BY_CHANCE = 0.05  # probability that weights of good views change the lens by as much
_NOTICED_SIGMAS = 2.0  # views that disagree by less may do so by chance
_LEAST_SIGMA_PX = 1e-6
_LEAST_LEFT = 1e-3  # of a direction that one view alone determines


@dataclass(frozen=True)
class LensFit:
    """A lens fitted to views, with its covariance, the board's poses and the residuals."""

    lens: str
    views: BoardViews
    parameters: Float[np.ndarray, " 9"]  # fx fy cx cy and the coefficients in the camera's order
    covariance: Float[np.ndarray, "9 9"]  # of the parameters; zero for fixed ones
    inflation: float  # the factor in it by which views disagree beyond the noise of their corners
    fixed: tuple[str, ...]  # names of the parameters held at zero
    Ts_camera_board: Float[np.ndarray, "V 7"]  # wxyz_xyz
    residual_px: Float[np.ndarray, "V P 2"]  # predicted - seen; 0 for points not seen
    used: Bool[np.ndarray, "V P"]  # true for corners in the fit
    # 1; 0 if the view is left out; less than 1 if it is worse than the others and the lens would be
    # another one by it
    view_weights: Float[np.ndarray, " V"]
    # standard deviation of a corner's x and of its y; inf without a pose
    view_sigma_px: Float[np.ndarray, " V"]
    sigma_px: float  # the same for a view of weight 1, over the whole fit
    converged: bool  # true if the search ended before its limit of steps

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the parameters that the lens has."""
        return NAMES[self.lens]

    @property
    def camera(self) -> Camera:
        """The fitted camera, in the process's precision."""
        return lens_bundle.camera_of(self.lens, jnp.asarray(self.parameters, float))

    @property
    def sigma(self) -> Float[np.ndarray, " 9"]:
        """(9,) standard deviations of the parameters; 0 for fixed ones."""
        return np.sqrt(np.diag(self.covariance))

    @property
    def focal_sigma(self) -> Float[np.ndarray, " 2"]:
        """(2,) standard deviations of the focal lengths on the axis, over these."""
        on_axis_px, J = lens_bundle.axis_px(self.lens, jnp.asarray(self.parameters, float))
        variance = np.einsum("ci,ij,cj->c", J, self.covariance, J)
        return np.asarray(np.sqrt(variance) / np.abs(on_axis_px))

    @property
    def rms_px(self) -> float:
        """RMS distance of the corners in the fit from their predictions, as OpenCV defines it."""
        return float(np.sqrt(np.mean(np.sum(self.residual_px[self.used] ** 2, axis=-1))))

    @property
    def used_px(self) -> Float[np.ndarray, "N 2"]:
        """(N, 2) the corners that are in the fit, px."""
        seen_px = np.asarray(lens_bundle.padded_corners(self.views).corners_px)
        return seen_px[: len(self.used)][self.used]

    @property
    def weights(self) -> Float[np.ndarray, "V P"]:
        """(V, P) the weight of every corner."""
        return self.used * self.view_weights[:, None]


def fit_lens(
    views: BoardViews,
    lens: str,
    fixed: tuple[str, ...] = (),
    start: Float[np.ndarray, " 9"] | None = None,
) -> LensFit:
    """Fit the lens and the pose of every view, and find the corners and views that are wrong.

    Args:
        fixed: names of parameters to hold at zero.
        start: (9,) first guess; found by `lens_start` if not given.
    """
    free = lens_bundle.free_mask(lens, fixed)
    parameters = np.where(free, lens_start(views, lens)[0] if start is None else start, 0)
    count = len(views.views)
    poses = board_poses(views, lens, parameters)
    posed = ~np.isnan(poses[:, 0])
    seen, y = lens_bundle.padded(views, parameters, poses)
    problem = _Problem(lens, seen, free, np.pad(posed, (0, len(seen.corners_px) - count)))

    weights = np.where(problem.posed[:, None], seen.present, 0.0)
    sigma_px = problem.typical_px(np.asarray(lens_bundle.residuals_px(lens, y, seen)))
    for _ in range(_ROBUST_ROUNDS):
        bundle = problem.solved(y, weights, sigma_px, _CUT)
        sigma_px = problem.typical_px(np.asarray(bundle.residual_px))
        y = _posed_anew(views, problem, bundle, sigma_px)

    bundle = problem.solved(y, weights, sigma_px, _CUT)
    used, view_weights = problem.judged(np.asarray(bundle.residual_px), sigma_px)
    for _ in range(_ROUNDS):
        bundle, sigma_px = problem.fitted(bundle.unknowns, used * view_weights[:, None], sigma_px)
        residual_px = np.asarray(bundle.residual_px)
        before = used, view_weights
        # By the median view: a few bad ones would raise the sigma until they pass for good.
        used, view_weights = problem.judged(residual_px, problem.typical_px(residual_px))
        if np.array_equal(used, before[0]) and np.allclose(view_weights, before[1], rtol=0.05):
            break
    used, view_weights = before  # those of the last fit
    inflation, covariance = problem.uncertainty(bundle, used * view_weights[:, None], sigma_px)
    if np.any((view_weights > 0) & (view_weights < 1)):
        equal = (view_weights > 0).astype(float)
        weights = used * equal[:, None]
        plain, plain_sigma_px = problem.fitted(bundle.unknowns, weights, sigma_px)
        if problem.same_lens(bundle, plain, covariance):
            bundle, sigma_px, view_weights = plain, plain_sigma_px, equal
            inflation, covariance = problem.uncertainty(bundle, weights, sigma_px)
    residual_px = np.asarray(bundle.residual_px)
    return LensFit(
        lens=lens,
        views=views,
        parameters=np.asarray(bundle.unknowns.lens),
        covariance=covariance,
        inflation=inflation,
        fixed=fixed,
        Ts_camera_board=np.asarray(bundle.unknowns.Ts_camera_board)[:count],
        residual_px=residual_px[:count],
        used=used[:count],
        view_weights=view_weights[:count],
        view_sigma_px=problem.view_sigma_px(residual_px)[:count],
        sigma_px=sigma_px,
        converged=bool(bundle.converged),
    )


@dataclass(frozen=True)
class _Problem:
    lens: str
    seen: BoardCorners
    free: np.ndarray
    posed: np.ndarray  # (V,) true for views with a first guess of the pose

    def solved(self, y: LensUnknowns, weights: np.ndarray, sigma_px: float, cut: float) -> Bundle:
        return lens_bundle.solve(self.lens, y, self.seen, weights, self.free, sigma_px, cut)

    def view_sigma_px(self, residual_px: np.ndarray) -> np.ndarray:
        """(V,) sigma by the median, so up to half the corners may be wrong; inf without a pose.

        The squared length of two Gaussian coordinates has the median 2 ln 2 sigma^2.
        """
        squared = np.where(self.seen.present, np.sum(residual_px**2, axis=-1), np.nan)
        squared[~self.posed] = np.inf
        corners = np.sum(self.seen.present, axis=1)
        known = np.where(corners[:, None] > 0, squared, np.inf)
        # The pose takes six of the 2 n degrees of freedom.
        freedom = np.maximum(2 * corners - 6, 1) / np.maximum(2 * corners, 1)
        return np.sqrt(np.nanmedian(known, axis=1) / (2 * np.log(2)) / freedom)

    def typical_px(self, residual_px: np.ndarray) -> float:
        """Standard deviation of a corner's coordinate in the median view, px."""
        each = self.view_sigma_px(residual_px)[self.posed]
        return max(float(np.median(each)) if len(each) else 1.0, _LEAST_SIGMA_PX)

    def fitted(self, y: LensUnknowns, weights: np.ndarray, sigma_px: float) -> tuple[Bundle, float]:
        """Plain least squares, and the deviation of a corner's coordinate at weight 1 in it, px."""
        bundle = self.solved(y, weights, sigma_px, NO_CUT)
        views = np.any(weights > 0, axis=1).sum()
        freedom = 2 * np.sum(weights > 0) - 6 * views - self.free.sum()
        squared = float(np.sum(weights * np.sum(np.asarray(bundle.residual_px) ** 2, axis=-1)))
        return bundle, max(float(np.sqrt(squared / max(freedom, 1))), _LEAST_SIGMA_PX)

    def judged(self, residual_px: np.ndarray, sigma_px: float) -> tuple[np.ndarray, np.ndarray]:
        """Judge corners and views: a mask of the right corners (V, P) and view weights (V,)."""
        each = self.view_sigma_px(residual_px)
        # Views of few corners are granted the spread of a sample median; views of hardly more
        # corners than their pose needs are granted the spread at their few degrees of freedom.
        corners = np.maximum(np.sum(self.seen.present, axis=1), 1)
        freedom = np.maximum(2 * corners - 6, 1)
        median_spread = 5 / (np.log(2) * np.sqrt(corners))
        granted = np.maximum(1 + median_spread, stats.chi2.isf(_CHANCE, freedom) / freedom)
        ratio = each / sigma_px
        worse = (ratio > _WEAK) & (ratio**2 > granted)
        right = self.posed & ~(worse & (ratio > _WRONG))
        weights = np.where(right, np.where(worse, 1 / np.maximum(ratio, 1) ** 2, 1.0), 0.0)
        expected_px = sigma_px / np.sqrt(np.where(right, weights, 1))
        distance_px = np.linalg.norm(residual_px, axis=-1)
        used = self.seen.present & right[:, None] & (distance_px < _FAR * expected_px[:, None])
        # Fewer than four corners don't determine a pose.
        few = used.sum(axis=1) < 4
        return used & ~few[:, None], np.where(few, 0.0, weights)

    def same_lens(self, weighted: Bundle, plain: Bundle, covariance: np.ndarray) -> bool:
        """True if two lenses differ by no more than the covariance of one lets expect."""
        moved = np.asarray(plain.unknowns.lens - weighted.unknowns.lens)[self.free]
        inside = covariance[np.ix_(self.free, self.free)]
        if not np.all(np.isfinite(inside)):
            return False
        sigma = np.sqrt(np.diag(inside))
        correlation = inside / np.outer(sigma, sigma)
        squared = float(moved / sigma @ np.linalg.solve(correlation, moved / sigma))
        return squared < stats.chi2.isf(_BY_CHANCE, self.free.sum())

    def uncertainty(
        self, bundle: Bundle, weights: np.ndarray, sigma_px: float
    ) -> tuple[float, np.ndarray]:
        """The factor of the variances by which the views disagree, 1 where there are too few; and
        the covariance (9, 9), zero for fixed parameters, infinite if undetermined."""
        information, gradient = map(
            np.asarray, lens_bundle.view_information(self.lens, bundle.unknowns, self.seen, weights)
        )
        shown = np.any(weights > 0, axis=1)
        each = information[shown][:, self.free][:, :, self.free]
        scale = 1 / np.sqrt(np.maximum(np.einsum("bii->i", each), 1e-300))
        each, scores = each * np.outer(scale, scale), gradient[shown][:, self.free] * scale
        factor, inverse = 1.0, np.full_like(np.outer(scale, scale), np.inf)
        try:
            inverse = np.linalg.inv(each.sum(axis=0))
            factor = _leveraged_inflation(each, scores / sigma_px)
        except np.linalg.LinAlgError:  # not all of them are determined
            pass
        if not np.all(np.diag(inverse) > 0):
            inverse[:] = np.inf
        covariance = np.zeros((COUNT, COUNT))
        inside = np.ix_(self.free, self.free)
        covariance[inside] = factor * sigma_px**2 * inverse * np.outer(scale, scale)
        return factor, covariance


def _posed_anew(
    views: BoardViews, problem: _Problem, bundle: Bundle, sigma_px: float
) -> LensUnknowns:
    """Give views that are far off a new first pose: they may be stuck in the mirrored one."""
    each = problem.view_sigma_px(np.asarray(bundle.residual_px))
    far = np.flatnonzero(problem.posed & (each > 2 * sigma_px))
    y = bundle.unknowns
    if not len(far):
        return y
    few = replace(views, views=tuple(views.views[i] for i in far))
    poses = board_poses(few, problem.lens, np.asarray(y.lens))
    Ts_camera_board = np.array(y.Ts_camera_board)
    Ts_camera_board[far] = np.where(np.isnan(poses), Ts_camera_board[far], poses)
    again = LensUnknowns(y.lens, jnp.asarray(Ts_camera_board))
    residual_px = np.asarray(lens_bundle.residuals_px(problem.lens, again, problem.seen))
    worse = problem.view_sigma_px(residual_px) >= each
    Ts_camera_board[worse] = np.asarray(y.Ts_camera_board)[worse]
    return LensUnknowns(y.lens, jnp.asarray(Ts_camera_board))


def _leveraged_inflation(
    information: Float[np.ndarray, "V p p"], scores: Float[np.ndarray, "V p"]
) -> float:
    """The factor of the variances where few views weigh much each; 1 if it is not noticed.

    A view draws the solution towards itself, by its share of the information, so its score is
    smaller than its error: each is divided by the root of what is left of it. Of independent noise
    the factor has the mean 1 exactly.

    Args:
        information: of the p shared unknowns from each view, its pose eliminated, for noise of 1.
        scores: gradient of half the cost of each view by them, of residuals in units of noise.

    Source: Bell, McCaffrey (2002), "Bias reduction in standard errors for linear regression with
    multi-stage samples".
    """
    lower = np.linalg.cholesky(information.sum(axis=0))
    whitened = np.linalg.solve(lower, np.swapaxes(np.linalg.solve(lower, information), 1, 2))
    shares, axes = np.linalg.eigh(whitened)
    along = np.einsum("bij,bi->bj", axes, np.linalg.solve(lower, scores.T).T)
    count = information.shape[1]
    ratio = float(np.sum(along**2 / np.maximum(1 - shares, _LEAST_LEFT)) / count)
    chance = float(np.sqrt(2 * np.sum(shares**2)) / count)
    return ratio if ratio > 1 + _NOTICED_SIGMAS * chance else 1.0
