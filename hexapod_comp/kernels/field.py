"""Compiled: the error field at a point."""

from __future__ import annotations

import math

from .compiling import compiled


@compiled
def locate(value, nodes):
    """Return (cell index, weight of the upper node, outside) of a coordinate; held at the boundary."""
    last = nodes.shape[0] - 1
    if value <= nodes[0]:
        return 0, 0.0, value < nodes[0]
    if value >= nodes[last]:
        return last - 1, 1.0, value > nodes[last]
    index = 0
    while value >= nodes[index + 1]:
        index += 1
    return index, (value - nodes[index]) / (nodes[index + 1] - nodes[index]), False


@compiled
def add_family(u, sense, lines, i, s, j, t, error):
    """Add one family of lines: bilinear weights of its four lines around the point times their polynomials.

    The weight of a line is the area of the rectangle opposite to it (Mou & King, W_xi): (1 − s)(1 − t) for the
    line at the lower node of both cross axes, and so on; they sum to 1.
    """
    for direction in range(2):
        share = 0.5 * (1.0 + sense) if direction == 0 else 0.5 * (1.0 - sense)
        if share == 0.0:
            continue
        w00 = share * (1.0 - s) * (1.0 - t)
        w01 = share * (1.0 - s) * t
        w10 = share * s * (1.0 - t)
        w11 = share * s * t
        for component in range(6):
            value = 0.0
            for power in range(lines.shape[4] - 1, -1, -1):
                value = value * u + (
                    w00 * lines[direction, i, j, component, power]
                    + w01 * lines[direction, i, j + 1, component, power]
                    + w10 * lines[direction, i + 1, j, component, power]
                    + w11 * lines[direction, i + 1, j + 1, component, power]
                )
            error[component] += value


@compiled
def along(value, nodes):
    """Return the polynomial's argument u in [−1, 1] of a coordinate, held at the ends of the line."""
    first, last = nodes[0], nodes[nodes.shape[0] - 1]
    u = (2.0 * value - first - last) / (last - first)
    return min(1.0, max(-1.0, u))


@compiled
def field_one(position, sense, grid_x, grid_y, grid_z, lines_x, lines_y, lines_z, error):
    """Write the six error components at a point into `error`; return whether it lies outside the box.

    Not finite positions give NaN, never a number.
    """
    x, y, z = position[0], position[1], position[2]
    if not (math.isfinite(x) and math.isfinite(y) and math.isfinite(z)):
        error[:] = math.nan
        return True
    i, s, out_x = locate(x, grid_x)
    j, t, out_y = locate(y, grid_y)
    k, w, out_z = locate(z, grid_z)
    error[:] = 0.0
    add_family(along(x, grid_x), sense[0], lines_x, j, t, k, w, error)
    add_family(along(y, grid_y), sense[1], lines_y, i, s, k, w, error)
    add_family(along(z, grid_z), sense[2], lines_z, i, s, j, t, error)
    return out_x or out_y or out_z
