"""What `jaxnav calibrate board` can be told."""

import math
import re
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Literal

import tyro

from jaxnav.commands.kinds import Switch, require, require_finite


def _default(hint: str, metavar: str) -> object:
    return tyro.conf.arg(metavar=metavar, help_behavior_hint=f"(default: {hint})")


@dataclass(frozen=True)
class CalibrateBoard:
    """Print a calibration target at true scale, with rulers on it to check the print.

    A charuco board is the best for a single camera: it may be cut off by the image's edge, so its
    points reach the corners. An aprilgrid does the same and is what Kalibr takes.

    Written to --out: board.pdf and board.png, either of which is to be printed at 100 %;
    board.yaml, which `jaxnav calibrate intrinsics --board` takes; report.json.
    """

    target: tyro.conf.Positional[Literal["charuco", "aprilgrid", "chessboard", "marker"]]
    """What is printed."""
    paper: Annotated[str, tyro.conf.arg(metavar="{a4,a3,letter,WxH}")] = "a4"
    """The paper, or its width and height in mm, as in 600x400."""
    landscape: Switch = False
    """The paper's longer side lies."""
    columns: Annotated[int | None, _default("as the target and the paper suggest", "INT")] = None
    """Squares or tags side by side."""
    rows: Annotated[int | None, _default("as the target and the paper suggest", "INT")] = None
    """Squares or tags one above the other."""
    size_mm: Annotated[float | None, _default("the largest round size that fits", "FLOAT")] = None
    """Side of a square, or of the black outline of a tag or marker."""
    marker_mm: Annotated[float | None, _default("a cell of white around it", "FLOAT")] = None
    """Of a charuco board, the side of its markers."""
    spacing: float = 0.3
    """Of an aprilgrid, the gap between tags in sides of a tag: Kalibr's tagSpacing."""
    family: Annotated[str | None, _default("4x4 for charuco, else tag36h11", "NAME")] = None
    """Of the markers: tag36h11, 4x4_50, 6x6_250, ..."""
    first_id: int = 0
    """Of the markers, which are numbered on from there."""
    border_cells: int = 2
    """Of an aprilgrid, how wide the tags' black frame is; Kalibr reads 2."""
    dpi: int = 300
    """Pixels an inch of the PNG."""
    out: Annotated[Path, tyro.conf.arg(metavar="DIR")] = Path("calibrated")
    """Folder for the results."""

    def __post_init__(self) -> None:
        named = self.paper.lower() in ("a4", "a3", "letter")
        known = named or self.paper_size_mm is not None
        require(
            known, "--paper", f"must be a4, a3, letter or WxH in mm (600x400), got {self.paper}"
        )
        if self.paper_size_mm is not None:
            fits = all(50 <= side <= 5000 for side in self.paper_size_mm)
            require(fits, "--paper", f"must be from 50 to 5000 mm a side, got {self.paper}")
        for flag, value in (("--size-mm", self.size_mm), ("--marker-mm", self.marker_mm)):
            if value is not None:
                require_finite(flag, value)
        charuco = self.target == "charuco" or self.marker_mm is None
        require(charuco, "--marker-mm", f"goes with charuco, not with {self.target}")
        alone = self.target != "marker" or (self.columns is None and self.rows is None)
        require(alone, "--columns", "and --rows go with boards, not with a single marker")
        pair = self.marker_mm is None or self.size_mm is not None
        require(pair, "--marker-mm", "needs --size-mm")
        require(math.isfinite(self.spacing), "--spacing", f"must be finite, got {self.spacing}")
        require(50 <= self.dpi <= 2400, "--dpi", f"must be from 50 to 2400, got {self.dpi}")

    @property
    def paper_size_mm(self) -> tuple[float, float] | None:
        """Width and height where they are given in mm."""
        match = re.fullmatch(r"(\d+(?:\.\d+)?)x(\d+(?:\.\d+)?)(?:mm)?", self.paper.lower())
        return (float(match[1]), float(match[2])) if match else None
