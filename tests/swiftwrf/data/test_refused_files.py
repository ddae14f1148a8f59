"""Folders of every format with one thing wrong: each is refused in one sentence, with the words of its row."""

import io
import json
import pickle
import zlib

import numpy as np
import pytest
from fuzz.kinds import DATA, SNAPSHOTS, N
from PIL import Image
from samples import (
    FREQUENCY,
    array_yml,
    bfee,
    nexmon,
    nexmon_payload,
    pcap,
    snapshot_arrays,
    write_deepmimo,
    write_dichasus,
    write_paths,
    write_records,
    write_snapshots,
)

from swiftwrf import InputError
from swiftwrf.errors import MAX_LENGTH

POSITIONS, GATEWAY, PLACES, TEST = "tx_pos.csv", "gateway_info.yml", "gateway_position.yml", "test_index.txt"
CUT_CSV = "".join(f"{i},1,1\n" for i in range(1, N))


def positions(row):
    """Return the positions with another last row."""
    return {POSITIONS: f"x,y,z\n{CUT_CSV}{row}\n"}


def gateway(position="[0, 0, 0]", orientation="[0, 0, 0, 1]"):
    return {GATEWAY: f"g: {{position: {position}, orientation: {orientation}}}\n"}


def image(*shape, name="00003", kind="PNG"):
    stream = io.BytesIO()
    Image.fromarray(np.zeros(shape, np.uint8)).save(stream, format=kind)
    return {f"spectrum/{name}.png": stream.getvalue()}


def images(content):
    return {f"spectrum/{number:05d}.png": content for number in range(1, N + 1)}


def undecoded(rows, columns):
    """Return a PNG of zeros, without its pixels ever being in memory."""

    def chunk(name, data):
        return len(data).to_bytes(4, "big") + name + data + zlib.crc32(name + data).to_bytes(4, "big")

    size = columns.to_bytes(4, "big") + rows.to_bytes(4, "big") + bytes([8, 0, 0, 0, 0])
    return b"\x89PNG\r\n\x1a\n" + chunk(b"IHDR", size) + chunk(b"IDAT", zlib.compress(b"")) + chunk(b"IEND", b"")


SPECTRA = [
    ("gateway_info.yml is missing", {GATEWAY: None}),
    ("not valid YAML", {GATEWAY: "a: [1"}),
    ("must describe one gateway", {GATEWAY: "a: !!python/object/apply:os.getcwd []"}),
    ("one gateway", {GATEWAY: "name: x\n"}),
    ("unit quaternion", gateway(orientation="[0, 0, 1, 1]")),
    (r"position must have shape \(3\)", gateway("[0, 0]")),
    ("one of tx_pos.csv", {POSITIONS: None}),
    ("one of tx_pos.csv", {"rx_pos.csv": "x,y,z\n1,1,1\n"}),
    ("header x,y,z", {POSITIONS: "a,b,c\n1,2,3\n"}),
    ("is empty", {POSITIONS: ""}),
    ("no rows", {POSITIONS: "x,y,z\n"}),
    ("row 11, counted from 0", positions("nan,1,1")),
    ("row 11, counted from 0", positions("inf,1,1")),
    ("row 12, column x: 'here' is not a number", positions("here,1,1")),
    ("row 12 has 2 values", positions("1,1")),
    ("position 11 of .* is that of the fixed end", positions("0,0,0")),
    ("12 images, but there are 13", {POSITIONS: "x,y,z\n" + "1,1,1\n" * 13}),
    ("0 images", images(None)),
    ("00003.png is missing", {"spectrum/00003.png": None} | image(8, 32, name="00099")),
    ("8 x 30 pixels", image(8, 30)),
    ("must have one shape", image(16, 64)),
    ("mode RGB", image(8, 32, 3)),
    ("not a complete PNG", {"spectrum/00003.png": b""}),
    ("not a complete PNG", {"spectrum/00003.png": lambda content: content[:60]}),
    *(("not a complete PNG", image(8, 32, name="00001", kind=kind)) for kind in ("EPS", "BMP", "TIFF", "GIF")),
    ("pixels; take one measurement of several", images(undecoded(5000, 20000))),
    ("expected 1 to 12", {TEST: "00013\n"}),
    ("expected 1 to 12", {TEST: "0\n"}),
    ("twice", {TEST: "11\n11\n"}),
    ("whole number", {TEST: "eleven\n"}),
    ("both its training and its test", {TEST: "10\n"}),
    ("test_index.txt is missing", {TEST: None}),
]


