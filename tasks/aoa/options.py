"""Options of python -m tasks.aoa, and their checks."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Annotated, Literal

from augment.suggest import MAX_SUGGESTIONS
from swiftwrf import InputError, Spectra
from swiftwrf.data.raytraced import check_scene, sionna
from swiftwrf.data.spectra import Moving
from swiftwrf.metrics import WINDOW
from swiftwrf.models import FIELD_MODELS
from tasks.aoa.condition import AUTO, fraction_key
from tasks.page import labels
from tasks.run import SEEDS, Preset, choice
from tasks.source import SpectraSource, reading

RAYTRACE = "raytrace"  # the field model that takes --scene
PAPER_FRACTIONS = (0.1, 0.3, 0.5, 0.7)
DEFAULT_EXTRA = 3000  # further synthetic positions where cross-validation recommends some


@dataclass(frozen=True)
class AoaConfig(SpectraSource):
    """Angle of arrival with few measured spectra: turbo learning against its references and baselines.

    Without --data the built-in simulated room is used. --resume DIR.partial continues an interrupted run, on a cluster with
    --scheduler.
    """

    mix: tuple[float, ...] = ()
    """measured fractions, each in (0, 1]: 0.3 keeps 30 % of the training spectra and synthesizes the others (default with
    --preset paper: 0.1 0.3 0.5 0.7)"""
    data: str | None = None
    """folder or file of spectra, ray paths or array snapshots, see docs/formats.md"""
    split: str = "random"
    """a split that comes with the data, or a seeded one: random or block"""
    synthesizer: Annotated[
        tuple[str, ...],
        choice(
            f"field models of the synthetic spectra; {AUTO} chooses the one that predicts held-out measured spectra best",
            FIELD_MODELS,
            labels.FIELD_MODELS,
        ),
    ] = (AUTO,)
    scene: str | None = None
    """room of tasks.scenes or Mitsuba scene (FILE.xml) for --synthesizer raytrace, in the coordinates of the data (default:
    the room that it estimates from the spectra)"""
    extra: int | None = None
    """number of further synthetic positions in the region of the measured ones (default: 3000 if cross-validation on the
    measured spectra shows a gain, else none; none with --preset paper)"""
    suggest: int = 0
    """number of positions to suggest for the next measurements, those that reduce the uncertainty over the region most"""
    moving: Moving | None = None
    """which end moves in the built-in room (default: transmitter)"""
    preset: Preset = "quick"
    """quick: sized for a CPU; paper: the paper's model, network and measured fractions, and a long training, for a GPU"""
    repeats: int = 1
    """runs with different measured spectra and networks, pooled"""
    scheduler: str | None = None
    """address of a Dask scheduler whose workers compute the steps of the run (extra: cluster)"""
    seed: int = 0
    """seed of everything random"""
    out: str | None = None
    """directory of the run; must not exist (default: a new one under runs/aoa)"""
    device: Literal["auto", "cpu", "cuda"] = "auto"
    """device to compute on"""


def with_preset(config: AoaConfig) -> AoaConfig:
    """Return the options with those of the paper where --preset paper leaves them open.

    Example:
        >>> with_preset(AoaConfig(preset="paper")).mix
        (0.1, 0.3, 0.5, 0.7)
    """
    if config.preset != "paper":
        return config
    # the paper's training sets contain synthetic spectra at the withheld positions alone
    return replace(config, mix=config.mix or PAPER_FRACTIONS, extra=config.extra or 0)


def check(config: AoaConfig) -> None:
    """Refuse options that are wrong whatever the data.

    Raises:
        InputError: The first such option.
    """
    if not config.synthesizer:
        raise InputError("--synthesizer takes at least one name")
    if AUTO in config.synthesizer and len(config.synthesizer) > 1:
        raise InputError(f"--synthesizer takes {AUTO} or names, not both: {' '.join(config.synthesizer)}")
    for name in config.synthesizer:
        if name != AUTO:
            FIELD_MODELS[name]  # refuses an unknown name
    if RAYTRACE in config.synthesizer:
        sionna()  # refuses before anything is computed
    if config.scene is not None:
        _check_scene(config.scene, config.synthesizer)
    if config.extra is not None and config.extra < 0:
        raise InputError(f"--extra takes a number of positions, got {config.extra}")
    if not 0 <= config.suggest <= MAX_SUGGESTIONS:
        raise InputError(f"--suggest takes 0 to {MAX_SUGGESTIONS} positions, got {config.suggest}")
    if config.moving is not None and config.data is not None:
        raise InputError("--moving is for the built-in room; with --data the data say which end moves")
    if not config.mix or not all(0 < fraction <= 1 for fraction in config.mix):
        raise InputError(f"--mix takes measured fractions in (0, 1], got {_listed(config.mix) or 'none'}")
    if len(set(config.mix)) < len(config.mix):
        raise InputError(f"--mix names a fraction twice: {_listed(config.mix)}")
    if reading(config).given and config.data is None:
        raise InputError(f"--{reading(config).given[0]} says how --data is read; give it with --data")
    if config.repeats < 1:
        raise InputError(f"--repeats must be at least 1, got {config.repeats}")
    if config.seed + config.repeats > SEEDS:
        raise InputError(f"--seed {config.seed} leaves no seeds for {config.repeats} repeats; choose a smaller one")


def _listed(fractions: tuple[float, ...]) -> str:
    return " ".join(map(fraction_key, fractions))


def _check_scene(scene: str, synthesizers: tuple[str, ...]) -> None:
    if RAYTRACE not in synthesizers:
        raise InputError(f"--scene is for synthesizer {RAYTRACE}; add it to --synthesizer, or leave --scene out")
    check_scene(scene, "--scene ")


def check_data(data: Spectra, config: AoaConfig) -> None:
    """Refuse data that do not meet the requirements of the options.

    Raises:
        InputError: Spectra too small to compute their SSIM, or a field model needs the array or the fixed end, and neither
            data nor command line describe it.
    """
    if min(data.grid.shape) < WINDOW:
        raise InputError(
            f"spectra of {data.name} have {data.grid.shape[0]} x {data.grid.shape[1]} pixels; SSIM, the measure "
            f"of their quality, needs at least {WINDOW} x {WINDOW}"
        )
    for name in config.synthesizer:
        missing = [] if name == AUTO else FIELD_MODELS[name].lacking(data)
        if missing:
            hint = "give it with --array" if "array" in missing else "the data must say where it stands"
            raise InputError(f"synthesizer {name} needs the {missing[0]}, which {data.name} does not describe; {hint}")


def n_synthetic(data: Spectra, config: AoaConfig) -> int:
    """Return the largest number of further synthetic positions.

    Raises:
        InputError: --extra asks for some, but the direction at other positions is unknown.
    """
    if config.extra:
        data.direction_at(data.position[:1])  # refuses unknown geometry
    known = data.fixed_position is not None and data.rotation is not None
    return config.extra if config.extra is not None else DEFAULT_EXTRA if known else 0
