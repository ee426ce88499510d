"""What `other_renderer` draws: one printed panel on the wall of a room, seen by a moving camera.

The world is the marker's frame: x right, y up, z towards the viewer; metres. Nothing of the package
is used. `other_draws` draws scenes by lot.
"""

from dataclasses import dataclass, field

import numpy as np
from scipy.spatial.transform import Rotation

SIZE_M = 0.1
EXPOSURE_S = 0.01
FOCAL_PX, FULL_PX = 320.0, (640, 480)
CORNERS_M = SIZE_M / 2 * np.array([[-1, 1, 0], [1, 1, 0], [1, -1, 0], [-1, -1, 0.0]])


@dataclass(frozen=True)
class Thing:
    """A box, or a capsule along its own z. `half_m` (3,): a capsule's radius twice, half length."""

    kind: str
    R: np.ndarray  # its axes in the world
    center_m: np.ndarray
    half_m: np.ndarray
    reflectance: np.ndarray

    def hides(self, eye: np.ndarray, points: np.ndarray) -> np.ndarray:
        """Which of the points (N, 3) it hides from the eye (3,), (N,) bool."""
        a = (eye - self.center_m) @ self.R
        b = (points - self.center_m) @ self.R
        if self.kind == "box":
            step = np.where(np.abs(b - a) < 1e-12, 1e-12, b - a)
            low, high = (-self.half_m - a) / step, (self.half_m - a) / step
            first = np.minimum(low, high).max(axis=1)
            last = np.maximum(low, high).min(axis=1)
            return (first <= last) & (last > 0) & (first < 1)
        ball = np.zeros((81, 1, 3))
        ball[:, 0, 2] = np.linspace(-1, 1, 81) * self.half_m[2]
        s = np.clip(np.sum((ball - a) * (b - a), axis=2) / np.sum((b - a) ** 2, axis=1), 0, 1)
        away = np.linalg.norm(a + s[..., None] * (b - a) - ball, axis=2)
        return np.any(away < self.half_m[0], axis=0)


@dataclass(frozen=True)
class Scene:
    """One picture's room, light, camera and its motion."""

    R_camera_world: np.ndarray  # at the middle of the exposure, like t
    t_camera_world: np.ndarray
    angular_rad_s: np.ndarray  # of the camera, about its own axes, like linear_m_s
    linear_m_s: np.ndarray
    crop_px: tuple[int, int, int, int]  # left, top, width, height in the full image
    panel: np.ndarray | None  # reflectance of the paper on the wall, top row first
    panel_m: float  # side of the paper
    wall: np.ndarray
    things: tuple[Thing, ...]
    light_m: np.ndarray  # place of the lamp, a disc that faces the marker
    light_radius_m: float
    lamp_share: float  # of the light on the marker; the rest comes evenly from all sides
    white: float  # signal of white paper that nothing keeps light from, of full scale
    lens_px: float
    response: str  # linear or srgb
    truth: dict = field(default_factory=dict)

    def signal(self) -> float:
        """What a white surface gives, of full scale, where nothing keeps light from it."""
        return self.white / (1.0 if self.panel is None else float(self.panel.max()))

    def pose_at(self, time_s: float) -> tuple[np.ndarray, np.ndarray]:
        """(R_camera_world, t_camera_world), the time counted from the middle of the exposure."""
        # The camera's own motion moves the world the other way.
        R = Rotation.from_rotvec(-self.angular_rad_s * time_s).as_matrix()
        return R @ self.R_camera_world, R @ (self.t_camera_world - self.linear_m_s * time_s)

    def project(self, points: np.ndarray, time_s: float = 0.0) -> np.ndarray:
        """Pixels (N, 2) in the crop; the centre of its top-left pixel is (0, 0)."""
        R, t = self.pose_at(time_s)
        p = points @ R.T + t
        return FOCAL_PX * p[:, :2] / p[:, 2:] + self.center_px()

    def center_px(self) -> np.ndarray:
        """Where the optical axis meets the crop, (2,)."""
        return (np.array(FULL_PX) - 1) / 2 - self.crop_px[:2]

    def eye(self) -> np.ndarray:
        """The camera's place at the middle of the exposure, (3,)."""
        return -self.R_camera_world.T @ self.t_camera_world

    def side_px(self) -> float:
        """Mean length of the marker's sides in the image."""
        corners = self.project(CORNERS_M)
        return float(np.linalg.norm(corners - np.roll(corners, 1, axis=0), axis=1).mean())

    def streaks_px(self) -> np.ndarray:
        """From the exposure's start to its end, of the marker's centre and corners, (5, 2)."""
        points = np.vstack([np.zeros(3), CORNERS_M])
        half = EXPOSURE_S / 2
        return self.project(points, half) - self.project(points, -half)


def on_paper(count: int, side_m: float) -> np.ndarray:
    """A grid of points over a square around the marker's centre, (count**2, 3)."""
    at = (np.arange(count) + 0.5) / count * side_m - side_m / 2
    x, y = np.meshgrid(at, at)
    return np.stack([x.ravel(), y.ravel(), np.zeros(x.size)], axis=1)
