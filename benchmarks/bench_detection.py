"""Compare detectors: precision, smallest readable markers and speed. One thread.

OMP_NUM_THREADS=1 python benchmarks/bench_detection.py          # rewrites README-detection.md
OMP_NUM_THREADS=1 pytest benchmarks/bench_detection.py --benchmark-only
"""

import os
import sys
import time
from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np
import pyapriltags
import pytest

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

from jaxnav.core.models.camera import Camera
from jaxnav.detection import make_detector, marker_cells
from jaxnav.detection.families import dictionary
from jaxnav.files.images import read_image
from tests.helpers.marker_images import Scene, random_scene, rotation

FAMILY = "tag36h11"
TABLE = Path(__file__).with_name("README-detection.md")
DATA = Path(os.environ.get("JAXNAV_DATA", Path(__file__).parents[2] / "shared/data"))
Find = Callable[[np.ndarray], tuple[np.ndarray, np.ndarray]]  # image -> ids, corners_px


def opencv(refinement: int, family: str = FAMILY) -> Find:
    parameters = cv2.aruco.DetectorParameters()
    parameters.cornerRefinementMethod = refinement
    decoder = cv2.aruco.ArucoDetector(dictionary(family), parameters)

    def find(image: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        quads, ids, _ = decoder.detectMarkers(image)
        return np.ravel([] if ids is None else ids), np.reshape(quads, (-1, 4, 2))

    return find


def apriltag(family: str = FAMILY) -> Find:
    decoder = pyapriltags.Detector(families=family, nthreads=1, quad_decimate=1.0)

    def find(image: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        tags = decoder.detect(image)
        corners_px = [tag.corners[[1, 0, 3, 2]] - 0.5 for tag in tags]
        return np.array([tag.tag_id for tag in tags], int), np.reshape(corners_px, (-1, 4, 2))

    return find


def ours(backend: str, family: str = FAMILY) -> Find:
    detector = make_detector(backend, family)

    def find(image: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        detections = detector.detect(image)
        return detections.ids, detections.corners_px

    return find


def finders() -> dict[str, Find]:
    return {
        "OpenCV": opencv(cv2.aruco.CORNER_REFINE_NONE),
        "OpenCV SUBPIX": opencv(cv2.aruco.CORNER_REFINE_SUBPIX),
        "pyapriltags": apriltag(),
        "ours, aruco": ours("aruco"),
        "ours, apriltag": ours("apriltag"),
    }


def precision_scene(rng: np.random.Generator, side_px: float) -> Scene:
    cells = marker_cells(FAMILY, int(rng.integers(587)))
    return random_scene(rng, side_px, cells, optics_px=0.4)


def small_scene(rng: np.random.Generator, side_px: float, blur_px: float) -> Scene:
    """Upright, 39 degrees off its normal, before a patterned wall; blur in a random direction."""
    direction = rng.uniform(0, 2 * np.pi)
    depth_m = 319 / side_px
    return Scene(
        Camera.create((319.0, 319.0), (79.5, 59.5)),
        (160, 120),
        rotation(np.deg2rad(39), rng.choice([-1, 1]) * np.pi / 2, rng.uniform(-0.1, 0.1)),
        np.append(rng.uniform(-15, 15, 2) * depth_m / 319, depth_m),
        1.0,
        marker_cells(FAMILY, int(rng.integers(587))),
        black=rng.uniform(20, 60),
        white=rng.uniform(150, 250),
        texture=20.0,
        optics_px=0.3,
        motion_px=(blur_px * np.cos(direction), blur_px * np.sin(direction)),
    )


def measure(
    draw: Callable[[np.random.Generator], Scene], count: int
) -> dict[str, tuple[float, float]]:
    """Of each finder: the part found, and the RMS error of a coordinate, px."""
    errors: dict[str, list[np.ndarray]] = {name: [] for name in FINDERS}
    for seed in range(count):
        rng = np.random.default_rng(seed)
        scene = draw(rng)
        image, truth_px = scene.render(rng), scene.corners_px()
        for name, find in FINDERS.items():
            _, corners_px = find(image)
            away = [np.max(np.abs(corners - truth_px)) for corners in corners_px]
            if away and min(away) < 3:
                errors[name].append(corners_px[int(np.argmin(away))] - truth_px)
    return {
        name: (len(e) / count, float(np.sqrt(np.mean(np.square(e)))) if e else np.nan)
        for name, e in errors.items()
    }


def coded(image: np.ndarray) -> np.ndarray:
    """Grey levels that are proportional to light, as sRGB codes them."""
    light = image / 255
    code = np.where(light <= 0.0031308, 12.92 * light, 1.055 * light ** (1 / 2.4) - 0.055)
    return np.round(255 * code).astype(np.uint8)


def pictures(count: int) -> dict[str, tuple[str, list[np.ndarray]]]:
    """Family and grey pictures by kind: rendered ones, and real ones where there are any."""

    def drawn(draw: Callable[[np.random.Generator], Scene]) -> list[np.ndarray]:
        seeds = map(np.random.default_rng, range(count))
        return [draw(rng).render(rng) for rng in seeds]

    sharp = [drawn(lambda rng, s=side_px: precision_scene(rng, s)) for side_px in (140, 42, 20)]
    kinds = {f"rendered, {s} px": (FAMILY, p) for s, p in zip((140, 42, 20), sharp, strict=True)}
    kinds["rendered, 42 px, sRGB"] = (FAMILY, [coded(image) for image in sharp[1]])
    for blur_px in (2, 4):
        blurred = drawn(lambda rng, b=blur_px: small_scene(rng, 28, b))
        kinds[f"rendered, 28 px, {blur_px} px blur"] = (FAMILY, blurred)
    for name, family in (("apriltag_photos", FAMILY), ("boards/charuco-lifecam-480", "4x4_1000")):
        files = sorted((DATA / name).glob("*.jpg"))
        if files:
            images = [read_image(file, cv2.IMREAD_GRAYSCALE) for file in files]
            kinds[f"real: {name}"] = (family, images)
    return kinds


def fits_given_up(count: int) -> list[str]:
    """A row a kind of picture: its markers, and those that keep the decoder's corners."""
    rows = []
    for kind, (family, images) in pictures(count).items():
        detector = make_detector("aruco", family)
        given_up = [~detector.detect(image).refined for image in images]
        in_pictures = sum(bool(np.any(markers)) for markers in given_up)
        markers = np.concatenate(given_up)
        rows.append(row(kind, len(images), len(markers), np.sum(markers), in_pictures))
    return rows


def row(*cells: object) -> str:
    return "| " + " | ".join(str(cell) for cell in cells) + " |"


def frame() -> np.ndarray:
    """820 x 410 px: a patterned wall with the paper's marker at about 1.5 m."""
    rng = np.random.default_rng(0)
    wall = cv2.resize(rng.normal(110, 20, (137, 274)), (820, 410), interpolation=cv2.INTER_LINEAR)
    image = np.clip(wall + rng.normal(0, 3, wall.shape), 0, 255).astype(np.uint8)
    marker = random_scene(rng, 36, marker_cells(FAMILY, 0), optics_px=0.4).render(rng)
    image[150 : 150 + marker.shape[0], 400 : 400 + marker.shape[1]] = marker
    return image


def write_table(count: int = 40) -> None:
    lines = [
        "# Detectors compared",
        "",
        f"`python benchmarks/bench_detection.py`: {FAMILY}, noise of 3 grey levels,",
        f"{count} pictures a row, one thread.",
        "",
        "RMS error of a corner's coordinate in px (part found), views up to 60 degrees, any roll:",
        "",
        row("side, px", *FINDERS),
        row(*["---"] * (len(FINDERS) + 1)),
    ]
    for side_px in (140, 70, 42, 28, 20):
        results = measure(lambda rng, s=side_px: precision_scene(rng, s), count)
        lines.append(row(side_px, *(f"{e:.3f} ({p:.0%})" for p, e in results.values())))
    lines += [
        "",
        "Found from cold, small and blurred, 39 degrees off the normal (RMS error, px):",
        "",
        row("side, px", "motion blur, px", *FINDERS),
        row(*["---"] * (len(FINDERS) + 2)),
    ]
    for side_px in (14, 17, 20, 28):
        for blur_px in (0, 2, 4):
            results = measure(lambda rng, s=side_px, b=blur_px: small_scene(rng, s, b), count)
            cells = (f"{p:.0%} ({e:.2f})" if p else "0 %" for p, e in results.values())
            lines.append(row(side_px, blur_px, *cells))
    lines += [
        "",
        "Fits of the pattern that are given up (ours, aruco): such a marker keeps the decoder's",
        "corners and their sigma.",
        "",
        row("pictures", "how many", "markers", "given up", "in pictures"),
        row(*["---"] * 5),
        *fits_given_up(count),
    ]
    image = frame()
    lines += ["", "Time for a frame of 820 x 410 px with one marker, ms (least of 30):", ""]
    lines += [row(*FINDERS), row(*["---"] * len(FINDERS))]
    times_ms = []
    for find in FINDERS.values():
        find(image)
        laps = []
        for _ in range(30):
            start = time.perf_counter()
            find(image)
            laps.append(time.perf_counter() - start)
        times_ms.append(f"{min(laps) * 1e3:.1f}")
    lines.append(row(*times_ms))
    TABLE.write_text("\n".join(lines) + "\n")


cv2.setNumThreads(1)
FINDERS = finders()


@pytest.mark.parametrize("name", FINDERS)
def test_frame(benchmark, name):
    image = frame()
    ids, _ = benchmark(FINDERS[name], image)
    assert len(ids) == 1


if __name__ == "__main__":
    write_table()
