"""Compare spherical-harmonics shading with Mitsuba's path tracing of the same scene: errors, times and a picture."""
from __future__ import annotations

import json
import time
from pathlib import Path
from statistics import median

import numpy as np

from .errors import check_integer, message
from .exr import write_exr
from .files import replacing
from .panel import draw_panel, require_matplotlib
from .rendering import check_view, render, sh_integrator

REPEATS = 3


def compare(scene, folder, *, integrator=None, spp=16, reference_spp=1024, sensor=0, seed=0, title="scene", metadata=None,
            progress=None):
    """Render a scene with `shprt` and with `path`, and write both images, a panel and a report.

    The reference is Mitsuba's ``path`` with ``max_depth=2``: emission and direct illumination; with interreflected transfer of N bounces
    ``max_depth`` is N + 2, and without limit where their number is open.
    It is rendered as two independent halves, whose difference tells the noise of their mean. Errors are taken over the pixels
    that see a surface and no part of an emitter.

    Parameters
    ----------
    scene : mitsuba.Scene
        Loaded with ``optimize=False`` while a JIT variant is active.
    folder : str or os.PathLike
        Existing folder; receives ``sh.exr``, ``reference.exr``, ``panel.png`` and ``report.json``.
    integrator : mitsuba.Integrator, optional
        The `shprt` to judge; by default the scene's own, or one with default parameters.
    spp : int, optional
        Samples per pixel of the `shprt` image, and of both integrators in the timings.
    reference_spp : int, optional
        Samples per pixel of the reference, both halves together; even.
    sensor, seed : int, optional
        Index of the sensor; seed of the random numbers.
    title : str, optional
        Name of the scene in the panel and the report.
    metadata : dict, optional
        Further attributes of the EXR files.
    progress : callable, optional
        Called as ``progress(label, done, total)``.

    Returns
    -------
    report : dict
        ``errors`` (see `image_errors`), ``noise`` (the same figures for the reference's own Monte Carlo error) and ``times`` in
        seconds: ``bake`` (finding the lights and baking or reading the transfer), ``first_render`` (compile and render), ``sh``
        and ``direct`` (median of three repeated renders at the same `spp`) and their ratio ``sh_over_direct``.

    Raises
    ------
    ImportError
        matplotlib is missing (extra ``plot``).
    TypeError, ValueError
        A number is of the wrong type or out of range.
    OSError
        `folder` does not exist or is not writable.
    """
    import mitsuba as mi

    from .shading.settings import parse_transfer

    folder = Path(folder)
    if not folder.is_dir():
        raise NotADirectoryError(message("compare", "folder", "be an existing folder", str(folder), "Create it first."))
    spp = check_integer("compare", "spp", spp, 1, 2**24)
    reference_spp = check_integer("compare", "reference_spp", reference_spp, 2, 2**24)
    seed = check_integer("compare", "seed", seed, 0, 2**32 - 1)
    require_matplotlib()
    check_view(scene, sensor, spp, seed)
    integrator = sh_integrator(scene) if integrator is None else integrator

    def image(what, label, samples, image_seed):
        bar = (lambda done, total: progress(label, done, total)) if progress else None
        return render(scene, what, sensor=sensor, spp=samples, seed=image_seed, progress=bar)

    start = time.perf_counter()
    integrator.prepare_scene(scene, (lambda done, total: progress("bake", done, total)) if progress else False)
    bake = time.perf_counter() - start
    sh, names = image(integrator, "shprt", spp, seed)
    first_render = time.perf_counter() - start - bake

    depth = integrator.bounces + 2 if integrator.bounces else -1
    if not parse_transfer("compare", integrator.transfer).interreflected:
        depth = 2
    path = mi.load_dict({"type": "path", "max_depth": depth})
    half = (reference_spp + 1) // 2
    halves = [colours(*image(path, f"path, half {k} of 2", half, mi.sample_tea_32(seed, k)[0])) for k in (1, 2)]
    reference = (halves[0] + halves[1]) / 2
    mask = shaded_pixels(scene, sensor)
    # One half minus the mean of both is half their difference, which is distributed like the error of that mean.
    noise = image_errors(halves[0], reference, mask)
    errors = image_errors(colours(sh, names), reference, mask)

    times = {"first_render": first_render, "bake": bake}
    direct = mi.load_dict({"type": "direct"})
    render(scene, direct, sensor=sensor, spp=spp, seed=seed)  # compiles
    samples = {"sh": [], "direct": []}
    for _ in range(REPEATS):  # alternating, so that a change of the machine's load meets both
        for key, what in (("sh", integrator), ("direct", direct)):
            start = time.perf_counter()
            render(scene, what, sensor=sensor, spp=spp, seed=seed)
            samples[key].append(time.perf_counter() - start)
    times.update({key: median(values) for key, values in samples.items()})
    times["sh_over_direct"] = times["sh"] / times["direct"]

    settings = {**(metadata or {}), **integrator.parameters()}
    report = {"scene": title, "size": [sh.shape[1], sh.shape[0]], "spp": spp, "reference_spp": 2 * half, "seed": seed,
              "reference": f"path, max_depth={depth}", "settings": settings, "errors": errors,
              "noise": noise, "times": times, "shaded_pixels": int(mask.sum())}

    planes = dict(zip(names, np.moveaxis(sh, -1, 0)))
    write_exr(folder / "sh.exr", planes, {**settings, "spp": spp, "seed": seed})
    write_exr(folder / "reference.exr", dict(zip("RGB", np.moveaxis(reference, -1, 0))),
              {"integrator": "path", "max_depth": depth, "spp": 2 * half, "seed": seed})
    draw_panel(folder / "panel.png", colours(sh, names), reference, mask, report)
    with replacing(folder / "report.json") as temporary:
        temporary.write_text(json.dumps(report, indent=2) + "\n")
    return report


