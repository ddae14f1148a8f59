"""Steps of turbo learning: the room is found, field models predict spectra, and estimators are trained and tested."""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import cast

import torch
from torch import Tensor

from augment.cross_validation import STAND_IN, CrossValidationMetrics
from augment.estimators import SavedEstimator
from augment.mix import Mixed, mix
from augment.positions import SyntheticPositions, synthetic_positions
from augment.turbo.artifacts import save_artifacts
from augment.turbo.condition import MEASURED_STAND_IN, NETWORKS, Condition, MeasuredSubset, Row, Training
from augment.turbo.experiment import ROOM_MODEL, Experiment
from augment.turbo.locating import Locating
from swiftwrf import FitError, InputError, Spectra, load
from swiftwrf.choices import AUTO
from swiftwrf.data.store import Store
from swiftwrf.metrics import l1, psnr, ssim
from swiftwrf.models import FieldModel
from swiftwrf.runtime.checkpoint import read, write
from swiftwrf.runtime.steps import STEPS, Step

KIND = "synthetic spectra"
SCORE = {"psnr_db": psnr, "ssim": ssim, "l1": l1}
BATCH_POSITIONS = 4096  # spectra predicted before they are rounded: half a gigabyte of 90 x 360 pixels


def syntheses(
    experiment: Experiment,
    subset: MeasuredSubset,
    names: Sequence[str],
    validation: Mapping[str, CrossValidationMetrics],
) -> list[Step[Experiment]]:
    """Return the syntheses whose spectra are trained on, and those for comparison; models with a room follow its search."""
    direct: list[Step[Experiment]] = []
    with_room: list[Synthesis] = []
    for name in dict.fromkeys((*names, *experiment.candidates)):
        trains = name in names
        synthesis = Synthesis(subset, name, trains, experiment.n_extra(validation.get(name)) if trains else 0)
        (with_room if experiment.finds_room(name) else direct).append(synthesis)
    search: list[Step[Experiment]] = []
    if with_room:
        search.append(RoomSearch(subset, tuple(with_room)))
    return search + direct if with_room and with_room[0].trains else direct + search


@dataclass(frozen=True)
class RoomSearch(Step[Experiment]):
    """Find the room in the measured spectra, once for all field models that are built on it and for the locator.

    Args:
        subset: Measured spectra.
        syntheses: Steps of these models.
        locates: Whether matched-field processing locates the test spectra by the room.
    """

    subset: MeasuredSubset
    syntheses: tuple[Synthesis, ...]
    locates: bool = False

    title = "finding the room"

    @property
    def name(self) -> str:
        return f"room-{self.subset}"

    @property
    def file(self) -> str:
        """File of the fitted model in the run's directory."""
        return f"{STEPS}/{self.name}.safetensors"

    def compute(self, experiment: Experiment, folder: Path) -> Row:
        measured, _ = experiment.withhold(self.subset)
        began = time.perf_counter()
        try:
            model = experiment.make_model(ROOM_MODEL, self.subset).fit(
                measured, device=experiment.device, progress=True
            )
        except (InputError, FitError) as error:
            return {"refused": str(error)}
        model.save(folder / self.file)
        return {"seconds": time.perf_counter() - began, "planes": len(model.room.planes) if model.room else 0}

    def then(self, experiment: Experiment, value: Row) -> Sequence[Step[Experiment]]:
        found = None if "refused" in value else self  # without a room the models refuse the spectra themselves
        seconds = value.get("seconds", 0.0)
        steps: list[Step[Experiment]] = [replace(one, room=found, room_seconds=seconds) for one in self.syntheses]
        if self.locates and value.get("planes"):
            steps.append(Locating(self.subset, self.file, seconds))
        return steps


