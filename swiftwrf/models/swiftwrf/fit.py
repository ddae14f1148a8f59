"""The fit of a SwiftWRF model: choose rank and number of primitives on held-out spectra, then fit all spectra."""

from __future__ import annotations

import math
import time
from collections.abc import Callable
from dataclasses import asdict, replace

import torch

from swiftwrf.data.spectra import Spectra, fingerprint
from swiftwrf.data.splits import folds
from swiftwrf.gp import choose_kernel
from swiftwrf.models.base import FitContext
from swiftwrf.models.swiftwrf.config import FitConfig
from swiftwrf.models.swiftwrf.deformation import DEFORMATIONS
from swiftwrf.models.swiftwrf.field import DeformableGaussians
from swiftwrf.models.swiftwrf.optimise import Optimisation, run_name
from swiftwrf.models.swiftwrf.regression import TRIAL_STEPS, Regression
from swiftwrf.runtime.progress import progress_bar
from swiftwrf.runtime.session import Session

MIN_PRIMITIVES, MAX_PRIMITIVES = 16, 512  # numbers of primitives that the search tries
MIN_GAIN = 0.004  # relative reduction of the loss that counts, 0.04 dB


def fit_field(train: Spectra, config: FitConfig, context: FitContext) -> DeformableGaussians:
    """Fit deformable Gaussians. The same data, options and machine give the same result.

    Each record has stage (search, final), n_primitives, steps, step, loss, validation (of the search), seconds of the run
    and elapsed seconds of the fit. A fit that continues from a checkpoint sends the earlier records first.

    Args:
        train: Checked training spectra.
        config: Options.
        context: Device, checkpoint, callback and progress.

    Raises:
        InputError: The checkpoint belongs to another fit.
        FitError: A loss or gradient is not finite (the checkpoint has the last good state), or the loss ends above its
            first value.
    """
    fold = folds(train.position, config.validation, config.seed)
    work = train.at_most(config.max_azimuths)
    kernel = choose_kernel(work.position, work.store, fold)
    if config.validation == "random":
        fold = torch.arange(len(train))  # leave-one-out costs a regression no more than five folds
    if config.model.rank == "auto":
        deformation = DEFORMATIONS[config.model.deformation]
        rank = deformation.choose_rank(work.position, work.store, fold, kernel)
        config = replace(config, model=replace(config.model, rank=rank))
    with progress_bar(context.progress) as bar:
        session = Session(context.checkpoint, fingerprint(work, asdict(config)), bar, context.on_record)
        if config.steps:
            optimisation = Optimisation(config, work, kernel, context.device)
            optimisation.run(session)
            field = optimisation.result
        else:
            field = _regress(Regression(work, config, kernel, fold), config, session).to(context.device)
    field.grid = train.grid
    return field


def _regress(regression: Regression, config: FitConfig, session: Session) -> DeformableGaussians:
    """Return the smallest field whose held-out loss is level with the lowest, or the one of the given size."""
    task = session.bar.add_task("regression", total=None)

    def record(stage: str, n: int, began: float, loss: float, validation: float | None) -> None:
        seconds = time.perf_counter() - began
        found = {"steps": 0, "step": 0, "loss": loss, "validation": validation, "seconds": seconds}
        session.evaluated({"stage": stage, "n_primitives": n} | found, {}, {"run": run_name(stage, n)})

    def loss(n: int) -> float:
        name = run_name("search", n)
        session.bar.update(task, description=name)
        if name not in session.losses:
            began = time.perf_counter()
            session.losses[name] = regression.held_out_loss(n, TRIAL_STEPS)
            record("search", n, began, session.losses[name], session.losses[name])
        return session.losses[name]

    n = config.model.n_primitives
    if n == "auto":
        n = doubling_search(loss, MIN_PRIMITIVES, MAX_PRIMITIVES, patience=1)
    began = time.perf_counter()
    session.bar.update(task, description=run_name("final", n))
    field = regression.field(n)
    record("final", n, began, regression.held_out_loss(n), None)
    return field


def doubling_search(loss: Callable[[int], float], first: int, last: int, patience: int) -> int:
    """Return the smallest of first, 2 first, 4 first, ... whose loss is within 0.4 % of the lowest loss found.

    The size doubles until `patience` doublings in a row have each reduced the loss by less than 0.4 %, so the search costs
    about as much as its last fits.

    Args:
        loss: Held-out loss of a fit of a size.
        first: First size.
        last: Maximum size.
        patience: Number of doublings without gain that ends the search.
    """
    losses: dict[int, float] = {}
    size, lowest, without_gain = first, math.inf, 0
    while size <= last and without_gain < patience:
        losses[size] = max(loss(size), 0.0)  # rounding may leave less
        without_gain = 0 if losses[size] < (1 - MIN_GAIN) * lowest else without_gain + 1
        lowest = min(lowest, losses[size])
        size *= 2
    return next(size for size, found in losses.items() if found <= (1 + MIN_GAIN) * lowest)
