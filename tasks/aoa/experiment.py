"""Turbo learning measured: the same network trained on few measured spectra, on those and synthetic ones, and on all."""

from __future__ import annotations

import time
from dataclasses import replace
from pathlib import Path

import torch
from torch import Tensor

from augment import (
    Mixed,
    Places,
    choose_synthesizer,
    draw_places,
    make_synthesizer,
    mix,
    withhold,
)
from augment import Settings as SynthesizerSettings
from augment.choose import SLOW, candidates
from augment.suggest import suggest
from swiftwrf import FitError, GeometryModel, InputError, Spectra, simulated_room
from swiftwrf.checkpoint import Saved, read, write
from swiftwrf.data import read_spectra
from swiftwrf.geometry import HybridModel
from swiftwrf.metrics import angle_errors, l1, psnr, ssim
from tasks.aoa import arms
from tasks.aoa.advice import advise
from tasks.aoa.config import AUTO, AoaConfig, check, check_data, further_positions
from tasks.aoa.estimators import ESTIMATORS, Settings, learners
from tasks.aoa.page import page
from tasks.aoa.results import mix_metrics
from tasks.metrics import AdviceMetrics, AoaMetrics, MixMetrics
from tasks.page.page import reporting
from tasks.run import Row, Run, choose_device, console
from tasks.source import reading

SCORE = {"psnr_db": psnr, "ssim": ssim, "l1": l1}
SAMPLE = " sample"  # after the name of a synthesizer whose draws are scored instead of its means
NORMAL_80 = 1.2816  # standard deviations about the mean that hold 80 % of a normal variable
EXAMPLE_QUANTILES = (1.0, 0.8, 0.6, 0.4, 0.2, 0.0)  # of the PSNR at the test positions: the best to the worst spectrum


def run(config: AoaConfig, resume: Path | None = None) -> None:
    """Runs the experiment and writes its directory, or goes on with an interrupted one.

    Raises:
        InputError: what the configuration asks for is not there or makes no sense.
    """
    device = choose_device(config.device)
    check(config)
    if config.data is None:
        data = simulated_room(seed=config.seed, moving=config.moving or "transmitter")
    else:
        data = read_spectra(config.data, reading(config))
    for note in data.notes:
        console.print(f"{data.name}: {note}")
    check_data(data, config)
    train, test = data.split(config.split, config.seed)
    if len(test) == 0:
        raise InputError(f"split {config.split!r} of {data.name} has no test spectra")
    for share in config.mix:
        withhold(train, share, config.seed)  # refuses before anything is written
    extra = further_positions(data, config)
    label = f"mix{'_'.join(f'{share:g}' for share in config.mix)}-s{config.seed}"
    with Run("aoa", config.out, label, config, device, data.source, resume) as directory:
        experiment = _Experiment(config, train, test, extra, device, directory)
        for repeat in range(config.repeats):
            for share in config.mix:
                experiment.turbo(share, repeat)
        if config.suggest:
            for share in config.mix:
                experiment.suggest(share)
        directory.write_csv("errors.csv", experiment.errors)
        directory.write_csv("synthesis.csv", experiment.synthesis)
        directory.write_csv("history.csv", experiment.history)
        metrics: AoaMetrics = {
            "task": "aoa",
            "data": data.name,
            "split": config.split,
            "preset": config.preset,
            "seed": config.seed,
            "repeats": config.repeats,
            "moving": data.moving,
            "extra": extra,
            "n_train": len(train),
            "n_test": len(test),
            "grid": data.grid.shape,
            "line_of_sight_share": float(test.line_of_sight.float().mean()),
            "mixes": {f"{share:g}": experiment.summary(share) for share in config.mix},
        }
        final = directory.finish(metrics, reporting(page))
    console.print(f"report: [bold]{final / 'report.html'}[/]")


