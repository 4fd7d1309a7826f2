"""Triangles to pixels, compiled by numba: which face is nearest at each pixel, and how high the casters of shadow are.

Screen coordinates: pixel (column, row) is sampled at the integer point (column, row), row 0 at the bottom. Everything
is written for many triangles much smaller than a pixel, of which most touch no sample at all.
"""

import numpy as np
from numba import njit

from .geometry import CLUSTER

NOTHING = -1
_WIDE = 8  # columns
BLOCK = 8
"""Texels along each side of a block of the shadow map."""
_VECTOR = {"contract", "arcp", "nsz"}  # what lets a compiler work on eight faces at once


@njit(cache=True, error_model="numpy")
def outside(matrix, x, y, z, radius, size):  # type: ignore[no-untyped-def]
    """Whether a sphere (m) lies beyond one of the four sides of the picture.

    `matrix` (3, 4) maps points to homogeneous pixels (column * w, row * w, w), w the distance along the view axis.
    """
    for side in range(4):
        row = side // 2
        a, b, c, d = matrix[row, 0], matrix[row, 1], matrix[row, 2], matrix[row, 3]
        if side % 2 == 1:
            end = size - 1
            a, b = end * matrix[2, 0] - a, end * matrix[2, 1] - b
            c, d = end * matrix[2, 2] - c, end * matrix[2, 3] - d
        if a * x + b * y + c * z + d < -radius * np.sqrt(a * a + b * b + c * c):
            return True
    return False


@njit(cache=True, error_model="numpy", fastmath=_VECTOR, inline="never")
def _project(corners, m, screen):  # type: ignore[no-untyped-def]
    """A cluster's corners (9, CLUSTER) to `screen` (9, CLUSTER): column, row, w of each. Returns the smallest w."""
    m00, m01, m02, m03 = m[0, 0], m[0, 1], m[0, 2], m[0, 3]
    m10, m11, m12, m13 = m[1, 0], m[1, 1], m[1, 2], m[1, 3]
    m20, m21, m22, m23 = m[2, 0], m[2, 1], m[2, 2], m[2, 3]
    one, smallest = np.float32(1), np.float32(np.inf)
    for corner in range(3):
        xs, ys, zs = corners[3 * corner], corners[3 * corner + 1], corners[3 * corner + 2]
        columns, rows, depths = screen[3 * corner], screen[3 * corner + 1], screen[3 * corner + 2]
        for i in range(CLUSTER):
            x, y, z = xs[i], ys[i], zs[i]
            w = m20 * x + m21 * y + m22 * z + m23
            inverse_depth = one / w
            columns[i] = (m00 * x + m01 * y + m02 * z + m03) * inverse_depth
            rows[i] = (m10 * x + m11 * y + m12 * z + m13) * inverse_depth
            depths[i] = w
            smallest = min(smallest, w)
    return smallest


@njit(cache=True, error_model="numpy", fastmath=_VECTOR, inline="never")
def _project_flat(corners, m, screen):  # type: ignore[no-untyped-def]
    """As `_project` without perspective: column, row and the third coordinate."""
    for corner in range(3):
        xs, ys, zs = corners[3 * corner], corners[3 * corner + 1], corners[3 * corner + 2]
        for axis in range(3):
            m0, m1, m2, m3 = m[axis, 0], m[axis, 1], m[axis, 2], m[axis, 3]
            row = screen[3 * corner + axis]
            for i in range(CLUSTER):
                row[i] = m0 * xs[i] + m1 * ys[i] + m2 * zs[i] + m3


