"""Measure speed against error of every setting: seconds a spectrum, and its error.

The numerical error is the difference to the exact float64 rendering of the same model, for settings that change the
rendering only. The held-out error is the difference to measured test spectra. Both are RMS over pixels, and the median over
spectra.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import torch
from fields import load_scene
from pareto import speed
from record import options, write_result
from torch import Tensor

from swiftwrf import (
    AngularGrid,
    CoarrayModel,
    Spectra,
    fit,
    make_model,
    simulated_room,
)
from swiftwrf.array.planar import PlanarArray
from swiftwrf.data.splits import validation_for
from swiftwrf.metrics import psnr
from swiftwrf.models.coarray import project
from swiftwrf.rasterize import Backend, prepare, rasterize_magnitude
from tasks import labels
from tasks.page import figures
from tasks.page.figures import Palette

CUTOFFS = (None, 1e-5, 1e-4, 1e-3, 1e-2)
GRIDS = ((45, 180), (90, 360), (180, 720))
SIZES = (16, 64, 256, 1024)
BATCH = 32  # spectra a call
Point = dict[str, Any]


@dataclass(frozen=True)
class Config:
    data: Path | None = None
    """folder of spectra. Defaults to the simulated room"""
    split: str = "random"
    name: str | None = None
    """name of the result. Defaults to that of the data"""
    array: tuple[int, float, float] | None = None
    """square array that took the spectra, where the data do not say: elements a side, spacing [m], carrier [Hz]"""
    seconds: float = 1.0
    """seconds for the repeats of one rate, of which there are 3 to 30"""
    seed: int = 0


def main(config: Config) -> None:
    """Measure every setting, write `results/speed_NAME.json` and draw `docs/figures/speed_NAME.svg`."""
    data = load_scene(config.data) if config.data else simulated_room(seed=config.seed)
    if config.array is not None:
        side, spacing, frequency = config.array
        data = replace(data, array=PlanarArray.square(side, frequency, spacing))
    train, test = data.split(config.split, config.seed)
    study = Study(train, test, config)
    drawing, models = study.drawing(), study.models() + study.others()
    name = config.name or f"{data.name}_{config.split}".replace("-", "_")
    content = {
        "data": data.name,
        "split": config.split,
        "seed": config.seed,
        "n_train": len(train),
        "n_test": len(test),
    }
    content |= {"grid": data.grid.shape, "drawing": drawing, "models": models}
    write_result(f"speed_{name}", content)
    draw(content, Path(__file__).parent.parent / "docs" / "figures" / f"speed_{name}.svg")


class Study:
    """One scene and the model that the default fit finds for it."""

    def __init__(self, train: Spectra, test: Spectra, config: Config) -> None:
        self.train, self.test, self.seconds = train, test, config.seconds
        validation = validation_for(config.split)
        self.validation = validation
        self.seed = config.seed
        prepare("cpu")
        began = time.perf_counter()
        self.model = fit(train, validation=validation, seed=config.seed)
        self.fit_seconds = time.perf_counter() - began

    def rate(self, synthesize: Callable[[Tensor], Tensor]) -> dict[str, float]:
        """Return the seconds of a spectrum from positions to magnitudes: median, minimum and maximum of the repeats."""
        position = self.test.position.repeat(-(-BATCH // len(self.test)), 1)[:BATCH]

        def once() -> float:
            began = time.perf_counter()
            synthesize(position)
            return (time.perf_counter() - began) / BATCH

        once()
        repeats = max(3, min(30, int(self.seconds / (BATCH * once()))))
        taken = sorted(once() for _ in range(repeats))
        return {"median": taken[repeats // 2], "low": taken[0], "high": taken[-1]}

    def point(self, setting: str, synthesize: Callable[[Tensor], Tensor], fit_seconds: float, **more: Any) -> Point:
        """Return time and error of a model on the grid of the data."""
        drawn = synthesize(self.test.position)
        result = {
            "setting": setting,
            "seconds": self.rate(synthesize),
            "fit_seconds": fit_seconds,
            "held_out": rms(drawn, self.test.spectrum),
            "psnr_db": float(psnr(drawn, self.test.spectrum).median()),
            **more,
        }
        print(setting, f"{result['seconds']['median'] * 1e3:.3f} ms, {result['psnr_db']:.2f} dB", more, flush=True)
        return result

    def drawing(self) -> list[Point]:
        """Return the default model rendered with every setting, the exact one first."""
        points: list[Point] = []
        own_grid = self.train.grid
        others = [AngularGrid.hemisphere(*shape) for shape in GRIDS if shape != own_grid.shape]
        grids = [(own_grid, True), *((grid, False) for grid in others)]
        exact = {g: self._drawer(g, "reference", None, torch.float64)(self.test.position) for g, _ in grids}
        for backend in ("reference", "cpu"):
            for cutoff in CUTOFFS:
                for dtype in (torch.float32, torch.float16, torch.bfloat16):
                    for grid, own in grids:
                        if not own and (dtype != torch.float32 or cutoff not in (None, 1e-4)):
                            continue
                        if backend == "reference" and (cutoff is not None or dtype != torch.float32):
                            continue  # as fast and as wrong as without
                        points.append(self._drawn(grid, backend, cutoff, dtype, exact[grid], own))
        return points

    def _drawn(
        self, grid: AngularGrid, backend: Backend, cutoff: float | None, dtype: torch.dtype, exact: Tensor, own: bool
    ) -> Point:
        size = f"{grid.n_elevation} x {grid.n_azimuth}"
        weights = "" if dtype == torch.float32 else f", weights {str(dtype).removeprefix('torch.')}"
        setting = f"{backend}, cutoff {'none' if cutoff is None else f'{cutoff:g}'}{weights}, {size}"
        synthesize = self._drawer(grid, backend, cutoff, dtype)
        drawn = synthesize(self.test.position)
        result: Point = {"setting": setting, "backend": backend, "seconds": self.rate(synthesize), "own_grid": own}
        result |= {"numerical": rms(drawn, exact), "largest": float((drawn - exact).abs().max())}
        if own:
            result |= {"held_out": rms(drawn, self.test.spectrum)}
        print(setting, f"{result['seconds']['median'] * 1e3:.3f} ms, numerical {result['numerical']:.2e}", flush=True)
        return result

    @torch.no_grad()
    def _drawer(
        self, grid: AngularGrid, backend: Backend, cutoff: float | None, dtype: torch.dtype
    ) -> Callable[[Tensor], Tensor]:
        """Return the rendering of the default model with weights rounded to `dtype`; float64 applies to all tensors."""
        wide = dtype == torch.float64

        @torch.no_grad()
        def synthesize(position: Tensor) -> Tensor:
            spectrum = torch.empty(len(position), *grid.shape, dtype=torch.float64 if wide else torch.float32)
            step = 1 if backend == "reference" else BATCH
            for start in range(0, len(position), step):
                rows = slice(start, start + step)
                mean, cholesky, weight = self.model.primitives(position[rows])
                tensors = tuple(x.double() if wide else x.float() for x in (mean, cholesky, weight.to(dtype)))
                spectrum[rows] = rasterize_magnitude(*tensors, grid, backend, cutoff)
            return spectrum.clamp_(0, 1)

        return synthesize

    def models(self) -> list[Point]:
        """Return the default model and those of other sizes."""
        models = {f"swiftwrf, default (N {len(self.model.mean)}, K {len(self.model.weight) - 1})": self.model}
        seconds = [self.fit_seconds]
        for n in SIZES:
            began = time.perf_counter()
            models[f"swiftwrf, N {n}"] = fit(self.train, n_primitives=n, validation=self.validation, seed=self.seed)
            seconds.append(time.perf_counter() - began)
        return [
            self.point(setting, model.synthesize, taken, parameters=sum(p.numel() for p in model.parameters()))
            for (setting, model), taken in zip(models.items(), seconds, strict=True)
        ]

    def others(self) -> list[Point]:
        """Return the other field models, and projections onto the spectra that the array can produce."""
        array, grid, points = self.train.array, self.train.grid, []
        models = {}
        for name in ("nearest", "idw", "gp", *(("coarray",) if array else ())):
            model = models[name] = make_model(name, validation=self.validation, seed=self.seed)
            began = time.perf_counter()
            model.fit(self.train)
            seconds = time.perf_counter() - began
            more = (
                {"parameters": model.process.coefficient.numel() + model.form.numel()}
                if isinstance(model, CoarrayModel)
                else {}
            )
            points.append(self.point(name, model.synthesize, seconds, **more))
        if array is None:
            return points
        stretched = float(models["coarray"].offset) > 1e-3
        for name, synthesize in (("swiftwrf, default", self.model.synthesize), ("gp", models["gp"].synthesize)):

            def projected(position: Tensor, synthesize: Callable[[Tensor], Tensor] = synthesize) -> Tensor:
                return project(synthesize(position), array, grid, stretched=stretched)

            points.append(self.point(f"{name}, projected", projected, 0.0))
        return points


def rms(drawn: Tensor, truth: Tensor) -> float:
    """Return the RMS difference over pixels, and its median over spectra."""
    return float((drawn.double() - truth.double()).square().mean(dim=(-2, -1)).sqrt().median())


def draw(content: dict[str, Any], file: Path) -> None:
    """Draw numerical and held-out error against seconds a spectrum, with the Pareto fronts."""
    figure, axes = figures.new_figure(1, 2, 10.5, 4.2)
    palette = Palette.of(labels.FIELD_MODELS)
    own = [p for p in content["drawing"] if p["own_grid"]]
    short = {p["setting"]: p["setting"].rsplit(", ", 1)[0] for p in own}
    numerical = {short[p["setting"]]: (p["seconds"]["median"], max(p["numerical"], 1e-9)) for p in own}
    held_out = {p["setting"]: (p["seconds"]["median"], p["held_out"]) for p in content["models"]}
    speed(axes[0], palette, numerical, "seconds a spectrum", "RMS error against the exact drawing")
    default = [name for name in held_out if name.startswith("swiftwrf, default (") or name == "coarray"]
    speed(axes[1], palette, held_out, "seconds a spectrum", "RMS error against held-out spectra", default)
    file.write_text(figures.as_svg(figure))
    print(f"drew {file}")


if __name__ == "__main__":
    main(options(Config))
