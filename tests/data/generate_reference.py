"""Regenerate or check ``reference.npz``: coefficients and vertex gradients of 62 polygons, in 50-digit arithmetic.

    python -m tests.data.generate_reference            recompute from the stored vertices and rewrite the file
    python -m tests.data.generate_reference --check    recompute and compare; exit status 1 if a value is off

Contents, for case k: ``names[k]``; ``vertices_k`` (N, 3), seen from the origin, positive solid angle, exactly representable in float32;
``coefficients_k`` (225,), order 14; ``normals_k`` (N, 3) and ``moments_k`` (N, 2, 225), from which
``tests.reference.expand_gradients`` makes the gradients with respect to the vertices (N, 3, 225) at two thirds of their size.

Polygons. Drawn once with a seeded generator: triangles, quadrilaterals, heptagons and a ten-cornered star (non-convex) of radius 0.8 to
0.9 in random planes, centred at distance 1 to 2; quadrilaterals of radius 0.7 at distances 10 to 1e6, and at 1e-1 to 1e-4 from their
own plane ("near"); of radius 0.5 seen edge-on at gaps 1e-2 to 1e-6 ("grazing"); triangles of width 1e-2 to 1e-6 ("sliver"); squares
at height 1 with half sides 10 to 1e4 ("huge"); and four axis-aligned ones. The vertices are data; everything else follows from them.

Method. ``tests.reference``: each coefficient of degree l >= 1 is ``1/(l(l+1))`` times the sum over the edges of the line integral of
``n_e . grad Y_lm`` (divergence theorem), each gradient the line integral of Y_lm times the velocity of the edge (Reynolds); both by
Gauss-Legendre rules of order + 30 nodes per arc, where grad Y_lm comes from the ladder operators of solid harmonics. The vertices came
with values made in 60 digits by another program, with explicit derivatives of the Legendre functions: all coefficients are the same
floats (where not zero by symmetry), the gradients agree to 3e-16.
"""
from __future__ import annotations

import argparse
import sys

import numpy as np

from tests.reference import DATA, edge_moments_mp

ORDER = 14
TOLERANCE = 1e-15
"""Largest difference relative to the largest entry of an array: float64 rounding."""
KEYS = ("coefficients", "normals", "moments")


def main(arguments=None) -> int:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--check", action="store_true", help="compare with the stored values, write nothing")
    options = parser.parse_args(arguments)

    with np.load(DATA) as data:
        stored = dict(data)
    fresh, worst = {"names": stored["names"], "order": np.array(ORDER)}, 0.0
    for k, name in enumerate(stored["names"]):
        vertices = fresh[f"vertices_{k}"] = stored[f"vertices_{k}"]
        for key, value in zip(KEYS, edge_moments_mp(vertices, (0, 0, 0), ORDER)):
            fresh[f"{key}_{k}"] = value
            if options.check:
                known = stored[f"{key}_{k}"]
                worst = max(worst, np.abs(known - value).max() / np.abs(value).max())
        print(f"\r{k + 1}/{len(stored['names'])} {name:20s}", end="", file=sys.stderr, flush=True)
    print(file=sys.stderr)
    if options.check:
        print(f"largest relative difference {worst:.1e}, tolerance {TOLERANCE:.0e}")
        return int(not worst <= TOLERANCE)
    np.savez_compressed(DATA, **fresh)
    return 0


if __name__ == "__main__":
    sys.exit(main())
