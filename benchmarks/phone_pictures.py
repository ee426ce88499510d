"""Photographs of a printed sheet as a phone takes them, by a ray caster of its own.

Nothing of the package is used. A sheet is what a PDF prints; it lies on a desk and may be bent
about its shorter axis. Light is added up in linear units over 3 x 3 rays a pixel, goes through the
lens's blur, a Bayer mosaic with shot noise, white balance, sharpening, sRGB and JPEG, and is stored
as the sensor lies, with the EXIF orientation of a phone that is held upright.
Pixels: the centre of the top-left pixel is (0, 0).
"""

import functools
import subprocess
import tempfile
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
from PIL import Image
from scipy.spatial.transform import Rotation

SIZE_PX = (4000, 3000)
FOCAL_PX, CENTER_PX = (3012.0, 3012.0), (2008.5, 1489.2)
LENS = (0.06, -0.11, 3e-4, -2e-4, 0.05)  # k1 k2 p1 p2 k3, as OpenCV has them
INK, PAPER, DESK = 0.04, 0.82, 0.25  # reflectance
ELECTRONS = 6000.0  # of a white pixel
GAINS = (0.62, 1.0, 0.74)  # red, green, blue of the sensor in the light of a lamp
DPI, RAYS = 600, 3
LENS_BLUR_PX = 0.6


@dataclass(frozen=True)
class Shot:
    """One photograph. The sheet's frame: x right, y down, z away from its reader, metres."""

    turn: np.ndarray  # R_camera_sheet, (3, 3)
    place_m: np.ndarray  # of the sheet's centre in the camera, (3,)
    sag_m: float = 0.0  # how far the middle of the sheet bulges over its ends
    blur_px: float = 0.0  # defocus, standard deviation
    streak_px: float = 0.0  # along the image's x
    zoom: float = 1.0  # of the focal length: a phone that focuses anew
    level: float = 0.8  # white paper in the middle of the image, of full scale


def toward(tilt_deg: float, about_deg: float, roll_deg: float) -> np.ndarray:
    """R_camera_sheet of a sheet tilted about an axis in its plane, then rolled, (3, 3)."""
    about = np.deg2rad(about_deg)
    axis = np.deg2rad(tilt_deg) * np.array([np.cos(about), np.sin(about), 0])
    roll = Rotation.from_rotvec([0, 0, np.deg2rad(roll_deg)])
    return np.asarray((roll * Rotation.from_rotvec(axis)).as_matrix())


def printed(pdf: Path, scale: float = 1.0) -> tuple[np.ndarray, np.ndarray]:
    """A PDF's first page as (grey image (H, W) in 0 to 1, its width and height on paper in m)."""
    with tempfile.TemporaryDirectory() as folder:
        page = ["pdftoppm", "-r", str(DPI), "-gray", "-singlefile", str(pdf), f"{folder}/page"]
        subprocess.run(page, check=True)
        image = cv2.imread(f"{folder}/page.pgm", cv2.IMREAD_GRAYSCALE)
    return np.float32(image) / 255, scale * np.array(image.shape[::-1]) / DPI * 0.0254


@functools.cache
def _rays() -> tuple[np.ndarray, np.ndarray]:
    """Slopes x/z, y/z of the pixels' rays before the zoom, each (H, W), by fixed point."""
    v, u = np.indices(SIZE_PX[::-1], dtype=np.float32)
    xd, yd = (u - CENTER_PX[0]) / FOCAL_PX[0], (v - CENTER_PX[1]) / FOCAL_PX[1]
    k1, k2, p1, p2, k3 = map(np.float32, LENS)
    x, y = xd.copy(), yd.copy()
    for _ in range(12):
        r2 = x * x + y * y
        radial = 1 + r2 * (k1 + r2 * (k2 + r2 * k3))
        dx, dy = 2 * p1 * x * y + p2 * (r2 + 2 * x * x), p1 * (r2 + 2 * y * y) + 2 * p2 * x * y
        x, y = (xd - dx) / radial, (yd - dy) / radial
    return x, y


