"""Posteriors smoothed along a walk."""

import numpy as np
import pandas as pd
import pytest
import torch
from quick import command

from swiftwrf import InputError, Rssi, rssi_room
from swiftwrf.locate import Posterior, RssiLocator, smoothed
from swiftwrf.locate import posterior as module
from swiftwrf.locate.posterior import normalised

STEP_M, NOISE_M = 0.4, 1.5


def line(cells=301, length=30.0):
    at = torch.zeros(1, cells, 3, dtype=torch.float64)
    at[0, :, 0] = torch.linspace(0, length, cells, dtype=torch.float64)
    return at


def walk(n=60, seed=1):
    """Positions (n,) of a random walk in the middle of the line, and noisy observations of them."""
    generator = torch.Generator().manual_seed(seed)
    steps = STEP_M * torch.randn(n, generator=generator, dtype=torch.float64)
    truth = 15 + steps.cumsum(dim=0)
    return truth, truth + NOISE_M * torch.randn(n, generator=generator, dtype=torch.float64)


def gaussian(at, observed):
    away = at[..., 0] - observed[:, None]
    return Posterior(at, normalised(-0.5 * (away / NOISE_M) ** 2), 0.1)


def kalman(observed, variances):
    """Means of the Rauch-Tung-Striebel smoother of a random walk, with a flat prior."""
    mean, variance = [float(observed[0])], [NOISE_M**2]
    for y, q in zip(observed[1:].tolist(), variances, strict=True):
        p = variance[-1] + q
        gain = p / (p + NOISE_M**2)
        mean.append(mean[-1] + gain * (y - mean[-1]))
        variance.append((1 - gain) * p)
    found = mean[:]
    for i in range(len(mean) - 2, -1, -1):
        found[i] = mean[i] + variance[i] / (variance[i] + variances[i]) * (found[i + 1] - mean[i])
    return torch.tensor(found, dtype=torch.float64)


@pytest.mark.parametrize("is_shared", [True, False])
def test_a_random_walk_has_the_means_of_the_kalman_smoother(is_shared):
    truth, observed = walk()
    at = line() if is_shared else line().expand(len(observed), -1, -1).contiguous()
    alone = gaussian(at, observed)
    found = smoothed(alone, None, STEP_M)
    expected = kalman(observed, [STEP_M**2 + 0.1**2 / 6] * (len(observed) - 1))
    assert (found.mean[:, 0] - expected).abs().max() < 0.05
    error, before = ((p.mean[:, 0] - truth).square().mean().sqrt() for p in (found, alone))
    assert error < 0.6 * before
    assert found.weight.sum(dim=1).allclose(torch.ones(len(observed), dtype=torch.float64))


def test_the_time_between_observations_widens_the_step():
    _, observed = walk(n=30)
    time = torch.arange(30.0, dtype=torch.float64).square() / 10
    found = smoothed(gaussian(line(), observed), time, STEP_M)
    expected = kalman(observed, ((STEP_M * time.diff()) ** 2 + 0.1**2 / 6).tolist())
    inside = expected[:, None].sub(torch.tensor([0.0, 30.0])).abs().amin(dim=1) > 5  # away from the ends of the line
    assert (found.mean[:, 0] - expected)[inside].abs().max() < 0.1


def test_products_in_chunks_are_the_same(monkeypatch):
    posterior = gaussian(line(), walk(n=5)[1])
    whole = smoothed(posterior, None, 1.0)
    monkeypatch.setattr(module, "MAX_KEPT_PAIRS", 0)
    monkeypatch.setattr(module, "CHUNK", 1000)
    assert smoothed(posterior, None, 1.0).weight.allclose(whole.weight, atol=1e-6)


def test_neighbours_resolve_two_modes():
    at, observed = line(), torch.tensor([5.0, 5.5, 6.0], dtype=torch.float64)
    modes = gaussian(at, observed).weight
    modes[1] = 0.4 * modes[1] + 0.6 * gaussian(at, observed + 18).weight[1]
    alone = Posterior(at, modes.log(), 0.1)
    assert alone.ambiguous.tolist() == [False, True, False]
    assert alone.most_likely[1, 0] > 20
    found = smoothed(alone, None, 1.0)
    assert not found.ambiguous.any()
    assert abs(float(found.median[1, 0]) - 5.5) < 1


def test_a_single_observation_keeps_its_posterior():
    alone = gaussian(line(), torch.tensor([4.0], dtype=torch.float64))
    assert smoothed(alone, None, 1.0).log_weight.allclose(alone.log_weight, atol=1e-12)


def test_a_jump_and_impossible_candidates_keep_finite_weights():
    at = line()
    sure = torch.full((4, at.shape[1]), -torch.inf, dtype=torch.float64)
    sure[[0, 1, 2, 3], [10, 10, 290, 290]] = 0.0
    found = smoothed(Posterior(at, sure, 0.1), None, 0.1)
    assert found.most_likely[:, 0].round(decimals=6).tolist() == [1.0, 1.0, 29.0, 29.0]
    assert found.weight.isfinite().all()


