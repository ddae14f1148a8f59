"""Models are kept, come back as they were, and are applied to new spectra, rows and positions."""

import json
import shutil
from dataclasses import replace

import numpy as np
import pandas as pd
import pytest
import torch
from quick import run, said
from scipy.io import loadmat

from augment import Mixed
from augment.estimators.aann import AANN
from augment.estimators.aann_kernel import AANNKernel
from swiftwrf import AngularGrid, InputError, Rssi, RssiModel, Spectra, load, make_model, rssi_room, simulated_room
from swiftwrf.data.writing import write_spectra
from swiftwrf.locate import Posterior
from swiftwrf.metrics import angle_errors
from swiftwrf.predicting import _located
from swiftwrf.runtime.checkpoint import read, write
from tasks.aoa.page import steps
from tasks.aoa.records import FractionRecords
from tasks.records import Records

GRID = AngularGrid.hemisphere(8, 32)


@pytest.fixture(scope="module")
def small():
    return simulated_room(n=60, grid=GRID)


@pytest.fixture(scope="module", params=[AANN, AANNKernel])
def network(request, small, tmp_path_factory):
    """A real network, hardly trained, and its file."""
    estimator = request.param(steps=3, batch=8).fit(Mixed.measured(small))
    file = tmp_path_factory.mktemp("network") / "network.safetensors"
    estimator.save(file)
    return estimator, file


@pytest.fixture(scope="module")
def finished(tmp_path_factory):
    """The directory of a run."""
    folder = tmp_path_factory.mktemp("run") / "aoa"
    assert run("aoa", "--mix", 0.5, "--synthesizer", "nearest", "idw", "--extra", 5, "--out", folder) == 0
    return folder


def test_the_network_comes_back_as_it_was(small, network):
    estimator, file = network
    again = load(file)
    assert again.grid == GRID
    assert again.to("cpu") is again
    apart = angle_errors(again.predict(small.spectrum), estimator.predict(small.spectrum))["great_circle"]
    assert float(apart.rad2deg().max()) < 1e-3  # its weights were rounded before
    assert file.stat().st_size < 60e6


@pytest.mark.parametrize("change", ["missing", "shape", "features", "config", "grid", "width", "scale"])
def test_a_damaged_network_is_refused(network, tmp_path, change):
    kind, tensors, header = read(network[1], AANN.kind, AANNKernel.kind)
    if kind == AANN.kind and change in ("features", "width", "scale"):
        pytest.skip("the network has no kernel regression")
    match change:
        case "missing":
            del tensors["_offset" if kind == AANN.kind else "_direction.dual"]
        case "shape":
            tensors["_network.fc.0.weight"] = torch.zeros(3, 3)
        case "features":
            tensors["_direction.known"] = tensors["_direction.known"][:, :100]
        case "scale":
            tensors["_scale"] = torch.zeros(2)
        case "width":
            header["_direction"]["gamma"] = -1.0
        case "config":
            header["config"]["layers"] = 3
        case "grid":
            del header["grid"]
    write(tmp_path / "changed", kind, tensors, header)
    with pytest.raises(InputError):
        load(tmp_path / "changed")


def test_a_run_keeps_the_estimator_that_saw_most(finished):
    files = sorted(file.name for file in finished.glob("kernel_regression*.safetensors"))
    # the network of these runs is a stand-in that cannot be saved
    assert files == ["kernel_regression-measured-mix0.5.safetensors", "kernel_regression-mix0.5.safetensors"]
    estimator = load(finished / "kernel_regression-mix0.5.safetensors")
    errors = pd.read_csv(finished / "errors.csv")
    own = errors[errors.method == "kernel_regression, measured + synthetic + extra (nearest)"]
    test = simulated_room(n=30, grid=GRID).subset(torch.tensor(own["index"].tolist()))
    estimate = estimator.predict(test.spectrum).rad2deg().numpy()
    np.testing.assert_allclose(estimate, own[["estimate_azimuth_deg", "estimate_elevation_deg"]], atol=1e-3)


def test_the_report_and_predict_apply_the_file_of_the_choice(finished):
    fraction = FractionRecords.of(Records(finished))[0]
    for training in ("-measured", ""):
        fraction.mix["estimator_choice"]["file"] = f"kernel_regression{training}-mix0.5.safetensors"
        assert f"swiftwrf predict {finished} SOURCE" in [step.code for step in steps(fraction)]
        assert fraction.chosen_file == finished / f"kernel_regression{training}-mix0.5.safetensors"


