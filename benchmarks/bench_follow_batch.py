"""Fits of many markers in one call, on JAX's default device: what a GPU makes of `follow_pattern`.

python benchmarks/bench_follow_batch.py
JAX_PLATFORMS=cpu OMP_NUM_THREADS=1 python benchmarks/bench_follow_batch.py 1 64

Pictures of `bench_blur.py`, each with its own lens, place, light and id. The corners of each are
compared with those of a fit alone.
"""

import sys
import time
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

import jaxnav
from benchmarks.bench_blur import FAMILY, KINDS, drawn, predicted
from benchmarks.bench_detection import row
from jaxnav.detection.patch_fit import PatchFit
from jaxnav.detection.pattern_program import codes_on_device, follow_pattern
from jaxnav.detection.track import first_fit

BATCHES = (1, 64, 1024, 8192)
PICTURES, ROUNDS = 64, 5


def patches(kind: str) -> list[PatchFit]:
    """The fit of each picture alone, which holds its patch."""
    fits = []
    for seed, picture in enumerate(drawn(kind, PICTURES)):
        fit = first_fit(picture.image, picture.camera, predicted(picture, seed))
        assert fit is not None
        fits.append(fit)
    return fits


def measure(fits: list[PatchFit], many: int) -> tuple[float, float, float]:
    """Time a marker, us; time to compile, s; largest difference of a corner, px."""
    chosen = [fits[i % len(fits)] for i in range(many)]
    cameras, stack = (
        jax.device_put(jax.tree.map(lambda *leaves: np.stack(leaves), *parts))
        for parts in ([fit.camera for fit in chosen], [fit.patch for fit in chosen])
    )
    follow: Any = jax.jit(jax.vmap(follow_pattern, in_axes=(0, 0, None)))
    codes = codes_on_device(FAMILY)
    laps = []
    for _ in range(ROUNDS + 1):
        begin = time.perf_counter()
        found = jax.block_until_ready(follow(cameras, stack, codes))
        laps.append(time.perf_counter() - begin)
    alone = np.stack([fit.summary.corners_px for fit in chosen])
    off_px = jnp.max(jnp.abs(found.summary.corners_px - alone))
    lap = float(np.median(laps[1:]))
    return 1e6 * lap / many, laps[0] - lap, float(off_px)


if __name__ == "__main__":
    jaxnav.configure(threads=1)
    sizes = [int(word) for word in sys.argv[1:]] or BATCHES
    print(f"jax {jax.__version__}, {jax.devices()[0].device_kind}\n")
    print(row("followed", "at once", "us a marker", "s to compile", "off, px"))
    print(row(*["---"] * 5), flush=True)
    for kind in ("clean", "blur4", "blur8"):
        fits = patches(kind)
        for many in sizes:
            us, compiling_s, off_px = measure(fits, many)
            print(
                row(KINDS[kind], many, f"{us:.0f}", f"{compiling_s:.0f}", f"{off_px:.4f}"),
                flush=True,
            )
