"""Other quantities than RSSI: maps in their unit, whatever it is, and refusals where a model of power is asked for."""

import numpy as np
import pandas as pd
import pytest
import torch

import swiftwrf
from swiftwrf import InputError, Rssi, RssiModel
from swiftwrf.data.writing import write_rssi
from swiftwrf.rssi.coverage import default_threshold
from swiftwrf.rssi.maps import RssiMap

N = 120
DRAW = np.random.default_rng(0)
PLACE = DRAW.uniform(0, 20, (N, 2))
TRUTH = 150 + 80 * np.sin(PLACE[:, 0] / 5) * np.cos(PLACE[:, 1] / 6)  # [Mbps]
TABLE = pd.DataFrame(PLACE, columns=["x", "y"]).assign(tcp_download=TRUTH + DRAW.normal(0, 5, N), jitter_ms=3.0)
OPTIONS = {"columns": {"rssi": "tcp_download"}, "quantity": "throughput", "unit": "Mbps"}


def read(scale: float = 1.0, **options: object) -> Rssi:
    return Rssi.from_frame(TABLE.assign(tcp_download=scale * TABLE.tcp_download), **(OPTIONS | options))


def test_the_map_of_a_quantity_is_near_the_truth_and_has_its_unit():
    data = read()
    train, test = data.split(seed=1)
    prediction = RssiModel().fit(train).predict(test.transmitter_position)
    truth = torch.from_numpy(TRUTH)[test.index]
    assert float((prediction.mean[:, 0] - truth).abs().mean()) < 8
    low, high = prediction.interval(0.8)
    inside = ((test.rssi_dbm >= low) & (test.rssi_dbm <= high)).double().mean()
    assert 0.6 < float(inside) < 0.97
    assert list(prediction.to_frame().columns[-3:]) == ["receiver", "predicted_mbps", "std_mbps"]
    assert prediction.plot().figure.axes[-1].get_ylabel() == "predicted throughput [Mbps]"
    chart = RssiMap.predict(RssiModel().fit(train), detected=True)
    assert (chart.detection == 1).all()
    assert chart.to_xarray()["throughput"].attrs["units"] == "Mbps"


def test_a_prediction_does_not_depend_on_the_unit():
    position = read().transmitter_position[:5]
    in_mbps, in_bps = (
        RssiModel().fit(read(scale, unit=unit)).predict(position) for scale, unit in ((1.0, "Mbps"), (1e6, "bps"))
    )
    torch.testing.assert_close(1e6 * in_mbps.mean, in_bps.mean, rtol=1e-4, atol=1.0)
    assert in_mbps.std is not None
    assert in_bps.std is not None
    torch.testing.assert_close(1e6 * in_mbps.std, in_bps.std, rtol=1e-3, atol=1.0)


def test_held_out_errors_are_in_the_unit():
    small, large = (RssiModel().fit(read(scale)).held_out_db for scale in (1.0, 1e3))
    assert small.keys() == large.keys() == {"swiftwrf", "mean"}
    assert {name: 1e3 * error for name, error in small.items()} == pytest.approx(large, rel=1e-3)
    detrended = TABLE.tcp_download - TABLE.tcp_download.mean()
    assert small["mean"] == pytest.approx(detrended.abs().mean(), rel=0.05)


def test_the_default_threshold_is_the_median():
    data = Rssi.from_frame(TABLE.assign(tcp_download=TABLE.tcp_download.clip(lower=150)), **OPTIONS)
    rounded = float(f"{TABLE.tcp_download.clip(lower=150).median():.3g}")
    assert default_threshold(data) == (rounded, "the median of the measured values")


def test_a_model_of_a_quantity_is_updated_and_saved_in_its_unit(tmp_path):
    data = read()
    model = RssiModel().fit(data.subset(torch.arange(80)))
    updated = model.update(data.subset(torch.arange(80, N)))
    truth = torch.from_numpy(TRUTH)
    error = [(one.predict(data.transmitter_position).mean[:, 0] - truth).abs().mean() for one in (model, updated)]
    assert float(error[1]) < float(error[0])
    updated.save(tmp_path / "model.safetensors")
    loaded = swiftwrf.load(tmp_path / "model.safetensors")
    torch.testing.assert_close(
        loaded.predict(data.transmitter_position).mean, updated.predict(data.transmitter_position).mean
    )
    assert (loaded.quantity, loaded.unit) == ("throughput", "Mbps")


