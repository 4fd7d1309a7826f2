"""Which triangle is nearest at each pixel, compiled by numba.

Screen coordinates are TinyRenderer's: pixel (column, row) is sampled at the integer point (column, row), row 0 at the
bottom. w is the distance along the view axis (m). The code is tuned for many triangles much smaller than a pixel, most
of which contain no sample.
"""

import numpy as np
from numba import njit

NOTHING = -1
"""Face number of a pixel that shows no face."""
RANKS = 256
"""Number of ranks in an integer depth buffer; 2**16 times as many values still fit into a float32."""


@njit(cache=True, error_model="numpy")
def outside(matrix, center, radius, size):  # type: ignore[no-untyped-def]
    """Whether a sphere, center (3,) and radius (m), lies beyond one of the four sides of the picture.

    `matrix` (3, 4) maps points to homogeneous pixels (column * w, row * w, w).
    """
    for side in range(4):
        row = side // 2
        distance, square = 0.0, 0.0
        for i in range(4):
            a = matrix[row, i] if side % 2 == 0 else (size - 1) * matrix[2, i] - matrix[row, i]
            distance += a * center[i] if i < 3 else a
            square += a * a if i < 3 else 0.0
        if distance < -radius * np.sqrt(square):
            return True
    return False


@njit(cache=True, error_model="numpy", fastmath={"contract", "arcp", "nsz"})
def project(vertices, matrix, screen):  # type: ignore[no-untyped-def]
    """Vertices (3, V) to `screen` (V, 3): column, row, w. Returns whether any vertex lies behind the eye."""
    m00, m01, m02, m03 = matrix[0]
    m10, m11, m12, m13 = matrix[1]
    m20, m21, m22, m23 = matrix[2]
    x, y, z = vertices[0], vertices[1], vertices[2]
    min_w = np.float32(np.inf)
    for v in range(x.size):
        w = m20 * x[v] + m21 * y[v] + m22 * z[v] + m23
        screen[v, 0] = (m00 * x[v] + m01 * y[v] + m02 * z[v] + m03) / w
        screen[v, 1] = (m10 * x[v] + m11 * y[v] + m12 * z[v] + m13) / w
        screen[v, 2] = w
        min_w = min(min_w, w)
    return min_w <= 0


@njit(cache=True, error_model="numpy", fastmath={"contract", "arcp", "nsz"})
def project_flat(vertices, matrix, screen):  # type: ignore[no-untyped-def]
    """As `project`, without perspective: column, row and 1 / the third coordinate."""
    x, y, z = vertices[0], vertices[1], vertices[2]
    for v in range(x.size):
        screen[v, 0] = matrix[0, 0] * x[v] + matrix[0, 1] * y[v] + matrix[0, 2] * z[v] + matrix[0, 3]
        screen[v, 1] = matrix[1, 0] * x[v] + matrix[1, 1] * y[v] + matrix[1, 2] * z[v] + matrix[1, 3]
        screen[v, 2] = 1 / (matrix[2, 0] * x[v] + matrix[2, 1] * y[v] + matrix[2, 2] * z[v] + matrix[2, 3])


@njit(cache=True, error_model="numpy")
def nearest(faces, first, last, screen, behind, limits, min_area, encoding, depth_buffer, ids):  # type: ignore[no-untyped-def]
    """Enters faces into a depth buffer and writes their numbers where they are nearest.

    Faces seen from behind are left out.

    Args:
        faces: (F, 3) rows of `screen`.
        first, last: Range of the faces to enter.
        screen: (V, 3) from `project`.
        behind: Whether any vertex may lie behind the eye.
        limits: (near, far), m: nothing nearer or farther is drawn.
        min_area: Faces whose doubled area in the picture is not larger (square pixels) are left out.
        encoding: (offset, scale, rank). With scale 0 the buffer holds inverse depth 1 / w, and of two equals the later
            one stays. Otherwise it holds round(offset + scale / w) * RANKS + rank, as an integer depth buffer does;
            at equal depth the higher rank stays, at equal rank the earlier face.
        depth_buffer: (H, W) float32, larger is nearer, 0 for nothing.
        ids: (H, W) int32 face numbers.
    """
    size = depth_buffer.shape[0]
    near, far = 1 / limits[0], 1 / limits[1]
    zero, end = np.float32(0), np.float32(size - 1)
    for f in range(first, last):
        a, b, c = faces[f, 0], faces[f, 1], faces[f, 2]
        if behind and (screen[a, 2] <= 0 or screen[b, 2] <= 0 or screen[c, 2] <= 0):
            if screen[a, 2] > limits[0] or screen[b, 2] > limits[0] or screen[c, 2] > limits[0]:
                _clipped(f, a, b, c, screen, limits, min_area, encoding, depth_buffer, ids)
            continue
        xa, ya = screen[a, 0], screen[a, 1]
        xb, yb = screen[b, 0], screen[b, 1]
        xc, yc = screen[c, 0], screen[c, 1]
        # most faces fail one of these tests; a single branch is cheaper than three
        area = (xb - xa) * (yc - ya) - (xc - xa) * (yb - ya)
        x0 = int(np.ceil(max(min(xa, xb, xc), zero)))
        x1 = int(np.floor(min(max(xa, xb, xc), end)))
        y0 = int(np.ceil(max(min(ya, yb, yc), zero)))
        y1 = int(np.floor(min(max(ya, yb, yc), end)))
        if not ((area > min_area) & (x0 <= x1) & (y0 <= y1)):
            continue
        wa, wb, wc = screen[a, 2], screen[b, 2], screen[c, 2]
        corners = xa, ya, wa, xb, yb, wb, xc, yc, wc
        _fill(f, corners, (x0, x1, y0, y1), near, far, encoding, depth_buffer, ids)


