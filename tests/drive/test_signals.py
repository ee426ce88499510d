"""Signals to a drive: none is lost, whatever the interpreter is doing when it arrives."""

import os
import signal
import subprocess
import threading
import time

import pytest

from jaxnav.drive.signals import Interrupted, Signals
from tests.helpers.processes import python

ALL = ["SIGINT", "SIGTERM", "SIGHUP", "SIGQUIT", "SIGTSTP", "SIGUSR1"]


def raise_signal(name):
    os.kill(os.getpid(), getattr(signal, name))
    time.sleep(0.01)


@pytest.mark.parametrize("name", ALL)
def test_each_is_noted_and_none_raises(name):
    told = []
    with Signals() as signals:
        signals.check()
        signals.on_signal(told.append)
        raise_signal(name)
        with pytest.raises(Interrupted, match=name):
            signals.check()
        assert signals.exit_code == 128 + getattr(signal, name)
        raise_signal("SIGINT")  # the second one changes nothing
        assert signals.name == name
    assert told[0] == name


def test_one_that_comes_inside_a_callback_that_swallows_errors_is_not_lost():
    """As a library's callback of the garbage collection does with KeyboardInterrupt."""

    class Swallows:
        def __del__(self):
            raise_signal("SIGINT")

    with Signals() as signals:
        Swallows()
        with pytest.raises(Interrupted):
            signals.check()


def test_who_asks_after_it_has_come_is_told_at_once():
    with Signals() as signals:
        raise_signal("SIGTERM")
        told = []
        signals.on_signal(told.append)
        assert told == ["SIGTERM"]
        with pytest.raises(Interrupted):
            signals.hold()


def test_it_is_told_while_the_main_thread_is_inside_a_library():
    heard = threading.Event()
    with Signals() as signals:
        signals.on_signal(lambda name: heard.set())
        threading.Timer(0.05, os.kill, (os.getpid(), signal.SIGTERM)).start()
        lock = threading.Lock()
        lock.acquire()
        assert heard.wait(2.0)
        assert signals.number == signal.SIGTERM


def test_one_who_fails_keeps_nobody_else_from_hearing_it_and_handlers_are_given_back():
    told, before = [], [signal.getsignal(getattr(signal, name)) for name in ALL]
    with Signals() as signals:
        assert signal.getsignal(signal.SIGINT) not in before
        signals.on_signal(lambda name: 1 / 0)
        signals.on_signal(told.append)
        raise_signal("SIGTERM")
        time.sleep(0.1)
    assert told == ["SIGTERM"]
    assert [signal.getsignal(getattr(signal, name)) for name in ALL] == before
    assert signal.set_wakeup_fd(-1) == -1


def test_what_nohup_ignores_stays_ignored():
    before = signal.signal(signal.SIGHUP, signal.SIG_IGN)
    try:
        with Signals() as signals:
            raise_signal("SIGHUP")
            signals.check()
    finally:
        signal.signal(signal.SIGHUP, before)


def test_outside_the_main_thread_there_are_none():
    made = []
    thread = threading.Thread(target=lambda: made.append(Signals()))
    thread.start()
    thread.join()
    made[0].check()
    made[0].close()


PROGRAM = """
import ctypes, sys, time
from jaxnav.drive.signals import Signals
signals = Signals()
{hold}
print("here", flush=True)
end_s = time.monotonic() + {sleeps}
while time.monotonic() < end_s:
    ctypes.CDLL(None).sleep(1)  # as a compiler does: the main thread asks for no signal meanwhile
signals.check()
"""


def ended(hold, sleeps, name):
    process = python("-c", PROGRAM.format(hold=hold, sleeps=sleeps), stderr=subprocess.PIPE)
    process.stdout.readline()
    begin_s = time.monotonic()
    process.send_signal(getattr(signal, name))
    _, err = process.communicate(timeout=30)
    return process.returncode, time.monotonic() - begin_s, err


def test_a_start_that_compiles_for_long_ends_soon():
    code, took_s, err = ended("", 20, "SIGTERM")
    assert (code, err) == (128 + signal.SIGTERM, "jaxnav: interrupted\n")
    assert took_s < 10


def test_once_something_is_open_it_is_not_cut_short():
    code, took_s, err = ended("signals.hold()", 2, "SIGINT")
    assert code == 1  # its own end: nobody caught `Interrupted` here
    assert took_s > 1
    assert "Interrupted: SIGINT" in err
