"""Predictors and localizers of one's own in comparisons, and results as short texts and tables of LaTeX."""

import pytest
import torch

import swiftwrf
from swiftwrf import InputError
from swiftwrf.contrib.comparison.localizers import Localizer, Located
from swiftwrf.contrib.comparison.steps import Memo
from swiftwrf.rssi.base import RssiPredictor

DATA = swiftwrf.rssi_room(n=60).columns([0, 4, 8])


class Constant(RssiPredictor):
    """One power at any place."""

    name = "constant"

    def _fit(self, train, **_):
        self.fits = getattr(self, "fits", 0) + 1

    def _predict(self, position):
        return torch.full((len(position), len(self.receiver_names)), -60.0), None


class Origin(Localizer):
    """Locate any row at the origin."""

    def fit(self, train):
        return self

    def locate(self, rssi):
        return Located(torch.zeros(len(rssi), 3, dtype=torch.float64))


def test_a_predictor_of_ones_own_is_compared_and_stays_as_it_is():
    own = Constant()
    result = swiftwrf.rssi.compare(DATA, also=[own])
    expected = (result.test.rssi_dbm[result.test.detected] + 60).abs().quantile(0.5)
    assert result.summary().loc["constant", "median"] == pytest.approx(float(expected), abs=1e-6)
    assert not hasattr(own, "fits")
    assert "constant" in [method.name for method in result.answer().methods]
    assert repr(result).startswith("<RssiComparison of simulated-floor: 8 methods, 48 training and 12 test rows;")
    rows = [line.split(" & ") for line in result.to_latex().splitlines() if " & " in line]
    assert [row[0] for row in rows[1:]] == [
        name.replace("_", r"\_") for name in result.summary().sort_values("median").index
    ]
    assert ["constant", f"{float(expected):.2f}"] in [row[:2] for row in rows]


def test_a_localizer_of_ones_own_is_compared():
    result = swiftwrf.locate.compare(DATA, n_cells=300, also={"origin": Origin()})
    expected = result.test.transmitter_position.norm(dim=1).quantile(0.5)
    assert result.summary().loc["origin", "median"] == pytest.approx(float(expected), abs=1e-6)
    assert len(repr(result)) < 250


def test_methods_of_ones_own_need_names_of_their_own(tmp_path):
    known = Constant()
    known.name = "knn"
    with pytest.raises(InputError, match="also has a predictor 'knn'"):
        swiftwrf.rssi.compare(DATA, also=[known])
    with pytest.raises(InputError, match="also has a localizer 'knn'"):
        swiftwrf.locate.compare(DATA, also={"knn": Origin()})
    with pytest.raises(InputError, match="keep takes predictors by name"):
        swiftwrf.rssi.compare(DATA, also=[Constant()], keep=Memo(tmp_path))
    with pytest.raises(InputError, match="keep takes localizers by name"):
        swiftwrf.locate.compare(DATA, also={"origin": Origin()}, keep=Memo(tmp_path))
