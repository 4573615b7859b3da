"""Unshadowed diffuse transfer: the clamped cosine in spherical harmonics."""
from __future__ import annotations

import math

from ..light.zonal import phong_bands
from ..sh.basis import sh_basis


def cosine_bands(order: int) -> list:
    """``A_l / pi`` with ``A_l`` the clamped-cosine factors of Ramamoorthi and Hanrahan 2001, l = 0 .. order.

    ``A_0 = pi, A_1 = 2 pi / 3``, odd l > 1: 0, even l: ``2 pi (-1)^(l/2 - 1) / ((l + 2)(l - 1)) * l! / (2^l ((l/2)!)^2)``.
    """
    return phong_bands(1.0, order)


def cosine_transfer(normal, order: int) -> list:
    """Coefficients of ``max(0, normal . omega) / pi``, the transfer of an unoccluded diffuse surface of reflectance 1 ([G03]
    diffuse unshadowed).

    Parameters
    ----------
    normal : 3-vector
        Unit surface normal.
    order : int
        Highest degree, 0 to 64.

    Returns
    -------
    list of (order + 1)**2 floats in 1/sr, exact up to the band limit; the dot product with light coefficients is a radiance.
    """
    bands = cosine_bands(order)
    basis = sh_basis(normal, order)
    return [basis[i] * bands[math.isqrt(i)] for i in range(len(basis))]
