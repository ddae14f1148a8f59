"""Checks that an implementation keeps the contract of its base class, in one line of the tests of another package.

`augment.testing.check_estimator` checks estimators of the direction.
"""

from __future__ import annotations

import shutil
from collections.abc import Callable
from dataclasses import fields, replace
from functools import partial
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import torch
from torch import Tensor

from swiftwrf.array.angles import AngularGrid
from swiftwrf.data.formats.base import Format, ReadOptions
from swiftwrf.data.rssi import Rssi
from swiftwrf.data.simulated import rssi_room, simulated_room
from swiftwrf.data.snapshots import Snapshots
from swiftwrf.data.spectra import Spectra
from swiftwrf.errors import InputError, NotFitted
from swiftwrf.models.base import ARRAY, FIXED_END, FieldModel
from swiftwrf.models.prediction import Prediction
from swiftwrf.rssi.base import RssiPredictor
from swiftwrf.runtime.checkpoint import Saved, load
from swiftwrf.runtime.validation import Configured

__all__ = ["check_field_model", "check_not_fitted", "check_predictor", "check_reader", "check_saved"]
STEPS_M = (1e-3, 1e-4)  # of finite differences; a local process jumps where its neighbours change


def check_field_model(
    model: FieldModel, data: Spectra | None = None, *, device: str = "cpu", is_differentiable: bool = True
) -> None:
    """Check that a field model keeps the contract of `FieldModel`, and fit it.

    Predictions are finite magnitudes, the same in every batch and from a file. They have gradients by the position, and on a
    finer grid the same values, if the model takes other grids. Wrong calls are refused.

    Args:
        model: Model that is not fitted, with its options.
        data: Training spectra, at least 30, which meet all requirements, on a grid of `AngularGrid.hemisphere`. Defaults to
            40 spectra of the simulated room.
        device: Device to fit on.
        is_differentiable: Whether the mean has a gradient by the position. Without one it must not require it.

    Raises:
        AssertionError: The first sentence that does not hold.

    Example:
        >>> import swiftwrf
        >>> check_field_model(swiftwrf.make_model("idw"))
    """
    data = data or simulated_room(n=40, grid=AngularGrid.hemisphere(15, 60))
    require(model, set(model.requires) <= {ARRAY, FIXED_END}, "requires names an unknown property of the data")
    check_not_fitted(model)
    require_refusal(model, "a prediction before the fit", lambda: model.predict(data.position), "call fit first")
    require_refusal(model, "a fit to 9 spectra", lambda: model.fit(data.subset(torch.arange(9))))
    bare = replace(data, array=None, rotation=None, fixed_position=None, frequency_hz=None, channel=None)
    if model.requires:
        require_refusal(model, f"spectra without {' and '.join(model.requires)}", lambda: model.fit(bare))
    require(model, model.fit(data, device=device) is model and model.is_fitted, "fit does not return the fitted model")
    is_trained = any(tensor.requires_grad for tensor in model.parameters())
    require(model, not is_trained, "fit leaves parameters that require gradients")
    require(model, model.region().device.type == "cpu", "region is not on the CPU")
    position = data.position[:3] + torch.tensor([0.05, -0.03, 0.02], dtype=torch.float64)
    prediction = model.predict(position)
    mean = prediction.mean
    _check_prediction(model, model.predict, position, (3, *data.grid.shape), atol=2e-5)
    require(model, mean.dtype == torch.float32 and mean.device == model.device, "the mean is not float32 on its device")
    require(model, ((mean >= 0) & (mean <= 1)).all(), "the mean is outside [0, 1]")
    require(model, torch.equal(model.synthesize(position), mean), "synthesize gives another mean than predict")
    far = torch.tensor([[1e7] * 3, [1e9] * 3], dtype=torch.float64)
    require(model, model.synthesize(far).isfinite().all(), "the mean far away is not finite")
    require_refusal(model, "positions in a plane", lambda: model.predict(torch.zeros(4, 2)), "shape (n, 3)")
    require_refusal(model, "a position of nan", lambda: model.predict(torch.full((1, 3), torch.nan)), "finite")
    _check_gradient(model, lambda at: model.predict(at).mean, position, is_differentiable)
    fine = AngularGrid.hemisphere(*(2 * size for size in data.grid.shape))
    if model.any_grid:  # on a grid twice as fine, every second pixel is the same
        for of_fine, part in zip(_parts(model.predict(position, fine)), _parts(prediction), strict=True):
            close(model, of_fine[:, 1::2, ::2], part, "a finer grid gives other values", 1e-4)
        odd = model.synthesize(position, AngularGrid.hemisphere(7, 30))
        require(
            model, odd.shape == (3, 7, 30), f"a grid of 7 x 30 directions gives spectra of shape {tuple(odd.shape)}"
        )
    else:
        require_refusal(model, "another grid", lambda: model.predict(position, fine))
    if type(model).saved == FieldModel.saved:
        require_refusal(model, "a file without `saved`", model.state, "must name what `_fit` sets")
    else:
        check_saved(model, lambda loaded: loaded.predict(position))
    if type(model).accepts_like(model):
        again = type(model)(model.config).fit(data.subset(torch.arange(30)), like=model)
        require(model, again.predict(position).mean.isfinite().all(), "a fit with its structure is not finite")


