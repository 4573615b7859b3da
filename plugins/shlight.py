"""Polygonal light (``shlight``)
------------------------------

A diffuse light on the outside of a shape, with the radiometry of Mitsuba's ``area``: under ``path``, ``direct``,
``volpath``, ``prb`` and ``ptracer`` both give the same image. The integrator ``shprt`` projects a light on a rectangle
or a polygon mesh analytically to spherical harmonics; it accepts ``area`` lights too. This plugin adds light from both
sides, and how finely a texture is resolved there.

.. pluginparameters::

 * - radiance
   - |spectrum| or |texture| or |float|
   - Emitted radiance in W/(m^2 sr), per nanometre in spectral variants. A number stands for white (D65).
     (Default: 1)
   - |exposed|, |differentiable|

 * - two_sided
   - |bool|
   - Emit the same radiance on the inside of the shape, too. (Default: false)

 * - subdivisions
   - |int|
   - Number of triangles of uniform radiance into which ``shprt`` cuts the light if its radiance is a texture, 1 to 65536;
     of no effect on other lights and under other integrators. The nearest number that makes a grid is taken: of
     2 a b triangles on a rectangle, with cells nearly square, otherwise of s^2 on each face of the mesh. 1 stands for
     the texture's mean on a planar light as a whole, which is as fast as a light without texture. (Default: 128)

 * - sampling_weight
   - |float|
   - Relative number of samples that integrators spend on this light. (Default: 1)
   - |exposed|

 * - (nested)
   - |medium|
   - Medium that surrounds the light, if any.
   - |exposed|

A light belongs inside a shape, whose place and size it takes: ``to_world`` is refused. Without a shape it cannot emit,
and the first render that asks it for light stops with an error, where ``area`` would silently stay dark.

.. tabs::
    .. code-tab:: xml

        <shape type="rectangle" id="light">
            <emitter type="shlight">
                <rgb name="radiance" value="18.4, 14.0, 6.8"/>
            </emitter>
        </shape>

    .. code-tab:: python

        'type': 'rectangle',
        'emitter': {
            'type': 'shlight',
            'radiance': {
                'type': 'rgb',
                'value': [18.4, 14.0, 6.8],
            }
        }

``mi.traverse`` exposes the radiance as ``light.emitter.radiance.value`` (a texture under ``light.emitter.radiance.data``).
"""
from __future__ import annotations

import textwrap

from ..errors import check_integer, check_parameters, message
from ..light.cut import SUBDIVISIONS


class DetachedLightError(RuntimeError):
    """A light was asked to emit, but stands outside a shape."""


def detached_light(light) -> DetachedLightError:
    """The error for a light outside a shape; raise what is returned.

    Parameters
    ----------
    light : mi.Emitter
        The light; its identifier goes into the message.
    """
    name = light.id()
    # Mitsuba invents identifiers for nodes that have none.
    got = "one that stands on its own" if not name or name.startswith("_") else f"'{name}', which stands on its own"
    return DetachedLightError(
        f"shlight(): an emitter of type 'shlight' must be inside a shape, which it lights up, got {got}. Move the "
        "<emitter> into a <shape>, such as <shape type=\"rectangle\"> with its 'to_world'.")


def check_attached(scene) -> None:
    """Raise if a ``shlight`` of the scene stands outside a shape.

    Parameters
    ----------
    scene : mi.Scene

    Raises
    ------
    DetachedLightError
        Names the light and the remedy.
    """
    for light in scene.emitters():
        if type(light).__name__ == "SHLight" and light.get_shape() is None:
            raise detached_light(light)


