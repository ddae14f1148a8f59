"""Make the tables of docs/development/targets.md: targets, committed results, and whether they are met.

A result is rounded to the digits of its target before the comparison.
"""

from __future__ import annotations

from collections.abc import Sequence

from aoa_tables import aoa_shares, change_text, turbo_condition
from record import load, markdown

from augment.turbo.condition import FULL_NETWORK, MEASURED_NETWORK

# by scene and split: SSIM and PSNR [dB], with the digits they were asked for
SYNTHESIS: dict[str, tuple[str, str]] = {
    "s23-200 random": ("0.978", "31.1"),
    "s23-200 block": ("0.661", "16.4"),
    "newrf-bedroom random": ("0.688", "19.6"),
    "newrf-office random": ("0.678", "19.3"),
    "simulated-room random": ("0.733", "22.7"),
}
# by data and split: median and 90 % absolute error [dB]
RSSI: dict[str, tuple[str, str]] = {
    "tetam-tracks random": ("3.05", "7.6"),
    "tetam-tracks spatial": ("3.15", "7.7"),
    "tetam-tracks block": ("3.35", "8.0"),
    "tetam-fingerprints random": ("2.40", "5.5"),
    "tetam-fingerprints spatial": ("2.35", "6.2"),
}
# by data and split: how much lower turbo learning should be than the measured share alone, by share; and the shares at which
# it should be below everything measured
TURBO: dict[str, tuple[dict[str, float], tuple[str, ...]]] = {
    "newrf-bedroom random": ({"0.1": 0.25, "0.3": 0.15, "0.5": 0.10}, ("0.5",)),
    "newrf-office random": ({"0.1": 0.25, "0.3": 0.15, "0.5": 0.10}, ("0.5",)),
    "simulated-room random": ({"0.3": 0.25}, ("0.3",)),
    "s23-200 random": ({"0.1": 0.50, "0.3": 0.30}, ()),
    "s23-200 block": ({"0.1": 0.0, "0.3": 0.0}, ()),
}


def _missed(value: float, target: str, unit: str, larger_is_better: bool) -> list[str]:
    """Return the difference to the target as text, in an empty list if the target is met."""
    digits = len(target.partition(".")[2])
    short = float(target) - round(value, digits) if larger_is_better else round(value, digits) - float(target)
    return [] if short < 0.5 * 10**-digits else [f"{short:.{digits}f} {unit}".strip()]


def _state(missed: Sequence[str]) -> str:
    return f"missed by {' and '.join(missed)}" if missed else "met"


def synthesis_targets() -> str:
    """Return SSIM and PSNR of swiftwrf at unseen positions beside their targets."""
    rows = []
    found = {f"{row['scene']} {row['split']}": row for row in load("synthesis")["rows"] if row["method"] == "swiftwrf"}
    for scene, (ssim, psnr) in SYNTHESIS.items():
        own = {name: found[scene][name]["median"] for name in ("ssim", "psnr_db")}
        missed = _missed(own["ssim"], ssim, "(SSIM)", True) + _missed(own["psnr_db"], psnr, "dB", True)
        rows.append([scene, f"{ssim} / {psnr}", f"{own['ssim']:.3f} / {own['psnr_db']:.1f}", _state(missed)])
    return markdown(["scene, split", "target", "swiftwrf", ""], rows)


def aoa_targets() -> str:
    """Return what synthetic spectra change in the error of the network, beside the targets."""
    rows = []
    for share, mix, result in aoa_shares():
        metrics = result["metrics"]
        scene = f"{metrics['data']} {metrics['split']}"
        lower, below_all = TURBO[scene]
        median = {name: method["great_circle_deg"]["median"] for name, method in mix["methods"].items()}
        turbo = turbo_condition(mix).method
        aim, found = lower.get(share), mix["methods"][turbo]["changes"][MEASURED_NETWORK]
        # "never worse" is missed if the interval lies above zero
        reached = found["low"] if aim == 0 else found["change"]
        missed = [] if aim is None or reached <= -aim else [f"{reached + aim:.0%}"]
        above = median[turbo] - median[FULL_NETWORK]
        if share in below_all and above >= 0:
            missed.append(f"{above:.2f} degrees (everything measured)")
        target = "" if aim is None else f"-{aim:.0%}" if aim else "never worse"
        target += ", below everything measured" if share in below_all else ""
        if target:
            who = f"{scene}, {metrics['moving']} moves"
            rows.append([who, f"{float(share):.0%}", target, change_text(found), _state(missed)])
    return markdown(["scene, split", "measured", f"target against {MEASURED_NETWORK}", "measured", ""], rows)


def rssi_targets() -> str:
    """Return median and 90 % quantile of the absolute error of swiftwrf beside their targets."""
    rows = []
    found = load("rssi")["sets"]
    for scene, (median, p90) in RSSI.items():
        own = found[scene]["methods"]["swiftwrf"]["abs_error_db"]
        missed = _missed(own["median"], median, "dB (median)", False) + _missed(own["p90"], p90, "dB (90 %)", False)
        rows.append([scene, f"{median} / {p90}", f"{own['median']:.2f} / {own['p90']:.1f}", _state(missed)])
    return markdown(["data, split", "target", "swiftwrf", ""], rows)
