"""Derivatives by the zonal recurrence: reference values, Gauss-Legendre along edges, autodiff, degenerate input, forms of the loop."""
import drjit as dr
import numpy as np
import pytest

import reference
from mi_shlight.light import recurrence
from mi_shlight.light.polygon import VertexList, edge_frame, interior_direction
from mi_shlight.light.recurrence import (arc_series, edge_shares, line_integrals, project_recurrence, project_recurrence_lines,
                                         project_recurrence_spatial, share_integrals)

CASES = reference.reference_cases()
ORDER, COUNT = 6, 49
LARGEST = max(len(case.vertices) for case in CASES)
QUAD = np.array([[-0.5, -0.4, 1.2], [0.6, -0.5, 1.0], [0.7, 0.5, 0.8], [-0.4, 0.6, 1.0]])

# Relative L2 error at order 6 by class of the reference set, the first key that fits: (float32, float64).
VERTEX = {"distance 10": (4e-5, 2e-11), "": (1e-5, 3e-12)}
"""Of the derivatives by all vertices. Distant lights have the short edges where the odd share errs most (see share_integrals)."""
EDGE = {"": (7e-5, 5e-11)}
"""Of what either end of an edge does: small on short and on nearly radial edges."""
SPATIAL = {"distance 10000": (0.1, 3e-10), "distance 1000": (5e-3, 1e-11), "distance 100": (5e-4, 1e-12), "distance 10": (5e-5, 1e-13),
           "distance": (np.inf, 2e-8), "sliver 0.01": (3e-4, 1e-12), "sliver 0.0001": (0.05, 2e-10), "sliver": (np.inf, 2e-8),
           "": (1e-5, 5e-14)}
"""Of the derivative by the point: edge terms of size theta leave theta^2, as in the coefficients."""


def limit(table, case, precision):
    return next(limits for name, limits in table.items() if case.name.startswith(name))[precision.eps < 1e-10]


def relative(a, b):
    return np.linalg.norm(a - b) / np.linalg.norm(b)


def wide(precision, points):
    """A Dr.Jit vector of many points (count, 3)."""
    return precision.Array3(*(precision.Float(np.ascontiguousarray(c).tolist()) for c in np.asarray(points, dtype=float).T))


def opaque(precision, v):
    """A vector whose numbers do not become part of the kernel."""
    return precision.Array3(*(dr.opaque(precision.Float, float(c)) for c in v))


def seen(precision, vertices, x=(0, 0, 0)):
    v, x = [opaque(precision, p) for p in vertices], opaque(precision, x)
    return VertexList(v), x, interior_direction(v, x)


def numbers(values):
    dr.eval(values)
    return np.array([np.array(v)[0] for v in values], dtype=float)


def vertex_gradients(rows, count):
    """(N, 3, count) from the rows of project_recurrence_lines."""
    rows = np.array([numbers(row) for row in rows])
    moments = -np.stack([rows[:, :count], rows[:, count:2 * count]], axis=1)
    return reference.expand_gradients(rows[:, 2 * count:], moments)


def spatial(precision, light, x, apex, order):
    coeffs, slopes = project_recurrence_spatial(light, x, apex, order)
    dr.eval(coeffs, slopes)
    return numbers(coeffs), np.array([numbers(part) for part in slopes])


def test_reference_by_vertex(precision):
    """All edges of all cases as lanes of one polygon with two corners, whose first edge is looked at."""
    starts, ends = (wide(precision, np.concatenate([np.roll(case.vertices, -k, axis=0) for case in CASES])) for k in (0, 1))
    x = precision.vector((0, 0, 0))
    _, rows = project_recurrence_lines(VertexList([starts, ends]), x, precision.vector((0, 0, 1)), ORDER)
    dr.eval(rows)
    edges, errors = np.array([np.array(value) for value in rows[0]], dtype=float).T, {}
    for case in CASES:
        row, edges = edges[:len(case.vertices)], edges[len(case.vertices):]
        moments, exact = -np.stack([row[:, :COUNT], row[:, COUNT:2 * COUNT]], axis=1), case.moments[:, :, :COUNT]
        whole = relative(reference.expand_gradients(row[:, 2 * COUNT:], moments), case.gradients[..., :COUNT])
        edge = max(relative(a, b) for a, b in zip(moments, exact))
        if not (whole <= limit(VERTEX, case, precision) and edge <= limit(EDGE, case, precision)):
            errors[case.name] = whole, edge
    assert not errors


