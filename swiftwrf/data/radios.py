"""Names of receivers and the radios behind them: ids that are none, names of several radios, radios of several names."""

from __future__ import annotations

import re
from collections.abc import Sequence

import numpy as np
import pandas as pd
from numpy.typing import NDArray

from swiftwrf.data.cells import Floats, plain_name, text_of
from swiftwrf.errors import InputError, listed

ADDRESS = re.compile(r"((?:[0-9a-f]{2}[:-]?){4}[0-9a-f]{2})[:-]?[0-9a-f]{2}", re.IGNORECASE)
NO_ADDRESS = ("000000000000", "ffffffffffff")
NO_CELL = re.compile(r"-1|0x?f+|65535|268435455|2147483647|4294967295|9223372036854775807|unknown|<unknown.*>")
CELL_NUMBER = re.compile(r"(?:.*_)?(?:cell_?id|cid|eci|cgi|nci|ci)")  # which is never 0, unlike pci and psc
PHYSICAL_CELL = re.compile(r"(?:.*_)?(?:pci|psc|physical_cell_?id)")  # which other cells on other carriers have, too
CARRIER = re.compile(r"(?:.*_)?(?:[eu]?|nr_?)arfcn(?:_?dl)?")
NETWORK = re.compile(r"(?:.*_)?(?:e?ssid|network(?:_name)?|ap_?(?:name|id)?|access_?point(?:_?(?:name|id))?)")
WIFI_MHZ = {"2.4 GHz": (2400, 2500), "5 GHz": (5150, 5925), "6 GHz": (5925, 7125)}  # lower and upper end
WIFI_CHANNELS = {"2.4 GHz": range(1, 15), "5 GHz": (*range(36, 65, 4), *range(100, 145, 4), *range(149, 178, 4))}
BAND = re.compile(r"(?:.*_)?(?:freq\w*|channel|chan|ch|band|radio)(?:_?(?:mhz|ghz|id|name|no|number))?")


def plain_receiver(name: str) -> str:
    """Return the name of a receiver without what people write differently: case, separators, and zeros before a number.

    Example:
        >>> plain_receiver("CB-99-D5-23-7D-12"), plain_receiver("AP 01"), plain_receiver("007")
        ('cb99d5237d12', 'ap 1', '7')
    """
    words = re.split(r"[\s:._-]+", name.strip().lower())
    plain = "".join(words)
    return plain if re.fullmatch("[0-9a-f]{12}", plain) else re.sub(r"(?<!\d)0+(?=\d)", "", " ".join(words))


def band_names(column: str, values: pd.Series) -> pd.Series | None:
    """Return the bands of values in a column of bands, channels or frequencies as text; None for another column.

    Frequencies and channels of Wi-Fi are those of 2.4 and 5 GHz, frequencies also of 6 GHz, whose channels have the same
    numbers. Other values are their own bands.

    Example:
        >>> list(band_names("freq", pd.Series(["2437", "5180", ""]))), list(band_names("channel", pd.Series(["1", "36"])))
        (['2.4 GHz', '5 GHz', ''], ['2.4 GHz', '5 GHz'])
    """
    if not BAND.fullmatch(plain := plain_name(column)):
        return None
    known = values[values != ""]
    number, is_channel = pd.to_numeric(known, errors="coerce").to_numpy(float), "ch" in plain
    for unit_mhz in (1.0,) if is_channel else (1.0, 1e3, 1e-3, 1e-6):
        band = np.full(len(known), "", dtype=object)
        for name, found in (WIFI_CHANNELS if is_channel else WIFI_MHZ).items():
            mhz = number * unit_mhz
            band[np.isin(number, found) if is_channel else (mhz >= found[0]) & (mhz < found[1])] = name
        if (band != "").all():
            known = pd.Series(band, known.index, dtype=object)
            break
    return known.reindex(values.index, fill_value="")


def bands_of_receivers(
    table: pd.DataFrame,
    packet: NDArray[np.int64],
    receiver: NDArray[np.int64],
    n: int,
    max_bands: int = 12,
    min_fraction: float = 0.95,
) -> tuple[str, list[str]] | None:
    """Return a column of a long table that is the band of its receivers, and the band of each; None without one.

    Args:
        table: Packets.
        packet: Rows of the packets that count.
        receiver: Number of the receiver of each of them.
        n: Number of receivers.
        max_bands: Largest number of bands. Not studied.
        min_fraction: Least fraction of packets with the most frequent band of their receiver. Not studied.
    """
    for name in table.columns:
        if not BAND.fullmatch(plain_name(name)):
            continue
        values = band_names(name, text_of(table[name]))
        assert values is not None
        each = values.to_numpy()[packet]
        usual = pd.Series(each).groupby(receiver).agg(lambda one: one.mode().iloc[0]).reindex(range(n), fill_value="")
        same = (usual.to_numpy()[receiver] == each).mean()
        if same >= min_fraction and several_bands(usual, max_bands):
            return name, [str(band) for band in usual]
    return None


