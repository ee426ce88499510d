"""Run many drives side by side, each with as few slots as its next frames need.

A compiled step computes every slot for sightings and hypotheses, empty or not. Few frames need
more than one sighting and two hypotheses, so there are programs of several sizes: drives are
sorted by what they needed last, a program advances a fixed number of them by a chunk of frames,
and what did not suffice is done again with more. Steps are pure, so that is exact.
"""

import threading
from collections import deque
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Int, Key, PyTree

from jaxnav.core.filter.bank import Bank, fill_slots, first_hypotheses, survivors_first
from jaxnav.core.filter.hypotheses import MultiHypothesis
from jaxnav.core.linalg.small_matrices import as_class
from jaxnav.core.navigator import Navigator
from jaxnav.sim.traces import DriveTraces

_POOL = 1024  # drives under way at once on a thread
# Up to so many drives don't pay for a second program, and for a third.
_ONE_PROGRAM, _TWO_PROGRAMS = 32, 512
_ACCELERATOR_DRIVES = 2048


@jax.tree_util.register_static
@dataclass(frozen=True)
class Slots:
    """The size of a program. None: as many slots as the navigator has."""

    drives: int  # that it advances at once
    sightings: int | None = None
    hypotheses: int | None = None

    def suffice(self, seen: Any, alive: Any) -> Any:
        """Whether a step has room for `seen` sightings and a bank with `alive` hypotheses.

        The heaviest hypothesis may branch into every further candidate, two a sighting; an empty
        bank starts with all slots.
        """
        enough = seen <= (np.inf if self.sightings is None else self.sightings)
        if self.hypotheses is None:
            return enough
        assert self.sightings is not None
        branches = 2 * self.sightings - 1
        return enough & ((seen == 0) | (alive > 0)) & (alive + branches <= self.hypotheses)

    def limit(self, navigator: Navigator) -> Navigator:
        """The navigator with so many slots for sightings."""
        if self.sightings is None:
            return navigator
        return as_class(Navigator, navigator, max_sightings=self.sightings)

    def lack(self, seen: Int[Array, ""], before: Bank, after: Bank) -> Bool[Array, ""]:
        """Whether a step with these slots may have left out something that all slots hold."""
        lacks = ~self.suffice(seen, jnp.sum(before.initialised))
        if self.hypotheses is not None:  # all may have been lost on the way
            lacks |= (seen > 0) & ~jnp.any(after.initialised)
        return lacks

    def cut(self, bank: Bank) -> Bank:
        """The first slots of a bank, with its hypotheses in them."""
        if self.hypotheses is None:
            return bank
        return first_hypotheses(survivors_first(bank), self.hypotheses)

    def restored(self, few: Bank, whole: Bank) -> Bank:
        """`few` in the first slots of a bank whose further slots are empty."""
        if self.hypotheses is None:
            return few
        return fill_slots(few, survivors_first(whole))


def program_sizes(navigator: Navigator, drives: int) -> list[Slots]:
    """The sizes of the programs for so many drives, the smallest first, the last with all slots.

    Nine frames of ten have one hypothesis alive, three of four show one sighting. A navigator with
    a step of its own, few drives, and an accelerator have one program.

    Args:
        drives: how many; one that carries P derivatives costs as much as 1 + P.
    """
    if jax.default_backend() != "cpu":
        return [Slots(min(drives, _ACCELERATOR_DRIVES))]
    whole = Slots(min(drives, 8))
    if drives <= _ONE_PROGRAM or type(navigator) is not Navigator:
        return [whole]
    if isinstance(navigator.selector, MultiHypothesis):
        least = [Slots(64, 1, 2)] if drives > _TWO_PROGRAMS else []
        return [*least, Slots(16, 2, 5), whole]
    several = navigator.no_candidates().valid.shape[0] > 2  # two candidates a sighting
    return [Slots(64, 1), whole] if several else [whole]


