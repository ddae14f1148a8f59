"""Public data sets by name: a local server in place of the internet, raw files made in the layout of each source."""

import hashlib
import io
import json
import pickle
import threading
from functools import partial
from http.server import SimpleHTTPRequestHandler, ThreadingHTTPServer

import numpy as np
import pandas as pd
import pytest
from PIL import Image
from quick import command, said
from scipy.io import savemat

from swiftwrf import InputError, Rssi, Spectra, datasets, load_rssi, load_spectra
from swiftwrf.contrib.datasets import DATA_SETS, conversions

pytest.importorskip("pooch", reason="needs the extra data")


class Quiet(SimpleHTTPRequestHandler):
    def log_message(self, *arguments):
        pass


def write(folder, files):
    for name, content in files.items():
        (folder / name).parent.mkdir(parents=True, exist_ok=True)
        (folder / name).write_bytes(content if isinstance(content, bytes) else content.encode())


def kolak_files(n=40):
    draw = np.random.default_rng(1)

    def table(rows):
        frame = pd.DataFrame(draw.uniform(0, 9, (rows, 2)), columns=["x", "y"]).assign(ts=1.6e18, heading=0.0)
        for number in range(1, 4):
            frame[f"rssi_{number}"] = draw.uniform(-90, -40, rows)
        frame.loc[0, "rssi_2"] = np.nan
        return frame.to_csv()

    anchors = "id,x,y,z\n1,5.5,2.4,2\n2,0.8,6.8,2.6\n3,3,0.1,2.4\n"
    return {"anchors.csv": anchors, "calibration/calibration_df.csv": table(n), "tests/test_robot_df.csv": table(12)}


@pytest.fixture
def served(tmp_path, monkeypatch):
    """A server with the raw files of a data set called `toy`, and a cache of its own."""
    raw = tmp_path / "server"
    write(raw, kolak_files())
    sums = {file: hashlib.sha256((raw / file).read_bytes()).hexdigest() for file in kolak_files()}
    (tmp_path / "sums.txt").write_text("".join(f"{file} {digest}\n" for file, digest in sums.items()))
    server = ThreadingHTTPServer(("127.0.0.1", 0), partial(Quiet, directory=str(raw)))
    threading.Thread(target=server.serve_forever, daemon=True).start()
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    monkeypatch.delenv("SWIFTWRF_DATA", raising=False)
    address = f"http://127.0.0.1:{server.server_port}/"
    toy = DATA_SETS["kolak"]._replace(name="toy", checksums=tmp_path / "sums.txt", url=address)
    monkeypatch.setitem(DATA_SETS, "toy", toy)
    yield server
    server.shutdown()
    server.server_close()


def test_a_data_set_is_downloaded_once_and_converted(served):
    folder = datasets.fetch("toy")
    served.shutdown()
    served.server_close()
    assert datasets.fetch("toy") == folder
    data = datasets.load("toy")
    assert isinstance(data, Rssi)
    assert (len(data), data.receiver_names) == (52, ("anchor1", "anchor2", "anchor3"))
    assert not data.detected[0, 1]
    assert [len(part) for part in data.named_splits["spatial"]] == [40, 12]
    page = (folder / "README.md").read_text()
    assert "CC BY 4.0" in page
    assert "Kolakowski" in page


def test_the_folder_of_converted_data_comes_first(served, tmp_path, monkeypatch):
    (tmp_path / "own" / "toy").mkdir(parents=True)
    monkeypatch.setenv("SWIFTWRF_DATA", str(tmp_path / "own"))
    assert datasets.fetch("toy") == tmp_path / "own" / "toy"
    monkeypatch.setenv("SWIFTWRF_DATA", str(tmp_path / "elsewhere"))
    assert datasets.fetch("toy") == tmp_path / "cache" / "swiftwrf" / "datasets" / "toy"


def test_a_cache_that_cannot_be_written_is_named(served, tmp_path):
    (tmp_path / "cache").write_text("a file in the place of the folder")
    with pytest.raises(InputError, match=r"cannot be written .*set XDG_CACHE_HOME"):
        datasets.fetch("toy")


