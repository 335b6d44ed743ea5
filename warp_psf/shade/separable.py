"""Phong lobes as sums of separable terms: products of a function of what comes in and one of what goes out.

Light that a glossy body sends on depends on the direction in which it leaves. With a lobe that is a sum of K products
g_k(in) h_k(out) it is a sum of K lights that leave with the fixed distributions h_k (Iwasaki 2007, section 4.1; Kautz
and McCool 1999). The papers' h_k are tables about the axes of each surface point, and a radiance field is baked for
each. Here K = 4 and h_k = 1, x, y, z of the outgoing direction about the world's axes: they are the same at every
surface point, so that what a body sends through h_k is what it sends evenly, times a coordinate of the direction.
"""

from functools import cache

import numpy as np

# Points of the rules over incidence, within the lobe, and around it: the factors are then right to 1e-4.
INCIDENCE_POINTS, LOBE_POINTS, ANGLE_POINTS = 48, 48, 64
# The integrals over the hemisphere, with the cosine, of products of 1 and z; and of x^2.
GRAM = np.array([[np.pi, 2 * np.pi / 3], [2 * np.pi / 3, np.pi / 2]])
LEVEL_GRAM = np.pi / 4


@cache
def factor_lobe(exponent: float) -> np.ndarray:
    """The best four-term approximation of the normalised Phong lobe (n + 2)/(2 pi) cos^n: k00, k01, k11, kt.

    About the normal, with in and out both in the upper hemisphere,

        lobe(in, out) ~ k00 + k01 (in_z + out_z) + k11 in_z out_z - kt (in_x out_x + in_y out_y),

    which is the least-squares fit weighted with both cosines. As 1 and z are among its functions, it keeps the energy
    of the lobe and how that varies with incidence as far as 1 and z can tell. (The lobe's own first two bands, a
    Legendre series cut off, would lose a quarter of the energy of a narrow lobe at normal incidence.)

    The lobe is sampled by its own distribution, so that narrow ones are as well integrated as wide ones.
    """
    nodes, weights = np.polynomial.legendre.leggauss(INCIDENCE_POINTS)
    z_in, weight_in = 0.5 * (nodes + 1.0), np.pi * weights
    nodes, weights = np.polynomial.legendre.leggauss(LOBE_POINTS)
    # u = t^(n + 1) makes the lobe even: the integral of t^n g(t) is that of g over u, over n + 1.
    t, weight_lobe = (0.5 * (nodes + 1.0)) ** (1.0 / (exponent + 1.0)), 0.5 * weights / (exponent + 1.0)
    angle = 2 * np.pi * (np.arange(ANGLE_POINTS) + 0.5) / ANGLE_POINTS
    z, t, angle = z_in[:, None, None], t[None, :, None], angle[None, None, :]
    level, aside = np.sqrt(1 - z * z), np.sqrt(1 - t * t) * np.cos(angle)
    z_out = t * z + aside * level
    # Along the level part of the mirrored direction.
    x_out = t * level - aside * z
    scale = (exponent + 2.0) / (2 * np.pi) * 2 * np.pi / ANGLE_POINTS
    weight = scale * (weight_in * z_in)[:, None, None] * weight_lobe[None, :, None] * np.maximum(z_out, 0.0)
    moments = np.array([[weight.sum(), (weight * z_out).sum()], [(weight * z).sum(), (weight * z * z_out).sum()]])
    inverse = np.linalg.inv(GRAM)
    upright = inverse @ (0.5 * (moments + moments.T)) @ inverse
    # The two level axes share the moment.
    along = (weight * level * x_out).sum() / (2 * LEVEL_GRAM**2)
    return np.array([upright[0, 0], upright[0, 1], upright[1, 1], along])
