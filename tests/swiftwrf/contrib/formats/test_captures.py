"""Captures of CSI tools: channels, element order and directions from bytes made here, and everything that is refused."""

import numpy as np
import pytest
import torch
from samples import bfee, nexmon, nexmon_payload, pcap, plane_waves, write_captures

from swiftwrf import InputError, load_rssi, load_snapshots
from swiftwrf.contrib.formats import captures

pytest.importorskip("csiread", reason="needs the extra csi")

N = 12


def unit_power(channel):
    """Channels (n, ..., 3) as (n, S, 3), each position with mean power 1."""
    channel = torch.from_numpy(channel).flatten(1, -2)
    return (channel / channel.abs().square().mean(dim=(1, 2), keepdim=True).sqrt()).to(torch.complex64)


def test_channels_are_those_written(tmp_path):
    written = write_captures(tmp_path, n=N)
    data = load_snapshots(tmp_path)
    assert data.channel.shape == (N, 3 * 30, 3)
    torch.testing.assert_close(data.channel, unit_power(written))
    assert data.position.numpy() == pytest.approx(plane_waves(N, 3, 30)[0])


def test_elements_are_ports_whatever_the_chains(tmp_path):
    written = write_captures(tmp_path, n=2, packets=2)
    for order in ((2, 0, 1), (1, 0, 2)):
        frames = [bfee(csi[..., None], port=order) for csi in written[1]]
        (tmp_path / "walk1.dat").write_bytes(b"".join(frames))
        torch.testing.assert_close(load_snapshots(tmp_path).channel, unit_power(written))


def test_other_frames_and_packets_are_left_out(tmp_path):
    written = write_captures(tmp_path, n=2, packets=2)
    first, second = written[1]
    streams = np.stack([second, 1j * first[::-1]], axis=-1)
    others = [bfee(first[..., None], code=0xC1), bfee(first[:, :2, None]), bfee(first[..., None], port=(0, 0, 1))]
    (tmp_path / "walk1.dat").write_bytes(b"".join([*others, bfee(first[..., None]), bfee(streams)]))
    (tmp_path / "spare.dat").write_bytes(bfee(first[..., None]))
    data = load_snapshots(tmp_path)
    torch.testing.assert_close(data.channel, unit_power(written))
    assert any("all 3 elements are left out: 2" in note for note in data.notes)
    assert any("left out: spare.dat" in note for note in data.notes)


def test_captures_with_fewer_packets_repeat_them(tmp_path):
    written = write_captures(tmp_path, n=2, packets=4)
    (tmp_path / "walk1.dat").write_bytes(b"".join(bfee(csi[..., None]) for csi in written[1, :2]))
    written[1] = written[1, [0, 0, 1, 1]]
    data = load_snapshots(tmp_path)
    torch.testing.assert_close(data.channel, unit_power(written))
    assert "packets used of each capture: 2, 4" in data.notes


def test_packets_of_long_captures_are_evenly_spaced(tmp_path, monkeypatch):
    written = write_captures(tmp_path, n=2, packets=5)
    monkeypatch.setattr(captures, "MAX_PACKETS", 2)
    torch.testing.assert_close(load_snapshots(tmp_path).channel, unit_power(written[:, [0, 2]]))


def test_times_splits_and_every(tmp_path):
    write_captures(tmp_path, n=4)
    table = tmp_path / "positions.csv"
    lines = table.read_text().splitlines()
    table.write_text("\n".join([f"{lines[0]},time", *(f"{line},{i}.5" for i, line in enumerate(lines[1:]))]))
    (tmp_path / "train_index.txt").write_text("1\n2\n3\n")
    (tmp_path / "test_index.txt").write_text("4\n")
    data = load_snapshots(tmp_path)
    assert data.time.tolist() == [0.5, 1.5, 2.5, 3.5]
    assert [part.tolist() for part in data.named_splits["random"]] == [[0, 1, 2], [3]]
    assert len(load_snapshots(tmp_path, every=2)) == 2


def test_a_capture_alone_names_what_to_add(tmp_path):
    write_captures(tmp_path)
    with pytest.raises(InputError, match=r"is one capture; name its folder: .*file,x,y,z.*array_position"):
        load_snapshots(tmp_path / "walk0.dat")


def test_captures_of_one_antenna_receive_no_direction(tmp_path):
    write_captures(tmp_path)
    (tmp_path / "walk.csv").write_text('type,role,mac,CSI_DATA\nCSI_DATA,AP,3C:71,"[1 2]"\n')
    for source in (tmp_path, tmp_path / "walk.csv"):
        with pytest.raises(InputError, match=r"walk.csv is a capture of an ESP32, which has one antenna"):
            load_snapshots(source)


