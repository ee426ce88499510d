"""Reflectances of the things in `other_scenes`: printed panels, walls and clutter."""

import cv2
import numpy as np

from jaxnav.core.models.markers import FAMILY_SIZES
from jaxnav.detection import marker_cells

FAMILY = "tag36h11"
INK, PAPER = (0.04, 0.09), (0.75, 0.9)  # ranges of reflectance


def printed(pattern: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """Reflectance (n, m) of a pattern (n, m) that is 1 where the paper is white."""
    ink, paper = rng.uniform(*INK), rng.uniform(*PAPER)
    return ink + (paper - ink) * pattern


def marker_paper(family: str, marker_id: int) -> np.ndarray:
    """A marker with one cell of paper around it, (n + 2, n + 2), top row first, 1 white."""
    return np.pad(marker_cells(family, marker_id), 1, constant_values=1.0)


def other_family(rng: np.random.Generator) -> tuple[str, int]:
    """(family, id) of a marker of another family."""
    others = [name for name in FAMILY_SIZES if name != FAMILY and "mip" not in name]
    family = str(rng.choice(others))
    return family, int(rng.integers(FAMILY_SIZES[family]))


def checker(rng: np.random.Generator) -> np.ndarray:
    """Black and white squares on paper, or a black square frame around a random texture."""
    n = int(rng.integers(3, 10))
    if rng.random() < 0.5:
        return np.pad(np.indices((n, n)).sum(axis=0) % 2 * 1.0, 1, constant_values=1.0)
    inside = (rng.random((6, 6)) < rng.uniform(0.1, 0.9)) * 1.0
    return np.pad(np.pad(inside, 1), 1, constant_values=1.0)


def text(rng: np.random.Generator) -> np.ndarray:
    """Lines of printed letters, (400, 400)."""
    page = np.full((400, 400), 255, np.uint8)
    height = int(rng.integers(25, 90))
    letters = list("ABCDEFGHIJKLMNOPQRSTUVWXYZabcdefghijklmnopqrstuvwxyz0123456789     ")
    for line in range(height + 10, 400, int(1.4 * height)):
        words = "".join(rng.choice(letters, 30))
        font = cv2.FONT_HERSHEY_SIMPLEX
        cv2.putText(page, words, (20, line), font, height / 30, 0, max(height // 9, 1))
    return page / 255.0


def wall(rng: np.random.Generator) -> np.ndarray:
    """A wall's reflectance, (256, 256): plaster, bricks, stripes or squares."""
    level, contrast = rng.uniform(0.15, 0.65), rng.uniform(0.02, 0.15)
    grain = sum(
        cv2.resize(rng.standard_normal((k, k)), (256, 256), interpolation=cv2.INTER_CUBIC) / 2**i
        for i, k in enumerate((8, 16, 32, 64, 128))
    )
    row, column = np.indices((256, 256))
    kind = rng.integers(4)
    figure = np.zeros((256, 256))
    if kind == 1:
        shifted = column + 32 * (row // 32 % 2)
        figure = -1.0 * ((row % 32 < 3) | (shifted % 64 < 3))
    elif kind == 2:
        figure = np.sign(np.sin(2 * np.pi * column / rng.integers(12, 60)))
    elif kind == 3:
        figure = 2.0 * ((row // 32 + column // 32) % 2) - 1
    return np.clip(level + contrast * (figure + 0.4 * grain), 0.02, 0.9)


def coat(rng: np.random.Generator) -> np.ndarray:
    """Reflectance of one thing of the clutter, (1, 1) plain or (8, 8) squares."""
    if rng.random() < 0.5:
        return np.full((1, 1), rng.uniform(0.03, 0.8))
    return np.asarray(rng.uniform(0.03, 0.8, (8, 8)))
