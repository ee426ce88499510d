"""Reading and writing tuned parameters of a navigator in YAML.

    parameters:
      motion.acceleration_density: [0.01, 0.01, 0.09]   # a number, a list, or a matrix as its rows
      controller.proportional_per_m: 0.05
    provenance:                                         # where they come from; may be left out
      command: jaxnav tune drive.mcap
      loss: 0.12

`jaxnav.core.parameters.TUNABLES` has the names, units and meanings. Parameters that are not named
stay as they are: so a number that is infinite in a navigator is left out. Only `motion.gate_nis`
may be `.inf`, which is no gate. The provenance is kept and shown, and decides nothing.
"""

import json
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from difflib import get_close_matches
from pathlib import Path
from textwrap import indent
from typing import Annotated, Any

import jax.numpy as jnp
import numpy as np
from jaxtyping import Float
from pydantic import Field

from jaxnav.core.navigator import Navigator
from jaxnav.core.parameters import TUNABLES, Tunable, allowed_shapes, parameters_of, with_parameters
from jaxnav.errors import BadInput
from jaxnav.files.validation import Entry, at, read, show_value, validate
from jaxnav.files.writing import atomic_write, plain_data, yaml_text

_LONGEST_SHOWN = 300  # characters of a provenance in a line
_LEAST, _MOST = 1e-18, 1e9  # bounds of a number, so that float32 holds its square
_MOST_ENTRIES = 64  # of a list, and rows of a matrix
# Bound for the matrix of correlations, whose entries float32 rounds by 6e-8.
_LEAST_EIGENVALUE = 1e-6
_SYMMETRY = 1e-6  # relative to the geometric mean of the two variances: what float32 leaves


class ParamsFile(Entry):
    """A file of tuned parameters, whose values `Params.from_values` checks."""

    parameters: Annotated[dict[str, Any], Field(min_length=1)]
    provenance: dict[str, Any] = Field(default_factory=dict)


@dataclass(frozen=True, eq=False)
class Params:
    """Tuned parameters, each of which is valid by itself.

    Attributes:
        values: name -> float64, (), (d,) or (d, d), in the order of the file.
        provenance: plain values.
        path: the file, for messages.
        prefix: the key in the file that holds `parameters`; empty where none does.
    """

    values: dict[str, Float[np.ndarray, "..."]]
    provenance: dict[str, Any]
    path: Path
    prefix: str = field(default="", kw_only=True)

    @staticmethod
    def from_values(
        values: Mapping[str, Any],
        path: str | Path,
        provenance: Mapping[str, Any] | None = None,
        prefix: str = "",
    ) -> "Params":
        """Check the values, and make parameters of them.

        Args:
            values: name -> number, or nested lists or an array of numbers.
            path, prefix: their place, for messages.

        Raises:
            BadInput: an unknown name, or a value that no parameter can have; names file and key.
        """
        params = Params({}, dict(provenance or {}), Path(path), prefix=prefix)
        for name, value in values.items():
            where = params.where(name)
            if name not in TUNABLES:
                nearest = ", ".join(get_close_matches(name, TUNABLES, cutoff=0))
                problem = f"unknown: of {len(TUNABLES)} names the nearest are {nearest}"
                raise BadInput(where, problem)
            params.values[name] = _array(value, where, TUNABLES[name])
        return params

    def where(self, name: str) -> str:
        """File and key of a parameter."""
        return at(self.path, self.prefix, "parameters", name)

    def without(self, name: str) -> "Params":
        """All parameters but one, which something else determines."""
        values = {other: value for other, value in self.values.items() if other != name}
        return replace(self, values=values)

    def plain(self) -> dict[str, Any]:
        """The values as plain numbers and lists, bit for bit: `from_values` makes the same."""
        return {name: value.tolist() for name, value in self.values.items()}

    def describe(self) -> str:
        """One line for a person: the file, how many there are, and where they come from."""
        # As JSON, for a terminal obeys some of the characters that a file may hold.
        origin = "; ".join(
            f"{json.dumps(key)[1:-1]}: {json.dumps(value)}"
            for key, value in self.provenance.items()
        )
        if len(origin) > _LONGEST_SHOWN:
            origin = f"{origin[:_LONGEST_SHOWN]}..."
        count = f"{len(self.values)} parameter{'s' if len(self.values) > 1 else ''}"
        return f"{count} from {self.path}" + (f" ({origin})" if origin else "")


def load_params(path: str | Path) -> Params:
    """Read tuned parameters, and check each by itself; `apply_params` checks that they fit.

    Raises:
        BadInput: one line naming file and key.
    """
    entry = read(path, ParamsFile)
    return Params.from_values(entry.parameters, path, entry.provenance)


