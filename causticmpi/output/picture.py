"""The finished picture as rank 0 holds it: plain arrays, all of the same window of the film."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

# Keeps black pixels from dominating the relative error; part of the report's definition of estimated_relmse.
RELMSE_FLOOR = 0.01


@dataclass(frozen=True, eq=False)
class Picture:
    """Radiance, its parts and the features of the first hit, for the pixels that were rendered.

    rgb, diffusive, caustic : (H, W, 3) float64, linear Rec.709 radiance; rgb = diffusive (L_d) + caustic (L_c)
    variance : (H, W, 3) float64, radiance^2, variance of the mean of rgb from independent passes; zeros for one pass
    albedo : (H, W, 3) float32, reflectance; normal : (H, W, 3) float32, unit length or zero where nothing is hit
    depth : (H, W) float32, scene units
    film_size : (width, height) of the whole film in pixels
    crop : (x0, y0, x1, y1), half open, the window of the film that the arrays cover; None: all of it

    Raises ValueError where the shapes, the crop and the film disagree.
    """

    rgb: NDArray[np.float64]
    diffusive: NDArray[np.float64]
    caustic: NDArray[np.float64]
    variance: NDArray[np.float64]
    albedo: NDArray[np.float32]
    normal: NDArray[np.float32]
    depth: NDArray[np.float32]
    film_size: tuple[int, int]
    crop: tuple[int, int, int, int] | None = None

    def __post_init__(self) -> None:
        x0, y0, x1, y1 = self.window
        if not (0 <= x0 < x1 <= self.film_size[0] and 0 <= y0 < y1 <= self.film_size[1]):
            raise ValueError(f"crop {self.crop} is not a window of the film {self.film_size}")
        size = (y1 - y0, x1 - x0)
        for name in ("rgb", "diffusive", "caustic", "variance", "albedo", "normal", "depth"):
            shape, needed = getattr(self, name).shape, size if name == "depth" else (*size, 3)
            if shape != needed:
                raise ValueError(f"{name} has shape {shape}, needs {needed}")

    @property
    def window(self) -> tuple[int, int, int, int]:
        """(x0, y0, x1, y1), half open, in pixels of the film."""
        return self.crop if self.crop is not None else (0, 0, *self.film_size)

    @property
    def height(self) -> int:
        """Rows of the arrays (of the crop window, if there is one)."""
        return int(self.rgb.shape[0])

    @property
    def width(self) -> int:
        """Columns of the arrays (of the crop window, if there is one)."""
        return int(self.rgb.shape[1])


def estimated_relmse(rgb: NDArray[np.float64], variance: NDArray[np.float64]) -> float:
    """Relative mean squared error as the picture's own variance predicts it: mean(variance / (rgb^2 + 0.01)).

    rgb : (H, W, 3) radiance; variance : (H, W, 3) of the mean, radiance^2. Dimensionless, >= 0; not finite where
    a pixel is not. Zeros (a single pass) give 0, which says nothing: the report writes null then.
    """
    # Non-finite pixels pass through on purpose (nan or inf), without a warning for each: the report names them.
    with np.errstate(invalid="ignore", over="ignore"):
        return float(np.mean(variance / (np.square(rgb) + RELMSE_FLOOR)))
