"""Triangles to pixels, compiled by numba: which triangle is nearest at each pixel, then one shading per pixel.

Screen coordinates are TinyRenderer's: pixel (column, row) is sampled at the integer point (column, row), row 0 at the
bottom. Everything is written for many triangles much smaller than a pixel, of which most touch no sample at all.
"""

import numpy as np
from numba import njit

NOTHING = -1
RANKS = 256
"""How many ranks a depth buffer of few bits tells apart; times 2**16 it still fits a float32."""


@njit(cache=True, error_model="numpy")
def outside(matrix, center, radius, size):  # type: ignore[no-untyped-def]
    """Whether a sphere (3,), m, lies beyond one of the four sides of the picture.

    `matrix` (3, 4) maps points to homogeneous pixels (column * w, row * w, w), w the distance along the view axis.
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
    """Vertices (3, V) to `screen` (V, 3): column, row, w. Returns whether any lies behind the eye."""
    m00, m01, m02, m03 = matrix[0]
    m10, m11, m12, m13 = matrix[1]
    m20, m21, m22, m23 = matrix[2]
    x, y, z = vertices[0], vertices[1], vertices[2]
    least = np.float32(np.inf)
    for v in range(x.size):
        w = m20 * x[v] + m21 * y[v] + m22 * z[v] + m23
        screen[v, 0] = (m00 * x[v] + m01 * y[v] + m02 * z[v] + m03) / w
        screen[v, 1] = (m10 * x[v] + m11 * y[v] + m12 * z[v] + m13) / w
        screen[v, 2] = w
        least = min(least, w)
    return least <= 0


@njit(cache=True, error_model="numpy")
def nearest(faces, first, last, screen, behind, limits, smallest, rule, closeness, ids):  # type: ignore[no-untyped-def]
    """Enters faces `first` to `last` into the buffers of closeness (H, W) float32 and of face numbers (H, W) int32.

    Faces seen from behind, and faces of less than `smallest` doubled square pixels, are left out. `limits` (near,
    far) m: nothing nearer or farther is drawn. `rule` (offset, scale, rank) says what closeness is: with scale 0
    it is 1 / w and of two equals the later one stays; else it is round(offset + scale / w) * RANKS + rank, a depth
    buffer of few bits, and of two equals the one of higher rank stays, or the earlier one.
    """
    size = closeness.shape[0]
    near, far = 1 / limits[0], 1 / limits[1]
    zero, end = np.float32(0), np.float32(size - 1)
    for f in range(first, last):
        a, b, c = faces[f, 0], faces[f, 1], faces[f, 2]
        if behind and (screen[a, 2] <= 0 or screen[b, 2] <= 0 or screen[c, 2] <= 0):
            if screen[a, 2] > limits[0] or screen[b, 2] > limits[0] or screen[c, 2] > limits[0]:
                _clipped(f, a, b, c, screen, limits, smallest, rule, closeness, ids)
            continue
        xa, ya = screen[a, 0], screen[a, 1]
        xb, yb = screen[b, 0], screen[b, 1]
        xc, yc = screen[c, 0], screen[c, 1]
        # most faces fail one of these; testing all at once spares the processor a guess for each
        area = (xb - xa) * (yc - ya) - (xc - xa) * (yb - ya)
        x0 = int(np.ceil(max(min(xa, xb, xc), zero)))
        x1 = int(np.floor(min(max(xa, xb, xc), end)))
        y0 = int(np.ceil(max(min(ya, yb, yc), zero)))
        y1 = int(np.floor(min(max(ya, yb, yc), end)))
        if not ((area > smallest) & (x0 <= x1) & (y0 <= y1)):
            continue
        _fill(
            f,
            xa,
            ya,
            screen[a, 2],
            xb,
            yb,
            screen[b, 2],
            xc,
            yc,
            screen[c, 2],
            x0,
            x1,
            y0,
            y1,
            near,
            far,
            rule,
            closeness,
            ids,
        )


@njit(cache=True, error_model="numpy")
def _fill(f, xa, ya, wa, xb, yb, wb, xc, yc, wc, x0, x1, y0, y1, near, far, rule, closeness, ids):  # type: ignore[no-untyped-def]
    xa, ya, xb, yb, xc, yc = float(xa), float(ya), float(xb), float(yb), float(xc), float(yc)
    offset, scale, rank = rule
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
                if ia == 0.0:  # most small faces never come here
                    area = (xb - xa) * (yc - ya) - (xc - xa) * (yb - ya)
                    ia, ib, ic = 1 / (area * wa), 1 / (area * wb), 1 / (area * wc)
                value = np.float32(ea * ia + eb * ib + ec * ic)
                if value < far or value > near:
                    continue
                if scale == 0:
                    better = value >= closeness[y, x]
                else:
                    value = np.float32(np.floor(offset + scale * value + 0.5) * RANKS + rank)
                    better = value > closeness[y, x]
                if better:
                    closeness[y, x] = value
                    ids[y, x] = f


@njit(cache=True, error_model="numpy")
def _clipped(f, a, b, c, screen, limits, smallest, rule, closeness, ids):  # type: ignore[no-untyped-def]
    """A face that reaches behind the eye: what is left of it beyond the near plane."""
    near = limits[0]
    polygon = np.empty((4, 3), np.float32)
    count = 0
    corners = (a, b, c)
    for k in range(3):
        p, q = corners[k], corners[(k + 1) % 3]
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
    size = closeness.shape[0]
    for k in range(1, count - 1):
        pa, pb, pc = polygon[0], polygon[k], polygon[k + 1]
        if not (pb[0] - pa[0]) * (pc[1] - pa[1]) - (pc[0] - pa[0]) * (pb[1] - pa[1]) > smallest:
            continue  # not a number neither: a corner exactly beside the eye
        x0 = int(np.ceil(max(min(pa[0], pb[0], pc[0]), 0)))
        x1 = int(np.floor(min(max(pa[0], pb[0], pc[0]), size - 1)))
        y0 = int(np.ceil(max(min(pa[1], pb[1], pc[1]), 0)))
        y1 = int(np.floor(min(max(pa[1], pb[1], pc[1]), size - 1)))
        _fill(
            f,
            pa[0],
            pa[1],
            pa[2],
            pb[0],
            pb[1],
            pb[2],
            pc[0],
            pc[1],
            pc[2],
            x0,
            x1,
            y0,
            y1,
            np.inf,
            1 / limits[1],
            rule,
            closeness,
            ids,
        )


@njit(cache=True, error_model="numpy")
def weights(f, x, y, faces, screen):  # type: ignore[no-untyped-def]
    """Perspective-correct weights of a face's three corners at the sample (x, y)."""
    a, b, c = faces[f, 0], faces[f, 1], faces[f, 2]
    xa, ya, wa = float(screen[a, 0]), float(screen[a, 1]), float(screen[a, 2])
    xb, yb, wb = float(screen[b, 0]), float(screen[b, 1]), float(screen[b, 2])
    xc, yc, wc = float(screen[c, 0]), float(screen[c, 1]), float(screen[c, 2])
    ea = ((xb - x) * (yc - y) - (xc - x) * (yb - y)) / wa
    eb = ((xc - x) * (ya - y) - (xa - x) * (yc - y)) / wb
    ec = ((xa - x) * (yb - y) - (xb - x) * (ya - y)) / wc
    total = ea + eb + ec
    return ea / total, eb / total, ec / total


