"""Calibrate lenses from views of a board: check the sigmas, and compare jaxnav with OpenCV.

    python benchmarks/bench_intrinsics.py        # the tables of README-intrinsics.md

Corner level: 40 views of 9 x 6 points, 30 mm apart, corner noise 0.1 px, by the QCar's lens (147
degrees) and by one of 67 degrees with radtan distortion. Both sides get the same corners in the
same process and take turns; times are medians.
"""

import time
from dataclasses import dataclass, replace

import cv2
import jax
import jax.numpy as jnp
import numpy as np
from scipy import stats

from jaxnav.calibrate.board.views import BoardViews
from jaxnav.calibrate.lens import bundle as lens_bundle
from jaxnav.calibrate.lens.bundle import NO_CUT
from jaxnav.calibrate.lens.fit import LensFit, fit_lens
from jaxnav.calibrate.lens.simulated_views import grid_points_m, seen_from, simulated_views
from jaxnav.calibrate.lens.start import board_poses, opencv_calibration
from jaxnav.core.models.camera import Camera
from jaxnav.files.configuration import configure

TRIALS, ROUNDS, VIEWS, SIGMA_PX = 100, 15, 40, 0.1
IMAGE_SIZE_PX = (820, 410)
POINTS_M = grid_points_m(9, 6, 0.03)


@dataclass(frozen=True)
class Case:
    """A camera and how the board is held before it."""

    lens: str
    truth: tuple[float, ...]
    distances_m: tuple[float, float]

    @property
    def camera(self) -> Camera:
        return Camera.create(self.truth[:2], self.truth[2:4], self.lens, self.truth[4:])


CASES = {
    "147 deg, equidistant": Case("equidistant", (319, 319, 401, 202, 0, 0, 0, 0), (0.15, 0.6)),
    "67 deg, radtan": Case(
        "radtan", (619, 620, 411, 212, -0.25, 0.08, 1e-3, -5e-4, 0.01), (0.35, 1.0)
    ),
}


def drawn(case: Case, seed: int) -> tuple[BoardViews, np.ndarray]:
    """Views of one trial and the board's true poses."""
    rng = np.random.default_rng(seed)
    return simulated_views(
        case.camera, IMAGE_SIZE_PX, POINTS_M, VIEWS, rng, SIGMA_PX, case.distances_m
    )


def planted(views: BoardViews, poses: np.ndarray, case: Case, seed: int) -> BoardViews:
    """Four views of the forty spoilt: two blurred, one of a longer board, one misnumbered."""
    rng = np.random.default_rng(10_000 + seed)
    spoilt = list(views.views)
    for row in (3, 11):
        noise_px = rng.normal(scale=1.5, size=spoilt[row].corners_px.shape)
        spoilt[row] = replace(spoilt[row], corners_px=spoilt[row].corners_px + noise_px)
    longer, inside = seen_from(case.camera, IMAGE_SIZE_PX, POINTS_M * [1.1, 1, 1], poses[20])
    ids = np.flatnonzero(inside)
    spoilt[20] = replace(spoilt[20], ids=ids, corners_px=longer[ids])
    spoilt[30] = replace(spoilt[30], corners_px=np.roll(spoilt[30].corners_px, 1, axis=0))
    return replace(views, views=tuple(spoilt))


def consistency(case: Case) -> None:
    """Errors of a hundred trials against their sigmas."""
    truth = np.array(case.truth, float)
    count = len(truth)
    errors, sigmas, squared, noise = [], [], [], []
    for seed in range(TRIALS):
        fit = fit_lens(drawn(case, seed)[0], case.lens)
        error = fit.parameters[:count] - truth
        errors.append(error)
        sigmas.append(fit.sigma[:count])
        squared.append(error @ np.linalg.solve(fit.covariance[:count, :count], error))
        noise.append(fit.sigma_px)
    ratio = np.abs(np.array(errors)) / np.array(sigmas)
    low, high = stats.chi2.ppf([5e-4, 1 - 5e-4], count * TRIALS) / (count * TRIALS)
    rms, sigma = np.sqrt(np.mean(np.square(errors), axis=0)), np.mean(sigmas, axis=0)
    print("\n| parameter | truth | RMS error | mean sigma | within 3 sigma, % |")
    print("|---|---|---|---|---|")
    for i, name in enumerate(lens_bundle.NAMES[case.lens]):
        inside = 100 * np.mean(ratio[:, i] < 3)
        print(f"| {name} | {truth[i]:g} | {rms[i]:.2g} | {sigma[i]:.2g} | {inside:.0f} |")
    worst = np.max(np.abs(np.array(errors)[:, :2] / truth[:2]))
    worst_px = np.max(np.abs(np.array(errors)[:, 2:4]))
    print(
        f"\nANEES / {count}: {np.mean(squared) / count:.3f}, 99.9 % band {low:.3f} to {high:.3f}; "
        f"corner noise found {np.mean(noise):.4f} px, "
        f"{np.min(noise):.4f} to {np.max(noise):.4f}; worst focal length "
        f"{100 * worst:.3f} %, worst centre {worst_px:.2f} px"
    )