def test_signal_to_noise_ratios_are_values_whatever_their_size():
    snr = np.where(np.arange(N) % 7 == 0, 0.0, -20 + TRUTH / 10)
    data = Rssi.from_frame(TABLE[["x", "y"]].assign(gateway="g1", SNR=snr), quantity="SNR", unit="dB")
    np.testing.assert_allclose(data.rssi_dbm[:, 0], snr)  # 0 is no filler


def test_a_comparison_is_in_the_unit_of_the_quantity():
    result = swiftwrf.rssi.compare(read())
    test = result.predictions
    errors = (test.predicted - test.measured).abs()
    methods = {method.name: method.error for method in result.answer().methods}
    assert methods["swiftwrf"]["median"] == pytest.approx(errors.median(), abs=0.02)
    assert not set(result.values) & {"mri_pooled", "mri_receiver", "mri_residual"}
    assert "Mbps" in " ".join(result.answer().conclusion)
    assert "dB" not in " ".join(result.answer().conclusion)


def test_models_of_power_are_refused(tmp_path):
    data = read()
    for use in (swiftwrf.RssiLocator().fit, lambda rows: write_rssi(rows, tmp_path)):
        with pytest.raises(InputError, match="has throughput, but"):
            use(data)
    with pytest.raises(InputError, match="quantity and unit belong together"):
        read(unit=None)
    with pytest.raises(InputError, match="pool_by pools received powers"):
        read(pool_by="mac")
    with pytest.raises(InputError, match="positions of both ends"):
        Rssi.from_frame(TABLE.assign(tx_x=1.0, tx_y=2.0), **OPTIONS)
    with pytest.raises(InputError, match="has 0 columns that are named latency"):
        read(columns=None, quantity="latency", unit="ms")
    model = RssiModel().fit(data)
    with pytest.raises(InputError, match=r"was fitted to throughput"):
        model.update(swiftwrf.rssi_room(n=20).columns([0]))


def test_repeats_compare_the_named_predictors_only():
    result = swiftwrf.rssi.compare(read(), only=["knn"], repeats=2)
    assert set(result.values) == set(result.repeats["method"]) == {"swiftwrf", "mean", "knn"}
    assert result.repeats["method"].value_counts().tolist() == [2, 2, 2]


def test_repeats_are_comparisons_of_other_seeds():
    """Mean and standard deviation over splits, in the summary, the recorded values and the answer."""
    data = read()
    alone = {
        seed: swiftwrf.rssi.compare(data, seed=seed).errors.groupby("method")["abs_error_db"].agg(["median", "mean"])
        for seed in (2, 3, 4)
    }
    result = swiftwrf.rssi.compare(data, seed=2, repeats=3)
    over, table = result.recorded().metrics["repeats"], result.summary()
    for name in ("swiftwrf", "knn"):
        for kind in ("median", "mean"):
            each = [alone[seed].loc[name, kind] for seed in alone]
            assert over[name][f"{kind}_mean"] == pytest.approx(np.mean(each), rel=1e-3)
            assert over[name][f"{kind}_std"] == pytest.approx(np.std(each, ddof=1), rel=1e-2)
            assert table.loc[name, f"{kind}_std"] == pytest.approx(np.std(each, ddof=1), rel=1e-2)
    assert over["knn"]["median_std"] > 0
    text = f"swiftwrf {np.mean([alone[seed].loc['swiftwrf', 'median'] for seed in alone]):.2f} Mbps"
    assert f"Median errors over 3 splits: {text}" in " ".join(result.answer().conclusion)
    with pytest.raises(InputError, match="repeats need a split with a seed"):
        swiftwrf.rssi.compare(data.subset(torch.arange(8)), repeats=2)
