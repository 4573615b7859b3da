"""Render a loaded scene in passes of bounded memory, and choose the `shprt` integrator to do it with."""
from __future__ import annotations

import numpy as np

from .errors import check_integer, message

# One pass holds about this many floats (samples times channels): 512 MiB.
PASS_FLOATS = 2**27


def sh_integrator(scene, overrides=None):
    """The `shprt` integrator of a scene with some parameters replaced.

    Parameters
    ----------
    scene : mitsuba.Scene
        If its own integrator is `shprt`, that one's parameters are the starting point; otherwise the defaults are.
    overrides : dict, optional
        `shprt` parameters that replace them.

    Returns
    -------
    integrator : mitsuba.Integrator
        The scene's own instance if nothing is overridden, else a new one.

    Raises
    ------
    RuntimeError
        Mitsuba's report of an unknown parameter or a bad value, naming it.
    """
    import mitsuba as mi

    own = scene.integrator()
    default = mi.load_dict({"type": "shprt"})
    inherits = isinstance(own, type(default))
    if inherits and not overrides:
        return own
    parameters = {**(own.parameters() if inherits else {}), **(overrides or {})}
    return mi.load_dict({"type": "shprt", **parameters}) if parameters else default


def check_view(scene, sensor=0, spp=0, seed=0):
    """The sensor object and the number of samples per pixel that `render` will use; raises as it does, but before any work."""
    sensors = scene.sensors()
    if not sensors:
        raise ValueError("render(): 'scene' must have a sensor, got none. Add a <sensor> to the scene file.")
    sensor = sensors[check_integer("render", "sensor", sensor, 0, len(sensors) - 1, "It is the index of a sensor of the scene.")]
    check_integer("render", "seed", seed, 0, 2**32 - 1)
    size = [int(n) for n in sensor.film().crop_size()]
    if min(size) < 1:
        raise ValueError(message("render", "film size", "be at least 1 x 1 pixels", f"{size[0]} x {size[1]}",
                                 "Set the film's width and height."))
    spp = check_integer("render", "spp", spp, 0, 2**24, "0 takes the number of the scene's sampler.")
    total = spp or sensor.sampler().sample_count()
    check_integer("render", "sample_count", total, 1, 2**24, "It is the number of samples per pixel of the scene's sampler.")
    return sensor, total


def render(scene, integrator, *, sensor=0, spp=0, seed=0, progress=None):
    """Render an image and name its channels.

    A single pass equals ``mi.render`` with the same seed. Larger images are averaged over passes with independent seeds so
    that memory stays bounded.

    Parameters
    ----------
    scene : mitsuba.Scene
    integrator : mitsuba.Integrator
    sensor : int, optional
        Index of the sensor in the scene.
    spp : int, optional
        Samples per pixel; 0 takes the number of the sensor's sampler.
    seed : int, optional
        Seed of the random numbers, 0 to 2**32 - 1.
    progress : callable, optional
        Called as ``progress(done, total)`` with samples per pixel after each pass.

    Returns
    -------
    image : numpy.ndarray, shape (H, W, C), float32
        The developed film.
    names : list of str
        Name of each channel, such as ``R``, ``G``, ``B``, ``L.0.0``.

    Raises
    ------
    TypeError, ValueError
        A number is of the wrong type or out of range.
    """
    import mitsuba as mi

    sensor, total = check_view(scene, sensor, spp, seed)
    film = sensor.film()
    width, height = film.crop_size()
    floats = width * height * (5 + len(integrator.aov_names()))
    step = max(1, min(total, PASS_FLOATS // floats))
    image, done = 0.0, 0
    while done < total:
        count = min(step, total - done)
        pass_seed = seed if done == 0 else mi.sample_tea_32(seed, done)[0]
        image = image + np.array(mi.render(scene, integrator=integrator, sensor=sensor, spp=count, seed=pass_seed)) * (count / total)
        done += count
        if progress:
            progress(done, total)
    return np.asarray(image, dtype=np.float32), [field.name for field in film.bitmap().struct_()]
