"""Another centre of a dot, independent of the ellipse fit to grey values: to question it, not to measure with.

Contours at half height with an ellipse through them (scikit-image) are good to some hundredths of a pixel.
"""

import numpy as np
from numpy.typing import NDArray
from skimage.measure import EllipseModel, find_contours

Array = NDArray[np.float64]


def crop_around(image: NDArray, xy: Array, half: int) -> tuple[Array, int, int]:
    """The square of the image (h, w) around a place (2,), cut at the border, and x and y of its first pixel."""
    height, width = image.shape
    x, y = round(float(xy[0])), round(float(xy[1]))
    x0, y0 = max(0, x - half), max(0, y - half)
    return image[y0 : min(height, y + half + 1), x0 : min(width, x + half + 1)].astype(float), x0, y0


def contour_centres(image: NDArray, xy: Array, semi_axes: Array, background: Array, contrast: Array) -> Array:
    """(n, 2) centres of ellipses through the contour at half height; NaN where there is no closed contour.

    Parameters
    ----------
    image : (h, w), bright dots. xy : (n, 2) places. semi_axes : (n, 2). background, contrast : (n,) grey values.
    """
    result = np.full((len(xy), 2), np.nan)
    for row, place in enumerate(np.asarray(xy, dtype=float)):
        crop, x0, y0 = crop_around(image, place, int(np.ceil(semi_axes[row].max() + 4.0)))
        here = place - np.array([x0, y0])
        best: tuple[float, Array] | None = None
        for contour in find_contours(crop, background[row] + 0.5 * contrast[row]):
            if len(contour) < 8 or not np.allclose(contour[0], contour[-1]):
                continue
            distance = float(np.linalg.norm(contour[:, ::-1].mean(axis=0) - here))
            if best is None or distance < best[0]:
                best = distance, contour[:-1, ::-1]
        if best is None:
            continue
        model = _ellipse_through(best[1])
        if model is not None:
            result[row] = model + np.array([x0, y0])
    return result


def _ellipse_through(points: Array) -> Array | None:
    """Centre of scikit-image's least-squares ellipse; both its old and its new interface."""
    if hasattr(EllipseModel, "from_estimate"):
        model = EllipseModel.from_estimate(points)
        return np.asarray(model.center, dtype=float) if model else None
    model = EllipseModel()
    return np.asarray(model.params[:2], dtype=float) if model.estimate(points) else None