def test_another_checksum_is_refused(served, tmp_path):
    (tmp_path / "server" / "anchors.csv").write_text("id,x,y,z\n1,0,0,0\n")
    with pytest.raises(InputError, match="its checksum differs: http://127"):
        datasets.fetch("toy")
    assert not (tmp_path / "cache" / "swiftwrf" / "datasets" / "toy").exists()


def test_offline_a_sentence_has_the_address_and_the_place(served, tmp_path):
    served.shutdown()
    served.server_close()
    with pytest.raises(InputError, match="cannot be downloaded") as caught:
        datasets.fetch("toy")
    place = tmp_path / "cache" / "swiftwrf" / "datasets" / "raw" / "toy"
    assert f"{DATA_SETS['toy'].url}anchors.csv" in str(caught.value)
    assert str(caught.value).endswith(str(place / "anchors.csv"))
    write(place, kolak_files())
    assert len(datasets.load("toy")) == 52


def test_a_conversion_that_fails_leaves_nothing(served, tmp_path, monkeypatch):
    def fail(raw, out):
        (out / "half").touch()
        raise InputError("no")

    monkeypatch.setitem(DATA_SETS, "toy", DATA_SETS["toy"]._replace(convert=fail))
    with pytest.raises(InputError, match=r"^no$"):
        datasets.fetch("toy")
    assert [path.name for path in (tmp_path / "cache" / "swiftwrf" / "datasets").iterdir()] == ["raw"]


def test_commands_take_names_where_there_is_no_such_folder(served, tmp_path, capsys, monkeypatch):
    monkeypatch.chdir(tmp_path)
    assert command("inspect", "toy", "--out", "a") == 0
    assert "toy: licence CC BY 4.0" in capsys.readouterr().err
    assert json.loads((tmp_path / "a" / "inspect.json").read_text())["kind"] == "RSSI"
    (tmp_path / "toy").mkdir()
    assert command("inspect", "toy", "--out", "b") == 2
    assert "is in none of the known formats" in said(capsys)


def test_every_source_is_pinned_and_has_a_licence():
    table = datasets.catalogue()
    assert table["licence"].str.len().min() > 2
    for data in DATA_SETS.values():
        assert len(data.commit) == 40
        lines = [line.rsplit(" ", 1) for line in data.checksums.read_text().splitlines()]
        assert lines
        assert all(len(digest) == 64 and int(digest, 16) for _, digest in lines)


def pickled_paths(first=0):
    """A table of NeWRF: three receivers, one of them without a path."""
    rows = [
        {
            "TxPos": np.array([-1.5, 0, 2.7]),
            "RxPos": np.array([1.0, number, 1.2]),
            "Frequency": 2.412,
            "LastXPts": np.array([[-1.5, 0, 2.7], [2.0, 1, 1]]).T if number != 1 else np.nan,
            "RxChanPerRay": np.array([[1 + 2j], [3j]]) if number != 1 else np.nan,
            "LineOfSight": 1,
        }
        for number in range(first, first + 3)
    ]
    columns = pd.Index(list(rows[0]), dtype=object)
    table = pd.DataFrame({name: [row[name] for row in rows] for name in columns}, index=pd.Index([0, 1, 2]))
    content = pickle.dumps(table.set_axis(columns, axis=1), protocol=3)
    for name, former in (("DataFrame", "pandas.core.frame"), ("Index", "pandas.core.indexes.base")):
        content = content.replace(f"cpandas\n{name}\n".encode(), f"c{former}\n{name}\n".encode())
    return content.replace(b"cnumpy._core.", b"cnumpy.core.")


def converted(folder, files, convert, *options):
    """Convert raw files, and return the folder of the converted ones."""
    write(folder / "raw", files)
    (folder / "out").mkdir()
    convert(folder / "raw", folder / "out", *options)
    return folder / "out"


