"""Small made files of the formats that others use, each with one thing changed where a test asks for it."""

import json
import math
import struct
from dataclasses import replace
from pathlib import Path

import numpy as np
import pandas as pd
import torch
from PIL import Image
from scipy.spatial.transform import Rotation

from swiftwrf.array.planar import LIGHT_SPEED, PlanarArray
from swiftwrf.contrib.formats.records import checksum
from swiftwrf.data import Snapshots
from swiftwrf.data.simulated import ShoeboxRoom

FREQUENCY = 2.4e9
WAVELENGTH = LIGHT_SPEED / FREQUENCY
POSITION = torch.tensor([0.2, 2.4, 1.2], dtype=torch.float64)  # of the array, on a wall
FACING_X = Rotation.from_euler("yx", [90, 25], degrees=True)  # its normal is +x, and it hangs askew


def snapshots(
    n: int = 120, count: int = 3, noise: float = 0.05, side: int = 4, seed: int = 0, echo: float = 0.0
) -> Snapshots:
    """Direct paths from all over a room, noise, and an echo from the floor of so much amplitude."""
    generator = torch.Generator().manual_seed(seed)
    place = torch.tensor([0.8, 0.4, 0.4]) + torch.tensor([4.5, 4.2, 2.3]) * torch.rand(n, 3, generator=generator)
    position, rotation = place.double(), torch.from_numpy(FACING_X.as_matrix())
    array = PlanarArray.grid(side, side, WAVELENGTH / 2, FREQUENCY)
    channel = torch.zeros(n, count, side * side, dtype=torch.complex128)
    for mirror, amplitude in ((1.0, 1.0), (-1.0, echo)):
        away = position * torch.tensor([1.0, 1.0, mirror]) - POSITION
        phase = array.phase(away / away.norm(dim=1, keepdim=True) @ rotation)
        turn = 2 * math.pi / WAVELENGTH * away.norm(dim=1)
        channel += (amplitude * torch.polar(torch.ones_like(phase), phase - turn[:, None]))[:, None]
    channel += noise * torch.randn(channel.shape, dtype=torch.complex128, generator=generator)
    return Snapshots(channel, position, array=array, name="made", fixed_position=POSITION, rotation=rotation)


def snapshot_arrays(data: Snapshots) -> dict[str, object]:
    """Return the arrays of snapshots.npz."""
    return {
        "csi": data.channel.numpy(),
        "position": data.position.numpy(),
        "element_position": np.pad(data.array.element.numpy(), ((0, 0), (0, 1))),
        "frequency_hz": np.float64(FREQUENCY),
        "array_position": data.fixed_position.numpy(),
        "array_orientation": Rotation.from_matrix(data.rotation.numpy()).as_quat(),
    }


def write_snapshots(
    folder: Path, name: str = "snapshots.npz", data: Snapshots | None = None, **changes: object
) -> Path:
    """snapshots.npz or snapshots.h5; None leaves an array out."""
    arrays = {k: v for k, v in {**snapshot_arrays(data or snapshots()), **changes}.items() if v is not None}
    folder.mkdir(exist_ok=True)
    if name.endswith(".npz"):
        np.savez(folder / name, **arrays)
    else:
        import h5py

        with h5py.File(folder / name, "w") as file:
            for key, value in arrays.items():
                file[key] = value
    return folder


def write_paths(folder: Path, n: int = 12, **changes: object) -> Path:
    """paths.npz of one path a receiver, some arrays replaced or (None) left out."""
    arrays = {
        "transmitter_position": np.tile([0.0, 0.0, 2.0], (n, 1)),
        "receiver_position": np.stack([np.arange(1.0, n + 1), np.zeros(n), np.ones(n)], axis=1),
        "path_count": np.ones(n, dtype=np.int32),
        "last_point": np.tile([0.0, 0.0, 2.0], (n, 1)),
        "gain": np.ones(n, dtype=np.complex64),
        "line_of_sight": np.ones(n, dtype=bool),
        "frequency_hz": np.float64(2.4e9),
    } | changes
    folder.mkdir(exist_ok=True)
    np.savez(folder / "paths.npz", **{name: value for name, value in arrays.items() if value is not None})
    return folder


