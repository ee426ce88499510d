"""Define a study: what it can vary and what it measures, and the config of one.

A cell is one point of the grid; a study is a function of cells and trials to named variables.
"""

import abc
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, ClassVar

import numpy as np
from jaxtyping import Shaped

from jaxnav.errors import BadInput
from jaxnav.experiments.studies.parameters import Parameter, Value

Cell = Mapping[str, Value]  # parameter name -> value, for every parameter
Progress = Callable[[int], object]  # number of trials that have ended since the last call

_KEYS = ("trials", "seed", "precision", "axes", "fixed", "rig", "markers", "vehicle")
_MAX_TRIALS = 2**31 - 1  # `fold_in` counts in 32 bits


def nobody(ended: int) -> None:
    """Tell nobody of progress."""


@dataclass(frozen=True)
class Variable:
    """A quantity that is measured in every trial."""

    description: str
    unit: str = ""
    dtype: str = "float32"  # a missing value is NaN, or the largest int
    of_selector: bool = False  # measured once for each selector of that axis
    outcomes: tuple[str, ...] = ()  # meaning of an int8's numbers
    among: tuple[str, ...] = ()  # outcomes over which it is summarised; all by default


@dataclass(frozen=True)
class Rate:
    """A proportion: the trials with some outcomes among the trials with other outcomes."""

    description: str
    variable: str
    of: tuple[str, ...]
    among: tuple[str, ...]


@dataclass(frozen=True)
class Schema:
    """A kind of study: its parameters, variables and rates."""

    kind: str
    parameters: Mapping[str, Parameter]
    variables: Mapping[str, Variable]
    rates: Mapping[str, Rate]
    box_trials: int  # of a study, as a rule
    inner: tuple[str, ...] = ()  # axes over which every trial loops by itself
    predicted: str | None = None  # the variable that is the probability of `flip_rate`


@dataclass(frozen=True)
class Config:
    """A checked and complete study: every parameter is an axis or is fixed."""

    schema: Schema
    axes: Mapping[str, Sequence[Value]]  # in the order of the result's dimensions
    fixed: Mapping[str, Value]
    trials: int  # of every cell
    seed: int = 0
    precision: str = "float32"
    files: Mapping[str, str] = field(default_factory=dict)  # name -> digest of calibration files

    @staticmethod
    def parse(
        schema: Schema,
        data: Mapping[str, Any],
        where: object,
        files: Mapping[str, str] | None = None,
    ) -> "Config":
        """Parse and check a config file's content.

        Args:
            schema: the kind of study.
            data: the file's mapping.
            where: the file, for messages.
            files: name -> digest of the calibration files that the study uses.

        Raises:
            BadInput: one line naming file and key.
        """
        for key in data:
            if key not in _KEYS:
                raise BadInput(f"{where}: {key}", f"unknown key: expected {', '.join(_KEYS)}")
        known = schema.parameters
        axes, fixed = (_parameters(data, key, where, schema) for key in ("axes", "fixed"))
        for name in fixed:
            if name in axes:
                raise BadInput(f"{where}: fixed.{name}", "is an axis as well")
        if not axes:
            raise BadInput(f"{where}: axes", "is an empty grid: name at least one axis")
        precision = data.get("precision", "float32")
        if precision not in ("float32", "float64"):
            raise BadInput(f"{where}: precision", f"must be float32 or float64, got {precision!r}")
        return Config(
            schema,
            {name: known[name].values(v, f"{where}: axes.{name}") for name, v in axes.items()},
            {
                name: parameter.check(fixed[name], f"{where}: fixed.{name}")
                if name in fixed
                else parameter.default
                for name, parameter in known.items()
                if name not in axes
            },
            trials=_whole(data.get("trials"), f"{where}: trials", 1),
            seed=_whole(data.get("seed", 0), f"{where}: seed", 0),
            precision=precision,
            files=dict(files or {}),
        )

    def to_dict(self) -> dict[str, Any]:
        """The config as plain data, equal for equal studies."""
        return {
            "kind": self.schema.kind,
            "axes": {name: list(values) for name, values in self.axes.items()},
            "fixed": dict(sorted(self.fixed.items())),
            "trials": self.trials,
            "seed": self.seed,
            "precision": self.precision,
            "files": dict(sorted(self.files.items())),
        }

    @property
    def outer_axes(self) -> dict[str, Sequence[Value]]:
        """The axes other than the schema's `inner`."""
        return {n: v for n, v in self.axes.items() if n not in self.schema.inner}

    @property
    def shape(self) -> tuple[int, ...]:
        """The lengths of the outer axes, and the trials."""
        return (*map(len, self.outer_axes.values()), self.trials)

    def sizes(self, variable: Variable) -> dict[str, int]:
        """A variable's dimensions: name -> length."""
        inner = self.schema.inner if variable.of_selector else ()
        names = (*self.outer_axes, *(n for n in inner if n in self.axes))
        return {name: len(self.axes[name]) for name in names} | {"trial": self.trials}

    def cell(self, index: Sequence[int]) -> Cell:
        """The cell at an index of the outer axes."""
        axes = self.outer_axes.items()
        varied = {name: values[i] for (name, values), i in zip(axes, index, strict=True)}
        return {**self.fixed, **varied}


class Study(abc.ABC):
    """A study, any part of which can be run. It can be pickled and holds no device arrays."""

    schema: ClassVar[Schema]

    def __init__(self, config: Config):
        self.config = config

    @property
    def box_trials(self) -> int:
        """The default number of trials that are run and written together."""
        return self.schema.box_trials

    @abc.abstractmethod
    def run(
        self, cells: Sequence[Cell], trials: range, progress: Progress = nobody
    ) -> dict[str, Shaped[np.ndarray, "cells ... trials"]]:
        """Run trials of cells: variables (cells, trials) or (cells, selectors, trials). A trial's
        bits depend on its cell and its number alone.

        Args:
            progress: called with the number of trials that have ended since the last call, if they
                end one after the other.
        """


def _parameters(
    data: Mapping[str, Any], section: str, where: object, schema: Schema
) -> Mapping[str, Any]:
    given = data.get(section)
    if given is None:
        return {}
    if not isinstance(given, Mapping):
        raise BadInput(
            f"{where}: {section}", f"must be a mapping of names to values, got {given!r}"
        )
    for name in given:
        if name not in schema.parameters:
            raise BadInput(
                f"{where}: {section}.{name}",
                f"unknown {'axis' if section == 'axes' else 'parameter'} of a study of kind "
                f"{schema.kind}: expected {', '.join(schema.parameters)}",
            )
    return given


def _whole(value: Any, where: str, low: int) -> int:
    if value is None:
        raise BadInput(where, "missing")
    if type(value) is not int or not low <= value <= _MAX_TRIALS:
        raise BadInput(where, f"must be a whole number from {low} to {_MAX_TRIALS}, got {value!r}")
    return value
