"""Options of python -m tasks.aoa, and their checks."""

from __future__ import annotations

from typing import Annotated, Literal

from annotated_types import Ge, Le

from swiftwrf.choices import AUTO, FIELD_MODELS, MAX_SUGGESTIONS, RAYTRACE, Moving, check_scene, fraction_key
from swiftwrf.errors import InputError
from swiftwrf.runtime.validation import NonNegativeInt, PositiveInt, Preset
from tasks import labels
from tasks.options import SEEDS, Options, Output, Seed, SpectraSource, choice, given, options

PAPER_FRACTIONS = (0.1, 0.3, 0.5, 0.7)


@options
class AoaConfig(Options):
    """Angle of arrival with few measured spectra: turbo learning against its references and baselines.

    Without --data the built-in simulated room is used. swiftwrf resume DIR.partial continues an interrupted run.

    Example: swiftwrf aoa --mix 0.3 --data DIR --split block
    """

    mix: tuple[float, ...] = ()
    """measured fractions in (0, 1]: 0.3 keeps 30 % of the training spectra and synthesizes the others. Required, except with
    --preset paper"""
    data: str | None = None
    """folder or file of spectra, ray paths or array snapshots, or name of a public data set, see docs/formats.md"""
    split: str = "random"
    """a split that comes with the data, or a seeded one: random or block"""
    synthesizer: Annotated[
        tuple[str, ...],
        choice(
            f"field models of the synthetic spectra; {AUTO} chooses the one that predicts held-out measured spectra best",
            FIELD_MODELS,
            labels.FIELD_MODELS,
            AUTO,
        ),
    ] = (AUTO,)
    scene: str | None = None
    """room of tasks.scenes or Mitsuba scene (FILE.xml) for --synthesizer raytrace, in the coordinates of the data (default:
    the room that it estimates from the spectra)"""
    extra: NonNegativeInt | None = None
    """number of extra synthetic positions in the region of the measured ones (default: 3000 if cross-validation on the
    measured spectra shows a gain, else none; none with --preset paper)"""
    suggest: Annotated[int, Ge(0), Le(MAX_SUGGESTIONS)] = 0
    """number of positions to suggest for the next measurements, those that reduce the uncertainty over the region most"""
    moving: Moving | None = None
    """which end moves in the built-in room (default: transmitter)"""
    preset: Preset = "quick"
    """quick: sized for a CPU; paper: the paper's model, network and measured fractions, and a long training, for a GPU"""
    repeats: PositiveInt = 1
    """runs with different measured spectra and networks, pooled"""
    scheduler: str | None = None
    """address of a Dask scheduler whose workers compute the steps of the run (extra: cluster)"""
    processes: PositiveInt | None = None
    """processes of this machine that compute the steps, a gigabyte of memory each (default: one a thread, at most 4; one on
    a GPU)"""
    seed: Seed = 0
    """seed of everything random"""
    out: str | None = None
    """directory of the run; must not exist (default: a new one under runs/aoa)"""
    device: Literal["auto", "cpu", "cuda"] = "auto"
    """device to compute on"""
    output: Output = Output()
    spectra: SpectraSource = SpectraSource()

    def __post_init__(self) -> None:
        if self.preset == "paper":
            # the paper's training sets contain synthetic spectra at the withheld positions alone
            object.__setattr__(self, "mix", self.mix or PAPER_FRACTIONS)
            object.__setattr__(self, "extra", self.extra or 0)

    def check(self) -> None:
        super().check()
        if not self.synthesizer:
            raise InputError("--synthesizer takes at least one name")
        if AUTO in self.synthesizer and len(self.synthesizer) > 1:
            raise InputError(f"--synthesizer takes {AUTO} or names, not both: {' '.join(self.synthesizer)}")
        for name in self.synthesizer:
            if name != AUTO:
                FIELD_MODELS.check(name)
        if self.scene is not None:
            if RAYTRACE not in self.synthesizer:
                raise InputError(
                    f"--scene is for synthesizer {RAYTRACE}; add it to --synthesizer, or leave --scene out"
                )
            check_scene(self.scene, "--scene ")
        if self.moving is not None and self.data is not None:
            raise InputError("--moving is for the built-in room; with --data the data determine which end moves")
        if not self.mix or not all(0 < fraction <= 1 for fraction in self.mix):
            raise InputError(f"--mix takes measured fractions in (0, 1], got {_listed(self.mix) or 'none'}")
        if len(set(self.mix)) < len(self.mix):
            raise InputError(f"--mix names a fraction twice: {_listed(self.mix)}")
        if self.data is None and (names := given(self.spectra)):
            raise InputError(f"--{names[0]} is an option of the reader; give it with --data")
        if self.processes is not None and self.scheduler is not None:
            raise InputError("--processes and --scheduler exclude each other; leave out one")
        if self.seed + self.repeats > SEEDS:
            raise InputError(f"--seed {self.seed} leaves no seeds for {self.repeats} repeats; choose a smaller one")


def _listed(fractions: tuple[float, ...]) -> str:
    return " ".join(map(fraction_key, fractions))
