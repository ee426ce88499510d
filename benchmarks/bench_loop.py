"""Time the car's loop part by part: the search for markers, the estimator, and the start.

    python benchmarks/bench_loop.py
    pytest benchmarks/bench_loop.py --benchmark-enable --benchmark-only

The QCar before the paper's marker. Images are rendered, 820 x 410 px each, four a set.
"""

import itertools
import os
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")  # before NumPy, as the command does

from jaxnav.files.configuration import configure, step_folder

configure(float64=False, threads=1)

import cv2  # noqa: E402
import jax  # noqa: E402
import numpy as np  # noqa: E402
import pytest  # noqa: E402

from jaxnav.commands.simulate.rendered_world import SENSOR  # noqa: E402
from jaxnav.detection import make_detector  # noqa: E402
from jaxnav.drive.expect import Region, expect_corners  # noqa: E402
from jaxnav.drive.flags import Health  # noqa: E402
from jaxnav.drive.interfaces import Frame  # noqa: E402
from jaxnav.drive.pilot import Input  # noqa: E402
from jaxnav.drive.seeing import Search  # noqa: E402
from jaxnav.files import Route, calib_dir, load_markers, load_rig, load_vehicle  # noqa: E402
from jaxnav.recordings.drive_log import read_drive  # noqa: E402
from jaxnav.recordings.drive_setup import DriveSetup  # noqa: E402
from jaxnav.sim.rendering import Renderer  # noqa: E402
from jaxnav.sim.scene import Scene  # noqa: E402
from jaxnav.vehicles.conformance.faults import WAYPOINTS_M  # noqa: E402
from jaxnav.vehicles.conformance.lockstep import BEGIN_NS, Rates, drive  # noqa: E402
from jaxnav.vehicles.world import SimWorld  # noqa: E402

DISTANCES_M = (1.0, 2.0, 3.0)  # from the front camera's lens
WORKERS = 2
SETS = 40
FIRST_SETS = 3  # not counted
# Of a car that is tracked.
COVARIANCE = np.diag([0.02**2, 0.02**2, np.deg2rad(1.0) ** 2]).astype(np.float32)
MARKER_Y_M, CAMERA_M = 1.47, 0.193  # the marker's wall; the front camera ahead of the rear axle

DRIVE_S, SETTLING_S = 6.0, 1.0
DELAYS_S = (0.0, 0.03, 0.05)  # from an exposure until the pilot hears of its corners
START = (2.0, -1.0, np.deg2rad(125.0))

MAIN = "import sys; from jaxnav.cli import main; sys.exit(main())"
STARTS, HELPS = 3, 10


def setup() -> DriveSetup:
    """The paper's car on a long route."""
    qcar = calib_dir() / "qcar"
    return DriveSetup(
        load_rig(qcar / "rig.yaml"),
        load_markers(qcar / "markers.yaml"),
        load_vehicle(qcar / "vehicle.yaml"),
        Route(WAYPOINTS_M, 0.15, START),
    )


class Views:
    """Sets of images of a standing car, and what looks for markers in them."""

    def __init__(self, distance_m: float):
        """The car faces the marker from so far."""
        made = setup()
        rig, markers = made.rig, made.markers
        half = np.sqrt(0.5)
        pose = np.array([half, 0, 0, half, 0, MARKER_Y_M - CAMERA_M - distance_m, 0])
        renderer = Renderer(Scene.create(markers, seed=0), rig, sensor=SENSOR)
        rng = np.random.default_rng(0)
        self.sets = [renderer.render_still(pose, rng) for _ in range(4)]
        detectors = [make_detector("aruco", "tag36h11")]
        self.searches = [
            Search(c, rig.image_sizes_px[c], rig.camera(c), detectors) for c in range(len(rig))
        ]
        self.searches[0].warm_up()
        quads_px, visible, radius_px = jax.device_get(
            expect_corners(rig, markers, pose.astype(np.float32), COVARIANCE)
        )
        self.regions = [
            Region(quads_px[c][visible[c]], radius_px[c][visible[c]]) for c in range(len(rig))
        ]

    def look(self, pool: ThreadPoolExecutor, number: int, tracked: bool) -> int:
        """One set, a camera a job; how many markers were found."""

        def one(camera: int) -> int:
            image = self.sets[number % len(self.sets)][camera]
            region = self.regions[camera] if tracked else None
            found = self.searches[camera].look(Frame(number, image), region).detections
            return 0 if found is None else len(found)

        return sum(pool.map(one, range(len(self.searches))))


@pytest.mark.parametrize("distance_m", DISTANCES_M)
@pytest.mark.parametrize("tracked", [True, False])
def test_frame_set(benchmark: Any, distance_m: float, tracked: bool) -> None:
    """A set of four images."""
    cv2.setNumThreads(1)
    views = Views(distance_m)
    numbers = itertools.count()  # a picture that stays the same is not looked at
    with ThreadPoolExecutor(WORKERS) as pool:
        assert benchmark(lambda: views.look(pool, next(numbers), tracked)) == 1


