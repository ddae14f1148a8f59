"""Stages of turbo learning, each from the data and from files of earlier ones: plain values, and files for later stages."""

from __future__ import annotations

import time
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import cast

import torch
from torch import Tensor

from augment.choose import choose_model
from augment.cross_validation import LOCATOR, cross_validate, degrees
from augment.estimators.base import estimated
from augment.mix import Mixed, mix
from augment.positions import SyntheticPositions, synthetic_positions
from augment.turbo.artifacts import as_bytes, model_file, save_examples, save_located, save_model
from augment.turbo.condition import Condition, MeasuredSubset, Row
from augment.turbo.experiment import ROOM_MODEL, Experiment
from swiftwrf import FitError, GeometryModel, InputError, Spectra, load
from swiftwrf.contrib.comparison.steps import STEPS
from swiftwrf.data.store import Store
from swiftwrf.locate import MatchedField, MatchedFieldConfig, Posterior
from swiftwrf.metrics import LEVEL, l1, psnr, ssim
from swiftwrf.models import FieldModel
from swiftwrf.models.base import synthesized
from swiftwrf.runtime.checkpoint import Saved, read, write

KIND = "synthetic spectra"
SCORE = {"psnr_db": psnr, "ssim": ssim, "l1": l1}
BATCH_POSITIONS = 4096  # spectra predicted before they are rounded: half a gigabyte of 90 x 360 pixels
BATCH_SPECTRA = 256  # spectra located at a time: a posterior has a thousand candidates
# where all methods are compared on held-out spectra: half the time of the defaults, and a third of the extra positions
HELD_OUT_LOCATOR = MatchedFieldConfig(n_calibration=40, max_cells=100_000, spacing=0.2)
MAX_HELD_OUT_EXTRA = 1000


def _file(name: str) -> str:
    return f"{STEPS}/{name}.safetensors"


def compare(experiment: Experiment, folder: Path, subset: MeasuredSubset, compared: list[str], rooms: list[Row]) -> Row:
    """Compare field models on held-out measured spectra, and determine whether turbo learning helps.

    Args:
        experiment: Data and options.
        folder: Folder of the files.
        subset: Measured spectra.
        compared: Names of field models. Empty for all that are fast and whose requirements the data meet.
        rooms: Results of `decide_room` without the folds that are predicted.
    """
    measured, _ = experiment.withhold(subset)
    seed = experiment.seed + subset.repeat
    models = [experiment.own_models.get(name, name) for name in compared]
    # a search that was refused is repeated, so that the models that need it are left out with its reason
    structures = [(_read_room(folder, room["file"]), room["seconds"]) for room in rooms if "file" in room]
    structures = structures if len(structures) == len(rooms) else []
    try:
        choice = choose_model(measured, models or None, seed=seed, device=experiment.device, structures=structures)
    except InputError:
        if not compared:
            raise
        # field models asked for by name need no comparison
        return {"choice": None, "cross_validation": {}}
    trained = [name for name in compared if name in choice.folds] or [choice.name]
    return {
        "choice": {name: value for name, value in vars(choice).items() if name != "folds"},
        "cross_validation": {
            name: cross_validate(choice.folds[name], experiment.n_synthetic, seed) for name in trained
        },
    }