def powers(row):
    return {"gateway_rssi.csv": f"a,b\n{row}\n" + "-50,-60\n" * (N - 1)}


def places(content):
    return {PLACES: content}


RSSI = [
    ("UTF-8", {POSITIONS: "x,y,z\n\xe4,1,1\n".encode("latin-1")}),
    ("UTF-8", {POSITIONS: "x,y,z\n1,1,1\n".encode("utf-16")}),
    ("UTF-8", places("\xe4: [1, 2, 3]".encode("latin-1"))),
    ("UTF-8", {"train_index.txt": "1\n".encode("utf-16")}),
    ("whole number", {"train_index.txt": "1_0\n"}),
    ("whole number", {"train_index.txt": "9" * 5000}),
    ("expected 0 to 11", {TEST: "12\n"}),
    ("not a number", {POSITIONS: "x,y,z\n1_0,1,1\n"}),
    ("must match", {POSITIONS: "x,y,z\n1e10,1,1\n"}),
    ("comma-separated", {POSITIONS: 'x,y,z\n"' + "1" * 200_000 + '",1,1\n'}),
    ("needs 3 finite numbers", {POSITIONS: "x,y,z\n" + "nan,1,1\n" * N}),
    ("no name for column 2", {"gateway_rssi.csv": "a,\n" + "-50,-60\n" * N}),
    ("'a' twice", {"gateway_rssi.csv": "a,a\n-1,-2\n"}),
    ("has 1 rows, tx_pos.csv 12", {"gateway_rssi.csv": "a,b\n-50,-60\n"}),
    ("is empty", {"gateway_rssi.csv": ""}),
    ("row 1, receiver a: 31 dBm", powers("31,-60")),
    ("row 1, receiver a: -151 dBm", powers("-151,-60")),
    ("row 1, column a: 'loud' is not a number", powers("loud,-60")),
    ("row 1 has 3 values", powers("-50,-60,-70")),
    ("'a' needs a position", places("a: '123'\nb: [5, 0, 1]\n")),
    ("'a' needs a position", places("a: 2001-99-99\nb: [5, 0, 1]\n")),
    ("'a' needs a position", places("a: [0, 0, " + "9" * 5000 + "]\nb: [5, 0, 1]\n")),
    ("not valid YAML", places("a: " + "[" * 5000 + "]" * 5000)),
    ("not valid YAML", places("a: &a [*a]\nb: [1, 2, 3]")),
    ("not valid YAML", places("? [1, 2]\n: 3")),
    ("has none of the receivers", places("d: [0, 0, 1]\n")),
    ("'a' twice", places("a: [0, 0, 1]\na: [1, 1, 1]\n")),
    ("3 finite numbers", places("a: [0, 0]\nb: [1, 1]\n")),
    ("latitude and longitude", {"survey.yml": "origin: [91, 0]"}),
    ("ascending", {"survey.yml": "floors: {up: 4, down: 1}"}),
    ("names with ascending heights", {"survey.yml": "floors: 3"}),
    ("true or false", {"survey.yml": "receiver_moves: perhaps"}),
    ("states storeys", {"survey.yml": "storeys: 3"}),
]


def paths(**changes):
    return lambda folder: write_paths(folder, **changes)


