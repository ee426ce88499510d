"""Validation of a tuned parameter's value: a number, a list of them, or a table or matrix as rows.

Every number must be positive, and a matrix a covariance: symmetric and positive definite. One that
only bounds what is believed may be infinite. The navigator decides how many entries there must be.
"""

import math
from typing import Any

import numpy as np
from jaxtyping import Float

from jaxnav.core.parameters import Tunable
from jaxnav.errors import BadInput
from jaxnav.files.validation import show_value

_LEAST, _MOST = 1e-18, 1e9  # bounds of a number, so that float32 holds its square
_MOST_ENTRIES = 64  # of a list, and rows of a matrix
# Bound for the matrix of correlations, whose entries float32 rounds by 6e-8.
_LEAST_EIGENVALUE = 1e-6
_SYMMETRY = 1e-6  # relative to the geometric mean of the two variances: what float32 leaves


def param_array(value: Any, where: str, tunable: Tunable) -> Float[np.ndarray, "..."]:
    """Check a parameter's numbers and return them unchanged as an array (), (d,) or (d, d).

    Args:
        value: plain, or an array.
        where: file and key, for the message.
        tunable: what the parameter may be.

    Raises:
        BadInput: the value is anything else; names its place in the list.
    """
    value = _plain(value)
    if tunable.guard and isinstance(value, float) and not math.isfinite(value):
        if value != math.inf:
            raise BadInput(where, f"must be > 0 and finite, or .inf for none, got {value}")
        return np.array(value)
    if not isinstance(value, list):
        return np.array(_at_most(_positive(value, where), where, *tunable.most[:1]))
    if not 1 <= len(value) <= _MOST_ENTRIES:
        bound = f"1 to {_MOST_ENTRIES}"
        raise BadInput(where, f"must have {bound} entries, got {len(value)}")
    if not any(isinstance(entry, list) for entry in value):
        return np.array(_entries(value, where, tunable))
    if tunable.rows:
        return np.array([_row(row, f"{where}[{i}]", tunable) for i, row in enumerate(value)])
    if tunable.matrix is None:
        raise BadInput(where, "can't be a matrix: it is a number, or a list of them")
    for i, row in enumerate(value):
        if not isinstance(row, list) or len(row) != len(value):
            got = f"{len(row)} numbers" if isinstance(row, list) else show_value(row)
            count = len(value)
            problem = f"must have {count} numbers, as the matrix has {count} rows, got {got}"
            raise BadInput(f"{where}[{i}]", problem)
    entries = [
        [_number(entry, f"{where}[{i}][{j}]", _MOST**2) for j, entry in enumerate(row)]
        for i, row in enumerate(value)
    ]
    return _covariance(np.array(entries), where)


def _row(value: Any, where: str, tunable: Tunable) -> list[float]:
    """A row of a table."""
    count = len(tunable.most)
    if not isinstance(value, list) or len(value) != count:
        got = f"{len(value)}" if isinstance(value, list) else show_value(value)
        raise BadInput(where, f"must have {count} numbers, got {got}")
    return _entries(value, where, tunable)


def _entries(value: list[Any], where: str, tunable: Tunable) -> list[float]:
    numbers = [_positive(entry, f"{where}[{i}]") for i, entry in enumerate(value)]
    for i, (number, most) in enumerate(zip(numbers, tunable.most, strict=False)):
        _at_most(number, f"{where}[{i}]", most)
    return numbers


def _at_most(number: float, where: str, most: float = math.inf) -> float:
    if number > most:
        raise BadInput(where, f"must be at most {most:g}, got {number:g}")
    return number


def _plain(value: Any) -> Any:
    if hasattr(value, "tolist"):
        value = value.tolist()
    return [_plain(entry) for entry in value] if isinstance(value, list | tuple) else value


def _number(value: Any, where: str, most: float) -> float:
    if isinstance(value, bool) or not isinstance(value, int | float):
        raise BadInput(where, f"must be a number, got {show_value(value)}")
    if isinstance(value, float) and not math.isfinite(value):
        raise BadInput(where, f"must be finite, got {value}")
    if not -most <= value <= most:
        raise BadInput(where, f"must be from {-most:g} to {most:g}, got {show_value(value)}")
    return float(value)


def _positive(value: Any, where: str) -> float:
    number = _number(value, where, _MOST)
    if number <= 0:
        raise BadInput(where, f"must be > 0, got {number:g}")
    if number < _LEAST:
        raise BadInput(where, f"must be at least {_LEAST:g}, got {number:g}")
    return number


def _covariance(matrix: np.ndarray, where: str) -> np.ndarray:
    variances = np.diagonal(matrix)
    for i, variance in enumerate(variances):
        if variance < _LEAST**2:
            problem = f"a variance must be at least {_LEAST**2:g}, got {variance:g}"
            raise BadInput(f"{where}[{i}][{i}]", problem)
    scale = np.sqrt(variances[:, None] * variances)
    apart = np.abs(matrix - matrix.T) / scale
    if apart.max() > _SYMMETRY:
        i, j = np.unravel_index(apart.argmax(), apart.shape)
        problem = f"must equal [{j}][{i}], {matrix[j, i]:g}, in a symmetric matrix"
        raise BadInput(f"{where}[{i}][{j}]", f"{problem}, got {matrix[i, j]:g}")
    least = np.linalg.eigvalsh((matrix + matrix.T) / 2 / scale).min()
    if least < _LEAST_EIGENVALUE:
        raise BadInput(
            where,
            f"must be positive definite: the least eigenvalue of its correlations is {least:.3g}, "
            f"and must be at least {_LEAST_EIGENVALUE:g}",
        )
    return matrix