@njit(cache=True, error_model="numpy")
def _fill(f, corners, box, near, far, encoding, depth_buffer, ids):  # type: ignore[no-untyped-def]
    """Enters one face at the samples in `box` (x0, x1, y0, y1); `near` and `far` are inverse depths."""
    xa, ya, wa, xb, yb, wb, xc, yc, wc = corners
    x0, x1, y0, y1 = box
    xa, ya, xb, yb, xc, yc = float(xa), float(ya), float(xb), float(yb), float(xc), float(yc)
    offset, scale, rank = encoding
    ia, ib, ic = 0.0, 0.0, 0.0
    for y in range(y0, y1 + 1):
        # Each edge function is linear along the row; faces that share an edge see exactly opposite values there.
        ea0, ea1 = xb * (yc - y) - xc * (yb - y), yb - yc
        eb0, eb1 = xc * (ya - y) - xa * (yc - y), yc - ya
        ec0, ec1 = xa * (yb - y) - xb * (ya - y), ya - yb
        for x in range(x0, x1 + 1):
            ea = ea0 + x * ea1
            eb = eb0 + x * eb1
            ec = ec0 + x * ec1
            if (ea >= 0) & (eb >= 0) & (ec >= 0):
                if ia == 0.0:  # only now: most small faces contain no sample
                    area = (xb - xa) * (yc - ya) - (xc - xa) * (yb - ya)
                    ia, ib, ic = 1 / (area * wa), 1 / (area * wb), 1 / (area * wc)
                value = np.float32(ea * ia + eb * ib + ec * ic)
                if value < far or value > near:
                    continue
                if scale == 0:
                    better = value >= depth_buffer[y, x]
                else:
                    value = np.float32(np.floor(offset + scale * value + 0.5) * RANKS + rank)
                    better = value > depth_buffer[y, x]
                if better:
                    depth_buffer[y, x] = value
                    ids[y, x] = f


@njit(cache=True, error_model="numpy")
def _clipped(f, a, b, c, screen, limits, min_area, encoding, depth_buffer, ids):  # type: ignore[no-untyped-def]
    """Enters the part beyond the near plane of a face that reaches behind the eye."""
    near = limits[0]
    polygon = np.empty((4, 3), np.float32)
    count = 0
    vertices = (a, b, c)
    for k in range(3):
        p, q = vertices[k], vertices[(k + 1) % 3]
        if screen[p, 2] > near:
            polygon[count] = screen[p, 0], screen[p, 1], screen[p, 2]
            count += 1
        if (screen[p, 2] > near) != (screen[q, 2] > near):
            wp, wq = screen[p, 2], screen[q, 2]
            t = (near - wp) / (wq - wp)
            for i in range(2):
                polygon[count, i] = ((1 - t) * screen[p, i] * wp + t * screen[q, i] * wq) / near
            polygon[count, 2] = near
            count += 1
    size = depth_buffer.shape[0]
    for k in range(1, count - 1):
        pa, pb, pc = polygon[0], polygon[k], polygon[k + 1]
        if not (pb[0] - pa[0]) * (pc[1] - pa[1]) - (pc[0] - pa[0]) * (pb[1] - pa[1]) > min_area:
            continue  # also rejects NaN: a corner level with the eye
        x0 = int(np.ceil(max(min(pa[0], pb[0], pc[0]), 0)))
        x1 = int(np.floor(min(max(pa[0], pb[0], pc[0]), size - 1)))
        y0 = int(np.ceil(max(min(pa[1], pb[1], pc[1]), 0)))
        y1 = int(np.floor(min(max(pa[1], pb[1], pc[1]), size - 1)))
        corners = pa[0], pa[1], pa[2], pb[0], pb[1], pb[2], pc[0], pc[1], pc[2]
        _fill(f, corners, (x0, x1, y0, y1), np.inf, 1 / limits[1], encoding, depth_buffer, ids)
