"""From measured RSSI to a model: what all receivers share, each receiver's fit, and how far to trust it."""

from __future__ import annotations

import functools
import time
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from swiftwrf.data.rssi import Rssi
from swiftwrf.errors import InputError
from swiftwrf.rssi.choose import comparable, mixing_weights
from swiftwrf.rssi.config import RssiConfig
from swiftwrf.rssi.head import pooled
from swiftwrf.rssi.learn import learn
from swiftwrf.rssi.model import RssiModel
from swiftwrf.rssi.prepare import Setting, check, prepare
from swiftwrf.rssi.solve import Fitted, Group, solve
from swiftwrf.rssi.state import State, fingerprint
from swiftwrf.rssi.uncertainty import LEVEL, known
from swiftwrf.runtime.progress import progress_bar
from swiftwrf.runtime.threads import single_thread

GROUP = 4  # receivers a task: a state is kept after each, and a cluster's workers take one each
Map = Callable[[Callable[[Any], Any], Iterable[Any]], Iterable[Any]]


def fit_rssi(
    train: Rssi,
    config: RssiConfig | None = None,
    *,
    pool: Rssi | None = None,
    device: torch.device | str = "cpu",
    parallel: Map = map,
    checkpoint: Path | None = None,
    on_record: Callable[[dict[str, Any]], None] | None = None,
    progress: bool = True,
) -> RssiModel:
    """Fits all receivers; same data, configuration and machine give the same model.

    Whatever has to be chosen is chosen on five held-out folds of the training rows: the kernel and whether there are
    primitives at all, the weights of the field beside simpler predictors (the receiver's law, the law of all receivers, the
    receiver's mean), and the width of the interval.

    Args:
        train: the only rows it sees; a receiver's missing values do not count. A receiver heard in fewer than 10 rows falls
            back to the law of all receivers. Where the receivers' positions are unknown, each law is a level.
        config: how; `RssiConfig()` unless given.
        pool: the same rows at every receiver of the data, of which `train` has some: the kernel and the law of all
            receivers are learnt from them.
        device: where to compute; the model that comes back is on the CPU.
        parallel: maps the fit over groups of receivers; give one that spreads work over processes or machines.
        checkpoint: a file that keeps the groups that are fitted; where it exists, the fit goes on from it.
        on_record: called when the kernel is chosen and after each group of receivers with stage (search, final), group,
            n_primitives, validation loss (mean absolute error of held-out sites [dB]; not in the search) and seconds.
        progress: show a progress bar on a terminal.

    Raises:
        InputError: fewer than 10 measurements in all, something not finite, a pool of other rows, a checkpoint of another
            fit, or all measurements in one part of the region, where other parts are held out.
        FitError: a fit that broke.
    """
    config, pool, began = config or RssiConfig(), pool or train, time.perf_counter()
    check(train, pool)
    told = on_record or (lambda record: None)
    state = State(checkpoint, fingerprint(config, train, pool))
    setting = prepare(train, pool, config)
    told({"stage": "search", "n_primitives": setting.n_primitives, "seconds": time.perf_counter() - began})
    groups = [setting.columns(slice(start, start + GROUP)) for start in range(0, len(train.receiver_names), GROUP)]
    pending = [number for number in range(len(groups)) if number not in state.fitted]
    task = functools.partial(
        learn if config.plain else solve,
        kernel=setting.kernel,
        config=config,
        n_primitives=setting.n_primitives,
        device=torch.device(device),
    )
    with progress_bar(progress) as bar:
        results = parallel(task, [groups[number] for number in pending])
        done = bar.track(zip(pending, results, strict=True), total=len(pending), description="groups of receivers")
        for number, fitted in done:
            state.add(number, fitted)
            told(_record(number, fitted, groups[number], setting, time.perf_counter() - began))
    parts = zip(*(state.fitted[number] for number in range(len(groups))), strict=True)
    along = (0, 0, 0, 1, 0, 1)  # the dimension of the receivers in each field of `Fitted`
    return _assemble(train, setting, Fitted(*(torch.cat(p, dim=d) for p, d in zip(parts, along, strict=True))), config)


def _record(number: int, fitted: Fitted, group: Group, setting: Setting, seconds: float) -> dict[str, Any]:
    return {
        "stage": "final",
        "group": number,
        "n_primitives": setting.n_primitives,
        "validation": float((fitted.held_out - group.rssi).abs().nanmean()),
        "seconds": seconds,
    }


@single_thread()
def _assemble(train: Rssi, setting: Setting, fitted: Fitted, config: RssiConfig) -> RssiModel:
    """The model: the mixture worked into its tensors, and the interval's width."""
    predictions = torch.cat([fitted.held_out[None], setting.held_out])
    row, group, kernel = setting.sites.of_row, setting.whole, setting.kernel
    weight = torch.tensor([1.0, 0, 0, 0], dtype=torch.float64)
    if not comparable(predictions[: 1 if config.plain else None, row], train.rssi_dbm).any():
        raise InputError(
            "nothing can be held out to tell how wrong the model is: all measurements are in one part of the region; "
            'measure elsewhere, too, give a pool of more receivers, or take validation="random"'
        )
    if not config.plain:
        weight = mixing_weights(predictions[:, row], train.rssi_dbm)
    level, slope = (
        torch.einsum("p,pr->r", weight, torch.stack(values))
        for values in zip((fitted.level, fitted.slope), *setting.simple, strict=True)
    )
    still = pooled(fitted.drawn, torch.zeros(1, len(level)))[0]
    somewhere = known(group.local, kernel)
    predicted = torch.einsum("p,pnr->nr", weight, predictions.where(weight[:, None, None] > 0, 0.0))
    score = ((train.rssi_dbm - predicted[row]) / _held_out_deviation(setting)[row]).abs()
    return RssiModel(
        receiver_names=tuple(map(str, train.receiver_names)),
        n_primitives=setting.n_primitives,
        kernel=kernel,
        weight=weight,
        # where it is unknown, any will do: the law has no slope and the directivity is 0
        receiver=train.receiver_position.double().nan_to_num(0.0),
        centre=setting.centre,
        level=level,
        slope=slope,
        directivity=(weight[0] * fitted.directivity).float(),
        anchor=group.local.float(),
        coefficient=fitted.coefficient.float(),
        drawn=fitted.drawn,
        offset=torch.zeros_like(still) if config.plain else still,
        share=weight[:1].float(),
        known_position=somewhere.position.float(),
        known_root=somewhere.root.float(),
        field_db=group.field_db.float(),
        noise_db=group.noise_db.float(),
        widening=score[score.isfinite()].quantile(LEVEL).float()[None],
    )


def _held_out_deviation(setting: Setting) -> Tensor:
    """Of a measurement about what all other folds say of its site, (n, R) [dB]: as `RssiModel` has it, without the fold.

    So the interval is cross-conformal (V. Vovk, Annals of Mathematics and Artificial Intelligence 74, 2015): each row's
    error is taken in units of what a model without it would have said.
    """
    group, unknown = setting.whole, torch.empty(len(setting.whole.local), dtype=torch.float64)
    for number in group.fold.unique():
        out = group.fold == number
        unknown[out] = known(group.local[~out], setting.kernel).unknown(group.local[out], setting.kernel)
    return (group.noise_db.square() + group.field_db.square() * unknown[:, None]).sqrt()