class _Experiment:
    """Trains and tests every arm, each a step of the run's directory, and gathers the tables of the run."""

    def __init__(
        self, config: AoaConfig, train: Spectra, test: Spectra, extra: int, device: torch.device, directory: Run
    ) -> None:
        self.config, self.train, self.test, self.extra = config, train, test, extra
        self.device, self.directory = device, directory
        self.errors: list[Row] = []
        self.synthesis: list[Row] = []
        self.history: list[Row] = []
        self.training_seconds: list[Row] = []
        self.synthesis_seconds: list[Row] = []
        self.chosen: dict[float, Row] = {}  # by share, of the first repeat
        self.counts: dict[float, dict[str, dict[str, int]]] = {}
        self._kept_examples: set[float] = set()

    def turbo(self, share: float, repeat: int) -> None:
        """All arms at one measured share."""
        measured, withheld = withhold(self.train, share, self.config.seed + repeat)
        at = {"mix": share, "repeat": repeat}
        suffix = f"mix{share:g}-r{repeat}"
        self._train_on(at, arms.LOWER.name, suffix, Mixed.measured(measured), list(ESTIMATORS))
        asked_for, advice = self._choose(at, suffix, measured)
        sampled = bool(advice and advice["sampled"])
        # unless told how many, only where held-out measured spectra gain from them
        wanted = self.config.extra is not None or bool(advice and advice["recommended_extra"])
        further = draw_places(measured, self.extra, self.config.seed + repeat) if self.extra and wanted else None
        for name in dict.fromkeys((*asked_for, *candidates(self.train))):
            places = (withheld, further) if name in asked_for else (None, None)
            try:
                drawn = self._synthesize(at | {"synthesizer": name}, suffix, measured, places, sampled)
            except (InputError, FitError) as error:
                if name in asked_for:
                    raise
                console.print(f"{name} is left out of the comparison: {error}")
                continue
            if name in asked_for:
                mixed = mix(measured, withheld, drawn["withheld"])
                self._train_on(at, arms.turbo(name), suffix, mixed, learners())
                if further is not None:
                    more = mixed.add(further, drawn["further"])
                    self._train_on(at, arms.turbo(name, extra=True), suffix, more, learners())
        # the same whatever the share, so its steps are shared by all of them
        self._train_on(at, arms.UPPER.name, f"r{repeat}", Mixed.measured(self.train), learners())

    def suggest(self, share: float) -> None:
        """Where to measure next, as a table for those who go there."""
        measured, _ = withhold(self.train, share, self.config.seed)

        def compute() -> Row:
            found = suggest(measured, self.config.suggest, self.config.seed)
            return {"position": found.position, "left": found.left}

        value = self.directory.step(f"suggestion-mix{share:g}", compute)["value"]
        position, left = torch.tensor(value["position"]), torch.tensor(value["left"])
        columns = {"x_m": position[:, 0], "y_m": position[:, 1], "z_m": position[:, 2], "variance_left": left[1:]}
        self.directory.write_csv(f"suggested-mix{share:g}.csv", _rows({}, columns))
        places = {"measured": measured.position.numpy(), "suggested": position.numpy(), "left": left.numpy()}
        self.directory.write_npz(f"suggested-mix{share:g}.npz", places)

    def _choose(self, at: Row, suffix: str, measured: Spectra) -> tuple[list[str], AdviceMetrics | None]:
        """Synthesizers whose spectra train, and what cross-validation says of them, where they were compared."""
        named = [name for name in self.config.synthesizer if name != AUTO]
        compared = [name for name in named if name not in SLOW] or None
        if named and compared is None:
            return named, None

        def compute() -> Row:
            choice = choose_synthesizer(measured, self._settings(at["repeat"]), compared)
            advice = advise(choice.trials, self._estimator_settings(at["repeat"]), self.extra)
            return {
                "choice": {"name": choice.name, "psnr_db": choice.psnr_db, "seconds": choice.seconds},
                "advice": advice,
            }

        value = self.directory.step(f"choice-{suffix}", compute)["value"]
        self.chosen.setdefault(at["mix"], value)
        return named or [value["choice"]["name"]], value["advice"]

    def _settings(self, repeat: int) -> SynthesizerSettings:
        return SynthesizerSettings(
            validation="random",  # the withheld places lie among the measured ones, whatever the split of the test
            seed=self.config.seed + repeat,
            preset=self.config.preset,
            device=self.device,
        )

    def _estimator_settings(self, repeat: int) -> Settings:
        return Settings(self.train.grid, self.config.seed + repeat, self.device, self.config.preset)

    def _train_on(self, at: Row, training: str, suffix: str, train: Mixed, estimators: list[str]) -> None:
        """Trains and tests estimators on one training set."""
        self.counts.setdefault(at["mix"], {})[training] = train.counts
        for estimator in estimators:
            name = arms.arm(estimator, training)
            self._arm(at | {"method": name}, f"{name}-{suffix}", train, estimator)

    def _arm(self, arm: Row, step: str, train: Mixed, name: str) -> None:
        """Trains one estimator and tests it."""

        def compute() -> Row:
            estimator = ESTIMATORS[name].make(self._estimator_settings(arm["repeat"]))
            began = time.perf_counter()
            estimator.fit(train)
            fitted = time.perf_counter()
            estimate = estimator.estimate(self.test.spectrum)
            seconds = {"train": fitted - began, "estimate": time.perf_counter() - fitted}
            return {"estimate": estimate, "seconds": seconds, "history": estimator.history}

        done = self.directory.step(step, compute)
        estimate = torch.tensor(done["value"]["estimate"], dtype=torch.float64)
        errors = angle_errors(estimate, self.test.label)
        columns = {
            "index": self.test.index,
            "line_of_sight": self.test.line_of_sight,
            "truth_azimuth_deg": self.test.label[:, 0].rad2deg(),
            "truth_elevation_deg": self.test.label[:, 1].rad2deg(),
            "estimate_azimuth_deg": estimate[:, 0].rad2deg(),
            "estimate_elevation_deg": estimate[:, 1].rad2deg(),
            **{f"{kind}_deg": error.rad2deg() for kind, error in errors.items()},
        }
        self.errors += _rows(arm, columns)
        self.history += [arm | row for row in done["value"]["history"]]
        self.training_seconds.append(arm | done["value"]["seconds"])

    def _synthesize(
        self, arm: Row, suffix: str, measured: Spectra, places: tuple[Places | None, Places | None], sampled: bool
    ) -> dict[str, Tensor]:
        """Spectra of one synthesizer at withheld and further places, and its quality at the test positions."""
        name = arm["synthesizer"]
        step = f"synthesis_{name}-{suffix}"
        file = self.directory.path(f"steps/{step}.safetensors")

        def compute() -> Row:
            fit = _FitHistory()
            checkpoint = self.directory.path(f"steps/{step}-fit.safetensors")
            settings = replace(self._settings(arm["repeat"]), checkpoint=checkpoint, on_record=fit.add)
            synthesizer = make_synthesizer(name, settings)
            synthesizer.fit(measured)
            fitted = time.perf_counter()
            generator = torch.Generator().manual_seed(settings.seed)
            drawn = {"test": synthesizer.synthesize(self.test.position)}
            deviation = synthesizer.deviation(self.test.position)
            if deviation is not None:
                drawn["test deviation"] = deviation
            if synthesizer.samples:
                drawn["test sample"] = synthesizer.synthesize(self.test.position, generator)
            for key, asked in zip(("withheld", "further"), places, strict=True):
                if asked is not None:
                    own = generator if sampled and synthesizer.samples else None
                    drawn[key] = synthesizer.synthesize(asked.position, own)
            seconds = {
                "fit": fitted - fit.began + fit.earlier + synthesizer.shared_seconds,
                "synthesize": time.perf_counter() - fitted,
            }
            write(file, "synthetic spectra", {key: _as_bytes(spectrum) for key, spectrum in drawn.items()}, {})
            if places[0] is not None and arm["repeat"] == 0:
                self._keep_model(synthesizer.model, name, arm["mix"], measured)
            return {"history": fit.records, "seconds": seconds}

        value = self.directory.step(step, compute)["value"]
        drawn = {key: spectrum.float() / 255 for key, spectrum in read(file, "synthetic spectra")[1].items()}
        for key, called in (("test", name), ("test sample", name + SAMPLE)):
            if key in drawn:
                scores = {score: function(drawn[key], self.test.spectrum) for score, function in SCORE.items()}
                self.synthesis += _rows(arm | {"synthesizer": called}, {"index": self.test.index} | scores)
                self.synthesis_seconds.append(arm | {"synthesizer": called} | value["seconds"])
        self.history += [arm | row for row in value["history"]]
        if arm["repeat"] == 0 and places[0] is not None and arm["mix"] not in self._kept_examples:
            self._kept_examples.add(arm["mix"])
            self._keep_examples(arm["mix"], name, drawn)
        return drawn

    def _keep_model(self, model: Saved | None, name: str, share: float, measured: Spectra) -> None:
        """The fitted model, and the room where one was found."""
        if model is None:
            return
        prefix = "model" if name == "swiftwrf" else name
        model.save(self.directory.path(f"{prefix}-mix{share:g}.safetensors"))
        room = model.geometry if isinstance(model, HybridModel) else model
        if isinstance(room, GeometryModel):
            self.directory.write_json(f"geometry-mix{share:g}.json", room.to_json())
            at, gain, order = room.image_sources()
            places = {
                "measured": measured.position.numpy(),
                "test": self.test.position.numpy(),
                "fixed": room.fixed_position.numpy(),
                "image": at.numpy(),
                "gain": gain.numpy(),
                "order": order.numpy(),
            }
            self.directory.write_npz(f"room-mix{share:g}.npz", places)

    def _keep_examples(self, share: float, name: str, drawn: dict[str, Tensor]) -> None:
        """Measured and synthetic spectra at test positions for the report, chosen by rule."""
        measured, synthetic = self.test.spectrum, drawn["test"]
        score = psnr(synthetic, measured)
        order = score.argsort()
        chosen = order[[round(q * (len(order) - 1)) for q in EXAMPLE_QUANTILES]]
        examples = {
            "measured": _as_bytes(measured[chosen]).numpy(),
            "synthetic": _as_bytes(synthetic[chosen]).numpy(),
            "synthesizer": name,
            "index": self.test.index[chosen].numpy(),
            "psnr_db": score[chosen].numpy(),
        }
        if "test deviation" in drawn:
            deviation = drawn["test deviation"]
            examples["deviation"] = _as_bytes(deviation[chosen]).numpy()
            examples["coverage"] = float(((synthetic - measured).abs() <= NORMAL_80 * deviation).float().mean())
        self.directory.write_npz(f"examples-mix{share:g}.npz", examples)

    def summary(self, share: float) -> MixMetrics:
        """What metrics.json says of one share."""
        chosen = self.chosen.get(share, {})
        rows = {
            "errors": self.errors,
            "training_seconds": self.training_seconds,
            "synthesis": self.synthesis,
            "synthesis_seconds": self.synthesis_seconds,
        }
        n_measured = round(share * len(self.train))
        return mix_metrics(share, n_measured, self.counts[share], chosen.get("choice"), chosen.get("advice"), rows)


class _FitHistory:
    """The records of a fit, and the seconds that it took in sessions before this one."""

    def __init__(self) -> None:
        self.records: list[Row] = []
        self.began, self.earlier = time.perf_counter(), 0.0

    def add(self, record: Row) -> None:
        """One record; those of earlier sessions come first."""
        self.records.append(record)
        self.earlier = max(self.earlier, record.get("elapsed", 0.0) - (time.perf_counter() - self.began))


def _rows(arm: Row, columns: dict[str, Tensor]) -> list[Row]:
    lists = {name: column.tolist() for name, column in columns.items()}
    return [arm | dict(zip(lists, values, strict=True)) for values in zip(*lists.values(), strict=True)]


def _as_bytes(spectrum: Tensor) -> Tensor:
    """In 256 steps, as measured spectra come in images."""
    return (spectrum.clamp(0, 1) * 255).round().to(torch.uint8)
