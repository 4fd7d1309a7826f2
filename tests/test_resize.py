"""Pictures at another size: exact means, linear interpolation, and distances of surfaces that exist."""

import numpy as np
import pytest

from lerobot_lansar.pictures import resize


def weights(old, size):
    """What each old pixel of a line counts in a new one, from the definition; (size, old)."""
    table = np.zeros((size, old))
    for new in range(size):
        if size < old:
            for pixel in range(old):
                left, right = max(pixel, new * old / size), min(pixel + 1, (new + 1) * old / size)
                table[new, pixel] = max(right - left, 0) * size / old
        else:
            place = np.clip((new + 0.5) * old / size - 0.5, 0, old - 1)
            left = int(place)
            table[new, left] += 1 - (place - left)
            table[new, min(left + 1, old - 1)] += place - left
    return table


@pytest.mark.parametrize(("old", "size"), [(200, 128), (200, 100), (200, 16), (84, 64), (84, 128), (84, 200), (5, 256)])
def test_colours_are_means_over_areas_or_interpolated_between_centres(old, size):
    pictures = np.random.default_rng(0).integers(0, 256, (2, old, old, 3), dtype=np.uint8)
    table = weights(old, size)
    exact = np.einsum("ia,jb,nabc->nijc", table, table, pictures.astype(float))
    resized = resize(pictures, size)
    assert resized.dtype == np.uint8
    assert np.abs(resized - exact).max() < 0.5 + 1e-6
    np.testing.assert_array_equal(resize(pictures[0], size), resized[0])
    assert resize(np.full((old, old, 3), 255, np.uint8), size).min() == 255


def test_distances_are_those_of_the_nearest_pixel():
    depth = np.random.default_rng(0).random((2, 84, 84)).astype(np.float32)
    for size in (32, 42, 128):
        resized = resize(depth, size)
        nearest = ((np.arange(size) + 0.5) * 84 / size).astype(int)
        assert resized.dtype == np.float32
        np.testing.assert_array_equal(resized, depth[:, nearest][:, :, nearest])


def test_pictures_of_that_size_already_stay_as_they_are():
    picture = np.zeros((84, 84, 3), np.uint8)
    assert resize(picture, 84) is picture
