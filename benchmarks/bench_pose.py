"""Both poses of one marker: ours against OpenCV, and our LM step against optimistix's own.

    python benchmarks/bench_pose.py

Peers run in the same process, interleaved, OpenCV on one thread; medians over the rounds.
"""

import functools
import time
from collections.abc import Callable

import cv2
import jax
import jax.numpy as jnp
import lineax as lx
import numpy as np
import optimistix as optx

from jaxnav import refine
from jaxnav.ippe import ippe_square
from jaxnav.levenberg_marquardt import NormalEquationsLM
from jaxnav.markers import CORNER_SIGNS
from jaxnav.refine import solve_markers

SIZE_M, FOCAL_PX, ROUNDS = 0.172, 319.0, 7
STEPS = 12  # what `Navigator.step` allows
OBJECT_M = SIZE_M / 2 * CORNER_SIGNS


def markers(count: int, rng: np.random.Generator) -> np.ndarray:
    """Noisy corners (count, 4, 2), normalised: 0.3 to 5 m, tilted up to 75 degrees, 0.3 px."""
    tilt, azimuth, roll = (rng.uniform(0, top, count) for top in (np.deg2rad(75), 7, 7))
    corners = np.empty((count, 4, 2))
    for i in range(count):
        axis = np.array([np.cos(azimuth[i]), np.sin(azimuth[i]), 0.0])
        R = cv2.Rodrigues(tilt[i] * axis)[0] @ np.diag([1.0, -1, -1])
        R = R @ cv2.Rodrigues(np.array([0, 0, roll[i]]))[0]
        position_m = rng.uniform(0.3, 5) * np.array([rng.uniform(-1, 1), rng.uniform(-0.5, 0.5), 1])
        points = OBJECT_M @ R.T + position_m
        corners[i] = points[:, :2] / points[:, 2:]
    return corners + rng.normal(scale=0.3 / FOCAL_PX, size=corners.shape)


def opencv(corners: np.ndarray, refined: bool) -> None:
    """IPPE, and LM from both poses."""
    for image in corners:
        _, rotations, translations, _ = cv2.solvePnPGeneric(
            OBJECT_M, image, np.eye(3), None, flags=cv2.SOLVEPNP_IPPE_SQUARE
        )
        if refined:
            for rotation, translation in zip(rotations, translations, strict=True):
                cv2.solvePnPRefineLM(OBJECT_M, image, np.eye(3), None, rotation, translation)


def medians_us(tasks: dict[str, tuple[Callable[[], object], int]]) -> dict[str, float]:
    """Median time an item of each task, which handles so many; tasks take turns."""
    for task, _ in tasks.values():
        task()
    times: dict[str, list[float]] = {name: [] for name in tasks}
    for _ in range(ROUNDS):
        for name, (task, items) in tasks.items():
            started = time.perf_counter()
            task()
            times[name].append((time.perf_counter() - started) / items * 1e6)
    return {name: float(np.median(values)) for name, values in times.items()}


def solve_with(
    make_solver: Callable[..., optx.AbstractLeastSquaresSolver],
) -> Callable[..., object]:
    """Both poses refined by at most `STEPS` steps of a solver."""

    def run(corners: jax.Array, sizes: jax.Array) -> object:
        own = refine.NormalEquationsLM
        refine.NormalEquationsLM = make_solver  # type: ignore[assignment,misc]
        try:
            one = functools.partial(refine.solve_marker, max_steps=STEPS)
            return jax.vmap(one)(corners, sizes)
        finally:
            refine.NormalEquationsLM = own  # type: ignore[misc]

    return jax.jit(run)


def main() -> None:
    """Print the table."""
    cv2.setNumThreads(1)
    corners = markers(2000, np.random.default_rng(0))
    sizes = jnp.full(len(corners), SIZE_M)
    few, many = corners[:300], jnp.asarray(corners, jnp.float32)
    closed_form = jax.jit(jax.vmap(ippe_square))
    own = solve_with(NormalEquationsLM)
    builtin = solve_with(
        lambda rtol, atol: optx.LevenbergMarquardt(
            rtol=1e-4, atol=1e-4, linear_solver=lx.Normal(lx.Cholesky())
        )
    )
    result = medians_us(
        {
            "OpenCV IPPE_SQUARE": (lambda: opencv(few, False), len(few)),
            "jaxnav ippe_square, vmap": (
                lambda: jax.block_until_ready(closed_form(many, sizes)),
                len(many),
            ),
            "OpenCV IPPE_SQUARE + 2 refineLM": (lambda: opencv(few, True), len(few)),
            "jaxnav solve_markers, to convergence": (
                lambda: jax.block_until_ready(solve_markers(many, sizes)),
                len(many),
            ),
            f"jaxnav, LM of {STEPS} steps at most": (
                lambda: jax.block_until_ready(own(many, sizes)),
                len(many),
            ),
            f"the same {STEPS} steps by optimistix.LevenbergMarquardt": (
                lambda: jax.block_until_ready(builtin(many, sizes)),
                len(many),
            ),
        }
    )
    print("| both poses of one marker | us a marker |\n|---|---|")
    for name, microseconds in result.items():
        print(f"| {name} | {microseconds:.2f} |")


if __name__ == "__main__":
    main()
