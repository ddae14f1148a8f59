"""Reader of the NeRF2 layout for spectra: gateway_info.yml, tx_pos.csv or rx_pos.csv, spectrum/*.png."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import torch
from PIL import Image, UnidentifiedImageError
from torch import Tensor

from swiftwrf.angles import AngularGrid, ArrayPose
from swiftwrf.data.files import read_positions, read_yaml, sha256
from swiftwrf.data.formats.base import SPECTRA_FORMATS, Format
from swiftwrf.data.spectra import Moving, Spectra
from swiftwrf.data.splits import read_split, split_names
from swiftwrf.errors import InputError


@SPECTRA_FORMATS.register("nerf2", meaning="gateway_info.yml, tx_pos.csv or rx_pos.csv, spectrum/00001.png, ...")
class Nerf2(Format[Spectra]):
    """Images; row i of the positions belongs to the image numbered i from 1."""

    def recognises(self, path: Path) -> bool:
        return (path / "gateway_info.yml").is_file() or (path / "spectrum").is_dir()

    def read(self, path: Path) -> Spectra:
        return _read(path)


def _read(folder: Path) -> Spectra:
    pose = _read_pose(folder / "gateway_info.yml")
    tables = [file for file in (folder / "tx_pos.csv", folder / "rx_pos.csv") if file.is_file()]
    if len(tables) != 1:
        raise InputError(f"{folder} must hold one of tx_pos.csv (moving transmitter) and rx_pos.csv (moving receiver)")
    moving: Moving = "transmitter" if tables[0].name == "tx_pos.csv" else "receiver"
    position = read_positions(tables[0])
    spectrum = _read_images(folder / "spectrum", len(position))
    fixed = torch.tensor(pose.position, dtype=torch.float64)
    ends = (position, fixed) if moving == "transmitter" else (fixed, position)
    if bool((position == fixed).all(dim=1).any()):
        raise InputError(f"{tables[0]} has a position equal to the gateway's, from which there is no direction")
    splits = {name: read_split(folder, name, len(position), first=1) for name in split_names(folder)}
    described = [folder / "gateway_info.yml", tables[0], *sorted(folder.glob("*_index*.txt"))]
    return Spectra(
        name=folder.resolve().name,
        position=position,
        spectrum=spectrum,
        grid=AngularGrid.hemisphere(*spectrum.shape[1:]),
        label=pose.line_of_sight(*ends),
        line_of_sight=torch.ones(len(position), dtype=torch.bool),
        moving=moving,
        index=torch.arange(len(position)),
        named_splits=splits,
        source={file.name: sha256(file) for file in described},
        fixed_position=fixed,
        rotation=pose.rotation,
    )


def _read_pose(file: Path) -> ArrayPose:
    content = read_yaml(file)
    gateways = [value for value in content.values() if isinstance(value, dict)]
    if len(gateways) != 1:
        raise InputError(f"{file} must describe one gateway with its position and orientation, got {len(gateways)}")
    try:
        position = tuple(float(x) for x in gateways[0]["position"])
        orientation = tuple(float(x) for x in gateways[0]["orientation"])
    except (KeyError, TypeError, ValueError):
        raise InputError(f"{file}: the gateway needs a position of 3 and an orientation of 4 numbers") from None
    if len(position) != 3 or len(orientation) != 4:
        raise InputError(
            f"{file}: the gateway's position must have 3 numbers and its orientation (x, y, z, w) 4, "
            f"got {len(position)} and {len(orientation)}"
        )
    try:
        return ArrayPose(position, orientation)
    except InputError as error:
        raise InputError(f"{file}: {error}") from None


def _read_images(folder: Path, n: int) -> Tensor:
    """`00001.png` to `n`.png as float32 (n, H, W) in [0, 1], all grey and of one shape."""
    if not folder.is_dir():
        raise InputError(f"{folder} is missing; expected one grey image a position, 00001.png to {n:05d}.png")
    found = len(list(folder.glob("*.png")))
    if found != n:
        raise InputError(f"{folder} holds {found} images, but there are {n} positions; each position needs its image")
    images = [_read_image(folder / f"{number:05d}.png") for number in range(1, n + 1)]
    for number, image in enumerate(images, start=1):
        if image.shape != images[0].shape:
            raise InputError(
                f"{folder / f'{number:05d}.png'} has {image.shape[0]} x {image.shape[1]} pixels, the first image "
                f"{images[0].shape[0]} x {images[0].shape[1]}; all spectra must have one shape"
            )
    return torch.from_numpy(np.stack(images)).float() / 255


def _read_image(file: Path) -> np.ndarray[tuple[int, int], np.dtype[np.uint8]]:
    if not file.is_file():
        raise InputError(f"{file} is missing; images are numbered from 00001.png without gaps")
    try:
        with Image.open(file) as image:
            image.verify()  # the checksums; loading alone forgives a missing end
        with Image.open(file) as image:
            image.load()
            if image.mode != "L":
                raise InputError(f"{file} has mode {image.mode}; a spectrum is an 8-bit grey image")
            rows, columns = image.height, image.width
            if not (rows >= 2 and columns == 4 * rows):
                raise InputError(
                    f"{file} has {rows} x {columns} pixels; a spectrum has 4 columns a row "
                    "(elevations to 90, azimuths to 360 degrees), e.g. 90 x 360"
                )
            return np.asarray(image)
    except (UnidentifiedImageError, OSError, SyntaxError) as error:
        raise InputError(f"{file} is not a complete PNG image ({error})") from None