def write_deepmimo(folder: Path, n: int = 30, tracer: str = "Remcom Wireless Insite", **changes: object) -> Path:
    """Paths of the simulated room from a transmitter on the ceiling; a change computes an array from all, None omits it."""
    generator = torch.Generator().manual_seed(0)
    receiver = torch.tensor([0.5, 0.5, 0.6]) + torch.tensor([5.0, 4.0, 1.0]) * torch.rand(n, 3, generator=generator)
    transmitter = torch.tensor([3.0, 2.5, 2.7])
    paths = ShoeboxRoom(frequency_hz=FREQUENCY).paths(transmitter[None], receiver)
    direction, gain, length = (
        t.reshape(n, 25, *t.shape[1:]).numpy() for t in (paths.direction, paths.gain, paths.length)
    )
    blocked = (
        np.zeros((n, 25)) + 4 * (~paths.line_of_sight).numpy()[:, None]
    )  # a direct path through a box: transmission
    arrays = {
        "power": 20 * np.log10(abs(gain)),
        "phase": np.rad2deg(np.angle(gain)),
        "delay": length / LIGHT_SPEED,
        "aoa_az": np.rad2deg(np.arctan2(direction[..., 1], direction[..., 0])),
        "aoa_el": np.rad2deg(np.arccos(direction[..., 2])),
        "inter": np.where(np.arange(25) == 0, blocked, np.where(np.arange(25) <= 6, 1.0, 11.0)),
        "rx_pos": receiver.double().numpy(),
        "tx_pos": transmitter[None].double().numpy(),
    }
    arrays |= {key: change(arrays) for key, change in changes.items() if change is not None}
    folder.mkdir(exist_ok=True)
    for key, value in arrays.items():
        if changes.get(key, True) is None:
            continue
        np.savez_compressed(folder / f"{key}_t000_tx000_r001.npz", **{key: value.astype(np.float32)})
    params = {"rt_params": {"frequency": FREQUENCY, "raytracer_name": tracer}}
    (folder / "params.json").write_text(json.dumps(params))
    return folder


def _varint(value: int) -> bytes:
    low, high = value & 0x7F, value >> 7
    return bytes([low | 0x80]) + _varint(high) if high else bytes([low])


def _field(number: int, content: bytes) -> bytes:
    return _varint(number << 3 | 2) + _varint(len(content)) + content


def tensor_message(values: np.ndarray) -> bytes:
    """A serialized tensor, as TensorFlow writes it."""
    dtype = {"f4": 1, "f8": 2, "c8": 8}[values.dtype.str[1:]]
    shape = b"".join(_field(2, _varint(1 << 3) + _varint(size)) for size in values.shape)
    return _varint(1 << 3) + _varint(dtype) + _field(2, shape) + _field(4, values.tobytes())


def write_records(file: Path, examples: list[dict[str, np.ndarray]]) -> None:
    """A TFRecord file of examples of tensors."""
    with file.open("wb") as stream:
        for example in examples:
            entries = b""
            for name, values in example.items():
                feature = _field(1, _field(1, tensor_message(values)))
                entries += _field(1, _field(1, name.encode()) + _field(2, feature))
            content = _field(1, entries)
            length = struct.pack("<Q", len(content))
            stream.write(length + checksum(length) + content + checksum(content))


def _seen_from_the_front(data: Snapshots, rows: int, columns: int) -> np.ndarray:
    """Channels (n, rows, columns, S) of an array whose row 0 is the upper one."""
    channel = data.channel.numpy().transpose(0, 2, 1).reshape(len(data), rows, columns, -1)
    return channel[:, ::-1]


