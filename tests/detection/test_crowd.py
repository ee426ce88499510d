"""Pictures that are too much to look at."""

import cv2
import numpy as np
import pytest

from jaxnav.detection import crowd, make_detector
from jaxnav.detection.aruco import _CLOSER_LOOK_PX, _worth_a_look
from jaxnav.detection.crowd import thin_crowd
from jaxnav.detection.families import all_cells
from jaxnav.detection.refine import mean_side_px


def grille(period_px: int, side_px: int, shape: tuple[int, int] = (410, 820)) -> np.ndarray:
    y, x = np.mgrid[: shape[0], : shape[1]]
    dark = (x % period_px < side_px) & (y % period_px < side_px)
    return np.where(dark, 30, 220).astype(np.uint8)


def chessboard(side_px: int) -> np.ndarray:
    y, x = np.mgrid[:410, :820]
    return ((x // side_px + y // side_px) % 2 * 255).astype(np.uint8)


def turned(image: np.ndarray, angle_deg: float) -> np.ndarray:
    about = cv2.getRotationMatrix2D((410, 205), angle_deg, 1)
    return cv2.warpAffine(image, about, (820, 410), borderMode=cv2.BORDER_REFLECT)


def test_a_picture_full_of_squares_is_thinned_out():
    """Half a thousand quadrilaterals and more become some dozen, at most."""
    whole = make_detector("aruco")._decoder(0.0)
    for name, image in {
        "grille": grille(16, 10),
        "mesh": 250 - grille(20, 12),
        "chessboard": chessboard(10),
        "wide chessboard": chessboard(30),
        "turned grille": turned(grille(16, 10), 25.0),
        "turned mesh": turned(250 - grille(20, 12), 40.0),
    }.items():
        left = thin_crowd(image, "tag36h11", 25.0)
        assert left is not image, name
        assert len(whole.detectMarkers(left)[2]) < 400, name


def test_a_marker_in_a_crowd_is_found():
    image = grille(16, 10)
    cells = np.pad(all_cells("tag36h11")[7], 1, constant_values=1)
    marker = np.kron(cells * 190 + 30, np.ones((8, 8))).astype(np.uint8)
    height, width = marker.shape
    image[150 : 150 + height, 300 : 300 + width] = marker
    found = make_detector("aruco").detect(image)
    assert found.ids.tolist() == [7]


def test_a_textured_wall_is_no_crowd_and_costs_no_search(monkeypatch):
    """A carpet, gravel, plaster: spots by the hundred, hardly a square."""
    rng = np.random.default_rng(0)
    for image in (rng.integers(0, 256, (410, 820), np.uint8), grille(160, 100)):
        assert thin_crowd(image, "tag36h11", 25.0) is image
    monkeypatch.setattr(crowd, "_quads", lambda *_: pytest.fail("searched"))
    for grain_px in (2, 3, 4, 6, 8):
        rng = np.random.default_rng(grain_px)
        grains = rng.normal(110, 25, (410 // grain_px + 1, 820 // grain_px + 1))
        wall = cv2.resize(grains, (820, 410), interpolation=cv2.INTER_LINEAR)
        image = np.clip(wall + rng.normal(0, 3, wall.shape), 0, 255).astype(np.uint8)
        assert thin_crowd(image, "tag36h11", 25.0) is image


def test_what_is_worth_a_look_is_what_it_was():
    """Against each with all that were kept before it, as it is defined."""
    rng = np.random.default_rng(0)
    square = np.array([[0.0, 0], [1, 0], [1, 1], [0, 1]])
    centers = rng.uniform(0, 12, (400, 1, 2))
    quads = list(
        centers + square * rng.uniform(5, 200, (400, 1, 1)) * rng.choice([1, 1, 0.05], (400, 1, 1))
    )
    kept: list[np.ndarray] = []
    for quad in quads:
        known = any(np.max(np.abs(quad.mean(axis=0) - q.mean(axis=0))) < 0.5 for q in kept)
        if _CLOSER_LOOK_PX[0] <= mean_side_px(quad) <= _CLOSER_LOOK_PX[1] and not known:
            kept.append(quad)
    assert 20 < len(kept) < 390
    found = _worth_a_look(quads)
    assert len(found) == len(kept)
    assert all(one is other for one, other in zip(found, kept, strict=True))
