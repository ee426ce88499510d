"""`jaxnav view`: show a recorded drive in Rerun, or write a file for it."""

from contextlib import ExitStack

from jaxnav.commands.bars import progress_bar
from jaxnav.commands.drive.arguments import ViewDrive as Arguments
from jaxnav.commands.drive.plot import read_outcomes
from jaxnav.errors import visible
from jaxnav.files import atomic_path, output_folder
from jaxnav.pictures.rerun.view import RerunView, import_rerun
from jaxnav.pictures.scenery import Scenery
from jaxnav.recordings.drive_log import DriveLog
from jaxnav.recordings.plausible import keep_plausible, left_out_note


def run(args: Arguments) -> int:
    """Show the whole drive, and leave the window open."""
    import_rerun()
    log = read_outcomes(args.recording, args.headless)
    scenery = Scenery.from_header(log.header)
    if args.out is not None:
        output_folder(args.out.parent)
    with ExitStack() as stack:
        save = None if args.out is None else stack.enter_context(atomic_path(args.out))
        view = RerunView(
            scenery.rig,
            scenery.markers,
            scenery.on_map_m(scenery.waypoints_m),
            live=save is None,
            save=save,
            waits=True,
        )
        stack.callback(view.close)
        show_drive(view, log, scenery, args.headless)
    if args.out is not None:
        print(f"written to {visible(args.out)}: rerun {visible(args.out)} opens it")
    if view.dropped:
        print(f"{view.dropped} outcomes or images could not be shown")
    return 0


def show_drive(view: RerunView, log: DriveLog, scenery: Scenery, headless: bool) -> None:
    """Show all outcomes, all frames and all images of a drive in a view."""
    outcomes, odd = keep_plausible(log.outcomes)
    if odd:
        print(left_out_note(odd))
    names = () if scenery.rig is None else scenery.rig.names
    for index in progress_bar(
        range(len(outcomes.now_ns)), unit="outcome", disable=headless, leave=False
    ):
        view.show_recorded(outcomes, index)
    for frame in (frame for given in log.inputs for frame in given.frames):
        name = names[frame.camera] if frame.camera < len(names) else f"camera_{frame.camera}"
        if frame.detections is not None:
            view.image(name, frame.stamp_ns, None, frame.detections.corners_px)
    for image in log.images():
        view.image(image.topic.removeprefix("/camera/"), image.stamp_ns, image.jpeg, None)
