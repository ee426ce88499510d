"""Data to tune, stop and test a filter with: simulated drives, or recordings as sequences of equal
length: cut, padded, and stacked."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import jaxlie
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from jaxnav.commands.bars import progress_bar, update_after_compiling
from jaxnav.commands.reading import given_files, read_shown
from jaxnav.commands.simulate.arguments import TuneFilter as Arguments
from jaxnav.commands.simulate.simulate import ScenarioCar
from jaxnav.core.filter.free import ConstantVelocity
from jaxnav.core.filter.hypotheses import MultiHypothesis
from jaxnav.core.filter.selectors import make_selector
from jaxnav.core.models.markers import MarkerMap
from jaxnav.core.models.origin import opposite, poses_in_world
from jaxnav.core.navigator import Navigator
from jaxnav.core.pose.observation import Observation
from jaxnav.errors import BadInput
from jaxnav.experiments.tuning.recorded import FrameSequences, simulate_sequences
from jaxnav.recordings.drive_events import DriveEvents, refused_odometry
from jaxnav.recordings.drive_log import DriveLog
from jaxnav.recordings.drive_setup import DriveSetup
from jaxnav.recordings.other.recording import Recording
from jaxnav.recordings.other.recordings import read_recording
from jaxnav.recordings.other.replay import estimate_corner_sigma_px
from jaxnav.sim.rollout import Rollout

_TEST_SEED = 10**6
_HELD_OUT = 4  # one of this many sequences of a recording is held out
_DRIVE = ".mcap"
LEAST_SEQUENCES = 4
GAP_S = 0.5  # a marker that was away for longer appears anew
_IDENTITY = (1.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0)  # wxyz xyz

Progress = Callable[[int], object]


class NamedSequences(NamedTuple):
    """The sequences of a recording, with its file's name and the navigator that goes with them."""

    name: str
    navigator: Navigator
    recorded: FrameSequences


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
            size, known = len(named.recorded), partial(_known, named.recorded)
            tuning_tests.append(TuningTest(name, named.navigator, size, known))
    return tuning_tests


def _known(recorded: FrameSequences, progress: Progress) -> FrameSequences:
    return recorded


def _sequences(args: Arguments, path: Path, part: tuple[float, float]) -> NamedSequences:
    if path.suffix == _DRIVE:
        log = read_shown(path, args.headless)
        setup = DriveSetup.from_header(log.header, path)
        return NamedSequences(str(path), setup.navigator(), sequences_of_drive(log, setup, part))
    given = given_files(args, ("rig", "markers"))
    recording = read_recording(path, given.get("rig"), given.get("markers"))
    navigator = navigator_of(recording, args.selector)
    return NamedSequences(str(path), navigator, sequences_of_recording(recording, part))


# --- sequences -----------------------------------------------------------------------------


def sequences_of_drive(
    log: DriveLog, setup: DriveSetup, part: tuple[float, float], length: int = 400
) -> FrameSequences:
    """Sequences of a drive. The vehicle's true pose is unknown, so that no frame is judged.

    Odometry that the pilot refused on the way is left out.

    Args:
        setup: its `navigator()` goes with the sequences.
        part: which of the events, as shares of them: (0, 0.5) is the first half.
        length: events of a sequence, at most.

    Raises:
        BadInput: a frame of a camera that the rig does not have, or no marker is in view.
    """
    events = DriveEvents.from_inputs(log.inputs, setup, log.path, refused_odometry(log))
    begin, end = _bounds(len(events), part)
    if not np.any(events.obs.visible[begin:end]):
        problem = f"{end - begin} of its {len(events)} events, and none shows a marker of the map"
        raise BadInput(log.path, problem)
    indices, used = _side_by_side(_cut(np.arange(begin, end), length))
    obs: Any = jax.tree.map(lambda leaf: jnp.asarray(leaf[indices]), events.obs)
    shown = obs.visible & used[..., None, None]
    of_used = shown, obs.has_odometry & used, jnp.where(used, obs.dt_s, 0).at[:, 0].set(0)
    obs = eqx.tree_at(lambda o: (o.visible, o.has_odometry, o.dt_s), obs, of_used)
    return FrameSequences(
        markers=_maps(setup.markers, np.tile(np.arange(len(setup.markers.ids)), (len(used), 1))),
        obs=obs,
        used=jnp.asarray(used),
        T_world_vehicle_true=jnp.asarray(np.tile(_IDENTITY, (*used.shape, 1)), float),
        judged=jnp.zeros(used.shape, bool),
    )


