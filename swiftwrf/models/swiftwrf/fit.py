"""From measured spectra to a model: how much the scene needs, then a model of that size."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import asdict, replace
from pathlib import Path

import torch
from torch import Tensor

from swiftwrf.data.spectra import Spectra, check_training, fingerprint
from swiftwrf.data.splits import folds
from swiftwrf.gp import Kernel, choose_kernel
from swiftwrf.models.swiftwrf.config import FitConfig
from swiftwrf.models.swiftwrf.deformation import deformation_type
from swiftwrf.models.swiftwrf.model import SwiftWRF
from swiftwrf.models.swiftwrf.optimise import Optimisation
from swiftwrf.models.swiftwrf.regression import TRIAL_STEPS, Regression
from swiftwrf.models.swiftwrf.search import doubling_search
from swiftwrf.runtime.progress import progress_bar
from swiftwrf.runtime.session import Record, Session, Size

FEWEST, MOST = 16, 512  # primitives that the search tries


def fit(
    train: Spectra,
    config: FitConfig | None = None,
    *,
    device: torch.device | str = "cpu",
    checkpoint: Path | None = None,
    on_record: Callable[[Record], None] | None = None,
    progress: bool = True,
) -> SwiftWRF:
    """Fits a SwiftWRF model to spectra.

    By regression, unless the configuration asks for steps by gradient: sizes are doubled until held-out training spectra
    gain no more, and all spectra make the model of that size. Same data, configuration and machine give the same model.

    Args:
        train: the only spectra it sees.
        config: how; `FitConfig()` unless given.
        device: where to compute.
        checkpoint: a file that keeps the state of the fit; where it exists, the fit goes on from it.
        on_record: called at each evaluation with stage (search, final), n_primitives, steps, step, loss, validation loss
            (of the search), seconds of that run and elapsed ones of the fit; a fit that goes on begins with the records
            of its earlier sessions.
        progress: show a progress bar on a terminal.

    Raises:
        InputError: fewer than 10 spectra, something not finite, a configuration that does not fit together, or a
            checkpoint of another fit.
        FitError: a loss or gradient that is not finite (the checkpoint holds the last good state), or a fit that ends
            worse than it began.
    """
    config = config or FitConfig()
    check_training(train)
    config.check()
    fold = folds(train.position, config.validation, config.seed)
    work = train.at_most(config.max_azimuths)
    kernel = choose_kernel(work.position, work.store, fold)
    if config.validation == "random":
        fold = torch.arange(len(train))  # regression leaves out one spectrum as easily as a fifth of them
    if config.model.rank == "auto":
        config = replace(config, model=replace(config.model, rank=_rank(work, config, fold, kernel)))
    with progress_bar(progress) as bar:
        session = Session(checkpoint, fingerprint(work, asdict(config)), bar, on_record)
        if config.steps:
            optimisation = Optimisation(config, work, kernel, device)
            optimisation.run(session)
            model = optimisation.result
        else:
            model = _regress(Regression(work, config, kernel, fold), config, session).to(device)
    model.grid = train.grid
    return model.eval()


def _rank(train: Spectra, config: FitConfig, fold: Tensor, kernel: Kernel) -> int:
    deformation = deformation_type(config.model.deformation)
    return deformation.choose_rank(train.position, train.store, fold, kernel)


def _regress(regression: Regression, config: FitConfig, session: Session) -> SwiftWRF:
    """The smallest model that predicts held-out spectra as well as any, or the one of the size that is asked for."""
    task = session.bar.add_task("regression", total=None)

    def record(size: Size, began: float, loss: float, validation: float | None) -> None:
        seconds = time.perf_counter() - began
        found = {"steps": 0, "step": 0, "loss": loss, "validation": validation, "seconds": seconds}
        stage = "final" if size.final else "search"
        session.evaluated({"stage": stage, "n_primitives": size.n_primitives} | found, {}, {"run": size.key})

    def loss(n: int) -> float:
        size = Size(False, n, 0)
        session.bar.update(task, description=str(size))
        if size.key not in session.losses:
            began = time.perf_counter()
            session.losses[size.key] = regression.held_out_loss(n, TRIAL_STEPS)
            record(size, began, session.losses[size.key], session.losses[size.key])
        return session.losses[size.key]

    n = config.model.n_primitives
    if n == "auto":
        n = doubling_search(loss, FEWEST, MOST, patience=1)
    size, began = Size(True, n, 0), time.perf_counter()
    session.bar.update(task, description=str(size))
    model = regression.model(n)
    record(size, began, regression.held_out_loss(n), None)
    return model