def rms_px(views: BoardViews, lens: str, parameters: np.ndarray) -> float:
    """Of all corners with these figures, every view's pose at its best; as OpenCV counts it."""
    seen, start = lens_bundle.padded(views, parameters, board_poses(views, lens, parameters))
    held = lens_bundle.solve(
        lens,
        start,
        seen,
        jnp.asarray(seen.present, float),
        jnp.zeros(lens_bundle.COUNT, bool),
        jnp.asarray(SIGMA_PX),
        jnp.asarray(NO_CUT),
    )
    squared = np.sum(np.asarray(held.residual_px) ** 2, axis=-1)
    return float(np.sqrt(np.mean(squared[np.asarray(seen.present)])))


def of_opencv(views: BoardViews, lens: str) -> np.ndarray | None:
    """Nine figures by OpenCV, None where it throws."""
    try:
        matrix, coefficients = opencv_calibration(views, views.views, lens)
    except cv2.error:
        return None
    figures = [matrix[0, 0], matrix[1, 1], matrix[0, 2], matrix[1, 2], *coefficients]
    return np.append(figures, np.zeros(lens_bundle.COUNT - len(figures)))


def against_opencv(case: Case, spoilt: bool) -> None:
    """Both sides on the same views."""
    truth = np.array(case.truth, float)
    rows: dict[str, list[list[float]]] = {"OpenCV": [], "jaxnav": []}
    thrown = not_above = 0
    for seed in range(-1, ROUNDS):
        clean, poses = drawn(case, 500 + seed)
        views = planted(clean, poses, case, seed) if spoilt else clean
        good = replace(
            views, views=tuple(v for i, v in enumerate(views.views) if v is clean.views[i])
        )
        begun = time.perf_counter()
        theirs = of_opencv(views, case.lens)
        between = time.perf_counter()
        fit: LensFit = fit_lens(views, case.lens)
        ended = time.perf_counter()
        if seed < 0:  # compiles
            continue
        found = {"OpenCV": theirs, "jaxnav": fit.parameters}
        thrown += theirs is None
        errors_px = {}
        for name, figures in found.items():
            if figures is None:
                continue
            took = between - begun if name == "OpenCV" else ended - between
            focal = 100 * np.max(np.abs(figures[:2] / truth[:2] - 1))
            center = np.max(np.abs(figures[2:4] - truth[2:4]))
            errors_px[name] = rms_px(good, case.lens, figures)
            rows[name].append([errors_px[name], focal, center, took])
        if theirs is not None:
            not_above += errors_px["jaxnav"] <= errors_px["OpenCV"] * (1 + 1e-6)
    for name, values in rows.items():
        if values:
            error_px, focal, center, took = np.median(values, axis=0)
            worst = np.max(values, axis=0)
            print(
                f"| {'4 of 40 spoilt' if spoilt else 'clean'} | {name} | {error_px:.5f} | "
                f"{focal:.3f} ({worst[1]:.3f}) | {center:.2f} ({worst[2]:.2f}) | {took:.2f} |"
            )
    print(
        f"<!-- OpenCV threw {thrown} times; jaxnav's RMS is not above OpenCV's in {not_above} of "
        f"{ROUNDS - thrown} -->"
    )


def scaling() -> None:
    """The bundle alone, 500 views of 99 points."""
    case = CASES["147 deg, equidistant"]
    points_m = grid_points_m(11, 9, 0.03)
    views, poses = simulated_views(
        case.camera, IMAGE_SIZE_PX, points_m, 500, np.random.default_rng(0)
    )
    seen, start = lens_bundle.padded(views, np.append([300.0, 300, 410, 205], np.zeros(5)), poses)
    took = []
    for _ in range(5):
        begun = time.perf_counter()
        jax.block_until_ready(
            lens_bundle.solve(
                "equidistant",
                start,
                seen,
                jnp.asarray(seen.present, float),
                jnp.asarray(lens_bundle.free_mask("equidistant")),
                jnp.asarray(SIGMA_PX),
                jnp.asarray(NO_CUT),
            )
        )
        took.append(time.perf_counter() - begun)
    print(f"\n500 views, {int(np.sum(seen.present))} corners: {np.median(took[1:]):.2f} s")


if __name__ == "__main__":
    configure(float64=True)
    for title, each in CASES.items():
        print(f"\n## {title}")
        consistency(each)
        print("\n| views | | RMS of the good views, px | focal error, % (worst) | centre, px | s |")
        print("|---|---|---|---|---|---|")
        against_opencv(each, spoilt=False)
        against_opencv(each, spoilt=True)
    scaling()