def several_bands(bands: pd.Series, max_bands: int = 12) -> bool:
    """Return True for several bands, fewer than receivers."""
    return 1 < len({*bands} - {""}) <= min(max_bands, len(bands) - 1)


def unknown_ids(receiver: pd.Series) -> NDArray[np.bool_]:
    """Return which cells of a column of receivers hold a number that stands for an unknown one.

    Example:
        >>> unknown_ids(pd.Series(["0", "8585712"], name="eci")), unknown_ids(pd.Series(["0", "335"], name="pci"))
        (array([ True, False]), array([False, False]))
    """
    name, (number, ids) = plain_name(str(receiver.name)), pd.factorize(text_of(receiver))
    text = pd.Series(ids, dtype=str).str.lower().str.removesuffix(".0")
    unknown = text.map(plain_receiver).isin(NO_ADDRESS) | text.str.fullmatch(NO_CELL.pattern)
    if CELL_NUMBER.fullmatch(name) and not PHYSICAL_CELL.fullmatch(name):
        unknown |= text == "0"
    mask: NDArray[np.bool_] = unknown.to_numpy(bool)[number]
    return mask


def separate_radios(table: pd.DataFrame, receiver: str, together: pd.Series, min_fraction: float = 0.3) -> str | None:
    """Return the column that, with the names of the receivers, separates radios; None without one.

    A number of a physical cell repeats on another carrier. A network or access point has several radios if a fraction of
    the packets of one name, place and time differ in channel or band.

    Args:
        table: Long table.
        receiver: Column of the names.
        together: Number of the place and time of each row.
        min_fraction: Least fraction. Not studied.
    """
    plain = {name: plain_name(name) for name in table.columns if name != receiver}
    named = text_of(table[receiver])
    if PHYSICAL_CELL.fullmatch(plain_name(receiver)):
        carriers = [name for name in plain if CARRIER.fullmatch(plain[name])]
        return next((name for name in carriers if (text_of(table[name]).groupby(named).nunique() > 1).any()), None)
    if not NETWORK.fullmatch(plain_name(receiver)):
        return None
    several = {}
    for name in plain:
        if BAND.fullmatch(plain[name]) and text_of(table[name]).nunique() > 1:
            differ = text_of(table[name]).groupby([together, named], sort=False).nunique() > 1
            if differ.mean() >= min_fraction:
                several[name] = text_of(table[name]).nunique()
    return max(several, key=lambda name: several[name], default=None)


def strongest_of_each(
    packets: pd.DataFrame, receiver: str, power: Floats, timed: bool, min_spread_db: float = 6.0
) -> NDArray[np.bool_] | None:
    """Return which packets are the strongest of their radio's name, place and time; None if repeats are of one radio.

    Names of networks and access points are those of several radios. Without times, repeats are scans of one radio unless
    the standard deviation of their powers is larger than fading causes.

    Args:
        packets: Numbers of place and time, and of the name, of each packet.
        receiver: Column of the names in the table.
        power: Powers [dBm], nan where empty.
        timed: Whether the packets have times.
        min_spread_db: Least standard deviation of several radios [dB]. Not studied.
    """
    group = packets.groupby(list(packets.columns))
    if not NETWORK.fullmatch(plain_name(receiver)) or not (group.cumcount() > 0).any():
        return None
    values = pd.Series(power).groupby(group.ngroup().to_numpy())
    if not timed and not float(np.sqrt((values.var().dropna()).mean())) >= min_spread_db:
        return None
    usable = pd.Series(np.where(power < 0, power, -np.inf))  # fillers are at or above 0
    order = usable.groupby(group.ngroup().to_numpy()).rank(method="first", ascending=False)
    is_strongest: NDArray[np.bool_] = (order == 1).to_numpy()
    return is_strongest


def pool_names(names: Sequence[str], by: str) -> list[str]:
    """Return the access point of each radio; a radio that does not match is one of its own.

    `by` is "mac" for the first five bytes of an address, else a regular expression whose group is the access point.

    Raises:
        InputError: An expression that is broken, has no group, or matches no radio.

    Example:
        >>> pool_names(["a4:56:cc:00:10:b0", "a4:56:cc:00:10:b1", "lab"], "mac")
        ['a4:56:cc:00:10', 'a4:56:cc:00:10', 'lab']
        >>> pool_names(["hall-2G", "hall-5G"], "(.*)-.G")
        ['hall', 'hall']
    """
    try:
        pattern = ADDRESS if by == "mac" else re.compile(by)
    except re.error as error:
        raise InputError(f"pool_by {by!r} is no column and no regular expression ({error})") from None
    if pattern.groups != 1:
        raise InputError(f"pool_by takes mac, a column, or a regular expression with one group, got {by!r}")
    matches = [pattern.fullmatch(name) for name in names]
    if not any(matches):
        raise InputError(f"pool_by {by!r} matches no receiver; there are {listed(names)}")
    return [name if match is None else match.group(1) for name, match in zip(names, matches, strict=True)]


