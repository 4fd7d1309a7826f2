"""Pictures at another size, computed in one way for recordings, datasets and the environment. Needs numpy only."""

from functools import cache

import numpy as np

MAX_SIZE = 256
"""Largest width and height that pictures may be brought to; CALVIN's own have 200 and 84 pixels."""


def check_size(option: str, size: int, largest: int = MAX_SIZE) -> None:
    """Raises ValueError unless an option's value is a size of pictures in pixels, or 0."""
    if not 0 <= size <= largest:
        raise ValueError(f"{option} must be between 1 and {largest} pixels, or 0 for the cameras' own, got {size}")


def resize(pictures: np.ndarray, size: int) -> np.ndarray:
    """Square pictures of another size; the same bits on every machine.

    A colour becomes the mean over the area that a new pixel covers, if it covers more than an old one, and is
    interpolated linearly between the old pixels' centres otherwise. A distance is that of the nearest old pixel: a
    mean across an edge would be a point in the air between two surfaces.

    Args:
        pictures: Colours (..., n, n, 3) uint8, or distances (..., n, n) of a floating dtype.
        size: Width and height of the new pictures, pixels.

    Returns:
        (..., size, size, 3) or (..., size, size) of the same dtype; `pictures` itself if it has that size.
    """
    is_color = pictures.dtype == np.uint8
    old = pictures.shape[-2]
    if old == size:
        return pictures
    if not is_color:
        nearest = (2 * np.arange(size) + 1) * old // (2 * size)
        return pictures[..., nearest[:, None], nearest]
    taps, total = _taps(old, size)
    colors = np.moveaxis(pictures, (-3, -2), (0, 1)).astype(np.uint32)
    sums = _combine(np.moveaxis(_combine(colors, taps), 1, 0), taps)  # column, row, ...
    means = (2 * sums + total**2) // (2 * total**2)
    return np.moveaxis(means, (1, 0), (-3, -2)).astype(np.uint8)


def _combine(lines: np.ndarray, taps: tuple[tuple[np.ndarray, np.ndarray], ...]) -> np.ndarray:
    """Weighted sums along the first axis."""
    parts = [weights.reshape(-1, *[1] * (lines.ndim - 1)) * lines[pixels] for pixels, weights in taps]
    return np.asarray(np.sum(parts, axis=0, dtype=np.uint32))


@cache
def _taps(old: int, size: int) -> tuple[tuple[tuple[np.ndarray, np.ndarray], ...], int]:
    """Which pixels of an old line make those of a new one.

    Returns:
        A few pairs of old pixel and its weight, both (size,), for each new pixel. Weights are whole numbers, so that
        sums are exact. And their sum, the same for each new pixel.
    """
    new = np.arange(size)
    parts: list[tuple[np.ndarray, np.ndarray]] = []
    if size < old:  # the area that a new pixel covers, in 1/size of an old one
        total, first = old, new * old // size
        for pixel in (first + k for k in range(-(-old // size) + 1)):
            overlap = np.minimum((new + 1) * old, (pixel + 1) * size) - np.maximum(new * old, pixel * size)
            parts.append((pixel, np.maximum(overlap, 0)))
    else:  # between the centres of two old pixels, in 1/(2 size) of their distance
        total = 2 * size
        left, part = np.divmod((2 * new + 1) * old - size, total)
        parts += [(left, total - part), (left + 1, part)]
    return tuple((np.clip(pixel, 0, old - 1), weights.astype(np.uint32)) for pixel, weights in parts), total