def test_newrf_paths(tmp_path):
    out = converted(tmp_path, {"data/dataset_bedroom.pkl": pickled_paths()}, conversions.newrf)
    data = load_spectra(out, grid=(4, 8))
    assert data.position.tolist() == [[1, 0, 1.2], [1, 2, 1.2]]
    with np.load(out / "paths.npz") as stored:
        np.testing.assert_allclose(stored["last_point"][1], [2, 1, 1])
        assert stored["gain"].tolist() == [1 + 2j, 3j] * 2


class Trap:
    def __reduce__(self):
        return exec, ("raise SystemExit('run')",)


def test_a_pickle_runs_no_code(tmp_path):
    write(tmp_path, {"data/a.pkl": pickle.dumps(Trap())})
    with pytest.raises(InputError, match=r"builtins\.exec, which is not loaded"):
        conversions.newrf(tmp_path, tmp_path)


def test_s23(tmp_path):
    image = io.BytesIO()
    Image.fromarray(np.full((9, 36), 128, dtype=np.uint8)).save(image, "PNG")
    count = conversions.S23_TRAINING + 3
    rows = "".join(f"{number / 10},2,1\n" for number in range(count))
    files = {f"spectrum/{number:05d}.png": image.getvalue() for number in range(1, count + 1)}
    files |= {"gateway_info.yml": "gateway1:\n  position: [5.0, 0.26, 0]\n  orientation: [0, 0, 0, 1]\n"}
    files |= {"tx_pos.csv": "x,y,z\n" + rows, "train_index.txt": "1\n2\n", "test_index.txt": "3\n"}
    raw = {f"data_test200/{name}": content for name, content in files.items()}
    data = load_spectra(converted(tmp_path, raw, conversions.s23))
    assert isinstance(data, Spectra)
    assert data.named_splits["block"][1].tolist() == [count - 3, count - 2, count - 1]


def test_tetam_tracks(tmp_path):
    line = "{time},{receiver},beacon,{rssi},{x},2.0,1.8,0\n"
    packets = [  # two advertisements; one packet twice, one impossible value, one below what the layout holds
        {"time": 10.001, "receiver": "00ab", "rssi": -70, "x": 1.0},
        {"time": 10.0, "receiver": "00cd", "rssi": -60, "x": 1.2},
        {"time": 10.003, "receiver": "00ab", "rssi": -80, "x": 1.1},
        {"time": 10.5, "receiver": "00ab", "rssi": -101, "x": 3.0},
        {"time": 10.501, "receiver": "00cd", "rssi": 42, "x": 3.0},
    ]
    still = [{"time": 20.0 + second, "receiver": "00ab", "rssi": -50, "x": 15.0} for second in range(4)]
    devices = 'Dongles:{"00ab": [[7, 8, 1.2], 1, "one"], "00cd": [[1, 2, 2.3], 2, "two"]}\nBeacons:{}\n'
    tracks = {"straight_02": still, "straight_03": packets}
    files = {f"trk/{name}_all_sensors.mbd": "".join(line.format(**p) for p in some) for name, some in tracks.items()}
    data = load_rssi(converted(tmp_path, {"cnf/tetam.dev": devices, **files}, conversions.tetam_tracks))
    assert data.receiver_names == ("one", "two")
    np.testing.assert_array_equal(data.rssi_dbm[4:], [[-75, -60], [-99.9, np.nan]])
    np.testing.assert_allclose(data.transmitter_position[4:], [[1.1, 2, 1.8], [3, 2, 1.8]])
    assert data.named_splits["spatial"][1].tolist() == [4, 5]
    assert data.named_splits["block"][1].tolist() == [0, 1, 2, 3]


def test_dcm(tmp_path):
    router = "Col,Row,X,Y,Original_X_Value,Original_Y_Value\n0,1,1,1,-4.5,0.6\n1,10,1,1,-4,0\n"
    walks = {
        f"Dataset/router_{name}.txt": f"{x}\t1.5\t3\t4\t-40\n0 0 1 1 -35.0\n" for name, x in (("01", 2), ("110", 3))
    }
    data = load_rssi(converted(tmp_path, {"router_info.csv": router, **walks}, conversions.dcm))
    assert data.receiver_names == ("r01", "r110")
    assert data.receiver_position.tolist() == [[-4.5, 0.6, 0], [-4, 0, 0]]
    assert data.rssi_dbm[data.transmitter_position[:, 0] == 3].nan_to_num(0).tolist() == [[0, -40]]


