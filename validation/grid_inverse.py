"""Claim: derivatives through the light grid recover the colours of hundreds of lights from one picture.

    python -m validation.grid_inverse [--quick] [--out DIR] [--steps N]

The 723 lights of ``scenes/many_lights.xml`` get back their colours, from grey, by Adam on the mean squared difference from a picture made
without a grid. One reverse pass gives the derivatives by all 2169 numbers; that of three lights is compared with differences. Prints a
summary, and writes ``grid_inverse.json`` and ``grid_inverse.png``: start, result and target.
"""
from __future__ import annotations

import json
import pathlib
import time

import drjit as dr
import mitsuba as mi
import numpy as np

from validation import experiment

SIZE, SPP, CHECKED, STEP, GREY = 96, 2, (0.01, 0.42, 0.9), 0.5, 2.0
RATE = 0.3


def measure(steps: int, size: int, every: int = 1, **settings) -> tuple:
    """(record, pictures): start, result and target as arrays of linear colours; the colours of one in `every` lights are unknown.

    `settings` of ``shprt``.
    """
    scene = mi.load_file(str(experiment.ROOT / "scenes" / "many_lights.xml"), optimize=False, resx=size, resy=size)
    settings = {"type": "shprt", "transfer_samples": 256, **settings}
    exact, plugin = mi.load_dict(settings), mi.load_dict({**settings, "grid_resolution": 8})
    target = mi.render(scene, integrator=exact, spp=SPP, seed=0)
    parameters = mi.traverse(scene)
    keys = [key for key in parameters.keys() if key.endswith("emitter.radiance.value")][::every]
    checked = [keys[int(share * len(keys))] for share in CHECKED]
    truth = np.array([np.ravel(np.array(parameters[key])) for key in keys])
    optimizer = mi.ad.Adam(lr=RATE)
    for key in keys:
        optimizer[key] = mi.Color3f(GREY)

    def loss() -> tuple:
        picture = mi.render(scene, parameters, integrator=plugin, spp=SPP, seed=0)
        return dr.mean(dr.square(picture - target), axis=None), picture

    def of_light(key, value) -> float:
        kept = mi.Color3f(dr.detach(parameters[key]))
        parameters[key] = value
        parameters.update()
        result = float(loss()[0].array[0])
        parameters[key] = kept
        parameters.update()
        return result

    losses, start, seconds, agreement = [], None, [], []
    for step in range(steps):
        began = time.perf_counter()
        parameters.update(optimizer)
        value, picture = loss()
        dr.backward(value)
        if step == 0:
            start = np.array(picture)
            slopes = {key: np.ravel(np.array(optimizer[key].grad)).sum() for key in checked}
        optimizer.step()
        for key in keys:
            optimizer[key] = dr.maximum(optimizer[key], 0)
        losses.append(float(value.array[0]))
        seconds.append(time.perf_counter() - began)
        if step == 0:
            for key, slope in slopes.items():
                difference = (of_light(key, mi.Color3f(GREY + STEP)) - of_light(key, mi.Color3f(GREY - STEP))) / (2 * STEP)
                agreement.append(float(abs(slope / difference - 1)))
    found = np.array([np.ravel(np.array(optimizer[key])) for key in keys])
    with dr.suspend_grad():
        result = np.array(mi.render(scene, integrator=exact, spp=SPP, seed=0))
    pictures = {"start": start, "result": result, "target": np.array(target)}
    record = {"lights": len(keys), "steps": steps, "seconds_per_step": float(np.median(seconds)),
              "loss": [losses[0], losses[-1]], "derivative_against_differences": agreement,
              "mean_error_of_the_picture": [float(np.abs(image - pictures["target"]).mean() / pictures["target"].mean())
                                            for image in (start, result)],
              "power_of_the_panels": {"found": panels(found), "true": panels(truth)}}
    return record, pictures


def panels(colours: np.ndarray) -> list:
    """Mean colour of each of the three panels."""
    return [[round(float(c), 3) for c in panel.mean(axis=0)] for panel in np.array_split(colours, 3)]


def draw(pictures: dict, path: pathlib.Path) -> None:
    from matplotlib import pyplot

    from mi_shlight.panel import srgb

    figure, axes = pyplot.subplots(1, 3, figsize=(9, 3.2), constrained_layout=True)
    for axis, (name, image) in zip(axes, pictures.items()):
        axis.imshow(srgb(image))
        axis.set_title(name)
        axis.set_axis_off()
    figure.savefig(path, dpi=100)


def targets(record: dict) -> list:
    return [experiment.verdict("derivatives by three lights, against differences: off by at most 1 %",
                               max(record["derivative_against_differences"]), 0.01, text="{:.2%}"),
            experiment.verdict("mean error of the picture of the recovered lights at most 5 %",
                               record["mean_error_of_the_picture"][1], 0.05, text="{:.1%}")]


def main(arguments=None) -> None:
    options = experiment.options(__doc__, arguments, steps={"type": int, "default": 60, "help": "of Adam (default: %(default)s)"})
    mi.set_variant("llvm_ad_rgb")
    record, pictures = measure(1, 16, 60, order=2, transfer="unshadowed") if options.quick else measure(options.steps, SIZE)
    print(json.dumps(record, indent=1))
    record = {"targets": targets(record), **record}
    experiment.print_targets(record["targets"])
    experiment.write(options.out / "grid_inverse.json", record, options.quick)
    draw(pictures, options.out / "grid_inverse.png")


if __name__ == "__main__":
    main()
