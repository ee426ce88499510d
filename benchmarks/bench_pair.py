"""Time both poses of one marker, closed form and refined: jaxnav against OpenCV.

    python benchmarks/bench_pair.py              # the tables of README-pose.md
    pytest benchmarks/bench_pair.py --benchmark-enable --benchmark-only

Peers run in the same process and take turns, OpenCV on one thread and on the first lanes of the
batch; figures are medians over the rounds. Precision is float32, flags are those of the commands.
"""

import functools
import importlib.metadata
import os
import platform
import resource
import time
from collections.abc import Callable
from pathlib import Path

import cv2
import jax
import jax.numpy as jnp
import jaxlie
import lineax as lx
import numpy as np
import optimistix as optx
import pytest
from jax.experimental.compilation_cache import compilation_cache
from pytest_benchmark.fixture import BenchmarkFixture

from jaxnav.core.models.markers import CORNER_SIGNS
from jaxnav.core.pose import refine
from jaxnav.core.pose.ippe import PosePair, ippe_square
from jaxnav.core.pose.pair_lanes import ippe_squares, solve_pairs
from jaxnav.files.configuration import configure

SIZE_M, FOCAL_PX, ROUNDS, STEPS = 0.172, 319.0, 15, 12
BATCH, OPENCV_LANES, GENERAL_LANES, QUALITY_LANES = 100_000, 200, 2_000, 10_000
OBJECT_M = SIZE_M / 2 * CORNER_SIGNS


def markers(count: int, noise_px: float, seed: int = 0) -> np.ndarray:
    """Noisy corners (count, 4, 2), normalised: 0.3 to 5 m away, tilted up to 75 degrees."""
    rng = np.random.default_rng(seed)
    tilt, azimuth, roll = (rng.uniform(0, top, count) for top in (np.deg2rad(75), 7, 7))
    axis = np.stack([np.cos(azimuth), np.sin(azimuth), np.zeros(count)], axis=1)
    points = np.broadcast_to(OBJECT_M, (count, 4, 3))
    points = _turned(points, np.broadcast_to([0.0, 0, 1], (count, 3)), roll) * [1.0, -1, -1]
    depth_m = rng.uniform(0.3, 5, count)[:, None]
    sides = rng.uniform([-1, -0.5], [1, 0.5], (count, 2))
    position_m = depth_m * np.column_stack([sides, np.ones(count)])
    points = _turned(points, axis, tilt) + position_m[:, None]
    corners = points[..., :2] / points[..., 2:]
    return corners + rng.normal(scale=noise_px / FOCAL_PX, size=corners.shape)


def _turned(points: np.ndarray, axis: np.ndarray, angle: np.ndarray) -> np.ndarray:
    """Points (n, 4, 3) turned about an axis (n, 3) by an angle (n,) rad. Source: Rodrigues."""
    axis, c, s = axis[:, None], np.cos(angle)[:, None, None], np.sin(angle)[:, None, None]
    along = np.sum(points * axis, axis=2, keepdims=True) * axis
    return c * points + s * np.cross(axis, points) + (1 - c) * along


def opencv_pairs(corners: np.ndarray, refined: bool) -> tuple[np.ndarray, np.ndarray]:
    """Rotation vectors and translations (n, 2, 3): IPPE, and LM from both poses."""
    rotations, translations = np.empty((2, len(corners), 2, 3))
    for i, image in enumerate(corners):
        _, rotvecs, shifts, _ = cv2.solvePnPGeneric(
            OBJECT_M, image, np.eye(3), None, flags=cv2.SOLVEPNP_IPPE_SQUARE
        )
        for k, (rotvec, shift) in enumerate(zip(rotvecs, shifts, strict=True)):
            if refined:
                rotvec, shift = cv2.solvePnPRefineLM(
                    OBJECT_M, image, np.eye(3), None, rotvec, shift
                )
            rotations[i, k], translations[i, k] = rotvec[:, 0], shift[:, 0]
    return rotations, translations


Task = tuple[Callable[[], object], int]


def closed_form(corners: np.ndarray, batched: bool = True) -> Task:
    """Our closed form, compiled: the batched one, or the one for one marker under vmap."""
    return _compiled(ippe_squares if batched else jax.vmap(ippe_square), corners)


def _compiled(function: Callable[..., PosePair], corners: np.ndarray) -> Task:
    many, sizes = jnp.asarray(corners, jnp.float32), jnp.full(len(corners), SIZE_M, jnp.float32)
    compiled = jax.jit(function)
    jax.block_until_ready(compiled(many, sizes))
    return lambda: jax.block_until_ready(compiled(many, sizes)), len(corners)


def single_thread(corners: np.ndarray, refined: bool) -> Task:
    """OpenCV's."""
    cv2.setNumThreads(1)
    return lambda: opencv_pairs(corners, refined), len(corners)


def one_by_one(corners: np.ndarray) -> Task:
    """`solve_marker` under vmap, by at most `STEPS` steps."""
    one = functools.partial(refine.solve_marker, max_steps=STEPS)
    return _compiled(lambda corners, sizes: jax.vmap(one)(corners, sizes), corners)


