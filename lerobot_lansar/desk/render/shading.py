"""From the nearest face at each pixel to its color, compiled by numba: one shading per pixel.

The kernels share these arguments:

    ids (H, W) int32       face at each pixel, `NOTHING` where the picture stays as it is
    inverse_depth (H, W) float32 1 / w at each pixel
    matrices (G, 3, 4)     float32 from a group's frame to homogeneous pixels
    groups (S,)            the group of a shape; colors (S, 4) rgba
    picture (H, W, 3)      uint8, row 0 on top
"""

import math

import numpy as np
from numba import njit

from .raster import BLOCK, NOTHING


@njit(cache=True, error_model="numpy", fastmath={"contract", "arcp", "nsz"})
def _corner(face, i, m):  # type: ignore[no-untyped-def]
    """Column, row and 1 / w of a face's corner, whose coordinates begin at `i`."""
    x, y, z = face[i], face[i + 1], face[i + 2]
    inverse_depth = 1 / (m[2, 0] * x + m[2, 1] * y + m[2, 2] * z + m[2, 3])
    column = (m[0, 0] * x + m[0, 1] * y + m[0, 2] * z + m[0, 3]) * inverse_depth
    row = (m[1, 0] * x + m[1, 1] * y + m[1, 2] * z + m[1, 3]) * inverse_depth
    return float(column), float(row), float(inverse_depth)


@njit(cache=True, error_model="numpy", fastmath={"contract", "arcp", "nsz"})
def _planes(face, m):  # type: ignore[no-untyped-def]
    """For each corner of a face the plane over the picture, a + b * column + c * row, that is its perspective weight,
    not divided by the three weights' sum."""
    xa, ya, wa = _corner(face, 0, m)
    xb, yb, wb = _corner(face, 3, m)
    xc, yc, wc = _corner(face, 6, m)
    return (
        ((xb * yc - xc * yb) * wa, (yb - yc) * wa, (xc - xb) * wa),
        ((xc * ya - xa * yc) * wb, (yc - ya) * wb, (xa - xc) * wb),
        ((xa * yb - xb * ya) * wc, (ya - yb) * wc, (xb - xa) * wc),
    )


@njit(cache=True, error_model="numpy", fastmath={"contract", "arcp", "nsz"})
def _mixed(face, i, step, pa, pb, pc):  # type: ignore[no-untyped-def]
    """The weighted sum of what three corners have at `i`, `i + step` and `i + 2 * step`."""
    return pa * face[i] + pb * face[i + step] + pc * face[i + 2 * step]