def light(page: np.ndarray, size_m: np.ndarray, shot: Shot, rng: np.random.Generator) -> np.ndarray:
    """What each pixel takes in, (H, W) float32, 1 is full scale."""
    x0, y0 = _rays()
    slope = [np.gradient(a, axis=axis) for a in (x0, y0) for axis in (1, 0)]
    R, o = np.float32(shot.turn), np.float32(-shot.turn.T @ shot.place_m)
    bend = np.float32(4 * shot.sag_m / size_m[0] ** 2)
    desk = cv2.resize(np.float32(rng.random((40, 60))), SIZE_PX, interpolation=cv2.INTER_CUBIC)
    below = DESK * (0.6 + 0.8 * desk)
    total = np.zeros_like(x0)
    scale = np.float32(1 / size_m * page.shape[::-1])
    for i in range(RAYS * RAYS):
        du, dv = (np.array(divmod(i, RAYS), np.float32) + 0.5) / RAYS - 0.5
        x = (x0 + du * slope[0] + dv * slope[1]) / np.float32(shot.zoom)
        y = (y0 + du * slope[2] + dv * slope[3]) / np.float32(shot.zoom)
        dx, dy, dz = (R[0, k] * x + R[1, k] * y + R[2, k] for k in range(3))
        t = -o[2] / dz
        for _ in range(3 if bend else 0):  # the surface: z = bend * x^2
            at = o[0] + t * dx
            t -= (o[2] + t * dz - bend * at * at) / (dz - 2 * bend * at * dx)
        across = o[0] + t * dx
        along = across * (1 + np.float32(2 / 3) * (bend * across) ** 2)  # on the paper
        u = (along + np.float32(size_m[0] / 2)) * scale[0] - np.float32(0.5)
        v = (o[1] + t * dy + np.float32(size_m[1] / 2)) * scale[1] - np.float32(0.5)
        seen = cv2.remap(
            page, u, v, cv2.INTER_LINEAR, borderMode=cv2.BORDER_CONSTANT, borderValue=-1
        )
        total += np.where(seen < 0, below, INK + (PAPER - INK) * np.maximum(seen, 0))
    r2 = x0 * x0 + y0 * y0
    falls = 1 / (1 + r2) ** 2 * (1 + 0.25 * x0 - 0.15 * y0)  # cos^4, and a lamp to one side
    return np.asarray(total * falls * (shot.level / PAPER / RAYS**2))


def exposed(lit: np.ndarray, shot: Shot, rng: np.random.Generator) -> np.ndarray:
    """The picture, (H, W, 3) uint8 RGB, of what the pixels take in."""
    if shot.streak_px:
        lit = cv2.blur(lit, (round(shot.streak_px), 1))
    lit = cv2.GaussianBlur(lit, (0, 0), float(np.hypot(LENS_BLUR_PX, shot.blur_px)))
    bayer = np.empty_like(lit)  # RGGB
    for row, column, gain in ((0, 0, 0), (0, 1, 1), (1, 0, 1), (1, 1, 2)):
        bayer[row::2, column::2] = GAINS[gain] * lit[row::2, column::2]
    noise = np.sqrt(np.maximum(bayer, 0) / ELECTRONS + 0.001**2)
    bayer = np.clip(bayer + noise * rng.standard_normal(bayer.shape, np.float32), 0, 1)
    colour = cv2.demosaicing(np.uint16(bayer * 60000), cv2.COLOR_BayerRGGB2RGB_EA) / 60000
    colour = np.clip(np.float32(colour) / np.float32(GAINS), 0, 1)
    srgb = np.where(colour < 0.0031308, 12.92 * colour, 1.055 * colour ** (1 / 2.4) - 0.055)
    sharp = srgb + 0.3 * (srgb - cv2.GaussianBlur(srgb, (0, 0), 1.2))
    return np.uint8(np.clip(np.round(255 * sharp), 0, 255))


def photograph(sheet: tuple[np.ndarray, np.ndarray], shot: Shot, file: Path, seed: int) -> None:
    """Write a shot of `printed`'s sheet: JPEG of quality 90, held upright."""
    rng = np.random.default_rng(seed)
    picture = exposed(light(*sheet, shot, rng), shot, rng)
    exif = Image.Exif()
    exif[0x010F], exif[0x0110], exif[0x0112] = "Pear", "Pear 9", 6
    exif[0x0132] = f"2026:11:27 09:{seed % 60:02}:00"
    Image.fromarray(picture).save(file, quality=90, exif=exif)
