"""Description of the array of snapshots: positions of its elements, its carrier and its pose, by names of arrays."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from torch import Tensor

from swiftwrf.array.angles import ArrayPose
from swiftwrf.array.planar import LIGHT_SPEED, PlanarArray
from swiftwrf.data.archives import Arrays, refusing_broken
from swiftwrf.data.files import check_carrier
from swiftwrf.errors import InputError
from swiftwrf.positions import check_positions

POSE = ("array_orientation", "array_normal", "array_up")  # the first, or the others


def described_arrays(file: Path, content: Mapping[str, Any]) -> Arrays:
    """Return the arrays of snapshots.npz that describe the array of antennas, from the texts of a YAML mapping."""
    arrays = {}
    for name in ("frequency_hz", "array_position", *POSE, "rows", "columns", "spacing_m", "element_position"):
        if name in content:
            with refusing_broken(f"{name} of {file}", "a number or lists of numbers of one length"):
                arrays[name] = np.array(content[name], dtype=np.float64)
    return arrays


def pose_of(file: Path, arrays: Arrays) -> ArrayPose:
    """Return the pose of the array, by its orientation or by its normal and upper side."""
    stated = next((name for name in POSE[:2] if name in arrays), None)
    if stated is None:
        raise InputError(f"{file} lacks array_orientation; give that unit quaternion, or array_normal and array_up")
    position, orientation = arrays["array_position"], arrays[stated]
    if position.ndim == 2 or orientation.ndim == 2:
        raise InputError(
            f"{file}: array_position and array_orientation have shapes {position.shape} and {orientation.shape}, as of an "
            "array that moves; the array must rest while the transmitter moves, so give its one position (3) and "
            "quaternion (4)"
        )
    if stated == "array_orientation" and orientation.shape == (3,):
        raise InputError(
            f"{file}: array_orientation has 3 numbers; Euler angles leave their order open, so give the unit quaternion "
            "(x, y, z, w) that turns array into world coordinates"
        )
    with refusing_broken(file, "the description of an array"):
        where, turned = (tuple(values.flatten().tolist()) for values in (position, orientation))
        if stated == "array_orientation":
            return ArrayPose(where, turned)
        return ArrayPose.facing(where, turned, tuple(arrays.get("array_up", np.eye(3)[2]).flatten().tolist()))


def array_of(file: Path, arrays: Arrays, spacing_wavelengths: tuple[float, float] = (0.01, 20.0)) -> PlanarArray:
    """Return the array, described by the positions of its elements or by rows, columns and spacing.

    Neighbouring elements that are closer or farther apart than the given spacings have another unit.
    """
    frequency = arrays["frequency_hz"]
    if frequency.shape != ():
        raise InputError(f"{file}: frequency_hz must be one number, the carrier, got shape {frequency.shape}")
    check_carrier(file, float(frequency))
    wavelength = LIGHT_SPEED / float(frequency)
    if "element_position" in arrays:
        array = PlanarArray(_plane(file, arrays, wavelength), wavelength)
    elif all(name in arrays and arrays[name].shape == () for name in ("rows", "columns", "spacing_m")):
        rows, columns, spacing = (float(arrays[name]) for name in ("rows", "columns", "spacing_m"))
        if not (rows.is_integer() and columns.is_integer() and min(rows, columns) >= 1 and rows * columns < 1e6):
            raise InputError(f"{file}: rows and columns must be whole numbers from 1, got {rows:g} and {columns:g}")
        array = PlanarArray.grid(int(rows), int(columns), spacing, float(frequency))
    else:
        raise InputError(
            f"{file} lacks the array: give element_position (elements, 3) in metres, or the numbers rows, columns and "
            "spacing_m"
        )
    if len(array.element) < 2:
        raise InputError(
            f"{file} describes an array of one element, which resolves no directions; at least 2 are needed"
        )
    apart, (low, high) = array.spacing_wavelengths, spacing_wavelengths
    if not low <= apart <= high:
        raise InputError(
            f"{file}: neighbouring elements are {apart * array.wavelength:.4g} m, {apart:.3g} wavelengths apart; expected "
            f"{low:g} to {high:g} wavelengths, so is the spacing in metres and the carrier in Hz?"
        )
    return array


def _plane(file: Path, arrays: Arrays, wavelength: float) -> Tensor:
    """Return the positions of the elements in their plane, (K, 2) [m]."""
    columns = 2 if arrays["element_position"].shape[1:] == (2,) else 3
    element = check_positions(arrays["element_position"], f"{file}: element_position", (None, columns))
    if columns == 3 and float((height := element[:, 2]).max() - height.min()) > 1e-3 * wavelength:
        raise InputError(
            f"{file}: element_position spreads {float(height.max() - height.min()):.3g} m along z; give the elements in "
            "array coordinates, x and y in the array's plane, and let array_orientation turn them into the world"
        )
    return element[:, :2]