@njit(cache=True, error_model="numpy")
def shade_tiny(ids, faces, screen, owner, normals, uvs, places, texels, colors, lights, up, picture):  # type: ignore[no-untyped-def]
    """TinyRenderer's light on every pixel that shows a face: 60 % ambient, 35 % diffuse, 5 % specular, no shadow.

    Args:
        ids: (H, W) int32 face numbers, `NOTHING` where the picture stays as it is.
        owner: (F,) which shape a face belongs to; `places` (S, 3) first texel, width and height of its texture (no
            texture: width 0); `colors` (S, 4); `lights` and `up` (S, 3), the direction of the light and of the
            world's z axis in the shape's frame.
        texels: (T, 3) uint8.
        picture: (H, W, 3) uint8, row 0 on top.
    """
    size = ids.shape[0]
    for y in range(size):
        for x in range(size):
            f = ids[y, x]
            if f == NOTHING:
                continue
            ba, bb, bc = weights(f, x, y, faces, screen)
            shape = owner[f]
            square, toward, upward, light_up = 0.0, 0.0, 0.0, 0.0
            for i in range(3):
                n = ba * normals[f, 0, i] + bb * normals[f, 1, i] + bc * normals[f, 2, i]
                square += n * n
                toward += n * lights[shape, i]
                upward += n * up[shape, i]
                light_up += lights[shape, i] * up[shape, i]
            length = np.sqrt(square)
            toward /= length
            upward /= length
            mirrored = max(2 * toward * upward - light_up, 0.0)
            light = 0.6 + 0.35 * max(toward, 0.0) + 0.05 * mirrored * mirrored
            start, width, height = places[shape, 0], places[shape, 1], places[shape, 2]
            texel = 0
            if width > 0:
                u = ba * uvs[f, 0, 0] + bb * uvs[f, 1, 0] + bc * uvs[f, 2, 0]
                v = ba * uvs[f, 0, 1] + bb * uvs[f, 1, 1] + bc * uvs[f, 2, 1]
                column = min(int((u - np.floor(u)) * width), width - 1)
                line = min(int((v - np.floor(v)) * height), height - 1)
                texel = start + (height - 1 - line) * width + column
            for i in range(3):
                base = texels[texel, i] if width > 0 else 255
                value = light * np.floor(base * colors[shape, i])
                # a face without a direction comes out black
                picture[size - 1 - y, x, i] = min(int(value), 255) if value == value else 0


