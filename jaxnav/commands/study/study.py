"""`jaxnav study`: run a Monte-Carlo study, or go on with one."""

import os
from contextlib import ExitStack
from pathlib import Path
from typing import Any

import jax

from jaxnav.commands.bars import progress_bar, update_after_compiling
from jaxnav.commands.process import configure_jax
from jaxnav.commands.simulate.arguments import RunStudy as Arguments
from jaxnav.commands.study.studies import KINDS, load_study, shipped_configs
from jaxnav.errors import EXIT_INTERRUPTED, visible
from jaxnav.experiments.studies.running import (
    local_cluster,
    remote_cluster,
    run_here,
    run_on_cluster,
)
from jaxnav.experiments.studies.store import open_store, sweep_unfinished
from jaxnav.files import output_folder
from jaxnav.files.writing import sole_writer


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
        client = stack.enter_context(remote_cluster(args.scheduler, prepare_worker))
        if "dashboard" in client.scheduler_info()["services"]:
            print(f"dashboard: {client.dashboard_link}", flush=True)
        return client
    return None


def prepare_worker() -> None:
    """Configure JAX in a worker of a remote cluster as in this process."""
    configure_jax(float64=False)


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
