"""Loading of studies by their config files and of their stores, for `study` and `plot`."""

import hashlib
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import jax
import xarray as xr

from jaxnav.errors import BadInput
from jaxnav.experiments.studies.ambiguity import AmbiguityStudy
from jaxnav.experiments.studies.drives import DriveStudy
from jaxnav.experiments.studies.store import StudyStore, reading
from jaxnav.experiments.studies.study import Config, Study
from jaxnav.experiments.studies.summary import summarise
from jaxnav.files import calib_dir, load_markers, load_rig, load_vehicle
from jaxnav.files.reading import read_mapping

KINDS: dict[str, type[Study]] = {"ambiguity": AmbiguityStudy, "drive": DriveStudy}
SHIPPED = Path(__file__).resolve().parents[2] / "experiments" / "studies" / "configs"


def shipped_configs(kind: str) -> dict[str, Path]:
    """Paths of the configs of a kind that come with jaxnav, by name."""
    return {path.stem: path for path in sorted((SHIPPED / kind).glob("*.yaml"))}


def load_study(kind: str, path: Path) -> Study:
    """Load the study that a config file describes.

    Args:
        path: the file, or the name of a shipped one.

    Raises:
        BadInput: one line naming file and key.
    """
    if not path.exists():
        path = shipped_configs(kind).get(str(path), path)
    data = read_mapping(path)
    calibration = _calibration(data, path, kind)
    files = {name: _digest(file) for name, file in calibration.items()}
    config = Config.parse(KINDS[kind].schema, data, path, files)
    with jax.enable_x64(True):  # as exact as the files are; a study rounds to its own precision
        rig = load_rig(calibration["rig"]) if "rig" in calibration else None
        markers = load_markers(calibration["markers"]) if "markers" in calibration else None
        vehicle = load_vehicle(calibration["vehicle"]) if "vehicle" in calibration else None
    if rig is not None:
        for section, given in (("axes", config.axes), ("fixed", config.fixed)):
            counts = given.get("cameras")
            for count in counts if isinstance(counts, list) else [counts]:
                if isinstance(count, int) and count > len(rig):
                    raise BadInput(
                        f"{path}: {section}.cameras", f"the rig has {len(rig)}, got {count}"
                    )
    if kind == "ambiguity":
        return AmbiguityStudy(config, rig)
    assert rig is not None
    assert markers is not None
    assert vehicle is not None
    return DriveStudy(config, rig, markers, vehicle)


def summary_of(path: Path, bar: Any) -> tuple[str, int, xr.Dataset]:
    """The kind of a store, the number of trials in it, and its summary.

    Args:
        bar: a tqdm that shows how many trials have been read.

    Raises:
        BadInput: the path is not a store of a study.
    """
    store = StudyStore(path)
    # The stored config is checked as if a person had written it.
    kind = store.config.pop("kind", None)
    if not isinstance(kind, str) or kind not in KINDS:
        raise BadInput(f"{path}: config.kind", f"must be {' or '.join(KINDS)}, got {kind!r}")
    data = {key: value for key, value in store.config.items() if key != "files"}
    config = Config.parse(KINDS[kind].schema, data, f"{path}: config")
    trials = store.dataset(config)
    bar.reset(total=store.layout.trials)
    with reading(path):  # box by box, while it is summed up
        summary = summarise(trials, config, store.layout, bar.update)
    return kind, store.count_done(), summary


def _calibration(data: Mapping[str, Any], path: Path, kind: str) -> dict[str, Path]:
    """The calibration files of a config, relative to it; `qcar` stands for the shipped ones."""
    wanted = ("rig",) if kind == "ambiguity" else ("rig", "markers", "vehicle")
    files = {}
    for name in ("rig", "markers", "vehicle"):
        given = data.get(name, None if kind == "ambiguity" else "qcar")
        if given is None:
            continue
        if name not in wanted:
            raise BadInput(f"{path}: {name}", f"is not used by a study of kind {kind}")
        if not isinstance(given, str) or not given:
            raise BadInput(f"{path}: {name}", f"must be a file, or qcar, got {given!r}")
        shipped = calib_dir() / "qcar" / f"{name}.yaml"
        files[name] = shipped if given == "qcar" else path.parent / given
        if not _is_file(files[name]):
            raise BadInput(f"{path}: {name}", f"there is no file {files[name]}")
    return files


def _is_file(path: Path) -> bool:
    try:
        return path.is_file()
    except OSError:  # a name that is too long
        return False


def _digest(path: Path) -> str:
    return hashlib.sha256(path.read_bytes()).hexdigest()[:16]