@dataclass(frozen=True)
class Synthesis(Step[Experiment]):
    """Predict spectra by one field model at test, withheld and extra positions.

    Args:
        subset: Measured spectra.
        synthesizer: Name of the field model.
        trains: Whether its spectra train estimators. Otherwise it predicts at the test positions alone, for comparison.
        n_synthetic: Number of extra synthetic positions.
        room: Search for the room that the model reuses, if any.
        room_seconds: Time of that search [s], which counts as part of the fit.
    """

    subset: MeasuredSubset
    synthesizer: str
    trains: bool
    n_synthetic: int
    room: RoomSearch | None = None
    room_seconds: float = 0.0

    @property
    def name(self) -> str:
        return f"synthesis_{self.synthesizer}-{self.subset}"

    @property
    def title(self) -> str:
        return f"synthesizing spectra by {self.synthesizer}"

    @property
    def file(self) -> str:
        """File of the spectra in the run's directory."""
        return f"{STEPS}/{self.name}.safetensors"

    def test_spectra(self, folder: Path) -> dict[str, Store]:
        """Return the spectra at the test positions: `test`, and `test_std` if the model has it."""
        tensors = read(folder / self.file, KIND)[1]
        return {name: Store(tensor) for name, tensor in tensors.items() if name.startswith("test")}

    def training_spectra(self, folder: Path, part: str) -> tuple[SyntheticPositions, Tensor]:
        """Return positions and spectra of a part, `withheld` or `extra`, as they were synthesized together."""
        tensors = read(folder / self.file, KIND)[1]
        positions = (tensors[f"{part}_{name}"] for name in ("position", "label", "index"))
        return SyntheticPositions(*positions), tensors[part]

    def compute(self, experiment: Experiment, folder: Path) -> Row:
        try:
            return self._synthesize(experiment, folder)
        except (InputError, FitError) as error:
            if self.trains:
                raise
            return {"refused": str(error)}

    def _synthesize(self, experiment: Experiment, folder: Path) -> Row:
        measured, withheld = experiment.withhold(self.subset)
        history = _FitHistory()
        model = self._fitted(experiment, measured, history, folder)
        fitted = time.perf_counter()

        def std(position: Tensor) -> Tensor:
            return cast(Tensor, model.predict(position).std)

        test = experiment.test.position
        tensors = {"test": _as_bytes_at(test, model.synthesize)}
        tested = time.perf_counter()
        if model.predict(test[:1]).std is not None:
            tensors["test_std"] = _as_bytes_at(test, std)
        parts = {"withheld": withheld} if self.trains else {}
        if self.n_synthetic:
            parts["extra"] = synthetic_positions(measured, self.n_synthetic, experiment.seed_of(self.subset))
        for part, positions in parts.items():
            tensors[part] = _as_bytes_at(positions.position, model.synthesize)
            tensors |= {f"{part}_{name}": tensor for name, tensor in vars(positions).items()}
        seconds = {
            "fit": fitted - history.began + history.earlier + self.room_seconds,
            "synthesize": tested - fitted,
            "draw": time.perf_counter() - fitted,
        }
        write(folder / self.file, KIND, tensors, {})
        scores = _scores(tensors["test"], experiment.test)
        if self.trains and self.subset.repeat == 0:
            save_artifacts(model, self.subset.key, measured, experiment.test, folder)
        return {"history": history.records, "seconds": seconds, "scores": scores}

    def _fitted(self, experiment: Experiment, measured: Spectra, history: _FitHistory, folder: Path) -> FieldModel:
        # models that are only compared are as small as in the choice
        preset = experiment.preset if self.trains else "quick"
        room = load(folder / self.room.file) if self.room else None
        assert room is None or isinstance(room, FieldModel)
        history.begin()
        return experiment.make_model(self.synthesizer, self.subset, preset).fit(
            measured,
            like=room,
            device=experiment.device,
            checkpoint=folder / STEPS / f"{self.name}-fit.safetensors",
            on_record=history.add,
            progress=True,
        )

    def then(self, experiment: Experiment, value: Row) -> Sequence[Step[Experiment]]:
        trainings: list[tuple[Training, int]] = [("measured + synthetic", 0)] if self.trains else []
        if self.n_synthetic:
            trainings.append(("measured + synthetic + extra", self.n_synthetic))
        fraction, repeat = self.subset.measured_fraction, self.subset.repeat
        return [
            Evaluation(Condition(estimator, training, self.synthesizer, number, fraction, repeat), self)
            for training, number in trainings
            for estimator in experiment.trainable
            # a training of the network takes most of the time
            if training == trainings[-1][0] or estimator not in NETWORKS.values()
        ]