def test_lora(tmp_path):
    header = "Time,GPS Time,id,Latitude,Longitude,Altitude,GPS Precision,# Satellites,ED RSSI,GW RSSI\n"
    latitude, longitude, altitude = conversions.LORA_GATEWAY
    row = "10:00,10:00,0,{},{},{},1,9,-102,-112\n"
    foot = header + row.format(latitude + 0.001, longitude, altitude - 2) * 2
    car = header + row.format(latitude, longitude + 0.001, altitude)
    files = {"campus_walking_by_foot/1_Full-Collected-data.csv": foot, "campus_by_car/2_Full-Collected-data.csv": car}
    data = load_rssi(converted(tmp_path, files, conversions.lora))
    np.testing.assert_allclose(data.transmitter_position[[0, 2]], [[0, 110.57, -2], [103.37, 0, 0]], atol=0.01)
    assert data.rssi_dbm[0].tolist() == [-112, -102]
    assert data.named_splits["foot"][1].tolist() == [2]


@pytest.mark.parametrize("suffix", ["mat", "csv"])
def test_fingerprints(tmp_path, suffix):
    train, test = np.array([[1.5, 2, 3.7, 1, 0, -60, 100]] * 7), np.array([[4.0, 5, 0, 0, 0, 100, -70]] * 5)
    file = tmp_path / "raw" / ("original_datasets/TOY1.mat" if suffix == "mat" else "dataset/TOY1/Train.csv")
    file.parent.mkdir(parents=True)
    if suffix == "mat":
        parts = {"training": train, "test": test}
        database = {f"{name}Labels": rows[:, :5] for name, rows in parts.items()}
        savemat(file, {"database": database | {f"{name}Macs": rows[:, 5:] for name, rows in parts.items()}})
    else:
        for name, rows in (("Train", train), ("Test", test)):
            pd.DataFrame(np.hstack([rows[:, 5:], rows[:, :5]])).to_csv(file.with_stem(name), index=False)
    (tmp_path / "out").mkdir()
    conversions.fingerprints(tmp_path / "raw", tmp_path / "out")
    data = load_rssi(tmp_path / "out")
    assert data.floors.names == ("0", "1")
    assert data.transmitter_position[[0, -1]].tolist() == [[1.5, 2, 3.7], [4, 5, 0]]
    assert data.rssi_dbm[[0, -1]].nan_to_num(0).tolist() == [[-60, 0], [0, -70]]
    assert data.named_splits["published"][1].tolist() == [7, 8, 9, 10, 11]


def test_wifi_rooms(tmp_path):
    columns = [f"AP{number} RSS(dBm)" for number in range(1, 6)]
    draw = np.random.default_rng(0)
    for part, x in (("train", 1), ("test", 2)):
        table = pd.DataFrame(draw.integers(-90, -40, (12, 5)).astype(float), columns=columns)
        table["AP1 RSS(dBm)"] = -200.0
        table.loc[:2, "AP3 RSS(dBm)"] = -200.0  # nine packets are left
        write(tmp_path / "raw", {f"data/database_corridor_{part}.csv": table.assign(X=x, Y=3).to_csv(index=False)})
    (tmp_path / "out").mkdir()
    conversions.wifi_room(tmp_path / "raw", tmp_path / "out")
    data = load_rssi(tmp_path / "out")
    assert data.detected.tolist() == [[True, False, True, True]] * 2
    assert float(data.rssi_dbm[1, 3]) == pytest.approx(table["AP5 RSS(dBm)"].mean(), abs=0.006)
    np.testing.assert_allclose(data.transmitter_position[1], [1.2, 1.8, 0])
    np.testing.assert_allclose(data.receiver_position[0], [1.2, 4.5, 0])
    assert data.named_splits["random"][1].tolist() == [1]
