"""`jaxnav calibrate check`: markers that are not where the map says."""

from collections.abc import Iterator
from typing import Any

import numpy as np

from jaxnav.calibrate.rig.calibrate import calibrate_rig
from jaxnav.calibrate.rig.marker_check import Check, Verdict, checked
from jaxnav.calibrate.rig.vehicle_frame import moved_world
from jaxnav.commands.calibrate.arguments import CalibrateCheck as Arguments
from jaxnav.commands.calibrate.data import RigData, read_rig_data
from jaxnav.commands.calibrate.report import publish
from jaxnav.commands.calibrate.rig_results import RigResults
from jaxnav.commands.process import configure_jax
from jaxnav.errors import BadInput
from jaxnav.files import output_folder
from jaxnav.pictures.rig import map_check

EXIT_WRONG = 1


def run(args: Arguments) -> int:
    """Compare the map with the recordings, write a report, name wrong markers; 1 if there are."""
    configure_jax(float64=True)
    data = read_rig_data(
        args.recordings, args.rig, args.markers, None, args.family, only_known=True
    )
    if len(data.known) < 2:
        raise BadInput(
            args.markers or args.recordings[0],
            "one marker of the map was seen, two at least must be: nothing else can contradict it",
        )
    counts = np.bincount(data.views.marker, minlength=len(data.keys))
    anchor = max(data.known, key=lambda index: int(counts[index]))
    calibration = calibrate_rig(data.views, data.rig, {anchor: data.known[anchor]}, None)
    check = checked(
        calibration,
        data.views,
        data.rig,
        data.known,
        args.tolerance_m,
        np.deg2rad(args.tolerance_deg),
    )
    verdicts = check.verdicts
    all_right = all(verdict.right for verdict in verdicts.values())
    if all_right and sum(verdict.apart_m is not None for verdict in verdicts.values()) < 2:
        raise BadInput(
            args.recordings[0],
            "no two markers of the map are linked, so that nothing can contradict it: two must be "
            "in view at once now and then, by any cameras",
        )
    out = output_folder(args.out)
    results = RigResults("check", data, moved_world(calibration, check.T_map_world))
    report = results.report() | {
        "agreeing": check.agreeing,
        "verdicts": {" ".join(map(str, data.keys[i])): _as_json(v) for i, v in verdicts.items()},
    }
    mapped = results.mapped
    figure = map_check(
        given=np.stack([data.known[index] for index in mapped]),
        estimate=results.calibration.Ts_world_marker[mapped],
        size_m=data.views.size_m[mapped],
        ids=[data.keys[index][1] for index in mapped],
        wrong=[not verdicts[index].right for index in mapped],
    )
    publish(out, report, figure, _lines(data, check, all_right), results.save(out))
    return 0 if all_right else EXIT_WRONG


def _as_json(verdict: Verdict) -> dict[str, Any]:
    return {
        "right": verdict.right,
        "sightings": verdict.seen,
        "apart_m": verdict.apart_m,
        "apart_deg": None if verdict.apart_rad is None else np.rad2deg(verdict.apart_rad),
        "size_m": verdict.size_m,
        "wrong_size": verdict.wrong_size,
        "moved_m": verdict.moved_m,
    }


def _lines(data: RigData, check: Check, all_right: bool) -> Iterator[str]:
    yield f"{check.agreeing} of {len(check.verdicts)} markers agree with each other"
    for index, verdict in check.verdicts.items():
        for problem in _problems(float(data.views.size_m[index]), verdict):
            yield f"  marker {data.keys[index][1]}: {problem}"
    if all_right:
        yield "all markers that could be linked are where the map says"
    if check.agreeing < 2:
        yield "no two markers agree: which of them is right can't be told"


def _problems(map_m: float, verdict: Verdict) -> Iterator[str]:
    apart_m, apart_rad = verdict.apart_m, verdict.apart_rad
    if verdict.wrong_size:
        yield f"is {verdict.size_m:.4g} m large, the map says {map_m:.4g} m"
    if verdict.moved_m:
        yield f"moved by {verdict.moved_m:.3g} m while it was watched"
    if apart_m is None or apart_rad is None:
        if not (verdict.wrong_size or verdict.moved_m):
            yield f"seen {verdict.seen} times, nothing links it to the others"
    elif verdict.wrong:
        yield (
            f"is {apart_m:.3g} m and {np.rad2deg(apart_rad):.3g} deg from where the map says: it "
            "has moved, or was entered wrongly"
        )