def navigator_of(
    recording: Recording, selector: str, corner_sigma_px: float | None = None
) -> Navigator:
    """The navigator that localises the rig of a recording by its `sequences_of_recording`.

    Args:
        selector: one of `SELECTORS`.
        corner_sigma_px: by default estimated from the recording itself.
    """
    if corner_sigma_px is None:
        corner_sigma_px = estimate_corner_sigma_px(recording)
    return Navigator(
        rig=recording.rig,
        markers=jax.tree.map(lambda leaf: leaf[0], _maps(recording.markers, np.zeros((1, 1), int))),
        selector=make_selector(selector),
        motion=ConstantVelocity(),
        corner_sigma_px=corner_sigma_px,
    )


def sequences_of_recording(
    recording: Recording, part: tuple[float, float], length: int = 64, shortest: int = 10
) -> FrameSequences:
    """Appearances of the markers of a recording, each as if that marker were the only one.

    An appearance has the frames that show the marker. It ends at a gap of more than `GAP_S`, and is
    cut in equal pieces where it is too long. Judged is where the reference knows the pose.

    Args:
        part: which of the frames, as shares of them: (0, 0.5) is the first half.
        length: frames of a sequence, at most.
        shortest: sequences of fewer frames are left out.

    Raises:
        BadInput: there are fewer than `LEAST_SEQUENCES`.
    """
    begin, end = _bounds(len(recording), part)
    markers, pieces = [], []
    for marker, seen in enumerate(recording.seen[begin:end].T):
        frames = begin + np.flatnonzero(seen)
        apart_s = np.diff(recording.stamps_ns[frames]) / 1e9
        for appearance in np.split(frames, np.flatnonzero(apart_s > GAP_S) + 1):
            for piece in _cut(appearance, length):
                if len(piece) >= shortest:
                    markers.append(marker)
                    pieces.append(piece)
    if len(pieces) < LEAST_SEQUENCES:
        raise BadInput(
            recording.name,
            f"{end - begin} of its {len(recording)} frames give {len(pieces)} sequences of "
            f"{shortest} frames or more of one marker without a gap: at least {LEAST_SEQUENCES} "
            "are needed",
        )
    return _stacked(recording, markers, pieces)


def _stacked(
    recording: Recording, markers: Sequence[int], pieces: Sequence[np.ndarray]
) -> FrameSequences:
    """Pieces of a recording as sequences side by side, each with its only marker."""
    frames, used = _side_by_side(pieces)
    # Piece by piece, so that all markers but one of a large map are dropped at once.
    alone = [
        [lanes[:, :, [marker]] for lanes in recording.lanes(piece)]
        for piece, marker in zip(frames, markers, strict=True)
    ]
    corners_px, visible = (np.stack(rows) for rows in zip(*alone, strict=True))
    visible = visible & used[:, :, None, None]
    stamps_ns = recording.stamps_ns[frames]
    fields = {
        "corners_px": np.where(visible[..., None, None], corners_px, 0.0),
        "dt_s": np.diff(stamps_ns, axis=1, prepend=stamps_ns[:, :1]) / 1e9,
    }
    if recording.odometry is not None:
        fields["twist"] = np.array([recording.odometry.twists(piece) for piece in stamps_ns])
    truth, judged = np.array(_IDENTITY), np.zeros(frames.shape, bool)
    if (reference := recording.reference) is not None:
        known = reference.valid[frames]
        judged = used & known & visible.any(axis=(2, 3))
        Ts = poses_in_world(reference.T_world_vehicle[frames], opposite(recording.markers.origin_m))
        truth = np.where(known[..., None], Ts, truth)
    observed: Any = jax.vmap(jax.vmap(lambda fields: Observation(**fields)))
    return FrameSequences(
        markers=_maps(recording.markers, np.array(markers)[:, None]),
        obs=observed(
            {name: jnp.asarray(value, float) for name, value in fields.items()}
            | {"visible": jnp.asarray(visible), "has_odometry": jnp.zeros(frames.shape, bool)}
        ),
        used=jnp.asarray(used),
        T_world_vehicle_true=jnp.broadcast_to(jnp.asarray(truth, float), (*frames.shape, 7)),
        judged=jnp.asarray(judged),
    )


