"""Small inputs after public reports, each of which was misread once: their inspection contains what their READMEs ask for.

The folder of the cases lies beside that of the measured data. Expressions are looked for in the findings or the refusal.
"""

import json
import os
import re
import shutil
from pathlib import Path

import pytest
import torch
from quick import run

import swiftwrf

CASES = Path(os.environ.get("SWIFTWRF_DATA", "nowhere")).parent / "cases"
pytestmark = [
    pytest.mark.long,
    pytest.mark.skipif(not CASES.is_dir(), reason="needs the cases: a folder beside SWIFTWRF_DATA"),
]
FITS, CALIBRATE = "are in one frame", "Use swiftwrf.calibrate"
IN_RADIOS = "names in column {} are those of several radios, which column {} separates"
TABLES = {
    "01-rssi-127": ["127 counts as not detected: 49 of 1200 cells", "explain 83%"],
    "02-rssi-0-unknown": ["0 counts as not detected: 143 of 1200 cells", "not: It would explain"],
    "03-filler-below-minus-100": ["-105 counts as not detected"],
    "04-wigle-log": ["before the header are skipped: 1", "receiver = MAC", "projected to local metres", "z 51.2"],
    "05-degrees-called-x-y": ["projected to local metres", "x -12.68 to 10.23, y -7.26 to 5.66"],
    "06-rows-without-fix/input/empty": ["without a position are left out: 12 of 240", "228 rows"],
    "06-rows-without-fix/input/zero": ["at 0, 0, apart from all others are left out: 12 of 240", "228 rows"],
    "07-image-axes": [r"if y of the positions counts from the other side \(y = 14.0 - y\)"],
    "08-minus-inf": ["-inf counts as not detected: 75 of 1200 cells"],
    "09-ble-channels": ["columns that are not used: channel", "--offset-by channel"],
    "10-two-phones": ["--offset-by PHONEID"],
    "11-some-receivers-known": ["have no path-loss model: ap-south, ap-hall, ap-west", "models explain 87%"],
    "12-raw-nerf2-ble-layout": ["240 rows of RSSI at 5 receivers", "models explain 83%"],
    "13-receiver-moves-layout": ["the receiver moves", "240 rows of RSSI at 5 receivers"],
    "14-receiver-called-gateway": ["RSSI of 2 receivers = gateway, device"],
    "15-repeated-scans": ["400 rows are at 40 places; the split random keeps each in one part"],
    "29-other-columns-become-receivers/input/cell": ["RSSI = RSRP", "left out: RSRQ, SINR", "at 1 receivers"],
    "29-other-columns-become-receivers/input/phone": ["= AP1, AP2, AP3, AP4", "left out: mag_x, mag_z, pitch, x_est"],
    "30-receiver-column-unknown": ["receiver = ssid", "120 rows of RSSI at 5 receivers"],
    "31-packets-one-at-a-time": ["--window 1 joins", "no sign of a signal below the limit"],
    "32-stale-scans": ["cached scans do, are left out: 140 of 180"],
    "33-clipped-values": [r"scale ends at -50 dBm: 175 of 900 cells \(19%\)", "at least that"],
    "35-names-spelled-differently/input/all": ["matched.* spelled differently", "Path-loss models explain"],
    "35-names-spelled-differently/input/part": ["matched.* spelled differently", "at 6 receivers", "models explain"],
    "35-names-spelled-differently/input/zeros": ["01 is 1, 02 is 2", "Path-loss models explain"],
    "36-y-is-up": ["y spans 0.3 m and z 10.9 m; if y is the height, give --up y"],
    "38-header-repeated/input/walk": ["repeat the header are left out: 2"],
    "38-header-repeated/input/anyplace": ["repeat the header are left out: 149", "x = X, y = Y"],
    "40-rows-shorter-than-header": ["lack the last columns, which count as empty: experiment name"],
    "41-rss-and-coordinate-files": ["trn01rss.csv holds the RSSI and trn01crd.csv the positions", "160 rows"],
    "43-words-for-missing/input/words": ["160 rows of RSSI at 5 receivers, 87% detected"],
    "43-words-for-missing/input/unit": ["120 rows of RSSI at 4 receivers", "-80 to -40 dBm"],
    "43-words-for-missing/input/two-headers": ["row 1 is a second header and left out: HomeNet", "at 4 receivers"],
    "47-degrees-in-other-units": [
        "degrees x 1e7|1e7 degrees|1e-7",
        "projected to local metres",
        "not: are they metres",
    ],
    "51-times-in-milliseconds/input/ms": ["counts milliseconds.*, which are converted to seconds"],
    "51-times-in-milliseconds/input/s": ["not: milliseconds"],
    "55-date-and-time/input/clock": ["columns Date and Time together are the time", "rows of RSSI"],
    "55-date-and-time/input/excel": ["rows of RSSI"],
    "90-not-heard": ["300 rows of RSSI at 8 receivers, 79% detected", "not: counts as not detected"],
    "91-floors": ["floor = floor, receiver = ap_name", "z 0.00 to 8.00 m"],
    "92-plan-pixels": ["20.7 px in a metre", r"Map Y \(px\) points down", "x 1.00 to 30.50"],
    "93-gateway-id": ["receiver = gateway_id", "at 3 receivers", "not: --offset-by"],
    "101-ranked-neighbours": ["numbered columns are lists", "260 rows of RSSI at 6 receivers, 67% detected"],
    "101b-ranked-neighbours-as-columns": ["260 rows of RSSI at 6 receivers, 67% detected"],
    "102-associated-only": ["one receiver, the associated one", "no sign of a signal below the limit"],
    "103-pci-on-two-carriers": [IN_RADIOS.format("pci", "earfcn"), "at 6 receivers"],
    "104-neighbours-with-id-0": ["receiver = pci", "at 4 receivers"],
    "105-mesh-relays": [
        "rssi = rx_rssi",
        "that a relay sent are left out: 110 of 240",
        "not: are they metres|hops_away",
    ],
    "106-virtual-access-points": ["16 receivers share 4 radios", "--pool-by mac"],
    "107-two-logs-two-zones": [
        "clock of the scans is [+]2 h from that of the track",
        "140 rows of RSSI at 4 receivers",
    ],
    "108-held-fix": ["held fix.* left out: 117 of 360"],
    "109-receiver-called-room": ["is 'room' the receiver of each row[?]"],
    "110-tx-power-changed": ["differences of tx_power are subtracted"],
    "111-one-ssid-three-bands": [IN_RADIOS.format("ssid", "frequency"), "the strongest counts"],
    "112-accuracy-of-fix": [
        "accuracy of fixes = accuracy",
        "fixes with accuracy above 30.[78] are left out: 57 of 320",
    ],
    "113-utm-zones": ["UTM zones 32U, 33U are those of zone 33U", "x 284881.60 to 285805.70", "not: are they metres"],
    "114-ros-bag": ["x = field.pose.pose.position.x", "time = %time", "counts nanoseconds since 1970"],
    "115-containers/input/survey.csv.gz": ["120 rows of RSSI at 3 receivers, 100% detected, -85 to -36 dBm"],
    "115-containers/input/survey.zip": ["120 rows of RSSI at 3 receivers, 100% detected, -85 to -36 dBm"],
    "115-containers/input/survey.xlsx": ["120 rows of RSSI at 3 receivers, 100% detected, -85 to -36 dBm|openpyxl"],
    "115-containers/input/wigle.sqlite": ["rows are those of table location", "120 rows of RSSI at 3 receivers"],
    "115-containers/input/survey.pkl": ["none of the known formats"],
    "120-snr-alone": ["quantity"],
    "121-lora-below-noise": ["below the noise.* SNR = snr", "not: are they metres"],
    "122-decimal-comma-in-quotes": ["160 rows of RSSI at 3 receivers, 100% detected, -85.1 to -38.1 dBm"],
    "123-ten-points": ["10 rows of RSSI at 3 receivers"],
    "125-each-network-once": ["detected fewer than 10 rows, too few to fit a model"],
    "126-clock-set-back": ["run back by 3598 s before row 151, as at the end of summer time"],
    "127-throughput": ["jitter_ms", "map another quantity"],
    "128-kraken-log": ["KrakenSDR", "not: names column"],
}
ARRAYS = {
    "16-null-subcarriers": [r"4 of 32, counted from 0\): 0 to 1, 16, 31", "--drop-null", "not: nearly one direction"],
    "17-coefficients-without-delay": ["hardly depend on the position", f"not: {CALIBRATE}"],
    "18-square-axes-swapped": [r"give csi.transpose\(0, 2, 1\)"],
    "19-linear-array": ["receives the angle to its axis only", "by the angle to the array's axis", "not: rotation"],
    "20-behind-the-array": ["50% of the positions lie behind the array", "two places share one label"],
    "21-elements-column-by-column": ["if the elements are given column by column"],
    "22-normalised-positions": [r"fill \[-1, 1\] exactly, so positions look normalised; give metres"],
    "23-backscatter-phase": ["way there and back.*0.98 wavelengths apart, so directions are ambiguous", f"not: {FITS}"],
    "24-sign-flips": ["phase of elements 8 to 15, counted from 0, jumps by half a turn"],
    "25-matlab-complex": ["150 array snapshots", "Peaks are 3.0 degrees", FITS],
    "26-deepmimo-aodt": ["90 - aoa_el is taken", FITS],
    "27-calibration-beyond-45-degrees": ["would fit if", f"not: {CALIBRATE}"],
    "61-dead-elements/input/zero": [r"lement 5 is silent"],
    "61-dead-elements/input/noise": ["elements 1, 6, 11, 12, counted from 0, hold noise", "not: more directions"],
    "61-dead-elements/input/nan": ["lement 5 is silent"],
    "62-cables-swapped/input/two-of-16": ["elements 0 and 15 are exchanged", f"not: {FITS}"],
    "62-cables-swapped/input/four-of-8": [r"elements 0, 1, 3, 6 are exchanged", "not: reflections"],
    "63-two-polarisations": ["as of 2 polarisations: each polarisation is a snapshot", FITS],
    "66-elements-sampled-in-turn": ["elements sampled in turn", f"not: {FITS}"],
    "68-positions-late": [r"positions are 1.2 s \(6 rows\) late"],
    "69-padded-packets/input/zero": ["596 of 880 snapshots are 0 or NaN", "Peaks are 3.[0-4] degrees", FITS],
    "69-padded-packets/input/nan": ["596 of 880 snapshots are 0 or NaN", "Peaks are 3.[0-4] degrees", FITS],
    "71-array-moves": ["the array must rest"],
    "75-near-field": ["nearer than 2 D.2 / wavelength", f"not: {CALIBRATE}"],
    "77-carrier-of-another-band": ["carrier is about 5[.][0-3]|way there and back"],
    "88-whole-sphere": [
        r"elevations of -90 to 90 degrees.* give spectrum\[:, 30:\]",
        "not: counts from the other side",
    ],
    "95-regular-grid": ["64 positions, x 0.00 to 1.40"],
    "140-flawless": [FITS, "needs no calibration"],
    "141-several-anchors": ["describes 4 arrays; choose one by its number"],
    "142-carrier-per-packet": ["each row has its carrier, 2.404 to 2.476 GHz", FITS],
    "143-phase-degrees-as-radians": ["would fit if phases in degrees were taken as radians"],
    "144-magnitude-and-phase": ["140 array snapshots", "Peaks are 2.[0-9] degrees", FITS],
    "145-int8-pairs": ["holds pairs of numbers, read as real and imaginary part", FITS],
    "146-nexmon-neighbours": ["0c:9d:92:aa:01:10 260, f4:6b:8c:22:0b:31 260; choose one"],
    "146-nexmon-neighbours/phone_alone": ["26 array snapshots", "Peaks are 7.3 degrees"],
    "147-subcarriers-in-fft-order": ["subcarriers.* order of an FFT.*fftshift", FITS],
    "148-elements-in-wavelengths": ["if element_position is in wavelengths"],
    "150-matlab-struct": ["140 array snapshots", FITS],
    "152-antenna-off-base-link": [
        "errors grow towards the array, as of positions that are wrong by about 0.3 m",
        f"not: {CALIBRATE}|{FITS}",
    ],
    "153-two-transmitters-in-packets": ["110 array snapshots", f"not: {FITS}|{CALIBRATE}"],
}


