"""The steps of the experiment: a synthesizer is chosen, spectra are synthesized, an estimator is trained and tested."""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import torch
from torch import Tensor

from augment import SYNTHESIZERS, Mixed, choose_synthesizer, make_synthesizer, mix
from augment.choose import SLOW, candidates
from augment.suggest import suggest
from swiftwrf import FitError, InputError
from swiftwrf.data.store import Store
from swiftwrf.runtime.checkpoint import read, write
from tasks.aoa import arms
from tasks.aoa.advice import advise
from tasks.aoa.config import AUTO
from tasks.aoa.estimators import ESTIMATORS, SavedEstimator, learners
from tasks.aoa.keep import keep
from tasks.aoa.setting import At, Setting
from tasks.claim import STEPS
from tasks.metrics import AdviceMetrics
from tasks.run import Row
from tasks.steps import Step

KIND = "synthetic spectra"
AT_ONCE = 4096  # positions that are drawn before they are rounded: half a gigabyte of 90 x 360 pixels


def steps_at(setting: Setting, at: At) -> list[Step[Setting]]:
    """The bounds, and between them what the turbo arms follow from."""
    named = [name for name in setting.config.synthesizer if name != AUTO]
    compared = tuple(name for name in named if name not in SLOW)
    return [
        *(Arm(at, estimator, arms.LOWER.name) for estimator in ESTIMATORS),
        *(_syntheses(setting, at, named, None) if named and not compared else [Choice(at, compared)]),
        # the same whatever the share, so its steps are shared by all of them
        *(Arm(at, estimator, arms.UPPER.name) for estimator in learners()),
    ]


def _syntheses(setting: Setting, at: At, asked_for: list[str], advice: AdviceMetrics | None) -> list[Step[Setting]]:
    """Of the synthesizers whose spectra train, and of those that are compared with them."""
    sampled = bool(advice and advice["sampled"])
    # unless told how many, only where held-out measured spectra gain from them
    wanted = setting.config.extra is not None or bool(advice and advice["recommended_extra"])
    further = bool(setting.extra) and wanted
    names = dict.fromkeys((*asked_for, *candidates(setting.train)))
    return [Synthesis(at, name, name in asked_for, name in asked_for and further, sampled) for name in names]


@dataclass(frozen=True)
class Choice(Step[Setting]):
    """Compares synthesizers, and says whether turbo learning helps.

    Args:
        at: share and repeat.
        compared: their names; empty for all that apply and are fast.
    """

    at: At
    compared: tuple[str, ...]

    @property
    def name(self) -> str:
        return f"choice-{self.at}"

    def compute(self, setting: Setting, folder: Path) -> Row:
        measured, _ = setting.withhold(self.at)
        choice = choose_synthesizer(measured, setting.of_synthesizers(self.at), self.compared or None)
        advice = advise(choice.trials, setting.of_estimators(self.at), setting.extra)
        return {
            "choice": {"name": choice.name, "psnr_db": choice.psnr_db, "seconds": choice.seconds},
            "advice": advice,
        }

    def then(self, setting: Setting, value: Row) -> Sequence[Step[Setting]]:
        named = [name for name in setting.config.synthesizer if name != AUTO]
        return _syntheses(setting, self.at, named or [value["choice"]["name"]], value["advice"])


@dataclass(frozen=True)
class Synthesis(Step[Setting]):
    """Spectra of one synthesizer at test, withheld and further positions.

    Args:
        at: share and repeat.
        synthesizer: its name.
        trains: whether its spectra train estimators; else it is drawn at the test positions alone, for comparison.
        further: whether it draws at further positions, too.
        sampled: draws in place of means at the positions that train.
    """

    at: At
    synthesizer: str
    trains: bool
    further: bool
    sampled: bool

    @property
    def name(self) -> str:
        return f"synthesis_{self.synthesizer}-{self.at}"

    @property
    def file(self) -> str:
        """Where the spectra are kept."""
        return f"{STEPS}/{self.name}.safetensors"

    def spectra(self, folder: Path) -> dict[str, Store]:
        """Those kept in this folder: `test`, `test deviation`, `test sample`, `withheld`, `further`, as far as drawn."""
        return {key: Store(spectrum) for key, spectrum in read(folder / self.file, KIND)[1].items()}

    def compute(self, setting: Setting, folder: Path) -> Row:
        try:
            return self._draw(setting, folder)
        except (InputError, FitError) as error:
            if self.trains:
                raise
            return {"refused": str(error)}

    def _draw(self, setting: Setting, folder: Path) -> Row:
        measured, withheld = setting.withhold(self.at)
        fit = _FitHistory()
        checkpoint = folder / STEPS / f"{self.name}-fit.safetensors"
        settings = replace(
            setting.of_synthesizers(self.at),
            checkpoint=checkpoint,
            on_record=fit.add,
        )
        synthesizer = make_synthesizer(self.synthesizer, settings)
        fit.begin()
        synthesizer.fit(measured)
        fitted = time.perf_counter()
        generator = torch.Generator().manual_seed(settings.seed)
        test = setting.test.position
        drawn = {"test": _as_bytes_at(test, synthesizer.synthesize)}
        tested = time.perf_counter()  # what every synthesizer draws, whether it trains or not
        if synthesizer.deviation(test[:1]) is not None:
            drawn["test deviation"] = _as_bytes_at(test, synthesizer.deviation)
        if synthesizer.samples:
            drawn["test sample"] = _as_bytes_at(test, lambda some: synthesizer.synthesize(some, generator))
        own = generator if self.sampled and synthesizer.samples else None
        if self.trains:
            drawn["withheld"] = _as_bytes_at(withheld.position, lambda some: synthesizer.synthesize(some, own))
        if self.further:
            places = setting.further(self.at, measured)
            drawn["further"] = _as_bytes_at(places.position, lambda some: synthesizer.synthesize(some, own))
        seconds = {
            "fit": fitted - fit.began + fit.earlier + synthesizer.shared_seconds,
            "synthesize": tested - fitted,
            "draw": time.perf_counter() - fitted,
        }
        write(folder / self.file, KIND, drawn, {})
        if self.trains and self.at.repeat == 0:
            keep(self.synthesizer, synthesizer, self.at.share, measured, setting.test, folder)
        return {"history": fit.records, "seconds": seconds}

    def then(self, setting: Setting, value: Row) -> Sequence[Step[Setting]]:
        trainings = [arms.turbo(self.synthesizer)] if self.trains else []
        if self.further:
            trainings.append(arms.turbo(self.synthesizer, extra=True))
        return [Arm(self.at, estimator, training, self) for training in trainings for estimator in learners()]


