"""Run the unfinished boxes of a study in this process or on a Dask cluster.

This process writes every box, wherever it ran. On a cluster Dask carries tasks and results,
restarts the tasks of a dead worker, and shows its dashboard.
"""

import os
from collections.abc import Callable, Iterator, Mapping
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import contextmanager
from typing import TYPE_CHECKING, Any

import numpy as np
from jaxtyping import Shaped

from jaxnav.errors import BadInput
from jaxnav.experiments.studies.store import Box, StudyStore, versions
from jaxnav.experiments.studies.study import Cell, Progress, Study, nobody

if TYPE_CHECKING:
    from distributed import Client

_IN_FLIGHT = 2  # boxes for each worker, so that no worker waits for its next one
_PATIENCE_S = 30.0  # for a cluster without workers


def run_here(study: Study, store: StudyStore, progress: Progress = nobody) -> None:
    """Run the missing boxes in this process, on all its devices; write each while the next runs.

    Raises:
        BadInput: the store can't be written to.
    """

    def keep(box: Box, results: Mapping[str, np.ndarray], reported: list[int]) -> None:
        store.write(box, results)
        progress(store.layout.size(box) - sum(reported))

    with ThreadPoolExecutor(1) as writer:
        writing: Future[None] | None = None
        try:
            for box in store.missing():
                reported: list[int] = []  # how many trials of this box have ended

                def report(ended: int, reported: list[int] = reported) -> None:
                    reported.append(ended)
                    progress(ended)

                results = study.run(*_task(study, store, box), report)
                if writing is not None:
                    writing.result()
                writing = writer.submit(keep, box, results, reported)
        finally:
            if writing is not None:
                writing.result()


def run_on_cluster(
    study: Study, store: StudyStore, client: "Client", where: str, progress: Progress = nobody
) -> None:
    """Run the missing boxes on a cluster's workers.

    Args:
        where: the flag that named the cluster, for messages.

    Raises:
        BadInput: the store can't be written to; workers die of one box again and again, run other
            versions, or are gone.
    """
    from distributed import wait
    from distributed.client import FutureCancelledError, FuturesCancelledError
    from distributed.comm import CommClosedError
    from distributed.scheduler import KilledWorker

    waiting, lonely_s, wanted = store.missing(), 0.0, versions()
    running: dict[Any, Box] = {}
    try:
        while True:
            workers = len(client.scheduler_info(n_workers=-1)["workers"])
            lonely_s = 0.0 if workers else lonely_s + 1
            if lonely_s > _PATIENCE_S:
                raise BadInput(where, f"no worker for {_PATIENCE_S:g} s; {_KEPT}")
            while len(running) < _IN_FLIGHT * max(workers, 1):
                box = next(waiting, None)
                if box is None:
                    break
                task = _task(study, store, box)
                future = client.submit(run_box, study, *task, wanted, pure=False)
                running[future] = box
            if not running:
                return
            try:
                wait(list(running), timeout=1.0, return_when="FIRST_COMPLETED")
            except TimeoutError:
                continue
            for future in [f for f in running if f.done()]:
                box = running.pop(future)
                store.write(box, future.result())
                progress(store.layout.size(box))
    except KilledWorker as error:
        raise BadInput(
            where, f"a box killed one worker after the other: {error}; {_KEPT}"
        ) from None
    except (FutureCancelledError, FuturesCancelledError, CommClosedError, OSError):
        raise BadInput(where, f"the scheduler is gone; {_KEPT}") from None
    except OtherVersions as error:
        raise BadInput(where, f"{error}; {_KEPT}") from None
    finally:
        client.cancel(list(running), force=True)


_KEPT = "what is done is kept, the same command goes on"


class OtherVersions(RuntimeError):
    """Raised if a worker's versions differ, so that it would compute other bits."""


def run_box(
    study: Study, cells: list[Cell], trials: range, wanted: Mapping[str, str] | None = None
) -> dict[str, Shaped[np.ndarray, "cells ... trials"]]:
    """Run the trials of one box: every variable's values by name.

    Args:
        wanted: versions that this process must have; None: any.

    Raises:
        OtherVersions: this process has other versions.
    """
    if wanted is not None and (here := versions()) != wanted:
        other = ", ".join(f"{n} {here[n]} and not {v}" for n, v in wanted.items() if here[n] != v)
        raise OtherVersions(f"a worker has {other}")
    return study.run(cells, trials)


def _task(study: Study, store: StudyStore, box: Box) -> tuple[list[Cell], range]:
    trials = store.layout.region(box)[-1]
    cells = [study.config.cell(index) for index in store.layout.cells(box)]
    return cells, range(trials.start, trials.stop)


@contextmanager
def local_cluster(workers: int) -> Iterator["Client"]:
    """A cluster of worker processes on this machine, each with one box at a time."""
    import logging

    from distributed import Client, LocalCluster

    # Dask starts workers, later ones too, and multiprocessing a process of its own, by `python -c`,
    # which would import from the current folder.
    os.environ["PYTHONSAFEPATH"] = "1"
    with (
        LocalCluster(
            n_workers=workers,
            threads_per_worker=1,
            processes=True,
            dashboard_address=None,
            silence_logs=logging.CRITICAL,
        ) as cluster,
        Client(cluster) as client,
    ):
        yield client


@contextmanager
def remote_cluster(
    address: str, prepare: Callable[[], Any], timeout_s: float = 10.0
) -> Iterator["Client"]:
    """A client of a cluster that is already running.

    Args:
        prepare: called in every worker, later ones included, before it runs anything.
        timeout_s: longest wait for the scheduler.

    Raises:
        BadInput: the address does not answer.
    """
    import logging

    from distributed import Client, WorkerPlugin

    logging.getLogger("distributed").setLevel(logging.CRITICAL)  # we say ourselves what happened

    class Prepare(WorkerPlugin):
        name = "jaxnav"

        def setup(self, worker: Any) -> None:
            prepare()

    try:
        client = Client(address, timeout=timeout_s)
    except (OSError, ValueError) as error:
        reason = str(error).splitlines()[0] if str(error) else "nobody answers"
        raise BadInput("--scheduler", f"no Dask scheduler at {address!r}: {reason}") from None
    with client:
        client.register_plugin(Prepare())
        yield client
