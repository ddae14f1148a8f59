"""Images of floors and their places."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import BinaryIO

import numpy as np
from numpy.typing import NDArray
from PIL import Image, UnidentifiedImageError

from swiftwrf import InputError
from tasks.records import write_npz

MAX_PLAN_PIXELS = 2**24
STORED = "floor-plan.npz"  # in the directory of a run
Corners = tuple[float, float, float, float]  # x0, x1, y0, y1 [m]


@dataclass(frozen=True, eq=False)
class FloorPlan:
    """An image of a floor and its place.

    Args:
        pixels: Image (height, width, 3), the first row on top.
        corners: Positions x0, x1, y0, y1 [m] of its edges.
    """

    pixels: NDArray[np.uint8]
    corners: Corners

    @classmethod
    def scaled(cls, pixels: NDArray[np.uint8], metres_per_pixel: float, origin: tuple[float, float]) -> FloorPlan:
        """Return an image at the place that its scale and its origin determine.

        Args:
            pixels: Image (height, width, 3).
            metres_per_pixel: Length of a pixel [m].
            origin: Pixel at x = y = 0, counted to the right and down from the upper left corner.

        Raises:
            InputError: A scale that is not positive and finite, or an origin that is not finite.

        Example:
            >>> FloorPlan.scaled(np.zeros((30, 40, 3), np.uint8), 0.5, (0, 30)).corners
            (0.0, 20.0, 0.0, 15.0)
        """
        if not (np.isfinite([metres_per_pixel, *origin]).all() and metres_per_pixel > 0):
            raise InputError("a floor plan needs a positive scale [m a pixel] and an origin [pixels]")
        height, width = pixels.shape[:2]
        right, down = origin
        edges = (-right, width - right, down - height, down)
        x0, x1, y0, y1 = (float(metres_per_pixel * edge) for edge in edges)
        return cls(pixels, (x0, x1, y0, y1))

    def save(self, folder: Path) -> None:
        """Write the plan into the directory of a run."""
        write_npz(folder / STORED, {"pixels": self.pixels, "corners": np.array(self.corners)})

    @classmethod
    def load(cls, folder: Path) -> FloorPlan | None:
        """Return the plan in the directory of a run, or None if it has none."""
        if not (folder / STORED).is_file():
            return None
        with np.load(folder / STORED) as stored:
            x0, x1, y0, y1 = stored["corners"].tolist()
            return cls(stored["pixels"], (x0, x1, y0, y1))


def read_pixels(file: str | Path | BinaryIO, name: str) -> NDArray[np.uint8]:
    """Return the pixels (height, width, 3) of a PNG or JPEG image.

    Args:
        file: File or its name.
        name: Name of the image in errors.

    Raises:
        InputError: No readable image, or one of more than `MAX_PLAN_PIXELS`.
    """
    try:
        # two formats only: Pillow starts other programs for some; the pixels are read here, since the file may be truncated
        with Image.open(file, formats=("PNG", "JPEG")) as image:
            if image.width * image.height > MAX_PLAN_PIXELS:
                raise InputError(
                    f"{name} has {image.width} x {image.height} pixels; give one of at most {MAX_PLAN_PIXELS}"
                )
            return np.asarray(image.convert("RGB"))
    except InputError:
        raise
    except (UnidentifiedImageError, Image.DecompressionBombError, OSError, SyntaxError, ValueError) as error:
        raise InputError(f"{name} is not a readable image, PNG or JPEG ({error})") from None