def hold_out(
    experiment: Experiment, folder: Path, subset: MeasuredSubset, conditions: list[Condition], rooms: list[Row]
) -> Row:
    """Return the angular errors [deg] of conditions on held-out measured spectra, by method; none if a fit is refused.

    Args:
        experiment: Data and options.
        folder: Folder of the files.
        subset: Measured spectra, whose `parts` hold some out.
        conditions: Conditions with one field model, or without any.
        rooms: Results of `decide_room` for the parts, if the field model or the locator is built on a room.
    """
    seed, synthesizer = experiment.seed + subset.repeat, conditions[0].synthesizer
    extra = min(max(condition.n_synthetic for condition in conditions), MAX_HELD_OUT_EXTRA)
    errors: dict[str, list[float]] = {condition.method: [] for condition in conditions}
    for number, part in enumerate(experiment.parts(subset)):
        (measured, withheld), test = experiment.withhold(part), experiment.held_out(part)[1]
        room = _read_room(folder, rooms[number]["file"]) if rooms and "file" in rooms[number] else None
        train = {"measured": Mixed.measured(measured)}
        try:
            if synthesizer:
                model = experiment.make_model(synthesizer, subset.repeat)
                model.fit(measured, like=room, device=experiment.device)
                predict = partial(synthesized, model)
                mixed = mix(measured, withheld, _as_bytes_at(withheld.position, predict))
                train["measured + synthetic"] = train["measured + synthetic + extra"] = mixed
            if extra:
                positions = synthetic_positions(measured, extra, seed)
                mixed = mixed.add(positions, _as_bytes_at(positions.position, predict))
                train["measured + synthetic + extra"] = mixed
            for condition in conditions:
                if condition.estimator == LOCATOR:
                    estimate = MatchedField(HELD_OUT_LOCATOR, seed=seed).fit(measured, room=room).predict(test)
                else:
                    estimator = experiment.make_estimator(condition.estimator, subset.repeat)
                    estimator.fit(train[condition.training], device=experiment.device)
                    estimate = estimated(estimator, test)
                errors[condition.method] += degrees(estimate, test.label).tolist()
        except (InputError, FitError):
            return {"errors": {}}
    return {"errors": errors}


def find_room(experiment: Experiment, folder: Path, subset: MeasuredSubset) -> Row:
    """Find the room in the measured spectra, once for all field models that are built on it and for the locator.

    Args:
        experiment: Data and options.
        folder: Folder of the files.
        subset: Measured spectra.
    """
    model = experiment.make_model(ROOM_MODEL, subset.repeat)
    return _keep_room(experiment, folder, subset, partial(model.fit, device=experiment.device, progress=True))


def decide_room(experiment: Experiment, folder: Path, subset: MeasuredSubset, room: Row) -> Row:
    """Decide without held-out spectra which planes of the room exist, where, and what stands in it.

    Args:
        experiment: Data and options.
        folder: Folder of the files.
        subset: Measured spectra, of which some are held out.
        room: Result of `find_room` with all of them.
    """
    return (
        _keep_room(experiment, folder, subset, _read_room(folder, room["file"]).decided_on) if "file" in room else room
    )


def _keep_room(
    experiment: Experiment, folder: Path, subset: MeasuredSubset, room_of: Callable[[Spectra], FieldModel]
) -> Row:
    measured, _ = experiment.withhold(subset)
    began = time.perf_counter()
    try:
        model = room_of(measured)
    except (InputError, FitError) as error:
        return {"refused": str(error)}
    file = _file(f"room-{subset}")
    model.save(folder / file)
    planes = len(model.room.planes) if model.room else 0
    return {"seconds": time.perf_counter() - began, "planes": planes, "file": file}


def _read_room(folder: Path, file: str) -> GeometryModel:
    room = load(folder / file)
    assert isinstance(room, GeometryModel)
    return room


