"""The built-in office floor for RSSI: a BLE beacon, twelve receivers, multipath, shadowing and missed packets."""

from __future__ import annotations

from dataclasses import replace

import torch
from torch import Tensor

from swiftwrf.data.rssi import Rssi
from swiftwrf.data.simulated.room import ShoeboxRoom
from swiftwrf.runtime.validation import NonNegativeInt, PositiveInt, checked

FLOOR = ShoeboxRoom(
    size=(20.0, 16.0, 3.0),
    boxes=(
        ((4.0, 3.0, 0.0), (6.5, 3.4, 2.6)),
        ((9.0, 7.0, 0.0), (11.0, 9.5, 2.8)),
        ((14.0, 11.0, 0.0), (14.4, 14.0, 2.6)),
        ((3.0, 11.5, 0.0), (4.5, 13.0, 2.2)),
        ((15.5, 3.0, 0.0), (18.0, 4.0, 2.0)),
    ),
    reflection=-0.6,
    blockage=0.3,
    frequency_hz=2.44e9,
)
CHANNELS_HZ = (2.402e9, 2.426e9, 2.480e9)  # of BLE advertisements; a receiver does not report the channel
TRANSMIT_DBM = -8.0
PACKET_NOISE_DB = 2.0
SENSITIVITY_DBM = -97.0
BATCH_POSITIONS = 4096  # whose paths take half a gigabyte
MISSED_SHARE = 0.1  # of packets, lost to scanning gaps and collisions


@checked
def rssi_room(n: PositiveInt = 600, seed: NonNegativeInt = 0) -> Rssi:
    """Return simulated RSSI at twelve receivers, one packet a row and receiver on a random channel.

    Args:
        n: Number of positions of the transmitter.
        seed: Seed of positions, gains, channels, noise and misses.

    Raises:
        InputError: An argument outside its range.

    Example:
        >>> rssi_room(n=20).rssi_dbm.shape
        torch.Size([20, 12])
    """
    generator = torch.Generator().manual_seed(seed)
    x, y = torch.meshgrid(torch.tensor([2.5, 7.5, 12.5, 17.5]), torch.tensor([1.0, 8.0, 15.0]), indexing="ij")
    height = torch.where(torch.arange(12) % 2 == 0, 2.3, 1.2)
    receiver = torch.stack([x.flatten(), y.flatten(), height], dim=1).double()
    low, high = torch.tensor([[0.5, 0.5, 1.0], [19.5, 15.5, 1.4]], dtype=torch.float64)
    position = low + (high - low) * torch.rand(n, 3, dtype=torch.float64, generator=generator)
    gain_db = 2 * torch.randn(12, dtype=torch.float64, generator=generator)  # receivers differ
    power = torch.stack([_power(position, place) for place in receiver], dim=1)  # (n, R, channels)
    channel = torch.randint(len(CHANNELS_HZ), (n, 12, 1), generator=generator)
    noise = PACKET_NOISE_DB * torch.randn(n, 12, dtype=torch.float64, generator=generator)
    rssi = (TRANSMIT_DBM + gain_db + power.gather(2, channel)[..., 0] + noise).round()
    missed = (torch.rand(n, 12, generator=generator) < MISSED_SHARE) | (rssi < SENSITIVITY_DBM)
    return Rssi(
        torch.where(missed, torch.nan, rssi),
        position,
        receiver_position=receiver,
        receiver_names=[f"receiver{number:02d}" for number in range(1, 13)],
        name="simulated-floor",
    )


def _power(position: Tensor, receiver: Tensor) -> Tensor:
    """Return the power gain of the coherent sum of all paths on each channel, (n, channels) [dB]."""
    floors = [replace(FLOOR, frequency_hz=f) for f in CHANNELS_HZ]
    rays = (FLOOR.rays(some, receiver) for some in position.split(BATCH_POSITIONS))
    sums = torch.cat([torch.stack([floor.gain(part).sum(dim=1).abs() for floor in floors], dim=1) for part in rays])
    return 20 * sums.clamp_min(1e-9).log10()
