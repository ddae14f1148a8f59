"""Measure hard cases: errors of every backend and of reduced precision, quality or refusal of fits."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, replace
from typing import Any, Literal

import torch
from hard_cases import GRADIENT_TOLERANCE, HARD_CASES, VALUE_TOLERANCE, field_errors, magnitude_errors
from record import options, write_result
from torch import Tensor

from swiftwrf import AngularGrid, FieldModel, FitError, InputError, Spectra, SwiftWRF, rasterize, simulated_room
from swiftwrf.data.store import Store
from swiftwrf.metrics import psnr
from swiftwrf.models.swiftwrf_paper import DeformableGaussians, SwiftWRFPaper
from swiftwrf.positions import centre_and_half_side
from swiftwrf.rasterize import Backend, rasterize_magnitude


@dataclass(frozen=True)
class Config:
    many: int = 6000
    """spectra of the largest fit"""


def main(config: Config) -> None:
    """Measures everything and writes `results/stability_<cpu or cuda>.json`."""
    device = torch.device("cuda" if torch.cuda.is_available() else "cpu")
    backends: tuple[Backend, ...] = ("reference", "cuda" if device.type == "cuda" else "cpu")
    drawn = [
        render_case(name, backend, cutoff, device)
        for name in HARD_CASES
        for backend in backends
        for cutoff in (None, 1e-4)
    ]
    fits = [fit_case(name, config.many) for name in FITS]
    content = {"backends": drawn, "precision": precision(device), "fits": fits}
    write_result(f"stability_{device.type}", content, device)


def render_case(name: str, backend: Backend, cutoff: float | None, device: torch.device) -> dict[str, Any]:
    """Errors of one backend in one case, and what is tolerated."""
    case = HARD_CASES[name]

    def field(mean: Tensor, cholesky: Tensor, weight: Tensor, grid: AngularGrid, cutoff: float | None) -> Tensor:
        return rasterize(mean, cholesky, weight, grid, backend, cutoff)

    def length(mean: Tensor, cholesky: Tensor, weight: Tensor, grid: AngularGrid, cutoff: float | None) -> Tensor:
        return rasterize_magnitude(mean, cholesky, weight, grid, backend, cutoff)

    value, gradient = field_errors(field, case, cutoff, str(device))
    _, magnitude_gradient = magnitude_errors(length, case, cutoff, str(device))
    return {
        "case": name,
        "rule": case.rule,
        "backend": backend,
        "cutoff": cutoff,
        "value": value,
        "gradient": gradient,
        "magnitude_gradient": magnitude_gradient,
        "value_tolerance": VALUE_TOLERANCE[cutoff] * case.slack,
        "gradient_tolerance": GRADIENT_TOLERANCE[cutoff] * case.slack,
    }


# ------------------------------------------------------------------------------------------------------------- precision


def precision(device: torch.device) -> list[dict[str, Any]]:
    """Largest error of |A| of a model with 200 primitives as a share of the largest |A|, and PSNR, by what is rounded."""
    generator = torch.Generator().manual_seed(0)
    grid = AngularGrid.hemisphere(90, 360)
    anchor = torch.rand(100, 3, generator=generator)
    model = DeformableGaussians(200, grid, *centre_and_half_side(anchor), generator=generator)
    for parameter in (*model.primitives.parameters(), *model.output.parameters()):
        parameter.data += 0.3 * torch.randn(parameter.shape, generator=generator)
    model = model.to(device).requires_grad_(False)
    position = model.normalise(torch.rand(8, 3, generator=generator).to(device))
    mean, cholesky, weight = model(position)

    def drawn(
        mean: Tensor = mean, cholesky: Tensor = cholesky, weight: Tensor = weight, cutoff: float | None = 1e-4
    ) -> Tensor:
        return rasterize_magnitude(mean, cholesky, weight, grid, "auto", cutoff).cpu()

    doubles = (x.double() for x in (mean, cholesky, weight))
    exact = rasterize_magnitude(*doubles, grid, "reference", None).cpu()
    peak = float(exact.max())
    rows: list[tuple[str, Tensor]] = [("float32, no cutoff", drawn(cutoff=None))]
    rows += [(f"float32, cutoff {cutoff:g}", drawn(cutoff=cutoff)) for cutoff in (1e-5, 1e-4, 1e-3, 1e-2)]
    for name, dtype in (("float16", torch.float16), ("bfloat16", torch.bfloat16)):
        rows.append((f"weights in {name}", drawn(weight=weight.to(dtype).float())))
        rows.append((f"means in {name}", drawn(mean=mean.to(dtype).float())))
    for name in ("high", "medium"):
        with matmul_precision(name):
            rows.append((f"matrix products in {name!r} precision", drawn(*model(position))))
    return [
        {
            "what": what,
            "error": float((spectrum - exact).abs().max()) / peak,
            "psnr_db": float(psnr(spectrum.double() / peak, exact / peak).min()),
        }
        for what, spectrum in rows
    ]


@contextmanager
def matmul_precision(name: str) -> Iterator[None]:
    """TF32 (high) or bfloat16 (medium) in float32 matrix products, where the device has them."""
    before = torch.get_float32_matmul_precision()
    torch.set_float32_matmul_precision(name)
    try:
        yield
    finally:
        torch.set_float32_matmul_precision(before)


# ------------------------------------------------------------------------------------------------------------------ fits

GRID = AngularGrid.hemisphere(15, 60)


def room(n: int = 40) -> Spectra:
    """Spectra of the simulated room on a small grid."""
    return simulated_room(n=n, seed=0, grid=GRID)


def with_spectrum(change: Callable[[Tensor], Tensor]) -> Spectra:
    """The room with other spectra."""
    spectra = room()
    return replace(spectra, store=Store(change(spectra.spectrum.clone())))


def with_position(change: Callable[[Tensor], Tensor]) -> Spectra:
    """The room with other positions."""
    spectra = room()
    return replace(spectra, position=change(spectra.position.clone()))


def one_pixel(spectrum: Tensor) -> Tensor:
    """A spectrum with a single bright pixel, everywhere."""
    spectrum = torch.zeros_like(spectrum)
    spectrum[:, 7, 20] = 1.0
    return spectrum


def one_nan(spectrum: Tensor) -> Tensor:
    """One pixel of one spectrum is not a number."""
    spectrum[3, 2, 1] = torch.nan
    return spectrum


FITS: dict[str, Callable[[int], Spectra]] = {
    "constant spectra": lambda many: with_spectrum(lambda s: torch.full_like(s, 0.5)),
    "zero spectra": lambda many: with_spectrum(torch.zeros_like),
    "one bright pixel": lambda many: with_spectrum(one_pixel),
    "a pixel that is not a number": lambda many: with_spectrum(one_nan),
    "every position twice, with different spectra": lambda many: with_position(
        lambda p: p[::2].repeat_interleave(2, 0)
    ),
    "positions on a line": lambda many: with_position(lambda p: p[:, :1] * torch.tensor([[1.0, 0.0, 0.0]])),
    "all positions one point": lambda many: with_position(lambda p: p[:1].expand(len(p), 3).contiguous()),
    "coordinates in kilometres from home": lambda many: with_position(lambda p: p + 5e5),
    "coordinates in millimetres": lambda many: with_position(lambda p: p * 1e-3),
    "10 spectra": lambda many: room(10),
    "many spectra": room,
    "learning rate thirty times too large": lambda many: room(),
}


def fit_case(name: str, many: int, n_primitives: int | Literal["auto"] = "auto") -> dict[str, Any]:
    """Return the error of the fitted training spectra and of their mean, or the message of the refusal."""
    train = FITS[name](many)
    model: FieldModel = SwiftWRF(n_primitives=n_primitives)
    if name.startswith("learning rate"):
        model = SwiftWRFPaper(n_primitives=24, steps=300, rate=0.3, deformation_rate=0.24)
    result: dict[str, Any] = {"case": name, "n": len(train), "psnr_db": None, "mean_psnr_db": None, "refusal": None}
    began = time.perf_counter()
    try:
        drawn = model.fit(train).synthesize(train.position)
    except (InputError, FitError) as error:
        result["refusal"] = str(error)
    else:
        result["psnr_db"] = float(psnr(drawn, train.spectrum).median())
        result["mean_psnr_db"] = float(psnr(train.spectrum.mean(dim=0), train.spectrum).median())
    result["seconds"] = time.perf_counter() - began
    print(result, flush=True)
    return result


if __name__ == "__main__":
    main(options(Config))
