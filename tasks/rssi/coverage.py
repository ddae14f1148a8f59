"""Coverage of an RSSI run in words and tables: shares of the area, weak spots, receivers."""

from __future__ import annotations

from collections.abc import Sequence

from pandas import DataFrame

from swiftwrf.contrib.comparison.coverage import ANY, TWO
from tasks.page.page import Section, Table
from tasks.records import Records, Row
from tasks.rssi.maps import MAX_SPOTS, Maps

MAX_NAMED = 3  # weak spots in a sentence
MIN_NAMED_M2 = 0.5  # which is 1 as a whole number
MIN_MISSING_DB = 0.5  # below which lost packets are what is missing


def coverage_sentence(found: Row, passing: str, where: str = "the measured area") -> str:
    """Return a coverage in words, by `Coverage.values`, receivers and threshold, and the name of the measured area.

    It is empty where both ends move.
    """
    if found["n_scans"] is None:
        return ""
    if found["covered"] is None:
        return f"No cell of the map is in {where}."
    shares = {name: f"{share:.0%}" for name, share in found.items() if isinstance(share, float)}
    sentence = (
        f"{shares['covered']} of {where} is covered ({passing} with at least {found['certainty']:.0%} probability), "
        f"{shares['not_covered']} is not covered (at most {1 - found['certainty']:.0%}), {shares['uncertain']} is uncertain "
        "(between them)"
    )
    if found["scans_above"] is not None:
        sentence += f". {shares['scans_above']} of the {found['n_scans']} scans pass the threshold"
    if (part := shares["not_measured"]) != "0%":
        far = f"over {found['reach_m']:.1f} m from any scan"
        sentence += f". {part} of the area between the scans is not measured, {far}"
    return f"{sentence}."


def why(run: Records) -> str:
    """Return the default threshold of the coverage, and why it is that one; empty if it was asked for or does not count."""
    if run.metrics["threshold"] is None or run.metrics["coverage"][0]["n_scans"] is None:
        return ""
    threshold, unit = run.metrics["coverage"][0]["threshold_dbm"], Maps(run).unit
    options = "--above" if unit == "dBm" else "--above or --below"
    return (
        f"The threshold of {threshold:g} {unit} is {run.metrics['threshold']}; `{options} {unit.upper()}` sets another."
    )


def bands_sentence(run: Records) -> str:
    """Return the coverage of each band at the first threshold; empty without bands."""
    found, several = run.metrics.get("bands", []), len(run.metrics["coverage"]) > 1
    first = run.metrics["coverage"][0]["threshold_dbm"]
    shares = [
        f"{row['covered']:.0%} by {row['band']}" + (f" on {row['floor']}" if several else "")
        for row in found
        if row["threshold_dbm"] == first and row["covered"] is not None
    ]
    return f"The measured area is covered to {', '.join(shares)}." if shares else ""


def held_out_sentence(run: Records) -> str:
    """Return how many test scans pass at the first threshold, beside the prediction; empty without test scans."""
    table = run.table("coverage")
    first = table[table["threshold_dbm"] == run.metrics["coverage"][0]["threshold_dbm"]]
    rows = first[first["receiver"] == (ANY if (first["receiver"] == ANY).any() else first["receiver"].iloc[0])]
    if "n_test" not in rows or not (n := rows["n_test"].sum()):
        return ""
    above, predicted = ((rows["n_test"] * rows[name]).sum() / n for name in ("test_above", "test_predicted"))
    return (
        f"Of {n:.0f} test scans, which took no part in the fit, {above:.0%} pass and {predicted:.0%} were predicted to."
    )


def spots_sentence(floors: Sequence[Maps]) -> str:
    """Return the largest weak spots of all floors; empty if there are none."""
    named = []
    for maps in floors:
        where = f" on {maps.name}" if maps.suffix else ""
        for spot in maps.spots[:MAX_NAMED]:
            if spot["area_m2"] < MIN_NAMED_M2:
                continue
            place = f"{spot['area_m2']:,.0f} m², weakest at x = {spot['x_m']:.1f} m, y = {spot['y_m']:.1f} m{where}"
            named.append(
                (
                    spot["not_covered_m2"],
                    spot["area_m2"],
                    f"{place} ({missing(spot, maps)} at {spot['receiver']})",
                )
            )
    largest = [text for *_, text in sorted(named, key=lambda one: one[:2], reverse=True)[:MAX_NAMED]]
    return f"Largest weak spots: {'; '.join(largest)}." if largest else ""