def synthesize(
    experiment: Experiment, folder: Path, subset: MeasuredSubset, name: str, extra: int | None, room: Row | None
) -> Row:
    """Predict spectra by one field model at test, withheld and extra synthetic positions.

    Args:
        experiment: Data and options.
        folder: Folder of the files.
        subset: Measured spectra.
        name: Name of the field model.
        extra: Number of extra synthetic positions. None for a model that is only compared: it predicts at the test positions
            alone, and without a fit the reason is returned.
        room: Result of `find_room`, which the model reuses. The time of the search counts as part of the fit.
    """
    measured, withheld = experiment.withhold(subset)
    trains = extra is not None
    records: list[Row] = []
    began, earlier = time.perf_counter(), 0.0  # seconds that interrupted calls spent on the fit

    def add(record: Row) -> None:
        nonlocal earlier
        records.append(record)
        earlier = max(earlier, record.get("elapsed", 0.0) - (time.perf_counter() - began))

    synthesis = f"synthesis_{name}-{subset}"
    try:
        # models that are only compared are as small as in the choice
        model = experiment.make_model(name, subset.repeat, experiment.preset if trains else "quick")
        model.fit(
            measured,
            # without a room the models refuse the spectra themselves
            like=_read_room(folder, room["file"]) if room and "file" in room else None,
            device=experiment.device,
            checkpoint=folder / STEPS / f"{synthesis}-fit.safetensors",
            on_record=add,
            progress=True,
        )
        fitted = time.perf_counter()
        predict = partial(synthesized, model)
        test = _as_bytes_at(experiment.test.position, predict)
    except (InputError, FitError) as error:
        if trains:
            raise
        return {"refused": str(error)}
    tested = time.perf_counter()
    parts = {"withheld": withheld} if trains else {}
    if extra:
        parts["extra"] = synthetic_positions(measured, extra, experiment.seed + subset.repeat)
    tensors = {}
    for part, positions in parts.items():
        tensors[part] = _as_bytes_at(positions.position, predict)
        tensors |= {f"{part}_{key}": tensor for key, tensor in vars(positions).items()}
    seconds = {
        "fit": fitted - began + earlier + (room or {}).get("seconds", 0.0),
        "synthesize": tested - fitted,
        "draw": time.perf_counter() - fitted,
    }
    scores = _scores(Store(test), experiment.test.store)
    if trains:
        write(folder / _file(synthesis), KIND, tensors, {})
        if subset.repeat == 0:
            save_model(model, subset.key, measured, folder)
            if experiment.is_first(name):
                _save_examples(
                    experiment, folder / f"examples-mix{subset.key}.npz", model, name, test, scores["psnr_db"]
                )
    return {"history": records, "seconds": seconds, "scores": scores}


def _scores(predicted: Store, measured: Store) -> dict[str, Tensor]:
    """Return the scores (n,) of predicted spectra by name."""
    pairs = zip(predicted.batches(), measured.batches(), strict=True)
    scored = [[function(*pair) for function in SCORE.values()] for pair in pairs]
    return {key: torch.cat(batches) for key, batches in zip(SCORE, zip(*scored, strict=True), strict=True)}


def _save_examples(
    experiment: Experiment, file: Path, model: FieldModel, name: str, predicted: Tensor, psnr_db: Tensor
) -> None:
    """Save measured and predicted test spectra, with the standard deviations of a model that has some."""
    std = None
    if model.predict(experiment.test.position[:1]).std is not None:
        std = _as_bytes_at(experiment.test.position, lambda at: cast(Tensor, model.predict(at).std))
    save_examples(file, name, experiment.test, predicted, psnr_db, std)


def _as_bytes_at(position: Tensor, predict: Callable[[Tensor], Tensor]) -> Tensor:
    """Return predicted spectra at positions (n, 3), rounded in batches."""
    return torch.cat([as_bytes(predict(some).cpu()) for some in position.split(BATCH_POSITIONS)])


def training_set(experiment: Experiment, folder: Path, condition: Condition) -> Mixed:
    """Return the spectra that train the estimator of a condition."""
    if condition.training == "all measured":
        return Mixed.measured(experiment.train)
    measured, _ = experiment.withhold(condition.subset)
    if not condition.is_turbo:
        return Mixed.measured(measured)
    file = folder / _file(f"synthesis_{condition.synthesizer}-{condition.subset}")
    tensors = read(file, KIND)[1]

    def part(name: str) -> tuple[SyntheticPositions, Tensor]:
        return SyntheticPositions(*(tensors[f"{name}_{key}"] for key in ("position", "label", "index"))), tensors[name]

    train = mix(measured, *part("withheld"))
    return train.add(*part("extra")) if condition.n_synthetic else train


