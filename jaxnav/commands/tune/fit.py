"""A fit run by a command: a progress bar, the best parameters in a file, and a checkpoint."""

import dataclasses
import datetime
import io
import json
import struct
import zipfile
import zlib
from collections.abc import Callable, Collection, Mapping
from dataclasses import dataclass
from importlib.metadata import version
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeVar

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from jaxnav.commands.bars import progress_bar
from jaxnav.commands.report import write_report
from jaxnav.errors import EXIT_INTERRUPTED, BadInput, visible
from jaxnav.experiments.tuning.fit import Problem, TuningFit, arrays_of, fit_of, take_step
from jaxnav.experiments.tuning.unconstrained import Space
from jaxnav.files import write_params
from jaxnav.files.unpacking import read_npz
from jaxnav.files.writing import atomic_write, plain_data, sole_writer

if TYPE_CHECKING:
    from matplotlib.figure import Figure

Scores = TypeVar("Scores")

# Arguments on which a fit doesn't depend.
_OF_THE_REPORT = ("out", "headless", "test", "test_seeds")


def plain_key(command: str, args: Any) -> dict[str, Any]:
    """All that a result depends on, as plain values: command, arguments, versions."""
    settings = {
        name: plain_data(value)
        for name, value in dataclasses.asdict(args).items()
        if name not in _OF_THE_REPORT
    }
    versions = {name: version(name) for name in ("jaxnav", "jax", "optimistix", "optax")}
    return {"command": command} | settings | {"versions": versions}


def measure(value: tuple[float, float, float]) -> dict[str, Any]:
    """A mean with its interval, in the form of a summary."""
    return {"value": value[0], "interval": list(value[1:])}


# Exceptions of NumPy and zipfile for wrong bytes, such as a flag "encrypted" or an absurd length.
_DAMAGED = (
    KeyError, ValueError, TypeError, EOFError, OSError, RuntimeError, MemoryError, struct.error,
    zipfile.BadZipFile, zlib.error,
)  # fmt: skip


