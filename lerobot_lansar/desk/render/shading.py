"""From the nearest face at each pixel to its color, compiled by numba: one shading per pixel.

The kernels share these arguments:

    ids (H, W) int32       face at each pixel, `NOTHING` where the picture stays as it is
    inverse_depth (H, W) float32 1 / w at each pixel
    matrices (G, 3, 4)     float32 from a group's frame to homogeneous pixels
    groups (S,)            the group of a shape; colors (S, 4) rgba
    picture (H, W, 3)      uint8, row 0 on top
"""

import numpy as np
from numba import njit

from .geometry import CLUSTER
from .raster import NOTHING


@njit(cache=True, error_model="numpy")
def _corner(f, corner, corners, m):  # type: ignore[no-untyped-def]
    """Column, row and w of a face's corner, with the rounding of the raster."""
    cluster, i = corners[f // CLUSTER], f % CLUSTER
    x, y, z = cluster[3 * corner, i], cluster[3 * corner + 1, i], cluster[3 * corner + 2, i]
    w = m[2, 0] * x + m[2, 1] * y + m[2, 2] * z + m[2, 3]
    column = (m[0, 0] * x + m[0, 1] * y + m[0, 2] * z + m[0, 3]) / w
    row = (m[1, 0] * x + m[1, 1] * y + m[1, 2] * z + m[1, 3]) / w
    return float(column), float(row), float(w)


@njit(cache=True, error_model="numpy")
def _weights(f, x, y, corners, m):  # type: ignore[no-untyped-def]
    """Perspective weights of a face's three corners at the sample (x, y), not divided by their sum, and what each
    grows by per column and per row."""
    xa, ya, wa = _corner(f, 0, corners, m)
    xb, yb, wb = _corner(f, 1, corners, m)
    xc, yc, wc = _corner(f, 2, corners, m)
    pa = ((xb - x) * (yc - y) - (xc - x) * (yb - y)) / wa
    pb = ((xc - x) * (ya - y) - (xa - x) * (yc - y)) / wb
    pc = ((xa - x) * (yb - y) - (xb - x) * (ya - y)) / wc
    columns = (yb - yc) / wa, (yc - ya) / wb, (ya - yb) / wc
    rows = (xc - xb) / wa, (xa - xc) / wb, (xb - xa) / wc
    return pa, pb, pc, columns, rows


@njit(cache=True, error_model="numpy")
def shade_tiny(ids, corners, matrices, shapes, groups, normals, uvs, places, texels, colors, lights, up, picture):  # type: ignore[no-untyped-def]
    """TinyRenderer's light: 60 % ambient, 35 % diffuse, 5 % specular, no shadow.

    Args:
        ids, corners, matrices, groups, colors, picture: See above.
        shapes, normals, uvs: Of the geometry.
        places: (S, 3) first texel, width and height of a shape's texture; width 0 without one.
        texels: (T, 3) uint8.
        lights, up: (S, 3) direction of the light and of the world's z axis in the shape's frame.
    """
    size = ids.shape[0]
    for y in range(size):
        for x in range(size):
            f = ids[y, x]
            if f == NOTHING:
                continue
            shape = shapes[f]
            pa, pb, pc, _, _ = _weights(f, x, y, corners, matrices[groups[shape]])
            total = pa + pb + pc
            pa, pb, pc = pa / total, pb / total, pc / total
            square, toward, upward, light_up = 0.0, 0.0, 0.0, 0.0
            for i in range(3):
                n = pa * normals[f, 0, i] + pb * normals[f, 1, i] + pc * normals[f, 2, i]
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
                u = pa * uvs[f, 0, 0] + pb * uvs[f, 1, 0] + pc * uvs[f, 2, 0]
                v = pa * uvs[f, 0, 1] + pb * uvs[f, 1, 1] + pc * uvs[f, 2, 1]
                column = min(int((u - np.floor(u)) * width), width - 1)
                line = min(int((v - np.floor(v)) * height), height - 1)
                texel = start + (height - 1 - line) * width + column
            for i in range(3):
                base = texels[texel, i] if width > 0 else 255
                value = light * np.floor(base * colors[shape, i])
                # a face without a direction comes out black
                picture[size - 1 - y, x, i] = min(int(value), 255) if value == value else 0


@njit(cache=True, error_model="numpy")
def shade_gl(
    ids,
    inverse_depth,
    corners,
    matrices,
    shapes,
    groups,
    normals,
    uvs,
    places,
    levels,
    texels,
    colors,
    rotations,
    world,
    lamp,
    shadow,
    heights,
    picture,
    keep,
    surface,
):  # type: ignore[no-untyped-def]
    """Bullet's OpenGL shader: a near light with highlights and a shadow, trilinear texels.

    Args:
        ids, inverse_depth, corners, matrices, groups, colors, picture: See above.
        shapes, normals, uvs: Of the geometry.
        places: (S, 2) first mipmap level in `levels` and number of levels, 0 without texture.
        levels: (L, 3) first texel, width and height; `texels` (T, 3) uint8.
        rotations: (G, 3, 3) of the groups.
        world: (3, 4) homogeneous pixels (column * w, row * w, w) to world coordinates, m.
        lamp: (2, 3) positions of the light, and of the eye that the highlights are for, m.
        shadow: (3, 4) world to the shadow map's column, row and height towards the light.
        heights: (S, S) float32, the shadow map.
        keep: Whether to fill `surface` too.
        surface: (H, W, 8) float32: albedo (3), light 0 to 1, highlight, shadow map column, row, height.
    """
    size = ids.shape[0]
    length = np.sqrt(lamp[0, 0] ** 2 + lamp[0, 1] ** 2 + lamp[0, 2] ** 2)
    lx, ly, lz = lamp[0, 0] / length, lamp[0, 1] / length, lamp[0, 2] / length
    for y in range(size):
        for x in range(size):
            f = ids[y, x]
            if f == NOTHING:
                continue
            shape = shapes[f]
            group = groups[shape]
            pa, pb, pc, columns, rows = _weights(f, x, y, corners, matrices[group])
            total = pa + pb + pc
            # the normal need not be divided by it; a face that reaches behind the eye may have a negative one
            n0 = pa * normals[f, 0, 0] + pb * normals[f, 1, 0] + pc * normals[f, 2, 0]
            n1 = pa * normals[f, 0, 1] + pb * normals[f, 1, 1] + pc * normals[f, 2, 1]
            n2 = pa * normals[f, 0, 2] + pb * normals[f, 1, 2] + pc * normals[f, 2, 2]
            share = (1 if total > 0 else -1) / np.sqrt(n0 * n0 + n1 * n1 + n2 * n2)
            turn = rotations[group]
            nx = (turn[0, 0] * n0 + turn[0, 1] * n1 + turn[0, 2] * n2) * share
            ny = (turn[1, 0] * n0 + turn[1, 1] * n1 + turn[1, 2] * n2) * share
            nz = (turn[2, 0] * n0 + turn[2, 1] * n1 + turn[2, 2] * n2) * share
            toward = nx * lx + ny * ly + nz * lz
            w = 1 / inverse_depth[y, x]
            px = (world[0, 0] * x + world[0, 1] * y + world[0, 2]) * w + world[0, 3]
            py = (world[1, 0] * x + world[1, 1] * y + world[1, 2]) * w + world[1, 3]
            pz = (world[2, 0] * x + world[2, 1] * y + world[2, 2]) * w + world[2, 3]
            highlight = _highlight(lamp, px, py, pz, nx, ny, nz) if toward >= 0 else 0.0
            s = shadow[0, 0] * px + shadow[0, 1] * py + shadow[0, 2] * pz + shadow[0, 3]
            t = shadow[1, 0] * px + shadow[1, 1] * py + shadow[1, 2] * pz + shadow[1, 3]
            height = shadow[2, 0] * px + shadow[2, 1] * py + shadow[2, 2] * pz + shadow[2, 3]
            red, green, blue = 1.0, 1.0, 1.0
            first, count = places[shape, 0], places[shape, 1]
            if count > 0:
                u = pa * uvs[f, 0, 0] + pb * uvs[f, 1, 0] + pc * uvs[f, 2, 0]
                v = pa * uvs[f, 0, 1] + pb * uvs[f, 1, 1] + pc * uvs[f, 2, 1]
                u, v = u / total, v / total
                level = _level(f, u, v, pa, pb, pc, columns, rows, uvs, levels[first, 1], levels[first, 2], count)
                red, green, blue = _sample(u, v, level, first, levels, texels)
            red, green, blue = red * colors[shape, 0], green * colors[shape, 1], blue * colors[shape, 2]
            light = 0.5 + 0.5 * toward
            factor = _factor(light, highlight, s, t, height, heights)
            out = picture[size - 1 - y, x]
            out[0], out[1], out[2] = _byte(red * factor), _byte(green * factor), _byte(blue * factor)
            if keep:
                into = surface[y, x]
                into[0], into[1], into[2], into[3], into[4] = red, green, blue, light, highlight
                into[5], into[6], into[7] = s, t, height


@njit(cache=True, error_model="numpy")
def _highlight(lamp, px, py, pz, nx, ny, nz):  # type: ignore[no-untyped-def]
    """Half the cosine between the mirrored light and the way to the eye, to the power of 41."""
    ax, ay, az = lamp[0, 0] - px, lamp[0, 1] - py, lamp[0, 2] - pz
    bx, by, bz = lamp[1, 0] - px, lamp[1, 1] - py, lamp[1, 2] - pz
    to_light, to_eye = ax * nx + ay * ny + az * nz, bx * nx + by * ny + bz * nz
    across = 2 * to_light * to_eye - (ax * bx + ay * by + az * bz)
    if across <= 0:
        return 0.0
    squares = (ax * ax + ay * ay + az * az) * (bx * bx + by * by + bz * bz)
    cosine = across / np.sqrt(squares)
    c2 = cosine * cosine
    c8 = c2 * c2 * c2 * c2
    return 0.5 * c8 * c8 * c8 * c8 * c8 * cosine


@njit(cache=True, error_model="numpy")
def _factor(light, highlight, s, t, height, heights):  # type: ignore[no-untyped-def]
    """What the albedo is multiplied with: light and highlight, as far as no caster is higher."""
    visible = 0.0
    if light >= 0.5:
        extent = heights.shape[0]
        left, low = np.floor(s), np.floor(t)
        ds, dt = s - left, t - low
        column, row = int(left), int(low)
        if column < 0 or row < 0 or column + 1 >= extent or row + 1 >= extent:
            visible = 1.0
        else:
            visible += (1 - ds) * (1 - dt) if height >= heights[row, column] else 0.0
            visible += ds * (1 - dt) if height >= heights[row, column + 1] else 0.0
            visible += (1 - ds) * dt if height >= heights[row + 1, column] else 0.0
            visible += ds * dt if height >= heights[row + 1, column + 1] else 0.0
    return 0.5 + 0.5 * light * (0.7 + 0.3 * visible) + highlight * visible


@njit(cache=True, error_model="numpy")
def _byte(value):  # type: ignore[no-untyped-def]
    return np.uint8(min(value, 1.0) * 255 + 0.5)


@njit(cache=True, error_model="numpy")
def _level(f, u, v, pa, pb, pc, columns, rows, uvs, width, height, count):  # type: ignore[no-untyped-def]
    """Mipmap level of a pixel: log2 of the longer axis of the ellipse of texels that it covers, as GPUs have it."""
    qa, qb, qc = pa + columns[0], pb + columns[1], pc + columns[2]
    share = 1 / (qa + qb + qc)
    ux = ((qa * uvs[f, 0, 0] + qb * uvs[f, 1, 0] + qc * uvs[f, 2, 0]) * share - u) * width
    vx = ((qa * uvs[f, 0, 1] + qb * uvs[f, 1, 1] + qc * uvs[f, 2, 1]) * share - v) * height
    qa, qb, qc = pa + rows[0], pb + rows[1], pc + rows[2]
    share = 1 / (qa + qb + qc)
    uy = ((qa * uvs[f, 0, 0] + qb * uvs[f, 1, 0] + qc * uvs[f, 2, 0]) * share - u) * width
    vy = ((qa * uvs[f, 0, 1] + qb * uvs[f, 1, 1] + qc * uvs[f, 2, 1]) * share - v) * height
    along, across, mixed = ux * ux + vx * vx, uy * uy + vy * vy, ux * uy + vx * vy
    square = 0.5 * (along + across + np.sqrt((along - across) ** 2 + 4 * mixed * mixed))
    return min(max(0.5 * np.log2(max(square, 1e-12)), 0.0), count - 1.0)


@njit(cache=True, error_model="numpy")
def _sample(u, v, level, first, levels, texels):  # type: ignore[no-untyped-def]
    """Trilinear texture lookup: red, green, blue, 0 to 1."""
    near = int(level)
    part = level - near
    u, v = u - np.floor(u), v - np.floor(v)
    red, green, blue = 0.0, 0.0, 0.0
    for k in range(2):
        share = part if k else 1 - part
        if share == 0:
            continue
        start, width, height = levels[first + near + k, 0], levels[first + near + k, 1], levels[first + near + k, 2]
        s, t = u * width - 0.5, v * height - 0.5
        s0, t0 = np.floor(s), np.floor(t)
        ds, dt = s - s0, t - t0
        left, low = int(s0), int(t0)  # -1 to width - 1
        right, high = left + 1 if left + 1 < width else 0, low + 1 if low + 1 < height else 0
        left, low = left if left >= 0 else width - 1, low if low >= 0 else height - 1
        upper, lower = start + (height - 1 - high) * width, start + (height - 1 - low) * width
        a, b, c, d = lower + left, lower + right, upper + left, upper + right
        share /= 255
        wa, wb = (1 - ds) * (1 - dt) * share, ds * (1 - dt) * share
        wc, wd = (1 - ds) * dt * share, ds * dt * share
        red += wa * texels[a, 0] + wb * texels[b, 0] + wc * texels[c, 0] + wd * texels[d, 0]
        green += wa * texels[a, 1] + wb * texels[b, 1] + wc * texels[c, 1] + wd * texels[d, 1]
        blue += wa * texels[a, 2] + wb * texels[b, 2] + wc * texels[c, 2] + wd * texels[d, 2]
    return red, green, blue


@njit(cache=True, error_model="numpy")
def relight(ids, inverse_depth, surface, before, heights, touched, picture):  # type: ignore[no-untyped-def]
    """Colors anew the pixels of a kept layer on which the shadow has changed since it was painted.

    Args:
        ids: (H, W) where a face was painted over the layer.
        inverse_depth, surface: The layer's; see `shade_gl`.
        before, heights: (S, S) the shadow map when the layer was painted, and now.
        touched: (4,) first and last column, first and last row in which they may differ.
        picture: (H, W, 3) uint8, row 0 on top.
    """
    size = ids.shape[0]
    for y in range(size):
        for x in range(size):
            s, t = surface[y, x, 5], surface[y, x, 6]
            if s < touched[0] - 1 or s > touched[1] + 1 or t < touched[2] - 1 or t > touched[3] + 1:
                continue
            if ids[y, x] != NOTHING or inverse_depth[y, x] == 0 or surface[y, x, 3] < 0.5:
                continue
            column, row = int(np.floor(s)), int(np.floor(t))
            if column < 0 or row < 0 or column + 1 >= heights.shape[0] or row + 1 >= heights.shape[0]:
                continue
            changed = heights[row, column] != before[row, column] or heights[row, column + 1] != before[row, column + 1]
            row += 1
            changed |= (
                heights[row, column] != before[row, column] or heights[row, column + 1] != before[row, column + 1]
            )
            if changed:
                kept = surface[y, x]
                factor = _factor(kept[3], kept[4], s, t, kept[7], heights)
                for i in range(3):
                    picture[size - 1 - y, x, i] = _byte(kept[i] * factor)
