"""SH coefficients of hundreds of lights on a grid, interpolated in between ([W20] section 6.2).

Light is linear: coefficients and spatial gradients of all lights are added up at the points of the grid, once, and a point in between
costs the same for one light or a thousand. What does not vary smoothly over a cell, a light close to it or seen edge-on, is left out of the
cell's corners and evaluated exactly at the point (:py:mod:`mi_shlight.grid.split`), which [W20] does not do and its Fig. 12 shows the lack
of.
"""
