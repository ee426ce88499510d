"""What a progress bar shows while nothing moves."""

from collections.abc import Callable
from typing import Any

from tqdm import tqdm


def update_after_compiling(bar: "tqdm[Any]") -> Callable[[float], None]:
    """`bar.update`, with `compiling` beside the bar until its first call."""
    bar.set_postfix_str("compiling")

    def update(count: float) -> None:
        if bar.postfix:
            bar.set_postfix_str("")
        bar.update(count)

    return update