def test_captures_with_positions_are_no_survey(tmp_path):
    write_captures(tmp_path)
    with pytest.raises(InputError, match="looks like array snapshots, which swiftwrf aoa can read; expected RSSI"):
        load_rssi(tmp_path)


def subcarriers(tones, first, last, step=1):
    """Indices of the subcarriers first to last on both sides of DC, in the order of the FFT."""
    return [*range(first, last + 1), *range(tones - last, tones - first + 1)][::step]


@pytest.mark.parametrize(("tones", "used"), [(64, (1, 28)), (128, (2, 58)), (256, (2, 122, 3))])
@pytest.mark.parametrize(("chip", "bits"), [(3, 8), (0xDEAD, 8), (106, 11)])
def test_nexmon_channels_are_those_written(tmp_path, tones, used, chip, bits):
    written = write_captures(tmp_path, n=2, suffix=".pcap", tones=tones)
    written[:, :, [0, tones // 2]] = 120 + 120j  # DC and guard
    for i in range(2):
        (tmp_path / f"walk{i}.pcap").write_bytes(nexmon(written[i], chip))
    expected = unit_power(written[:, :, subcarriers(tones, *used)])
    torch.testing.assert_close(load_snapshots(tmp_path).channel, expected, rtol=0, atol=2 * 2.0**-bits)


@pytest.mark.parametrize("form", [{}, {"order": ">"}, {"mark": 0xA1B23C4D}, {"order": ">", "mark": 0xA1B23C4D}])
def test_nexmon_directions_in_all_kinds_of_pcap(tmp_path, form):
    written = write_captures(tmp_path, n=3, suffix=".pcap", tones=64)
    usual = load_snapshots(tmp_path)
    for i in range(3):
        (tmp_path / f"walk{i}.pcap").write_bytes(nexmon(written[i], **form))
    data = load_snapshots(tmp_path)
    torch.testing.assert_close(data.channel, usual.channel)
    cosine = data.direction @ data.array.axis
    turn = torch.angle((data.channel[:, :, 1:] * data.channel[:, :, :-1].conj()).mean(dim=(1, 2)))
    spacing = 0.0288 / data.array.wavelength
    assert (turn / (2 * torch.pi * spacing)).tolist() == pytest.approx(cosine.tolist(), abs=0.01)


def test_packets_of_one_sender_are_used(tmp_path):
    written = write_captures(tmp_path, n=2, packets=3, suffix=".pcap", tones=64)
    usual, neighbour = load_snapshots(tmp_path), bytes(range(10, 16))

    def capture(row: int, foreign: int) -> bytes:
        packets = [
            nexmon_payload(csi, core, number)
            for number, cores in enumerate(written[row])
            for core, csi in enumerate(cores.T)
        ]
        others = [
            nexmon_payload(1j * csi, core, 9 + number, sender=neighbour)
            for number in range(foreign)
            for core, csi in enumerate(written[row, 0].T)
        ]
        return pcap(others + packets)

    for foreign in (1, 3):
        for row in range(2):
            (tmp_path / f"walk{row}.pcap").write_bytes(capture(row, foreign))
        if foreign == 1:
            found = load_snapshots(tmp_path)
            assert found.channel.equal(usual.channel)
            assert "packets by sender: 01:02:03:04:05:06 6, 0a:0b:0c:0d:0e:0f 2" in " ".join(found.notes)
    with pytest.raises(InputError, match=r"several senders, with these packets: 0.* 6, 0.* 6; choose one: sender"):
        load_snapshots(tmp_path)
    assert load_snapshots(tmp_path, sender="01:02:03:04:05:06").channel.equal(usual.channel)
    assert not load_snapshots(tmp_path, sender="0A:0B:0C:0D:0E:0F").channel.equal(usual.channel)
    with pytest.raises(InputError, match=r"walk0\.pcap of .* has no packet of sender ff"):
        load_snapshots(tmp_path, sender="ff")


def test_nexmon_packets_of_one_frame_make_a_channel(tmp_path):
    written = write_captures(tmp_path, n=2, packets=2, suffix=".pcap", tones=64)
    usual = load_snapshots(tmp_path)
    first, second = (
        [nexmon_payload(csi, core, number) for core, csi in enumerate(written[1, number].T)] for number in range(2)
    )
    other_stream = nexmon_payload(written[0, 0, :, 0], core=0, number=0, stream=1)
    payloads = [b"other traffic", first[0], first[2], other_stream, first[1], second[0], second[0]]
    payloads += [*second[1:], first[0]]
    (tmp_path / "walk1.pcap").write_bytes(pcap(payloads))
    data = load_snapshots(tmp_path)
    torch.testing.assert_close(data.channel, usual.channel)
    assert any("left out: 2" in note for note in data.notes)
