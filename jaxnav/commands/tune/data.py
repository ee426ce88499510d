"""Data to tune, stop and test a filter with: simulated drives, or recordings."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np

from jaxnav.commands.bars import progress_bar, update_after_compiling
from jaxnav.commands.reading import read_shown
from jaxnav.commands.simulate.scenario_car import ScenarioCar
from jaxnav.commands.tune.arguments import TuneFilter as Arguments
from jaxnav.commands.tune.sequences import (
    NamedSequences,
    join_sequences,
    navigator_of,
    sequences_of_drive,
    sequences_of_recording,
)
from jaxnav.core.filter.hypotheses import MultiHypothesis
from jaxnav.core.filter.selectors import make_selector
from jaxnav.core.navigator import Navigator
from jaxnav.errors import BadInput
from jaxnav.experiments.tuning.recorded import FrameSequences, simulate_sequences
from jaxnav.files import load_markers, load_rig
from jaxnav.recordings.drive_setup import DriveSetup
from jaxnav.recordings.other.recordings import read_recording
from jaxnav.sim.rollout import Rollout

AT_A_TIME = 64  # sequences in a batch, where nothing is to be differentiated
_TEST_SEED = 10**6
_HELD_OUT = 4  # one of this many sequences of a recording is held out
_DRIVE = ".mcap"

Progress = Callable[[int], object]


@dataclass(frozen=True)
class TuningTest:
    """Sequences that have no part in the tuning, and the navigator that goes with them."""

    name: str
    navigator: Navigator
    size: int  # how many there are
    recorded: Callable[[Progress], FrameSequences]


@dataclass(frozen=True)
class TuningData:
    """A navigator before tuning, and the sequences to learn from, to stop by and to test on."""

    navigator: Navigator
    learned: FrameSequences
    held_out: FrameSequences
    tests: tuple[TuningTest, ...]


def read_data(args: Arguments) -> TuningData:
    """Read all data before any work is done; simulated tests are driven only when called for.

    Raises:
        BadInput: names the file or the flag.
    """
    return _recorded(args) if args.recordings else _simulated(args)


def _simulated(args: Arguments) -> TuningData:
    car = ScenarioCar.load(args)
    scenario = car.scenario(args.scenario)
    # The drives are the same whichever estimator is tuned.
    driver = car.navigator(scenario, MultiHypothesis())
    noise_px = jnp.asarray(args.corner_noise_px)
    rollout = Rollout(driver, car.vehicle, car.markers, scenario, noise_px)

    def drive(first: int, count: int, progress: Progress) -> FrameSequences:
        keys = jax.vmap(jax.random.key)(first + jnp.arange(count))
        return simulate_sequences(rollout, keys, progress)

    count = args.seeds + args.held_out_seeds
    with progress_bar(
        total=count, unit="drive", desc="drive", disable=args.headless, leave=False
    ) as bar:
        known = drive(args.seed, count, update_after_compiling(bar))
    own = car.navigator(scenario, make_selector(args.selector))
    return TuningData(
        navigator=own,
        learned=known.rows(slice(0, args.seeds)),
        held_out=known.rows(slice(args.seeds, None)),
        tests=(
            TuningTest(
                f"{args.test_seeds} drives, {args.scenario}",
                own,
                args.test_seeds,
                lambda progress: drive(_TEST_SEED, args.test_seeds, progress),
            ),
        ),
    )


def _recorded(args: Arguments) -> TuningData:
    learned = [_sequences(args, path, args.part) for path in args.recordings]
    together = join_sequences(learned)
    rows = np.arange(len(together))
    held_out = rows % _HELD_OUT == _HELD_OUT - 1
    if not held_out.any():
        some = ", ".join(str(path) for path in args.recordings)
        problem = f"{len(together)} sequences: at least {_HELD_OUT} are needed, one to be held out"
        raise BadInput(some, problem)
    begin, end = args.part
    rest = [(0.0, begin)] * (begin > 0) + [(end, 1.0)] * (end < 1)
    tests = [(path, part) for path in args.recordings for part in rest]
    tests += [(path, (0.0, 1.0)) for path in args.test]
    return TuningData(
        navigator=learned[0].navigator,
        learned=together.rows(rows[~held_out]),
        held_out=together.rows(rows[held_out]),
        tests=tuple(_judging(args, tests)),
    )


def _judging(
    args: Arguments, tests: Sequence[tuple[Path, tuple[float, float]]]
) -> list[TuningTest]:
    """The tests with a known pose of the vehicle in some frame."""
    tuning_tests = []
    for path, part in tests:
        named = _sequences(args, path, part)
        if bool(jnp.any(named.recorded.judged)):
            name = named.name if part == (0.0, 1.0) else f"{named.name}, {part[0]:g} to {part[1]:g}"
            tuning_tests.append(
                TuningTest(name, named.navigator, len(named.recorded), _known(named.recorded))
            )
    return tuning_tests


def _known(recorded: FrameSequences) -> Callable[[Progress], FrameSequences]:
    return lambda progress: recorded


def _sequences(args: Arguments, path: Path, part: tuple[float, float]) -> NamedSequences:
    if path.suffix == _DRIVE:
        log = read_shown(path, args.headless)
        setup = DriveSetup.from_header(log.header, path)
        return NamedSequences(str(path), setup.navigator(), sequences_of_drive(log, setup, part))
    recording = read_recording(
        path,
        None if args.rig is None else load_rig(args.rig),
        None if args.markers is None else load_markers(args.markers),
    )
    navigator = navigator_of(recording, args.selector)
    return NamedSequences(str(path), navigator, sequences_of_recording(recording, part))
