"""Images of values, a pixel each."""

from __future__ import annotations

import numpy as np
from matplotlib import colormaps
from numpy.typing import NDArray
from PIL import Image

TRANSPARENT = 255  # palette index of pixels without a value


def colour_image(values: NDArray[np.floating], colours: str, low: float = 0.0, high: float = 1.0) -> Image.Image:
    """Return an image of values (rows, columns), the first row on top; nan is transparent.

    Args:
        values: NDArray[np.floating] of the pixels.
        colours: Name of a matplotlib colour map.
        low: Value of its first colour.
        high: Value of its last colour.
    """
    scaled = (values - low) * (TRANSPARENT - 1) / (high - low or 1.0)
    image = Image.fromarray(
        np.where(np.isnan(values), TRANSPARENT, np.clip(scaled, 0, TRANSPARENT - 1)).astype(np.uint8)
    )
    rgb = colormaps[colours](np.linspace(0, 1, TRANSPARENT), bytes=True)[:, :3]
    image.putpalette(rgb.tobytes() + b"\0\0\0")
    image.info["transparency"] = TRANSPARENT
    return image