def test_directions_of_measured_and_unknown_positions(finished, small, tmp_path, capsys, monkeypatch):
    estimator = finished / "kernel_regression-mix0.5.safetensors"
    (tmp_path / "data").mkdir()
    write_spectra(small, tmp_path / "data")
    assert run("predict", estimator, tmp_path / "data", "--out", tmp_path / "known.csv") == 0
    assert "60 directions, median error" in capsys.readouterr().out
    known = pd.read_csv(tmp_path / "known.csv")
    assert known["index"].tolist() == list(range(60))
    assert known["great_circle_deg"].between(0, 180).all()

    np.save(tmp_path / "unknown.npy", small.spectrum.numpy())
    assert run("predict", estimator, tmp_path / "unknown.npy", "--out", tmp_path / "unknown.csv") == 0
    monkeypatch.chdir(tmp_path)
    (tmp_path / "predicted.csv").write_text("of another run")
    assert run("predict", estimator, tmp_path / "unknown.npy") == 0
    (default,) = tmp_path.glob("predicted-*.csv")
    unknown = pd.read_csv(tmp_path / "unknown.csv")
    assert default.read_bytes() == (tmp_path / "unknown.csv").read_bytes()
    assert unknown.columns.tolist() == ["index", "azimuth_deg", "elevation_deg"]
    np.testing.assert_allclose(unknown["elevation_deg"], known["elevation_deg"], atol=0.05)  # 8 or 16 bits on disk


def test_errors_are_those_of_known_directions(finished, small, tmp_path, capsys, monkeypatch):
    """The median of two errors is their mean; without the pose of the array there are none."""
    estimator = finished / "kernel_regression-mix0.5.safetensors"
    two = small.subset(torch.arange(2))
    without_pose = Spectra(two.spectrum, two.position, grid=GRID)
    for data in (two, without_pose):
        monkeypatch.setattr("tasks.source.Reading.spectra", lambda _, data=data: data)
        (tmp_path / "out.csv").unlink(missing_ok=True)
        assert run("predict", estimator, tmp_path, "--json", "--out", tmp_path / "out.csv") == 0
        answer, table = json.loads(capsys.readouterr().out), pd.read_csv(tmp_path / "out.csv")
        if data is two:
            assert answer["median_great_circle_deg"] == pytest.approx(table["great_circle_deg"].mean(), abs=1e-3)
    assert (set(answer), list(table)) == ({"n", "table"}, ["index", "azimuth_deg", "elevation_deg"])
    shifted = Spectra(two.spectrum, two.position, grid=replace(GRID, azimuth_start=0.1))
    monkeypatch.setattr("tasks.source.Reading.spectra", lambda _: shifted)
    assert run("predict", estimator, tmp_path, "--out", tmp_path / "no.csv") == 2
    assert "as many directions as the estimator was trained on, but others" in said(capsys)


@pytest.mark.parametrize(
    ("content", "sentence"),
    [
        (np.zeros((3, 8, 16), np.float32), "--grid 8 32"),
        (np.zeros((8, 32), np.float32), "(n, elevations, azimuths)"),
        (np.zeros((3, 8, 32), np.int64), "floating-point"),
        (np.full((3, 8, 32), 2.0), "magnitudes in [0, 1]"),
        (np.full((3, 8, 32), np.nan), "magnitudes in [0, 1]"),
        (np.zeros((0, 8, 32)), "floating-point"),
    ],
)
def test_other_spectra_are_refused(finished, tmp_path, capsys, content, sentence):
    np.save(tmp_path / "spectra.npy", content)
    file = finished / "kernel_regression-mix0.5.safetensors"
    assert run("predict", file, tmp_path / "spectra.npy", "--out", tmp_path / "out.csv") == 2
    assert sentence in said(capsys)
    assert not (tmp_path / "out.csv").exists()