def run_drives(
    keys: Key[Array, " S"],
    start: Callable[[Key[Array, " drives"]], PyTree],
    advance: Callable[[PyTree, Slots], tuple[PyTree, PyTree, Bool[Array, " drives"]]],
    sizes: Sequence[Slots],
    kept: DriveTraces,
    threads: int,
    progress: Callable[[int], object] = lambda ended: None,
) -> DriveTraces:
    """Run every drive from its start until its world has `ended`; `kept`, filled.

    What a drive computes depends neither on the others nor on their number.

    Args:
        keys: one for each drive.
        start: from keys to worlds, which have `ended`, `seen` (sightings of the last frame) and
            `bank`.
        advance: from worlds to those some frames later, their records with as many entries as
            `kept` expects of a chunk, and whether the slots did not suffice; leading axes
            (drives,).
        sizes: see `program_sizes`.
        kept: takes the records.
        threads: each with drives of its own; with several devices, one for each device.
        progress: called with the number of drives that have ended since the last call.
    """
    devices = jax.local_devices()
    if len(devices) > 1:
        threads = len(devices)
    waiting, lock, failed = deque(range(len(keys))), threading.Lock(), threading.Event()
    # The first thread to want a program compiles it for all.
    compiling: dict[Slots | None, threading.Lock] = {size: threading.Lock() for size in sizes}
    compiling[None] = threading.Lock()
    compiled: set[Slots | None] = set()

    def called(size: Slots | None, function: Callable[..., PyTree], *args: Any) -> PyTree:
        if size in compiled:
            return jax.device_get(function(*args))
        with compiling[size]:
            result = jax.device_get(function(*args))
            compiled.add(size)
        return result

    def work() -> None:
        room = min(_POOL, -(-len(keys) // threads))
        owner, size_of = np.full(room, -1), np.full(room, len(sizes) - 1)
        worlds: PyTree = None
        while not failed.is_set():
            (free,) = np.nonzero(owner < 0)
            with lock:
                taken = [waiting.popleft() for _ in range(min(len(free), len(waiting)))]
            owner[free[: len(taken)]] = taken
            for some in _in_calls(free[: len(taken)], sizes[-1].drives):
                fresh = called(None, start, keys[owner[some]])
                if worlds is None:
                    worlds = jax.tree.map(
                        lambda leaf: np.zeros((room, *leaf.shape[1:]), leaf.dtype), fresh
                    )
                _write(worlds, some, fresh)
                size_of[some] = len(sizes) - 1
            if not np.any(owner >= 0):
                return
            for number, size in enumerate(sizes):
                (due,) = np.nonzero((owner >= 0) & (size_of == number))
                for some in _in_calls(due, size.drives):
                    before = jax.tree.map(lambda leaf: leaf[some], worlds)  # noqa: B023
                    after, records, lacks = called(size, advance, before, size)
                    size_of[some[lacks]] = number + 1
                    first = np.unique(some, return_index=True)[1]  # a call is filled up with copies
                    done = np.isin(np.arange(len(some)), first) & ~lacks
                    _write(worlds, some[done], jax.tree.map(lambda leaf: leaf[done], after))  # noqa: B023
                    with lock:
                        kept.add(np.where(done, owner[some], -1), records)
                    if failed.is_set():
                        return
            over = (owner >= 0) & worlds.ended
            owner[over] = -1
            alive = worlds.bank.initialised.sum(axis=-1)
            size_of[:] = len(sizes) - 1
            for number in reversed(range(len(sizes) - 1)):
                size_of[sizes[number].suffice(worlds.seen, alive)] = number
            with lock:
                progress(int(over.sum()))

    threads = max(1, min(threads, -(-len(keys) // sizes[-1].drives)))
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
            failed.set()  # an interruption or a failure ends all threads
    return kept


def _in_calls(drives: Int[np.ndarray, " n"], count: int) -> list[Int[np.ndarray, " count"]]:
    """The drives in groups of `count`, the last one filled up with copies of its first."""
    return [
        np.resize(drives[begin : begin + count], count) for begin in range(0, len(drives), count)
    ]


def _write(worlds: PyTree, where: Int[np.ndarray, " n"], some: PyTree) -> None:
    for whole, part in zip(jax.tree.leaves(worlds), jax.tree.leaves(some), strict=True):
        whole[where] = part