def _bounds(count: int, part: tuple[float, float]) -> tuple[int, int]:
    """The first row and the end of a part of `count` rows; adjoining parts share no row."""
    begin, end = (round(share * count) for share in part)
    return begin, end


def _cut(indices: Int[np.ndarray, " N"], length: int) -> list[Int[np.ndarray, " T"]]:
    """The fewest pieces of at most `length` indices, whose lengths differ by one at most."""
    return np.array_split(indices, max(1, -(-len(indices) // length)))


def _side_by_side(
    pieces: Sequence[Int[np.ndarray, " N"]],
) -> tuple[Int[np.ndarray, "B T"], Bool[np.ndarray, "B T"]]:
    """Pieces padded to the longest with their last index, and a mask that is False at padding."""
    lengths = np.array([len(piece) for piece in pieces])
    longest = int(lengths.max())
    indices = [np.pad(piece, (0, longest - len(piece)), mode="edge") for piece in pieces]
    return np.array(indices), np.arange(longest) < lengths[:, None]


def _maps(markers: MarkerMap, rows: Int[np.ndarray, "B N"]) -> MarkerMap:
    """A map for each of B sequences, of N markers; ids are dummies, which no estimate uses."""

    def some(wxyz_xyz: Float[Array, "N 7"], size_m: Float[Array, " N"]) -> MarkerMap:
        ids = tuple(range(len(size_m)))
        return MarkerMap(jaxlie.SE3(wxyz_xyz), size_m, ids, families=("",) * len(ids))

    stack: MarkerMap = jax.vmap(some)(markers.Ts_world_marker.wxyz_xyz[rows], markers.size_m[rows])
    return stack


def join_sequences(recordings: Sequence[NamedSequences]) -> FrameSequences:
    """The sequences of all recordings, padded to the longest.

    Raises:
        BadInput: names two recordings that one estimator can't take together.
    """
    first = recordings[0]
    for other in recordings[1:]:
        if problem := _apart(first, other):
            raise BadInput(f"{first.name}, {other.name}", problem)
    return FrameSequences.concatenate([named.recorded for named in recordings])


def _apart(one: NamedSequences, other: NamedSequences) -> str | None:
    """The reason why one estimator can't take two recordings together; None without one."""
    lanes, lanes_other = (named.recorded.obs.visible.shape[2:] for named in (one, other))
    for what, here, there in zip(("cameras", "markers"), lanes, lanes_other, strict=True):
        if here != there:
            return f"must have as many {what} to be tuned on together, got {here} and {there}"
    with_twist = [named.recorded.obs.twist is not None for named in (one, other)]
    if with_twist[0] != with_twist[1]:
        return "must both have odometry, or neither, to be tuned on together"
    # Trees of the same structure, whatever their leaves hold.
    if not eqx.tree_equal(*(jax.tree.map(lambda _: 0, of.recorded) for of in (one, other))):
        return "must be of one kind to be tuned on together, drives or recordings of a rig"
    navigators = one.navigator, other.navigator
    # The parts on which poses depend; image sizes may be guesses from the corners seen.
    rigs = ((of.rig.cameras, of.rig.Ts_camera_vehicle) for of in navigators)
    vehicles = (getattr(of.motion, "vehicle", None) for of in navigators)
    for what, parts in (("rig", rigs), ("vehicle", vehicles)):
        if not eqx.tree_equal(*parts, rtol=1e-6, atol=1e-6):
            return f"must have the same {what} to be tuned on together; --{what} gives them one"
    return None
