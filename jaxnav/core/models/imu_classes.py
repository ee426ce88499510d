"""Two classes of inertial sensors, as figures: what a gyro and an accelerometer get wrong.

Each stands for the sensors of its price, by the figures of one of them:

* `consumer`, some euros: Bosch Sensortec BMI088 (BST-BMI088-DS001). Noise densities, offsets,
  range and tolerance of the sensitivity are the typical ones of its data sheet.
* `tactical`, some hundreds: Analog Devices ADIS16470. Noise densities and range of the gyro are
  those of its data sheet; its offset is the 1-sigma initial error of that family of sensors.

What no data sheet tells is an order of magnitude of the class, no measurement: the offset of the
tactical accelerometer, the walks, what is left of the delay. A walk is above what an Allan plot
shows, as filters need it: EuRoC's rig, with an ADIS16448, has 1.9e-5 rad/s/sqrt(s) and 3e-3
m/s^2/sqrt(s) (Burri et al., 2016), the consumer's; the tactical ones are a fifth of that. The
delay is that of a bus that a host polls, and of a sensor that stamps its own samples.
"""

import math
from dataclasses import dataclass

_G_MPS2 = 9.80665  # standard gravity, in which data sheets count


@dataclass(frozen=True)
class ImuClass:
    """Figures of one class, in the units of data sheets, alike on the three axes."""

    gyro_noise_degps: float  # density, deg/s/sqrt(Hz)
    gyro_offset_degps: float  # 1 sigma, before anything tells it
    gyro_walk: float  # of the offset, rad/s/sqrt(s)
    gyro_range_degps: float
    gyro_scale: float  # tolerance of the sensitivity
    gyro_late_s: float  # what is left of the delay
    accel_noise_ug: float  # density, 1e-6 g/sqrt(Hz)
    accel_offset_mg: float
    accel_walk: float  # m/s^2/sqrt(s)

    @property
    def gyro_noise(self) -> float:
        """Density, rad/s/sqrt(Hz)."""
        return math.radians(self.gyro_noise_degps)

    @property
    def gyro_offset_radps(self) -> float:
        """1 sigma."""
        return math.radians(self.gyro_offset_degps)

    @property
    def gyro_range_radps(self) -> float:
        """A reading at it or beyond is none."""
        return math.radians(self.gyro_range_degps)

    @property
    def accel_noise(self) -> float:
        """Density, m/s^2/sqrt(Hz)."""
        return self.accel_noise_ug * 1e-6 * _G_MPS2

    @property
    def accel_offset_mps2(self) -> float:
        """1 sigma."""
        return self.accel_offset_mg * 1e-3 * _G_MPS2


IMU_CLASSES = {
    "consumer": ImuClass(
        gyro_noise_degps=0.014,
        gyro_offset_degps=1.0,
        gyro_walk=2e-5,
        gyro_range_degps=2000.0,
        gyro_scale=0.01,
        gyro_late_s=5e-3,
        accel_noise_ug=175.0,  # 160 along x and y, 190 along z
        accel_offset_mg=20.0,
        accel_walk=3e-3,
    ),
    "tactical": ImuClass(
        gyro_noise_degps=0.008,
        gyro_offset_degps=0.2,
        gyro_walk=4e-6,
        gyro_range_degps=2000.0,
        gyro_scale=0.003,
        gyro_late_s=1e-3,
        accel_noise_ug=100.0,
        accel_offset_mg=10.0,
        accel_walk=6e-4,
    ),
}
