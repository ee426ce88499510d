"""Markers that no decoder reads: blurred, half in shadow, hidden by 30 %. One thread.

OMP_NUM_THREADS=1 python benchmarks/bench_blur.py --other DIR   # rewrites README-blur.md
python benchmarks/other_renderer.py --out DIR --count 60        # makes DIR

Every method sees the same pictures. "No prediction" searches for the marker and two others by
`Acquirer`. Those with a prediction get the true corners, shifted by up to
3 px (5 px for markers above 17 px) along each axis, and off by 0.5 px each.
"""

import argparse
import math
import sys
import time
from collections.abc import Callable, Iterable
from dataclasses import replace
from pathlib import Path
from typing import NamedTuple

import cv2
import numpy as np

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

import jaxnav
from benchmarks.bench_detection import DATA, apriltag, opencv, row
from jaxnav.core.models.camera import Camera
from jaxnav.detection import Acquirer, make_detector, marker_cells
from jaxnav.detection.track import Target, Track, track
from jaxnav.files.images import read_image
from tests.helpers import marker_images
from tests.helpers.marker_images import Scene, rotation
from tests.helpers.other_pictures import other_pictures

FAMILY = "tag36h11"
TABLE = Path(__file__).with_name("README-blur.md")
KINDS = {
    "blur4": "14-17 px, blur 4 px",
    "blur8": "20-40 px, blur 8 px",
    "shadow": "20-40 px, half in shadow",
    "hidden": "20-40 px, 30 % hidden",
    "clean": "20-40 px, sharp",
    "full": "20-40 px, blur 8 px, twice the light",
}
FOUND_PX = 3.0  # the largest error of a corner's coordinate that still counts as found


class Picture(NamedTuple):
    """A picture, its camera, and the truth of its marker."""

    image: np.ndarray
    camera: Camera | None
    marker_id: int
    corners_px: np.ndarray
    streak_px: np.ndarray


def drawn(kind: str, count: int) -> Iterable[Picture]:
    """Pictures by this repository's test scenes: 16 x 16 rays a pixel, a patterned wall."""
    marker_images.SUBPIXELS = 16
    for seed in range(count):
        rng = np.random.default_rng(seed)
        side_px = rng.uniform(14, 17) if kind == "blur4" else rng.uniform(20, 40)
        blur_px = {"blur4": 4.0, "blur8": 8.0, "full": 8.0}.get(kind, 0.0)
        marker_id = int(rng.integers(587))
        scene = _scene(rng, side_px, blur_px, marker_id)
        if kind == "full":
            twice = {"black": 2 * scene.black, "white": 2 * scene.white}
            scene = replace(scene, **twice, texture=2 * scene.texture)
        corners_px = scene.corners_px()
        image = scene.render(rng)
        if kind in ("shadow", "hidden"):
            image = _disturbed(kind, image, corners_px, side_px, rng)
        yield Picture(image, scene.camera, marker_id, corners_px, np.array(scene.motion_px))


def _scene(rng: np.random.Generator, side_px: float, blur_px: float, marker_id: int) -> Scene:
    direction = rng.uniform(0, 2 * np.pi)
    size = int(1.3 * side_px + blur_px + 26)
    center = (size - 1) / 2 + rng.uniform(-1, 1, 2)
    angles = rng.uniform(0, np.deg2rad(50)), rng.uniform(0, 2 * np.pi), rng.uniform(0, 2 * np.pi)
    return Scene(
        Camera.create((319.0, 319.0), (center[0], center[1])),
        (size, size),
        rotation(*angles),
        np.array([0, 0, 319 / side_px]),
        1.0,
        marker_cells(FAMILY, marker_id),
        black=rng.uniform(20, 60),
        white=rng.uniform(150, 235),
        texture=20.0,
        optics_px=rng.uniform(0.3, 0.6),
        motion_px=(blur_px * np.cos(direction), blur_px * np.sin(direction)),
    )


def _disturbed(
    kind: str, image: np.ndarray, corners_px: np.ndarray, side_px: float, rng: np.random.Generator
) -> np.ndarray:
    """The picture with a shadow across the marker, or with 30 % of it behind a straight edge."""
    angle = rng.uniform(0, 2 * np.pi)
    y, x = np.mgrid[: image.shape[0], : image.shape[1]]
    across = x * np.cos(angle) + y * np.sin(angle)
    if kind == "shadow":
        middle = corners_px.mean(axis=0) + rng.uniform(-0.15, 0.15) * side_px
        edge_px = across - middle @ [np.cos(angle), np.sin(angle)]
        dark = (1 - rng.uniform(0.3, 0.6)) / (1 + np.exp(-4 * edge_px / rng.uniform(0.3, 2)))
        return np.clip(image * (1 - dark) + rng.normal(0, 2, image.shape), 0, 255).astype(np.uint8)
    inside = np.zeros(image.shape, np.uint8)
    cv2.fillConvexPoly(inside, np.round(16 * corners_px).astype(np.int32), 1, shift=4)
    behind = 1 / (1 + np.exp(-4 * (across - np.quantile(across[inside > 0], 0.7))))
    rough = cv2.resize(rng.normal(0, 10, (8, 8)), image.shape[::-1], interpolation=cv2.INTER_CUBIC)
    object_levels = rng.uniform(60, 200) + rough + rng.normal(0, 3, image.shape)
    return np.clip(image * (1 - behind) + behind * object_levels, 0, 255).astype(np.uint8)


