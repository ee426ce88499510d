"""The first hour with a phone: print two sheets, photograph them, calibrate, find the marker.

    python benchmarks/bench_first_hour.py --out DIR         # needs pdftoppm, of poppler-utils

Photographs are those of `phone_pictures`, 4000 x 3000 px. Every command is a process of its own, as
a person starts it; printed are its last lines, its time, and how far its result is from the truth.
"""

import argparse
import json
import os
import resource
import subprocess
import sys
import time
from pathlib import Path

import cv2
import numpy as np
import yaml
from phone_pictures import CENTER_PX, FOCAL_PX, LENS, Shot, photograph, printed, toward
from scipy.spatial.transform import Rotation

# Of the marker's sheet: tilt, about, roll in degrees; its place in the camera, m.
MARKER_SHOTS = (
    ((35, 100, 92), (0.10, -0.05, 1.02)),
    ((28, 200, 88), (-0.32, 0.11, 1.63)),
    ((40, 280, 2), (0.45, -0.2, 2.5)),
)


def board_shots(count: int = 20) -> list[Shot]:
    """Hand-held views of the board: tilted to all sides, near, and into the image's corners."""
    rng = np.random.default_rng(24)
    shots = []
    for k in range(count):
        tilt = 8.0 if k % 7 == 0 else rng.uniform(22, 45)
        turn = toward(tilt, 137.5 * k, (90 if k % 3 else 0) + rng.uniform(-12, 12))
        z_m = rng.uniform(0.28, 0.48)
        to = np.array([(0, 0), (-1, -1), (1, 1), (1, -1), (-1, 1)][k % 5])
        x_m, y_m = to * (0.16, 0.12) * z_m + rng.normal(0, 0.01, 2)
        shots.append(
            Shot(
                turn,
                np.array([x_m, y_m, z_m]),
                sag_m=0.0008 if k in (4, 11, 15) else 0.0,
                blur_px=4.0 if k == 8 else 0.0,
                streak_px=14.0 if k == 13 else 0.0,
                level=rng.uniform(0.55, 0.9),
            )
        )
    return shots


def jaxnav(*words: str) -> str:
    """Run a command as a person does; what it printed. Its time goes to the terminal."""
    before, start = resource.getrusage(resource.RUSAGE_CHILDREN), time.monotonic()
    done = subprocess.run(
        [sys.executable, "-c", "import sys; from jaxnav.cli import main; sys.exit(main())", *words],
        capture_output=True,
        text=True,
        env=os.environ | {"PYTHONPATH": str(Path(__file__).resolve().parents[1])},
    )
    after = resource.getrusage(resource.RUSAGE_CHILDREN)
    cpu_s = after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime
    print(f"$ jaxnav {' '.join(words)}\n{done.stdout}{done.stderr}", end="")
    print(
        f"({time.monotonic() - start:.0f} s, {cpu_s:.0f} s of processor, exit {done.returncode})\n"
    )
    return done.stdout


def photographs(out: Path) -> None:
    """Print both sheets and photograph them, where that has not been done."""
    if not (out / "board/board.pdf").exists():
        jaxnav("calibrate", "board", "charuco", "--landscape", "--out", f"{out}/board")
        jaxnav("calibrate", "board", "marker", "--first-id", "3", "--out", f"{out}/marker-3")
    (out / "shots").mkdir(exist_ok=True)
    board, marker = printed(out / "board/board.pdf"), printed(out / "marker-3/board.pdf")
    for k, shot in enumerate(board_shots()):
        file = out / f"shots/IMG_{1001 + k}.jpg"
        if not file.exists():
            photograph(board, shot, file, k)
    for k, (turn, place_m) in enumerate(MARKER_SHOTS):
        file = out / f"IMG_{2001 + k}.jpg"
        if not file.exists():
            photograph(marker, Shot(toward(*turn), np.array(place_m)), file, 100 + k)


def center_of_marker(out: Path) -> np.ndarray:
    """Where on its sheet the marker's centre is, from the sheet's, x right, y down, (3,) m."""
    page, size_m = printed(out / "marker-3/board.pdf")
    count, _, boxes, _ = cv2.connectedComponentsWithStats(np.uint8(page < 0.5))
    left, top, width, height, _ = boxes[1 + np.argmax(boxes[1:count, cv2.CC_STAT_AREA])]
    middle = (np.array([left + width / 2, top + height / 2]) / page.shape[::-1] - 0.5) * size_m
    return np.append(middle, 0)


def main() -> None:
    """Walk through the hour."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--out", type=Path, required=True)
    out = parser.parse_args().out
    out.mkdir(parents=True, exist_ok=True)
    photographs(out)
    jaxnav("calibrate", "intrinsics", f"{out}/shots", "--board", f"{out}/board/board.yaml",
           "--out", f"{out}/phone", "--headless")  # fmt: skip
    camera = yaml.safe_load((out / "phone/camera.yaml").read_text())
    print(json.dumps(camera, default=str)[:1500])
    print("true:", FOCAL_PX, CENTER_PX, LENS, "\n")
    offset = center_of_marker(out)
    flip = np.diag([1.0, -1, -1])  # the marker's axes are x right, y up, z to its reader
    for k, (turn, place_m) in enumerate(MARKER_SHOTS):
        said = jaxnav("locate", f"{out}/IMG_{2001 + k}.jpg", "--camera", f"{out}/phone/camera.yaml",
                      "--marker-size-m", "0.15", "--as-json")  # fmt: skip
        for marker in json.loads(said)["markers"]:
            T = np.array(marker["poses"][0]["T_camera_marker"])
            apart_m = T[:3, 3] - (np.array(place_m) + toward(*turn) @ offset)
            turned = Rotation.from_matrix(T[:3, :3].T @ toward(*turn) @ flip).magnitude()
            print(f"marker {marker['id']}: off by {1e3 * apart_m.round(6)} mm,"
                  f" {np.rad2deg(turned):.3f} degrees")  # fmt: skip


if __name__ == "__main__":
    main()