def check_predictor(predictor: RssiPredictor, data: Rssi | None = None, *, is_differentiable: bool = True) -> None:
    """Check that a predictor of RSSI keeps the contract of `RssiPredictor`, and fit it.

    Predictions are finite, also far away and at receivers that are rarely or never detected. They are the same in every
    batch, from a file and for any names of receivers. Wrong calls are refused, and so are data without the positions of the
    receivers if the predictor needs them.

    Args:
        predictor: Predictor that is not fitted, with its options.
        data: Training rows at four receivers or more. Defaults to 60 rows of the simulated floor at four receivers.
        is_differentiable: Whether predictions have gradients by the position. Without them they must not require any.

    Raises:
        AssertionError: The first sentence that does not hold.

    Example:
        >>> import swiftwrf
        >>> check_predictor(swiftwrf.RssiModel())
    """
    data = data or rssi_room(n=60).columns([0, 1, 2, 3])
    position, kind = data.transmitter_position[:5] + 0.1, type(predictor)
    check_not_fitted(predictor)
    require_refusal(predictor, "a prediction before the fit", lambda: predictor.predict(position), "call fit first")
    require(predictor, predictor.fit(data) is predictor and predictor.is_fitted, "fit does not return the predictor")
    require(predictor, predictor.receiver_names == data.receiver_names, "the receivers are not those of the data")
    _check_prediction(predictor, predictor.predict, position, (len(position), len(data.receiver_names)), atol=1e-3)
    parts = _parts(predictor.predict(position))
    for number in range(len(parts)):
        part = partial(lambda at, number: _parts(predictor.predict(at))[number], number=number)
        _check_gradient(predictor, part, position, is_differentiable)
    far = _parts(predictor.predict(torch.tensor([[1e8, 0.0, 0.0]])))
    require(predictor, all(part.isfinite().all() for part in far), "a prediction far away is not finite")
    renamed = replace(data, receiver_names=tuple(f"z{99 - number}" for number in range(len(data.receiver_names))))
    again = _parts(kind(predictor.config).fit(renamed).predict(position))
    close(predictor, torch.cat(again), torch.cat(parts), "names of receivers change a prediction", atol=1e-3)
    detection = predictor.predict_detection(position)
    require(predictor, ((detection >= 0) & (detection <= 1)).all(), "the probability of detection leaves [0, 1]")
    require_refusal(predictor, "positions in a plane", lambda: predictor.predict(torch.zeros(4, 2)), "shape (n, 3)")
    rare = data.rssi_dbm.clone()
    rare[:, 0] = rare[1:, 1] = torch.nan
    rare[:, 2][data.transmitter_position[:, 0] > data.transmitter_position[:, 0].median()] = torch.nan
    for rows in (replace(data, rssi_dbm=rare), replace(data, receiver_position=data.receiver_position * torch.nan)):
        if lacking := predictor.lacking(rows):
            require_refusal(predictor, "data that lack a requirement", partial(predictor.fit, rows), lacking)
        else:
            mean = kind(predictor.config).fit(rows).predict(position).mean
            require(predictor, mean.isfinite().all(), "the mean is not finite at receivers that are rarely detected")
    if isinstance(predictor, Saved):
        check_saved(predictor, lambda loaded: loaded.predict(position))


