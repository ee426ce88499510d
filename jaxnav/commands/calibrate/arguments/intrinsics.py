"""What `jaxnav calibrate intrinsics` can be told."""

import re
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Literal

import tyro

from jaxnav.commands.kinds import OptionalFile, Switch, require

_NAMED = re.compile(r"([A-Za-z_][\w.\-]{0,99})=(.+)")


@dataclass(frozen=True)
class CalibrateIntrinsics:
    """Find a camera's focal length, centre and lens from pictures of a board.

    Show the camera a board of `jaxnav calibrate board`: 20 to 40 pictures or a slow video, tilted
    by 30 to 45 degrees to all sides, near enough to fill much of the image, and up to its corners.
    Blurred and wrong views are found, left out and named. What the pictures don't tell is refused,
    or held at zero and named. The size of the board has no part in this; that its squares are
    square and as many as its file says has.

    Written to --out: camera.yaml, a rig file with the cameras, which `jaxnav calibrate rig` and
    jaxnav locate take; report.json with every parameter's sigma; report.png.
    """

    sources: Annotated[
        tyro.conf.Positional[tuple[str, ...]],
        tyro.conf.arg(metavar="SOURCE", help_behavior_hint="(required)"),
    ]
    """Images, folders of images, videos. Of several cameras at once: front=DIR left=DIR ..."""
    board: Annotated[Path, tyro.conf.arg(metavar="FILE")]
    """The board: board.yaml of `jaxnav calibrate board`, or Kalibr's."""
    lens: Literal["auto", "radtan", "equidistant", "none"] = "auto"
    """The lens model; auto takes whichever explains pictures best that it was not fitted to."""
    name: str = "camera"
    """Of the camera, where the sources don't say it."""
    max_views: int = 100
    """Of more views those are taken that tell most about the lens."""
    rig: OptionalFile = None
    """A rig file that says where the cameras are; its other cameras go along unchanged."""
    out: Annotated[Path, tyro.conf.arg(metavar="DIR")] = Path("calibrated")
    """Folder for the results."""
    headless: Switch = False
    """No progress bar."""

    def __post_init__(self) -> None:
        require(bool(self.sources), "SOURCE", "give images, a folder of images or a video")
        require(self.max_views >= 8, "--max-views", f"must be at least 8, got {self.max_views}")
        require(
            _NAMED.fullmatch(f"{self.name}=x") is not None,
            "--name",
            f"must be a name (a letter first, then letters, digits and _ - .), got {self.name!r}",
        )
        named = [_NAMED.fullmatch(source) is not None for source in self.sources]
        require(
            all(named) or not any(named),
            "SOURCE",
            "give every source as NAME=PATH, or none of them",
        )

    @property
    def by_camera(self) -> dict[str, tuple[Path, ...]]:
        """The sources of every camera, in the order they were given in."""
        found: dict[str, tuple[Path, ...]] = {}
        for source in self.sources:
            match = _NAMED.fullmatch(source)
            name, path = match.groups() if match else (self.name, source)
            found[name] = (*found.get(name, ()), Path(path))
        return found