PATHS = [
    ("not an npz archive", {"paths.npz": lambda content: content[:100]}),
    ("no direction", paths(last_point=np.stack([np.arange(1.0, N + 1), np.zeros(N), np.ones(N)], axis=1))),
    ("carrier", paths(frequency_hz=np.float64(1e-320))),
    ("at one place", paths(receiver_position=np.tile([0.0, 0.0, 2.0], (N, 1)))),
    ("gain other than 0", paths(gain=np.zeros(N, dtype=np.complex64))),
    ("amplitudes", paths(gain=np.full(N, 1e300 + 0j))),
    ("at most 1e", paths(transmitter_position=np.full((N, 3), 1e300))),
    ("path_count", paths(path_count=np.float64(1))),
    ("path_count", paths(path_count=np.full(N, np.nan))),
    ("path_count", paths(path_count=np.int32(3))),
    ("must have shape", paths(path_count=np.full(N, 2**62))),
    ("plain numbers", paths(gain=np.array(["a"] * N))),
    ("complex", paths(transmitter_position=np.ones((N, 3), dtype=complex))),
    ("lacks gain", paths(gain=None)),
    ("gain must have shape", paths(gain=np.ones(5, np.complex64))),
    ("gain must be finite", paths(gain=np.full(N, np.nan, np.complex64))),
    ("at least one path", paths(path_count=np.arange(N, dtype=np.int32))),
    ("frequency_hz", paths(frequency_hz=np.float64(-1))),
    ("plain numbers", paths(last_point=np.array([object()] * N))),
]


def stored(**changes):
    return lambda folder: write_snapshots(folder, data=SNAPSHOTS, **changes)


def csi(change):
    return stored(csi=change(SNAPSHOTS.channel.numpy()))


def elements(change):
    return stored(element_position=change(snapshot_arrays(SNAPSHOTS)["element_position"]))


SNAPSHOT_ARRAYS = [
    ("must hold complex numbers", csi(np.abs)),
    (r"give csi.transpose\(0, 2, 1\)", csi(lambda c: c.transpose(0, 2, 1))),
    ("4 elements", csi(lambda c: c[..., :3])),
    ("for 12 positions", csi(lambda c: c[:5])),
    ("row 7 has no power", csi(lambda c: c * (np.arange(N) != 7)[:, None, None])),
    ("row 0 has no power", csi(lambda c: c + np.nan)),
    ("no power, or more than numbers hold", csi(lambda c: c + np.inf)),
    ("values at 1 elements", csi(lambda c: c * (np.arange(4) == 3))),
    ("lacks csi", stored(csi=None)),
    ("the array must rest", stored(array_position=np.zeros((N, 3)))),
    ("1 to 2 elements at one place", elements(lambda e: e[[0, *range(3)]])),
    ("wavelengths", elements(lambda e: 1000 * e)),
    ("along z", elements(lambda e: e[:, [2, 0, 1]])),
    ("lacks the array", stored(element_position=None)),
    ("whole numbers", stored(element_position=None, rows=4.5, columns=4, spacing_m=0.06)),
    ("lacks array_orientation", stored(array_orientation=None)),
    ("Euler angles", stored(array_orientation=np.zeros(3))),
    ("unit quaternion", stored(array_orientation=np.ones(4))),
    ("the array's normal", stored(array_orientation=None, array_normal=1.0)),
    (r"shape \(n, 3\)", stored(position=np.zeros((N, 2)))),
    ("equal to array_position", stored(position=np.tile([0.2, 2.4, 1.2], (N, 1)))),
    ("position must be real", stored(position=np.ones((N, 3), complex))),
    ("carrier in Hz", stored(frequency_hz=2.4)),
    ("frequency_hz", stored(frequency_hz=np.full(7, FREQUENCY))),
    ("time has 3 rows", stored(time=np.zeros(3))),
    (r"\(it is no zip archive\)$", {"snapshots.npz": pickle.dumps({"csi": 1})}),  # without advice to load a pickle
]


def of_rays(**changes):
    """Change arrays of a folder of DeepMIMO, each computed from all."""
    return lambda folder: write_deepmimo(folder, **changes)


def traced(name, values):
    return lambda folder: np.savez(folder / f"{name}_t000_tx000_r001.npz", **{name: values})


