"""Maps in plan: values as colours above the image of a floor."""

from __future__ import annotations

from dataclasses import dataclass
from hashlib import sha256
from pathlib import Path
from typing import BinaryIO

import numpy as np
from matplotlib import colormaps
from matplotlib.axes import Axes
from matplotlib.colors import ListedColormap
from numpy.typing import NDArray
from PIL import Image, UnidentifiedImageError

from swiftwrf import InputError
from swiftwrf.positions import MAX_COORDINATE_M
from swiftwrf.runtime.checkpoint import refusing
from swiftwrf.runtime.durable import write_npz
from tasks.configs import FloorPlanConfig
from tasks.labels import COVERAGE
from tasks.records import read_npz

TRANSPARENT = 255  # palette index of pixels without a value
MAX_PLAN_PIXELS = 2**24
STORED = "floor-plan.npz"  # in the directory of a run
Corners = tuple[float, float, float, float]  # x0, x1, y0, y1 [m]
CLASS_COLOURS = "coverage"  # colour map of `swiftwrf.rssi.coverage.CLASSES` by their numbers
colormaps.register(ListedColormap(list(COVERAGE.values()), CLASS_COLOURS), force=True)


def colour_image(values: NDArray[np.floating], colours: str, low: float = 0.0, high: float = 1.0) -> Image.Image:
    """Return an image of values (rows, columns), the first row on top; nan is transparent.

    `low` and `high` have the first and the last colour of a matplotlib colour map.
    """
    scaled = (values - low) * (TRANSPARENT - 1) / (high - low or 1.0)
    image = Image.fromarray(
        np.where(np.isnan(values), TRANSPARENT, np.clip(scaled, 0, TRANSPARENT - 1)).astype(np.uint8)
    )
    rgb = colormaps[colours](np.linspace(0, 1, TRANSPARENT), bytes=True)[:, :3]
    image.putpalette(rgb.tobytes() + b"\0\0\0")
    image.info["transparency"] = TRANSPARENT
    return image


@dataclass(frozen=True, eq=False)
class FloorPlan:
    """An image of a floor, (height, width, 3) with the first row on top, and the edges x0, x1, y0, y1 [m] of its place.

    Raises:
        InputError: No pixels, or edges that are not in order or beyond 1e9 m.
    """

    pixels: NDArray[np.uint8]
    corners: Corners

    def __post_init__(self) -> None:
        x0, x1, y0, y1 = self.corners
        near = all(abs(edge) <= MAX_COORDINATE_M for edge in self.corners)  # false for nan
        is_image = self.pixels.dtype == np.uint8 and self.pixels.shape[2:] == (3,) and self.pixels.size
        if not (near and x0 < x1 and y0 < y1 and is_image):
            raise InputError(
                f"a floor plan needs pixels, a positive scale [m a pixel] and an origin [pixels] with edges within "
                f"{MAX_COORDINATE_M:g} m, got edges at {x0:g}, {x1:g}, {y0:g}, {y1:g} m"
            )

    @classmethod
    def scaled(cls, pixels: NDArray[np.uint8], metres_per_pixel: float, origin: tuple[float, float]) -> FloorPlan:
        """Return an image (height, width, 3) at the place that the length of a pixel [m] and the origin determine.

        The origin is the pixel at x = y = 0, counted to the right and down from the upper left corner.

        Raises:
            InputError: A scale that is not positive, or edges beyond 1e9 m.

        Example:
            >>> FloorPlan.scaled(np.zeros((30, 40, 3), np.uint8), 0.5, (0, 30)).corners
            (0.0, 20.0, 0.0, 15.0)
        """
        height, width = pixels.shape[:2]
        right, down = origin
        edges = (-right, width - right, down - height, down)
        x0, x1, y0, y1 = (float(metres_per_pixel * edge) for edge in edges)
        return cls(pixels, (x0, x1, y0, y1))

    @classmethod
    def stated(cls, config: FloorPlanConfig, name: str, scale: float | None) -> FloorPlan | None:
        """Return the plan of a command's options, or None. `scale` is that of data in pixels [pixels a metre].

        Raises:
            InputError: An image that cannot be read, or no edges for data that are not in its pixels.
        """
        if config.floor_plan is None:
            return None
        if config.floor_extent is None and scale is None:
            raise InputError(f"--floor-plan needs --floor-extent x0 x1 y0 y1 [m], since {name} is not in its pixels")
        pixels = read_pixels(config.floor_plan, f"--floor-plan {config.floor_plan}")
        height, width = (side / (scale or 1.0) for side in pixels.shape[:2])
        return cls(pixels, config.floor_extent or (0.0, width, -height, 0.0))

    @property
    def source(self) -> dict[str, str]:
        """Digest of the plan, for the sources of a run."""
        return {"floor plan": sha256(self.pixels.tobytes()).hexdigest()}

    def draw(self, ax: Axes) -> None:
        """Draw the plan behind what is in the axes."""
        ax.imshow(self.pixels, extent=self.corners, aspect="equal", zorder=0)

    def save(self, folder: Path) -> None:
        """Write the plan into the directory of a run."""
        write_npz(folder / STORED, {"pixels": self.pixels, "corners": np.array(self.corners)})

    @classmethod
    def load(cls, folder: Path) -> FloorPlan | None:
        """Return the plan in the directory of a run, or None if it has none.

        Raises:
            InputError: The file of the plan is damaged.
        """
        file = folder / STORED
        if not file.exists():
            return None
        with refusing(f"{file} holds no floor plan"):
            stored = read_npz(file)
            x0, x1, y0, y1 = stored["corners"].tolist()
            return cls(stored["pixels"], (x0, x1, y0, y1))


def read_pixels(file: str | Path | BinaryIO, name: str) -> NDArray[np.uint8]:
    """Return the pixels (height, width, 3) of a PNG or JPEG image, whose name stands in errors.

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
