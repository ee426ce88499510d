"""Robots that share nothing with the QCar, and what a person does with them in a shell.

Whoever tests a command tests it on these too: see CONTRIBUTING.md. Their files lie in a folder with
a blank in its name, none is called what the QCar's is, and no marker has the id 0.
"""

import os
import subprocess
import sys
from dataclasses import dataclass
from pathlib import Path

import jax

from tests.helpers.late import MAIN

ROOT = Path(__file__).resolve().parents[2]

# Far from the QCar's place, two walls that meet, a marker on each. The first robot sees one of
# them at a time, and neither for a moment where it turns.
_CRAWLER = {
    "eye.yaml": """
cameras:
  - name: mast/lookout
    lens: radtan
    focal_px: [884.3, 886.1]
    center_px: [651.2, 347.9]
    distortion: [-0.281, 0.094, 0.0003, -0.0006]
    image_size_px: [1280, 720]
    position_m: [0.08, -0.03, 0.41]
    yaw_deg: 2.0
    elevation_deg: 4.0
""",
    "posters.yaml": """
markers:
  - {id: 3, family: tag25h9, size_m: 0.24,
     corners_world_m: [[13, -9.68, 0.74], [13, -9.92, 0.74], [13, -9.92, 0.5], [13, -9.68, 0.5]]}
  - {id: 4, family: tag25h9, size_m: 0.2,
     corners_world_m: [[11.1, -7.6, 0.7], [11.3, -7.6, 0.7], [11.3, -7.6, 0.5], [11.1, -7.6, 0.5]]}
""",
    "crawler.yaml": """
base: differential
forward_limit_mps: 0.7
turn_limit_radps: 2.0
time_constant_s: 0.12
""",
    "there and round.yaml": """
waypoints_m: [[10.9, -9.9], [11.2, -9]]
waypoint_radius_m: 0.12
start: {x_m: 10, y_m: -10, psi_deg: 4.0}
""",
}
_SLIDER = {
    "cams.yaml": """
cameras:
  - name: bow
    lens: double_sphere
    focal_px: [228.0, 228.6]
    center_px: [322.4, 237.1]
    distortion: [-0.18, 0.59]
    image_size_px: [640, 480]
    position_m: [0.15, 0.02, 0.22]
    yaw_deg: 10.0
    roll_deg: 90.0
  - name: port-side
    lens: equidistant
    focal_px: [301.0, 300.2]
    center_px: [318.3, 243.5]
    distortion: [-0.011, 0.004, -0.002, 0.0004]
    image_size_px: [640, 480]
    position_m: [-0.02, 0.16, 0.25]
    yaw_deg: 85.0
    roll_deg: -30.0
""",
    "codes.yaml": """
markers:
  - {id: 17, family: 5x5_100, size_m: 0.22,
     corners_world_m: [[13, -9.59, 0.45], [13, -9.81, 0.45], [13, -9.81, 0.23], [13, -9.59, 0.23]]}
  - {id: 42, family: 5x5_100, size_m: 0.2,
     corners_world_m: [[10.4, -7.6, 0.4], [10.6, -7.6, 0.4], [10.6, -7.6, 0.2], [10.4, -7.6, 0.2]]}
""",
    "slider.yaml": """
base: omni
forward_limit_mps: 0.6
left_limit_mps: 0.5
turn_limit_radps: 1.8
time_constant_s: 0.1
gyro: {class: tactical}
""",
    "over.yaml": """
waypoints_m: [[10.7, -9.7], [10.8, -9.1]]
waypoint_radius_m: 0.12
start: {x_m: 10, y_m: -9.9, psi_deg: 5.0}
""",
}


@dataclass(frozen=True)
class Stranger:
    """One robot and its files, which every command takes by `flags`."""

    folder: Path
    cameras: tuple[str, ...]
    goal_m: tuple[float, float]
    rig: Path
    markers: Path
    vehicle: Path
    route: Path

    @property
    def family(self) -> str:
        """Of its markers."""
        return "tag25h9" if len(self.cameras) == 1 else "5x5_100"

    def flags(self, *without: str) -> list[str]:
        """Flags with all its files, but for those named."""
        kinds = [kind for kind in ("rig", "markers", "vehicle", "route") if kind not in without]
        return [word for kind in kinds for word in (f"--{kind}", str(getattr(self, kind)))]


def crawler(folder: Path) -> Stranger:
    """A differential base with one camera."""
    return _written(folder / "some crawler", _CRAWLER, ("mast/lookout",), (11.2, -9.0))


def slider(folder: Path) -> Stranger:
    """An omni base with a gyro and two cameras that are rolled about their axes."""
    return _written(folder / "my slider", _SLIDER, ("bow", "port-side"), (10.8, -9.1))


def _written(
    folder: Path, texts: dict[str, str], cameras: tuple[str, ...], goal_m: tuple[float, float]
) -> Stranger:
    folder.mkdir()
    for name, text in texts.items():
        (folder / name).write_text(text)
    return Stranger(folder, cameras, goal_m, *(folder / name for name in texts))


def jaxnav(folder: Path, *arguments: object) -> subprocess.CompletedProcess[str]:
    """What a person gets who runs this in a folder. It keeps what it compiles where tests do."""
    kept = str(jax.config.jax_compilation_cache_dir)
    return subprocess.run(
        [sys.executable, "-c", MAIN, *map(str, arguments)],
        cwd=folder,
        env=os.environ | {"PYTHONPATH": str(ROOT), "JAX_COMPILATION_CACHE_DIR": kept},
        capture_output=True,
        text=True,
        check=False,
        timeout=1800,
    )