def evaluate(experiment: Experiment, folder: Path, condition: Condition, saved_as: str | None) -> Row:
    """Train the estimator of a condition, save it under a name if it has one, and estimate the test directions."""
    train = training_set(experiment, folder, condition)
    began = time.perf_counter()
    estimator = experiment.make_estimator(condition.estimator, condition.repeat)
    estimator.fit(train, device=experiment.device)
    fitted = time.perf_counter()
    estimate = estimated(estimator, experiment.test)
    if isinstance(estimator, Saved) and saved_as is not None:
        estimator.save(model_file(folder, saved_as, condition.subset.key))
    seconds = {"train": fitted - began, "estimate": time.perf_counter() - fitted}
    return {"estimate": estimate, "seconds": seconds, "history": estimator.history, "counts": train.counts}


def locate(experiment: Experiment, folder: Path, subset: MeasuredSubset, room: Row) -> Row:
    """Locate the moving end from the test spectra by the room that was found; their directions follow."""
    measured, _ = experiment.withhold(subset)
    test = experiment.test
    began = time.perf_counter()
    try:
        locator = MatchedField(seed=experiment.seed + subset.repeat).fit(
            measured, room=_read_room(folder, room["file"])
        )
    except (InputError, FitError) as error:
        return {"refused": str(error)}
    fitted = time.perf_counter()
    parts = [located(locator, test.subset(rows)) for rows in torch.arange(len(test)).split(BATCH_SPECTRA)]
    columns = {name: torch.cat([part[name] for part in parts]) for name in parts[0]}
    ended = time.perf_counter()
    if subset.repeat == 0:
        locator.save(model_file(folder, LOCATOR, subset.key))
        save_located(folder / f"located-mix{subset.key}.npz", locator, measured, test, columns["position"])
    seconds = {"room": room["seconds"], "fit": fitted - began, "locate": ended - fitted}
    return {
        "estimate": columns.pop("estimate"),
        "located": columns | {"weights": locator.weight, "seconds": seconds},
        "seconds": {"train": seconds["room"] + seconds["fit"], "estimate": seconds["locate"]},
        "history": [],
        "counts": Mixed.measured(measured).counts,
    }


def located(locator: MatchedField, test: Spectra) -> dict[str, Tensor]:
    """Return position and direction by the posteriors of test spectra.

    Returns:
        estimate: Azimuth and elevation (n, 2) [rad].
        position: Posterior median (n, 3) [m].
        radius: Radius of the 80 % credible region (n,) [m].
        level: Smallest level whose credible region contains the true position, (n,).
        ambiguous: True where a second mode has much of the posterior mass, (n,).
    """
    posterior = locator.locate(test)
    position = posterior.median
    return {
        "estimate": locator.direction(posterior),
        "position": position,
        "radius": posterior.credible_radius(LEVEL),
        "level": containing_level(posterior, test.position),
        "ambiguous": posterior.ambiguous,
    }


def containing_level(posterior: Posterior, truth: Tensor) -> Tensor:
    """Return the smallest level (n,) whose credible region, a ball around the median, contains the position (n, 3) [m].

    Example:
        >>> at = torch.tensor([[[0.0, 0, 0], [1.0, 0, 0]]], dtype=torch.float64)
        >>> posterior = Posterior(at, torch.tensor([[0.75, 0.25]], dtype=torch.float64).log())
        >>> containing_level(posterior, torch.tensor([[0.5, 0, 0]], dtype=torch.float64))
        tensor([0.7500], dtype=torch.float64)
    """
    median = posterior.median
    # the inverse of the credible radius
    error = (truth - median).norm(dim=1) / posterior.inflation - posterior.resolution_m / 4
    inside = (posterior.position - median[:, None]).norm(dim=2) < error[:, None]
    level: Tensor = (posterior.weight * inside).sum(dim=1)
    return level
