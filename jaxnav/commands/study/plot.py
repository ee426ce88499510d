"""`jaxnav plot`: draw pictures of a study, or of a recorded drive."""

from jaxnav.commands.drive.pictures import draw_drive, is_recording
from jaxnav.commands.study.arguments import Plot as Arguments


def run(args: Arguments) -> int:
    """Draw the drive or the study in the file."""
    if is_recording(args.store):
        return draw_drive(args)
    # It needs the packages of the extra `study`.
    from jaxnav.commands.study.pictures import draw_study

    return draw_study(args)