def other(kind: str, folder: Path, count: int) -> Iterable[Picture]:
    """Pictures by the other renderer."""
    for image, truth in other_pictures(kind, folder)[:count]:
        assert truth.id is not None
        yield Picture(image, truth.camera, truth.id, truth.corners_px, truth.streak_px)


def predicted(picture: Picture, seed: int) -> Target:
    """Where the marker is expected; its streak is known to half a pixel."""
    rng = np.random.default_rng([seed, 27])
    side_px = np.linalg.norm(picture.corners_px - np.roll(picture.corners_px, 1, 0), axis=1).mean()
    off_px = 3.0 if side_px < 18 else 5.0
    quad_px = picture.corners_px + rng.uniform(-off_px, off_px, 2) + rng.normal(0, 0.5, (4, 2))
    streak_px = picture.streak_px + rng.normal(0, 0.5, 2)
    return Target(
        FAMILY, picture.marker_id, quad_px[None], off_px + 1.5, tuple(map(float, streak_px)), 0.7
    )


def false_fixes(first: int, count: int, acquire: bool) -> tuple[int, int, int]:
    """In how many pictures without the sought marker it is followed, acquired, of how many.

    By turns: another marker of the family, blurred by up to 8 px; a part of a real photograph, of
    rooms with markers of the family and of boards; a wall of rough noise. Every fourth is
    overexposed.
    """
    photographs = [
        (read_image(file, cv2.IMREAD_GRAYSCALE), file.parent.name)
        for pattern in ("apriltag_photos/*.jpg", "boards/*/*.jpg", "boards/*/*.png")
        for file in sorted(DATA.glob(pattern))[::3]
    ]
    shown = {
        index: set(make_detector("aruco", FAMILY).detect(image).ids.tolist())
        for index, (image, folder) in enumerate(photographs)
        if folder == "apriltag_photos"
    }
    marker_images.SUBPIXELS, wrong, ghosts = 4, 0, 0
    for seed in range(first, first + count):
        rng = np.random.default_rng([seed, 270])
        side_px, blur_px, sought = rng.uniform(14, 40), rng.uniform(0, 8), int(rng.integers(587))
        ids = {sought}
        if seed % 3 == 0:
            other_id = int((sought + rng.integers(1, 587)) % 587)
            scene = _scene(rng, side_px, blur_px, other_id)
            image, quad_px, ids = scene.render(rng), scene.corners_px(), {other_id}
        elif seed % 3 == 1:
            index = int(rng.integers(len(photographs)))
            image, ids = photographs[index][0], shown.get(index, set())
            center = rng.uniform(side_px, np.array(image.shape[::-1]) - side_px)
            quad_px = center + side_px / 2 * np.array([[-1, -1], [1, -1], [1, 1], [-1, 1]])
        else:
            rough = rng.normal(110, rng.uniform(5, 60), (24, 24))
            image = cv2.resize(rough, (96, 96), interpolation=int(rng.integers(3)))
            image = np.clip(image + rng.normal(0, 3, image.shape), 0, 255).astype(np.uint8)
            quad_px = 48 + side_px / 2 * np.array([[-1, -1], [1, -1], [1, 1], [-1, 1]])
        if seed % 3 != 2 and sought in ids:
            continue
        if seed % 4 == 3:
            image = cv2.convertScaleAbs(image, alpha=rng.uniform(1.2, 2.5))
        angle = rng.uniform(0, 2 * np.pi)
        streak_px = (blur_px * math.cos(angle), blur_px * math.sin(angle))
        target = Target(FAMILY, sought, quad_px[None], 8.0, streak_px, 1.0)
        found = track(image, None, [target])[0]
        if found is not None:
            wrong += 1
            print(
                f"  seed {seed}: advantage {found.advantage:.0f}, explained {found.explained:.2f}"
            )
        # A photograph shows the sought marker elsewhere at times: what decoders read is no ghost.
        if acquire and sought not in ids:
            for corners_px in Acquirer([(FAMILY, sought)]).detect(image, None).corners_px:
                ghosts += 1
                print(f"  seed {seed}: acquired {sought} at {corners_px.mean(axis=0)}")
    return wrong, ghosts, count


Find = Callable[[Picture, Target], np.ndarray | Track | None]