def colours(image, names):
    """The (H, W, 3) colour of an image with named channels; a luminance image gives three equal channels."""
    picked = ["R", "G", "B"] if "R" in names else ["Y", "Y", "Y"]
    return np.stack([image[..., names.index(name)] for name in picked], axis=-1)


def shaded_pixels(scene, sensor=0, spp=64):
    """The pixels that see a surface and no part of an emitter, as an (H, W) array of bool.

    The neighbours of a pixel that shows an emitter count as showing it too: the few samples of this test may miss a sliver of it.
    """
    import mitsuba as mi

    depth, emission = (colours(*render(scene, mi.load_dict(probe), sensor=sensor, spp=spp)).max(axis=-1)
                       for probe in ({"type": "depth"}, {"type": "path", "max_depth": 1}))
    near_emitter = np.lib.stride_tricks.sliding_window_view(np.pad(emission > 0, 1), (3, 3)).any(axis=(2, 3))
    return (depth > 0) & ~near_emitter


def image_errors(image, reference, mask):
    """Figures for the difference of two images over some of their pixels.

    Parameters
    ----------
    image, reference : array_like, shape (H, W, C)
    mask : array_like of bool, shape (H, W)
        The pixels to take.

    Returns
    -------
    errors : dict of str to float
        With a the image and b the reference: ``mean_relative`` = sum|a-b| / sum b, ``bias`` = sum(a-b) / sum b, ``rmse`` in the
        unit of the images, and ``p95``, ``p99``, ``max``: percentiles and maximum over pixels of the channel mean of |a-b|,
        divided by the mean of b.

    Raises
    ------
    ValueError
        The reference is black on all of the pixels.
    """
    a, b = (np.asarray(values, dtype=np.float64)[np.asarray(mask)] for values in (image, reference))
    if not b.sum() > 0:
        raise ValueError("image_errors(): 'reference' must have light on the pixels of the mask, got none. "
                         "No lit surface is in view: check the scene's camera and lights.")
    difference = np.abs(a - b)
    pixels = difference.mean(axis=-1) / b.mean()
    return {"mean_relative": float(difference.sum() / b.sum()), "bias": float((a - b).sum() / b.sum()),
            "rmse": float(np.sqrt((difference**2).mean())), "p95": float(np.percentile(pixels, 95)),
            "p99": float(np.percentile(pixels, 99)), "max": float(pixels.max())}
