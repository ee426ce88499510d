"""The fault matrix: every fault comes to what it must (RELIABILITY)."""

import dataclasses
from collections.abc import Iterator
from functools import partial

import jax
import numpy as np
import pytest

from jaxnav.cli import main
from jaxnav.runtime.estimator import advance_packed
from jaxnav.runtime.flags import Fault, Health
from jaxnav.vehicles.faults import Row, Trial, line, run_trial
from jaxnav.vehicles.matrix import matrix
from tests import worlds


class Compiled:
    """`advance_packed`, compiled once for all navigators of a structure, and to run fast."""

    def __init__(self):
        self.executables = {}  # for events with corners, and for those without

    def __call__(self, navigator):
        return partial(self.run, navigator)

    def run(self, *told):
        kind = jax.tree.structure(told)
        if kind not in self.executables:
            options = {"xla_backend_optimization_level": 2}
            self.executables[kind] = jax.jit(advance_packed).lower(*told).compile(options)
        return self.executables[kind](*told)


@pytest.fixture(scope="module", params=["float64", "float32"])
def trial(request) -> Iterator[Trial]:
    """Compiled once in each precision, in which all rows are then driven."""
    with jax.enable_x64(request.param == "float64"):
        yield Trial(worlds.qcar_rig(), worlds.paper_markers(), worlds.qcar(), program=Compiled())


@pytest.mark.parametrize("row", matrix(), ids=lambda row: row.name)
def test_every_fault_comes_to_what_it_must(trial, row):
    result = run_trial(row, trial)
    assert result.broken == (), line(result)


def test_what_is_asked_of_a_fault_can_be_missed(trial):
    """The same measure finds fault with a drive in which the wrong thing is asked for."""
    tunnel = next(row for row in matrix() if row.name == "tunnel, 5 s")
    asked = dataclasses.replace(
        tunnel, faults=Fault.ODOMETRY_STUCK, at_most=Health.OK, error_m=0.0, drive_s=9.0
    )
    broken = run_trial(asked, trial).broken
    assert any("ODOMETRY_STUCK" in said for said in broken)
    assert any("health STOP" in said for said in broken)
    assert any("error" in said for said in broken)


def test_rows_have_names_of_their_own():
    names = [row.name for row in matrix()]
    assert len(set(names)) == len(names)
    assert all(isinstance(row, Row) and np.isfinite(row.drive_s) for row in matrix())


def test_a_fault_that_is_not_there_is_one_line(capsys, monkeypatch):
    monkeypatch.setattr("jaxnav.commands.faults.configure_jax", lambda **_: None)
    assert main(["faults", "--only", "earthquake"]) == 2
    error = capsys.readouterr().err.strip().splitlines()
    assert len(error) == 1
    assert "--only: names no fault" in error[0]