def builtin_lm(corners: np.ndarray) -> Task:
    """The same minima by optimistix's own solver, as good as it gets."""
    solver = optx.LevenbergMarquardt(rtol=1e-4, atol=1e-4, linear_solver=lx.Normal(lx.Cholesky()))

    def one_marker(corners_n: jax.Array, size_m: jax.Array) -> jax.Array:
        marker = refine._SingleMarker(corners_n, size_m)

        def one_pose(wxyz_xyz: jax.Array) -> jax.Array:
            chart = marker.chart(jaxlie.SE3(wxyz_xyz[None]))
            linearised = chart.linearised(marker.rows, jnp.eye(6))
            solution = optx.least_squares(
                lambda y, _: linearised(y[:, None])[0][:, 0],
                solver,
                jnp.zeros(6),
                max_steps=STEPS,
                throw=False,
            )
            return chart.transform(solution.value[:, None]).wxyz_xyz[0]

        return jax.vmap(one_pose)(ippe_square(corners_n, size_m).T_camera_marker.wxyz_xyz)

    return _compiled(lambda corners, sizes: jax.vmap(one_marker)(corners, sizes), corners)


def medians_us(tasks: dict[str, Task]) -> dict[str, np.ndarray]:
    """Median (wall, CPU) time an item of each task, which handles so many; tasks take turns."""
    times: dict[str, list[np.ndarray]] = {name: [] for name in tasks}
    for _ in range(ROUNDS):
        for name, (task, items) in tasks.items():
            started = np.array([time.perf_counter(), time.process_time()])
            task()
            spent = np.array([time.perf_counter(), time.process_time()]) - started
            times[name].append(spent / items * 1e6)
    return {name: np.median(values, axis=0) for name, values in times.items()}


def costs_px2(R: np.ndarray, t: np.ndarray, corners: np.ndarray) -> np.ndarray:
    """e1 (n, 2) in float64 of poses (n, 2); NaN for one that has a corner behind the camera."""
    points = np.einsum("nkij,cj->nkci", R, OBJECT_M) + t[:, :, None]
    error = points[..., :2] / points[..., 2:] - corners[:, None]
    in_front = np.all(points[..., 2] > 0, axis=2)
    return np.where(in_front, np.sum(error**2, axis=(2, 3)) * FOCAL_PX**2, np.nan)


