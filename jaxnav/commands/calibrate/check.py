"""`jaxnav calibrate check`: markers that are not where the map says."""

from typing import Any

import numpy as np

from jaxnav.calibrate.rig.calibrate import calibrate_rig
from jaxnav.calibrate.rig.marker_check import Check, Verdict, checked
from jaxnav.calibrate.rig.vehicle_frame import moved_world
from jaxnav.calibrate.rig.views import Ts_vehicle_camera
from jaxnav.commands.calibrate.arguments import CalibrateCheck as Arguments
from jaxnav.commands.calibrate.data import RigData, read_rig_data
from jaxnav.commands.calibrate.report import provenance, summary, write_files
from jaxnav.commands.pictures import save_figure
from jaxnav.commands.process import configure_jax
from jaxnav.errors import BadInput, visible
from jaxnav.files import output_folder, write_json
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
    given = Ts_vehicle_camera(data.rig)
    calibration = calibrate_rig(data.views, data.rig, {anchor: data.known[anchor]}, None)
    check = checked(
        calibration,
        data.views,
        data.rig,
        data.known,
        args.tolerance_m,
        np.deg2rad(args.tolerance_deg),
    )
    linked = sum(verdict.apart_m is not None for verdict in check.verdicts.values())
    if linked < 2 and all(verdict.right for verdict in check.verdicts.values()):
        raise BadInput(
            args.recordings[0],
            "no two markers of the map are linked, so that nothing can contradict it: two must be "
            "in view at once now and then, by any cameras",
        )
    calibration = moved_world(calibration, check.T_map_world)
    out = output_folder(args.out)
    calibrated = provenance(data, "check")
    report = summary(data, calibration, given, calibrated) | {
        "agreeing": check.agreeing,
        "verdicts": {_name(data, i): _as_json(verdict) for i, verdict in check.verdicts.items()},
    }
    write_files(out, data, calibration, calibrated, with_rig=False, all_found=True)
    write_json(out / "report.json", report)
    mapped = [int(index) for index in np.flatnonzero(calibration.mapped)]
    figure = map_check(
        given=np.stack([data.known[index] for index in mapped]),
        estimate=calibration.Ts_world_marker[mapped],
        size_m=data.views.size_m[mapped],
        ids=[data.keys[index][1] for index in mapped],
        wrong=[not check.verdicts[index].right for index in mapped],
    )
    save_figure(figure, out / "report.png")
    print(_text(data, check))
    print(f"the map as it was found, and the report, in {visible(out)}")
    return 0 if all(verdict.right for verdict in check.verdicts.values()) else EXIT_WRONG


def _name(data: RigData, index: int) -> str:
    family, marker_id = data.keys[index]
    return f"{family} {marker_id}"


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


def _text(data: RigData, check: Check) -> str:
    lines = [f"{check.agreeing} of {len(check.verdicts)} markers agree with each other"]
    for index, verdict in check.verdicts.items():
        lines += [
            f"  marker {data.keys[index][1]}: {said}" for said in _sentences(data, index, verdict)
        ]
    if all(verdict.right for verdict in check.verdicts.values()):
        lines.append("all markers that could be linked are where the map says")
    if check.agreeing < 2:
        lines.append("no two markers agree: which of them is right can't be told")
    return "\n".join(lines)


def _sentences(data: RigData, index: int, verdict: Verdict) -> list[str]:
    findings = []
    if verdict.wrong_size and verdict.size_m is not None:
        findings.append(
            f"is {verdict.size_m:.4g} m large, the map says {data.views.size_m[index]:.4g} m"
        )
    if verdict.moved_m:
        findings.append(f"moved by {verdict.moved_m:.3g} m while it was watched")
    if verdict.apart_m is None and not findings:
        findings.append(f"seen {verdict.seen} times, nothing links it to the others")
    if verdict.wrong and verdict.apart_m is not None and verdict.apart_rad is not None:
        findings.append(
            f"is {verdict.apart_m:.3g} m and {np.rad2deg(verdict.apart_rad):.3g} deg from where "
            "the map says: it has moved, or was entered wrongly"
        )
    return findings
