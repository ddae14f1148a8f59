"""One measured share of one run, as the report shows it."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

from pandas import DataFrame

from tasks.aoa import arms
from tasks.metrics import AoaMetrics, MixMetrics
from tasks.page.records import Records

AoaRecords = Records[AoaMetrics]


@dataclass(frozen=True)
class Share:
    """One measured share of one run.

    Args:
        run: the records of the run.
        key: the share as metrics.json and file names have it.
    """

    run: AoaRecords
    key: str

    @classmethod
    def of(cls, run: AoaRecords) -> list[Share]:
        """All shares of a run."""
        return [cls(run, key) for key in run.metrics["mixes"]]

    @property
    def mix(self) -> MixMetrics:
        """Its numbers."""
        return self.run.metrics["mixes"][self.key]

    def drawn_by(self, names: Iterable[str]) -> list[str]:
        """The synthesizers whose spectra train these arms; that of the first repeat, where repeats chose differently."""
        choice = self.mix["choice"]
        return arms.drawn_by(names) or ([choice["name"]] if choice else [])

    @property
    def percent(self) -> str:
        """The measured share in words."""
        return f"{float(self.key):.0%}"

    @property
    def file_name(self) -> str:
        """What its figures are called after."""
        return f"mix{self.key}-{self.run.file_name}"

    @property
    def title(self) -> str:
        """The share, and which run it is of where there are several."""
        return f"{self.percent} measured{self.run.label}"


def first_history(run: AoaRecords) -> DataFrame:
    """History of everything trained for the first share and repeat."""
    history = run.table("history")
    if not len(history):
        return history
    return history[(history["repeat"] == 0) & (history["mix"] == history["mix"].iloc[0])]


def fits(run: AoaRecords) -> tuple[DataFrame, DataFrame]:
    """History of the fits of SwiftWRF for the first share and repeat: of each size that was tried, and of the final one."""
    history = first_history(run)
    if "n_primitives" not in history:
        return history.iloc[:0].assign(steps=0), history.iloc[:0].assign(steps=0)
    own = history[history["synthesizer"] == "swiftwrf"]
    return own[own["stage"] == "search"], own[own["stage"] == "final"]