def methods() -> dict[str, Find]:
    """What looks for the marker; only its own id counts."""
    today = make_detector("aruco", FAMILY)

    def decoder(find: Callable[[np.ndarray], tuple[np.ndarray, np.ndarray]]) -> Find:
        def run(picture: Picture, target: Target) -> np.ndarray | None:
            ids, corners = find(picture.image)
            mine = np.flatnonzero(np.asarray(ids) == picture.marker_id)
            return corners[mine[0]] if len(mine) else None

        return run

    def reader(picture: Picture, target: Target) -> np.ndarray | None:
        found = today.detect(picture.image, picture.camera, target.quads_px)
        mine = np.flatnonzero(found.ids == picture.marker_id)
        return found.corners_px[mine[0]] if len(mine) else None

    def follow(picture: Picture, target: Target) -> Track | None:
        return track(picture.image, picture.camera, [target])[0]

    def unknown(picture: Picture, target: Target) -> Track | None:
        return follow(picture, replace(target, streak_px=(0.0, 0.0), streak_sigma_px=np.inf))

    def acquire(picture: Picture, target: Target) -> np.ndarray | None:
        others = [(picture.marker_id + step) % 587 for step in (0, 5, 99)]
        found = Acquirer([(FAMILY, i) for i in others]).detect(picture.image, picture.camera)
        mine = np.flatnonzero(found.ids == picture.marker_id)
        return found.corners_px[mine[0]] if len(mine) else None

    return {
        "OpenCV": decoder(opencv(cv2.aruco.CORNER_REFINE_SUBPIX)),
        "pyapriltags": decoder(apriltag()),
        "ours, decoding": reader,
        "no prediction": acquire,
        "ours, followed": follow,
        "motion unknown": unknown,
    }


def measure(pictures: Iterable[Picture]) -> dict[str, str]:
    """Of each method: the part found, the RMS error of a coordinate, and the NEES of a corner."""
    finders, count = methods(), 0
    errors: dict[str, list[np.ndarray]] = {name: [] for name in finders}
    nees: dict[str, list[float]] = {name: [] for name in finders}
    for seed, picture in enumerate(pictures):
        count += 1
        target = predicted(picture, seed)
        for name, find in finders.items():
            found = find(picture, target)
            if found is None:
                continue
            error = (found.corners_px if isinstance(found, Track) else found) - picture.corners_px
            if np.max(np.abs(error)) < FOUND_PX:
                errors[name].append(error)
                if isinstance(found, Track):
                    e = error.ravel()
                    nees[name].append(float(e @ np.linalg.solve(found.covariance_px2, e)) / 4)
    cells = {}
    for name in finders:
        if not errors[name]:
            cells[name] = "0 %"
            continue
        rms = float(np.sqrt(np.mean(np.square(errors[name]))))
        cells[name] = f"{len(errors[name]) / count:.0%} ({rms:.2f})"
        if nees[name]:
            cells[name] += f" {np.mean(nees[name]):.1f}, {np.median(nees[name]) / 0.918:.1f}"
    return cells


def times(count: int) -> list[str]:
    """CPU time of following one marker, ms, medians, a row a kind of picture."""
    rows = []
    for kind, what in KINDS.items():
        pictures = list(drawn(kind, count))
        targets = [predicted(picture, seed) for seed, picture in enumerate(pictures)]
        laps = []
        for picture, target in [*zip(pictures, targets, strict=True)] * 3:
            begin = time.process_time()
            track(picture.image, picture.camera, [target])
            laps.append(1e3 * (time.process_time() - begin))
        rows.append(row(what, f"{np.median(laps[count:]):.1f}"))
    return rows


def write_table(folder: Path | None, count: int) -> None:
    """Measure everything and write the table."""
    names = list(methods())
    head = ["", row("pictures", *names), row(*["---"] * (1 + len(names)))]
    lines = ["<!-- rows by bench_blur.py -->", "", "By the scenes of `tests/helpers`:", *head]
    for kind, what in KINDS.items():
        lines.append(row(what, *measure(drawn(kind, count)).values()))
        print(lines[-1], flush=True)
    if folder is not None:
        lines += ["", "By Mitsuba, `benchmarks/other_renderer.py`:", *head]
        for kind, what in KINDS.items():
            if (folder / kind).exists():
                lines.append(row(what, *measure(other(kind, folder, count)).values()))
                print(lines[-1], flush=True)
    lines += ["", row("followed", "CPU time, ms"), row("---", "---"), *times(15)]
    text = TABLE.read_text()
    turning = text[text.index("<!-- rows by bench_turning.py -->") :]
    before = text[: text.index("<!-- rows by bench_blur.py -->")]
    TABLE.write_text(before + "\n".join(lines) + "\n\n" + turning)


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--other", type=Path, help="pictures by benchmarks/other_renderer.py")
    parser.add_argument("--count", type=int, default=60)
    parser.add_argument("--false", type=int, help="count false fixes in so many pictures instead")
    parser.add_argument("--follow-only", action="store_true", help="acquire nothing in them")
    parser.add_argument("--first", type=int, default=0, help="the first of them")
    given = parser.parse_args()
    cv2.setNumThreads(1)
    jaxnav.configure(threads=1)  # as the commands that drive
    if given.false:
        wrong, ghosts, count = false_fixes(given.first, given.false, not given.follow_only)
        acquired = "" if given.follow_only else f", acquired in {ghosts}"
        print(f"of {count} pictures without it a marker is followed in {wrong}{acquired}")
    else:
        write_table(given.other, given.count)
