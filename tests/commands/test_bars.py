"""What a progress bar says while nothing moves."""

import io

from tqdm import tqdm

from jaxnav.commands.bars import drawn_on, update_after_compiling


def test_a_bar_says_compiling_until_something_moves():
    shown = io.StringIO()
    with tqdm(total=3, unit="drive", file=shown, mininterval=0, ascii=True) as bar:
        update = update_after_compiling(bar)
        assert "compiling" in shown.getvalue().split("\r")[-1]
        update(0)  # a chunk in which no drive has ended
        assert "compiling" not in shown.getvalue().split("\r")[-1]
        update(2)
        assert bar.n == 2


def test_a_bar_in_a_file_is_a_line_each_second():
    log = io.StringIO()
    with tqdm(total=400, **drawn_on(log)) as bar:
        for step in range(400):
            bar.set_postfix_str(f"at {step} m", refresh=False)
            bar.update()
    lines = log.getvalue().splitlines()
    assert 1 <= len(lines) <= 3
    assert "400/400" in lines[-1]
    assert "\r" not in log.getvalue()


def test_a_bar_on_a_terminal_moves():
    class Terminal(io.StringIO):
        def isatty(self):
            return True

    assert drawn_on(Terminal()) == {}