@njit(cache=True, error_model="numpy")
def light_gl(
    ids,
    faces,
    screen,
    owner,
    normals,
    uvs,
    places,
    levels,
    texels,
    colors,
    poses,
    groups,
    vertices,
    light,
    eye,
    shadow,
    surface,
):  # type: ignore[no-untyped-def]
    """What Bullet's OpenGL shader makes of every pixel that shows a face, but for the shadow.

    Args:
        ids, faces, screen, owner, normals, uvs, colors: As in `shade_tiny`.
        places: (S, 2) first mipmap level in `levels` and number of levels, 0 without texture.
        levels: (L, 3) first texel, width and height; `texels` (T, 3) uint8.
        poses: (G, 4, 4) link frames; `groups` (S,) the group of a shape; `vertices` (3, V) in the link frames.
        light, eye: (3,) positions of the light and of the eye that the highlights are for.
        shadow: (3, 4) world to shadow map column, row and height towards the light.
        surface: (H, W, 8) float32 to fill: albedo (3), light 0 to 1, highlight, shadow map column, row, height.
    """
    size = ids.shape[0]
    length = np.sqrt(light[0] ** 2 + light[1] ** 2 + light[2] ** 2)
    point, normal, local, rgb = np.empty(3), np.empty(3), np.empty(3), np.empty(3)
    for y in range(size):
        for x in range(size):
            f = ids[y, x]
            if f == NOTHING:
                continue
            ba, bb, bc = weights(f, x, y, faces, screen)
            shape = owner[f]
            pose = groups[shape]
            a, b, c = faces[f, 0], faces[f, 1], faces[f, 2]
            for i in range(3):
                local[i] = ba * normals[f, 0, i] + bb * normals[f, 1, i] + bc * normals[f, 2, i]
                rgb[i] = ba * vertices[i, a] + bb * vertices[i, b] + bc * vertices[i, c]
            square = 0.0
            for i in range(3):
                normal[i] = poses[pose, i, 0] * local[0] + poses[pose, i, 1] * local[1] + poses[pose, i, 2] * local[2]
                point[i] = (
                    poses[pose, i, 0] * rgb[0]
                    + poses[pose, i, 1] * rgb[1]
                    + poses[pose, i, 2] * rgb[2]
                    + poses[pose, i, 3]
                )
                square += normal[i] * normal[i]
            toward = 0.0
            for i in range(3):
                normal[i] /= np.sqrt(square)
                toward += normal[i] * light[i] / length
            highlight = 0.0
            if toward >= 0:
                to_light, to_eye, light_square, eye_square, across = 0.0, 0.0, 0.0, 0.0, 0.0
                for i in range(3):
                    p, q = light[i] - point[i], eye[i] - point[i]
                    light_square += p * p
                    eye_square += q * q
                    to_light += p * normal[i]
                    to_eye += q * normal[i]
                    across += p * q
                cosine = (2 * to_light * to_eye - across) / np.sqrt(light_square * eye_square)
                highlight = 0.5 * max(cosine, 0.0) ** 41
            first, count = places[shape, 0], places[shape, 1]
            if count == 0:
                rgb[:] = 1
            else:
                _sample(f, x, y, ba, bb, bc, faces, screen, uvs, first, count, levels, texels, rgb)
            for i in range(3):
                surface[y, x, i] = rgb[i] * colors[shape, i]
                surface[y, x, 5 + i] = (
                    shadow[i, 0] * point[0] + shadow[i, 1] * point[1] + shadow[i, 2] * point[2] + shadow[i, 3]
                )
            surface[y, x, 3] = 0.5 + 0.5 * toward
            surface[y, x, 4] = highlight


