"""Error of a picture against a reference: squared, relative, trimmed, in the caustic mask, and FLIP.

The reference's own variance is subtracted from squared errors: what remains is an unbiased estimate of the picture's
error, which may fall below zero where the picture is as good as the reference.
"""

import math
from dataclasses import dataclass

import numpy as np

from causticmpi.compare.reference import ReferencePicture
from causticmpi.output.picture import RELMSE_FLOOR
from causticmpi.output.png import srgb_bytes

TRIMMED_SHARE = 0.001
"""Of the pixels, the worst, left out of a trimmed mean; at least one."""


@dataclass(frozen=True)
class Errors:
    """mse, rmse: radiance^2, radiance. relmse: mean((I - R)^2 / (R^2 + 0.01)) over pixels and channels. trimmed_*: the
    worst 0.1 % of pixels left out. mask_*: inside the caustic mask only, nan if it is empty. own_*: the reference's
    share, which has been subtracted. flip: mean of the FLIP map [Andersson et al. 2020] of the 8-bit sRGB pictures in
    [0, 1], nan where it was not computed."""

    mse: float
    rmse: float
    relmse: float
    trimmed_relmse: float
    mask_mse: float
    mask_relmse: float
    mask_trimmed_relmse: float
    own_mse: float
    own_relmse: float
    flip: float


def caustic_mask(reference: ReferencePicture, level: float) -> np.ndarray:
    """(H, W) bool: the caustic layer's largest channel exceeds `level`."""
    mask: np.ndarray = reference.caustic.max(axis=-1) > level
    return mask


def relative_error(rgb: np.ndarray, reference: ReferencePicture) -> np.ndarray:
    """(H, W) squared relative error, mean over channels; the reference's own share is in it."""
    truth = reference.rgb
    error: np.ndarray = ((rgb - truth) ** 2 / (truth**2 + RELMSE_FLOOR)).mean(axis=-1)
    return error


def signed_error(rgb: np.ndarray, reference: ReferencePicture, side: int) -> np.ndarray:
    """(H, W) mean over channels of (I - R) / sqrt(R^2 + 0.01), smoothed over side x side pixels: bias shows through."""
    from scipy.ndimage import uniform_filter

    relative = (rgb - reference.rgb) / np.sqrt(reference.rgb**2 + RELMSE_FLOOR)
    smooth: np.ndarray = uniform_filter(relative.mean(axis=-1), side, mode="nearest")
    return smooth


def measure(rgb: np.ndarray, reference: ReferencePicture, mask: np.ndarray, with_flip: bool) -> Errors:
    """All errors of one picture, (H, W, 3) radiance. Non-finite pixels make squared errors nan or inf."""
    square = ((rgb - reference.rgb) ** 2).mean(axis=-1)
    own_square = reference.variance.mean(axis=-1)
    relative = relative_error(rgb, reference)
    own_relative = (reference.variance / (reference.rgb**2 + RELMSE_FLOOR)).mean(axis=-1)
    mse = float((square - own_square).mean())
    return Errors(
        mse=mse,
        rmse=math.sqrt(mse) if mse > 0 else math.nan,
        relmse=float((relative - own_relative).mean()),
        trimmed_relmse=trimmed(relative, own_relative),
        mask_mse=_mean((square - own_square)[mask]),
        mask_relmse=_mean((relative - own_relative)[mask]),
        mask_trimmed_relmse=trimmed(relative[mask], own_relative[mask]),
        own_mse=float(own_square.mean()),
        own_relmse=float(own_relative.mean()),
        flip=mean_flip(rgb, reference.rgb) if with_flip else math.nan,
    )


def trimmed(errors: np.ndarray, own: np.ndarray) -> float:
    """Mean of errors - own without the largest TRIMMED_SHARE of `errors` (rounded up); nan if nothing is left."""
    order = np.argsort(errors, axis=None)
    kept = order[: len(order) - math.ceil(TRIMMED_SHARE * len(order))]
    return _mean((errors - own).ravel()[kept])


def _mean(values: np.ndarray) -> float:
    return float(values.mean()) if values.size else math.nan


def flip_missing() -> str | None:
    """Why FLIP cannot be computed, None if it can."""
    try:
        import flip_evaluator  # noqa: F401
    except ImportError:
        return "FLIP is left out: the package flip-evaluator is not installed (pip install '.[compare]' in the clone)"
    return None


def mean_flip(rgb: np.ndarray, truth: np.ndarray) -> float:
    """Mean FLIP of two pictures, (H, W, 3) radiance, as sRGB at exposure 0. Raises ImportError without the package."""
    import flip_evaluator

    shown = [srgb_bytes(picture).astype(np.float32) / 255 for picture in (truth, rgb)]
    _, mean, _ = flip_evaluator.evaluate(*shown, "LDR", applyMagma=False)
    return float(mean)
