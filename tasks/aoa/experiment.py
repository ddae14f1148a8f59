"""Turbo learning measured: the same network trained on few measured spectra, on those and synthetic ones, and on all."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import torch
from torch import Tensor

from augment import withhold
from swiftwrf import InputError, Spectra, simulated_room
from swiftwrf.data import read_spectra
from swiftwrf.data.files import sha256
from swiftwrf.data.store import Store
from swiftwrf.metrics import angle_errors, covered, l1, psnr, ssim
from tasks.aoa.config import AUTO, AoaConfig, check, check_data, further_positions
from tasks.aoa.page import page
from tasks.aoa.pooled import pooled
from tasks.aoa.results import mix_metrics
from tasks.aoa.setting import At, Setting
from tasks.aoa.steps import Arm, Choice, Suggestion, Synthesis, as_bytes, steps_at
from tasks.cluster import connected
from tasks.metrics import AoaMetrics, MixMetrics
from tasks.page.page import reporting
from tasks.run import Row, Run, choose_device, console
from tasks.source import reading
from tasks.steps import Step, computed

SCORE = {"psnr_db": psnr, "ssim": ssim, "l1": l1}
SAMPLE = " sample"  # after the name of a synthesizer whose draws are scored instead of its means
EXAMPLE_QUANTILES = (1.0, 0.8, 0.6, 0.4, 0.2, 0.0)  # of the PSNR at the test positions: the best to the worst spectrum


def run(config: AoaConfig, resume: Path | None = None) -> None:
    """Runs the experiment and writes its directory, or goes on with an interrupted one.

    Raises:
        InputError: what the configuration asks for is not there or makes no sense.
        FitError: a fit broke, or the cluster was lost.
    """
    device = choose_device(config.device)
    check(config)
    data = measurements(config)
    for note in data.notes:
        console.print(f"{data.name}: {note}")
    check_data(data, config)
    train, test = data.split(config.split, config.seed)
    if len(test) == 0:
        raise InputError(f"split {config.split!r} of {data.name} has no test spectra")
    for share in config.mix:
        withhold(train, share, config.seed)  # refuses before anything is written
    setting = Setting(config, train, test, further_positions(data, config), device)
    steps: list[Step[Setting]] = []
    for repeat in range(config.repeats):
        for share in config.mix:
            steps += steps_at(setting, At(share, repeat))
    if config.suggest:
        steps += [Suggestion(At(share, 0)) for share in config.mix]
    source = data.source
    if config.scene is not None and Path(config.scene).is_file():
        source = {**source, f"scene {Path(config.scene).name}": sha256(Path(config.scene))}
    label = f"mix{'_'.join(f'{share:g}' for share in config.mix)}-s{config.seed}"
    with (
        connected(config.scheduler, device) as cluster,
        Run("aoa", config.out, label, config, device, source, resume) as directory,
    ):
        tables = _Tables(setting, directory)
        for step, value in computed(directory, steps, setting, cluster):
            tables.add(step, value)
        tables.pool()
        directory.write_csv("errors.csv", tables.errors)
        directory.write_csv("synthesis.csv", tables.synthesis)
        directory.write_csv("history.csv", tables.history)
        metrics: AoaMetrics = {
            "task": "aoa",
            "data": data.name,
            "split": config.split,
            "preset": config.preset,
            "seed": config.seed,
            "repeats": config.repeats,
            "moving": data.moving,
            "extra": setting.extra,
            "n_train": len(train),
            "n_test": len(test),
            "grid": data.grid.shape,
            "line_of_sight_share": float(test.line_of_sight.float().mean()),
            "mixes": {f"{share:g}": tables.summary(share) for share in config.mix},
        }
        final = directory.finish(metrics, reporting(page))
    console.print(f"report: [bold]{final / 'report.html'}[/]")


def measurements(config: AoaConfig) -> Spectra:
    """The spectra that a run is about.

    Raises:
        InputError: they cannot be read.
    """
    if config.data is None:
        return simulated_room(seed=config.seed, moving=config.moving or "transmitter")
    return read_spectra(config.data, reading(config))


class _Tables:
    """Gathers the tables of the run from what its steps computed."""

    def __init__(self, setting: Setting, directory: Run) -> None:
        self.setting, self.test, self.directory = setting, setting.test, directory
        self.errors: list[Row] = []
        self.synthesis: list[Row] = []
        self.history: list[Row] = []
        self.training_seconds: list[Row] = []
        self.arm_seconds: list[Row] = []  # the same, pooled
        self.synthesis_seconds: list[Row] = []
        self.chosen: dict[float, Row] = {}  # by share, of the first repeat
        self.counts: dict[float, dict[str, dict[str, int]]] = {}
        self._kept_examples: set[float] = set()

    def add(self, step: Step[Setting], value: Row) -> None:
        """What one step computed."""
        match step:
            case Choice():
                self.chosen.setdefault(step.at.share, value)
            case Synthesis() if "refused" in value:
                console.print(f"{step.synthesizer} is left out of the comparison: {value['refused']}")
            case Synthesis():
                self._add_synthesis(step, value)
            case Arm():
                self._add_arm(step, value)
            case Suggestion():
                self._add_suggestion(step, value)

    def pool(self) -> None:
        """Gives each arm all repeats, once all steps are added."""
        auto = self.setting.config.synthesizer == (AUTO,)
        self.errors = pooled(self.errors, auto)
        self.arm_seconds = pooled(self.training_seconds, auto)

    def _add_arm(self, step: Arm, value: Row) -> None:
        self.counts.setdefault(step.at.share, {})[step.training] = value["counts"]
        arm = step.at.row | {"method": step.method}
        estimate = torch.tensor(value["estimate"], dtype=torch.float64)
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
        self.history += [arm | row for row in value["history"]]
        self.training_seconds.append(arm | value["seconds"])

    def _add_synthesis(self, step: Synthesis, value: Row) -> None:
        """Its quality at the test positions."""
        drawn, share = step.spectra(self.directory.folder), step.at.share
        for key, called in (("test", step.synthesizer), ("test sample", step.synthesizer + SAMPLE)):
            if key in drawn:
                arm = step.at.row | {"synthesizer": called}
                scores = {name: self._score(function, drawn[key]) for name, function in SCORE.items()}
                self.synthesis += _rows(arm, {"index": self.test.index} | scores)
                trains = step.trains and called == step.synthesizer
                self.synthesis_seconds.append(arm | value["seconds"] | {"trains": trains})
        self.history += [step.at.row | {"synthesizer": step.synthesizer} | row for row in value["history"]]
        if step.at.repeat == 0 and step.trains and share not in self._kept_examples:
            self._kept_examples.add(share)
            self._keep_examples(share, step.synthesizer, drawn)

    def _add_suggestion(self, step: Suggestion, value: Row) -> None:
        """A table for those who go there."""
        name, (measured, _) = f"suggested-mix{step.at.share:g}", self.setting.withhold(step.at)
        position, left = (torch.tensor(value[key], dtype=torch.float64) for key in ("position", "left"))
        columns = {"x_m": position[:, 0], "y_m": position[:, 1], "z_m": position[:, 2], "variance_left": left[1:]}
        self.directory.write_csv(f"{name}.csv", _rows({}, columns))
        places = {"measured": measured.position.numpy(), "suggested": position.numpy(), "left": left.numpy()}
        self.directory.write_npz(f"{name}.npz", places)

    def _score(self, function: Callable[[Tensor, Tensor], Tensor], drawn: Store) -> Tensor:
        """Of each spectrum at the test positions."""
        pairs = zip(drawn.batches(), self.test.store.batches(), strict=True)
        return torch.cat([function(*pair) for pair in pairs])

    def _keep_examples(self, share: float, name: str, drawn: dict[str, Store]) -> None:
        """Measured and synthetic spectra at test positions for the report, chosen by rule."""
        measured, synthetic = self.test.store, drawn["test"]
        score = self._score(psnr, synthetic)
        order = score.argsort()
        chosen = order[[round(q * (len(order) - 1)) for q in EXAMPLE_QUANTILES]]
        examples = {
            "measured": as_bytes(measured[chosen]).numpy(),
            "synthetic": as_bytes(synthetic[chosen]).numpy(),
            "synthesizer": name,
            "index": self.test.index[chosen].numpy(),
            "psnr_db": score[chosen].numpy(),
        }
        if "test deviation" in drawn:
            deviation = drawn["test deviation"]
            examples["deviation"] = as_bytes(deviation[chosen]).numpy()
            triples = zip(synthetic.batches(), measured.batches(), deviation.batches(), strict=True)
            inside = torch.cat([covered(s, d, m) for s, m, d in triples])
            examples["coverage"] = float(inside.mean())
        self.directory.write_npz(f"examples-mix{share:g}.npz", examples)

    def summary(self, share: float) -> MixMetrics:
        """What metrics.json says of one share."""
        chosen = self.chosen.get(share, {})
        rows = {
            "errors": self.errors,
            "training_seconds": self.training_seconds,
            "arm_seconds": self.arm_seconds,
            "synthesis": self.synthesis,
            "synthesis_seconds": self.synthesis_seconds,
        }
        n_measured = round(share * len(self.setting.train))
        return mix_metrics(share, n_measured, self.counts[share], chosen.get("choice"), chosen.get("advice"), rows)


def _rows(arm: Row, columns: dict[str, Tensor]) -> list[Row]:
    lists = {name: column.tolist() for name, column in columns.items()}
    return [arm | dict(zip(lists, values, strict=True)) for values in zip(*lists.values(), strict=True)]