@njit(cache=True, error_model="numpy", fastmath=_VECTOR, inline="never")
def _touch_samples(screen, end, min_area, flags):  # type: ignore[no-untyped-def]
    """Flags (CLUSTER,) the faces that may hold a sample, seen from the front, of more than `min_area` doubled square
    pixels. Most small faces have one sample in their bounding box and do not hold it."""
    zero, margin = np.float32(0), np.float32(-1e-3)  # the margin is for rounding
    for i in range(CLUSTER):
        xa, ya, xb, yb, xc, yc = screen[0, i], screen[1, i], screen[3, i], screen[4, i], screen[6, i], screen[7, i]
        area = (xb - xa) * (yc - ya) - (xc - xa) * (yb - ya)
        x0 = np.ceil(max(min(min(xa, xb), xc), zero))
        x1 = np.floor(min(max(max(xa, xb), xc), end))
        y0 = np.ceil(max(min(min(ya, yb), yc), zero))
        y1 = np.floor(min(max(max(ya, yb), yc), end))
        ea = (xb - x0) * (yc - y0) - (xc - x0) * (yb - y0)
        eb = (xc - x0) * (ya - y0) - (xa - x0) * (yc - y0)
        ec = (xa - x0) * (yb - y0) - (xb - x0) * (ya - y0)
        holds = (min(min(ea, eb), ec) > margin) | (x0 < x1) | (y0 < y1)
        flags[i] = (area > min_area) & (x0 <= x1) & (y0 <= y1) & holds


