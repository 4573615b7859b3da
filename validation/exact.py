"""Claim: with ``transfer="exact"`` what nothing blocks carries no error of the spherical harmonics, and shadows are those of ``shadowed``.

**floor**: ``scenes/floor.xml``, in which nothing casts a shadow, against Mitsuba's ``direct``. Its pixels are means over many independent
pictures, so each has a standard error: the root mean square of the differences, in units of it, is 1 if nothing but noise is left. The
same for ``shadowed`` transfer, localised and projected over the sphere.

**pictures**: the ball, the plant and the Cornell box of :py:mod:`validation.soft_shadows`, ``exact`` beside ``shadowed``, both localised
and projected, against ``path``: mean errors of 8 x 8 pixels.

    python -m validation.exact
"""
from __future__ import annotations

import argparse
import json
import pathlib
import sys

import mitsuba as mi
import numpy as np

mi.set_variant("llvm_ad_rgb")

import mi_shlight  # noqa: E402

from .soft_shadows import PICTURES, errors, from_file, grey, render  # noqa: E402

RESULTS = pathlib.Path(__file__).parent / "results"
ORDERS = (2, 4, 8)
KINDS = {"projected": {"transfer": "shadowed", "localised": False}, "localised": {"transfer": "shadowed"},
         "exact, projected": {"transfer": "exact", "localised": False}, "exact": {"transfer": "exact"}}


def in_standard_errors(images: list, truth: np.ndarray) -> float:
    """Root mean square of ``truth`` minus the mean of `images`, in units of that mean's standard error at each pixel."""
    mean, sigma = np.mean(images, axis=0), np.std(images, axis=0, ddof=1) / np.sqrt(len(images))
    return float(np.sqrt((((truth - mean) / sigma) ** 2).mean()))


def measure_floor(size: int = 24, pictures: int = 32, spp: int = 1024) -> list:
    """Rows: order, transfer, root mean square in standard errors of `pictures` ``direct`` ones, and mean relative error."""
    scene = from_file("floor")(size)
    images = [render(scene, {"type": "direct"}, spp, seed) for seed in range(1, pictures + 1)]
    truth, rows = np.mean(images, axis=0), []
    for order in ORDERS:
        for kind, parameters in KINDS.items():
            image = render(scene, {"type": "shprt", "order": order, **parameters}, 16 * spp)      # places in the pixel are noise, too
            rows.append({"order": order, "transfer": kind, "standard errors": in_standard_errors(images, image),
                         "mean error": float(abs(image - truth).mean() / truth.mean())})
    return rows


def measure_pictures(size: int = 128, reference_spp: int = 8192) -> list:
    """Rows of the errors of :py:func:`validation.soft_shadows.errors` for each scene, order and kind of transfer."""
    rows = []
    for name, picture in PICTURES.items():
        scene = picture.load(size)
        truth = np.mean([render(scene, {"type": "path", "max_depth": 2}, reference_spp // 4, seed) for seed in range(4)], axis=0)
        unshadowed = render(scene, {"type": "shprt", "order": 14, "transfer": "unshadowed"}, 64)
        shadow = grey(truth) < 0.97 * grey(unshadowed)
        lamp = grey(render(scene, {"type": "path", "max_depth": 1}, 64)) > 0
        for order in ORDERS:
            for kind, parameters in KINDS.items():
                image = render(scene, {"type": "shprt", "order": order, "max_edge": picture.max_edge, **parameters}, 256)
                rows.append({"scene": name, "order": order, "transfer": kind, **errors(image, truth, shadow, lamp)})
                print(rows[-1], file=sys.stderr, flush=True)
    return rows


def main(arguments=None) -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--output", type=pathlib.Path, default=RESULTS / "exact.json")
    options = parser.parse_args(arguments)
    report = {"version": mi_shlight.__version__, "floor": measure_floor(), "pictures": measure_pictures()}
    options.output.write_text(json.dumps(report, indent=1) + "\n")
    for row in report["floor"] + report["pictures"]:
        print(" ".join(f"{value:.4g}" if isinstance(value, float) else str(value) for value in row.values()))


if __name__ == "__main__":
    main()