@dataclass(frozen=True)
class Fitting:
    """A fit that keeps its best parameters and a checkpoint in a folder.

    Attributes:
        folder: of params.yaml and checkpoint.npz.
        key: all that the result depends on, plain values; a checkpoint of another key is refused.
        prior_sigma: see `Objective`; it decides parameters on which no drive depends.
        named: parameters that a person asks for; one on which no drive depends is refused. None
            for all.
    """

    folder: Path
    key: dict[str, Any]
    problem: Problem
    space: Space
    prior_sigma: float = np.inf
    named: Collection[str] | None = None

    @property
    def checkpoint(self) -> Path:
        """The file that holds the state of the fit."""
        return self.folder / "checkpoint.npz"

    def run(self, headless: bool) -> TuningFit:
        """Run the fit to its end, from its checkpoint where there is one.

        Raises:
            BadInput: a checkpoint of another run or that another process is writing, or a
                parameter on which the loss doesn't depend.
            KeyboardInterrupt: the state reached is kept.
        """
        bars = progress_bar(total=self.problem.steps, unit="step", disable=headless)
        with sole_writer(self.checkpoint), bars as bar:
            bar.set_postfix_str("compiling")
            fit = TuningFit.begin(self.space.start, self.problem)
            kept = self._kept(fit)
            if kept is not None:
                fit = kept
                bar.clear()
                print(f"{self.checkpoint}: going on after step {fit.step}")
                bar.initial = bar.n = fit.step
                bar.refresh()
            while not fit.over:
                before, fit = fit, take_step(fit, self.problem)
                if fit.step == 1:
                    self._refuse_without_gradient(fit)
                if not bool(fit.descent.finite):
                    bar.clear()
                    print(self._where(before, fit.descent.asked_x))
                # Losses can't be compared here: another stage has other ones.
                if fit.step == 1 or bool(jnp.any(fit.best_x != before.best_x)):
                    self._write(fit)
                self._keep(fit)
                bar.set_postfix_str(f"held out {fit.history[-1][1]:.5g}, best {fit.best_loss:.5g}")
                bar.update(1)
        return fit

    def _write(self, fit: TuningFit) -> None:
        """Write the best parameters so far to params.yaml."""
        values = {name: np.asarray(value) for name, value in self.space.values(fit.best_x).items()}
        provenance = self.key | {
            "step": fit.step,
            "held_out_loss": {"before": float(fit.history[0][1]), "after": fit.best_loss},
            "date": datetime.datetime.now(datetime.UTC).date().isoformat(),
        }
        write_params(self.folder / "params.yaml", values, provenance)

    def _where(self, before: TuningFit, x: Array) -> str:
        """A message about a gradient at x that is not finite."""
        step = before.step
        softness = jnp.asarray(self.problem.softness(step), x.dtype)
        batch = self.problem.batch(before.stage_x, before.stage, step)
        place = self.problem.explain(x, batch, softness)
        if place is None:
            return f"step {step + 1}: the loss is not finite; not stepped on"
        return place.describe(self.space.labels, step + 1)

    def _refuse_without_gradient(self, fit: TuningFit) -> None:
        """Raise BadInput where the loss does not depend on a parameter at all."""
        batch = self.problem.batch(fit.stage_x, 0, 0)
        x, slope = self.space.start, fit.descent.gradient
        prior = x / self.prior_sigma**2 / batch.frames
        of_frames = np.asarray(slope - prior)
        tiny = 1e-6 * np.maximum(np.abs(np.asarray(prior)), 1e-12)
        labels = np.array(self.space.labels)
        for name in sorted(set(self.space.labels if self.named is None else self.named)):
            if np.all(np.abs(of_frames[labels == name]) <= tiny[labels == name]):
                raise BadInput("--train", f"the loss does not depend on {name}")

    def _keep(self, fit: TuningFit) -> None:
        buffer = io.BytesIO()
        np.savez(buffer, allow_pickle=False, run=json.dumps(self.key), **arrays_of(fit))
        atomic_write(self.checkpoint, buffer.getvalue())

    def _kept(self, like: TuningFit) -> TuningFit | None:
        if not self.checkpoint.exists():
            return None
        try:
            arrays = dict(read_npz(self.checkpoint))
            key = dict(json.loads(str(arrays.pop("run"))))
            other = [name for name in self.key | key if self.key.get(name) != key.get(name)]
            if not other:
                return fit_of(arrays, like)
        except _DAMAGED as error:
            problem = f"is damaged ({error}): delete it to begin anew"
            raise BadInput(self.checkpoint, problem) from None
        name = other[0]
        problem = f"whose {name} is {key.get(name)!r} and not {self.key.get(name)!r}"
        raise BadInput(self.checkpoint, f"is of another run, {problem}: choose another --out")


def run_fit(
    fitting: Fitting,
    headless: bool,
    *,
    before: Mapping[str, Float[Array, "..."]],
    test: Callable[[TuningFit], Mapping[str, tuple[Scores, Scores]]],
    as_json: Callable[[Scores], dict[str, Any]],
    draw: Callable[[TuningFit, Space, Mapping[str, tuple[Scores, Scores]]], "Figure"],
    text: Callable[[dict[str, Any]], list[str]],
) -> int:
    """Run a fit and its tests, write summary.json and report.png, and print the summary.

    Args:
        before: values of the parameters at the start, by name.
        test: scores before and after the fit, by the name of the test.
        text: the summary in lines.
    """
    folder, space = visible(fitting.folder), fitting.space
    try:
        fit = fitting.run(headless)
        results = test(fit)
    except KeyboardInterrupt:
        print(f"interrupted: the best so far is in {folder}; the same command goes on")
        return EXIT_INTERRUPTED
    values = {"before": before, "after": space.values(fit.best_x)}
    summary = {
        "run": fitting.key,
        "steps": fit.step,
        "stages": fit.stage + 1,
        "ended": fit.ended,
        "held_out_loss": {"before": float(fit.history[0][1]), "after": fit.best_loss},
        "parameters": {
            when: {name: np.asarray(value).tolist() for name, value in of.items()}
            for when, of in values.items()
        },
        "test": {
            name: {"before": as_json(was), "after": as_json(now)}
            for name, (was, now) in results.items()
        },
    }
    lines = [*text(summary), f"parameters and report in {folder}"]
    write_report(fitting.folder, summary, lines, report=draw(fit, space, results))
    return 0