@njit(cache=True, error_model="numpy", fastmath={"contract", "arcp", "nsz"})
def shade_tiny(ids, faces, matrices, shapes, groups, places, texels, colors, lights, up, picture):  # type: ignore[no-untyped-def]
    """TinyRenderer's light: 60 % ambient, 35 % diffuse, 5 % specular, no shadow.

    Args:
        ids, matrices, groups, colors, picture: See above.
        faces, shapes: Of the geometry.
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
            face = faces[f]
            (a0, a1, a2), (b0, b1, b2), (c0, c1, c2) = _planes(face, matrices[groups[shape]])
            pa, pb, pc = a0 + a1 * x + a2 * y, b0 + b1 * x + b2 * y, c0 + c1 * x + c2 * y
            total = pa + pb + pc
            pa, pb, pc = pa / total, pb / total, pc / total
            square, toward, upward, light_up = 0.0, 0.0, 0.0, 0.0
            for i in range(3):
                n = _mixed(face, 9 + i, 3, pa, pb, pc)
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
                u, v = _mixed(face, 18, 2, pa, pb, pc), _mixed(face, 19, 2, pa, pb, pc)
                column = min(int((u - np.floor(u)) * width), width - 1)
                line = min(int((v - np.floor(v)) * height), height - 1)
                texel = start + (height - 1 - line) * width + column
            for i in range(3):
                base = texels[texel, i] if width > 0 else 255
                value = light * np.floor(base * colors[shape, i])
                # a face without a direction comes out black
                picture[size - 1 - y, x, i] = min(int(value), 255) if value == value else 0


@njit(cache=True, error_model="numpy", fastmath={"contract", "arcp", "nsz"})
def shade_gl(
    ids,
    inverse_depth,
    faces,
    matrices,
    shapes,
    groups,
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
        ids, inverse_depth, matrices, groups, colors, picture: See above.
        faces, shapes: Of the geometry.
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
    last, face, shape, turn = NOTHING, faces[0], shapes[0], rotations[0]
    a0, a1, a2, b0, b1, b2, c0, c1, c2 = 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0
    for y in range(size):
        for x in range(size):
            f = ids[y, x]
            if f == NOTHING:
                continue
            if f != last:  # neighbours often show the same face
                last, face, shape = f, faces[f], shapes[f]
                group = groups[shape]
                turn = rotations[group]
                (a0, a1, a2), (b0, b1, b2), (c0, c1, c2) = _planes(face, matrices[group])
            pa, pb, pc = a0 + a1 * x + a2 * y, b0 + b1 * x + b2 * y, c0 + c1 * x + c2 * y
            total = pa + pb + pc
            # the normal need not be divided by it; a face that reaches behind the eye may have a negative one
            n0 = _mixed(face, 9, 3, pa, pb, pc)
            n1 = _mixed(face, 10, 3, pa, pb, pc)
            n2 = _mixed(face, 11, 3, pa, pb, pc)
            share = (1 if total > 0 else -1) / np.sqrt(n0 * n0 + n1 * n1 + n2 * n2)
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
                share = 1 / total
                u, v = _mixed(face, 18, 2, pa, pb, pc) * share, _mixed(face, 19, 2, pa, pb, pc) * share
                ux, vx = _slope(face, u, v, a1, b1, c1, share)
                uy, vy = _slope(face, u, v, a2, b2, c2, share)
                width, high = levels[first, 1], levels[first, 2]
                level = _level(ux * width, vx * high, uy * width, vy * high, count)
                red, green, blue = _sample(u, v, level, first, levels, texels)
            red, green, blue = red * colors[shape, 0], green * colors[shape, 1], blue * colors[shape, 2]
            light = 0.5 + 0.5 * toward
            visible = _visible(s, t, height, heights) if light >= 0.5 else 0.0
            factor = _factor(light, highlight, visible)
            out = picture[size - 1 - y, x]
            out[0], out[1], out[2] = _byte(red * factor), _byte(green * factor), _byte(blue * factor)
            if keep:
                into = surface[y, x]
                into[0], into[1], into[2], into[3], into[4] = red, green, blue, light, highlight
                into[5], into[6], into[7] = s, t, height


@njit(cache=True, error_model="numpy", fastmath={"contract", "arcp", "nsz"})
def _highlight(lamp, px, py, pz, nx, ny, nz):  # type: ignore[no-untyped-def]
    """Half the cosine between the mirrored light and the way to the eye, to the power of 41."""
    ax, ay, az = lamp[0, 0] - px, lamp[0, 1] - py, lamp[0, 2] - pz
    bx, by, bz = lamp[1, 0] - px, lamp[1, 1] - py, lamp[1, 2] - pz
    to_light, to_eye = ax * nx + ay * ny + az * nz, bx * nx + by * ny + bz * nz
    across = 2 * to_light * to_eye - (ax * bx + ay * by + az * bz)
    if across <= 0:
        return 0.0
    c2 = across * across / ((ax * ax + ay * ay + az * az) * (bx * bx + by * by + bz * bz))
    if c2 < 0.64:  # a highlight of less than 0.02 of 255
        return 0.0
    c8 = c2 * c2 * c2 * c2
    return 0.5 * c8 * c8 * c8 * c8 * c8 * np.sqrt(c2)


@njit(cache=True, error_model="numpy", fastmath={"contract", "arcp", "nsz"})
def _visible(s, t, height, heights):  # type: ignore[no-untyped-def]
    """The share of the light that no caster is in the way of, 0 to 1, between four texels of the shadow map."""
    extent = heights.shape[0]
    left, low = np.floor(s), np.floor(t)
    column, row = int(left), int(low)
    if column < 0 or row < 0 or column + 1 >= extent or row + 1 >= extent:
        return 1.0
    a, b = height >= heights[row, column], height >= heights[row, column + 1]
    c, d = height >= heights[row + 1, column], height >= heights[row + 1, column + 1]
    if a & b & c & d:
        return 1.0
    if not (a | b | c | d):
        return 0.0
    ds, dt = s - left, t - low
    return (1 - dt) * ((1 - ds) * a + ds * b) + dt * ((1 - ds) * c + ds * d)


@njit(cache=True, error_model="numpy", fastmath={"contract", "arcp", "nsz"})
def _factor(light, highlight, visible):  # type: ignore[no-untyped-def]
    """What the albedo is multiplied with."""
    return 0.5 + 0.5 * light * (0.7 + 0.3 * visible) + highlight * visible


@njit(cache=True, error_model="numpy", fastmath={"contract", "arcp", "nsz"})
def _byte(value):  # type: ignore[no-untyped-def]
    return np.uint8(min(value, 1.0) * 255 + 0.5)


@njit(cache=True, error_model="numpy", fastmath={"contract", "arcp", "nsz"})
def _slope(face, u, v, a, b, c, share):  # type: ignore[no-untyped-def]
    """What the texture coordinates u and v grow by per pixel, if the corners' weights grow by a, b and c; `share` is
    1 / the weights' sum."""
    sum_ = a + b + c
    return (_mixed(face, 18, 2, a, b, c) - u * sum_) * share, (_mixed(face, 19, 2, a, b, c) - v * sum_) * share


