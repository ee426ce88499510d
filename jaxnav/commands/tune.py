"""`jaxnav tune`: parameters learned by gradient."""

from jaxnav.arguments import Tune, TuneFilter
from jaxnav.commands import tune_controller, tune_filter


def run(args: Tune) -> int:
    """What is to be tuned."""
    if isinstance(args.what, TuneFilter):
        return tune_filter.run(args.what)
    return tune_controller.run(args.what)
