"""The page of an update: error over time, what was surprising, and where the field changed."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import torch
from matplotlib.patches import Rectangle
from pandas import DataFrame

from swiftwrf import Rssi, Spectra
from swiftwrf.online import ObstacleMonitor, Scores, Step
from swiftwrf.positions import nearest
from tasks.page import figures
from tasks.page.page import Number, Page, Plot, Section, Summary, Table

WINDOW = 30  # measurements of the running error
MAX_SURPRISING = 10
N_NEIGHBOURS = 5  # measurements whose mean innovation a map shows at each position
BLUE, RED = "#4477aa", "#ee6677"


@dataclass(frozen=True, eq=False)
class Followed:
    """Measurements that a model learnt one after the other."""

    source: str
    data: Rssi | Spectra
    steps: list[Step]

    @property
    def scores(self) -> Scores:
        """Scores of all measurements."""
        return Scores.joined([step.scores for step in self.steps])

    @property
    def unit(self) -> str:
        """Unit of the errors, in brackets."""
        return " [dB]" if isinstance(self.data, Rssi) else ""

    @property
    def surprise(self) -> torch.Tensor:
        """Root mean square innovation of each measurement, (n,)."""
        return self.scores.innovation.square().nanmean(dim=1).sqrt()

    @property
    def alarms(self) -> list[tuple[int, str]]:
        """Number of the measurement that raised each alarm, and the change in words."""
        return [(number, text) for number, step in enumerate(self.steps) for text in step.alarms]

    def rows(self) -> list[dict[str, Any]]:
        """Return the table of the measurements."""
        scores, running = self.scores, self.scores.running_error(WINDOW)
        return [
            {
                "index": index,
                **dict(zip(("x_m", "y_m", "z_m"), position, strict=True)),
                "error": error,
                "running_error": mean,
                "innovation": surprise,
                "covered": covered,
                "alarm": "; ".join(step.alarms),
            }
            for index, position, error, mean, surprise, covered, step in zip(
                self.data.index.tolist(),
                scores.position.tolist(),
                scores.error.tolist(),
                running.tolist(),
                self.surprise.tolist(),
                scores.covered.tolist(),
                self.steps,
                strict=True,
            )
        ]

    def summary(self, obstacles: ObstacleMonitor | None) -> dict[str, Any]:
        """Return the results as plain values."""
        running = self.scores.running_error(WINDOW)
        changes = [
            {"measurement": number, "what": text, "correlation": self.steps[number].correlation}
            for number, text in self.alarms
        ]
        found: dict[str, Any] = {
            "source": self.source,
            "measurements": len(self.steps),
            "mean_error": float(self.scores.error.nanmean()),
            "last_running_error": float(running[-1]),
            "coverage": float(self.scores.covered.nanmean()),
            "alarms": changes,
        }
        if obstacles is not None:
            region = obstacles.region().nonzero()[:, 0]
            boxes, n = obstacles.boxes, len(obstacles.candidates)
            found["obstacles"] = [
                {
                    "low_m": boxes.low[i],
                    "high_m": boxes.high[i],
                    "evidence_nats": obstacles.value[i],
                    "left": bool(i >= n),
                }
                for i in region
            ]
        return found

    def sentences(self, obstacles: ObstacleMonitor | None) -> list[str]:
        """Return the results in sentences."""
        found = self.summary(obstacles)
        text = [
            f"{found['measurements']} measurements learnt, mean error {found['mean_error']:.4g}{self.unit} before each was "
            f"learnt, {found['last_running_error']:.4g} over the last {WINDOW}"
        ]
        text += [f"change at measurement {number}: {what}" for number, what in self.alarms] or ["no change detected"]
        if found.get("obstacles"):
            text.append(f"an obstacle appeared or left: {len(found['obstacles'])} candidate positions, see the map")
        return text


def page(followed: Followed, obstacles: ObstacleMonitor | None) -> Page:
    """Return the page."""
    scores = followed.scores
    numbers = [
        Number(str(len(scores)), "measurements learnt"),
        Number(f"{float(scores.error.nanmean()):.3g}{followed.unit}", "mean error before each was learnt"),
        Number(str(len(followed.alarms)), "changes detected"),
    ]
    if bool(scores.covered.isfinite().any()):
        numbers.append(Number(f"{float(scores.covered.nanmean()):.0%}", "of the values inside their 80 % interval"))
    summary = Summary(numbers, [_error(followed)], followed.sentences(obstacles), ["Continue with model.safetensors."])
    rows = followed.rows()
    order = followed.surprise.nan_to_num().argsort(descending=True)[:MAX_SURPRISING].tolist()
    cells = [
        [str(rows[i]["index"]), *(f"{rows[i][name]:.3g}" for name in ("x_m", "y_m", "z_m", "error", "innovation"))]
        for i in order
    ]
    columns = ["measurement", "x [m]", "y [m]", "z [m]", f"error{followed.unit}", "innovation"]
    changes = [[str(number), text] for number, text in followed.alarms]
    tables = [Table(columns, cells, "Measurements with the largest innovations.")]
    if changes:
        tables.append(Table(["measurement", "change"], changes, "Detected changes.", long=True))
    return Page(
        f"Update: {followed.data.name}",
        summary,
        [Section("Surprising measurements", tables=tables), Section("Changes", plots=[_map(followed, obstacles)])],
    )


def _error(followed: Followed) -> Plot:
    figure, axes = figures.new_figure(1, 1, 7.4, 3.2)
    error, running = followed.scores.error, followed.scores.running_error(WINDOW)
    axes[0].plot(error, ".", markersize=3, color=figures.RULE)
    axes[0].plot(running, color=BLUE)
    for number, _ in followed.alarms:
        axes[0].axvline(number, color=RED, linewidth=1)
    axes[0].set(xlabel="measurement", ylabel=f"error{followed.unit}", ylim=(0, None))
    caption = f"Error of each measurement before it was learnt, mean of the last {WINDOW} (blue), and alarms (red)."
    return Plot("error", [figure], caption, DataFrame({"error": error, "running_error": running}))


def _map(followed: Followed, obstacles: ObstacleMonitor | None) -> Plot:
    figure, axes = figures.new_figure(1, 1, 6.8, 5)
    position = followed.scores.position
    _, near = nearest(position, position, min(N_NEIGHBOURS, len(position)))
    surprise = followed.surprise[near].nanmean(dim=1)
    drawn = axes[0].scatter(position[:, 0], position[:, 1], s=10, c=surprise, cmap="viridis")
    figure.colorbar(drawn, ax=axes[0], label=f"mean innovation of the {N_NEIGHBOURS} nearest measurements")
    caption = "Positions from above, coloured by their innovations."
    if obstacles is not None:
        caption += " Grey: obstacles that the training spectra show. Red: where an obstacle can have appeared or left."
        region = obstacles.region()
        standing = torch.arange(len(region)) >= len(obstacles.candidates)
        for chosen, colour in ((standing, figures.RULE), (region, RED)):
            for low, high in zip(
                obstacles.boxes.low[chosen].tolist(), obstacles.boxes.high[chosen].tolist(), strict=True
            ):
                size = high[0] - low[0], high[1] - low[1]
                axes[0].add_patch(Rectangle((low[0], low[1]), *size, fill=False, edgecolor=colour))
        axes[0].autoscale_view()
    axes[0].set(xlabel="x [m]", ylabel="y [m]", aspect="equal")
    table = DataFrame(position.numpy(), columns=["x_m", "y_m", "z_m"]).assign(innovation=surprise.numpy())
    return Plot("changes", [figure], caption, table)
