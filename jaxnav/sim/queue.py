"""Run many drives in a fixed number of lanes: a lane whose drive has ended takes the next seed."""

import threading
from collections import deque
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from contextlib import nullcontext
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Key, PyTree

from jaxnav.core.linalg.small_matrices import where
from jaxnav.sim.traces import DriveTraces


def run_lanes(
    keys: Key[Array, " S"],
    start: Callable[[Key[Array, " lanes"]], PyTree],
    advance: Callable[[PyTree], tuple[PyTree, PyTree]],
    lanes: int,
    threads: int,
    kept: DriveTraces,
    progress: Callable[[int], object] = lambda ended: None,
) -> DriveTraces:
    """Run every drive from its start until its world has `ended`; `kept`, filled.

    Args:
        keys: one for each drive; a key's drive does not depend on the others.
        start: from one key a lane to the worlds, leading axis (lanes,).
        advance: from worlds to the worlds some frames later and their records, leading axes (lanes,
            entries) with as many entries as `kept` expects of a chunk.
        threads: threads of `lanes` lanes each; with several devices, one thread for each device.
        kept: takes the records.
        progress: called with the number of drives that have ended since the last call.
    """
    devices = jax.local_devices()
    if len(devices) > 1:
        threads = len(devices)  # one for each device, all with the same program
    waiting, lock = deque(range(len(keys))), threading.Lock()
    compiling = threading.Lock()  # one thread compiles for all

    over_all = threading.Event()

    def work() -> None:
        owner = np.full(lanes, -1)
        worlds = start(keys[np.zeros(lanes, int)])
        over = np.ones(lanes, bool)
        turn: Any = compiling
        while True:
            with lock:
                owner[over] = [waiting.popleft() if waiting else -1 for _ in range(over.sum())]
            if over_all.is_set() or not np.any(owner >= 0):
                return
            starts = over & (owner >= 0)
            if np.any(starts):
                fresh = start(keys[np.maximum(owner, 0)])
                worlds = where(jnp.asarray(starts), fresh, worlds)
            with turn:
                worlds, chunk = advance(worlds)
            turn = nullcontext()
            chunk, ended = jax.device_get((chunk, worlds.ended))
            over = ended & (owner >= 0)
            with lock:
                kept.add(owner, chunk)
                progress(int(over.sum()))

    threads = max(1, min(threads, -(-len(keys) // lanes)))
    float64 = jnp.zeros(()).dtype == jnp.float64  # a new thread does not inherit it

    def work_alike(number: int) -> None:
        with jax.enable_x64(float64), jax.default_device(devices[number % len(devices)]):
            work()

    if threads == 1:  # with the same settings, or what is compiled would not serve both
        work_alike(0)
        return kept
    with ThreadPoolExecutor(threads) as pool:
        working = [pool.submit(work_alike, number) for number in range(threads)]
        try:
            for one in working:
                one.result()
        finally:
            over_all.set()  # an interruption or a failure ends all threads
    return kept
