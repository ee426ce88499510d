"""What every `jaxnav calibrate` command leaves behind: report.json, report.png, a few lines."""

from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.figure import Figure

import jaxnav
from jaxnav.commands.report import write_report
from jaxnav.errors import visible
from jaxnav.files.provenance import Calibrated, calibrated_now


def provenance(command: str, data: Sequence[Path | np.ndarray]) -> Calibrated:
    """What the written files state: date, tool, and a digest of the data."""
    return calibrated_now(f"jaxnav {jaxnav.__version__} calibrate {command}", data)


def publish(
    folder: Path, report: dict[str, Any], figure: Figure, lines: Iterable[str], files: Iterable[str]
) -> None:
    """Write the report and its figure, and print what they say.

    Args:
        files: that were written into the folder before.

    Raises:
        BadInput: a file can't be written.
    """
    where = f"{', '.join([*files, 'report.json', 'report.png'])} in {folder}"
    shown = [visible(line) for line in (*lines, where)]
    write_report(folder, report, shown, name="report.json", report=figure)