def _antenna(data: Snapshots) -> dict[str, object]:
    right, up, _ = data.rotation.T.tolist()
    spacing = WAVELENGTH / 2
    return {"name": "A", "location": data.fixed_position.tolist(), "rightvector": right, "upvector": up,
            "spacingX": spacing, "spacingY": spacing}  # fmt: skip


def record_source(shape: tuple[int, int], n: int = 24, count: int = 3) -> Snapshots:
    """Snapshots of an array of this shape that data sets of records can hold."""
    data = snapshots(n, count)
    array = PlanarArray.grid(*shape, WAVELENGTH / 2, FREQUENCY)
    away = data.position - data.fixed_position
    phase = array.phase(away / away.norm(dim=1, keepdim=True) @ data.rotation)[:, None].expand(-1, count, -1)
    channel = torch.polar(torch.ones_like(phase), phase).to(torch.complex64)
    return replace(data, channel=channel, array=array)


def write_espargos(folder: Path, arrays: int = 1, **changes: object) -> Path:
    """Write `arrays` arrays, the first of them with measured data."""
    data = record_source((2, 4))
    csi = _seen_from_the_front(data, 2, 4)
    csi = np.stack([csi, *([csi[::-1]] * (arrays - 1))], axis=1)
    folder.mkdir(exist_ok=True)
    examples = [
        {"csi": np.ascontiguousarray(csi[i]), "pos": data.position[i].numpy(), "time": np.float64([i])}
        for i in range(len(data))
    ]
    write_records(folder / "walk.tfrecords", examples)
    content = {"frequency": FREQUENCY, "antennas": [_antenna(data)] * arrays} | changes
    (folder / "metadata.json").write_text(json.dumps(content))
    return folder


def write_dichasus(folder: Path, offsets: bool = False, **changes: object) -> Path:
    """Write two arrays whose antennas are numbered crosswise; with `offsets`, their phases are in a file."""
    data = record_source((2, 2), count=8)
    first = _seen_from_the_front(data, 2, 2).reshape(len(data), 4, -1)
    order = [6, 0, 3, 5]  # of the first array's antennas
    csi = np.ones((len(data), 8, first.shape[2]), dtype=np.complex64)
    csi[:, order] = first
    cpo = np.linspace(0, 3, 8) if offsets else np.zeros(8)
    sto = np.linspace(0, 2, 8) if offsets else np.zeros(8)
    turns = np.arange(csi.shape[2]) / csi.shape[2]
    csi = csi * np.exp(-1j * (cpo[:, None] + 2 * np.pi * sto[:, None] * turns))
    stored = np.fft.ifftshift(csi, axes=2)
    folder.mkdir(exist_ok=True)
    examples = [
        {
            "csi": np.stack([stored[i].real, stored[i].imag], axis=-1).astype(np.float32),
            "pos-tachy": data.position[i].numpy(),
        }
        for i in range(len(data))
    ]
    write_records(folder / "walk.tfrecords", examples)
    if offsets:
        (folder / "reftx-offsets-walk.json").write_text(json.dumps({"cpo": cpo.tolist(), "sto": sto.tolist()}))
    antennas = [_antenna(data) | {"assignments": a} for a in ([[6, 0], [3, 5]], [[1, 2], [4, 7]])]
    (folder / "spec.json").write_text(json.dumps({"frequency": FREQUENCY, "antennas": antennas} | changes))
    return folder


def walk(seed: int = 2) -> pd.DataFrame:
    """A walk with RSSI of four receivers in whole decibels: x, y, a, b, c, d."""
    draw = np.random.default_rng(seed)
    xy = np.column_stack([np.linspace(0.5, 23, 60), draw.uniform(0.4, 11, 60)]).round(2)
    away = np.linalg.norm(xy[:, None] - draw.uniform((0, 0), (24, 12), (4, 2)), axis=2)
    rssi = (-42 - 24 * np.log10(1 + away) + draw.normal(0, 2, (60, 4))).round()
    return pd.DataFrame(np.column_stack([xy, rssi]), columns=["x", "y", "a", "b", "c", "d"])


