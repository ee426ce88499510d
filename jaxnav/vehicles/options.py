"""Parse the values of `--option KEY=VALUE`, and report wrong ones to a person."""

import math
from collections.abc import Mapping, Sequence

from jaxnav.errors import BadInput


def number(
    options: Mapping[str, str], key: str, default: float, least: float, most: float
) -> float:
    """A number from the options, or the default.

    Raises:
        BadInput: no number, or not within [least, most].
    """
    if key not in options:
        return default
    text = options[key]
    try:
        value = float(text)
    except ValueError:
        value = math.nan
    if not least <= value <= most:
        raise BadInput(
            f"--option {key}", f"expected a number from {least:g} to {most:g}, got {text!r}"
        )
    return value


def whole_number(options: Mapping[str, str], key: str, default: int, least: int, most: int) -> int:
    """A whole number from the options, or the default.

    Raises:
        BadInput: no whole number, or not within [least, most].
    """
    value = number(options, key, default, least, most)
    if value != int(value):
        raise BadInput(f"--option {key}", f"expected a whole number, got {options[key]!r}")
    return int(value)


def choice(options: Mapping[str, str], key: str, known: tuple[str, ...]) -> str:
    """One of several words from the options; by default the first.

    Raises:
        BadInput: another word.
    """
    value = options.get(key, known[0])
    if value not in known:
        raise BadInput(f"--option {key}", f"expected {' or '.join(known)}, got {value!r}")
    return value


def switch(options: Mapping[str, str], key: str) -> bool:
    """An option that is `true`, or `false` as it is by default.

    Raises:
        BadInput: another word.
    """
    return choice(options, key, ("false", "true")) == "true"


def by_camera(options: Mapping[str, str], prefix: str, names: Sequence[str]) -> dict[str, str]:
    """The values of the options `prefix` + camera, by the camera's name.

    Args:
        names: of the rig's cameras.

    Raises:
        BadInput: the rig has no such camera.
    """
    values = {key.removeprefix(prefix): options[key] for key in options if key.startswith(prefix)}
    for name in values:
        if name not in names:
            problem = f"the rig has no such camera: expected {', '.join(names)}"
            raise BadInput(f"--option {prefix}{name}", problem)
    return values


def latency_ns(options: Mapping[str, str]) -> int:
    """`latency_ms`: from the middle of the exposure until the driver hands the picture over.

    Raises:
        BadInput: no number, or not within [0, 1000].
    """
    return int(number(options, "latency_ms", 0.0, 0.0, 1000.0) * 1e6)
