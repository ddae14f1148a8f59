"""Turbo learning in one call, on spectra in memory."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from concurrent.futures import Executor
from dataclasses import replace
from itertools import zip_longest

import torch

from augment.choices import AUTO
from augment.choose import candidates
from augment.cross_validation import LOCATOR, STAND_IN
from augment.estimators import Estimator
from augment.positions import Count
from augment.turbo.condition import CHOSEN, LOCATED, NETWORKS, Condition, MeasuredSubset, Training
from augment.turbo.experiment import ROOM_MODEL, Experiment
from augment.turbo.results import TurboResult
from augment.turbo.stages import compare, evaluate, find_room, hold_out, locate, synthesize
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
    steps = Steps(experiment, keep, executor)
    results = {fraction: TurboResult(experiment, fraction, keep) for fraction in experiment.fractions}
    subsets = [_learn(experiment, one, steps, results[one.measured_fraction]) for one in experiment.subsets]
    for _ in zip_longest(*subsets):
        pass
    for result in results.values():
        if result.chosen is None or (condition := result.chosen[0]).method in result.files:
            continue
        if isinstance(experiment.make_estimator(condition.estimator, 0), Saved):
            title = f"{condition.method}, which is recommended"
            steps[steps.start(f"chosen-{condition.result_name}", title, evaluate, condition, CHOSEN)]
            result.files[condition.method] = CHOSEN
    return list(results.values())


def _learn(
    experiment: Experiment, subset: MeasuredSubset, steps: Steps[Experiment], result: TurboResult
) -> Iterator[None]:
    """Add the results of a measured subset. Yield before each wait for values, so that other subsets start their steps."""

    def train(
        estimator: str, training: Training = "measured", extra: int = 0, synthesizer: str = "", *, saved: bool = False
    ) -> Condition:
        condition = Condition(estimator, training, synthesizer, extra, subset.measured_fraction, subset.repeat)
        saved_as = None
        if saved and subset.repeat == 0:
            saved_as = condition.name if condition.is_turbo else f"{condition.name}-measured"
            result.files[condition.method] = saved_as
        # trainings on synthetic spectra begin last and take longest
        steps.start(condition.result_name, condition.method, evaluate, condition, saved_as, first=condition.is_turbo)
        return condition

    def hold(conditions: list[Condition], with_room: bool = False) -> None:
        if parts:
            rooms = [steps[room_of(part)] for part in parts if with_room]
            # the training of the paper's network takes too long to be repeated
            repeated = [one for one in conditions if not (one.is_network and experiment.preset == "paper")]
            name, title = f"held_out_{conditions[0].result_name}", f"held-out spectra, {conditions[0].training_set}"
            first = conditions[0].is_turbo
            held_out.append(steps.start(name, title, hold_out, subset, repeated, rooms, first=first))

    # from the measured spectra alone: the room is found, with and without held-out folds, and references are trained
    fast = [name for name in experiment.named if not experiment.model_type(name).slow]
    is_compared = bool(fast or not experiment.named)
    searches = ROOM_MODEL in experiment.candidates
    compared_models = [*experiment.candidates, *(fast or candidates(experiment.train))]
    parts = experiment.parts(subset) if subset.repeat == 0 else []
    blind = parts if searches else []
    if is_compared and any(map(experiment.finds_room, compared_models)):
        blind = [replace(subset, without=some) for some in experiment.blind_folds(subset)[1]]

    def find(some: MeasuredSubset = subset) -> str:
        return steps.start(f"room-{some}", "finding the room", find_room, some, first=True)

    def room_of(part: MeasuredSubset) -> str:
        return find(next(some for some in blind if set(part.without) <= set(some.without)))

    for part in blind:
        find(part)
    if searches:
        find()
    conditions = [
        train(name, saved=name == STAND_IN) for name in experiment.evaluated if name not in experiment.lacking
    ]
    full = [train(name, "all measured") for name in experiment.trainable]
    held_out: list[str] = []
    hold(conditions)

    yield
    # field models are compared; held-out spectra and test spectra are located by the room
    choice = f"choice-{subset}"
    if is_compared:
        found = [steps[find(part)] for part in blind]
        steps.start(choice, "comparing field models", compare, subset, fast, found, first=True)
    located = Condition(LOCATOR, "measured", "", 0, subset.measured_fraction, subset.repeat)
    if searches and all(steps[room_of(part)].get("planes") for part in parts):
        hold([located], with_room=True)
    if searches and steps[find()].get("planes"):
        steps.start(located.result_name, LOCATED, locate, subset, steps[find()])

    yield
    # the field models that were asked for or chosen, and others for comparison, predict spectra
    compared = steps[choice] if is_compared else {}
    names = experiment.named or [compared["choice"]["name"]]
    trainings = {name: experiment.trainings(compared.get("cross_validation", {}).get(name)) for name in names}
    models = dict.fromkeys((*names, *experiment.candidates))
    for name in sorted(models, key=experiment.finds_room):
        room = None
        if experiment.finds_room(name):
            room = steps[find()]
        extra = trainings[name][-1][1] if name in names else None
        title = f"synthesizing spectra by {name}"
        steps.start(f"synthesis_{name}-{subset}", title, synthesize, subset, name, extra, room, first=name in names)

    yield
    # estimators are trained on measured and synthetic spectra
    kept = (*NETWORKS.values(), STAND_IN)
    for name in names:
        steps[f"synthesis_{name}-{subset}"]
        turbo: list[Condition] = []
        for training, extra in trainings[name]:
            is_last = (training, extra) == trainings[name][-1]
            turbo += [
                train(one, training, extra, name, saved=is_last and experiment.is_first(name) and one in kept)
                for one in experiment.trainable
                if is_last or one not in NETWORKS.values()  # whose training takes most of the time
            ]
        conditions += turbo
        if not experiment.model_type(name).slow:
            hold(turbo, experiment.finds_room(name))

    yield
    for name in models:
        result.add_synthesis(subset, name, name in names, steps[f"synthesis_{name}-{subset}"])
    for condition in conditions:
        result.add(condition, steps[condition.result_name])
    if searches:
        room = steps[find()]
        refused = {"refused": room.get("refused", "no plane explains the spectra")}
        result.add(located, steps[located.result_name] if room.get("planes") else refused)
    for condition in full:
        result.add(condition, steps[condition.result_name])
    if subset.repeat == 0:
        result.compared = compared
    for name in held_out:
        result.held_out |= steps[name]["errors"]