def survey() -> pd.DataFrame:
    """Return the walk with -100 where RSSI counts as not detected."""
    return walk().mask(walk() < -76, -100)


def write_survey(folder: Path, name: str = "walk.csv") -> Path:
    """Write the survey as a table of comma-separated values."""
    folder.mkdir(exist_ok=True)
    survey().to_csv(folder / name, index=False)
    return folder / name


ROW = {"rows": 1, "columns": 3, "spacing_m": 0.0288, "frequency_hz": 5.2e9}  # the antennas of an Intel 5300


def array_yml(**changes: object) -> str:
    """array.yml of a row of three elements whose normal is +x; None leaves a name out."""
    content = ROW | {"array_position": [0, 2, 1], "array_orientation": [0.5, 0.5, 0.5, 0.5]} | changes
    return "".join(f"{name}: {value}\n" for name, value in content.items() if value is not None)


def bfee(csi: np.ndarray, port: tuple[int, ...] = (0, 1, 2), code: int = 0xBB) -> bytes:
    """A frame of the Linux 802.11n CSI Tool: parts of 8 bits of csi (30, ports, streams), in the order of the chains."""
    n_receive, n_transmit = csi.shape[1:]
    bits = at = 0
    for values in csi[:, port[:n_receive]].reshape(30, -1):
        at += 3
        for part in np.stack([values.real, values.imag], axis=1).astype(int).flatten():
            bits |= (int(part) & 0xFF) << at
            at += 8
    content = bits.to_bytes((at + 7) // 8, "little")
    chains = sum(number << 2 * chain for chain, number in enumerate(port))
    numbers = (code, 1, 1, 0, n_receive, n_transmit, 40, 40, 40, -90, 30, chains, len(content), 0)
    header = struct.pack("<BIHHBBBBBbBBHH", *numbers)
    return struct.pack(">H", len(header) + len(content)) + header + content


def plane_waves(n: int, packets: int, subcarriers: int) -> tuple[np.ndarray, np.ndarray]:
    """Positions (n, 3) before the row of `array_yml`, and channels (n, packets, subcarriers, 3) of parts in 8 bits.

    The common phase of a packet is random, and the phase over subcarriers that of the delay.
    """
    draw = np.random.default_rng(0)
    position = np.stack([draw.uniform(2, 6, n), draw.uniform(-2, 6, n), np.full(n, 1.0)], axis=1)
    away = position - [0, 2, 1]
    length = np.linalg.norm(away, axis=1)
    along = ROW["spacing_m"] * np.array([-1, 0, 1]) * (away[:, 1] / length)[:, None]  # (n, 3)
    offset = 312.5e3 * 4 * np.arange(subcarriers)[:, None] / LIGHT_SPEED * length[:, None, None]  # (n, subcarriers, 1)
    common = draw.uniform(size=(n, packets, 1, 1))
    cycles = (along * ROW["frequency_hz"] / LIGHT_SPEED)[:, None, None] - offset[:, None] + common
    channel = 100 * np.exp(2j * math.pi * cycles)
    return position, np.round(channel.real) + 1j * np.round(channel.imag)


# by number of the chip: bits of each mantissa with its sign, and of the exponent
NEXMON_FLOATS = {3: (9, 5), 0xDEAD: (9, 5), 106: (12, 6)}


def nexmon_payload(
    csi: np.ndarray, core: int, number: int = 1, chip: int = 106, stream: int = 0, sender: bytes = b"\1\2\3\4\5\6"
) -> bytes:
    """A packet of nexmon_csi: the channel (subcarriers,) of one core for one stream of a frame."""
    mantissa, exponent = NEXMON_FLOATS.get(chip, (12, 6))
    parts = (csi.real, csi.imag)
    scale = math.ceil(math.log2(np.abs(parts).max() + 1)) - (mantissa - 1)
    size = [np.minimum(np.round(np.abs(part) / 2.0**scale).astype(int), 2 ** (mantissa - 1) - 1) for part in parts]
    real, imag = (((part < 0) << (mantissa - 1)) | value for part, value in zip(parts, size, strict=True))
    words = real << (mantissa + exponent) | imag << exponent | (scale & (2**exponent - 1))
    header = struct.pack("<HbB6sHHHH", 0x1111, -40, 8, sender, number, core | stream << 3, 0xE02A, chip)
    return header + words.astype("<u4").tobytes()


def pcap(payloads: list[bytes], order: str = "<", mark: int = 0xA1B2C3D4) -> bytes:
    """A pcap file of UDP packets with these payloads."""
    frames = [bytes(42) + payload for payload in payloads]
    records = [struct.pack(f"{order}IIII", 0, 0, len(frame), len(frame)) + frame for frame in frames]
    return struct.pack(f"{order}IHHiIII", mark, 2, 4, 0, 0, 65535, 1) + b"".join(records)


def nexmon(channel: np.ndarray, chip: int = 106, **form: object) -> bytes:
    """A capture of nexmon_csi of channels (packets, subcarriers, cores)."""
    packets = [
        nexmon_payload(csi, core, number, chip)
        for number, cores in enumerate(channel)
        for core, csi in enumerate(cores.T)
    ]
    return pcap(packets, **form)


def write_captures(
    folder: Path, n: int = 12, packets: int = 3, suffix: str = ".dat", tones: int = 30, **changes: object
) -> np.ndarray:
    """A folder of captures; returns the channels that they hold, (n, packets, tones, 3)."""
    folder.mkdir(exist_ok=True)
    position, channel = plane_waves(n, packets, tones)
    rows = [f"walk{i}{suffix},{x},{y},{z}\n" for i, (x, y, z) in enumerate(position)]
    (folder / "positions.csv").write_text("file,x,y,z\n" + "".join(rows))
    (folder / "array.yml").write_text(array_yml(**changes))
    for i in range(n):
        content = nexmon(channel[i]) if suffix == ".pcap" else b"".join(bfee(csi[..., None]) for csi in channel[i])
        (folder / f"walk{i}{suffix}").write_bytes(content)
    return channel


def install(folder: Path, group: str, **points: str) -> None:
    """Write the metadata of an installed package with entry points, for processes whose path has the folder."""
    described = folder / f"{next(iter(points))}_package-1.dist-info"
    described.mkdir()
    (described / "METADATA").write_text(f"Metadata-Version: 2.1\nName: {next(iter(points))}-package\nVersion: 1\n")
    lines = [f"[{group}]", *(f"{name} = {value}" for name, value in points.items()), ""]
    (described / "entry_points.txt").write_text("\n".join(lines))


def write_nerf2(folder: Path, images: list[np.ndarray], orientation: str = "[0, 0, 0, 1]") -> Path:
    """Write spectra in the NeRF2 layout, at positions along a line."""
    (folder / "spectrum").mkdir(parents=True)
    (folder / "gateway_info.yml").write_text(f"g:\n  position: [0, 0, 0]\n  orientation: {orientation}\n")
    (folder / "tx_pos.csv").write_text("x,y,z\n" + "".join(f"{i},{10 + i},1.5\n" for i in range(len(images))))
    for number, image in enumerate(images, start=1):
        Image.fromarray(image).save(folder / "spectrum" / f"{number:05d}.png")
    return folder


def write_nerf2_rssi(folder: Path, names: str, position: str, rows: list[str]) -> Path:
    """Write RSSI in the NeRF2 layout, at positions along a line."""
    folder.mkdir(exist_ok=True)
    (folder / "gateway_position.yml").write_text(position)
    (folder / "tx_pos.csv").write_text("x,y,z\n" + "".join(f"{i},1,1\n" for i in range(len(rows))))
    (folder / "gateway_rssi.csv").write_text("\n".join([names, *rows, ""]))
    return folder