def test_reference_by_point(precision):
    """Fewer corners are repeated in place: edges without length add nothing."""
    corners = np.array([case.vertices[np.arange(LARGEST) * len(case.vertices) // LARGEST] for case in CASES])
    light, x = VertexList([wide(precision, corners[:, i]) for i in range(LARGEST)]), precision.vector((0, 0, 0))
    coeffs, slopes = project_recurrence_spatial(light, x, interior_direction(light.vertices, x), ORDER)
    values = project_recurrence(light, x, interior_direction(light.vertices, x), ORDER)
    dr.eval(coeffs, slopes, values)
    slopes, errors = np.array([[np.array(value) for value in part] for part in slopes], dtype=float), {}
    for k, case in enumerate(CASES):
        error = relative(slopes[..., k], -case.gradients[..., :COUNT].sum(axis=0))
        if not (error <= limit(SPATIAL, case, precision) or np.isfinite(error) and limit(SPATIAL, case, precision) == np.inf):
            errors[case.name] = error
    assert not errors
    solid_angle = np.abs(np.array(values[0]))
    for a, b in zip(coeffs, values):
        assert np.all(np.abs(np.array(a) - np.array(b)) <= 60 * precision.eps * np.maximum(solid_angle, 1))


ARCS = [1e-9, 1e-6, 3e-5, 1e-4, 1e-3, 0.03, 0.5, 1.5, 2.5, 3.1, 3.1415]


@pytest.mark.parametrize("arc", ARCS)
@pytest.mark.parametrize("lobe", [(0, 0, 1), (0, 0, -1), (1, 0, 0), (0, 1, 0), (0.36, 0.48, 0.8), (1e-9, 0, 1)], ids=str)
def test_line_integrals(arc, lobe):
    """Double precision against 40 Gauss-Legendre nodes along an edge in the x-y plane, also for lobes along its normal."""
    order = 14
    vector = dr.scalar.Array3f64
    frame = edge_frame(vector(1, 0, 0), vector(np.cos(arc), np.sin(arc), 0))
    shares, series = edge_shares(frame, type(frame.arc)(1)), arc_series(frame, order, lobe)
    nodes, weights = np.polynomial.legendre.leggauss(40)
    h = 0.5 * arc
    s, weights = h * nodes, h * weights
    z = lobe[0] * np.cos(h + s) + lobe[1] * np.sin(h + s)
    p = np.polynomial.legendre.legvander(z, order)
    even, odd = ((weights * share) @ p for share in (np.cos(s) / (2 * np.cos(h)), np.sin(s) / (2 * np.sin(h))))
    ours = share_integrals(series, shares, frame)
    combined = line_integrals(series, shares, 0.3, 0.2)
    scale = np.tan(h)                                # of the integral of the even share
    close = lambda a, b, units: np.allclose(np.array(a, dtype=float), b, rtol=0, atol=units * 2.2e-16 * scale)
    loss = 1 / max(np.cos(h), 1e-2)                  # where the arc is nearly half a circle, an end moved by eps turns its plane
    assert close(ours[0], even, 200 * loss)
    assert close(ours[1], odd, (200 + 1e5 * (arc < 0.03)) * loss)
    assert close(combined, 0.3 * even - 0.2 * odd, (200 + 50 / scale) * loss)


@pytest.mark.parametrize("mode", ["forward", "backward"])
def test_equal_to_autodiff_through_the_recurrence(mode):
    number, vector = dr.llvm.ad.Float64, dr.llvm.ad.Array3f64
    order, rng = 3, np.random.default_rng(5)
    moves, weights = rng.normal(size=(5, 3)), rng.normal(size=16)
    t = number(0)
    dr.enable_grad(t)
    moved = [vector(*map(float, v)) + t * vector(*map(float, d)) for v, d in zip(np.vstack([QUAD, [0.1, 0.2, 0.1]]), moves)]
    light, x = VertexList(moved[:-1]), moved[-1]
    apex = interior_direction(light.vertices, x)
    value = sum(float(w) * c for w, c in zip(weights, project_recurrence(light, x, apex, order)))
    if mode == "forward":
        dr.forward(t)
    else:
        dr.backward(value)
    auto = dr.grad(value if mode == "forward" else t)[0]
    light, x = light.detached(), dr.detach(x)
    by_vertex = vertex_gradients(project_recurrence_lines(light, x, apex, order)[1], 16)
    by_point = np.array([numbers(part) for part in project_recurrence_spatial(light, x, apex, order)[1]])
    analytic = np.einsum("ik,ikc,c", moves[:-1], by_vertex, weights) + moves[-1] @ by_point @ weights
    assert analytic == pytest.approx(auto, rel=1e-12)


DEGENERATE = {
    "coincident vertices": [QUAD[0], QUAD[0], QUAD[1], QUAD[2]],
    "vertex at the point": [(0, 0, 0), QUAD[1], QUAD[2], QUAD[3]],
    "edge through the point": [(-1, 0, 0), (1, 0, 0), (1, 1, 0.5), (-1, 1, 0.5)],
    "all at the point": [(0, 0, 0)] * 4,
    "vertices on one ray": [QUAD[0], 2 * QUAD[0], QUAD[1], QUAD[2]],
    "far": QUAD * 1e15,
    "tiny": QUAD * 1e-15,
}


@pytest.mark.parametrize("name", DEGENERATE)
def test_degenerate_edges(precision, name):
    light, x, apex = seen(precision, DEGENERATE[name])
    _, rows = project_recurrence_lines(light, x, apex, 2)
    coeffs, slopes = spatial(precision, light, x, apex, 2)
    rows = np.array([numbers(row) for row in rows])
    assert np.isfinite(rows).all() and np.isfinite(coeffs).all() and np.isfinite(slopes).all()
    flat = np.linalg.norm(rows[:, 18:], axis=1) == 0
    assert flat.sum() == {"far": 0, "tiny": 0, "all at the point": 4, "vertex at the point": 2}.get(name, 1)
    assert not rows[flat].any()


def test_scale(precision):
    """The derivative is inversely proportional to the size, down to sizes whose square is no float any more."""
    (_, a), (_, b) = (spatial(precision, *seen(precision, QUAD * scale), 2) for scale in (1, 2.0 ** -70))
    assert relative(b * 2.0 ** -70, a) < 30 * precision.eps


def test_unrolled_looped_and_scalar_forms_agree(monkeypatch):
    """One body, several bodies, a symbolic loop over the lobes, Python floats."""
    def both(v, x):
        light, apex = VertexList(v), interior_direction(v, x)
        values, rows = project_recurrence_lines(light, x, apex, 3)
        coeffs, slopes = project_recurrence_spatial(light, x, apex, 3)
        flat = [*values, *(value for row in rows for value in row), *coeffs, *(value for part in slopes for value in part)]
        dr.eval(flat)
        return np.array([value if isinstance(value, float) else value[0] for value in flat])

    forms = []
    for vector, unroll, size in ((dr.llvm.ad.Array3f64, 14, 8000), (dr.llvm.ad.Array3f64, 14, 400), (dr.llvm.ad.Array3f64, 2, 8000),
                                 (dr.scalar.Array3f64, 14, 8000)):
        monkeypatch.setattr(recurrence, "UNROLL_ORDER", unroll)
        monkeypatch.setattr(recurrence, "BODY_SIZE", size)
        forms.append(both([vector(*map(float, v)) for v in QUAD], vector(0.1, 0.2, 0.1)))
    assert len(recurrence._groups(3, 1)) == 1
    monkeypatch.setattr(recurrence, "BODY_SIZE", 400)
    assert len(recurrence._groups(3, 1)) > 1
    for form in forms[1:]:
        assert relative(form, forms[0]) < 1e-13


def test_not_active_is_zero(precision):
    light, x, apex = seen(precision, QUAD)
    coeffs, slopes = project_recurrence_spatial(light, x, apex, 2, precision.Float(1) < 0)
    assert not numbers(coeffs).any() and not any(numbers(part).any() for part in slopes)