def write_params(
    path: str | Path, values: Mapping[str, Any], provenance: Mapping[str, Any] | None = None
) -> None:
    """Write tuned parameters; `load_params` gives back the same numbers, bit for bit.

    Args:
        path: must not end in .json.
        values: name -> number, nested lists or array; written in the order of `TUNABLES`.
        provenance: texts, numbers, lists and mappings by texts; a number that is not finite is
            written as null.

    Raises:
        BadInput: the file can't be written, or `load_params` could not read it.
    """
    path = Path(path)
    if path.suffix.lower() == ".json":
        raise BadInput(path, "must not be called .json: it is written as YAML")
    params = Params.from_values(values, path, plain_data(dict(provenance or {})))
    plain = params.plain()
    validate(ParamsFile, {"parameters": plain}, path)
    text = "parameters:\n"
    for name, tunable in TUNABLES.items():
        if name in plain:
            comment = f"# {tunable.meaning} [{tunable.unit}]\n"
            text += indent(comment + yaml_text({name: plain[name]}), "  ")
    if params.provenance:
        text += yaml_text({"provenance": params.provenance})
    atomic_write(path, text)


def apply_params(navigator: Navigator, params: Params) -> Navigator:
    """The navigator with these parameters; all others stay as they are.

    One file serves the car, a simulation of it and every selector, so these are passed over:
    `controller.*` where nothing is driven, `selector.*` and `repeated_errors.*` that this selector
    does not have, the gate where the navigator has none, and how far off cameras and sensors may be
    where they are exact.
    Another `motion.*` that the motion model does not have is of another body, and an error.

    Raises:
        BadInput: a parameter that this navigator does not have, or not in this shape; names file
            and key.
    """
    known = parameters_of(navigator)
    values = {}
    for name, value in params.values.items():
        if name in known:
            shapes = allowed_shapes(name, known[name].shape)
            if value.shape not in shapes:
                expected = " or ".join(_counted(shape) for shape in shapes)
                verb = "have" if known[name].ndim else "be"
                problem = f"must {verb} {expected}, got {_counted(value.shape)}"
                raise BadInput(params.where(name), problem)
            if TUNABLES[name].guard and not np.isfinite(known[name]):
                continue
            values[name] = jnp.asarray(value, known[name].dtype)
        elif not _is_passed_over(name, navigator):
            model = type(navigator.motion).__name__
            problem = f"this navigator has no such number (its motion model is {model})"
            raise BadInput(params.where(name), f"{problem}: expected one of {', '.join(known)}")
    return with_parameters(navigator, values)


def _is_passed_over(name: str, navigator: Navigator) -> bool:
    part = name.partition(".")[0]
    if part == "controller":
        return navigator.controller is None
    is_prior = part == "rig" or (part == "motion" and hasattr(navigator.motion, "vehicle"))
    return part in ("selector", "repeated_errors") or (is_prior and bool(TUNABLES[name].most))


def _counted(shape: tuple[int, ...]) -> str:
    if not shape:
        return "a number"
    if len(shape) == 1:
        return f"{shape[0]} entries" if shape[0] != 1 else "1 entry"
    return f"{shape[0]} rows of {shape[1]}"


def _array(value: Any, where: str, tunable: Tunable) -> Float[np.ndarray, "..."]:
    """A parameter's numbers, checked: positive, and a matrix a covariance. One that only bounds
    what is believed may be infinite. The navigator decides how many entries there must be."""
    value = _plain(value)
    if tunable.guard and isinstance(value, float) and not math.isfinite(value):
        if value != math.inf:
            raise BadInput(where, f"must be > 0 and finite, or .inf for none, got {value}")
        return np.array(value)
    if not isinstance(value, list):
        return np.array(_positive(value, where, *tunable.most[:1]))
    if not 1 <= len(value) <= _MOST_ENTRIES:
        raise BadInput(where, f"must have 1 to {_MOST_ENTRIES} entries, got {len(value)}")
    if not any(isinstance(entry, list) for entry in value):
        return np.array(_positives(value, where, tunable.most))
    if not tunable.rows and tunable.matrix is None:
        raise BadInput(where, "can't be a matrix: it is a number, or a list of them")
    count = len(tunable.most) if tunable.rows else len(value)
    for i, row in enumerate(value):
        if not isinstance(row, list) or len(row) != count:
            got = f"{len(row)} numbers" if isinstance(row, list) else show_value(row)
            because = "" if tunable.rows else f", as the matrix has {count} rows"
            raise BadInput(f"{where}[{i}]", f"must have {count} numbers{because}, got {got}")
    if tunable.rows:
        return np.array(
            [_positives(row, f"{where}[{i}]", tunable.most) for i, row in enumerate(value)]
        )
    return _covariance(
        np.array(
            [
                [_number(entry, f"{where}[{i}][{j}]", _MOST**2) for j, entry in enumerate(row)]
                for i, row in enumerate(value)
            ]
        ),
        where,
    )


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


def _positive(value: Any, where: str, most: float = math.inf) -> float:
    number = _number(value, where, _MOST)
    if number < _LEAST:
        bound = "> 0" if number <= 0 else f"at least {_LEAST:g}"
        raise BadInput(where, f"must be {bound}, got {number:g}")
    if number > most:
        raise BadInput(where, f"must be at most {most:g}, got {number:g}")
    return number


def _positives(values: list[Any], where: str, most: Sequence[float]) -> list[float]:
    bounds = [*most, *[math.inf] * len(values)]
    return [_positive(value, f"{where}[{i}]", bounds[i]) for i, value in enumerate(values)]


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
