"""What a progress bar says while nothing moves, and where there is no terminal."""

import io
from pathlib import Path

from tqdm import tqdm

import jaxnav
from jaxnav.commands.bars import progress_bar, update_after_compiling


def test_a_bar_says_compiling_until_something_moves():
    shown = io.StringIO()
    with tqdm(total=3, unit="drive", file=shown, mininterval=0, ascii=True) as bar:
        update = update_after_compiling(bar)
        assert "compiling" in shown.getvalue().split("\r")[-1]
        update(0)  # a chunk in which no drive has ended
        assert "compiling" not in shown.getvalue().split("\r")[-1]
        update(2)
        assert bar.n == 2


def test_a_bar_in_a_file_is_a_line_each_second(monkeypatch):
    log = io.StringIO()
    monkeypatch.setattr("sys.stderr", log)
    with progress_bar(total=400) as bar:
        for step in range(400):
            bar.set_postfix_str(f"at {step} m")
            bar.update()
    lines = log.getvalue().splitlines()
    assert 1 <= len(lines) <= 3
    assert "400/400" in lines[-1]
    assert "at 399 m" in lines[-1]
    assert log.getvalue().isascii()
    assert log.getvalue().replace("\n", "").isprintable()


def test_a_long_bar_in_a_file_tells_a_state_every_other_second(monkeypatch):
    log, now_s = io.StringIO(), [0.0]
    monkeypatch.setattr("sys.stderr", log)
    monkeypatch.setattr("jaxnav.commands.bars.time.monotonic", lambda: now_s[0])
    with progress_bar(total=1000) as bar:
        bar.set_postfix_str("compiling")
        assert "compiling" in log.getvalue().splitlines()[-1]
        for step in range(1000):
            now_s[0] += 0.01
            bar.set_postfix_str(f"at {step} m")
            bar.update()
    assert 8 <= len(log.getvalue().splitlines()) <= 12


def test_bars_inside_bars_are_lines_too(monkeypatch):
    log = io.StringIO()
    monkeypatch.setattr("sys.stderr", log)
    for _ in progress_bar(range(2), unit=" file"):
        for _ in progress_bar(range(3), unit=" frame", leave=False):
            pass
    assert log.getvalue().replace("\n", "").isprintable()
    lines = log.getvalue().splitlines()
    assert all("file" in line or "frame" in line for line in lines)
    assert "2/2" in lines[-1]


def test_a_short_bar_that_does_not_stay_leaves_no_line(monkeypatch):
    log = io.StringIO()
    monkeypatch.setattr("sys.stderr", log)
    with progress_bar(total=3, leave=False) as bar:
        bar.update(3)
    assert log.getvalue() == ""


def test_a_bar_on_a_terminal_moves(monkeypatch):
    class Terminal(io.StringIO):
        def isatty(self):
            return True

    terminal = Terminal()
    monkeypatch.setattr("sys.stderr", terminal)
    with progress_bar(total=2) as bar:
        bar.update(2)
    assert "\r" in terminal.getvalue()


def test_a_headless_bar_is_silent(monkeypatch):
    log = io.StringIO()
    monkeypatch.setattr("sys.stderr", log)
    assert list(progress_bar(range(3), disable=True)) == [0, 1, 2]
    assert log.getvalue() == ""


def test_every_command_takes_its_bars_from_here():
    package = Path(jaxnav.__file__).parent
    users = [file.name for file in package.rglob("*.py") if "import tqdm" in file.read_text()]
    assert users == ["bars.py"]
