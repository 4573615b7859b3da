"""Tables of BSDFs against closed forms, numpy quadrature and Mitsuba's own sampling."""
import math

import numpy as np
import pytest

mi = pytest.importorskip("mitsuba")

import drjit as dr  # noqa: E402

from mi_shlight.light.zonal import phong_bands, times_pole_value  # noqa: E402
from mi_shlight.sh.lobes import sh_matrix  # noqa: E402
from mi_shlight.transfer.glossy import NODES, LobeQuadrature, Reflection, from_half, interpolate, look_at, row_length  # noqa: E402

ORDER = 6
FLAT = [1.0] * (ORDER + 1)
GLOSS = Reflection(0.0, True, False, None)
"""All of the BSDF goes to the table."""
HALF = [l * (l + 1) + m for l in range(ORDER + 1) for m in range(l + 1)]
CHECKER = {"type": "checkerboard", "color0": {"type": "rgb", "value": [0, 0, 0]}, "color1": {"type": "rgb", "value": [0.8, 0.4, 0.2]}}
GOLD = {"type": "roughconductor", "material": "Au", "alpha": 0.2}
PLASTIC = {"type": "roughplastic", "alpha": 0.3, "diffuse_reflectance": {"type": "rgb", "value": [0.5, 0.2, 0.1]}}
PRINCIPLED = {"type": "principled", "roughness": 0.5, "metallic": 0.5, "base_color": {"type": "rgb", "value": [0.5, 0.2, 0.1]}}


@pytest.fixture
def phong():
    """A modified Phong BSDF, ``f = (s + 2) / (2 pi) cos^s`` of the angle to the mirror direction, s = 12."""
    class Phong(mi.BSDF):
        def __init__(self, props):
            super().__init__(props)
            self.m_components = [int(mi.BSDFFlags.GlossyReflection) | int(mi.BSDFFlags.FrontSide)]
            self.m_flags = self.m_components[0]

        def eval(self, ctx, si, wo, active):
            up = active & (si.wi.z > 0) & (wo.z > 0)
            cosine = dr.maximum(dr.dot(mi.Vector3f(-si.wi.x, -si.wi.y, si.wi.z), wo), 0)
            return mi.Spectrum(14 / (2 * dr.pi) * cosine ** 12 * wo.z) & up

        def traverse(self, callback):
            pass

    mi.register_bsdf("test_phong", lambda props: Phong(props))
    return mi.load_dict({"type": "test_phong"})


def at_angles(table, theta, order=ORDER):
    """(angles, channels, coefficients with m >= 0)."""
    cosine, sine = (mi.Float(f(theta).tolist()) for f in (np.cos, np.sin))
    values = [interpolate(table, mi.UInt32(0), mi.UInt32(c), cosine, sine, order, True) for c in range(3)]
    dr.eval(values)
    return np.array([[np.array(v) for v in channel] for channel in values]).transpose(2, 0, 1)


def by_numpy(bsdf, theta, share=0.0, steps=144):
    """The same by a product quadrature over the hemisphere, which knows nothing of half vectors."""
    z, weight = np.polynomial.legendre.leggauss(steps)
    z, weight = (z + 1) / 2, weight / 2
    phi = (np.arange(steps) + 0.5) * (2 * math.pi / steps)
    sin = np.sqrt(1 - z * z)[:, None]
    omega = np.stack([sin * np.cos(phi), sin * np.sin(phi), np.broadcast_to(z[:, None], (steps, steps))], axis=-1).reshape(-1, 3)
    weighted = sh_matrix(omega, ORDER)[:, HALF] * np.repeat(weight * (2 * math.pi / steps), steps)[:, None]
    rows = []
    for angle in theta:
        si = dr.zeros(mi.SurfaceInteraction3f, len(omega))
        si.wi = mi.Vector3f(math.sin(angle), 0, math.cos(angle))
        value = np.array(bsdf.eval(mi.BSDFContext(), si, mi.Vector3f(np.ascontiguousarray(omega.T))))
        rho = np.array(bsdf.eval_diffuse_reflectance(si)) if share else np.zeros((3, 1))
        rows.append((value - share / math.pi * rho * omega[:, 2]) @ weighted)
    return np.array(rows)


@pytest.mark.parametrize("kind", [GOLD, PLASTIC, PRINCIPLED], ids=lambda kind: kind["type"])
def test_table_is_the_projection_of_the_bsdf(kind):
    bsdf = mi.load_dict(kind)
    found = look_at(bsdf, 1, kind is not GOLD)
    assert found.rest and found.complaint is None and (found.share > 0.1) == (kind is not GOLD)
    theta = np.radians([0, 7, 31, 62, 80])
    table = LobeQuadrature().table(bsdf, 1, found, ORDER, FLAT)
    assert dr.width(table) == NODES * 3 * row_length(ORDER)
    truth = by_numpy(bsdf, theta, found.share)
    assert np.abs(at_angles(table, theta) - truth).max() < 1e-3 * np.abs(truth).max()


