"""What a person gets where a file is no good."""

from collections.abc import Callable
from typing import Any

import pytest

from jaxnav.errors import BadInput


def problem(call: Callable[..., Any], *args: Any) -> str:
    """The one line."""
    with pytest.raises(BadInput) as caught:
        call(*args)
    line = str(caught.value)
    assert "\n" not in line
    return line
