"""The arms of the experiment: every estimator that learns, on each of the training sets.

Names, meanings and colours come from the registries of estimators and synthesizers. The network's arms are named after
their training set, the other estimators' by both.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

from augment import SYNTHESIZERS
from tasks.aoa.estimators import ESTIMATORS, learners
from tasks.page.palette import Palette

NETWORK = "aann"  # of the estimators: the one that the paper trains
TURBO = "turbo_"  # before the name of the synthesizer
EXTRA = "_extra"  # after it, where further positions are added to the withheld ones
AUTO = f"{TURBO}auto"  # what each repeat chose, where repeats chose differently


@dataclass(frozen=True)
class Bound:
    """What turbo learning is compared with: training sets without synthetic spectra."""

    name: str
    meaning: str
    colour: str


LOWER = Bound("measured_only", "lower bound: trained on the measured share alone", "#ee6677")
UPPER = Bound("measured_all", "upper bound: trained on all training spectra, measured", "#228833")


def turbo(synthesizer: str, extra: bool = False) -> str:
    """Name of the training set with spectra of this synthesizer, and with those at further positions."""
    return f"{TURBO}{synthesizer}{EXTRA if extra else ''}"


def arm(estimator: str, training: str) -> str:
    """Name of an estimator on a training set."""
    if estimator == NETWORK:
        return training
    return estimator if training == LOWER.name else f"{estimator}_{training}"


def training_of(name: str) -> str:
    """The training set of an arm of that name."""
    own = [estimator for estimator in ESTIMATORS if name == estimator or name.startswith(f"{estimator}_")]
    if not own:
        return name
    rest = name.removeprefix(max(own, key=len)).removeprefix("_")
    return rest or LOWER.name


def estimator_of(name: str) -> str:
    """The estimator of an arm of that name."""
    own = [estimator for estimator in ESTIMATORS if name == estimator or name.startswith(f"{estimator}_")]
    return max(own, key=len) if own else NETWORK


def is_network(name: str) -> bool:
    """Whether the arm's estimator is the network."""
    return estimator_of(name) == NETWORK


def is_turbo(name: str) -> bool:
    """Whether synthetic spectra train this arm."""
    return training_of(name).startswith(TURBO)


def taken(names: Iterable[str]) -> str:
    """Of these arms, the network's that a user would take and a run keeps: with the spectra of the first synthesizer, at
    further positions, too, where there are some. Errors play no part: the best of several on test spectra would flatter."""
    own = [name for name in names if is_turbo(name) and is_network(name)]
    return max(own, key=lambda name: name.endswith(EXTRA))  # the first of equals


def drawn_by(names: Iterable[str]) -> list[str]:
    """The synthesizers whose spectra train some of these arms."""
    trainings = dict.fromkeys(training_of(name) for name in names if is_turbo(name))
    return [name for name in SYNTHESIZERS if {turbo(name), turbo(name, extra=True)} & trainings.keys()]


def baselines() -> list[str]:
    """Names of the estimators on the measured share that the network must beat."""
    return [name for name in ESTIMATORS if name != NETWORK]


def terms() -> dict[str, str]:
    """What the names of arms mean."""
    return {
        **{bound.name: bound.meaning for bound in (LOWER, UPPER)},
        f"{TURBO}NAME": "trained on the measured share and on spectra that NAME synthesized at the withheld positions",
        f"{TURBO}NAME{EXTRA}": "the same, and at as many further positions as --extra says",
        AUTO: "what each repeat chose by cross-validation, synthesizer and further positions, where they chose differently",
        **{entry.name: entry.meaning for entry in ESTIMATORS.entries()},
        "no estimator's name": f"the network ({NETWORK}); an estimator's name alone is that one on the measured share",
    }


def meaning() -> str:
    """The same as text."""
    return "; ".join(f"{name}: {what}" for name, what in terms().items()) + "."


def synthesizers(names: Iterable[str]) -> dict[str, str]:
    """What the names of these synthesizers mean; runs may hold some that are registered no more."""
    return {name: SYNTHESIZERS[name].meaning for name in names if name in SYNTHESIZERS}


def palette() -> Palette:
    """Of synthesizers and arms; a turbo arm looks like its synthesizer, lighter without the further positions."""
    drawn = Palette.of(SYNTHESIZERS.entries()).colours
    colours = {bound.name: bound.colour for bound in (LOWER, UPPER)}
    colours |= Palette.of(ESTIMATORS.entries()).colours
    colours |= drawn
    for name, colour in drawn.items():
        colours |= {turbo(name): colour, turbo(name, extra=True): _darker(colour)}
    colours[AUTO] = "#332288"
    dashed = set(baselines())
    for estimator in learners():
        if estimator != NETWORK:
            for name, colour in list(colours.items()):
                if name in (LOWER.name, UPPER.name) or name.startswith(TURBO):
                    colours[arm(estimator, name)] = colour if name != LOWER.name else colours[estimator]
                    dashed.add(arm(estimator, name))
    return Palette(colours, frozenset(dashed))


def _darker(colour: str) -> str:
    return "#" + "".join(f"{int(int(colour[i : i + 2], 16) * 0.7):02x}" for i in (1, 3, 5))