def said(case, folder, capfd, *options):
    """Return the findings about a case, or the sentence that refuses it."""
    original = CASES / case if case.count("/") else CASES / case / "input"
    source = folder / original.name  # a copy: inspect writes the stated options beside it
    if original.is_dir():
        shutil.copytree(original, source)
    else:
        shutil.copy(original, source)
    code = run("inspect", source, *options, "--out", folder / "page")
    if code:
        return capfd.readouterr().err
    found = json.loads((folder / "page" / "inspect.json").read_text())["findings"]
    return "\n".join(each["text"] for each in found)


def check(text, expected):
    for expression in expected:
        unwanted, _, rest = expression.rpartition("not: ")
        found = re.search(rest, text, re.IGNORECASE)
        assert bool(found) != expression.startswith("not: "), f"{expression!r} of {unwanted}\n{text}"


@pytest.mark.parametrize("case", TABLES)
def test_a_table_is_read_or_refused_as_its_report_asks(case, tmp_path, capfd):
    check(said(case, tmp_path, capfd), TABLES[case])


@pytest.mark.parametrize("case", ARRAYS)
def test_snapshots_are_read_or_explained_as_their_report_asks(case, tmp_path, capfd):
    grid = () if case[:2] in ("26", "88") else ("--grid", 30, 120)
    check(said(case, tmp_path, capfd, *grid), ARRAYS[case])