def test_phong_lobe_seen_along_the_normal_is_zonal(phong):
    """There the BSDF times the cosine is a Phong lobe of the next exponent, whose coefficients are known in closed form."""
    assert look_at(phong, 1, False) == GLOSS
    table = LobeQuadrature().table(phong, 1, GLOSS, ORDER, FLAT)
    found = at_angles(table, np.array([0.0]))[0, 1]
    truth = np.array(from_half(list(found), ORDER), dtype=object)
    zonal = times_pole_value(phong_bands(13.0, ORDER))
    for l in range(ORDER + 1):
        assert abs(truth[l * (l + 1)] - zonal[l]) < 2e-6
        assert all(abs(truth[l * (l + 1) + m]) < 2e-6 and truth[l * (l + 1) - m] is None for m in range(1, l + 1))


def test_constant_light_gives_the_albedo():
    """Mitsuba's own importance sampling knows the directional albedo, too."""
    bsdf, theta = mi.load_dict(GOLD), np.radians([20.0, 65.0])
    table = LobeQuadrature().table(bsdf, 1, GLOSS, ORDER, FLAT)
    found = at_angles(table, theta)[:, :, 0] * math.sqrt(4 * math.pi)
    for angle, albedo in zip(theta, found):
        si = dr.zeros(mi.SurfaceInteraction3f, 1 << 16)
        si.wi = mi.Vector3f(math.sin(angle), 0, math.cos(angle))
        sampler = mi.load_dict({"type": "independent"})
        sampler.seed(0, 1 << 16)
        weight = bsdf.sample(mi.BSDFContext(), si, sampler.next_1d(), sampler.next_2d())[1]
        assert np.allclose(albedo, np.array(weight).mean(axis=1), rtol=2e-3)


def test_window_scales_the_degrees():
    bsdf, factors = mi.load_dict(GOLD), [0.5 ** l for l in range(ORDER + 1)]
    plain, scaled = (at_angles(LobeQuadrature().table(bsdf, 1, GLOSS, ORDER, f), np.array([0.7]))[0, 0] for f in (FLAT, factors))
    assert np.allclose(scaled, plain * [factors[math.isqrt(i)] for i in HALF], atol=1e-7)


@pytest.mark.parametrize("reflectance", [{"type": "rgb", "value": 0.4}, CHECKER], ids=["uniform", "textured"])
def test_diffuse_bsdf_leaves_nothing_to_tabulate(reflectance):
    bsdf = mi.load_dict({"type": "twosided", "nested": {"type": "diffuse", "reflectance": reflectance}})
    assert [look_at(bsdf, side, True) for side in (1, -1)] == [(1.0, False, False, None)] * 2


def test_back_of_a_two_sided_bsdf_is_its_own():
    front, back = GOLD, {"type": "roughconductor", "material": "Al", "alpha": 0.4}
    both = mi.load_dict({"type": "twosided", "front": front, "back": back})
    quadrature = LobeQuadrature()
    for kind, side in ((front, 1), (back, -1)):
        assert look_at(both, side, False).rest
        tables = quadrature.table(both, side, GLOSS, ORDER, FLAT), quadrature.table(mi.load_dict(kind), 1, GLOSS, ORDER, FLAT)
        assert np.array_equal(*map(np.array, tables))
    assert not look_at(mi.load_dict(front), -1, False).rest


def test_textured_gloss_is_taken_at_its_mean():
    def table(colour):
        bsdf = mi.load_dict({"type": "principled", "roughness": 0.4, "metallic": 1.0, "base_color": colour})
        found = look_at(bsdf, 1, False)
        return found, np.array(LobeQuadrature().table(bsdf, 1, found, ORDER, FLAT))

    found, mean = table(CHECKER)
    assert found.textured and "mean of its textures" in found.complaint
    ends = [table({"type": "rgb", "value": value}) for value in ([0, 0, 0], [0.8, 0.4, 0.2])]
    assert not any(found.textured or found.complaint for found, _ in ends)
    assert np.abs(mean - (ends[0][1] + ends[1][1]) / 2).max() < 0.03 * np.abs(mean).max()


def test_sharp_gloss_on_a_diffuse_base_is_not_overlooked():
    assert look_at(mi.load_dict(dict(PLASTIC, alpha=0.01)), 1, True).rest


def test_anisotropic_gloss_is_refused_and_its_diffuse_part_kept():
    found = look_at(mi.load_dict({"type": "roughconductor", "alpha_u": 0.1, "alpha_v": 0.4}), 1, False)
    assert not found.rest and found.share == 0 and "anisotropic" in found.complaint


def test_derivative_by_roughness():
    bsdf, step = mi.load_dict(GOLD), 2e-3
    parameters, quadrature = mi.traverse(bsdf), LobeQuadrature()

    def total(alpha):
        parameters["alpha.value"] = alpha
        parameters.update()
        table = quadrature.table(bsdf, 1, GLOSS, ORDER, FLAT)
        seen = interpolate(table, mi.UInt32(0), mi.UInt32(1), mi.Float(np.cos(0.6)), mi.Float(np.sin(0.6)), ORDER, True)
        return sum(value * (1 + i % 3) for i, value in enumerate(seen))

    alpha = mi.Float(0.2)
    dr.enable_grad(alpha)
    dr.backward(total(alpha))
    difference = (total(mi.Float(0.2 + step)) - total(mi.Float(0.2 - step))) / (2 * step)
    assert abs(dr.grad(alpha)[0] - difference[0]) < 1e-3 * abs(difference[0])
