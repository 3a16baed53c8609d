"""The picture to look at: 8-bit sRGB. The only place where radiance is clamped."""

import os

import numpy as np
from numpy.typing import NDArray

from causticmpi import __version__

# Non-finite pixels are drawn in a colour no one overlooks rather than as black or white.
NONFINITE_COLOUR = (255, 0, 255)


def srgb_bytes(rgb: NDArray[np.float64]) -> NDArray[np.uint8]:
    """Linear Rec.709 radiance to 8-bit sRGB [IEC 61966-2-1], 1.0 = white.

    rgb : (H, W, 3); clamped to [0, 1], rounded to the nearest byte.
    A pixel with a non-finite channel comes out magenta (255, 0, 255). Returns (H, W, 3).
    """
    finite = np.isfinite(rgb).all(axis=-1, keepdims=True)
    linear = np.clip(np.where(finite, rgb, 0.0), 0.0, 1.0)
    curve = np.where(linear <= 0.0031308, 12.92 * linear, 1.055 * linear ** (1 / 2.4) - 0.055)
    pixels = np.floor(255.0 * curve + 0.5).astype(np.uint8)
    return np.where(finite, pixels, np.array(NONFINITE_COLOUR, np.uint8))


def write_png(path: str | os.PathLike[str], rgb: NDArray[np.float64], biased: bool = False) -> None:
    """Write `rgb` ((H, W, 3), linear Rec.709 radiance) as 8-bit sRGB; see `srgb_bytes`.

    tEXt chunks: Software, Exposure (in stops), Biased where the method is, and NonfinitePixels where
    there are any.
    Raises OSError where the file cannot be written.
    """
    from PIL import Image, PngImagePlugin  # late: other ranks never write

    info = PngImagePlugin.PngInfo()
    info.add_text("Software", f"causticmpi {__version__}")
    info.add_text("Exposure", "+0 stops (radiance x 1, sRGB, clamped)")
    if biased:
        info.add_text("Biased", "yes")
    broken = int(np.count_nonzero(~np.isfinite(rgb).all(axis=-1)))
    if broken:
        info.add_text("NonfinitePixels", f"{broken} (drawn magenta)")
    info.add(b"sRGB", b"\0")  # says which curve the bytes follow, so that no viewer has to guess
    # Level 1: noise hardly compresses further, and this is written again and again while a run goes on.
    Image.fromarray(srgb_bytes(rgb)).save(path, "PNG", pnginfo=info, compress_level=1)
