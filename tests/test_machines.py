"""Another compiler decides alike: what is equal by construction is told by no rounding.

`benchmarks/bench_machines.py` has more compilers and recordings, and what each differs by.
"""

import jax
import numpy as np
import pytest

from benchmarks import bench_machines as machines


@pytest.mark.long
def test_a_step_a_start_a_merge_and_two_cameras_are_decided_alike(tmp_path, monkeypatch):
    monkeypatch.setenv("JAX_COMPILATION_CACHE_DIR", jax.config.jax_compilation_cache_dir)
    monkeypatch.setenv("JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS", "0")
    made = machines.make_drives()
    np.savez(tmp_path / "drives.npz", **made)
    own, other = (
        machines.outcomes_under(flags, tmp_path / "drives.npz", ["drives"])
        for flags in (machines.FLAGS["jaxnav's own"], machines.CONTRARY)
    )
    for case in made["names"]:
        found = machines.differences(own, other, case)
        unequal = {
            name: found[name] for name in ("claims", "decided", "chosen", "reported", "lives")
        }
        assert not any(unequal.values()), (case, unequal)
        assert found["pose"] < 1e-6, case
        assert found["claims %"] > 25, case
    # The first three start with a fan, of which hypotheses merge until one is left.
    lives = np.sum(own["start/lives"] >= 0, axis=1)
    assert lives[0] > 10
    assert np.any(np.diff(lives) < 0)
