"""Restoration of images that a motion has blurred: which motions are likely, and Wiener's filter.

The spectrum of an image blurred by a straight motion is the sharp one's times that of the motion,
sinc(l f), which is weak in stripes across the motion. The mean spectrum of the image's tiles is
compared with those stripes, without what a scene has by itself: a power that depends on the spatial
frequency's size, and in each direction, across walls and floors, falls off in its own way.

Source: Wiener (1949); Welch (1967), the mean spectrum; Gennery (1973), the stripes.
"""

import math
from functools import cache
from typing import NamedTuple

import numpy as np
from jaxtyping import Complex, Float, UInt8
from scipy import fft

_LENGTHS_PX = (3.0, 4.0, 5.5, 7.5, 10.0)
_TURN_PX = 2.0  # between the ends of neighbouring motions
_TILE = 64
_FREQUENCIES = (0.04, 0.45)  # 1/px: what is slower is the scene's, what is faster noise
_RINGS, _SECTORS = 40, 16  # per 1/px, and of half a turn
_FLOOR = 0.01  # of the stripes' power: noise fills them
_LENS_PX2 = 0.45  # variance of lens and pixel
_NOISE_PER_PX = 1e-3  # noise over the scene's power, for each pixel of the motion
_BORDER_PX = 16


class Motion(NamedTuple):
    """A straight motion at constant speed during an exposure."""

    length_px: float
    angle_rad: float  # from the image's x to its y

    @property
    def streak_px(self) -> tuple[float, float]:
        """The way along x and y."""
        return self.length_px * math.cos(self.angle_rad), self.length_px * math.sin(self.angle_rad)

    def transfer(self, fx: Float[np.ndarray, "..."], fy: Float[np.ndarray, "..."]) -> np.ndarray:
        """What it leaves of spatial frequencies, in 1/px."""
        along = fx * math.cos(self.angle_rad) + fy * math.sin(self.angle_rad)
        return np.asarray(np.sinc(self.length_px * along))


@cache
def motions() -> tuple[Motion, ...]:
    """The motions that are looked for, 3 to 10 px long."""
    return tuple(
        Motion(length, k * math.pi / count)
        for length in _LENGTHS_PX
        for count in [math.ceil(math.pi * length / _TURN_PX)]
        for k in range(count)
    )


def likely_motions(image: UInt8[np.ndarray, "rows columns"]) -> list[Motion]:
    """All `motions`, the likeliest first.

    Args:
        image: (H, W) grey levels, blurred by about the same motion everywhere.
    """
    size = min(_TILE, *image.shape)
    used, stripes = _stripes(size)
    power = _mean_power(image, size)
    seen = np.log(power + 1e-3 * power.mean() + 1e-9)[used]
    order = np.argsort(-(stripes @ seen), kind="stable")
    return [motions()[k] for k in order]


class BlurredImage:
    """An image that is restored for one motion after the other."""

    def __init__(self, image: UInt8[np.ndarray, "rows columns"]):
        """Take the image, (H, W) grey levels."""
        self._size = image.shape
        padded = [fft.next_fast_len(side + 2 * _BORDER_PX, real=True) for side in image.shape]
        more = [(_BORDER_PX, n - m - _BORDER_PX) for n, m in zip(padded, image.shape, strict=True)]
        levels = np.pad(image, more, mode="symmetric").astype(np.float32)
        self._mean, self._padded = float(levels.mean()), levels.shape
        self._spectrum: Complex[np.ndarray, "h w"] = fft.rfft2(levels - self._mean)
        self._fy = fft.fftfreq(padded[0]).astype(np.float32)[:, None]
        self._fx = fft.rfftfreq(padded[1]).astype(np.float32)[None]
        self._lens = np.exp(-2 * math.pi**2 * _LENS_PX2 * (self._fx**2 + self._fy**2))

    def restored(self, motion: Motion) -> UInt8[np.ndarray, "rows columns"]:
        """The image without that motion and the lens, by Wiener's filter."""
        transfer = motion.transfer(self._fx, self._fy).astype(np.float32) * self._lens
        sharpens = transfer / (transfer**2 + np.float32(_NOISE_PER_PX * motion.length_px))
        levels = fft.irfft2(self._spectrum * sharpens, s=self._padded) + self._mean
        rows, columns = (slice(_BORDER_PX, _BORDER_PX + side) for side in self._size)
        return np.clip(levels[rows, columns], 0, 255).astype(np.uint8)


def _mean_power(image: np.ndarray, size: int) -> Float[np.ndarray, "h w"]:
    """The mean spectral power of the image's tiles, which overlap by half."""
    window = np.hanning(size).astype(np.float32)
    places = [_begins(side, size) for side in image.shape]
    tiles = np.stack([image[y : y + size, x : x + size] for y in places[0] for x in places[1]])
    levels = tiles.astype(np.float32)
    levels -= levels.mean(axis=(1, 2), keepdims=True)
    spectra = fft.rfft2(levels * window * window[:, None])
    return np.asarray(np.mean(np.abs(spectra) ** 2, axis=0), float)


def _begins(side: int, size: int) -> np.ndarray:
    count = max(math.ceil(2 * (side - size) / size), 0) + 1
    return np.linspace(0, side - size, count).round().astype(int)


@cache
def _stripes(size: int) -> tuple[np.ndarray, Float[np.ndarray, "motions frequencies"]]:
    """Which frequencies of a tile count, and each motion's stripes without what a scene has."""
    fy, fx = fft.fftfreq(size)[:, None], fft.rfftfreq(size)[None]
    radius = np.hypot(fx, fy)
    used = (radius > _FREQUENCIES[0]) & (radius < _FREQUENCIES[1])
    scene = _of_scenes(radius[used], np.arctan2(fy, fx)[used])
    logs = np.stack([np.log(one.transfer(fx, fy)[used] ** 2 + _FLOOR) for one in motions()])
    stripes = logs - (logs @ scene) @ scene.T
    return used, stripes / np.linalg.norm(stripes, axis=1, keepdims=True)


def _of_scenes(radius: np.ndarray, angle_rad: np.ndarray) -> Float[np.ndarray, "frequencies n"]:
    """An orthonormal basis of log spectra: any function of the frequency's size, and in each sector
    a power of it."""
    ring = (radius * _RINGS).astype(int)
    sector = ((angle_rad / math.pi + 0.5) * _SECTORS).astype(int).clip(0, _SECTORS - 1)
    one_ring, one_sector = (np.eye(k.max() + 1)[k] for k in (ring, sector))
    columns = np.concatenate([one_ring, one_sector, one_sector * np.log(radius)[:, None]], axis=1)
    basis, weights, _ = np.linalg.svd(columns, full_matrices=False)
    return np.asarray(basis[:, weights > 1e-9 * weights[0]])
