"""Pictures of markers by other renderers than the package's: Mitsuba's and, by OpenGL, MuJoCo's."""

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import yaml

from jaxnav.core.models.camera import Camera

DATA = Path(__file__).parents[1] / "data/other_renderer"
RASTER = DATA.with_name("other_rasteriser")  # `shadow` alone
SETS = ("blur4", "blur8", "shadow", "hidden", "clean", "negatives")


@dataclass(frozen=True)
class Truth:
    """What is known of one picture. Pixels: the centre of the top-left one is (0, 0).

    Attributes:
        id: of the marker; None in `negatives`, where there is none of this family but what
            `more` says under `shown_family` and `shown_id`.
        corners_px: (4, 2), TL TR BR BL, at the middle of the exposure. In `negatives`, where a
            marker of the same size would have them.
        streak_px: (2,), the way of the marker's centre in the image during the exposure.
        more: all of the picture's entry in truth.yaml.
    """

    family: str
    id: int | None
    size_m: float
    exposure_s: float
    corners_px: np.ndarray
    streak_px: np.ndarray
    camera: Camera
    more: dict[str, Any]


def other_pictures(kind: str, folder: Path = DATA) -> list[tuple[np.ndarray, Truth]]:
    """The pictures of a set, (H, W) uint8, with what is true of each.

    Args:
        kind: one of `SETS`.
        folder: what `benchmarks/other_renderer.py --out` wrote.
    """
    sheet = yaml.safe_load((folder / kind / "truth.yaml").read_text())
    pairs = []
    for more in sheet["pictures"]:
        image = cv2.imread(str(folder / kind / more["image"]), cv2.IMREAD_GRAYSCALE)
        assert image is not None
        truth = Truth(
            sheet["family"],
            more["id"],
            sheet["size_m"],
            sheet["exposure_s"],
            np.array(more["corners_px" if more["id"] is not None else "panel_corners_px"]),
            np.array(more["streak_px"]),
            Camera.create(tuple(more["focal_px"]), tuple(more["center_px"])),
            more,
        )
        pairs.append((image, truth))
    return pairs
