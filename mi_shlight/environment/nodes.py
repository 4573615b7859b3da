"""Sums over the nodes of a quadrature rule, for Dr.Jit values as a loop inside the kernel, for Python floats as one in Python."""
from __future__ import annotations

import functools

import drjit as dr
import numpy as np

leggauss = functools.lru_cache(maxsize=None)(np.polynomial.legendre.leggauss)
"""Nodes and weights of Gauss-Legendre's rule on [-1, 1]."""


def sum_over_nodes(number, tables, term, count: int, *inputs) -> list:
    """``sum_k term(values of the tables at k, *inputs)``: a list of `count` values of the type `number`.

    Parameters
    ----------
    number : type
        Float type of the result.
    tables : sequence of ndarrays of one length
        What a node is: abscissae, weights.
    term : function
        ``term(values, *inputs) -> list`` of `count` floats. It must not see anything with derivatives but by `inputs`.
    """
    if not dr.is_jit_v(number):
        total = [number(0)] * count
        for values in zip(*(table.tolist() for table in tables)):
            total = [a + b for a, b in zip(total, term(values, *inputs))]
        return total
    index, length = dr.uint32_array_t(number), len(tables[0])
    columns = [number(table.tolist()) for table in tables]

    def body(k, total, inputs):
        values = [dr.gather(number, column, k) for column in columns]
        return k + 1, [a + b for a, b in zip(total, term(values, *inputs))], inputs

    state = index(0), [number(0) for _ in range(count)], inputs
    return dr.while_loop(state, lambda k, *_: k < length, body, mode="symbolic", max_iterations=-1)[1]
