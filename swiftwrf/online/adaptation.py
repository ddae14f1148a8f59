"""Adaptation of a model to a change of its scene."""

from __future__ import annotations

import torch

from swiftwrf.data.spectra import Spectra
from swiftwrf.metrics import psnr
from swiftwrf.models.process import ProcessModel

CORRELATIONS = (1.0, 0.8, 0.6, 0.4, 0.2, 0.05)  # of the fields before and after a change, that are compared
N_FOLDS = 5  # of the spectra after the change, by which they are compared


def adapted(before: ProcessModel, after: Spectra) -> tuple[ProcessModel, float]:
    """Return a model that has learnt spectra after a change, and the chosen correlation of the fields before and after it.

    The correlation is that with the highest mean PSNR of held-out spectra after the change. With 1, all spectra count alike.

    Args:
        before: Model of the spectra before the change.
        after: Spectra after the change.

    Raises:
        InputError: As `FieldModel.update`.

    Example:
        >>> import swiftwrf
        >>> data = swiftwrf.simulated_room(n=60)
        >>> model = swiftwrf.make_model("coarray").fit(data.subset(torch.arange(50)))
        >>> adapted(model, data.subset(torch.arange(50, 60)))[1] > 0.5
        True
    """
    parts = torch.arange(len(after)) % min(N_FOLDS, len(after))

    def held_out(model: ProcessModel) -> float:
        scores = []
        for number in parts.unique() if len(after) > 1 else ():
            out = after.subset(parts == number)
            predicted = model.update(after.subset(parts != number)).synthesize(out.position)
            scores.append(psnr(predicted.cpu(), out.spectrum))
        return float(torch.cat(scores).mean()) if scores else 0.0

    best = max(CORRELATIONS, key=lambda correlation: held_out(before.aged(correlation)))
    return before.aged(best).update(after), best
