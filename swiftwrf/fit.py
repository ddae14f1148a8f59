"""From measured spectra to a model: how much the scene needs, then one fit of that size."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import torch
from torch import Tensor

from swiftwrf import checks
from swiftwrf.data.spectra import Spectra, coarsening
from swiftwrf.data.splits import slabs
from swiftwrf.fit_config import FitConfig, Validation
from swiftwrf.metrics import WINDOW
from swiftwrf.model import SwiftWRF
from swiftwrf.optimise import Optimisation, Record, Session, fingerprint
from swiftwrf.prior import choose_kernel, choose_rank
from swiftwrf.progress import progress_bar
from swiftwrf.search import climb

FOLDS = 5  # the search holds out one; the kernel is chosen over all
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
        on_record: called at each look with stage (search, final), n_primitives, steps, step, loss, validation loss (final
            stage: none) and seconds.
        progress: show a progress bar on a terminal.

    Raises:
        InputError: fewer than 10 spectra, something not finite, or a checkpoint of another fit.
        FitError: a loss or gradient that is not finite (the checkpoint holds the last good state), or a fit that ends
            worse than it began.
    """
    config = config or FitConfig()
    checks.training(train)
    fold = folds(train.position, config.validation, config.seed)
    # an array's beams are far wider than a pixel, so little is lost at the coarser resolution of the fit
    work = _at_most(config.max_azimuths, train)
    kernel = choose_kernel(work.position, work.spectrum, fold)
    if config.model.rank == "auto":
        rank = choose_rank(work.position, work.spectrum, fold, kernel)
        config = replace(config, model=replace(config.model, rank=rank))
    with progress_bar(progress) as bar:
        session = Session(checkpoint, fingerprint(config, work), bar, on_record)
        small = _at_most(SEARCH_AZIMUTHS, work)
        kept, held_out = (small.subset(rows.nonzero()[:, 0]) for rows in (fold != 0, fold == 0))

        def loss(n: int, steps: int) -> float:
            optimisation = Optimisation(_sized(config, n), steps, kept, kernel, device, held_out)
            if optimisation.name not in session.losses:
                session.losses[optimisation.name] = optimisation.run(session).held_out_loss()
            return session.losses[optimisation.name]

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
        steps = climb(lambda steps: loss(TYPICAL if n == "auto" else n, steps), SHORTEST, LONGEST, patience=1)
    if n == "auto":
        n = climb(lambda n: loss(n, steps), FEWEST, MOST, patience=2)
    return n, steps


def _at_most(azimuths: int, spectra: Spectra) -> Spectra:
    return spectra.coarsen(coarsening(spectra.grid.shape, azimuths, least_rows=WINDOW))


def _sized(config: FitConfig, n: int) -> FitConfig:
    return replace(config, model=replace(config.model, n_primitives=n))


def folds(position: Tensor, validation: Validation, seed: int) -> Tensor:
    """Number of the fold, 0 to 4, of each training position."""
    if validation == "block":
        return slabs(position, FOLDS)
    order = torch.randperm(len(position), generator=torch.Generator().manual_seed(seed))
    return order % FOLDS