def check_reader(reader: Format[Any] | type[Format[Any]], path: str | Path, options: ReadOptions | None = None) -> None:
    """Check that a reader recognises and reads a sample, and that it refuses damaged files by one sentence.

    Args:
        reader: Reader, or its class.
        path: Folder or file of its layout, at most some MB, of which damaged copies are read.
        options: Options of reading that the sample needs.

    Raises:
        AssertionError: The first sentence that does not hold.

    Example:
        >>> import pandas as pd
        >>> from swiftwrf.data.formats import RSSI_FORMATS
        >>> with TemporaryDirectory() as folder:
        ...     table = Path(folder, "walk.csv")
        ...     pd.DataFrame({"x": range(9), "y": 1, "a": -70, "b": range(-59, -50)}).to_csv(table, index=False)
        ...     check_reader(RSSI_FORMATS["survey"], table)
    """
    path, options = Path(path), options or ReadOptions()
    reader = reader() if isinstance(reader, type) else reader
    unknown = reader.takes - {field.name for field in fields(ReadOptions)}
    require(reader, not unknown, f"takes names the unknown options {sorted(unknown)}")
    require(reader, reader.recognises(path), "the sample is not recognised")
    data, again = reader.read(path, options), reader.read(path, options)
    require(reader, isinstance(data, Spectra | Snapshots | Rssi), "the result is neither Spectra, Snapshots nor Rssi")
    values, repeated = (getattr(rows, rows.row_fields[1])[:] for rows in (data, again))
    close(reader, repeated, values, "a second reading gives other values", atol=0)
    with TemporaryDirectory() as folder:
        require(reader, not reader.recognises(Path(folder)), "an empty folder is recognised")
        for file in [path] if path.is_file() else sorted(file for file in path.rglob("*") if file.is_file()):
            copied = Path(folder, file.stem)
            copied.mkdir()
            whole = Path(shutil.copytree(path, copied / path.name) if path.is_dir() else shutil.copy(path, copied))
            damaged = whole if path.is_file() else whole / file.relative_to(path)
            content = damaged.read_bytes()
            for part in (content[: len(content) // 2], b"", content[::-1]):
                damaged.write_bytes(part)
                try:
                    reader.read(whole, options)
                except InputError:
                    continue
                except Exception as error:
                    require(reader, False, f"a damaged {file.name} raises {error!r}, not InputError")


# what the checks share


def require(subject: object, holds: bool | Tensor, sentence: str) -> None:
    """Raise AssertionError with the class and a sentence unless a condition holds."""
    if not holds:
        raise AssertionError(f"{type(subject).__name__}: {sentence}")


def require_refusal(subject: object, what: str, call: Callable[[], object], words: str = "") -> None:
    """Require that a call raises InputError whose sentence contains some words."""
    try:
        call()
    except InputError as error:
        require(subject, words in str(error), f"{what} is refused without the words {words!r}: {error}")
    else:
        require(subject, False, f"{what} is accepted, not refused by InputError")


def close(subject: object, tensor: Tensor, expected: Tensor, sentence: str, atol: float) -> None:
    """Require that a tensor is close to another one, of the same shape and type."""
    torch.testing.assert_close(
        tensor,
        expected,
        atol=atol,
        rtol=0,
        equal_nan=True,
        msg=lambda text: f"{type(subject).__name__}: {sentence}. {text}",
    )


def check_not_fitted(model: Configured) -> None:
    """Check what holds before a fit: attributes that a fit determines and unknown options are refused."""
    require(model, not model.is_fitted, "the model is fitted already; give one with its options alone")
    require_refusal(model, "an unknown option", lambda: type(model)(sead=1), "has no option 'sead'")
    for kind in type(model).__mro__:
        for name, value in vars(kind).items():
            if isinstance(value, property):
                try:
                    getattr(model, name)
                except NotFitted:  # a property that no fit determines has a value
                    pass
                except Exception as error:
                    require(model, False, f"{name} before the fit raises {error!r}, not NotFitted")


def check_saved(model: Saved, predict: Callable[[Any], Prediction | Tensor]) -> None:
    """Check that a fitted model from its file has the same options and predictions."""
    with TemporaryDirectory() as folder:
        model.save(Path(folder, "model"))
        loaded = load(Path(folder, "model"))
    require(
        model, (type(loaded), loaded.config) == (type(model), model.config), "a file gives another class or options"
    )
    for of_file, expected in zip(_parts(predict(loaded)), _parts(predict(model)), strict=True):
        atol = 1e-6 if expected.device.type == "cpu" else 1e-4  # a file is loaded to the CPU
        close(model, of_file, expected.cpu(), "a file gives other predictions", atol)


def _parts(prediction: Prediction | Tensor) -> list[Tensor]:
    """Return the tensors of a prediction."""
    if isinstance(prediction, Tensor):
        return [prediction]
    return [prediction.mean] if prediction.std is None else [prediction.mean, prediction.std]


def _check_prediction(
    model: Configured, predict: Callable[[Tensor], Prediction], position: Tensor, shape: tuple[int, ...], atol: float
) -> None:
    """Check shapes, finite values, and that repeated, single and no positions give the same predictions."""
    parts, again = _parts(predict(position)), _parts(predict(position))
    for part, repeated in zip(parts, again, strict=True):
        require(model, part.shape == shape, f"a prediction has shape {tuple(part.shape)}, not {shape}")
        require(model, part.isfinite().all(), "a prediction is not finite")
        require(model, torch.equal(part, repeated), "a second prediction differs from the first")
        require(model, not part.requires_grad, "a prediction requires gradients that nobody asked for")
    require(model, (parts[-1] >= 0).all() or len(parts) == 1, "a standard deviation is negative")
    if len(parts) == 1:
        require_refusal(model, "an interval", predict(position).interval, "no standard deviation")
    for part, *each in zip(parts, *(_parts(predict(one[None])) for one in position), strict=True):
        close(model, torch.cat(each), part, "single positions give other predictions than all at once", atol)
    empty = [tuple(part.shape) for part in _parts(predict(position[:0]))]
    require(model, empty == len(parts) * [(0, *shape[1:])], f"no position gives predictions of shapes {empty}")
    predict(position.float())


def _check_gradient(
    model: object, predict: Callable[[Tensor], Tensor], position: Tensor, is_differentiable: bool
) -> None:
    """Check gradients of a random combination of predictions by the position against finite differences."""
    position = position.clone().requires_grad_()
    weight = torch.rand(predict(position[:1]).shape[1:], generator=torch.Generator().manual_seed(0)).double()

    def total(at: Tensor) -> Tensor:
        return (predict(at).double().cpu() * weight).flatten(1).sum(dim=1)

    sums = total(position)
    require(model, sums.requires_grad == is_differentiable, f"is_differentiable={is_differentiable} is not so")
    if is_differentiable:
        (gradient,) = torch.autograd.grad(sums.sum(), position)
        steps = torch.tensor(STEPS_M, dtype=torch.float64)[:, None, None] * torch.eye(3, dtype=torch.float64)
        with torch.no_grad(), torch.backends.cudnn.flags(allow_tf32=False):  # whose 10 bits drown differences on a GPU
            ends = [[total(position + step) - total(position - step) for step in axes] for axes in steps]
        first, second = (torch.stack(end, dim=1) / (2 * step) for end, step in zip(ends, STEPS_M, strict=True))
        expected = first.where((first - gradient).abs() <= (second - gradient).abs(), second)
        atol = 0.03 * float(first.abs().max())
        close(model, gradient, expected, "gradients are not those of finite differences in metres", atol)
