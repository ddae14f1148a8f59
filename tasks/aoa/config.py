"""The options of python -m tasks.aoa, and what is wrong with them."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated, Literal

from augment import SYNTHESIZERS, lacks
from augment.suggest import MOST as MOST_SUGGESTED
from swiftwrf import InputError, Spectra
from swiftwrf.data.raytraced import check_scene, sionna
from swiftwrf.data.spectra import Moving
from swiftwrf.metrics import WINDOW
from tasks.run import SEEDS, Preset, choice
from tasks.source import SpectraSource, reading

AUTO = "auto"  # the synthesizer that suits the scene
RAYTRACE = "raytrace"  # the synthesizer that takes --scene
EXTRA = 3000  # further positions unless told otherwise


@dataclass(frozen=True)
class AoaConfig(SpectraSource):
    """Angle of arrival with few measured spectra: turbo learning against its bounds and baselines.

    Without --data the built-in simulated room is used. An interrupted run goes on with --resume DIR.partial, here or where
    a --scheduler beside it says.
    """

    mix: tuple[float, ...]
    """measured shares, each in (0, 1]: 0.3 keeps 30 % of the training spectra and synthesizes the others"""
    data: str | None = None
    """folder or file of spectra, ray paths or array snapshots, see docs/formats.md"""
    split: str = "random"
    """a split that comes with the data, or a seeded one: random or block"""
    synthesizer: Annotated[
        tuple[str, ...],
        choice(
            f"methods that draw the synthetic spectra; {AUTO} takes the one that predicts held-out measured spectra best",
            SYNTHESIZERS,
        ),
    ] = (AUTO,)
    scene: str | None = None
    """room of tasks.scenes or Mitsuba scene (FILE.xml) that synthesizer raytrace traces, in the coordinates of the data
    (default: the room that it finds from the spectra)"""
    extra: int | None = None
    """further positions in the region of the measured ones at which spectra are synthesized, too (default: 3000 where
    held-out measured spectra gain from them, else none)"""
    suggest: int = 0
    """also say where to measure next: so many positions that lower the uncertainty over the region most"""
    moving: Moving | None = None
    """which end moves in the built-in room (default: transmitter)"""
    preset: Preset = "quick"
    """quick: sized for a CPU; paper: the paper's model and a long training, for a GPU"""
    repeats: int = 1
    """runs with different random shares and networks, pooled"""
    scheduler: str | None = None
    """address of a Dask scheduler whose workers compute the steps of the run (extra: cluster)"""
    seed: int = 0
    """of everything random"""
    out: str | None = None
    """directory of the run; must not exist (default: a new one under runs/aoa)"""
    device: Literal["auto", "cpu", "cuda"] = "auto"
    """where to compute"""


def check(config: AoaConfig) -> None:
    """Refuses what makes no sense whatever the data.

    Raises:
        InputError: such an option.
    """
    if not config.synthesizer:
        raise InputError("--synthesizer takes at least one name")
    if AUTO in config.synthesizer and len(config.synthesizer) > 1:
        raise InputError(f"--synthesizer takes {AUTO} or names, not both: {' '.join(config.synthesizer)}")
    for name in config.synthesizer:
        if name != AUTO:
            SYNTHESIZERS[name]  # refuses an unknown one
    if RAYTRACE in config.synthesizer:
        sionna()  # refuses before anything is computed
    if config.scene is not None:
        _check_scene(config.scene, config.synthesizer)
    if config.extra is not None and config.extra < 0:
        raise InputError(f"--extra takes a number of positions, got {config.extra}")
    if not 0 <= config.suggest <= MOST_SUGGESTED:
        raise InputError(f"--suggest takes 0 to {MOST_SUGGESTED} positions, got {config.suggest}")
    if config.moving is not None and config.data is not None:
        raise InputError("--moving is for the built-in room; with --data the data say which end moves")
    if not config.mix or not all(0 < share <= 1 for share in config.mix):
        raise InputError(
            f"--mix takes measured shares in (0, 1], got {' '.join(f'{s:g}' for s in config.mix) or 'none'}"
        )
    if len(set(config.mix)) < len(config.mix):
        raise InputError(f"--mix names a share twice: {' '.join(f'{s:g}' for s in config.mix)}")
    if reading(config).given and config.data is None:
        raise InputError(f"--{reading(config).given[0]} says how --data is read; give it with --data")
    if config.repeats < 1:
        raise InputError(f"--repeats must be at least 1, got {config.repeats}")
    if config.seed + config.repeats > SEEDS:
        raise InputError(f"--seed {config.seed} leaves no seeds for {config.repeats} repeats; choose a smaller one")


def _check_scene(scene: str, synthesizers: tuple[str, ...]) -> None:
    if RAYTRACE not in synthesizers:
        raise InputError(f"--scene is for synthesizer {RAYTRACE}; add it to --synthesizer, or leave --scene out")
    check_scene(scene, "--scene ")


def check_data(data: Spectra, config: AoaConfig) -> None:
    """Refuses data that what is asked for cannot work with.

    Raises:
        InputError: spectra too small to be compared; a synthesizer needs the array, and neither data nor command line
            describe it.
    """
    if min(data.grid.shape) < WINDOW:
        raise InputError(
            f"spectra of {data.name} have {data.grid.shape[0]} x {data.grid.shape[1]} pixels; SSIM, by which they are "
            f"learnt and judged, needs at least {WINDOW} x {WINDOW}"
        )
    for name in config.synthesizer:
        missing = [] if name == AUTO else lacks(name, data)
        if missing:
            hint = "give it with --array" if "array" in missing else "the data must say where it stands"
            raise InputError(f"synthesizer {name} needs the {missing[0]}, which {data.name} does not describe; {hint}")


def further_positions(data: Spectra, config: AoaConfig) -> int:
    """How many further positions are synthesized at.

    Raises:
        InputError: some were asked for, but the directions there are unknown.
    """
    if config.extra:
        data.direction_at(data.position[:1])  # refuses
    known = data.fixed_position is not None and data.rotation is not None
    return config.extra if config.extra is not None else EXTRA if known else 0