def our_costs(pair: PosePair, corners: np.ndarray) -> np.ndarray:
    """Of our poses, whatever their precision, sorted."""
    poses = np.asarray(pair.T_camera_marker.wxyz_xyz, float)
    w, x, y, z = np.moveaxis(poses[..., :4], -1, 0) / np.linalg.norm(poses[..., :4], axis=-1)
    rows = [
        [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
        [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
        [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
    ]
    R = np.moveaxis(np.array(rows), (0, 1), (-2, -1))
    return np.sort(costs_px2(R, poses[..., 4:], corners), axis=1)


def quality(noise_px: float) -> dict[str, float]:
    """How our float32 minima compare with OpenCV's, shares of the lanes in percent.

    Both sides start from the same pair and are sorted by cost: where both of one side's starts run
    into one minimum, that side's second cost is compared with the other's second. A lane where
    OpenCV ends behind the camera is no pose and is left out, but counted.
    """
    corners = markers(QUALITY_LANES, noise_px, 7).astype(np.float32).astype(float)
    rotvecs, shifts = opencv_pairs(corners, refined=True)
    R = np.array([[cv2.Rodrigues(r)[0] for r in both] for both in rotvecs])
    theirs = np.sort(costs_px2(R, shifts, corners), axis=1)
    sizes = np.full(len(corners), SIZE_M)
    ours = our_costs(
        jax.jit(solve_pairs)(jnp.asarray(corners, jnp.float32), jnp.asarray(sizes, jnp.float32)),
        corners,
    )
    with jax.enable_x64(True):
        polished = our_costs(jax.jit(solve_pairs)(jnp.asarray(corners), sizes), corners)
    possible = np.all(np.isfinite(theirs), axis=1)
    worse = np.max(ours / theirs - 1, axis=1)[possible]
    not_yet = np.max(theirs / polished - 1, axis=1)[possible]
    left_over = np.max(ours / polished - 1, axis=1)
    return {
        "within 1e-4 of OpenCV's cost, or lower": 100 * np.mean(worse <= 1e-4),
        "worse by more than 1 %": 100 * np.mean(worse > 0.01),
        "largest excess over OpenCV": 100 * float(np.max(worse)),
        "lower than OpenCV's by more than 1e-4": 100
        * np.mean(np.min(ours / theirs - 1, axis=1)[possible] < -1e-4),
        "ours above the minimum (float64) by more than 1e-4": 100 * np.mean(left_over > 1e-4),
        "OpenCV above the minimum by more than 1e-4": 100 * np.mean(not_yet > 1e-4),
        "OpenCV behind the camera": 100 * np.mean(~possible),
    }


def compile_s() -> dict[str, float]:
    """Trace and compile, without the cache."""
    jax.config.update("jax_enable_compilation_cache", False)
    compilation_cache.reset_cache()
    corners = jax.ShapeDtypeStruct((BATCH, 4, 2), jnp.float32)
    sizes = jax.ShapeDtypeStruct((BATCH,), jnp.float32)
    seconds = {}
    for name, function in (("ippe_squares", ippe_squares), ("solve_markers", solve_pairs)):
        jax.clear_caches()
        started = time.perf_counter()
        jax.jit(function).lower(corners, sizes).compile()
        seconds[name] = time.perf_counter() - started
    return seconds


def peak_mib() -> float:
    """Most memory this process ever held, MiB."""
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024


@pytest.fixture(scope="module")
def corners() -> np.ndarray:
    """One batch for all."""
    configure(float64=False)
    return markers(BATCH, 0.3)


@pytest.mark.parametrize("name", ["opencv", "vmap", "batched"])
def test_closed_form(benchmark: BenchmarkFixture, corners: np.ndarray, name: str) -> None:
    """The pair from IPPE."""
    run, benchmark.extra_info["items"] = (
        single_thread(corners[:OPENCV_LANES], refined=False)
        if name == "opencv"
        else closed_form(corners, name == "batched")
    )
    benchmark(run)


@pytest.mark.parametrize("name", ["opencv", "solve_markers"])
def test_refined(benchmark: BenchmarkFixture, corners: np.ndarray, name: str) -> None:
    """The pair and both of its minima."""
    run, benchmark.extra_info["items"] = (
        single_thread(corners[:OPENCV_LANES], refined=True)
        if name == "opencv"
        else _compiled(solve_pairs, corners)
    )
    benchmark(run)


@pytest.mark.parametrize("name", ["own", "optimistix"])
def test_general(benchmark: BenchmarkFixture, corners: np.ndarray, name: str) -> None:
    """`solve_marker` under vmap: our step and optimistix's."""
    general = one_by_one if name == "own" else builtin_lm
    run, benchmark.extra_info["items"] = general(corners[:GENERAL_LANES])
    benchmark(run)


def main() -> None:
    """Print the tables."""
    configure(float64=False)
    many = markers(BATCH, 0.3)
    few, some = many[:OPENCV_LANES], many[:GENERAL_LANES]
    before = peak_mib()
    _compiled(solve_pairs, markers(1_000_000, 0.3))[0]()
    memory = peak_mib() - before
    noisy = markers(BATCH, 1.0)
    result = medians_us(
        {
            "OpenCV IPPE_SQUARE": single_thread(few, refined=False),
            "ippe_square, vmap": closed_form(many, batched=False),
            "ippe_squares": closed_form(many),
            "OpenCV IPPE_SQUARE + 2 refineLM": single_thread(few, refined=True),
            "solve_markers": _compiled(solve_pairs, many),
            "solve_markers, 1 px": _compiled(solve_pairs, noisy),
            f"solve_marker, vmap, {STEPS} steps at most": one_by_one(some),
            "the same by optimistix.LevenbergMarquardt": builtin_lm(some),
        }
    )
    model = _cpu_model()
    versions = ", ".join(
        f"{name} {importlib.metadata.version(name)}"
        for name in ("jax", "jaxlib", "optimistix", "opencv-python-headless", "numpy")
    )
    threads = len(os.sched_getaffinity(0))
    print(f"{versions}; {model}, {threads} threads for jax, 1 for OpenCV; batch {BATCH}\n")
    backend = jax.default_backend()
    print(
        f"| both poses of one marker | us, {backend} | CPU us | wall ratio | CPU ratio | pairs/s |"
    )
    print("|---|---|---|---|---|---|")
    peer = np.ones(2)
    for name, spent in result.items():
        peer = spent if name.startswith("OpenCV") else peer
        wall, cpu = peer / spent
        numbers = f"{spent[0]:.3g} | {spent[1]:.3g} | {wall:.1f} | {cpu:.1f} | {1e6 / spent[0]:.3g}"
        print(f"| {name} | {numbers} |")
    seconds = ", ".join(f"{name} {value:.1f} s" for name, value in compile_s().items())
    print(f"\ncompile: {seconds}; 1e6 markers add {memory:.0f} MiB to the process\n")
    columns = {noise: quality(noise) for noise in (0.3, 1.0)}
    print("| share of the markers, both poses, % | 0.3 px | 1 px |\n|---|---|---|")
    for name in columns[0.3]:
        print(f"| {name} | " + " | ".join(f"{c[name]:.3g}" for c in columns.values()) + " |")


def _cpu_model() -> str:
    info = Path("/proc/cpuinfo")
    lines = info.read_text().splitlines() if info.exists() else []
    names = [line.split(":")[1].strip() for line in lines if line.startswith("model name")]
    return names[0] if names else platform.processor()


if __name__ == "__main__":
    main()
