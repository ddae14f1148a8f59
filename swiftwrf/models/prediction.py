"""Predicted quantities with their uncertainty."""

from __future__ import annotations

import re
from dataclasses import dataclass
from statistics import NormalDist
from typing import Annotated

import numpy as np
import pandas as pd
from annotated_types import Ge, Gt, Lt
from numpy.typing import NDArray
from torch import Tensor

from swiftwrf.array.angles import AngularGrid
from swiftwrf.data.dataset import Arrays, Labelled, position_coordinates
from swiftwrf.data.spectra import DIRECTION, direction_coordinates
from swiftwrf.errors import InputError
from swiftwrf.metrics import LEVEL
from swiftwrf.plotting import Axes, Displayed, plan, polar_spectrum
from swiftwrf.runtime.validation import check_value, checked


@dataclass(frozen=True, eq=False)
class Prediction(Labelled, Displayed):
    """A predicted quantity with its uncertainty.

    Args:
        mean: Predictive mean, e.g. magnitudes (n, n_elevation, n_azimuth) or RSSI (n, R) [dBm].
        std: Predictive standard deviation of one measurement, of the same shape. None if the model has none: of
            spectra, `swiftwrf` by regression, `gp`, `coarray` and `hybrid` have one.
        position: Positions of the predictions, (n, 3) [m]. `predict` of every model sets it.
        grid: Directions of predicted spectra.
        receiver_names: Names of the receivers of predicted RSSI.
        quantity: RSSI, or what else is predicted at the receivers.
        unit: Its unit.

    Example:
        >>> import torch
        >>> prediction = Prediction(torch.zeros(2), torch.ones(2))
        >>> low, high = prediction.interval(0.8)
        >>> round(float(high[0]), 2)
        1.28
    """

    mean: Tensor
    std: Tensor | None = None
    position: Tensor | None = None
    grid: AngularGrid | None = None
    receiver_names: tuple[str, ...] = ()
    quantity: str = "RSSI"
    unit: str = "dBm"

    def plot(self, number: int = 0, ax: Axes | None = None) -> Axes:
        """Draw a predicted spectrum seen along the normal of the array, or the RSSI at a receiver seen from above.

        Args:
            number: Row of the spectrum, or column of the receiver.
            ax: Axes to draw into, polar for a spectrum. Defaults to those of a new figure.

        Raises:
            InputError: A prediction without directions or positions, or a number beyond it.

        Example:
            >>> import torch
            >>> at = torch.tensor([[0.0, 0.0, 1.0], [1.0, 2.0, 1.0]])
            >>> Prediction(torch.tensor([[-50.0], [-60.0]]), position=at).plot().get_ylabel()
            'y [m]'
        """
        count = len(self.mean) if self.grid is not None else self.mean.shape[-1]
        check_value("number", number, Annotated[int, Ge(-count), Lt(count)])
        if self.grid is not None:
            return polar_spectrum(self.mean[number], self.grid, ax)
        if self.position is None or self.mean.dim() != 2:
            raise InputError("this prediction contains neither directions nor positions; use that of a model's predict")
        ax = plan(self.position, self.mean[:, number], f"predicted {self.quantity} [{self.unit}]", ax)
        ax.set_title(self.receiver_names[number] if self.receiver_names else "")
        return ax

    def __repr__(self) -> str:
        facts = self._facts()
        return f"<Prediction of shape {facts['shape']}: mean {facts['mean']},\n standard deviation {facts['std']}>"

    def _facts(self) -> dict[str, str]:
        def span(values: Tensor | None) -> str:
            if values is None or not values.numel():
                return "none"
            low, high = (f"{float(end):.4g}" for end in values.detach().aminmax())
            return low if low == high else f"{low} to {high}"

        return {"shape": f"{tuple(self.mean.shape)}", "mean": span(self.mean), "std": span(self.std)}

    @checked
    def interval(self, level: Annotated[float, Gt(0), Lt(1)] = LEVEL) -> tuple[Tensor, Tensor]:
        """Return the lower and upper end of the central interval that contains a measurement with probability `level`.

        Intervals of spectra are clipped to [0, 1], the range of magnitudes.

        Raises:
            InputError: The model has no standard deviation, or the level is outside (0, 1).
        """
        if self.std is None:
            raise InputError("this model predicts no standard deviation, so there is no interval")
        half = -NormalDist().inv_cdf((1 - level) / 2) * self.std  # finite for every level below 1
        low, high = self.mean - half, self.mean + half
        return (low, high) if self.grid is None else (low.clamp_min(0), high.clamp_max(1))

    def to_frame(self) -> pd.DataFrame:
        """Return a table: a row for each position and receiver, or for each spectrum with its largest magnitude.

        Raises:
            InputError: Values without positions, or with neither directions nor names of receivers.

        Example:
            >>> import torch
            >>> at = torch.zeros(1, 3)
            >>> Prediction(torch.tensor([[-60.0]]), torch.tensor([[2.0]]), at, receiver_names=("hall",)).to_frame()
               x_m  y_m  z_m receiver  predicted_dbm  std_db
            0  0.0  0.0  0.0     hall          -60.0     2.0
        """
        position, mean = self._located(), self.mean.detach().cpu()
        if self.grid is not None:
            azimuth, elevation = self.grid.peak_direction(mean).rad2deg().T.numpy()
            peak = {
                "azimuth_deg": azimuth,
                "elevation_deg": elevation,
                "magnitude": mean.flatten(1).amax(dim=1).numpy(),
            }
            return _positions(position).assign(**peak)
        table = _positions(position.repeat(len(self.receiver_names), axis=0))
        receiver, differences = np.tile(self.receiver_names, len(position)), difference_unit(self.unit)
        values = {"receiver": receiver, f"predicted_{suffix(self.unit)}": mean.flatten().numpy()}
        std = {} if self.std is None else {f"std_{suffix(differences)}": self.std.detach().cpu().flatten().numpy()}
        return table.assign(**values, **std)

    def coordinates(self) -> Arrays:
        values: Arrays = {"receiver": (("receiver",), np.array(self.receiver_names, dtype=np.str_))}
        if self.grid is not None:
            values = direction_coordinates(self.grid)
        return position_coordinates(self._located()) | values

    def variables(self) -> Arrays:
        of_receivers = suffix(self.quantity), ("receiver",), self.unit
        name, dimensions, unit = ("spectrum", DIRECTION, "1") if self.grid else of_receivers
        values: Arrays = {name: (("position", *dimensions), self.mean.detach().cpu().numpy(), {"units": unit})}
        if self.std is not None:
            std = self.std.detach().cpu().numpy()
            values["std"] = (
                ("position", *dimensions),
                std,
                {"units": "1" if self.grid else difference_unit(self.unit)},
            )
        return values

    def _located(self) -> NDArray[np.float64]:
        """Return the positions (n, 3) [m] of values whose direction or receiver is known."""
        if self.position is None or (self.grid is None and not self.receiver_names):
            raise InputError(
                "this prediction lacks positions, or directions or receivers of its values; take that of a model's predict"
            )
        position: NDArray[np.float64] = self.position.detach().cpu().double().numpy()
        return position


def difference_unit(unit: str) -> str:
    """Return the unit of differences of values: dB of dBm.

    Example:
        >>> difference_unit("dBm"), difference_unit("Mbps")
        ('dB', 'Mbps')
    """
    return "dB" if unit == "dBm" else unit


def suffix(unit: str) -> str:
    """Return a unit or quantity as the part of a column's name.

    Example:
        >>> suffix("dBm"), suffix("Mbit/s")
        ('dbm', 'mbit_s')
    """
    return re.sub(r"[^a-z0-9]+", "_", unit.lower()).strip("_") or "value"


def _positions(position: NDArray[np.float64]) -> pd.DataFrame:
    return pd.DataFrame(position, columns=["x_m", "y_m", "z_m"])
