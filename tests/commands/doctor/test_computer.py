"""Checks of the computer: each finds its fault, and passes a computer in order."""

import importlib.metadata
import os
import time
from types import SimpleNamespace

import cv2
import jax
import jax.numpy as jnp
import pytest

from jaxnav.commands.doctor.computer import (
    clock,
    compile_cache,
    disk,
    jax_device,
    opencv,
    packages,
    processor,
)
from tests.helpers.findings import all_well, the_problem


class FakeClock:
    """Time that passes by itself a little, and by sleeping."""

    def __init__(self, late_s=1e-4, late_every=1, gain=0.0):
        self.now_ns, self.gain = 10**12, gain
        self.late_s, self.late_every, self.sleeps = late_s, late_every, 0

    def monotonic_ns(self):
        self.now_ns += 1
        return self.now_ns

    def wall_ns(self):
        return 10**18 + int(self.now_ns * (1 + self.gain))

    def sleep(self, seconds):
        self.sleeps += 1
        late_s = self.late_s if self.sleeps % self.late_every == 0 else 0.0
        self.now_ns += int((seconds + late_s) * 1e9)

    def found(self):
        return list(clock(self.monotonic_ns, self.wall_ns, self.sleep))


@pytest.mark.parametrize("fake", [FakeClock(), FakeClock(late_s=30e-3, late_every=101)])
def test_a_steady_clock_may_be_late_once_in_a_hundred(fake):
    assert all_well(fake.found())


@pytest.mark.parametrize(
    ("fake", "level", "words"),
    [
        (FakeClock(late_s=8e-3), "warning", "ends 8.00 ms late"),
        (FakeClock(late_s=8e-3, late_every=50), "warning", "ends 8.00 ms late (99 %"),
        (FakeClock(late_s=30e-3), "error", "the loop's tick is 20 ms"),
        (FakeClock(gain=0.1), "warning", "wall clock moved +20.0 ms"),
    ],
)
def test_a_clock_that_is_set_and_a_scheduler_that_is_late(fake, level, words):
    assert words in the_problem(fake.found(), level).what


def test_a_coarse_clock_is_an_error(monkeypatch):
    """15.6 ms is what old kernels and Windows count in."""
    coarse = SimpleNamespace(resolution=0.0156)
    monkeypatch.setattr(time, "get_clock_info", lambda name: coarse)
    assert "steps of 15.6 ms" in the_problem(FakeClock().found(), "error").what


def cores(folder, governor, allowed="2000000"):
    for number in range(2):
        core = folder / f"cpu{number}" / "cpufreq"
        core.mkdir(parents=True)
        (core / "scaling_governor").write_text(f"{governor}\n")
        (core / "scaling_max_freq").write_text(allowed)
        (core / "cpuinfo_max_freq").write_text("2000000")
    (folder / "cpufreq").mkdir()
    return folder


def test_the_governor_of_the_processor(tmp_path):
    assert all_well(processor(cores(tmp_path / "fast", "performance")))
    assert all_well(processor(tmp_path / "silent"))
    slow = the_problem(processor(cores(tmp_path / "slow", "powersave")), "note")
    assert "2 cores, governor powersave" in slow.what
    held = the_problem(processor(cores(tmp_path / "held", "performance", "1000000")), "warning")
    assert "held at 50%" in held.what


def test_the_disk(tmp_path, monkeypatch):
    def free(mib):
        return lambda folder: (2**40, 2**40, int(mib * 2**20))

    instants_ns = iter([0, 10**8])
    assert all_well(disk(tmp_path, free(50_000), lambda: next(instants_ns)))
    instants_ns = iter([0, 10**8])
    assert "500 MiB free" in next(disk(tmp_path, free(500))).what
    assert "3 MiB free" in the_problem(disk(tmp_path, free(3)), "error").what
    instants_ns = iter([0, 4 * 10**9])
    slow = the_problem(disk(tmp_path, free(50_000), lambda: next(instants_ns)), "warning")
    assert "4 MiB/s" in slow.what
    assert "can't be written" in the_problem(disk(tmp_path / "gone", free(9999)), "error").what
    assert list(tmp_path.iterdir()) == []


def test_packages_out_of_their_ranges_and_an_old_python_are_named(monkeypatch):
    assert all_well(packages())
    asked = ["numpy>=99", "no-such-thing>=1", "jax>=0.1", 'dask>=99; extra == "study"']
    monkeypatch.setattr(importlib.metadata, "requires", lambda name: asked)
    found = the_problem(packages(), "error")
    assert "numpy is " in found.what
    assert "expected >=99, no-such-thing is missing" in found.what
    assert "jax" not in found.what
    assert "dask" not in found.what
    monkeypatch.setattr("platform.python_version", lambda: "3.9.1")
    assert "Python is 3.9.1" in next(packages()).what


def test_opencv(monkeypatch):
    monkeypatch.setattr(cv2, "getBuildInformation", lambda: "GStreamer:   YES (1.20)")
    assert all_well(opencv())
    monkeypatch.setattr(cv2, "getBuildInformation", lambda: "GStreamer:   NO")
    assert "without GStreamer" in the_problem(opencv(), "note").what
    monkeypatch.setattr(cv2, "aruco", None)
    assert "without aruco" in the_problem(opencv(), "error").what


def test_jax_runs_on_the_processor_in_float64(tmp_path, monkeypatch):
    assert all_well(jax_device(tmp_path))
    with jax.enable_x64(False):
        assert "float32" in the_problem(jax_device(tmp_path), "warning").what


def test_a_graphics_processor_is_not_for_a_car(tmp_path, monkeypatch):
    (tmp_path / "model").write_bytes(b"NVIDIA Jetson Orin Nano\0")
    monkeypatch.setattr(
        jax, "devices", lambda: [SimpleNamespace(platform="gpu", device_kind="Orin")]
    )
    jetson = the_problem(jax_device(tmp_path / "model"), "error")
    assert "JAX_PLATFORMS=cpu" in jetson.do
    assert "faster on the processor" in the_problem(jax_device(tmp_path), "warning").what


def test_a_jax_that_computes_wrongly_is_found(tmp_path, monkeypatch):
    right = jnp.asarray
    monkeypatch.setattr(jnp, "asarray", lambda x, *args: right(x, *args) + 1)
    assert "21 * 2 gave 44" in the_problem(jax_device(tmp_path), "error").what


def test_the_compile_cache(tmp_path, monkeypatch):
    (tmp_path / "steps").mkdir()
    (tmp_path / "steps" / "a.step").write_bytes(b"x" * 2**20)
    (kept,) = compile_cache(tmp_path)
    assert "1 files, 1 MiB" in kept.what
    assert all_well([kept, *compile_cache(tmp_path / "not" / "made" / "yet")])
    refused = "/tmp/x belongs to another user"
    for why, given in (("no folder", (None,)), (refused, (None, refused))):
        assert why in the_problem(compile_cache(*given), "warning").what
    monkeypatch.setattr(os, "access", lambda path, mode: False)
    assert "can't be written" in the_problem(compile_cache(tmp_path), "warning").what