def test_spectra_and_rssi_at_the_positions_of_a_table(small, tmp_path):
    field, rssi = make_model("idw").fit(small), RssiModel(n_primitives=0).fit(rssi_room(n=60).columns([0, 4]))
    field.save(tmp_path / "field.safetensors")
    rssi.save(tmp_path / "rssi.safetensors")
    at, position = tmp_path / "at.csv", small.position[:5]
    pd.DataFrame(position.numpy(), columns=["x", "y", "z"]).to_csv(at, index=False)
    assert run("predict", tmp_path / "field.safetensors", at, "--out", tmp_path / "a.mat") == 0
    np.testing.assert_allclose(loadmat(tmp_path / "a.mat")["spectrum"], field.predict(position).mean.numpy(), atol=1e-6)
    assert run("predict", tmp_path / "rssi.safetensors", at, "--out", tmp_path / "a.csv") == 0
    table = pd.read_csv(tmp_path / "a.csv")
    np.testing.assert_allclose(table["predicted_dbm"], rssi.predict(position).mean.numpy().ravel(), atol=0.00501)
    assert all(len(text.rpartition(".")[2]) <= 2 for text in table["predicted_dbm"].astype(str))
    low, high = rssi.predict(position).interval(0.8)
    np.testing.assert_allclose(table["low_dbm"], low.numpy().ravel(), atol=0.00501)
    np.testing.assert_allclose(table["high_dbm"], high.numpy().ravel(), atol=0.00501)


def test_few_predictions_are_shown_and_places_beyond_the_scans_are_marked(tmp_path, capsys):
    data = rssi_room(n=120)
    rssi = data.rssi_dbm.where(data.rssi_dbm > -62, torch.nan)  # a receiver that is not sensitive
    model = RssiModel().fit(replace(data, rssi_dbm=rssi).columns([0, 4]))
    model.save(tmp_path / "rssi.safetensors")
    at, amid = tmp_path / "at.csv", data.transmitter_position.mean(dim=0)
    position = torch.stack([amid, amid + torch.tensor([500.0, 0, 0])])
    pd.DataFrame(position.numpy(), columns=["x", "y", "z"]).to_csv(at, index=False)
    assert run("predict", tmp_path / "rssi.safetensors", at, "--out", tmp_path / "a.csv") == 0
    table = pd.read_csv(tmp_path / "a.csv")
    assert table["outside"].tolist() == [False, False, True, True]
    np.testing.assert_allclose(table["detection"], model.predict_detection(position).ravel(), atol=0.000501)
    lines = capsys.readouterr().out.splitlines()
    assert lines[0].split() == list(table.columns)
    assert [line.split()[4] for line in lines[1:5]] == [f"{value:.2f}" for value in table["predicted_dbm"]]
    spread = torch.stack([data.transmitter_position[row] for row in range(21)])
    for n in (20, 21):
        pd.DataFrame(spread[:n].numpy(), columns=["x", "y", "z"]).to_csv(at, index=False)
        assert run("predict", tmp_path / "rssi.safetensors", at, "--out", tmp_path / f"{n}.csv") == 0
        *lines, last = capsys.readouterr().out.splitlines()
        assert last == f"{2 * n} rows: {tmp_path / f'{n}.csv'}"
        strongest = model.predict(spread[:n]).mean.max(dim=1).values.tolist() if n == 20 else []
        assert [float(line.split()[4]) for line in lines[2:]] == pytest.approx(strongest, abs=0.00501)


@pytest.mark.parametrize("suffix", [".xlsx", ".mat", "", ".parquet"])
def test_tables_of_other_kinds_are_refused(finished, small, tmp_path, capsys, suffix):
    """A table of directions is CSV; predictions at positions are MATLAB files, too."""
    make_model("idw").fit(small).save(tmp_path / "field.safetensors")
    pd.DataFrame(small.position[:5].numpy(), columns=["x", "y", "z"]).to_csv(tmp_path / "at.csv", index=False)
    np.save(tmp_path / "spectra.npy", small.spectrum.numpy())
    estimator, out = finished / "kernel_regression-mix0.5.safetensors", tmp_path / f"out{suffix}"
    assert run("predict", estimator, tmp_path / "spectra.npy", "--out", out) == 2
    assert "must end in .csv" in said(capsys)
    code = run("predict", tmp_path / "field.safetensors", tmp_path / "at.csv", "--out", out)
    assert (code, out.exists()) == ((0, True) if suffix == ".mat" else (2, False))