DEEPMIMO = [
    ("params.json", {"params.json": None}),
    ("rt_params", {"params.json": "{}"}),
    ("carrier in Hz", {"params.json": json.dumps({"rt_params": {"frequency": 2.4}})}),
    ("phase_t000_tx000_r001.npz is missing", {"phase_t000_tx000_r001.npz": None}),
    ("all have shape", traced("phase", np.zeros((3, 25)))),
    ("rx_pos of pair", traced("rx_pos", np.zeros((3, 3)))),
    ("must be finite", traced("rx_pos", np.full((N, 3), np.nan))),
    ("no receiver with a path", traced("power", np.full((N, 25), np.nan))),
    *(
        (
            "look like radians",
            of_rays(**{name: lambda a, name=name: np.deg2rad(a[name]) for name in ("aoa_az", "aoa_el")}),
        ),
        ("of propagation", of_rays(aoa_el=lambda a: 180 - a["aoa_el"], aoa_az=lambda a: a["aoa_az"] + 180)),
        ("x and y are swapped", of_rays(**{n: lambda a, n=n: a[n][:, [1, 0, 2]] for n in ("rx_pos", "tx_pos")})),
        ("turns clockwise", of_rays(aoa_az=lambda a: -a["aoa_az"])),
        ("not in metres", of_rays(rx_pos=lambda a: 1000 * a["rx_pos"])),
        ("not in metres or delays not in seconds", of_rays(delay=lambda a: 1e9 * a["delay"])),
    ),
]


def recorded(**values):
    return lambda folder: write_records(folder / "walk.tfrecords", [values])


RECORDS = [
    ("record 24", {"walk.tfrecords": lambda content: content[:-10]}),
    ("no TFRecord file", {"walk.tfrecords": b"\xff" * 100}),
    ("not what the data set has", recorded(csi=np.ones((2, 4, 3), np.float32), pos=np.zeros(3))),
    ("'pos'", recorded(csi=np.ones((1, 2, 4, 3), np.complex64))),
    ("no JSON with antennas", {"metadata.json": None}),
]


def antennas(**changes):
    usual = {"location": [0, 0, 1], "direction": [1, 0, 0], "spacingX": 0.06, "spacingY": 0.06, "assignments": [[0, 1]]}
    return described(antennas=[{name: value for name, value in (usual | changes).items() if value is not None}])


def described(**content):
    return lambda folder: write_dichasus(folder, offsets=True, **content)


def offsets(**content):
    return {"reftx-offsets-walk.json": json.dumps(content)}


DICHASUS = [
    ("offsets of 1", offsets(cpo=[0.0], sto=[0.0])),
    ("cpo and sto", offsets(cpo=["a"], sto=[0.0])),
    ("frequency must be a number", described(frequency=None)),
    ("carrier in Hz", described(frequency=2.4)),
    ("location", antennas(location=[0, 0])),
    ("is the spacing in metres", antennas(spacingX=60, spacingY=60)),
    ("spacingX", antennas(spacingX=None)),
    ("direction", antennas(direction=None)),
    ("lies along up", antennas(direction=[0, 0, 1])),
    ("right angles", antennas(rightvector=[1, 0, 0], upvector=[1, 0, 0.1])),
    ("equal length", antennas(assignments=[[0, 1], [2]])),
    ("each once", antennas(assignments=[[0, 0]])),
    ("not what the data set has", antennas(assignments=[[0, 99]])),
]


def described_by(**changes):
    return {"array.yml": array_yml(**changes)}


def listed(*rows, header="file,x,y,z"):
    return {"positions.csv": "\n".join([header, *rows, ""])}


