"""The colour of each pixel in the two looks, compiled by numba.

Screen coordinates are those of `raster`.
"""

import numpy as np
from numba import njit

from .raster import NOTHING


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
def shade_tiny(ids, faces, screen, owner, normals, uvs, textures, texels, colors, lights, up, picture):  # type: ignore[no-untyped-def]
    """Colours every pixel that shows a face as TinyRenderer does: 60 % ambient, 35 % diffuse, 5 % specular light.

    Args:
        ids: (H, W) int32 face numbers, `NOTHING` where the picture stays as it is.
        faces: (F, 3) rows of `screen`.
        screen: (V, 3) from `raster.project`.
        owner: (F,) the shape that a face belongs to.
        normals: (F, 3, 3) unit normals of the corners in the shape's frame.
        uvs: (F, 3, 2) texture coordinates of the corners.
        textures: (S, 3) first texel, width and height of a shape's texture; width 0 for none.
        texels: (T, 3) uint8.
        colors: (S, 4) rgba.
        lights, up: (S, 3) directions of the light and of the world's z axis in the shape's frame.
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
            start, width, height = textures[shape, 0], textures[shape, 1], textures[shape, 2]
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
                # NaN, of a face without a normal, becomes black
                picture[size - 1 - y, x, i] = min(int(value), 255) if value == value else 0


@njit(cache=True, error_model="numpy")
def light_gl(
    ids,
    faces,
    screen,
    owner,
    normals,
    uvs,
    textures,
    levels,
    texels,
    colors,
    poses,
    groups,
    vertices,
    light,
    eye,
    shadow,
    canvas,
):  # type: ignore[no-untyped-def]
    """What Bullet's OpenGL shader computes for every pixel that shows a face, except the shadow.

    Args:
        ids, faces, screen, owner, normals, uvs, texels, colors: As in `shade_tiny`.
        textures: (S, 2) first mipmap level in `levels` and number of levels, 0 without texture.
        levels: (L, 3) first texel, width and height.
        poses: (G, 4, 4) link frames.
        groups: (S,) the group of a shape.
        vertices: (3, V) in the link frames.
        light, eye: (3,) positions of the light and of the eye for which highlights are computed.
        shadow: (3, 4) world to shadow map column, row and height towards the light.
        canvas: (H, W, 8) float32 to fill: albedo (3), light 0 to 1, highlight, shadow map column, row, height.
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
            first, count = textures[shape, 0], textures[shape, 1]
            if count == 0:
                rgb[:] = 1
            else:
                _sample(f, x, y, ba, bb, bc, faces, screen, uvs, first, count, levels, texels, rgb)
            for i in range(3):
                canvas[y, x, i] = rgb[i] * colors[shape, i]
                canvas[y, x, 5 + i] = (
                    shadow[i, 0] * point[0] + shadow[i, 1] * point[1] + shadow[i, 2] * point[2] + shadow[i, 3]
                )
            canvas[y, x, 3] = 0.5 + 0.5 * toward
            canvas[y, x, 4] = highlight


@njit(cache=True, error_model="numpy")
def _sample(f, x, y, ba, bb, bc, faces, screen, uvs, first, count, levels, texels, rgb):  # type: ignore[no-untyped-def]
    """Trilinear texture lookup into `rgb` (3,), 0 to 1; the neighbours' coordinates determine the mipmap level."""
    u = ba * uvs[f, 0, 0] + bb * uvs[f, 1, 0] + bc * uvs[f, 2, 0]
    v = ba * uvs[f, 0, 1] + bb * uvs[f, 1, 1] + bc * uvs[f, 2, 1]
    width, height = levels[first, 1], levels[first, 2]
    max_square = 0.0
    for k in range(2):
        na, nb, nc = weights(f, x + (1 - k), y + k, faces, screen)
        du = (na * uvs[f, 0, 0] + nb * uvs[f, 1, 0] + nc * uvs[f, 2, 0] - u) * width
        dv = (na * uvs[f, 0, 1] + nb * uvs[f, 1, 1] + nc * uvs[f, 2, 1] - v) * height
        max_square = max(max_square, du * du + dv * dv)
    level = min(max(0.5 * np.log2(max(max_square, 1e-12)), 0.0), count - 1.0)
    near = int(level)
    part = level - near
    rgb[:] = 0
    for k in range(2):
        share = part if k else 1 - part
        if share == 0:
            continue
        start, width, height = levels[first + near + k]
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
def compose_gl(canvas, depth_buffer, heights, step, picture):  # type: ignore[no-untyped-def]
    """Combines light, highlight and shadow of every pixel into its colour.

    Args:
        canvas: From `light_gl`.
        depth_buffer: (H, W), 0 where there is nothing.
        heights: (S, S) float32 shadow map: height of the back face nearest to the light (m), 0 for none.
        step: Height of one step of the original's 16-bit map, m.
        picture: (H, W, 3) uint8, row 0 on top.
    """
    size, extent = canvas.shape[0], heights.shape[0]
    for y in range(size):
        for x in range(size):
            if depth_buffer[y, x] == 0:
                continue
            light = canvas[y, x, 3]
            visible = 0.0
            if light >= 0.5:
                s, t, height = canvas[y, x, 5], canvas[y, x, 6], canvas[y, x, 7]
                s0, t0 = np.floor(s), np.floor(t)
                for corner in range(4):
                    i, j = corner % 2, corner // 2
                    weight = (s - s0 if i else 1 - s + s0) * (t - t0 if j else 1 - t + t0)
                    column, row = int(s0) + i, int(t0) + j
                    covered = 0 <= column < extent and 0 <= row < extent
                    if not covered or height >= np.round(heights[row, column] / step) * step:
                        visible += weight
            light *= 0.7 + 0.3 * visible
            factor = 0.5 + 0.5 * light + canvas[y, x, 4] * visible
            for i in range(3):
                picture[size - 1 - y, x, i] = int(min(canvas[y, x, i] * factor, 1.0) * 255 + 0.5)
