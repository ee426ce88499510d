"""Lenses as their papers write them down, point by point in plain NumPy."""

import numpy as np


def omni(point, coefficients):
    """Mei and Rives (2007), Eqs. 6 to 11: onto the sphere, then before a plane at xi, then bent."""
    xi, k1, k2, p1, p2 = coefficients
    x, y, z = point / np.linalg.norm(point)
    u, v = x / (z + xi), y / (z + xi)
    r2 = u**2 + v**2
    radial = k1 * r2 + k2 * r2**2
    return np.array(
        [
            u * (1 + radial) + 2 * p1 * u * v + p2 * (r2 + 2 * u**2),
            v * (1 + radial) + p1 * (r2 + 2 * v**2) + 2 * p2 * u * v,
        ]
    )


def double_sphere(point, coefficients):
    """Usenko, Demmel, Cremers (2018), Eqs. 40 to 42."""
    xi, alpha = coefficients
    x, y, z = point
    d1 = np.sqrt(x**2 + y**2 + z**2)
    d2 = np.sqrt(x**2 + y**2 + (xi * d1 + z) ** 2)
    return np.array([x, y]) / (alpha * d2 + (1 - alpha) * (xi * d1 + z))


def eucm(point, coefficients):
    """Khomutenko, Garcia, Martinet (2016), Eq. 12; in the letters of Usenko et al., Eq. 18."""
    alpha, beta = coefficients
    x, y, z = point
    d = np.sqrt(beta * (x**2 + y**2) + z**2)
    return np.array([x, y]) / (alpha * d + (1 - alpha) * z)


BY_NAME = {"omni": omni, "double_sphere": double_sphere, "eucm": eucm}