@njit(cache=True, error_model="numpy", fastmath={"contract", "arcp", "nsz"})
def _level(ux, vx, uy, vy, count):  # type: ignore[no-untyped-def]
    """Mipmap level of a pixel: log2 of the longer axis of the ellipse of texels that it covers, as GPUs have it.

    Args:
        ux, vx, uy, vy: Texels per column and per row of the picture.
        count: How many levels there are.
    """
    along, across, mixed = ux * ux + vx * vx, uy * uy + vy * vy, ux * uy + vx * vy
    square = 0.5 * (along + across + np.sqrt((along - across) ** 2 + 4 * mixed * mixed))
    # log2 of the mantissa, 0.5 to 1, by a cubic: at most 0.0014 off
    mantissa, exponent = math.frexp(max(square, 1e-12))
    power = exponent - 3.13396 + mantissa * (6.02197 + mantissa * (1.2315 * mantissa - 4.11852))
    return min(max(0.5 * power, 0.0), count - 1.0)


@njit(cache=True, error_model="numpy", fastmath={"contract", "arcp", "nsz"})
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


@njit(cache=True, error_model="numpy", fastmath={"contract", "arcp", "nsz"})
def relight(lit, dark, ids, surface, heights, dirty, picture):  # type: ignore[no-untyped-def]
    """Colors anew the pixels of a kept layer on which shadows of what moves fall.

    Args:
        lit: (n, 3) int32 pixels to look at: number, and the shadow map's column and row there.
        dark: (n, 3) uint8 their colors in full shadow.
        ids: (H, W) where a face was painted over the layer.
        surface: (H, W, 8) the layer's; see `shade_gl`.
        heights: (S, S) the shadow map.
        dirty: Its blocks that hold more than the shadows in the layer; see `raster.cast`.
        picture: (H, W, 3) uint8, row 0 on top.
    """
    size = ids.shape[0]
    for k in range(len(lit)):
        if dirty[lit[k, 2] // BLOCK, lit[k, 1] // BLOCK] == 0:
            continue
        y, x = lit[k, 0] // size, lit[k, 0] % size
        if ids[y, x] != NOTHING:
            continue
        kept = surface[y, x]
        visible = _visible(kept[5], kept[6], kept[7], heights)
        if visible == 0:
            for i in range(3):
                picture[size - 1 - y, x, i] = dark[k, i]
        elif visible < 1:
            factor = _factor(kept[3], kept[4], visible)
            for i in range(3):
                picture[size - 1 - y, x, i] = _byte(kept[i] * factor)


@njit(cache=True, error_model="numpy", fastmath={"contract", "arcp", "nsz"})
def darken(lit, surface, dark):  # type: ignore[no-untyped-def]
    """Fills `dark`; see `relight`."""
    for k in range(len(lit)):
        kept = surface[lit[k, 0] // surface.shape[0], lit[k, 0] % surface.shape[0]]
        for i in range(3):
            dark[k, i] = _byte(kept[i] * _factor(kept[3], kept[4], 0.0))
