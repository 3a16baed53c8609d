"""Which pixels a kernel visits, in which order, and how it hands over their radiance."""

import numpy as np

from causticmpi.kernels.jit import inline

TILE = 4
"""Pixels are visited in squares of TILE x TILE: one 16-wide packet."""
BLOCK = 32
"""Squares are grouped in blocks, so that neighbours in time are neighbours in the picture."""


def pixel_order(window: tuple[int, int, int, int], width: int) -> np.ndarray:
    """(n, 4) int32, n a multiple of 16: x, y, number and slot of each pixel of the window, tile by tile.

    window: x0, y0, x1, y1, half open. A tile cut by the border is filled up with rows of -1.
    number: y * width + x in the whole film, names the random numbers: a crop along tile borders (multiples of 4 pixels)
    has the same samples as the whole; one that cuts tiles may gather other photons for them.
    slot: row of the pass film, which holds the window alone, in scan order.
    """
    x0, y0, x1, y1 = window
    # Tiles lie on the same grid for every window: what the pixels of a tile share is the same in a crop.
    xs, ys = (
        np.arange(low - low % TILE, low - low % TILE + -(-(high - low + low % TILE) // BLOCK) * BLOCK)
        for low, high in ((x0, x1), (y0, y1))
    )
    y, x = np.meshgrid(ys, xs, indexing="ij")
    per = BLOCK // TILE
    shape = (len(ys) // BLOCK, per, TILE, len(xs) // BLOCK, per, TILE)
    x, y = (a.reshape(shape).transpose(0, 3, 1, 4, 2, 5).reshape(-1, TILE * TILE) for a in (x, y))
    inside = (x >= x0) & (x < x1) & (y >= y0) & (y < y1)
    keep = inside.any(axis=1)
    order = np.where(inside[..., None], np.stack([x, y, y * width + x, (y - y0) * (x1 - x0) + x - x0], axis=-1), -1)[
        keep
    ]
    return np.ascontiguousarray(order.reshape(-1, 4).astype(np.int32))


@inline
def add_sample(film, slot, diffusive, caustic):
    """Add one sample to row `slot` of a pass film (slots, 6) float32: L_d, then L_c."""
    film[slot, 0] += diffusive[0]
    film[slot, 1] += diffusive[1]
    film[slot, 2] += diffusive[2]
    film[slot, 3] += caustic[0]
    film[slot, 4] += caustic[1]
    film[slot, 5] += caustic[2]
