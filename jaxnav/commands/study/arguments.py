"""Arguments of the commands that study many views, and draw what was found."""

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import tyro

from jaxnav.commands.kinds import (
    Count,
    Headless,
    ResultsFolder,
    Seed,
    Selector,
    StudyKind,
    optional,
    require,
)


@dataclass(frozen=True)
class RunStudy:
    """Run a Monte-Carlo study: a labelled grid of parameters, many trials in every cell.

    `ambiguity` studies single frames, `drive` closed-loop drives. CONFIG is a YAML file, or the
    name of one that comes with jaxnav (`jaxnav study ambiguity list` lists them, and all that can
    vary). The result is a Zarr store that xarray opens. A study that was interrupted or killed goes
    on when the same command is given again, and ends with the same bits.
    """

    kind: tyro.conf.Positional[StudyKind]
    """What a trial is."""
    config: Annotated[tyro.conf.Positional[Path], tyro.conf.arg(metavar="CONFIG")]
    """YAML file with `trials`, `axes` and what is fixed; or a name; or `list`."""
    out: Annotated[Path | None, optional("STORE", "(default: out/CONFIG.zarr)")] = None
    """Where the result goes, or goes on."""
    workers: Annotated[Count | None, optional("N", "(default: this process)", int)] = None
    """Start so many Dask workers on this machine."""
    scheduler: Annotated[str | None, optional("ADDRESS", constructor=str)] = None
    """Run on the Dask cluster with its scheduler there, e.g. tcp://127.0.0.1:8786."""
    chunk_trials: Annotated[Count | None, optional("N", "(default: 65536, or 256 drives)", int)] = (
        None
    )
    """How many trials are run and written at a time. Changes no result."""
    headless: Headless = False

    def __post_init__(self) -> None:
        own = self.workers is None or self.scheduler is None
        require(own, "--scheduler", "brings its own workers")


@dataclass(frozen=True)
class Plot:
    """Draw a study or a recorded drive.

    Of a study: flip-rate maps, curves with their intervals, reliability diagrams, and summary.json
    with the measures of every cell; if it is not finished, as far as it is. Of a drive (.mcap):
    drive.png, a map with what happened over time, and a summary in the terminal.
    """

    store: Annotated[tyro.conf.Positional[Path], tyro.conf.arg(metavar="STORE")]
    """What `jaxnav study` wrote, or a recorded drive (.mcap)."""
    out: Annotated[Path, tyro.conf.arg(metavar="DIR")] = Path("out")
    """Folder for the pictures."""
    headless: Headless = False


@dataclass(frozen=True)
class StudyReliability:
    """Draw whether flip probabilities mean what they say: when it says 10 %, are 10 % flipped?

    Without RECORDING, on random views of one marker (sides of 10 to 100 px, 0 to 60 degrees, corner
    noise of 0.2 to 2 px), frame by frame. With a RECORDING that has a reference, on its detections,
    every marker by itself. Written to --out: reliability.png and summary.json.
    """

    recording: Annotated[tyro.conf.Positional[Path | None], optional("RECORDING")] = None
    """Folder, ROS 1 bag (.bag, .bag.bz2) or .npz."""
    selector: Selector = "multi-hypothesis"
    """Whose probabilities, on a recording."""
    frames: Count = 165_000
    """How many random views."""
    seed: Seed = 0
    """Of the random views."""
    out: ResultsFolder = Path("out")
    headless: Headless = False
