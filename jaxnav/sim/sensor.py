"""Turn light into grey values: noise, gain, saturation, quantisation; and the times of rows."""

from dataclasses import dataclass

import cv2
import numpy as np
from jaxtyping import Float, UInt8

from jaxnav.errors import BadInput


@dataclass(frozen=True)
class Shutter:
    """The exposure times of the rows of an image.

    Row r is exposed for `exposure_s` around `stamp_s + (r - (rows - 1) / 2) * row_time_s`: the
    stamp of an image is the middle of the exposure of its middle row. Zeros give a global shutter
    without motion blur.
    """

    exposure_s: float = 0.0
    row_time_s: float = 0.0

    def __post_init__(self) -> None:
        for key in ("exposure_s", "row_time_s"):
            if not (np.isfinite(getattr(self, key)) and getattr(self, key) >= 0):
                raise BadInput(f"Shutter.{key}", "must be finite and not negative")

    def row_times_s(self, rows: int) -> Float[np.ndarray, " rows"]:
        """The middle of each row's exposure, relative to the stamp, (rows,)."""
        return (np.arange(rows) - (rows - 1) / 2) * self.row_time_s


@dataclass(frozen=True)
class Sensor:
    """An 8-bit grey image sensor.

    grey = round(gain * light + noise), clipped to 0 .. 255. The noise is Gaussian with
    variance `read_noise_grey**2 + gain * (gain * light) * 255 / full_well_e`: the second term is
    photon noise, Poisson in electrons, where 255 grey levels at unit gain are `full_well_e` of
    them. It is Poisson's up to the skewness, which is negligible above some 20 electrons.

    Source: Janesick (2007), "Photon Transfer"; EMVA 1288.
    """

    gain: float = 1.0
    full_well_e: float = 8000.0
    read_noise_grey: float = 1.0
    vignetting: float = 0.0  # fraction of the light lost in the farthest corner, 0 to 1
    psf_sigma_px: float = 0.0  # a Gaussian lens blur on top of the square pixel
    noise: bool = True

    def __post_init__(self) -> None:
        limits = {
            "gain": (0, np.inf, "positive"),
            "full_well_e": (0, np.inf, "positive"),
            "read_noise_grey": (-1e-300, np.inf, "not negative"),
            "vignetting": (-1e-300, 1 + 1e-12, "between 0 and 1"),
            "psf_sigma_px": (-1e-300, np.inf, "not negative"),
        }
        for key, (low, high, wanted) in limits.items():
            if not low < getattr(self, key) < high:
                raise BadInput(f"Sensor.{key}", f"must be {wanted}, got {getattr(self, key)}")

    def illuminate(
        self, light: Float[np.ndarray, "rows columns"], center_px: Float[np.ndarray, " 2"]
    ) -> Float[np.ndarray, "rows columns"]:
        """The scene's light after the lens's blur and vignetting, (H, W) float32."""
        if self.psf_sigma_px > 0:
            light = cv2.GaussianBlur(light, (0, 0), self.psf_sigma_px)
        if self.vignetting > 0:
            rows, columns = light.shape
            y2 = (np.arange(rows, dtype=np.float32) - np.float32(center_px[1])) ** 2
            x2 = (np.arange(columns, dtype=np.float32) - np.float32(center_px[0])) ** 2
            r2 = y2[:, None] + x2[None, :]
            light = light * (1 - np.float32(self.vignetting) * r2 / r2.max())
        return light

    def read_out(
        self, light: Float[np.ndarray, "rows columns"], rng: np.random.Generator
    ) -> UInt8[np.ndarray, "rows columns"]:
        """The grey values of an image of light, (H, W) uint8."""
        grey = np.float32(self.gain) * light
        if self.noise:
            variance = np.float32(self.gain * 255 / self.full_well_e) * grey
            variance += np.float32(self.read_noise_grey**2)
            grey += np.sqrt(variance) * rng.standard_normal(grey.shape, dtype=np.float32)
        return np.clip(np.rint(grey), 0, 255).astype(np.uint8)