@njit(cache=True, error_model="numpy")
def _sample(f, x, y, ba, bb, bc, faces, screen, uvs, first, count, levels, texels, rgb):  # type: ignore[no-untyped-def]
    """Trilinear texture lookup into `rgb` (3,), 0 to 1; the mipmap level follows from the neighbours' coordinates."""
    u = ba * uvs[f, 0, 0] + bb * uvs[f, 1, 0] + bc * uvs[f, 2, 0]
    v = ba * uvs[f, 0, 1] + bb * uvs[f, 1, 1] + bc * uvs[f, 2, 1]
    width, height = levels[first, 1], levels[first, 2]
    longest = 0.0
    for k in range(2):
        na, nb, nc = weights(f, x + (1 - k), y + k, faces, screen)
        du = (na * uvs[f, 0, 0] + nb * uvs[f, 1, 0] + nc * uvs[f, 2, 0] - u) * width
        dv = (na * uvs[f, 0, 1] + nb * uvs[f, 1, 1] + nc * uvs[f, 2, 1] - v) * height
        longest = max(longest, du * du + dv * dv)
    level = min(max(0.5 * np.log2(max(longest, 1e-12)), 0.0), count - 1.0)
    near = int(level)
    part = level - near
    rgb[:] = 0
    for k in range(2):
        share = part if k else 1 - part
        if share == 0:
            continue
        start, width, height = (
            levels[first + near + k, 0],
            levels[first + near + k, 1],
            levels[first + near + k, 2],
        )
        s, t = u * width - 0.5, v * height - 0.5
        s0, t0 = np.floor(s), np.floor(t)
        for corner in range(4):
            i, j = corner % 2, corner // 2
            weight = (s - s0 if i else 1 - s + s0) * (t - t0 if j else 1 - t + t0) * share / 255
            column, line = int(s0 + i) % width, int(t0 + j) % height
            texel = start + (height - 1 - line) * width + column
            for channel in range(3):
                rgb[channel] += weight * texels[texel, channel]


@njit(cache=True, error_model="numpy")
def compose_gl(surface, closeness, heights, step, picture):  # type: ignore[no-untyped-def]
    """Light, highlight and shadow of every pixel become its colour.

    Args:
        surface: From `light_gl`.
        closeness: (H, W), 0 where there is nothing to see.
        heights: (S, S) float32 shadow map: height of the highest back face towards the light, 0 for none.
        step: The height that one step of the original's 16-bit map stands for, m.
        picture: (H, W, 3) uint8, row 0 on top.
    """
    size, extent = surface.shape[0], heights.shape[0]
    for y in range(size):
        for x in range(size):
            if closeness[y, x] == 0:
                continue
            light = surface[y, x, 3]
            visible = 0.0
            if light >= 0.5:
                s, t, height = surface[y, x, 5], surface[y, x, 6], surface[y, x, 7]
                s0, t0 = np.floor(s), np.floor(t)
                for corner in range(4):
                    i, j = corner % 2, corner // 2
                    weight = (s - s0 if i else 1 - s + s0) * (t - t0 if j else 1 - t + t0)
                    column, row = int(s0) + i, int(t0) + j
                    covered = 0 <= column < extent and 0 <= row < extent
                    if not covered or height >= np.round(heights[row, column] / step) * step:
                        visible += weight
            light *= 0.7 + 0.3 * visible
            factor = 0.5 + 0.5 * light + surface[y, x, 4] * visible
            for i in range(3):
                picture[size - 1 - y, x, i] = int(min(surface[y, x, i] * factor, 1.0) * 255 + 0.5)


@njit(cache=True, error_model="numpy", fastmath={"contract", "arcp", "nsz"})
def project_flat(vertices, matrix, screen):  # type: ignore[no-untyped-def]
    """As `project` without perspective: column, row and 1 / the third coordinate."""
    x, y, z = vertices[0], vertices[1], vertices[2]
    for v in range(x.size):
        screen[v, 0] = matrix[0, 0] * x[v] + matrix[0, 1] * y[v] + matrix[0, 2] * z[v] + matrix[0, 3]
        screen[v, 1] = matrix[1, 0] * x[v] + matrix[1, 1] * y[v] + matrix[1, 2] * z[v] + matrix[1, 3]
        screen[v, 2] = 1 / (matrix[2, 0] * x[v] + matrix[2, 1] * y[v] + matrix[2, 2] * z[v] + matrix[2, 3])