def print_frame_sets() -> None:
    """Sets in a second, one after the other."""
    print(
        f"| four images, {WORKERS} threads | marker at m | sets/s | median ms | 99 % ms | found |"
    )
    print("|---|---|---|---|---|---|")
    for distance_m in DISTANCES_M:
        views = Views(distance_m)
        for tracked in (True, False):
            times_s, found = [], 0
            with ThreadPoolExecutor(WORKERS) as pool:
                for number in range(FIRST_SETS + SETS):
                    begin_s = time.perf_counter()
                    count = views.look(pool, number, tracked)
                    if number >= FIRST_SETS:
                        times_s.append(time.perf_counter() - begin_s)
                        found += count
            median, late = np.quantile(times_s, [0.5, 0.99]) * 1e3
            how = "tracked" if tracked else "searching"
            print(f"| {how} | {distance_m:.0f} | {SETS / sum(times_s):.0f} | {median:.1f} "
                  f"| {late:.1f} | {found / SETS:.0%} |")  # fmt: skip


def recorded(made: DriveSetup, delay_s: float) -> list[Input]:
    """What the pilot is told in a drive whose frames come so late."""
    world = SimWorld(made.rig, made.markers, made.vehicle, START, BEGIN_NS)
    rates = Rates(frame_delay_s=delay_s)
    return [step.input for step in drive(made.pilot(step_folder()), world, DRIVE_S, rates=rates)]


def handled_s(made: DriveSetup, inputs: list[Input]) -> dict[str, list[float]]:
    """How long the pilot takes, by kind, once it knows where it is."""
    pilot = made.pilot(step_folder())
    times_s: dict[str, list[float]] = {"odometry": [], "frames": []}
    for given in inputs:
        begin_s = time.perf_counter()
        pilot.handle(given)
        end_s = time.perf_counter()
        if given.now_ns - BEGIN_NS > SETTLING_S * 1e9:
            times_s["frames" if given.frames else "odometry"].append(end_s - begin_s)
    return times_s


@pytest.mark.parametrize("delay_s", DELAYS_S)
def test_handle(benchmark: Any, delay_s: float) -> None:
    """A whole drive of 6 s."""
    made = setup()
    inputs = recorded(made, delay_s)
    assert all(handled_s(made, inputs).values())
    benchmark(handled_s, made, inputs)


def print_handling() -> None:
    """The estimator's part of a cycle: fused, judged, commanded."""
    made = setup()
    times_s: dict[str, list[float]] = {}
    for delay_s in DELAYS_S:
        inputs = recorded(made, delay_s)
        when = f"{delay_s * 1e3:.0f} ms late" if delay_s else "in order"
        for _ in range(3):
            taken_s = handled_s(made, inputs)
            times_s.setdefault("odometry", []).extend(taken_s["odometry"])
            times_s.setdefault(f"a frame {when}", []).extend(taken_s["frames"])
    print("\n| `pilot.handle`, float32 | median ms | 99 % ms | calls |\n|---|---|---|---|")
    for name, taken in times_s.items():
        median, late = np.quantile(taken, [0.5, 0.99]) * 1e3
        print(f"| {name} | {median:.2f} | {late:.2f} | {len(taken)} |")


def started_s(folder: Path) -> tuple[float, float]:
    """From the start of a process until its first command, and until it is OK."""
    path = folder / "drive.mcap"
    begin_ns = time.monotonic_ns()
    subprocess.run(
        [sys.executable, "-c", MAIN, "run", "--car", "sim", "--headless", "--record", path,
         "--duration-s", "3", "--timeout-s", "3"],
        env=os.environ | {"XDG_CACHE_HOME": str(folder)},
        capture_output=True,
        check=True,
    )  # fmt: skip
    outcomes = read_drive(path).outcomes
    fine_ns = outcomes.now_ns[outcomes.health == Health.OK]
    until_ns = (outcomes.now_ns[0], fine_ns[0] if len(fine_ns) else np.inf)
    first_s, fine_s = ((end_ns - begin_ns) / 1e9 for end_ns in until_ns)
    return float(first_s), float(fine_s)


def median_s(act: Callable[[], object], count: int) -> float:
    """Of so many."""
    times_s = []
    for _ in range(count):
        begin_s = time.perf_counter()
        act()
        times_s.append(time.perf_counter() - begin_s)
    return float(np.median(times_s))


def print_starts() -> None:
    """Processes, from nothing."""
    print("\n| a process | first command s | health OK s |\n|---|---|---|")
    with tempfile.TemporaryDirectory() as name:
        rows = {"cold": [started_s(Path(name))]}
        rows["warm"] = [started_s(Path(name)) for _ in range(STARTS)]
    for kind, starts in rows.items():
        first_s, fine_s = np.median(starts, axis=0)
        print(f"| `jaxnav run --car sim`, {kind} | {first_s:.2f} | {fine_s:.2f} |")
    command = [sys.executable, "-c", MAIN, "--help"]
    taken_s = median_s(lambda: subprocess.run(command, capture_output=True, check=True), HELPS)
    print(f"\n`jaxnav --help`: {taken_s:.2f} s, median of {HELPS}")


def main() -> None:
    """Print the tables."""
    cv2.setNumThreads(1)
    print(f"jax {jax.__version__}, OpenCV {cv2.__version__}, NumPy {np.__version__}, "
          f"{os.cpu_count()} cores, load {os.getloadavg()[0]:.1f}\n")  # fmt: skip
    print_frame_sets()
    print_handling()
    print_starts()


if __name__ == "__main__":
    main()
