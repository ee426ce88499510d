"""Parse and check a study's config, its grid, trials and seed, before anything runs."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

from jaxnav.errors import BadInput
from jaxnav.experiments.studies.parameters import Parameter, Value

_KEYS = ("trials", "seed", "precision", "axes", "fixed", "rig", "markers", "vehicle")
_MAX_TRIALS = 2**31 - 1  # `fold_in` counts in 32 bits


@dataclass(frozen=True)
class Config:
    """A checked and complete study: every parameter is an axis or is fixed."""

    kind: str
    axes: Mapping[str, Sequence[Value]]  # in the order of the result's dimensions
    fixed: Mapping[str, Value]
    trials: int  # of every cell
    seed: int = 0
    precision: str = "float32"
    files: Mapping[str, str] = field(default_factory=dict)  # name -> digest of calibration files

    @staticmethod
    def parse(
        kind: str,
        parameters: Mapping[str, Parameter],
        data: Mapping[str, Any],
        where: object,
        files: Mapping[str, str] | None = None,
    ) -> "Config":
        """Parse and check a config file's content.

        Args:
            kind: the kind of study.
            parameters: the parameters that this kind can vary.
            data: the file's mapping.
            where: the file, for messages.
            files: name -> digest of the calibration files that the study uses.

        Raises:
            BadInput: one line naming file and key.
        """
        for key in data:
            if key not in _KEYS:
                raise BadInput(f"{where}: {key}", f"unknown key: expected {', '.join(_KEYS)}")
        given_axes, given_fixed = (_mapping(data, key, where) for key in ("axes", "fixed"))
        for section, given in (("axes", given_axes), ("fixed", given_fixed)):
            for name in given:
                if name not in parameters:
                    raise BadInput(
                        f"{where}: {section}.{name}",
                        f"unknown {'axis' if section == 'axes' else 'parameter'} of a study of "
                        f"kind {kind}: expected {', '.join(parameters)}",
                    )
        for name in given_fixed:
            if name in given_axes:
                raise BadInput(f"{where}: fixed.{name}", "is an axis as well")
        if not given_axes:
            raise BadInput(f"{where}: axes", "is an empty grid: name at least one axis")
        precision = data.get("precision", "float32")
        if precision not in ("float32", "float64"):
            raise BadInput(f"{where}: precision", f"must be float32 or float64, got {precision!r}")
        return Config(
            kind=kind,
            axes={
                name: parameters[name].values(given, f"{where}: axes.{name}")
                for name, given in given_axes.items()
            },
            fixed={
                name: parameter.check(given_fixed[name], f"{where}: fixed.{name}")
                if name in given_fixed
                else parameter.default
                for name, parameter in parameters.items()
                if name not in given_axes
            },
            trials=_whole(data, "trials", where, 1, _MAX_TRIALS),
            seed=_whole({"seed": 0} | dict(data), "seed", where, 0, _MAX_TRIALS),
            precision=precision,
            files=dict(files or {}),
        )

    def to_dict(self) -> dict[str, Any]:
        """The config as plain data, equal for equal studies."""
        return {
            "kind": self.kind,
            "axes": {name: list(values) for name, values in self.axes.items()},
            "fixed": dict(sorted(self.fixed.items())),
            "trials": self.trials,
            "seed": self.seed,
            "precision": self.precision,
            "files": dict(sorted(self.files.items())),
        }


def difference(wanted: Mapping[str, Any], other: Mapping[str, Any], prefix: str = "") -> list[str]:
    """The differences between two studies, as lines `key: here, there`."""
    differing = []
    for key in sorted(set(wanted) | set(other)):
        here, there = wanted.get(key), other.get(key)
        if here == there and type(here) is type(there):
            continue
        name = f"{prefix}{key}"
        if isinstance(here, Mapping) and isinstance(there, Mapping):
            differing += difference(here, there, f"{name}.") or [f"{name}: in another order"]
        else:
            differing.append(f"{name} is {_short(here)} here and {_short(there)} there")
    if not differing and list(wanted.get("axes", {})) != list(other.get("axes", {})):
        differing.append("axes are in another order")
    return differing


def _short(value: object) -> str:
    if value is None:
        return "nothing"
    text = str(value)
    return text if len(text) <= 60 else f"{text[:57]}..."


def _mapping(data: Mapping[str, Any], key: str, where: object) -> Mapping[str, Any]:
    value = data.get(key)
    if value is None:
        return {}
    if not isinstance(value, Mapping):
        raise BadInput(f"{where}: {key}", f"must be a mapping of names to values, got {value!r}")
    return value


def _whole(data: Mapping[str, Any], key: str, where: object, low: int, high: int) -> int:
    value = data.get(key)
    if value is None:
        raise BadInput(f"{where}: {key}", "missing")
    if isinstance(value, bool) or not isinstance(value, int) or not low <= value <= high:
        raise BadInput(
            f"{where}: {key}", f"must be a whole number from {low} to {high}, got {value!r}"
        )
    return value
