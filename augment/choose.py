"""Choice of a field model by cross-validation on measured spectra.

Some models search for a structure (walls, number of primitives) before they fit parameters. A search takes most of the time,
so it is not repeated in every fold. By default no fold is predicted with a structure that its spectra helped to find. One
search leaves out folds 0 and 1, another leaves out folds 2 and 3. A model reuses the structure of the search that left its
fold out, and fits its parameters to all other folds. Fold 4 takes part in both searches and is never predicted. If a search
without two folds had too few spectra, each fold has a separate search.

Turbo learning gives rooms instead, one for each pair of folds. A search of all measured spectra finds their planes once. The
spectra outside the pair decide which planes exist, where, and what stands among them (`GeometryModel.decided_on`).
`benchmarks/held_out_rooms.py` measures what that shares.
"""

from __future__ import annotations

import math
import time
from collections.abc import Iterable, Sequence
from copy import copy
from dataclasses import dataclass
from typing import Any

import torch
from scipy.stats import trim_mean
from torch import Tensor

from swiftwrf import FitError, InputError, Spectra
from swiftwrf.data.spectra import check_training
from swiftwrf.data.splits import FOLDS, MIN_TRAINING, Validation, folds
from swiftwrf.gp import subsample
from swiftwrf.metrics import psnr
from swiftwrf.models import FIELD_MODELS, FieldModel
from swiftwrf.models.base import model_type, synthesized

BLIND_FOLDS = ((0, 1), (2, 3))  # pairs of folds that one structure search leaves out


@dataclass(frozen=True)
class Fold:
    """A field model fitted to some of the measured spectra, and the spectra that were held out from it.

    Args:
        model: Model fitted to `train`. Its parameters do not depend on `test`. Its structure does not either, except where
            that is one of `structures` whose search took all spectra.
        train: Measured spectra that the model was fitted to.
        test: Measured spectra that were held out.

    Example:
        >>> import swiftwrf
        >>> measured = swiftwrf.simulated_room(n=40, grid=swiftwrf.AngularGrid.hemisphere(10, 40))
        >>> fold = choose_model(measured, ("nearest",)).folds["nearest"][0]
        >>> fold.model.predict(fold.test.position).mean.shape == fold.test.store.shape
        True
    """

    model: FieldModel
    train: Spectra
    test: Spectra


@dataclass(frozen=True, repr=False)
class ModelChoice:
    """Result of `choose_model`.

    Args:
        name: Name of the best field model.
        psnr_db: Trimmed mean of the PSNR over held-out measured spectra [dB] of each candidate.
        seconds: Time of the cross-validation of each candidate [s]. A shared search counts for each model that uses it.
        folds: Scored folds of each candidate.
        left_out: Reason for each candidate that could not be fitted.

    Example:
        >>> import swiftwrf
        >>> measured = swiftwrf.simulated_room(n=40, grid=swiftwrf.AngularGrid.hemisphere(10, 40))
        >>> choice = choose_model(measured, ("nearest",))
        >>> choice
        <ModelChoice: nearest, PSNR nearest ... dB>
        >>> len(choice.folds["nearest"]) > 1
        True
    """

    name: str
    psnr_db: dict[str, float]
    seconds: dict[str, float]
    folds: dict[str, list[Fold]]
    left_out: dict[str, str]

    def __repr__(self) -> str:
        scores = ", ".join(f"{name} {psnr_db:.2f} dB" for name, psnr_db in self.psnr_db.items())
        reasons = "".join(f"; without {name}: {reason}" for name, reason in self.left_out.items())
        return f"<ModelChoice: {self.name}, PSNR {scores}{reasons}>"


def candidates(data: Spectra) -> list[str]:
    """Return the names of the field models whose requirements the data meet and whose fit takes seconds.

    Example:
        >>> import swiftwrf
        >>> "gp" in candidates(swiftwrf.simulated_room(n=20))
        True
    """
    return [name for name, model in FIELD_MODELS.items() if not model.slow and not model.lacking(data)]


def choose_model(
    measured: Spectra,
    models: Iterable[str | FieldModel | type[FieldModel]] | None = None,
    *,
    validation: Validation = "random",
    seed: int = 0,
    device: torch.device | str = "cpu",
    structures: Sequence[tuple[FieldModel, float]] = (),
    **options: Any,
) -> ModelChoice:
    """Return the field model with the highest PSNR on held-out measured spectra.

    The score is the mean without the lowest and the highest tenth. All candidates predict the same spectra, so differences
    between their means are paired and have a smaller variance than differences between medians.

    Args:
        measured: Measured spectra, at least 11.
        models: Candidates: names, classes, or models, which are fitted with their own options and stay as they are. Defaults
            to all field models that are fast and whose requirements the data meet.
        validation: Rule by which the spectra are divided into folds.
        seed: Seed of the folds and of the fits.
        device: Device to compute on.
        structures: A fitted model for each of the `blind_folds`, and the seconds of its fit. Candidates that can reuse its
            structure do not search.
        options: Further options of the candidates. Each candidate takes those that it has.

    Raises:
        InputError: Fewer than 11 spectra, a value that is not finite, an unknown name, two candidates of one name, an option
            that no candidate has, or no candidate that can be fitted.

    Example:
        >>> import swiftwrf
        >>> measured = swiftwrf.simulated_room(n=40, grid=swiftwrf.AngularGrid.hemisphere(10, 40))
        >>> sorted(choose_model(measured, ("nearest", swiftwrf.make_model("idw", seed=1))).psnr_db)
        ['idw', 'nearest']
    """
    check_training(measured)
    types = _by_name(candidates(measured) if models is None else models, options)
    fold, every_blind = blind_folds(measured, validation, seed)
    if not every_blind:
        raise InputError(
            f"cross-validation of field models needs more than {MIN_TRAINING} measured spectra, got {len(measured)}"
        )
    options |= {"validation": validation, "seed": seed}
    searched = [[model] for model in structures] or [list[tuple[FieldModel, float]]() for _ in every_blind]
    psnr_db: dict[str, float] = {}
    scored: dict[str, list[Fold]] = {}
    seconds: dict[str, float] = {}
    left_out: dict[str, str] = {}
    for name, field_model in types.items():
        try:
            unfitted = field_model(**field_model.supported(options)) if isinstance(field_model, type) else field_model
            parts = zip(every_blind, searched, strict=True)
            psnr_db[name], scored[name], seconds[name] = _cross_validated(unfitted, measured, fold, parts, device)
        except (InputError, FitError) as error:
            left_out[name] = str(error)
    if not psnr_db:
        reasons = "; ".join(f"{name}: {reason}" for name, reason in left_out.items())
        raise InputError(f"no field model can be fitted to {len(measured)} spectra of {measured.name} ({reasons})")
    best = max(psnr_db, key=lambda name: psnr_db[name])
    return ModelChoice(best, psnr_db, seconds, scored, left_out)


