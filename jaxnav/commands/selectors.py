"""Selectors by the names of the command line."""

from jaxnav.ambiguity import LowestReprojection, PaperCost, Selector

SELECTORS: dict[str, type] = {
    "lowest-reprojection": LowestReprojection,
    "paper-cost": PaperCost,
}


def make_selector(name: str) -> Selector:
    """A selector with its default parameters."""
    selector: Selector = SELECTORS[name]()
    return selector
