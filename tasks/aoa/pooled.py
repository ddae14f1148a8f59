"""Arms that all repeats have, so that none is compared with bounds of more repeats than its own."""

from __future__ import annotations

from tasks.aoa import arms
from tasks.run import Row


def pooled(rows: list[Row], auto: bool) -> list[Row]:
    """Rows of arms, where each turbo arm has all repeats of its share.

    A repeat stands for a user, who chooses a synthesizer and whether to add further positions by cross-validation. Where
    repeats chose differently, what each would take is one arm.

    Args:
        rows: with `mix`, `repeat` and `method`.
        auto: whether repeats choose their synthesizer; `turbo_auto` is then the arm of what they chose. Else
            `turbo_NAME_extra` adds no further positions in the repeats that advise against them.
    """
    own: dict[float, dict[int, set[str]]] = {}
    for row in rows:
        if arms.is_turbo(row["method"]):
            own.setdefault(row["mix"], {}).setdefault(row["repeat"], set()).add(arms.training_of(row["method"]))
    unequal = {share: set().union(*of.values()) for share, of in own.items() if len({*map(frozenset, of.values())}) > 1}
    found: list[Row] = []
    for row in rows:
        method, share = row["method"], row["mix"]
        if share not in unequal or not arms.is_turbo(method):
            found.append(row)
            continue
        training, estimator = arms.training_of(method), arms.estimator_of(method)
        of_repeat, more = own[share][row["repeat"]], training + arms.EXTRA
        if auto:
            if training == max(of_repeat, key=lambda name: name.endswith(arms.EXTRA)):
                found.append(row | {"method": arms.arm(estimator, arms.AUTO)})
            continue
        found.append(row)
        if more in unequal[share] and more not in of_repeat:
            found.append(row | {"method": arms.arm(estimator, more)})
    return found