def test_a_grid_is_a_pair_of_numbers():
    assert swiftwrf.load_spectra(CASES / "28-grid-as-a-pair/input", grid=(30, 120)).grid.shape == (30, 120)


def test_path_loss_of_a_narrow_range_of_distances_is_that_of_the_other_receivers():
    data = swiftwrf.load_rssi(CASES / "94-narrow-distances/input")
    place = data.receiver_position[0] + torch.tensor([[1.0, 0, 0], [4.0, 0, 0], [8.0, 0, 0]])
    found = swiftwrf.RssiModel().fit(data).predict(place).mean[:, 0]
    assert (found - torch.tensor([-40.0, -58.0, -67.0])).abs().max() < 8


def test_snr_alone_is_mapped_as_a_quantity_in_db(tmp_path, capfd):
    text = said("120-snr-alone", tmp_path, capfd, "--quantity", "snr", "--unit", "dB")
    check(text, ["rows of snr at 3 receivers", "dB"])


def test_throughput_is_mapped_as_a_quantity(tmp_path, capfd):
    options = ("--quantity", "throughput", "--unit", "Mbit/s", "--columns", "rssi=tcp_download_mbps")
    check(said("127-throughput", tmp_path, capfd, *options), ["rows of throughput at 1 receivers", "Mbit/s"])


def test_one_of_several_senders_is_the_phone_alone(tmp_path, capfd):
    text = said("146-nexmon-neighbours", tmp_path, capfd, "--sender", "f4:6b:8c:22:0b:31", "--grid", 20, 72)
    check(text, ["26 array snapshots"])