def test_joined_groups_are_one_walk():
    at, observed = line(), walk(n=9)[1]
    whole = gaussian(at, observed)
    parts = Posterior.cat([gaussian(at, some) for some in observed.split(4)])
    assert parts.position.shape == whole.position.shape
    assert parts.log_weight.equal(whole.log_weight)
    own = Posterior.cat([gaussian(at.expand(len(some), -1, -1), some) for some in observed.split(4)])
    assert own.position.shape == (9, 301, 3)


@pytest.mark.parametrize(
    ("time", "speed", "message"),
    [
        (None, 0.0, "speed is a number above 0"),
        (None, float("nan"), "speed is a number above 0"),
        ([0.0, 1.0], 1.0, "3 finite times"),
        ([0.0, 1.0, float("nan")], 1.0, "3 finite times"),
        ([0.0, 2.0, 1.0], 1.0, "number 3 is earlier"),
    ],
)
def test_other_speeds_and_times_are_refused(time, speed, message):
    posterior = gaussian(line(), walk(n=3)[1])
    with pytest.raises(InputError, match=message):
        smoothed(posterior, None if time is None else torch.tensor(time), speed)


def times(table, **options):
    time = Rssi.from_frame(table, **options).time
    return None if time is None else time.tolist()


def test_times_of_the_rows_of_a_table():
    wide = pd.DataFrame({"x": range(3), "y": 0, "time": ["2", "3.5", "7"], "hall": ["-50", "-60", "-55"]})
    assert times(wide) == [0.0, 1.5, 5.0]
    assert times(wide.assign(time=[f"2024-01-01 10:{second}" for second in ("00:00", "00:01", "01:00")])) == [0, 1, 60]
    assert times(wide.rename(columns={"time": "clock"})) is None
    assert times(wide.rename(columns={"time": "clock"}), columns={"time": "clock"}) == [0.0, 1.5, 5.0]
    assert torch.isnan(torch.tensor(times(wide.assign(time=["2", "noon", "7"])))).tolist() == [False, True, False]


def test_packets_of_one_row_have_its_time():
    long = pd.DataFrame(
        {"receiver": ["a", "b", "a", "a"], "time": [1, 1, 2, 2], "rssi": [-50, -60, -55, -56], "x": 0, "y": 0}
    )
    assert times(long) == [0.0, 1.0, 1.0]
    assert times(long.assign(time=[4, 4, 6, 6], x=[1, 1, 2, 2])) == [0.0, 2.0, 2.0]
    apart = long.assign(session=["p", "q", "q", "q"], floor=[0, 1, 1, 1])
    assert times(apart) == [0.0, 0.0, 1.0, 1.0]


@pytest.mark.parametrize("cell", ["noon", ""])
def test_walks_without_a_time_are_refused(cell, tmp_path, capsys):
    data = rssi_room(n=60)
    RssiLocator(n_cells=300).fit(data).save(tmp_path / "locator")
    table = pd.DataFrame(data.rssi_dbm[:3].numpy(), columns=list(data.receiver_names)).assign(time=["2", cell, "7"])
    table.to_csv(tmp_path / "walk.csv", index=False)
    assert (
        command("predict", tmp_path / "locator", tmp_path / "walk.csv", "--track", 1, "--out", tmp_path / "out.csv")
        == 2
    )
    assert "row 1 (counted from 0) has no time" in capsys.readouterr().err


def test_positions_of_a_walk(tmp_path, capsys):
    data = rssi_room(n=60)
    locator = RssiLocator(n_cells=300).fit(data)
    file = tmp_path / "locator"
    locator.save(file)
    # the transmitter rests at one position: the smoothed rows agree
    row = data.rssi_dbm[7] + 6 * torch.randn(10, 12, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    table = pd.DataFrame(row.clamp(-149, 0).numpy(), columns=list(data.receiver_names)).assign(time=np.arange(10) / 10)
    table.to_csv(tmp_path / "walk.csv", index=False)
    assert command("predict", file, tmp_path / "walk.csv", "--out", tmp_path / "alone.csv") == 0
    assert command("predict", file, tmp_path / "walk.csv", "--track", 0.1, "--out", tmp_path / "tracked.csv") == 0
    alone, tracked = (pd.read_csv(tmp_path / name) for name in ("alone.csv", "tracked.csv"))
    assert list(tracked.columns) == list(alone.columns)
    assert tracked[["x_m", "y_m"]].std().sum() < 0.5 * alone[["x_m", "y_m"]].std().sum()
    assert (tracked.credible_radius_80_m <= alone.credible_radius_80_m + 0.5).all()
    capsys.readouterr()
    assert command("predict", file, tmp_path / "walk.csv", "--track", 0, "--out", tmp_path / "out.csv") == 2
    assert "speed is a number above 0" in capsys.readouterr().err