def missing(spot: Row, maps: Maps) -> str:
    """Return what a weak spot of a floor lacks, in words."""
    if maps.unit == "dBm" and spot["missing_db"] < MIN_MISSING_DB:
        return "packets are lost"
    return f"{maps.amount(spot['missing_db'])} {'too high' if maps.is_below else 'missing'}"


def section(run: Records) -> Section | None:
    """Return weak spots, and coverage by threshold and receiver. None where both ends move."""
    floors = [maps for maps in Maps.of_floors(run) if maps.has_coverage]
    if not floors:
        return None
    tables = [_spots(floors)] if any(maps.spots for maps in floors) else []
    every, several, limit = run.table("coverage"), len(floors) > 1, f"{floors[0].direction} [{floors[0].unit}]"
    of_one = ~every["receiver"].isin([ANY, TWO])
    if run.metrics["rooms"]:
        tables.append(_rooms(run.table("rooms"), limit))
    if run.metrics.get("bands"):
        tables.append(_table(run.table("bands"), several, limit, by="band"))
    found = Section("", tables=tables)
    if of_one.all():
        found.tables.append(_table(every, several, limit))
    else:
        found.tables.append(_table(every[~of_one], several, limit))
        found.parts.append(Section("Each receiver", tables=[_table(every[of_one], several, limit)], folded=True))
    return found


def _spots(floors: Sequence[Maps]) -> Table:
    rows = []
    for maps in floors:
        for rank, spot in enumerate(maps.spots[: 2 * MAX_SPOTS], start=1):
            floor = [str(maps.arrays["floor_names"][maps.floor])] if maps.suffix else []
            sizes = [f"{spot[name]:.1f}" for name in ("x_m", "y_m", "area_m2", "not_covered_m2")]
            rows.append(
                [
                    str(rank),
                    *floor,
                    *sizes,
                    f"{spot['probability']:.0%}",
                    missing(spot, maps),
                    spot["receiver"],
                ]
            )
    heads = ["x [m]", "y [m]", "area [m²]", "not covered [m²]", "probability", "missing", "best receiver"]
    found, first = floors[0].coverage, floors[0]
    caption = (
        f"Weak spots: connected parts of the measured area that are not covered {first.limit}. The place is the weakest "
        f"one. Missing there: {first.error_unit} by which the best receiver is too {'high' if first.is_below else 'weak'} "
        f"for {found['certainty']:.0%} of its {first.measurement}s. All are in `weak_spots.csv`."
    )
    return Table(["", *(["floor"] if floors[0].suffix else []), *heads], rows, caption)


def _table(table: DataFrame, several: bool, limit: str, by: str = "receiver") -> Table:
    columns = {
        "covered": "covered",
        "not_covered": "not covered",
        "uncertain": "uncertain",
        "not_measured": "not measured",
        "scans_above": f"scans {limit.partition(' ')[0]}",
        "test_predicted": "test scans, predicted",
        "test_above": "test scans, counted",
    }
    columns = {name: head for name, head in columns.items() if name in table}
    rows = [
        [
            row[by],
            *([str(row["floor"])] if several else []),
            f"{row['threshold_dbm']:g}",
            *("-" if row[name] != row[name] or row[name] is None else f"{row[name]:.0%}" for name in columns),
        ]
        for row in table.to_dict("records")
    ]
    caption = (
        f"Coverage by receiver. {ANY.capitalize()}: a scan has at least one beyond the threshold. {TWO.capitalize()}: the "
        "second-best receiver is beyond it, too, as roaming needs. Not measured: part of the area between the scans. Test "
        "scans took no part in the fit. `coverage.csv` contains the same."
    )
    if by == "band":
        caption = "Coverage by band: a scan has at least one receiver of the band beyond the threshold. `bands.csv`."
    heads = [by, *(["floor"] if several else []), limit, *columns.values()]
    return Table(heads, rows, caption)


def _rooms(table: DataFrame, limit: str) -> Table:
    names = ("area_m2", "covered", "not_covered", "uncertain", "not_measured")
    rows = [
        [
            row["room"],
            f"{row['threshold_dbm']:g}",
            f"{row['area_m2']:.0f}",
            *("-" if row[name] != row[name] or row[name] is None else f"{row[name]:.0%}" for name in names[1:]),
            row["best_receiver"],
        ]
        for row in table.to_dict("records")
    ]
    heads = ["room", limit, "area [m²]", "covered", "not covered", "uncertain", "not measured", "best receiver"]
    return Table(heads, rows, "Coverage of each room by any receiver; percentages of its measured area. `rooms.csv`.")
