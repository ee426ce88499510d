"""Compare detectors on real photographs: what each finds, what it misses and what it makes up.

    python benchmarks/bench_photographs.py FAMILY=FOLDER ... --out DIR

Of each photograph the markers of all detectors are laid over each other: one marker is the same id
at the same place. Nobody says what is there: what only one detector sees is drawn into --out, for
the eye to judge. Prints a table.
"""

import argparse
import sys
from pathlib import Path

import cv2
import numpy as np

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))
sys.path.insert(0, str(Path(__file__).resolve().parent))

from bench_detection import Find, apriltag, opencv, ours, row

from jaxnav.calibrate.board.images import source_files
from jaxnav.commands.drive.locate import detect, detectors_for
from jaxnav.files.images import read_image

APRILTAG = ("tag16h5", "tag25h9", "tag36h11")


def locate(family: str) -> Find:
    """What `jaxnav locate` does: both, and a closer look at every quadrilateral."""
    detectors = detectors_for("aruco", family)

    def find(image: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        found = detect(detectors, image)
        return found.ids, found.corners_px

    return find


def finders(family: str) -> dict[str, Find]:
    """Those that can read the family."""
    found = {
        "OpenCV": opencv(cv2.aruco.CORNER_REFINE_NONE, family),
        "OpenCV, AprilTag's quads": opencv(cv2.aruco.CORNER_REFINE_APRILTAG, family),
        "ours, aruco": ours("aruco", family),
        "jaxnav locate": locate(family),
    }
    if family in APRILTAG:
        found["pyapriltags"] = apriltag(family)
        found["ours, apriltag"] = ours("apriltag", family)
    return found


class Marker:
    """One marker of a photograph: its id, corners (4, 2) and who found it, how often."""

    def __init__(self, marker_id: int, corners_px: np.ndarray):
        self.marker_id, self.corners_px = marker_id, corners_px
        self.by: dict[str, int] = {}

    def is_at(self, corners_px: np.ndarray) -> bool:
        """True where the centres are less than a third of the smaller side apart."""
        away = np.linalg.norm(corners_px.mean(axis=0) - self.corners_px.mean(axis=0))
        return bool(away < min(side_px(corners_px), side_px(self.corners_px)) / 3)


def side_px(corners_px: np.ndarray) -> float:
    """Mean side of a quadrilateral (4, 2)."""
    sides = np.linalg.norm(corners_px - np.roll(corners_px, 1, axis=0), axis=1)
    return float(np.mean(sides))


def laid_over(image: np.ndarray, found: dict[str, Find]) -> list[Marker]:
    """The markers of all detectors."""
    markers: list[Marker] = []
    for name, find in found.items():
        for marker_id, corners_px in zip(*find(image), strict=True):
            same = [m for m in markers if m.marker_id == marker_id and m.is_at(corners_px)]
            if not same:
                same = [Marker(int(marker_id), corners_px)]
                markers += same
            same[0].by[name] = same[0].by.get(name, 0) + 1
    return markers


def draw(image: np.ndarray, markers: list[Marker], names: list[str], file: Path) -> None:
    """Markers that all see are green, others red with who sees them."""
    scale = 1600 / max(image.shape)
    picture = cv2.resize(cv2.cvtColor(image, cv2.COLOR_GRAY2BGR), None, fx=scale, fy=scale)
    for marker in markers:
        everyone = len(marker.by) == len(names)
        colour = (0, 200, 0) if everyone else (0, 0, 255)
        corners = np.int32(np.round((marker.corners_px + 0.5) * scale))
        cv2.polylines(picture, [corners], True, colour, 1)
        who = "" if everyone else "".join(str(names.index(name)) for name in marker.by)
        place = tuple(corners.min(axis=0).tolist())
        cv2.putText(picture, f"{marker.marker_id} {who}", place, 0, 0.5, colour, 1)
    cv2.imwrite(str(file), picture)


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("sources", nargs="+", help="FAMILY=FOLDER")
    parser.add_argument("--out", type=Path, help="folder for pictures of what was found")
    arguments = parser.parse_args()
    for source in arguments.sources:
        family, _, folder = source.partition("=")
        found = finders(family)
        names, every = list(found), []
        for file in source_files([Path(folder)]):
            image = read_image(file, cv2.IMREAD_GRAYSCALE)
            markers = laid_over(image, found)
            every += [(file.name, marker) for marker in markers]
            if arguments.out:
                arguments.out.mkdir(parents=True, exist_ok=True)
                draw(image, markers, names, arguments.out / f"{family}-{file.stem}.png")
        print(f"\n{family}, {len(source_files([Path(folder)]))} photographs\n")
        print(row("", "found", "of all", "alone", "twice"))
        print(row(*["---"] * 5))
        for name in names:
            by = [marker.by for _, marker in every if name in marker.by]
            twice = sum(count[name] > 1 for count in by)
            print(row(name, len(by), len(every), sum(len(b) == 1 for b in by), twice))
        for file_name, marker in every:
            if len(marker.by) < len(names):
                center = marker.corners_px.mean(axis=0).round().astype(int).tolist()
                print(f"{file_name} {marker.marker_id} at {center},"
                      f" {side_px(marker.corners_px):.0f} px: {', '.join(marker.by)}")  # fmt: skip


if __name__ == "__main__":
    main()
