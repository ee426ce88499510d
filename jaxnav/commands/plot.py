"""`jaxnav plot`: pictures of a study, or of a recorded drive."""

from jaxnav.arguments import Plot as Arguments
from jaxnav.commands.drive_pictures import draw_drive, is_recording


def run(args: Arguments) -> int:
    """Draw what the file is."""
    if is_recording(args.store):
        return draw_drive(args)
    # It needs the packages of the extra `study`.
    from jaxnav.commands.study_pictures import draw_study

    return draw_study(args)