def pools_by(source: object, table: pd.DataFrame, names: Sequence[str], column: str | None, by: str) -> list[str]:
    """Return the access point of each radio, by a column of a long table or by the radio's name.

    Args:
        source: Name of the table, for messages.
        table: Table.
        names: Names of the radios.
        column: Column of the names in a long table.
        by: Column of the access points, or what `pool_names` takes.

    Raises:
        InputError: A column of a wide table, a radio of several access points, or as `pool_names`.
    """
    if by not in table.columns:
        return pool_names(names, by)
    if column is None:
        raise InputError(f"{source} has a column for each receiver; pool by their names: mac or a regular expression")
    pairs = pd.DataFrame({"radio": text_of(table[column]), "pool": text_of(table[by])}).drop_duplicates()
    if len(several := pairs["radio"][pairs["radio"].duplicated()]):
        raise InputError(
            f"{source}: receiver {several.iloc[0]!r} has several values in column {by!r}, so it is no access point"
        )
    pool = dict(zip(pairs["radio"], pairs["pool"], strict=True))
    return [pool[name] or name for name in names]


def pooled(rssi: Floats, pool: list[str], by: str, min_spread_db: float = 9.0) -> tuple[list[str], Floats, list[str]]:
    """Return the receivers that radios are pooled into, their RSSI (n, P) [dBm], and notes.

    Radios of one place give the mean of their detected powers. The power of radios of several places, e.g. of a network, is
    that of the strongest one at each place.

    Args:
        rssi: RSSI of the radios (n, R) [dBm], nan where not detected.
        pool: Receiver of each radio.
        by: How pools are named, for the notes.
        min_spread_db: Least standard deviation over rows of the difference of radios at several places [dB], more than
            fading causes. Not studied.

    Example:
        >>> pooled(np.array([[-50.0, -53.0], [-60.0, np.nan]]), ["hall", "hall"], "mac")[1].round(1)
        array([[-51.2],
               [-60. ]])
    """
    names, columns, apart = list(dict.fromkeys(pool)), [], []
    for name in names:
        radios = rssi[:, [radio == name for radio in pool]]
        difference = pd.DataFrame(radios - radios[:, np.isfinite(radios).sum(axis=0).argmax()][:, None])
        if len(difference) and difference.std().max() >= min_spread_db:
            apart.append(name)
            columns.append(pd.DataFrame(radios).max(axis=1))
        else:
            columns.append(10 * np.log10(pd.DataFrame(10 ** (radios / 10)).mean(axis=1)))
    notes = [f"{len(pool)} radios are pooled into {len(names)} receivers by {by}: mean of their powers"]
    if apart:
        notes.append(f"radios of these receivers are at several places, so the strongest one counts: {listed(apart)}")
    return names, np.stack(columns, axis=1), notes


def propose_pools(names: list[str], rssi: Floats, max_apart_db: float = 2.0, min_rows: int = 10) -> list[str]:
    """Return a note that proposes to pool addresses that share five bytes and follow each other, or none.

    The median difference of their values in a row is at most `max_apart_db` (not studied).

    Example:
        >>> power = np.arange(-70.0, -50.0)[:, None] + np.array([0, 1])
        >>> propose_pools(["68:10:bb:63:71:20", "68:10:bb:63:71:21"], power)[0][:48]
        '2 receivers share 1 radio (virtual access points'
    """
    columns: dict[str, list[int]] = {}
    for column, name in enumerate(names):
        if match := ADDRESS.fullmatch(name):
            columns.setdefault(match[1].lower(), []).append(column)
    shared = []
    for group in columns.values():
        apart = np.abs(rssi[:, group[1:]] - rssi[:, group[:1]])
        close = [np.isfinite(a).sum() >= min_rows and np.nanmedian(a) <= max_apart_db for a in apart.T]
        if any(close):
            shared.append([group[0], *np.array(group[1:])[close]])
    if not shared:
        return []
    n, radios = sum(map(len, shared)), "1 radio" if len(shared) == 1 else f"{len(shared)} radios"
    return [
        f"{n} receivers share {radios} (virtual access points): five bytes of their addresses are equal, and their values "
        f"follow each other, e.g. {listed(names[c] for c in shared[0])}; --pool-by mac makes one receiver of each radio"
    ]
