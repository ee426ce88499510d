"""Selectors by the names that files and command lines use."""

from jaxnav.core.filter.choose import (
    LowestReprojection,
    Mahalanobis,
    ObjectSpace,
    Oracle,
    OrientationGiven,
    PaperCost,
    RatioTest,
    Selector,
    Ungated,
)
from jaxnav.core.filter.hypotheses import MultiHypothesis

# With their default parameters. `Ungated`: on a filter without gate and restart.
SELECTORS: dict[str, Selector] = {
    "multi-hypothesis": MultiHypothesis(),
    "lowest-reprojection": LowestReprojection(),
    "lowest-reprojection-ungated": Ungated(LowestReprojection()),
    "ratio-test": RatioTest(),
    "object-space": ObjectSpace(),
    "paper-cost": PaperCost(),
    "paper-cost-ungated": Ungated(PaperCost()),
    "mahalanobis": Mahalanobis(),
    "orientation-given": OrientationGiven(),
    "oracle": Oracle(),
}


def make_selector(name: str) -> Selector:
    """The selector of a name, to be given to `Navigator`."""
    return SELECTORS[name]
