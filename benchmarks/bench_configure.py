"""Measure the gain of each flag of `jaxnav.configure`: the table of docs/guide/performance.md.

    python -m benchmarks.bench_configure [TURNS]

Fresh processes, turn and turn about; both poses of 4096 markers in float32, as times OpenCV's
IPPE_SQUARE on one thread in the same process.
"""

import json
import os
import subprocess
import sys
import time
from collections.abc import Callable

import numpy as np

from jaxnav.files.configuration import FLAGS

MARKERS, OPENCV_LANES, ROUNDS = 4096, 100, 9
EMITTERS, YNNPACK = (f"--{flag}={value}" for flag, value in FLAGS.items())
SETTINGS = {"none": "", "fusion": EMITTERS, "ynn": YNNPACK, "both": f"{EMITTERS} {YNNPACK}"}


def one_process() -> dict[str, float]:
    """Ratios of this process, and seconds to trace and compile, with the flags that it has."""
    from benchmarks.bench_pair import closed_form, markers, single_thread

    corners = markers(MARKERS, 0.3)
    tasks, compile_s = {}, {}
    for name, batched in (("vmap", False), ("ippe_squares", True)):
        started = time.perf_counter()
        tasks[name], _ = closed_form(corners, batched)
        compile_s[f"{name}, s to compile"] = time.perf_counter() - started
    tasks["OpenCV"], _ = single_thread(corners[:OPENCV_LANES], refined=False)
    spent: dict[str, list[float]] = {name: [] for name in tasks}
    for _ in range(ROUNDS):
        for name, task in tasks.items():
            spent[name].append(_seconds(task) / (OPENCV_LANES if name == "OpenCV" else MARKERS))
    peer = np.median(spent.pop("OpenCV"))
    return {name: float(peer / np.median(values)) for name, values in spent.items()} | compile_s


def _seconds(task: Callable[[], object]) -> float:
    started = time.perf_counter()
    task()
    return time.perf_counter() - started


def main(turns: int) -> None:
    """Print the table: median and least of each column."""
    found: dict[str, list[dict[str, float]]] = {name: [] for name in SETTINGS}
    for _ in range(turns):
        for name, flags in SETTINGS.items():
            run = subprocess.run(
                [sys.executable, "-m", "benchmarks.bench_configure", "one"],
                env=os.environ | {"XLA_FLAGS": flags},
                capture_output=True,
                text=True,
                check=True,
            )
            found[name].append(json.loads(run.stdout))
    columns = list(found["none"][0])
    print(f"| flags | {' | '.join(columns)} |\n|---|{'---|' * len(columns)}")
    for name, rows in found.items():
        values = [[row[column] for row in rows] for column in columns]
        print(f"| {name} | {' | '.join(f'{np.median(v):.3g}, {min(v):.3g}' for v in values)} |")


if __name__ == "__main__":
    if sys.argv[1:] == ["one"]:
        print(json.dumps(one_process()))
    else:
        main(int(sys.argv[1]) if len(sys.argv) > 1 else 5)
