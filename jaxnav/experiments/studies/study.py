"""Define the interface of all kinds of study: cells times trials in, named variables out."""

import abc
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import ClassVar

import numpy as np
from jaxtyping import Shaped

from jaxnav.experiments.studies.config import Config
from jaxnav.experiments.studies.parameters import Parameter, Value

Cell = Mapping[str, Value]  # parameter name -> value, for every parameter
Progress = Callable[[int], object]  # number of trials that have ended since the last call


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
class Grid:
    """The labelled grid of one study."""

    schema: Schema
    config: Config

    @property
    def outer_axes(self) -> dict[str, Sequence[Value]]:
        """The axes other than `inner`."""
        return {n: v for n, v in self.config.axes.items() if n not in self.schema.inner}

    def dimensions(self, variable: Variable) -> tuple[str, ...]:
        """The names of a variable's dimensions."""
        inner = self.schema.inner if variable.of_selector else ()
        return (*self.outer_axes, *(n for n in inner if n in self.config.axes), "trial")

    def cell(self, index: Sequence[int]) -> Cell:
        """The cell at an index of the outer axes."""
        axes = self.outer_axes.items()
        varied = {name: values[i] for (name, values), i in zip(axes, index, strict=True)}
        return {**self.config.fixed, **varied}


class Study(abc.ABC):
    """A study, any part of which can be run. It can be pickled and holds no device arrays."""

    schema: ClassVar[Schema]

    def __init__(self, config: Config):
        self.grid = Grid(self.schema, config)

    @property
    def config(self) -> Config:
        """The config that defines the study."""
        return self.grid.config

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
