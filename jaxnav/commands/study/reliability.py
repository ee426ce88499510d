"""`jaxnav reliability`: compare flip probabilities with observed flips in a diagram."""

from typing import Any

import numpy as np

from jaxnav.commands.bars import progress_bar
from jaxnav.commands.process import configure_jax
from jaxnav.commands.report import write_report
from jaxnav.commands.simulate.arguments import StudyReliability as Arguments
from jaxnav.core.filter.selectors import make_selector
from jaxnav.errors import BadInput, visible
from jaxnav.files import output_folder
from jaxnav.pictures.localisation import reliability_diagram
from jaxnav.recordings.other.recordings import read_recording
from jaxnav.recordings.other.replay import replay
from jaxnav.sim.random_views import random_views
from jaxnav.sim.statistics import Reliability


def run(args: Arguments) -> int:
    """Compute flip probabilities, compare them with the truth, write a diagram and a summary."""
    configure_jax(float64=True)
    name, probability, flipped = _simulated(args) if args.recording is None else _recorded(args)
    if not len(probability):
        raise BadInput(args.recording or "--frames", "gave no frame with two poses to choose from")
    out = output_folder(args.out)
    reliability = Reliability.from_predictions(probability, flipped)
    summary: dict[str, Any] = {
        "frames": name,
        "pairs": len(probability),
        "flipped_fraction": float(np.mean(flipped)),
        "expected_calibration_error": reliability.expected_calibration_error,
        "bins": {
            "predicted": reliability.predicted.tolist(),
            "observed": reliability.observed.tolist(),
            "counts": reliability.counts.tolist(),
        },
    }
    text = (
        f"{name}: {summary['pairs']} pairs, {summary['flipped_fraction']:.2%} flipped, "
        f"expected calibration error {reliability.expected_calibration_error:.4f}"
    )
    curve = reliability.predicted, reliability.observed, *reliability.intervals, reliability.counts
    diagram = reliability_diagram({"observed": curve}, title=text)
    write_report(out, summary, [text, f"diagram in {visible(out)}"], reliability=diagram)
    return 0


def _simulated(args: Arguments) -> tuple[str, np.ndarray, np.ndarray]:
    """Name, probabilities (N,) by the image alone and flips (N,) of pairs, on random views."""
    with progress_bar(total=args.frames, unit="frame", disable=args.headless) as bar:
        frames = random_views(args.frames, args.seed, progress=bar.update)
    pair = np.asarray(frames.pair)
    return (
        "random views",
        np.asarray(frames.flip_probability)[pair],
        np.asarray(frames.flipped)[pair],
    )


def _recorded(args: Arguments) -> tuple[str, np.ndarray, np.ndarray]:
    """Name, probabilities (N,) by a selector and flips (N,); each marker of a recording alone."""
    assert args.recording is not None
    recording = read_recording(args.recording, None, None)
    if recording.reference is None:
        raise BadInput(args.recording, "has no reference trajectory to tell the true pose")
    with progress_bar(total=len(recording), unit="frame", disable=args.headless) as bar:
        result = replay(
            recording, make_selector(args.selector), one_at_a_time=True, progress=bar.update
        )
    branch = result.branch
    pair = np.asarray(branch.ambiguous & ~branch.outlier) & recording.reference.valid[:, None]
    name = f"{recording.name}, {args.selector}"
    return name, result.flip_probability[pair], np.asarray(branch.wrong)[pair]
