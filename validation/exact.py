"""Claim: with ``transfer="exact"`` what nothing blocks carries no error of the spherical harmonics, and shadows are those of ``shadowed``.

**floor**: ``scenes/floor.xml``, in which nothing casts a shadow, against Mitsuba's ``direct``. Its pixels are means over many independent
pictures, so each has a standard error: the root mean square of the differences, in units of it, is 1 if nothing but noise is left. The
same for ``shadowed`` transfer, localised and projected over the sphere.

**pictures**: the ball, the plant and the Cornell box of :py:mod:`validation.soft_shadows`, ``exact`` beside ``shadowed``, both localised
and projected, against ``path``: mean errors of 8 x 8 pixels.

    python -m validation.exact [--quick] [--out DIR]

writes ``exact.json`` and prints its rows.
"""
from __future__ import annotations

import sys

import mitsuba as mi
import numpy as np

mi.set_variant("llvm_ad_rgb")

from validation import experiment  # noqa: E402
from validation.soft_shadows import PICTURES, errors, from_file, grey, render  # noqa: E402

ORDERS = (2, 4, 8)
KINDS = {"projected": {"transfer": "shadowed", "localised": False}, "localised": {"transfer": "shadowed"},
         "exact, projected": {"transfer": "exact", "localised": False}, "exact": {"transfer": "exact"}}


def in_standard_errors(images: list, truth: np.ndarray) -> float:
    """Root mean square of ``truth`` minus the mean of `images`, in units of that mean's standard error at each pixel."""
    mean, sigma = np.mean(images, axis=0), np.std(images, axis=0, ddof=1) / np.sqrt(len(images))
    return float(np.sqrt((((truth - mean) / sigma) ** 2).mean()))


def measure_floor(size: int = 24, pictures: int = 32, spp: int = 1024, orders=ORDERS) -> list:
    """Rows: order, transfer, root mean square in standard errors of `pictures` ``direct`` ones, and mean relative error."""
    scene = from_file("floor")(size)
    images = [render(scene, {"type": "direct"}, spp, seed) for seed in range(1, pictures + 1)]
    truth, rows = np.mean(images, axis=0), []
    for order in orders:
        for kind, parameters in KINDS.items():
            image = render(scene, {"type": "shprt", "order": order, **parameters}, 16 * spp)      # places in the pixel are noise, too
            rows.append({"order": order, "transfer": kind, "standard errors": in_standard_errors(images, image),
                         "mean error": float(abs(image - truth).mean() / truth.mean())})
    return rows


def measure_pictures(size: int = 128, reference_spp: int = 8192, orders=ORDERS, names=tuple(PICTURES)) -> list:
    """Rows of the errors of :py:func:`validation.soft_shadows.errors` for each scene, order and kind of transfer."""
    rows = []
    for name in names:
        picture = PICTURES[name]
        scene = picture.load(size)
        truth = np.mean([render(scene, {"type": "path", "max_depth": 2}, reference_spp // 4, seed) for seed in range(4)], axis=0)
        unshadowed = render(scene, {"type": "shprt", "order": 14, "transfer": "unshadowed"}, 64)
        shadow = grey(truth) < 0.97 * grey(unshadowed)
        lamp = grey(render(scene, {"type": "path", "max_depth": 1}, 64)) > 0
        for order in orders:
            for kind, parameters in KINDS.items():
                image = render(scene, {"type": "shprt", "order": order, "max_edge": picture.max_edge, **parameters}, 128)
                rows.append({"scene": name, "order": order, "transfer": kind, **errors(image, truth, shadow, lamp)})
                print(rows[-1], file=sys.stderr, flush=True)
    return rows


def targets(report: dict) -> list:
    """Verdicts on ``exact`` transfer: noise alone where nothing is in the way, and shadows no worse."""
    lines = [experiment.verdict(f"floor, order {row['order']}: off converged `direct` by at most 1.15 standard errors",
                                row["standard errors"], 1.15) for row in report["floor"] if row["transfer"] == "exact"]
    rows = {(row["scene"], row["order"], row["transfer"]): row["blocks"] for row in report["pictures"]}
    return lines + [experiment.verdict(f"{scene}, order {order}: error at most 1.05 times that of localised shadows",
                                       error / rows[scene, order, "localised"], 1.05)
                    for (scene, order, kind), error in rows.items() if kind == "exact"]


def main(arguments=None) -> None:
    options = experiment.options(__doc__, arguments)
    if options.quick:
        report = {"floor": measure_floor(8, 4, 16, ORDERS[:1]), "pictures": measure_pictures(32, 64, ORDERS[:1], ("ball",))}
    else:
        report = {"floor": measure_floor(), "pictures": measure_pictures()}
    for row in report["floor"] + report["pictures"]:
        print(" ".join(f"{value:.4g}" if isinstance(value, float) else str(value) for value in row.values()))
    report = {"targets": targets(report), **report}
    experiment.print_targets(report["targets"])
    experiment.write(options.out / "exact.json", report, options.quick)


if __name__ == "__main__":
    main()