FRAME = len(bfee(np.zeros((30, 3, 1))))
CUTS = [1, 2, 3, 12, 23, FRAME - 1, FRAME + 1, 2 * FRAME + 40]
OTHER_SIZES = [(0, 0xFF), (1, 0), (11, 0), (11, 4), (11, 255), (12, 3), (19, 0), (20, 9)]  # places and bytes
INCOMPLETE = r"walk1.dat is not a complete capture of the Linux 802.11n CSI Tool"
CAPTURES = [
    (r"lacks positions.csv: .*file,x,y,z", {"positions.csv": None}),
    (r"lacks array.yml: .*array_orientation", {"array.yml": None}),
    ("lacks frequency_hz", described_by(frequency_hz=None)),
    ("carrier in Hz", described_by(frequency_hz=5.2)),
    ("wavelengths", described_by(spacing_m=28.8)),
    ("lacks the array", described_by(rows=None)),
    ("array_position of", described_by(array_position="[0, a, 1]")),
    ("array_position of|not finite", described_by(array_position="[0, .nan, 1]")),
    ("no packet has a channel of the 4 elements .*3 have others", described_by(columns=4)),
    ("no column z", listed("walk0.dat,1,2", header="file,x,y")),
    ("no column file", listed("1,2,3", header="x,y,z")),
    ("names walk0.dat twice", listed("walk0.dat,1,2,3", "walk0.dat,2,2,3")),
    ("row 1 must name a capture", listed("walk99.dat,1,2,3")),
    ("row 1 must name a capture", listed("array.yml,1,2,3")),
    ("position must be finite", listed("walk0.dat,1,,3")),
    ("not a number", listed("walk0.dat,1,two,3")),
    ("equal to array_position", listed("walk0.dat,0,2,1")),
    ("no packet", {"walk0.dat": b""}),
    ("row 0 has no power", {"walk0.dat": bfee(np.zeros((30, 3, 1)))}),
    *((INCOMPLETE, {"walk1.dat": lambda content, at=at: content[:at]}) for at in CUTS),
    *(
        (INCOMPLETE, {"walk1.dat": lambda c, at=FRAME + at, byte=byte: c[:at] + bytes([byte]) + c[at + 1 :]})
        for at, byte in OTHER_SIZES
    ),
]
PCAP = [
    (words, {"walk1.pcap": change})
    for words, change in (
        ("is cut off", lambda content: content[:-1]),
        ("is cut off", lambda content: content[: 24 + 10]),
        ("does not begin as a pcap file", lambda content: b"\x0a\x0d\x0d\x0a" + content),
        ("does not begin as a pcap file", b""),
        ("no packet has a channel of the 3 elements", lambda content: content[:24]),
        ("64, 128 or 256 subcarriers", pcap([nexmon_payload(np.ones(100), 0)])),
        ("64, 128 or 256 subcarriers", pcap([b"\x11\x11"])),
        ("chip 9 is none of 4358, 4366c0", nexmon(np.ones((1, 64, 3)), chip=9)),
        ("43455c0 .* has one antenna", nexmon(np.ones((1, 64, 1)), chip=101)),
        ("packets have several bandwidths", lambda content: content + nexmon(np.ones((1, 128, 3)))[24:]),
        ("different numbers of subcarriers", nexmon(np.ones((1, 128, 3)))),
        ("no packet .* 3 elements .* 2 have others", nexmon(np.ones((2, 64, 4)))),
    )
]
REFUSED = {
    "format of spectra nerf2": SPECTRA,
    "format of RSSI nerf2": RSSI,
    "format of spectra paths": PATHS,
    "format of array snapshots snapshots": SNAPSHOT_ARRAYS,
    "format of spectra deepmimo": DEEPMIMO,
    "format of array snapshots records": RECORDS,
    "records with offsets": DICHASUS,
    "format of array snapshots captures": CAPTURES,
    "captures in pcap": PCAP,
}


@pytest.mark.parametrize(("kind", "words", "change"), [(kind, *row) for kind, rows in REFUSED.items() for row in rows])
def test_a_folder_with_one_thing_wrong_is_refused(tmp_path, kind, words, change):
    """A change is a function of the folder, or what files hold: bytes, text, a function of their bytes; None deletes one."""
    write, read = DATA[kind]
    write(folder := tmp_path / "folder")
    if callable(change):
        change(folder)
    else:
        for name, content in change.items():
            file = folder / name
            if content is None:
                file.unlink()
            else:
                made = content(file.read_bytes()) if callable(content) else content
                file.write_bytes(made.encode() if isinstance(made, str) else made)
    with pytest.raises(InputError, match=words) as refused:
        read(folder)
    assert len(str(refused.value)) <= MAX_LENGTH
