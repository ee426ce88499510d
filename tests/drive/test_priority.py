"""A process gets priority over others, and its terminal is restored afterwards."""

import os
import sys
from contextlib import suppress

import pytest

from jaxnav.drive import priority


@pytest.fixture
def group(tmp_path, monkeypatch):
    path = tmp_path / "autogroup"
    path.write_text("/autogroup-42 nice 0\n")
    monkeypatch.setattr(priority, "_GROUP", path)
    monkeypatch.setattr(os, "setpriority", lambda *_: None)
    return path


def nice_of(group) -> int:
    """What the kernel would answer; it takes a number alone."""
    return int(group.read_text().rpartition(" ")[2])


@pytest.mark.parametrize(("before", "meanwhile"), [(0, priority.NICE), (-15, -15)])
def test_all_of_its_terminal_comes_first_however_it_ends(group, before, meanwhile):
    group.write_text(f"/autogroup-42 nice {before}\n")
    with suppress(KeyError), priority.before_others():
        assert nice_of(group) == meanwhile
        raise KeyError
    assert nice_of(group) == before


@pytest.fixture
def refused(monkeypatch):
    def refuse(*_):
        raise PermissionError

    monkeypatch.setattr(os, "setpriority", refuse)


def test_without_groups_or_without_the_right_to_it_goes_on(group, refused, monkeypatch):
    group.unlink()
    with priority.before_others():
        assert not group.exists()
    monkeypatch.setattr(priority, "_group_nice", lambda: 0)
    monkeypatch.setattr(priority, "_GROUP", group / "nowhere")
    with priority.before_others():
        pass


@pytest.mark.skipif(sys.platform != "linux", reason="nice values of threads are Linux's")
def test_a_thread_comes_before_its_siblings_and_goes_back(monkeypatch):
    given = [-10]
    monkeypatch.setattr(os, "getpriority", lambda *_: given[-1])
    monkeypatch.setattr(os, "setpriority", lambda kind, who, nice: given.append(nice))
    with priority.before_siblings():
        assert given[-1] == priority.FIRST_NICE
    assert given == [-10, priority.FIRST_NICE, -10]


def test_a_thread_that_may_not_come_first_goes_on(refused):
    with priority.before_siblings():
        pass