@dataclass(frozen=True)
class Arm(Step[Setting]):
    """Trains one estimator on one training set, and tests it.

    Args:
        at: share and repeat.
        estimator: its name.
        training: name of the training set.
        synthesis: of its spectra, where some are synthetic.
    """

    at: At
    estimator: str
    training: str
    synthesis: Synthesis | None = None

    @property
    def method(self) -> str:
        """What the tables call it."""
        return arms.arm(self.estimator, self.training)

    @property
    def name(self) -> str:
        return f"{self.method}-r{self.at.repeat}" if self.training == arms.UPPER.name else f"{self.method}-{self.at}"

    @property
    def reads(self) -> tuple[str, ...]:
        return (self.synthesis.file,) if self.synthesis else ()

    def compute(self, setting: Setting, folder: Path) -> Row:
        train = self._training_set(setting, folder)
        estimator = ESTIMATORS[self.estimator].make(setting.of_estimators(self.at))
        began = time.perf_counter()
        estimator.fit(train)
        fitted = time.perf_counter()
        estimate = torch.cat([estimator.estimate(part) for part in setting.test.store.batches()])
        if isinstance(estimator, SavedEstimator) and self._is_kept(setting):
            estimator.save(folder / f"{self.estimator}-mix{self.at.share:g}.safetensors")
        seconds = {"train": fitted - began, "estimate": time.perf_counter() - fitted}
        return {"estimate": estimate, "seconds": seconds, "history": estimator.history, "counts": train.counts}

    def _is_kept(self, setting: Setting) -> bool:
        """Whether it is what a user would take: trained on all that the first synthesizer adds."""
        if self.synthesis is None or self.at.repeat:
            return False
        first = setting.config.synthesizer[0] in (AUTO, self.synthesis.synthesizer)
        return first and self.training == arms.turbo(self.synthesis.synthesizer, extra=self.synthesis.further)

    def _training_set(self, setting: Setting, folder: Path) -> Mixed:
        if self.training == arms.UPPER.name:
            return Mixed.measured(setting.train)
        measured, withheld = setting.withhold(self.at)
        if self.synthesis is None:
            return Mixed.measured(measured)
        drawn = self.synthesis.spectra(folder)
        mixed = mix(measured, withheld, drawn["withheld"].values)
        if self.training == arms.turbo(self.synthesis.synthesizer, extra=True):
            mixed = mixed.add(setting.further(self.at, measured), drawn["further"].values)
        return mixed


@dataclass(frozen=True)
class Suggestion(Step[Setting]):
    """Where to measure next.

    Args:
        at: share and repeat.
    """

    at: At

    @property
    def name(self) -> str:
        return f"suggestion-mix{self.at.share:g}"

    def compute(self, setting: Setting, folder: Path) -> Row:
        measured, _ = setting.withhold(self.at)
        found = suggest(measured, setting.config.suggest, setting.config.seed)
        return {"position": found.position, "left": found.left}


class _FitHistory:
    """The records of a fit, and the seconds that it took in sessions before this one."""

    def __init__(self) -> None:
        self.records: list[Row] = []
        self.began = self.earlier = 0.0

    def begin(self) -> None:
        """Its time counts from now on."""
        self.began = time.perf_counter()

    def add(self, record: Row) -> None:
        """One record; those of earlier sessions come first."""
        self.records.append(record)
        self.earlier = max(self.earlier, record.get("elapsed", 0.0) - (time.perf_counter() - self.began))


def _as_bytes_at(position: Tensor, draw: Callable[[Tensor], Tensor | None]) -> Tensor:
    """What is drawn at positions (n, 3), some at a time."""
    parts = (draw(some) for some in position.split(AT_ONCE))
    return torch.cat([as_bytes(part) for part in parts if part is not None])


def as_bytes(spectrum: Tensor) -> Tensor:
    """In 256 steps, as measured spectra come in images."""
    return (spectrum.clamp(0, 1) * 255).round().to(torch.uint8)
