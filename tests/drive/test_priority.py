"""A process gets priority over others, and its terminal is restored afterwards."""

import os
import sys

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


def test_all_of_its_terminal_comes_first_meanwhile(group):
    with priority.before_others():
        assert nice_of(group) == priority.NICE
    assert nice_of(group) == 0


def test_however_it_ends_the_terminal_is_as_it_was(group):
    with pytest.raises(KeyError), priority.before_others():
        raise KeyError
    assert nice_of(group) == 0


def test_a_terminal_that_comes_first_already_is_left_alone(group):
    group.write_text("/autogroup-42 nice -15\n")
    with priority.before_others():
        assert nice_of(group) == -15
    assert group.read_text() == "/autogroup-42 nice -15\n"


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
