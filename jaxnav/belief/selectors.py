"""Selectors by the names that files and command lines use."""

from jaxnav.belief.ambiguity import (
    LowestReprojection,
    Mahalanobis,
    ObjectSpace,
    Oracle,
    OrientationGiven,
    PaperCost,
    RatioTest,
    Selector,
)
from jaxnav.belief.hypotheses import MultiHypothesis

SELECTORS: dict[str, type] = {
    "multi-hypothesis": MultiHypothesis,
    "lowest-reprojection": LowestReprojection,
    "ratio-test": RatioTest,
    "object-space": ObjectSpace,
    "paper-cost": PaperCost,
    "mahalanobis": Mahalanobis,
    "orientation-given": OrientationGiven,
    "oracle": Oracle,
}


def make_selector(name: str) -> Selector:
    """A selector with its default parameters."""
    selector: Selector = SELECTORS[name]()
    return selector
