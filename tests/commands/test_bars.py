"""What a progress bar says while nothing moves, and where there is no terminal."""

import io
import time
from pathlib import Path

import pytest

import jaxnav
from jaxnav.commands import bars
from jaxnav.commands.bars import progress_bar, update_after_compiling


class Terminal(io.StringIO):
    def isatty(self):
        return True


def states(stream):
    return [one for one in stream.getvalue().replace("\r", "\n").splitlines() if one.strip()]


@pytest.mark.parametrize("stream", [io.StringIO, Terminal])
def test_a_bar_moves_and_says_compiling_until_something_comes(stream, monkeypatch):
    shown = stream()
    monkeypatch.setattr("sys.stderr", shown)
    monkeypatch.setattr(bars, "FROM_S", 0.2)
    monkeypatch.setattr(bars, "EVERY_S", 0.1)
    with progress_bar(total=3, unit="drive") as bar:
        update = update_after_compiling(bar)
        time.sleep(0.6)
        waited = states(shown)
        assert len(waited) >= 2
        assert "compiling" in waited[-1]
        assert "[00:00<" in waited[-1]
        update(0)  # a chunk in which no drive has ended
        update(3)
    assert "3/3" in states(shown)[-1]
    assert "compiling" not in states(shown)[-1]
    assert ("\r" in shown.getvalue()) == shown.isatty()


def test_a_bar_in_a_file_is_a_line_each_second(monkeypatch):
    log, now_s = io.StringIO(), [0.0]
    monkeypatch.setattr("sys.stderr", log)
    monkeypatch.setattr("jaxnav.commands.bars.time.monotonic", lambda: now_s[0])
    with progress_bar(total=1000) as bar:
        for step in range(1000):
            now_s[0] += 0.01
            bar.set_postfix_str(f"at {step} m")
            bar.update()
    lines = log.getvalue().splitlines()
    assert 8 <= len(lines) <= 10  # from 2 s to 10 s, and its end
    assert "1000/1000" in lines[-1]
    assert "at 999 m" in lines[-1]
    assert log.getvalue().isascii()
    assert log.getvalue().replace("\n", "").isprintable()


def test_bars_inside_bars_are_lines_too(monkeypatch):
    log = io.StringIO()
    monkeypatch.setattr("sys.stderr", log)
    monkeypatch.setattr(bars, "FROM_S", 0.0)
    for _ in progress_bar(range(2), unit=" file"):
        for _ in progress_bar(range(3), unit=" frame", leave=False):
            pass
    assert log.getvalue().replace("\n", "").isprintable()
    lines = log.getvalue().splitlines()
    assert all("file" in line or "frame" in line for line in lines)
    assert "2/2" in lines[-1]


def test_a_short_bar_leaves_no_line_in_a_file_and_a_headless_one_nothing(monkeypatch):
    log = io.StringIO()
    monkeypatch.setattr("sys.stderr", log)
    assert list(progress_bar(range(3))) == [0, 1, 2]
    monkeypatch.setattr(bars, "FROM_S", 0.0)
    assert list(progress_bar(range(3), disable=True)) == [0, 1, 2]
    assert log.getvalue() == ""


def test_every_command_takes_its_bars_from_here():
    package = Path(jaxnav.__file__).parent
    users = [file.name for file in package.rglob("*.py") if "import tqdm" in file.read_text()]
    assert users == ["bars.py"]