def test_positions_on_floors_have_the_heights_of_the_measurements(tmp_path, capsys):
    draw = np.random.default_rng(0)
    survey = pd.DataFrame(draw.uniform(0, 9, (60, 2)), columns=["x", "y"])
    survey["floor"] = np.repeat([0, 1], 30)
    survey["hall"] = -50 - survey.x - 15 * survey.floor
    RssiModel().fit(Rssi.from_frame(survey)).save(tmp_path / "model.safetensors")

    def predicted(columns, file):
        survey[columns].iloc[[0, 59]].to_csv(tmp_path / "at.csv", index=False)
        return run("predict", tmp_path / "model.safetensors", tmp_path / "at.csv", "--out", tmp_path / file)

    assert predicted(["x", "y", "floor"], "floors.csv") == 0
    table = pd.read_csv(tmp_path / "floors.csv")
    assert table.z_m.tolist() == [0, 4]
    assert table.predicted_dbm.to_numpy() == pytest.approx(survey.hall.iloc[[0, 59]].to_numpy(), abs=5)
    for columns in (["x", "y"], ["x", "y", "floor"]):
        survey.floor += 7
        assert predicted(columns, "none.csv") == 2
        assert "a column floor with names of floors: 0, 1" in said(capsys)


def test_the_directory_of_a_run_is_enough(finished, small, tmp_path, capsys):
    """The choice of the toy, the strongest peak, has no file, so a copy of the run has another choice."""
    np.save(tmp_path / "new.npy", small.spectrum.numpy()[:7])
    assert run("predict", finished, tmp_path / "new.npy", "--out", tmp_path / "none.csv") == 2
    assert "saved models: kernel_regression-measured-mix0.5.safetensors, kernel" in capsys.readouterr().err
    of_run, file = tmp_path / "run", tmp_path / "run" / "kernel_regression-mix0.5.safetensors"
    shutil.copytree(finished, of_run)
    metrics = json.loads((of_run / "metrics.json").read_text())
    metrics["mixes"]["0.5"]["estimator_choice"]["file"] = file.name
    (of_run / "metrics.json").write_text(json.dumps(metrics))
    assert run("predict", file, tmp_path / "new.npy", "--out", tmp_path / "one.csv", "--json") == 0
    assert json.loads(capsys.readouterr().out) == {"n": 7, "table": str(tmp_path / "one.csv")}
    assert run("predict", of_run, tmp_path / "new.npy", "--out", tmp_path / "other.csv") == 0
    assert f"applied: {file}" in capsys.readouterr().err.replace("\n", "")
    assert (tmp_path / "one.csv").read_bytes() == (tmp_path / "other.csv").read_bytes()


def test_the_columns_of_positions_are_those_of_the_posteriors():
    """Equal masses on a cross: 0.1 to 1 m along x either way, half as far along y, a tenth along z."""
    step = torch.arange(-10, 11)[torch.arange(21) != 10] / 10.0
    at = torch.cat([side * step[:, None] for side in torch.diag(torch.tensor([1, 0.5, 0.1]))]).double()
    mass = torch.full((2, 60), 1 / 60, dtype=torch.float64).log()
    found = _located([Posterior(at.expand(2, -1, -1), mass)], torch.arange(2), torch.tensor([[3.0, 0, 4], [0, 0, 1]]))
    assert [float(found[f"std_{axis}_m"][0]) for axis in "xyz"] == pytest.approx(at.numpy().std(axis=0))
    assert found["credible_radius_80_m"].tolist() == [0.5, 0.5]
    assert found["position_error_m"].tolist() == pytest.approx([5, 1])


def test_the_median_error_of_a_table(small, monkeypatch, tmp_path, capsys):
    errors = pd.DataFrame({"great_circle_deg": [1.0, 2.0, 9.0], "position_error_m": [0.1, 0.2, 3.0], "x_m": 0.0})
    (tmp_path / "a.safetensors").touch()
    monkeypatch.setattr("tasks.predict.load", lambda file: AANN())
    monkeypatch.setattr(AANN, "grid", GRID, raising=False)
    monkeypatch.setattr("tasks.predict.observed_spectra", lambda *_: (small.store, small))
    monkeypatch.setattr("tasks.predict.predict", lambda *_, **__: errors)
    assert run("predict", tmp_path / "a.safetensors", tmp_path, "--out", tmp_path / "out.csv") == 0
    assert "3 positions, median error 2 degrees and 0.2 m" in capsys.readouterr().out
