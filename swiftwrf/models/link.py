"""The link over which the training spectra of a model were measured."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Annotated

from torch import Tensor

from swiftwrf.array.planar import PlanarArray
from swiftwrf.choices import Moving
from swiftwrf.data.spectra import Spectra
from swiftwrf.errors import InputError


@dataclass(frozen=True, eq=False)
class Link:
    """The ends of a link and its array. Values that the spectra do not describe are None.

    Args:
        moving: End that moves. The array is at the receiver.
        fixed_position: Position of the fixed end, float64 (3,) [m].
        rotation: Rotation from array to world coordinates, float64 (3, 3).
        array: Antenna array with its carrier.
        frequency_hz: Frequencies of the snapshots of channels, float64 (S,) [Hz].

    Example:
        >>> import swiftwrf
        >>> link = Link.from_spectra(swiftwrf.simulated_room(n=10))
        >>> len(link.aligned(swiftwrf.simulated_room(n=20, seed=1)))
        20
        >>> link.aligned(swiftwrf.simulated_room(n=20, moving="receiver"))
        Traceback (most recent call last):
        swiftwrf.errors.InputError: simulated-room was measured over another link than ...
    """

    moving: Moving
    fixed_position: Annotated[Tensor, "float64 3"] | None
    rotation: Annotated[Tensor, "float64 3 3"] | None
    array: PlanarArray | None
    frequency_hz: Annotated[Tensor, "float64 s"] | None = None

    @classmethod
    def from_spectra(cls, data: Spectra) -> Link:
        """Return the link that spectra describe."""
        return cls(data.moving, data.fixed_position, data.rotation, data.array, data.frequency_hz)

    def aligned(self, data: Spectra) -> Spectra:
        """Return spectra of this link with their snapshots in its order of frequencies, and refuse those of another link.

        Values that one of both does not describe are not compared. Lengths may differ by 0.001 wavelengths (by 1 mm if the
        wavelength is unknown), elements of the rotation by 0.0001, frequencies by a millionth.

        Raises:
            InputError: Another moving end, fixed position, rotation, array or other frequencies.
        """
        known, given = self.frequency_hz, data.frequency_hz
        if known is not None and given is not None and data.channel is not None and len(known) == len(given):
            order = given.argsort(stable=True)[known.argsort(stable=True).argsort()]
            if bool((given != (given := given[order])).any()):
                data = replace(data, channel=data.channel[:, order], frequency_hz=given)
        fitted, new = self.array, data.array
        array = fitted or new
        length = 1e-3 * array.wavelength if array else 1e-3
        compared = {
            f"moving end ({data.moving}, not {self.moving})": data.moving != self.moving,
            "position of the fixed end": _differ(self.fixed_position, data.fixed_position, length),
            "orientation of the array": _differ(self.rotation, data.rotation, 1e-4),
            "arrangement of the elements": fitted and new and _differ(fitted.element, new.element, length),
            "carrier": fitted and new and abs(fitted.wavelength - new.wavelength) > length,
            "set of frequencies": known is not None and _differ(known, given, 1e-6 * float(known.max())),
        }
        if different := [what for what, differs in compared.items() if differs]:
            raise InputError(
                f"{data.name} was measured over another link than the training spectra, with another "
                f"{', '.join(different)}; give spectra of the same link or fit another model"
            )
        return data


class Linked:
    """Base class of models whose training spectra must describe the link."""

    link: Link

    @property
    def array(self) -> PlanarArray:
        """Antenna array with its carrier."""
        assert self.link.array is not None
        return self.link.array

    @property
    def rotation(self) -> Tensor:
        """Rotation from array to world coordinates, float64 (3, 3)."""
        assert self.link.rotation is not None
        return self.link.rotation

    @property
    def fixed_position(self) -> Tensor:
        """Position of the fixed end, float64 (3,) [m]."""
        assert self.link.fixed_position is not None
        return self.link.fixed_position

    @property
    def moving(self) -> Moving:
        """End that moves."""
        return self.link.moving


def _differ(known: Tensor | None, other: Tensor | None, tolerance: float) -> bool:
    if known is None or other is None:
        return False
    return known.shape != other.shape or bool((known - other).abs().max() > tolerance)