@dataclass(frozen=True)
class Evaluation(Step[Experiment]):
    """Train and test one condition.

    Args:
        condition: Estimator and training set.
        synthesis: Step of the synthetic spectra, if there are any.
    """

    condition: Condition
    synthesis: Synthesis | None = None

    @property
    def subset(self) -> MeasuredSubset:
        """Measured spectra of the condition."""
        return self.condition.subset

    @property
    def name(self) -> str:
        return self.condition.result_name

    @property
    def title(self) -> str:
        return self.condition.method

    @property
    def priority(self) -> int:
        return int(self.condition.is_network)

    def compute(self, experiment: Experiment, folder: Path) -> Row:
        train = self.training_set(experiment, folder)
        began = time.perf_counter()
        estimator = experiment.make_estimator(self.condition.estimator, self.subset)
        estimator.fit(train, device=experiment.device)
        fitted = time.perf_counter()
        estimate = estimator.estimate(experiment.test)
        if isinstance(estimator, SavedEstimator) and (file := self._saved_as(experiment)):
            estimator.save(folder / f"{file}-mix{self.subset.key}.safetensors")
        seconds = {"train": fitted - began, "estimate": time.perf_counter() - fitted}
        return {"estimate": estimate, "seconds": seconds, "history": estimator.history, "counts": train.counts}

    def _saved_as(self, experiment: Experiment) -> str:
        """Return the file name of a condition that a user may choose, empty for the others.

        These have all spectra of the first field model, or are the measured-only candidate of the cross-validation.
        """
        if self.subset.repeat:
            return ""
        if self.synthesis is None:
            alone = self.condition.estimator == STAND_IN and self.condition.training == "measured"
            return MEASURED_STAND_IN if alone else ""
        first = experiment.models[0] in (AUTO, self.synthesis.synthesizer)
        is_complete = self.condition.n_synthetic == self.synthesis.n_synthetic
        return self.condition.name if first and is_complete else ""

    def training_set(self, experiment: Experiment, folder: Path) -> Mixed:
        """Return the spectra that train the estimator."""
        if self.condition.training == "all measured":
            return Mixed.measured(experiment.train)
        measured, _ = experiment.withhold(self.subset)
        if self.synthesis is None:
            return Mixed.measured(measured)
        train = mix(measured, *self.synthesis.training_spectra(folder, "withheld"))
        if self.condition.training == "measured + synthetic + extra":
            train = train.add(*self.synthesis.training_spectra(folder, "extra"))
        return train


class _FitHistory:
    """Records of a fit, and the seconds that earlier sessions of the run spent on it."""

    def __init__(self) -> None:
        self.records: list[Row] = []
        self.began = self.earlier = 0.0

    def begin(self) -> None:
        """Start the clock."""
        self.began = time.perf_counter()

    def add(self, record: Row) -> None:
        """Append a record; those of earlier sessions come first."""
        self.records.append(record)
        self.earlier = max(self.earlier, record.get("elapsed", 0.0) - (time.perf_counter() - self.began))


def _scores(predicted: Tensor, test: Spectra) -> dict[str, Tensor]:
    """Return the scores of predicted test spectra, (n,) each."""
    pairs = zip(Store(predicted).batches(), test.store.batches(), strict=True)
    scored = [[function(*pair) for function in SCORE.values()] for pair in pairs]
    return {name: torch.cat(parts) for name, parts in zip(SCORE, zip(*scored, strict=True), strict=True)}


def _as_bytes_at(position: Tensor, predict: Callable[[Tensor], Tensor]) -> Tensor:
    """Return predicted spectra at positions (n, 3), rounded in batches."""
    return torch.cat([as_bytes(predict(some).cpu()) for some in position.split(BATCH_POSITIONS)])


def as_bytes(spectrum: Tensor) -> Tensor:
    """Return magnitudes in 256 steps, the resolution of spectra stored as images."""
    return (spectrum.clamp(0, 1) * 255).round().to(torch.uint8)