def _by_name(
    models: Iterable[str | FieldModel | type[FieldModel]], options: dict[str, Any]
) -> dict[str, FieldModel | type[FieldModel]]:
    """Return candidates by name.

    Raises:
        InputError: Two candidates of one name, or an option that none of them has.
    """
    types: dict[str, FieldModel | type[FieldModel]] = {}
    for model in models:
        field_model = model_type(model, options.get("preset", "quick")) if isinstance(model, str) else model
        name = model if isinstance(model, str) else model.name
        if types.setdefault(name, field_model) is not field_model:
            raise InputError(f"two candidates have the name {name!r}; give one of them another `name`")
    for option in options:
        if not any(field_model.supported({option: options[option]}) for field_model in types.values()):
            raise InputError(f"none of the candidates {', '.join(types)} has an option {option!r}; leave it out")
    return types


def _cross_validated(
    unfitted: FieldModel,
    measured: Spectra,
    fold: Tensor,
    parts: Iterable[tuple[tuple[int, ...], list[tuple[FieldModel, float]]]],
    device: torch.device | str,
) -> tuple[float, list[Fold], float]:
    """Return the trimmed mean PSNR [dB] of a candidate over held-out spectra, its scored folds, and the seconds.

    Args:
        unfitted: Candidate, which stays as it is.
        measured: Measured spectra.
        fold: Fold of each spectrum, (n,).
        parts: Folds that one search leaves out, and the models that were fitted without them.
        device: Device to compute on.
    """
    scored, psnr_db, seconds = [], [], 0.0
    for blind, fitted in parts:
        structure = None
        if unfitted.searches:
            structure, searching = _structure(unfitted, measured.subset(without(fold, *blind)), fitted, device)
            seconds += searching
        for number in blind:
            train, test = held_out(measured, fold, (number,))
            began = time.perf_counter()
            model = copy(unfitted)
            model.fit(train, like=structure, device=device)
            predicted = synthesized(model, test.position)
            seconds += time.perf_counter() - began
            scored.append(Fold(model, train, test))
            psnr_db.append(psnr(predicted, test.spectrum))
    return float(trim_mean(torch.cat(psnr_db).numpy(), 0.1)), scored, seconds  # without the highest and lowest tenth


def held_out(measured: Spectra, fold: Tensor, numbers: tuple[int, ...], most: int = 1000) -> tuple[Spectra, Spectra]:
    """Return the spectra outside of some folds, and at most `most` of those in them: more do not change the choice."""
    rows, *_ = subsample(torch.isin(fold, torch.tensor(numbers)).nonzero()[:, 0], rows=most)
    return measured.subset(without(fold, *numbers)), measured.subset(rows)


def blind_folds(measured: Spectra, validation: Validation, seed: int) -> tuple[Tensor, tuple[tuple[int, ...], ...]]:
    """Return the fold of each spectrum, and the folds that each structure search leaves out, none for too few spectra."""
    fold, n = folds(measured.position, validation, seed), len(measured)
    if all(len(without(fold, *blind)) >= MIN_TRAINING for blind in BLIND_FOLDS):
        return fold, BLIND_FOLDS
    if n <= MIN_TRAINING:
        return fold, ()
    number = max(FOLDS, math.ceil(n / (n - MIN_TRAINING)))
    return folds(measured.position, validation, seed, number), tuple((fold,) for fold in range(number))


def _structure(
    unfitted: FieldModel, measured: Spectra, searched: list[tuple[FieldModel, float]], device: torch.device | str
) -> tuple[FieldModel, float]:
    """Return a model fitted to these spectra whose structure the candidate can reuse, and the seconds of its fit.

    Models that are built on the same structure, such as a room, share one search: `searched` collects the fitted models.
    """
    for model, seconds in searched:
        if unfitted.accepts_like(model):
            return model, seconds
    began = time.perf_counter()
    model = copy(unfitted)
    model.fit(measured, device=device)
    searched.append((model, time.perf_counter() - began))
    return searched[-1]


def without(fold: Tensor, *numbers: int) -> Tensor:
    """Return the rows outside the folds of these numbers."""
    return (~torch.isin(fold, torch.tensor(numbers))).nonzero()[:, 0]
