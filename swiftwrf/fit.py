"""From measured spectra to a model: what a fit is told, and its two rounds."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import torch
from torch import Tensor

from swiftwrf.data.spectra import Spectra, coarsening
from swiftwrf.data.splits import MIN_TRAINING, slabs
from swiftwrf.errors import InputError
from swiftwrf.fit_config import FitConfig, Validation
from swiftwrf.metrics import WINDOW
from swiftwrf.model import SwiftWRF
from swiftwrf.optimise import Optimisation, Record, Stage, fingerprint, read_state
from swiftwrf.prior import choose_kernel, choose_rank
from swiftwrf.progress import progress_bar

FOLDS = 5  # validation holds out one; the kernel is chosen over all


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

    A first fit without one fold of the training spectra finds the number of steps after which they are predicted best; a
    second one takes that many with all of them. Same data, configuration and machine give the same model.

    Args:
        train: the only spectra it sees.
        config: how; `FitConfig()` unless given.
        device: where to compute.
        checkpoint: a file that keeps the state of the fit; where it exists, the fit goes on from it.
        on_record: called with stage, step, loss, validation loss (final stage: none) and seconds at each look.
        progress: show a progress bar on a terminal.

    Raises:
        InputError: fewer than 10 spectra, something not finite, or a checkpoint of another fit.
        FitError: a loss or gradient that is not finite; the checkpoint holds the last good state.
    """
    config = config or FitConfig()
    if len(train) < MIN_TRAINING:
        raise InputError(f"a fit needs at least {MIN_TRAINING} spectra, got {len(train)}")
    for name, tensor in (("position", train.position), ("spectrum", train.spectrum)):
        bad = (~tensor.isfinite()).flatten(1).any(dim=1).nonzero()
        if len(bad):
            raise InputError(f"{name} of training spectrum {int(bad[0])} is not finite; mend or leave it out")
    fold = folds(train.position, config.validation, config.seed)
    # an array's beams are far wider than a pixel, so little is lost at the coarser resolution of the fit
    work = train.coarsen(coarsening(train.grid.shape, config.max_azimuths, least_rows=WINDOW))
    kernel = choose_kernel(work.position, work.spectrum, fold)
    if config.model.rank is None:
        rank = choose_rank(work.position, work.spectrum, fold, kernel)
        config = replace(config, model=replace(config.model, rank=rank))
    owner = fingerprint(config, work)
    saved = read_state(checkpoint, owner)
    with progress_bar(progress) as bar:

        def run(stage: Stage, rows: Tensor, steps: int, held_out: Spectra | None = None) -> Optimisation:
            optimisation = Optimisation(stage, steps, work.subset(rows), kernel, config, device, held_out)
            optimisation.run(saved, checkpoint, owner, bar, on_record)
            return optimisation

        if saved is None or saved.stage == "search":
            held_out = work.subset((fold == 0).nonzero()[:, 0])
            steps = run("search", (fold != 0).nonzero()[:, 0], config.steps, held_out).best_step
        else:
            steps = saved.steps
        model = run("final", torch.arange(len(work)), steps).result
    model.grid = train.grid
    return model.eval()


def folds(position: Tensor, validation: Validation, seed: int) -> Tensor:
    """Number of the fold, 0 to 4, of each training position."""
    if validation == "block":
        return slabs(position, FOLDS)
    order = torch.randperm(len(position), generator=torch.Generator().manual_seed(seed))
    return order % FOLDS