def build():
    """Class of the emitter for Mitsuba's current variant, whose types it is bound to."""
    import drjit as dr
    import mitsuba as mi

    def quotient(a, b):
        """a / b, and 0 instead of Python's ZeroDivisionError in scalar variants."""
        if dr.is_jit_v(mi.Float):
            return a / b
        return a / b if b != 0 else a * 0

    def wavelength_samples(sample):
        """As many stratified samples as a ray carries wavelengths: none in rgb and mono variants."""
        return mi.sample_shifted(sample) if mi.is_spectral else mi.Color0f()

    class SHLight(mi.Emitter):
        __doc__ = globals()["__doc__"]

        def __init__(self, props):
            if "to_world" in props:
                raise ValueError(message(
                    "shlight", "to_world", "not be given", props["to_world"],
                    "The light takes the place and size of its shape: move 'to_world' to the shape."))
            super().__init__(props)
            self.radiance = self._read_radiance(props)
            self.two_sided = props.get("two_sided", False)
            if not isinstance(self.two_sided, bool):
                raise TypeError(message("shlight", "two_sided", "be true or false", self.two_sided))
            self.subdivisions = check_integer("shlight", "subdivisions", props.get("subdivisions", SUBDIVISIONS), 1, 65536,
                                              "It is a number of triangles.")
            check_parameters("shlight", props, ("radiance", "two_sided", "subdivisions", "sampling_weight"), props.unqueried())
            # Not yet `Surface`: a scene silently drops a surface emitter that no shape brings in. See `surface`.
            self.m_flags = int(mi.EmitterFlags.SpatiallyVarying if self.radiance.is_spatially_varying()
                               else mi.EmitterFlags.Empty)

        @staticmethod
        def _read_radiance(props):
            kinds = mi.Properties.Type
            if "radiance" in props:
                kind = props.type("radiance")
                valid = (isinstance(props["radiance"], mi.Texture) if kind == kinds.Object
                         else kind in (kinds.Float, kinds.Integer, kinds.Color, kinds.Spectrum))
                if not valid:
                    raise TypeError(message(
                        "shlight", "radiance", "be a spectrum, a texture or a number, in W/(m^2 sr)", props["radiance"],
                        'For instance <rgb name="radiance" value="1, 1, 1"/>.'))
            return props.get_emissive_texture("radiance", 1.0)

        def surface(self):
            """The shape that emits; DetachedLightError if there is none."""
            shape = self.get_shape()
            if shape is None:
                raise detached_light(self)
            # Every use that depends on the flag samples the light first, and so passes here.
            self.m_flags = int(self.m_flags) | int(mi.EmitterFlags.Surface)
            return shape

        def flags(self, active=True):
            if self.get_shape() is not None:
                self.surface()
            return super().flags(active)

        def traverse(self, callback):
            super().traverse(callback)
            callback.put("radiance", self.radiance, mi.ParamFlags.Differentiable)

        def emitted_cosine(self, cosine):
            """Cosine between the direction of emission and the normal of the side that emits, 0 or less where none does."""
            return abs(cosine) if self.two_sided else cosine

        def eval(self, si, active=True):
            emits = active & (self.emitted_cosine(mi.Frame3f.cos_theta(si.wi)) > 0)
            return mi.depolarizer(self.radiance.eval(si, active)) & emits

        def sample_direction(self, it, sample, active=True):
            shape = self.surface()
            if not self.radiance.is_spatially_varying():
                ds = shape.sample_direction(it, sample, active)
                active = active & (self.emitted_cosine(-dr.dot(ds.d, ds.n)) > 0) & (ds.pdf != 0)
                si = mi.SurfaceInteraction3f(ds, it.wavelengths)
            else:
                ds, si, active = self._sample_texture_direction(shape, it, sample, active)
            ds.emitter = mi.EmitterPtr(self) if dr.is_jit_v(mi.Float) else self
            weight = quotient(self.radiance.eval(si, active), ds.pdf)
            return ds, mi.depolarizer(weight) & active

        def _sample_texture_direction(self, shape, it, sample, active):
            si, density, active = self._sample_texture(shape, sample, active)
            si.wavelengths = it.wavelengths
            ds = mi.DirectionSample3f()
            ds.p = si.p
            ds.n = si.n
            ds.uv = si.uv
            ds.time = it.time
            ds.delta = False
            ds.d = ds.p - it.p
            squared_distance = dr.squared_norm(ds.d)
            ds.dist = dr.sqrt(squared_distance)
            ds.d = quotient(ds.d, ds.dist)
            cosine = self.emitted_cosine(-dr.dot(ds.d, ds.n))
            active = active & (cosine > 0)
            ds.pdf = dr.select(active, quotient(density * squared_distance, cosine), 0)
            return ds, si, active

        def _sample_texture(self, shape, sample, active):
            """Point on the shape with density proportional to the texture, and that density per unit area."""
            uv, density = self.radiance.sample_position(sample, active)
            active = active & (density != 0)
            si = shape.eval_parameterization(uv, active=active)
            active = active & si.is_valid()
            return si, quotient(density, dr.norm(dr.cross(si.dp_du, si.dp_dv))), active

        def pdf_direction(self, it, ds, active=True):
            shape = self.surface()
            cosine = self.emitted_cosine(-dr.dot(ds.d, ds.n))
            active = active & (cosine > 0)
            if not self.radiance.is_spatially_varying():
                density = shape.pdf_direction(it, ds, active)
            else:
                si = shape.eval_parameterization(ds.uv, active=active)
                active = active & si.is_valid()
                density = quotient(self.radiance.pdf_position(ds.uv, active) * dr.square(ds.dist),
                                   dr.norm(dr.cross(si.dp_du, si.dp_dv)) * cosine)
            return dr.select(active, density, 0)

        def eval_direction(self, it, ds, active=True):
            active = active & (self.emitted_cosine(-dr.dot(ds.d, ds.n)) > 0)
            si = mi.SurfaceInteraction3f(ds, it.wavelengths)
            return mi.depolarizer(self.radiance.eval(si, active)) & active

        def sample_position(self, time, sample, active=True):
            """A point of the emitting surface. Of a two-sided light both sides belong to it, and the normal tells which it is."""
            shape = self.surface()
            if self.two_sided:
                back = sample.x >= 0.5
                sample = mi.Point2f(2 * sample.x - dr.select(back, mi.Float(1), 0), sample.y)
            if not self.radiance.is_spatially_varying():
                ps = shape.sample_position(time, sample, active)
            else:
                si, density, active = self._sample_texture(shape, sample, active)
                ps = mi.PositionSample3f(si)
                ps.pdf = density
                ps.delta = False
            if self.two_sided:
                ps.pdf *= 0.5
                ps.n = dr.select(back, -ps.n, ps.n)
            return ps, dr.select(active & (ps.pdf > 0), quotient(1, ps.pdf), 0)

        def pdf_position(self, ps, active=True):
            shape = self.surface()
            if not self.radiance.is_spatially_varying():
                density = shape.pdf_position(ps, active)
            else:
                si = shape.eval_parameterization(ps.uv, active=active)
                density = quotient(self.radiance.pdf_position(ps.uv, active), dr.norm(dr.cross(si.dp_du, si.dp_dv)))
                density = dr.select(active & si.is_valid(), density, 0)
            return density * 0.5 if self.two_sided else density

        def sample_wavelengths(self, si, sample, active=True):
            wavelengths, weight = self.radiance.sample_spectrum(si, wavelength_samples(sample), active)
            return wavelengths, mi.Spectrum(weight)

        def sample_ray(self, time, sample1, sample2, sample3, active=True):
            ps, area = self.sample_position(time, sample2, active)
            local = mi.warp.square_to_cosine_hemisphere(sample3)
            si = mi.SurfaceInteraction3f(ps, dr.zeros(type(wavelength_samples(sample1))))
            wavelengths, weight = self.sample_wavelengths(si, sample1, active)
            si.time = time
            si.wavelengths = wavelengths
            # The cosine of the emission and that of the density of `local` cancel, which leaves pi.
            if mi.is_polarized:
                weight = mi.depolarizer(weight[0, 0])
            return si.spawn_ray(si.to_world(local)), area * weight * dr.pi

        def bbox(self):
            return self.surface().bbox()

        def to_string(self):
            lines = [f"radiance = {self.radiance}", f"two_sided = {str(self.two_sided).lower()}"]
            if self.radiance.is_spatially_varying():
                lines.append(f"subdivisions = {self.subdivisions}")
            shape = self.get_shape()
            if shape is None:
                lines.append("shape = none: it must be inside a shape to emit")
            else:
                lines.append(f"shape = {shape.class_name()} '{shape.id()}'")
                lines.append(f"surface_area = {dr.slice(shape.surface_area(), 0):g}"
                             if dr.is_jit_v(mi.Float) else f"surface_area = {shape.surface_area():g}")
                lines.append(f"bbox = {shape.bbox()}")
            if self.get_medium() is not None:
                lines.append(f"medium = {self.get_medium()}")
            return "SHLight[\n" + textwrap.indent(",\n".join(lines), "  ") + "\n]"

    return SHLight
