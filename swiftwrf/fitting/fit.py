"""From measured spectra to a model: how much the scene needs, then one fit of that size."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import asdict, replace
from pathlib import Path

import torch

from swiftwrf.data.spectra import Spectra, check_training, coarsening, fingerprint
from swiftwrf.data.splits import folds
from swiftwrf.fitting.config import FitConfig
from swiftwrf.fitting.optimise import Optimisation
from swiftwrf.fitting.search import doubling_search
from swiftwrf.fitting.state import Record, Session, Size
from swiftwrf.gp import choose_kernel
from swiftwrf.metrics import WINDOW
from swiftwrf.model import SwiftWRF
from swiftwrf.model.deformation import deformation_type
from swiftwrf.progress import progress_bar

FEWEST, TYPICAL, MOST = 16, 64, 2048  # primitives that the search tries
SHORTEST, LONGEST = 300, 1200  # steps that it tries
SEARCH_AZIMUTHS = 90  # columns of the spectra in the search: coarser ones rank the candidates alike


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

    Short fits without one fold of the training spectra find how many primitives and then how many steps predict that fold
    best; one fit of that size takes all spectra. Same data, configuration and machine give the same model.

    Args:
        train: the only spectra it sees.
        config: how; `FitConfig()` unless given.
        device: where to compute.
        checkpoint: a file that keeps the state of the fit; where it exists, the fit goes on from it.
        on_record: called at each evaluation with stage (search, final), n_primitives, steps, step, loss, validation loss
            (final stage: none), seconds of that run and elapsed ones of the fit; a fit that goes on begins with the records
            of its earlier sessions.
        progress: show a progress bar on a terminal.

    Raises:
        InputError: fewer than 10 spectra, something not finite, or a checkpoint of another fit.
        FitError: a loss or gradient that is not finite (the checkpoint holds the last good state), or a fit that ends
            worse than it began.
    """
    config = config or FitConfig()
    check_training(train)
    fold = folds(train.position, config.validation, config.seed)
    # an array's beams are far wider than a pixel, so little is lost at the coarser resolution of the fit
    work = _at_most(config.max_azimuths, train)
    kernel = choose_kernel(work.position, work.spectrum, fold)
    if config.model.rank == "auto":
        deformation = deformation_type(config.model.deformation)
        rank = deformation.choose_rank(work.position, work.spectrum, fold, kernel)
        config = replace(config, model=replace(config.model, rank=rank))
    with progress_bar(progress) as bar:
        session = Session(checkpoint, fingerprint(work, asdict(config)), bar, on_record)
        small = _at_most(SEARCH_AZIMUTHS, work)
        kept, held_out = (small.subset(rows.nonzero()[:, 0]) for rows in (fold != 0, fold == 0))

        def loss(n: int, steps: int) -> float:
            key = Size(False, n, steps).key
            if key not in session.losses:
                run = Optimisation(_sized(config, n), steps, kept, kernel, device, held_out).run(session)
                session.losses[key] = run.held_out_loss()
            return session.losses[key]

        n, steps = _choose_size(loss, config)
        model = Optimisation(_sized(config, n), steps, work, kernel, device).run(session).result
    model.grid = train.grid
    return model.eval()


def _choose_size(loss: Callable[[int, int], float], config: FitConfig) -> tuple[int, int]:
    """Numbers of primitives and steps: those given, or those that held-out spectra call for.

    Args:
        loss: of a fit of so many primitives and steps on held-out spectra.
    """
    n, steps = config.model.n_primitives, config.steps
    if steps == "auto":  # first, for sizes that are compared in short fits favour large ones
        steps = doubling_search(lambda steps: loss(TYPICAL if n == "auto" else n, steps), SHORTEST, LONGEST, patience=1)
    if n == "auto":
        n = doubling_search(lambda n: loss(n, steps), FEWEST, MOST, patience=2)
    return n, steps


def _at_most(azimuths: int, spectra: Spectra) -> Spectra:
    return spectra.coarsen(coarsening(spectra.grid.shape, azimuths, least_rows=WINDOW))


def _sized(config: FitConfig, n: int) -> FitConfig:
    return replace(config, model=replace(config.model, n_primitives=n))
