"""What becomes of a hit: range noise, edges, reflectance."""

from dataclasses import replace

import numpy as np
import pytest

from asca_pillars.sim.casting.raycast import Hits
from asca_pillars.sim.lidar import Firings, Lidar, draw_firings
from asca_pillars.sim.returns import Returns, measure

# Nothing but what a test switches on.
QUIET = Lidar(
    ego_first_ring=(),
    ego_beyond_ring=(),
    range_sigma_m=(0.0, 0.0),
    ring_bias_sigma_m=0.0,
    beam_split_share=0.0,
    loss_share=(0.0, 0.0),
    ring_gain=(),
    ring_gain_sigma=0.0,
    response=1.0,
    dark_offset=0.0,
    fade_m=0.0,
    near_fade=0.0,
    reflectance_sigma=(0.0, 0.0),
    reflectance_sigma_share=0.0,
    weak_laser_sigma=0.0,
    faint_reflectance=(0.0, 0.0),
    zero_share=0.0,
)


def scan(lidar: Lidar, rho_m: float | np.ndarray, reflectance: float = 0.405, seed: int = 0) -> tuple[Returns, Firings]:
    """What comes back of a surface all around that the lasers meet at right angles."""
    firings = draw_firings(lidar, np.random.default_rng(seed), camera_only=False)
    shape = firings.hidden.shape
    rho = np.broadcast_to(np.asarray(rho_m, float), shape)
    none = np.zeros(0, np.int64)
    owner = np.where(rho == rho.min(), 0, -1)
    hits = Hits(rho, np.ones(shape, np.float32), np.full(shape, reflectance, np.float32), owner, none, none)
    return measure(hits, firings, np.random.default_rng(seed)), firings


def slant(returns: Returns, firings: Firings) -> np.ndarray:
    x, y, z, _ = returns.points.astype(float).T
    return np.sqrt(x**2 + y**2 + (z - firings.origin_z_m[returns.ring]) ** 2)


def test_scans_are_exact_without_noise_and_noisy_within_and_across_rings() -> None:
    returns, firings = scan(QUIET, 10.0)
    assert len(returns.points) == firings.hidden.size
    expected = 10.0 * np.sqrt(1 + firings.slope[returns.ring] ** 2)
    np.testing.assert_allclose(slant(returns, firings), expected, atol=0.001)
    np.testing.assert_allclose(returns.points[:, 3], 0.40)
    lidar = replace(QUIET, range_sigma_m=(0.008, 0.008), ring_bias_sigma_m=0.016)
    returns, firings = scan(lidar, 10.0)
    error = slant(returns, firings) - 10.0 * np.sqrt(1 + firings.slope[returns.ring] ** 2)
    rings = [error[returns.ring == ring] for ring in range(64)]
    assert np.mean([ring.std() for ring in rings]) == pytest.approx(0.008, rel=0.03)
    assert np.std([ring.mean() for ring in rings]) == pytest.approx(0.016, rel=0.3)


def test_reflectance_fades_with_range_and_weak_returns_become_zero_before_they_are_lost() -> None:
    values, zeros, kept = [], [], []
    for rho in (10.0, 30.0, 50.0, 70.0):
        returns, firings = scan(replace(QUIET, fade_m=33.0, focus_m=13.0), rho, 0.12)
        reflectance = returns.points[:, 3]
        values.append(np.median(reflectance[reflectance > 0]))
        zeros.append((reflectance == 0).mean())
        kept.append(len(reflectance) / firings.hidden.size)
    assert values == sorted(values, reverse=True) and values[0] == pytest.approx(0.12, abs=0.011)
    assert zeros == sorted(zeros) and zeros[0] == 0 and zeros[-1] > 0.5
    assert kept == sorted(kept, reverse=True) and kept[1] == 1.0


def test_faint_reflectances_are_zero_and_gains_are_those_of_the_ring() -> None:
    lidar = replace(QUIET, faint_reflectance=(0.2, 0.2))
    share = {value: (scan(lidar, 10.0, value)[0].points[:, 3] == 0).mean() for value in (0.05, 0.1, 0.25)}
    assert share[0.05] == pytest.approx(0.75, abs=0.02)
    assert share[0.1] == pytest.approx(0.5, abs=0.02)
    assert share[0.25] == 0
    gain = np.linspace(0.5, 1.5, 64)
    for seed in (0, 1):
        returns, _ = scan(replace(QUIET, ring_gain=tuple(gain)), 10.0, seed=seed)
        medians = [np.median(returns.points[returns.ring == ring, 3]) for ring in range(64)]
        np.testing.assert_allclose(medians, 0.405 * gain, atol=0.011)


def stripes(near: float, far: float, columns: int) -> np.ndarray:
    """(C,) a body on every other twelve columns."""
    return np.where(np.arange(columns) // 12 % 2 == 0, near, far)


@pytest.mark.parametrize(("far", "between"), [(20.0, 0.03), (10.5, 0.15)])
def test_only_beams_at_an_edge_are_split(far: float, between: float) -> None:
    """Next to an edge 30 % of the firings lean over it: some are lost, some change sides, a few mix both ranges."""
    lidar = replace(QUIET, beam_split_share=0.3, split_lost_share=0.35)
    columns = draw_firings(lidar, np.random.default_rng(0), False).hidden.shape[1]
    rho = stripes(10.0, far, columns)
    returns, firings = scan(lidar, rho)
    measured = slant(returns, firings) / np.sqrt(1 + firings.slope[returns.ring] ** 2)
    turns = np.arctan2(returns.points[:, 1], returns.points[:, 0]) - firings.phase_rad[returns.ring]
    column = np.searchsorted(firings.azimuth_rad, turns % (2 * np.pi) - 5e-4)
    step = np.flatnonzero(np.diff(rho) != 0)
    beside = np.isin(column, np.concatenate([step, step + 1, [0, columns - 1, columns]]))
    own = rho[np.minimum(column, columns - 1)]
    exact = np.abs(measured - own) < 0.01
    assert exact[~beside].all()
    share = {
        "lost": 1 - beside.sum() / (64 * 2 * (len(step) + 0.5)),
        "mixed": ((measured > 10.01) & (measured < far - 0.01))[beside].mean(),
    }
    assert share["lost"] == pytest.approx(0.3 * 0.35, abs=0.02)
    assert share["mixed"] == pytest.approx(between, abs=0.08)
    # A point that changed sides belongs to the body that it lies on.
    assert (returns.owner[np.abs(measured - 10.0) < 0.01] == 0).all()
    assert (returns.owner[np.abs(measured - far) < 0.01] == -1).all()