@njit(cache=True, error_model="numpy")
def nearest(
    drawn, matrices, eyes, spheres, ranges, cones, corners, ranks, limits, min_area, first_wins, inverse_depth, ids
):  # type: ignore[no-untyped-def]
    """Enters the faces of some groups into the buffers of inverse depth (H, W) float32 and face numbers (H, W) int32.

    Faces seen from behind, and faces of less than `min_area` doubled square pixels, are left out.

    Args:
        drawn: (n,) numbers of groups.
        matrices: (G, 3, 4) float32 from a group's frame to homogeneous pixels; eyes: (G, 3) the eye in that frame, m.
        spheres, ranges, cones, corners, ranks: Of the geometry.
        limits: (near, far) m: nothing nearer or farther is drawn.
        first_wins: Of two faces at the same distance the one of lower rank is seen, else the one of higher rank.
        inverse_depth: 1 / w of the nearest face, 0 for none; ids: its number where this call drew it.
    """
    size = inverse_depth.shape[0]
    zero, end = np.float32(0), np.float32(size - 1)
    screen = np.empty((9, CLUSTER), np.float32)
    flags = np.zeros(CLUSTER, np.uint8)
    eights = flags.view(np.uint64)
    rule = 1 / limits[0], 1 / limits[1], first_wins
    for g in drawn:
        matrix = matrices[g]
        if outside(matrix, spheres[g, 0], spheres[g, 1], spheres[g, 2], spheres[g, 3], size):
            continue
        for k in range(ranges[g, 0], ranges[g, 1]):
            dx, dy, dz = cones[k, 0] - eyes[g, 0], cones[k, 1] - eyes[g, 1], cones[k, 2] - eyes[g, 2]
            away = cones[k, 4] * dx + cones[k, 5] * dy + cones[k, 6] * dz
            if away >= cones[k, 7] * np.sqrt(dx * dx + dy * dy + dz * dz) + cones[k, 3]:
                continue
            behind = _project(corners[k], matrix, screen) <= 0
            _touch_samples(screen, end, min_area, flags)
            for eight in range(CLUSTER // 8):
                if eights[eight] == 0 and not behind:
                    continue
                for i in range(8 * eight, 8 * eight + 8):
                    f = k * CLUSTER + i
                    wa, wb, wc = screen[2, i], screen[5, i], screen[8, i]
                    if behind and (wa <= 0 or wb <= 0 or wc <= 0):
                        if wa > limits[0] or wb > limits[0] or wc > limits[0]:
                            _clipped(f, i, screen, limits, min_area, rule, ranks, inverse_depth, ids)
                        continue
                    if flags[i] == 0:
                        continue
                    xa, ya, xb, yb = screen[0, i], screen[1, i], screen[3, i], screen[4, i]
                    xc, yc = screen[6, i], screen[7, i]
                    x0 = int(np.ceil(max(min(xa, xb, xc), zero)))
                    x1 = int(np.floor(min(max(xa, xb, xc), end)))
                    y0 = int(np.ceil(max(min(ya, yb, yc), zero)))
                    y1 = int(np.floor(min(max(ya, yb, yc), end)))
                    _fill(f, xa, ya, wa, xb, yb, wb, xc, yc, wc, x0, x1, y0, y1, rule, ranks, inverse_depth, ids)


@njit(cache=True, error_model="numpy")
def _narrowed(start, slope, first, last):  # type: ignore[no-untyped-def]
    """The columns among `first` to `last` where start + slope * column can be positive."""
    if slope > 0:
        return max(first, int(np.ceil(min(-start / slope, 1e6))) - 1), last
    if slope < 0:
        return first, min(last, int(np.floor(max(-start / slope, -1e6))) + 1)
    return first, last


@njit(cache=True, error_model="numpy")
def _fill(f, xa, ya, wa, xb, yb, wb, xc, yc, wc, x0, x1, y0, y1, rule, ranks, inverse_depth, ids):  # type: ignore[no-untyped-def]
    xa, ya, xb, yb, xc, yc = float(xa), float(ya), float(xb), float(yb), float(xc), float(yc)
    near, far, first_wins = rule
    ia, ib, ic = 0.0, 0.0, 0.0
    for y in range(y0, y1 + 1):
        # Each edge function is linear along the row; faces that share an edge see exactly opposite values there.
        ea0, ea1 = xb * (yc - y) - xc * (yb - y), yb - yc
        eb0, eb1 = xc * (ya - y) - xa * (yc - y), yc - ya
        ec0, ec1 = xa * (yb - y) - xb * (ya - y), ya - yb
        first, last = x0, x1
        if x1 - x0 > _WIDE:  # look only at what may be inside, and a pixel more for rounding
            first, last = _narrowed(ea0, ea1, first, last)
            first, last = _narrowed(eb0, eb1, first, last)
            first, last = _narrowed(ec0, ec1, first, last)
        for x in range(first, last + 1):
            ea = ea0 + x * ea1
            eb = eb0 + x * eb1
            ec = ec0 + x * ec1
            if (ea >= 0) & (eb >= 0) & (ec >= 0):
                if ia == 0.0:  # most small faces never come here
                    area = (xb - xa) * (yc - ya) - (xc - xa) * (yb - ya)
                    ia, ib, ic = 1 / (area * wa), 1 / (area * wb), 1 / (area * wc)
                value = np.float32(ea * ia + eb * ib + ec * ic)
                if value < far or value > near or value < inverse_depth[y, x]:
                    continue
                if value == inverse_depth[y, x]:
                    other = ids[y, x]
                    if first_wins and (other == NOTHING or ranks[f] > ranks[other]):
                        continue
                    if not first_wins and other != NOTHING and ranks[f] < ranks[other]:
                        continue
                inverse_depth[y, x] = value
                ids[y, x] = f


@njit(cache=True, error_model="numpy")
def _clipped(f, i, screen, limits, min_area, rule, ranks, inverse_depth, ids):  # type: ignore[no-untyped-def]
    """A face that reaches behind the eye: what is left of it beyond the near plane."""
    near = limits[0]
    polygon = np.empty((4, 3), np.float32)
    count = 0
    for k in range(3):
        p, q = 3 * k, 3 * ((k + 1) % 3)
        wp, wq = screen[p + 2, i], screen[q + 2, i]
        if wp > near:
            polygon[count] = screen[p, i], screen[p + 1, i], wp
            count += 1
        if (wp > near) != (wq > near):
            t = (near - wp) / (wq - wp)
            for axis in range(2):
                polygon[count, axis] = ((1 - t) * screen[p + axis, i] * wp + t * screen[q + axis, i] * wq) / near
            polygon[count, 2] = near
            count += 1
    size = inverse_depth.shape[0]
    for k in range(1, count - 1):
        a, b, c = polygon[0], polygon[k], polygon[k + 1]
        # also rejects NaN: a corner level with the eye
        if not (b[0] - a[0]) * (c[1] - a[1]) - (c[0] - a[0]) * (b[1] - a[1]) > min_area:
            continue
        x0 = int(np.ceil(max(min(a[0], b[0], c[0]), 0)))
        x1 = int(np.floor(min(max(a[0], b[0], c[0]), size - 1)))
        y0 = int(np.ceil(max(min(a[1], b[1], c[1]), 0)))
        y1 = int(np.floor(min(max(a[1], b[1], c[1]), size - 1)))
        unlimited = np.float32(np.inf), rule[1], rule[2]
        _fill(
            f,
            a[0],
            a[1],
            a[2],
            b[0],
            b[1],
            b[2],
            c[0],
            c[1],
            c[2],
            x0,
            x1,
            y0,
            y1,
            unlimited,
            ranks,
            inverse_depth,
            ids,
        )


@njit(cache=True, error_model="numpy")
def cast(drawn, matrices, toward, ranges, cones, corners, heights, dirty):  # type: ignore[no-untyped-def]
    """Enters the back faces of some groups into a shadow map (S, S) float32 of heights towards the light, m.

    Args:
        drawn: (n,) numbers of groups.
        matrices: (G, 3, 4) float32 from a group's frame to column, row and height; the columns run the other way, so
            that faces that turn their back to the light come out as fronts.
        toward: (G, 3) unit vector to the light in the group's frame.
        ranges, cones, corners: Of the geometry.
        dirty: (S / BLOCK, S / BLOCK) uint8 set to 1 for blocks of texels of which one, or a neighbour, was written.
    """
    size = heights.shape[0]
    zero, end = np.float32(0), np.float32(size - 1)
    screen = np.empty((9, CLUSTER), np.float32)
    flags = np.zeros(CLUSTER, np.uint8)
    eights = flags.view(np.uint64)
    for g in drawn:
        for k in range(ranges[g, 0], ranges[g, 1]):
            lit = cones[k, 4] * toward[g, 0] + cones[k, 5] * toward[g, 1] + cones[k, 6] * toward[g, 2]
            if lit >= cones[k, 7]:
                continue
            _project_flat(corners[k], matrices[g], screen)
            _touch_samples(screen, end, zero, flags)
            for eight in range(CLUSTER // 8):
                if eights[eight] == 0:
                    continue
                for i in range(8 * eight, 8 * eight + 8):
                    if flags[i] != 0:
                        _fill_heights(i, screen, zero, end, heights, dirty)


@njit(cache=True, error_model="numpy")
def _fill_heights(i, screen, zero, end, heights, dirty):  # type: ignore[no-untyped-def]
    xa, ya, xb, yb, xc, yc = screen[0, i], screen[1, i], screen[3, i], screen[4, i], screen[6, i], screen[7, i]
    x0 = int(np.ceil(max(min(xa, xb, xc), zero)))
    x1 = int(np.floor(min(max(xa, xb, xc), end)))
    y0 = int(np.ceil(max(min(ya, yb, yc), zero)))
    y1 = int(np.floor(min(max(ya, yb, yc), end)))
    za, zb, zc, share = screen[2, i], screen[5, i], screen[8, i], np.float32(0)
    for y in range(y0, y1 + 1):
        ea0, ea1 = xb * (yc - y) - xc * (yb - y), yb - yc
        eb0, eb1 = xc * (ya - y) - xa * (yc - y), yc - ya
        ec0, ec1 = xa * (yb - y) - xb * (ya - y), ya - yb
        for x in range(x0, x1 + 1):
            ea = ea0 + x * ea1
            eb = eb0 + x * eb1
            ec = ec0 + x * ec1
            if (ea >= 0) & (eb >= 0) & (ec >= 0):
                if share == 0:  # most small faces never come here
                    share = 1 / ((xb - xa) * (yc - ya) - (xc - xa) * (yb - ya))
                height = (ea * za + eb * zb + ec * zc) * share
                if height > heights[y, x]:
                    heights[y, x] = height
    for y in range(max(y0 - 1, 0) // BLOCK, y1 // BLOCK + 1):
        for x in range(max(x0 - 1, 0) // BLOCK, x1 // BLOCK + 1):
            dirty[y, x] = 1
