"""`jaxnav study`: run a Monte-Carlo study, or go on with one; and the loading of studies by their
config files and of their stores."""

import hashlib
import os
from collections.abc import Mapping
from contextlib import ExitStack
from functools import partial
from pathlib import Path
from typing import Any

import jax
import xarray as xr

from jaxnav.commands.bars import progress_bar, update_after_compiling
from jaxnav.commands.process import configure_jax
from jaxnav.commands.simulate.arguments import RunStudy as Arguments
from jaxnav.errors import EXIT_INTERRUPTED, BadInput, visible
from jaxnav.experiments.studies.ambiguity import AmbiguityStudy
from jaxnav.experiments.studies.drives import DriveStudy
from jaxnav.experiments.studies.running import (
    local_cluster,
    remote_cluster,
    run_here,
    run_on_cluster,
)
from jaxnav.experiments.studies.store import StudyStore, open_store, reading, sweep_unfinished
from jaxnav.experiments.studies.study import Config, Study
from jaxnav.experiments.studies.summary import summarise
from jaxnav.files import calib_dir, load_markers, load_rig, load_vehicle, output_folder
from jaxnav.files.reading import read_mapping
from jaxnav.files.writing import sole_writer

KINDS: dict[str, type[Study]] = {"ambiguity": AmbiguityStudy, "drive": DriveStudy}
SHIPPED = Path(__file__).resolve().parents[2] / "experiments" / "studies" / "configs"
_LOADS: dict[str, Any] = {"rig": load_rig, "markers": load_markers, "vehicle": load_vehicle}


def run(args: Arguments) -> int:
    """Run the trials that are missing in the store, and print how many it holds."""
    if str(args.config) == "list":
        _list(args.kind)
        return 0
    configure_jax(float64=False)
    study = load_study(args.kind, args.config)
    path = args.out or Path("out") / f"{args.config.stem}.zarr"
    output_folder(path.parent)
    with ExitStack() as stack:
        stack.enter_context(sole_writer(path))
        sweep_unfinished(path)
        client = _cluster(args, stack)
        store = open_store(path, study, args.chunk_trials)
        total, done = store.layout.trials, store.count_done()
        if 0 < done < total:
            print(f"{visible(path)} holds {done} of {total} trials: going on", flush=True)
        bar = stack.enter_context(
            progress_bar(
                total=total, initial=done, unit="trial", unit_scale=True, disable=args.headless,
            )
        )  # fmt: skip
        update = update_after_compiling(bar)
        try:
            if client is None:
                run_here(study, store, update)
            else:
                flag = "--workers" if args.scheduler is None else "--scheduler"
                run_on_cluster(study, store, client, flag, update)
        except KeyboardInterrupt:
            bar.close()
            print(
                f"interrupted: {store.count_done()} of {total} trials are in {path}; "
                "the same command goes on"
            )
            return EXIT_INTERRUPTED
    print(f"{total} trials in {visible(path)}; `jaxnav plot {visible(path)}` draws them")
    return 0


def _cluster(args: Arguments, stack: ExitStack) -> Any:
    """A client of the cluster that the arguments ask for; None without one."""
    if args.workers is not None:
        _hand_down_the_cache()
        return stack.enter_context(local_cluster(args.workers))
    if args.scheduler is not None:
        prepare = partial(configure_jax, float64=False)  # JAX in a worker, as in this process
        client = stack.enter_context(remote_cluster(args.scheduler, prepare))
        if "dashboard" in client.scheduler_info()["services"]:
            print(f"dashboard: {client.dashboard_link}", flush=True)
        return client
    return None


def _hand_down_the_cache() -> None:
    """Set JAX's compile cache in the environment, where local worker processes take it from."""
    directory: str | None = getattr(jax.config, "jax_compilation_cache_dir")  # noqa: B009  (mypy knows no such field)
    if directory:
        os.environ.setdefault("JAX_COMPILATION_CACHE_DIR", directory)
        os.environ.setdefault("JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS", "0.2")


def _list(kind: str) -> None:
    """Print the shipped configs and the axes of a kind of study."""
    print(f"configs of kind {kind} that come with jaxnav:")
    for name, path in shipped_configs(kind).items():
        first = path.read_text(encoding="utf-8").splitlines()[0].removeprefix("# ")
        print(f"  {name:24} {first}")
    print(f"\naxes of a study of kind {kind}, and what they are when nothing is said:")
    for name, parameter in KINDS[kind].schema.parameters.items():
        unit = f" ({parameter.unit})" if parameter.unit else ""
        default = "" if parameter.default is None else f" [{parameter.default}]"
        choices = f": {', '.join(parameter.choices)}" if parameter.choices else ""
        words = f", or {' or '.join(parameter.words)}" if parameter.words else ""
        print(f"  {name:24} {parameter.description}{unit}{default}{choices}{words}")


# --- configs and stores --------------------------------------------------------------------


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
    files = {
        name: hashlib.sha256(file.read_bytes()).hexdigest()[:16]
        for name, file in calibration.items()
    }
    config = Config.parse(KINDS[kind].schema, data, path, files)
    with jax.enable_x64(True):  # as exact as the files are; a study rounds to its own precision
        content = {name: _LOADS[name](file) for name, file in calibration.items()}
    rig = content.get("rig")
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
    return DriveStudy(config, **content)


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
    files = {}
    for name in _LOADS:
        given = data.get(name)
        if given is None:
            if kind == "ambiguity":
                continue
            given = "qcar"
        if kind == "ambiguity" and name != "rig":
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
