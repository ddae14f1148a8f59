"""Turbo learning in one call, on spectra in memory."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from concurrent.futures import Executor
from dataclasses import replace
from itertools import zip_longest
from typing import Any

import torch

from augment.choices import AUTO
from augment.choose import candidates
from augment.cross_validation import LOCATOR, STAND_IN
from augment.estimators import Estimator
from augment.positions import Count
from augment.turbo.condition import CHOSEN, LOCATED, NETWORKS, Condition, MeasuredSubset, Row, Training
from augment.turbo.experiment import ROOM_MODEL, Experiment
from augment.turbo.results import TurboResult
from augment.turbo.stages import compare, decide_room, evaluate, find_room, hold_out, locate, synthesize
from swiftwrf.contrib.comparison.steps import Memo, Steps
from swiftwrf.data import Spectra
from swiftwrf.models import FieldModel
from swiftwrf.runtime.checkpoint import Saved
from swiftwrf.runtime.validation import NonNegativeInt, PositiveInt, Preset, checked


@checked
def turbo_learning(
    data: Spectra,
    *,
    measured: float = 0.3,
    split: str = "random",
    models: str | Sequence[str | FieldModel] = AUTO,
    estimators: Sequence[str | Estimator] | None = None,
    extra: Count | None = None,
    preset: Preset = "quick",
    repeats: PositiveInt = 1,
    seed: NonNegativeInt = 0,
    device: torch.device | str = "cpu",
    keep: Memo | None = None,
    executor: Executor | None = None,
) -> TurboResult:
    """Train estimators on few measured spectra, on these and synthetic ones, and on all, and compare their errors.

    A part of the training spectra counts as measured. Field models fitted to it predict spectra at the withheld positions
    and at extra ones. Errors are those on the test part of the split, which takes no part in any fit or choice.

    Args:
        data: Labelled spectra.
        measured: Fraction of the training spectra that counts as measured, in (0, 1].
        split: Split that comes with the data, or a seeded one: random or block.
        models: Field models of the synthetic spectra: names, models of your own, or "auto" for the one that predicts
            held-out measured spectra best.
        estimators: Estimators beside kernel regression: names such as "aann_kernel", or estimators of your own.
            Defaults to all, and to a comparison of all fast field models.
        extra: Number of extra synthetic positions. Defaults to 3,000 where cross-validation recommends some.
        preset: "quick", or "paper" for the sizes of the publication.
        repeats: Number of random measured subsets, whose errors are pooled.
        seed: Seed of everything random.
        device: Device to compute on.
        keep: Results by the names of steps, in a folder. A call with equal data, options, code of own classes and versions
            continues after them, others are refused.
        executor: Processes that compute steps side by side, e.g. a `ProcessPoolExecutor`.

    Raises:
        InputError: A split, name or fraction that does not exist, data that do not suffice, or `keep` of another call.
        FitError: A fit diverged.

    Source:
        M. Liu et al., "Deformable 2D Gaussian Splatting for Efficient Wireless Radiance Field Rendering", 2025: the case
        study on angle of arrival.

    Example:
        >>> import swiftwrf
        >>> data = swiftwrf.simulated_room(n=40, grid=swiftwrf.AngularGrid.hemisphere(10, 40))
        >>> result = turbo_learning(data, measured=0.5, models=["idw"], estimators=["peak"], extra=0)
        >>> bool(result.summary().loc["kernel_regression, measured", "median"] < result.summary().loc["peak", "median"])
        True
    """
    given = locals().copy()
    models = (models,) if isinstance(models, str) else models
    experiment = Experiment(
        *data.split(split, seed), (measured,), models, estimators, extra, preset, repeats, seed, device, split
    )
    if keep is not None:
        named = [experiment.model_type(name) for name in (*experiment.named, *experiment.candidates)]
        keep.of(given | {"field models": named, "evaluated": experiment.evaluated})
    return learn(experiment, keep or Memo(), executor)[0]


def learn(experiment: Experiment, keep: Memo, executor: Executor | None = None) -> list[TurboResult]:
    """Return the result of each measured fraction. Measured subsets are computed side by side."""
    steps, rehearsal = Steps(experiment, keep, executor), _Rehearsal(experiment)
    for some in (rehearsal, steps):
        results = {fraction: TurboResult(experiment, fraction, keep) for fraction in experiment.fractions}
        subsets = [
            _Learning(experiment, subset, some, results[subset.measured_fraction]) for subset in experiment.subsets
        ]
        for _ in zip_longest(*(subset.phases() for subset in subsets)):
            pass
        # one more for each fraction: the estimator that is recommended
        steps.expect(len(rehearsal.names) + len(results) if some is rehearsal else len(results))
    for subset in subsets:
        subset.collect()
    for result in results.values():
        if result.chosen is None or (condition := result.chosen[0]).method in result.files:
            continue
        if isinstance(experiment.make_estimator(condition.estimator, 0), Saved):
            title = f"training {condition.method}, which is recommended"
            steps[steps.start(f"chosen-{condition.result_name}", title, evaluate, condition, CHOSEN)]
            result.files[condition.method] = CHOSEN
    return list(results.values())


class _Rehearsal(Steps[Experiment]):
    """Steps that are counted and not computed, as if every search finds a room and extra positions are recommended."""

    def __init__(self, experiment: Experiment) -> None:
        chosen = [
            *(name for name in experiment.named if not experiment.model_type(name).slow),
            *candidates(experiment.train),
        ]
        self.names: set[str] = set()
        self.assumed = {
            "planes": True,
            "choice": {"name": chosen[0]},
            "cross_validation": {name: {"recommended_n_synthetic": 1} for name in chosen},
        }

    def start(self, name: str, *_: Any, **__: Any) -> str:
        self.names.add(name)
        return name

    def __getitem__(self, name: str) -> Row:
        return self.assumed


class _Learning:
    """Steps of one measured subset."""

    def __init__(
        self, experiment: Experiment, subset: MeasuredSubset, steps: Steps[Experiment], result: TurboResult
    ) -> None:
        self.experiment, self.subset, self.steps, self.result = experiment, subset, steps, result
        self.conditions: list[Condition] = []
        self.located = Condition(LOCATOR, "measured", "", 0, subset.measured_fraction, subset.repeat)
        self.choice = f"choice-{subset}"  # name of the step that compares field models
        self.held_out: list[str] = []  # names of the steps with errors on held-out spectra
        self.fast = [name for name in experiment.named if not experiment.model_type(name).slow]
        self.compares = bool(self.fast or not experiment.named)
        self.searches = ROOM_MODEL in experiment.candidates
        self.parts = experiment.parts(subset) if subset.repeat == 0 else []
        # the subset without folds that the room in it takes no notice of
        self.blind = self.parts if self.searches else []
        compared = [*experiment.candidates, *(self.fast or candidates(experiment.train))]
        if self.compares and any(map(experiment.finds_room, compared)):
            self.blind = [replace(subset, without=folds) for folds in experiment.blind_folds(subset)[1]]

    def phases(self) -> Iterator[None]:
        """Start all steps.

        Yield before each wait for values, so that other subsets start their steps.
        """
        self.begin()
        yield
        self.decide_rooms()
        yield
        self.use_rooms()
        yield
        self.compared = self.steps[self.choice] if self.compares else {}
        self.names = self.experiment.named or [self.compared["choice"]["name"]]
        validation = self.compared.get("cross_validation", {})
        trainings = {name: self.experiment.trainings(validation.get(name)) for name in self.names}
        self.predict(trainings)
        yield
        for name in self.names:
            self.steps[self.synthesis(name)]
            self.train_turbo(name, trainings[name])

    def titled(self, title: str) -> str:
        """Return the title of a step, with the measured fraction and the repeat where there are several."""
        of = f", {self.subset.measured_fraction:.0%} measured" if len(self.experiment.fractions) > 1 else ""
        return title + of + (f", repeat {self.subset.repeat + 1}" if self.experiment.repeats > 1 else "")

    def synthesis(self, name: str) -> str:
        """Return the name of the step in which a field model predicts spectra."""
        return f"synthesis_{name}-{self.subset}"

    def train(
        self,
        estimator: str,
        training: Training = "measured",
        extra: int = 0,
        synthesizer: str = "",
        *,
        saved: bool = False,
    ) -> Condition:
        """Start the training of an estimator, which is saved in the first repeat."""
        subset = self.subset
        condition = Condition(estimator, training, synthesizer, extra, subset.measured_fraction, subset.repeat)
        saved_as = None
        if saved and subset.repeat == 0:
            saved_as = condition.name if condition.is_turbo else f"{condition.name}-measured"
            self.result.files[condition.method] = saved_as
        # trainings on synthetic spectra begin last and take longest
        title = f"{'training and ' * (estimator in self.experiment.trainable)}testing {condition.method}"
        self.steps.start(
            condition.result_name, self.titled(title), evaluate, condition, saved_as, first=condition.is_turbo
        )
        return condition

    def hold(self, conditions: list[Condition], with_room: bool = False) -> None:
        """Start the comparison of conditions on held-out spectra."""
        if not self.parts:
            return
        rooms = [self.steps[self.room_of(part)] for part in self.parts if with_room]
        # the training of the paper's network takes too long to be repeated
        repeated = [one for one in conditions if not (one.is_network and self.experiment.preset == "paper")]
        first = conditions[0]
        name = f"held_out_{first.result_name}"
        title = self.titled(
            f"testing on held-out spectra, {first.training_set if first is not self.located else first.name}"
        )
        self.held_out.append(
            self.steps.start(name, title, hold_out, self.subset, repeated, rooms, first=first.is_turbo)
        )

    def find(self) -> str:
        """Start the search for the room in the measured spectra; return its name."""
        return self.steps.start(
            f"room-{self.subset}", self.titled("finding the room"), find_room, self.subset, first=True
        )

    def decide(self, part: MeasuredSubset) -> str:
        """Start the decision, without held-out spectra, which planes of the room exist; return its name."""
        title = (
            f"deciding without held-out spectra what is in the room, {self.blind.index(part) + 1} of {len(self.blind)}"
        )
        room = self.steps[self.find()]
        return self.steps.start(f"room-{part}", self.titled(title), decide_room, part, room, first=True)

    def room_of(self, part: MeasuredSubset) -> str:
        """Return the name of a decision without the spectra that a part holds out."""
        return self.decide(next(blind for blind in self.blind if set(part.without) <= set(blind.without)))

    def begin(self) -> None:
        """From the measured spectra alone: find the room, and train references."""
        if self.blind or self.searches:
            self.find()
        experiment = self.experiment
        usable = [name for name in experiment.evaluated if name not in experiment.lacking]
        self.conditions = [self.train(name, saved=name == STAND_IN) for name in usable]
        self.full = [self.train(name, "all measured") for name in experiment.trainable]
        self.hold(self.conditions)

    def decide_rooms(self) -> None:
        """Decide without each of the held-out folds what is in the room."""
        for part in self.blind:
            self.decide(part)

    def use_rooms(self) -> None:
        """Compare field models, and locate held-out spectra and test spectra by the room."""
        if self.compares:
            rooms = [self.steps[self.decide(part)] for part in self.blind]
            title = self.titled("comparing field models")
            self.steps.start(self.choice, title, compare, self.subset, self.fast, rooms, first=True)
        if self.searches and all(self.steps[self.room_of(part)].get("planes") for part in self.parts):
            self.hold([self.located], with_room=True)
        if self.searches and (room := self.steps[self.find()]).get("planes"):
            self.steps.start(self.located.result_name, self.titled(f"locating by {LOCATED}"), locate, self.subset, room)

    def predict(self, trainings: dict[str, list[tuple[Training, int]]]) -> None:
        """Predict spectra by the field models that were asked for or chosen, and by others for comparison."""
        self.models = dict.fromkeys((*trainings, *self.experiment.candidates))
        for name in sorted(self.models, key=self.experiment.finds_room):
            room = self.steps[self.find()] if self.experiment.finds_room(name) else None
            extra = trainings[name][-1][1] if name in trainings else None
            title = self.titled(f"synthesizing spectra by {name}")
            self.steps.start(
                self.synthesis(name), title, synthesize, self.subset, name, extra, room, first=name in trainings
            )

    def train_turbo(self, name: str, trainings: list[tuple[Training, int]]) -> None:
        """Train estimators on measured spectra and on synthetic ones of a field model."""
        experiment, kept = self.experiment, (*NETWORKS.values(), STAND_IN)
        turbo: list[Condition] = []
        for training, extra in trainings:
            is_last = (training, extra) == trainings[-1]
            turbo += [
                self.train(one, training, extra, name, saved=is_last and experiment.is_first(name) and one in kept)
                for one in experiment.trainable
                if is_last or one not in NETWORKS.values()  # whose training takes most of the time
            ]
        self.conditions += turbo
        if not experiment.model_type(name).slow:
            self.hold(turbo, experiment.finds_room(name))

    def collect(self) -> None:
        """Add the values of all steps to the result."""
        steps, result = self.steps, self.result
        for name in self.models:
            result.add_synthesis(self.subset, name, name in self.names, steps[self.synthesis(name)])
        for condition in self.conditions:
            result.add(condition, steps[condition.result_name])
        if self.searches:
            room = steps[self.find()]
            refused = {"refused": room.get("refused", "no plane explains the spectra")}
            result.add(self.located, steps[self.located.result_name] if room.get("planes") else refused)
        for condition in self.full:
            result.add(condition, steps[condition.result_name])
        if self.subset.repeat == 0:
            result.compared = self.compared
        for name in self.held_out:
            result.held_out |= steps[name]["errors"]
