"""The output of a drive blocks no thread and breaks nothing, whatever reads it."""

import os
import subprocess
import sys
import time
from pathlib import Path

import pytest

from tests.helpers.processes import ROOT, python

PROGRAM = """
import os, sys, time
from jaxnav.drive.output import FreeOutput, fill_descriptors
fill_descriptors()
begin_s = time.monotonic()
with FreeOutput():
    for number in range(3000):
        sys.stderr.write(f"line {number} " + 80 * "x" + "\\n")
        print(f"line {number} " + 80 * "x")
    os.system("echo of another process >&2")
    took_s = time.monotonic() - begin_s
with open(sys.argv[1], "w") as file:
    file.write(f"{took_s}")
sys.exit(7)
"""


def run(folder, **how):
    report = folder / "report"
    return python("-c", PROGRAM, report, **how), report


def took_s(process, report):
    assert process.wait(30) == 7
    return float(report.read_text())


def test_everything_arrives_in_its_order(tmp_path):
    with (tmp_path / "out").open("wb") as out, (tmp_path / "err").open("wb") as err:
        took_s(*run(tmp_path, stdout=out, stderr=err))
    lines = (tmp_path / "out").read_text().splitlines()
    assert [int(line.split()[1]) for line in lines] == list(range(3000))
    assert (tmp_path / "err").read_text().endswith("of another process\n")


def test_readers_that_are_stuck_hold_nothing_up(tmp_path):
    ends = os.pipe()
    process, report = run(tmp_path, stdout=ends[1], stderr=ends[1])
    begin_s = time.monotonic()
    assert took_s(process, report) < 5
    assert time.monotonic() - begin_s < 20
    for end in ends:
        os.close(end)


def test_readers_that_are_gone_break_nothing(tmp_path):
    ends = os.pipe()
    os.close(ends[0])
    took_s(*run(tmp_path, stdout=ends[1], stderr=ends[1]))
    os.close(ends[1])


@pytest.mark.skipif(not Path("/dev/full").exists(), reason="no /dev/full")
def test_a_disk_that_is_full_breaks_nothing(tmp_path):
    with Path("/dev/full").open("wb") as full:
        took_s(*run(tmp_path, stdout=full, stderr=full))


def test_descriptors_that_are_closed_break_nothing(tmp_path):
    command = f'exec "{sys.executable}" -c "$PROGRAM" "{tmp_path / "report"}" <&- >&- 2>&-'
    environment = os.environ | {"PYTHONPATH": str(ROOT), "PROGRAM": PROGRAM}
    process = subprocess.Popen(["/bin/sh", "-c", command], env=environment)
    took_s(process, tmp_path / "report")
