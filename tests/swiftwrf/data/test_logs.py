"""A track and scans in two files are the walk that they were logged on."""

import numpy as np
import pandas as pd
import pytest

from swiftwrf import InputError, Rssi, load_rssi

START = pd.Timestamp("2026-06-10 08:00:00")


def write(folder, zone_h=0.0, every_s=3.0, gap=False, as_gpx=False):
    """Write a walk along x at 1 m/s and y at 0.5 m/s, and scans every 3 s of two receivers."""
    seconds = np.arange(0, 91, 1.5)
    seconds = seconds[(seconds < 30) | (seconds > 60)] if gap else seconds
    track = pd.DataFrame({"time": START + pd.to_timedelta(seconds, unit="s"), "x": seconds, "y": seconds / 2})
    if as_gpx:
        points = "".join(
            f'<trkpt lat="{48 + 1e-5 * s}" lon="{11 + 1e-5 * s}"><time>{t.isoformat()}Z</time></trkpt>'
            for t, s in zip(track.time, seconds, strict=True)
        )
        (folder / "track.gpx").write_text(f"<gpx><trk><trkseg>{points}</trkseg></trk></gpx>")
    else:
        track.to_csv(folder / "track.csv", index=False)
    at = np.arange(1.0, 90, every_s)
    when = START + pd.to_timedelta(at + 3600 * zone_h, unit="s")
    scan = pd.DataFrame({"timestamp": np.repeat(when, 2), "bssid": ["a", "b"] * len(at)})
    scan["rssi"] = np.column_stack([-40 - np.arange(len(at)), -90 + np.arange(len(at))]).ravel()
    scan.to_csv(folder / "scan.csv", index=False)
    return at


@pytest.mark.parametrize("zone_h", [0.0, 2.0, -5.5, 1.0])
def test_scans_get_the_positions_of_the_track(tmp_path, zone_h):
    at = write(tmp_path, zone_h)
    data = load_rssi(tmp_path)
    np.testing.assert_allclose(data.transmitter_position[:, :2], np.column_stack([at, at / 2]), atol=1e-6)
    np.testing.assert_array_equal(data.rssi_dbm[:, 0], -40 - np.arange(len(at)))
    corrected = [note for note in data.notes if "clock" in note]
    assert corrected == (
        [f"the clock of the scans is {zone_h:+g} h from that of the track, which is corrected"] if zone_h else []
    )


def test_scans_in_a_gap_have_no_position(tmp_path):
    at = write(tmp_path, gap=True)
    data = load_rssi(tmp_path)
    np.testing.assert_allclose(data.transmitter_position[:, 0], at[(at <= 28.5) | (at >= 61.5)], atol=1e-6)


def test_scans_long_before_or_after_the_track_have_no_position(tmp_path):
    at = write(tmp_path)
    scan = pd.read_csv(tmp_path / "scan.csv")
    for seconds in (-60, -5, 95, 160):
        late = {"timestamp": START + pd.to_timedelta(seconds, unit="s"), "bssid": "a", "rssi": -50 + seconds / 10}
        scan = pd.concat([scan, pd.DataFrame([late])], ignore_index=True)
    scan.to_csv(tmp_path / "scan.csv", index=False)
    data = load_rssi(tmp_path)
    np.testing.assert_allclose(np.sort(data.transmitter_position[:, 0]), [0.0, *at, 90.0], atol=1e-6)


def test_a_track_in_gpx_beside_scans(tmp_path):
    at = write(tmp_path, 2.0, as_gpx=True)
    data = load_rssi(tmp_path)
    degrees = data.origin.to_degrees(data.transmitter_position[:, :2].numpy())
    np.testing.assert_allclose(degrees, np.column_stack([48 + 1e-5 * at, 11 + 1e-5 * at]), atol=1e-8)


def test_logs_of_different_times_are_refused(tmp_path):
    write(tmp_path, 0.1)
    with pytest.raises(InputError, match="correct the times of one log"):
        load_rssi(tmp_path)


def walk_of(x, **columns):
    x = np.asarray(x, dtype=float)
    rssi = -40.0 - np.arange(len(x)) % 7
    return pd.DataFrame({"x": x, "y": x / 2, "a": rssi, "b": rssi - 20 + np.arange(len(x)) % 3, **columns})


def test_rows_of_a_held_fix_are_left_out():
    moving = np.arange(60.0)
    held = np.where((moving > 20) & (moving < 35), 20.0, moving)
    data = Rssi.from_frame(walk_of(held))
    np.testing.assert_array_equal(data.index, [*range(21), *range(35, 60)])
    assert any("held fix, before a jump to the next one, are left out: 14 of 60" in note for note in data.notes)
    stands = np.concatenate([moving[:21], np.full(14, 20.0), moving[21:]])  # and then goes on from there
    points = np.repeat(np.arange(12.0), 6)
    for x in (stands, points):
        assert len(Rssi.from_frame(walk_of(x))) == len(x)


def test_times_that_run_back():
    elapsed = 2.0 * np.arange(60)
    clock = pd.Timestamp("2026-10-25 02:59:00") + pd.to_timedelta(elapsed - 3600 * (elapsed >= 60), unit="s")
    data = Rssi.from_frame(walk_of(np.arange(60), time=clock.astype(str)))
    np.testing.assert_allclose(data.time, elapsed)
    assert any("run back by 3598 s before row 31, as at the end of summer time" in note for note in data.notes)
    reset = Rssi.from_frame(
        walk_of(np.arange(60), time=(clock + pd.to_timedelta(500.0 * (elapsed >= 60), unit="s")).astype(str))
    )
    np.testing.assert_allclose(reset.time, elapsed - 3100 * (elapsed >= 60))
    assert any(note.endswith("run back by 3098 s before row 31") for note in reset.notes)


def test_a_log_of_a_krakensdr_has_rssi_at_positions_and_no_header(tmp_path):
    spectrum = ", ".join(["0.01"] * 360)
    rows = [
        f"{1780000000000 + 1000 * k}, {10 + k}, 3.1, -{40 + k}.5, 433920000, UCA, 120, roof, 48.{k:04d}, 11.5, 10, 0, GPS, "
        f"R, R, R, R, {spectrum}"
        for k in range(12)
    ]
    (tmp_path / "log.csv").write_text("\n".join(rows) + "\n")
    data = load_rssi(tmp_path / "log.csv")
    assert data.receiver_names == ("roof",)
    np.testing.assert_array_equal(data.rssi_dbm[:, 0], -40.5 - np.arange(12))
    degrees = data.origin.to_degrees(data.transmitter_position[:, :2].numpy())
    np.testing.assert_allclose(degrees[:, 0], 48 + 1e-4 * np.arange(12), atol=1e-8)
    assert any("KrakenSDR" in note for note in data.notes)


@pytest.mark.parametrize("name", ["accuracy", "AccuracyMeters", "hdop", "gps_accuracy_m"])
def test_fixes_of_bad_accuracy_are_left_out(name):
    walk = pd.DataFrame({"x": np.arange(40.0), "y": 0.0, "ap": -50.0 - np.arange(40), name: 4.0})
    walk.loc[[3, 17, 30], name] = [80.0, 21.0, 19.0]
    data = Rssi.from_frame(walk)
    assert data.index.tolist() == [row for row in range(40) if row not in (3, 17)]
    assert f"fixes with {name} above 20 are left out: 2 of 40 rows" in data.notes
    whole = Rssi.from_frame(walk.assign(**{name: np.linspace(3, 9, 40)}))
    assert len(whole) == 40
