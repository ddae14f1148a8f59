"""Phases at the elements of an array with few sines and cosines.

In a lattice of elements few steps lead from one element to the next. The wave at an element is that at an earlier element,
rotated by the phase of a step. Other arrays have as many steps as elements, and nothing is saved.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache

import torch
from torch import Tensor

from swiftwrf.array.planar import LAG_TOLERANCE_WAVELENGTHS, PlanarArray

MAX_STEPS_COMPARED = 16  # steps that are looked for between elements
Link = tuple[int, int]


@dataclass(frozen=True)
class ElementChain:
    """Elements of an array, each one step away from an earlier one.

    Args:
        step: Phase of a wave from unit vector u at the first element, then over each step, is step @ u, (D, 3) [rad].
        links: For the second and each further element, the number of an earlier element and of the step from there.
    """

    step: Tensor
    links: tuple[Link, ...]

    @classmethod
    def of(cls, array: PlanarArray, element: Tensor) -> ElementChain:
        """Return the chain of an array whose elements have the phases element @ u, (K, 3) [rad]."""
        links = _links(array)
        first = {step: (number, parent) for number, (parent, step) in reversed([*enumerate(links, start=1)])}
        steps = [element[number] - element[parent] for _, (number, parent) in sorted(first.items())]
        return cls(torch.stack([element[0], *steps]).float(), links)

    def phasors(self, unit: Tensor, amplitude: Tensor, phase: Tensor) -> Tensor:
        """Return amplitude * exp(j (phase + element @ unit)) at each element, complex64 (K, N).

        Args:
            unit: Directions, float32 (3, N).
            amplitude: Real amplitudes (N,).
            phase: Phases at the origin of the array (N,) [rad].
        """
        turn = self.step @ unit
        turn[0] += phase
        rotation = torch.complex(turn.cos(), turn.sin())
        wave = rotation.new_empty(1 + len(self.links), unit.shape[1])
        torch.mul(rotation[0], amplitude, out=wave[0])
        for number, (parent, step) in enumerate(self.links, start=1):
            torch.mul(wave[parent], rotation[step], out=wave[number])
        return wave


@lru_cache(maxsize=64)
def _links(array: PlanarArray) -> tuple[Link, ...]:
    """Return the links of an array's elements in their order."""
    element = (array.element.double() / array.wavelength / LAG_TOLERANCE_WAVELENGTHS).round().long()
    step: list[Tensor] = []
    number = {tuple(element[0].tolist()): 0}
    links: list[Link] = []
    for k in range(1, len(element)):
        before = ((number.get(tuple((element[k] - s).tolist())), d) for d, s in enumerate(step[:MAX_STEPS_COMPARED], 1))
        link = next(((parent, d) for parent, d in before if parent is not None), None)
        if link is None:
            step.append(element[k] - element[k - 1])
            link = k - 1, len(step)
        links.append(link)
        number[tuple(element[k].tolist())] = k
    return tuple(links)
