"""What a progress bar says while nothing moves."""

import io

from tqdm import tqdm

from jaxnav.commands.bars import update_after_compiling


def test_a_bar_says_compiling_until_something_moves():
    shown = io.StringIO()
    with tqdm(total=3, unit="drive", file=shown, mininterval=0, ascii=True) as bar:
        update = update_after_compiling(bar)
        assert "compiling" in shown.getvalue().split("\r")[-1]
        update(0)  # a chunk in which no drive has ended
        assert "compiling" not in shown.getvalue().split("\r")[-1]
        update(2)
        assert bar.n == 2
