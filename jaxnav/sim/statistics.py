"""Compute rates with confidence intervals, and bounds on the ANEES."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, Int, Num
from scipy.special import gammaincinv  # scipy.stats takes half a second to import

_Z = 1.959963984540054  # 95 % of a normal distribution lies within


def wilson_interval(
    rate: Float[np.ndarray, "*S"], count: Num[np.ndarray, "*S"]
) -> tuple[np.ndarray, np.ndarray]:
    """The ends of the 95 % interval of a proportion observed in `count` trials.

    Source: Wilson (1927).
    """
    center = (rate + _Z**2 / (2 * count)) / (1 + _Z**2 / count)
    half = _Z / (1 + _Z**2 / count) * np.sqrt(rate * (1 - rate) / count + (_Z / (2 * count)) ** 2)
    return np.maximum(center - half, 0), np.minimum(center + half, 1)


@dataclass(frozen=True)
class Reliability:
    """Predicted and observed frequencies in bins of equal width."""

    predicted: Float[np.ndarray, " bins"]  # mean prediction of each bin
    observed: Float[np.ndarray, " bins"]
    counts: Int[np.ndarray, " bins"]

    @staticmethod
    def from_predictions(
        probability: Float[np.ndarray, " N"], happened: Bool[np.ndarray, " N"], bins: int = 20
    ) -> "Reliability":
        """Bin predictions in [0, 1], without empty bins."""
        index = np.minimum((probability * bins).astype(int), bins - 1)
        counts = np.bincount(index, minlength=bins)
        used = counts > 0
        predicted = np.bincount(index, probability, bins)[used] / counts[used]
        observed = np.bincount(index, happened.astype(float), bins)[used] / counts[used]
        return Reliability(predicted, observed, counts[used])

    @property
    def intervals(self) -> tuple[Float[np.ndarray, " bins"], Float[np.ndarray, " bins"]]:
        """The ends of the 95 % interval of every bin's frequency."""
        return wilson_interval(self.observed, self.counts)

    @property
    def expected_calibration_error(self) -> float:
        """The mean gap between prediction and frequency, weighted by the bins' counts.

        Source: Naeini, Cooper, Hauskrecht (2015).
        """
        gaps = np.abs(self.predicted - self.observed)
        return float(np.sum(self.counts * gaps) / np.sum(self.counts))


def bootstrap_mean(
    sums: Num[np.ndarray, " S"], counts: Num[np.ndarray, " S"], draws: int = 1000
) -> tuple[float, float, float]:
    """The mean over the frames of all drives, and its 95 % interval by bootstrap over drives.

    Args:
        sums, counts: (S,), the sum over each drive's frames and their number.
    """
    picks = np.random.default_rng(0).integers(0, len(sums), (draws, len(sums)))
    means = sums[picks].sum(axis=1) / np.maximum(counts[picks].sum(axis=1), 1)
    low, high = np.percentile(means, [2.5, 97.5])
    return float(sums.sum() / max(int(counts.sum()), 1)), float(low), float(high)


def anees_band(drives: int, freedom: int, share: float = 0.999) -> tuple[float, float]:
    """The interval in which a consistent filter's ANEES lies, each drive counted once.

    Source: Bar-Shalom, Li, Kirubarajan (2001), Eq. 5.4.2-14.
    """
    tail = (1 - share) / 2
    low, high = (float(2 * gammaincinv(freedom * drives / 2, p)) for p in (tail, 1 - tail))
    return low / drives, high / drives
