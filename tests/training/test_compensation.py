"""Laws of compensated growth: what is remembered, what is added, and that nothing else changes."""

import json
import math
from dataclasses import replace

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from vdgs.config.method import CompensationConfig, DensifyConfig
from vdgs.kernels.kernel_types import DensificationStats
from vdgs.model.anchors import Anchors
from vdgs.training.compensation import (
    CompensationState,
    begin_cycle,
    close_cycle,
    compensate,
    cycle_gradient,
    cycle_log,
    low_visibility_mask,
    update_cache,
)
from vdgs.training.densification import decide_densification
from vdgs.training.per_anchor_tensors import index_rows

K = 3
PAPER = CompensationConfig()
GROWTH = DensifyConfig(grad_threshold=1.0, num_levels=2, coarsest_voxels=1.0)
ALL, NONE = torch.ones(1, dtype=torch.bool), torch.zeros(1, dtype=torch.bool)


def some_anchors(n: int, seed: int = 0) -> Anchors:
    g = torch.Generator().manual_seed(seed)
    return Anchors(
        positions=torch.rand(n, 3, generator=g) * 40 - 20,
        features=torch.randn(n, 32, generator=g),
        offsets=torch.randn(n, K, 3, generator=g),
        log_scales=torch.zeros(n, 6),
    )


def see(statistics: DensificationStats, times: torch.Tensor, mean: torch.Tensor) -> None:
    """A cycle in which each offset is drawn so many times with that mean gradient."""
    statistics.drawn += times
    statistics.gradient += times * mean
    statistics.seen += times.amax(1)
    statistics.opacity += times.sum(1)


def one_offset(times: float = 0.0, mean: float = 0.0) -> DensificationStats:
    statistics = DensificationStats.zeros(1, 1)
    see(statistics, torch.tensor([[times]]), torch.tensor([[mean]]))
    return statistics


def simulate(config: CompensationConfig | None, seed: int, cycles: int = 4, growth: DensifyConfig = GROWTH):
    """Anchors and statistics after some cycles of random views; without compensation where config is None."""
    anchors = some_anchors(25, seed)
    statistics, memory = DensificationStats.zeros(25, K), CompensationState.zeros(25, K)
    for cycle in range(cycles):
        g = torch.Generator().manual_seed(1000 * seed + cycle)
        n = len(anchors)
        share = torch.rand(n, generator=g)
        see(statistics, torch.floor(60 * share[:, None] * torch.rand(n, K, generator=g)), torch.rand(n, K, generator=g))
        change = None
        if config is not None:
            low, threshold = low_visibility_mask(share, config)
            change = close_cycle(memory, statistics, low, threshold, growth, config)
        decision = decide_densification(anchors, statistics, 1.0, growth, g, compensated=change)
        kept = torch.cat([decision.keep_mask, torch.ones(len(decision.added), dtype=torch.bool)])
        anchors = anchors.concat(decision.added).select(kept)
        statistics, memory = (
            DensificationStats(**remapped(statistics, kept)),
            CompensationState(**remapped(memory, kept)),
        )
        begin_cycle(memory, statistics)
    return anchors, statistics, memory


def remapped(kept_per_anchor: DensificationStats | CompensationState, kept: torch.Tensor) -> dict[str, torch.Tensor]:
    """As training keeps them beside the anchors: new rows are zero."""
    group = kept_per_anchor.tensors()
    count = len(kept) - len(next(iter(group.values())))
    index_rows(group, {name: tensor.new_zeros(count, *tensor.shape[1:]) for name, tensor in group.items()}, kept)
    return group


def bits(anchors: Anchors, statistics: DensificationStats) -> list[bytes]:
    return [tensor.numpy().tobytes() for tensor in (*anchors.tensors().values(), *statistics.tensors().values())]


@settings(max_examples=10)
@given(
    seed=st.integers(0, 1000),
    config=st.sampled_from([replace(PAPER, beta_g=0.0), replace(PAPER, t_low=0.0)]),
)
def test_without_weight_or_threshold_it_is_plain_growth_bit_for_bit(seed, config):
    growth = replace(GROWTH, grad_threshold=0.6, min_draw_fraction=0.2)
    plain, compensated = simulate(None, seed, growth=growth), simulate(config, seed, growth=growth)
    assert bits(*plain[:2]) == bits(*compensated[:2])
    assert len(plain[0]) > 25


def test_with_the_papers_weights_more_grows_and_twice_the_same():
    plain, once, again = simulate(None, 5), simulate(PAPER, 5), simulate(PAPER, 5)
    assert len(once[0]) > len(plain[0])
    assert bits(*once[:2]) == bits(*again[:2])
    assert torch.equal(once[2].cache, again[2].cache)


@settings(max_examples=40)
@given(
    cycles=st.lists(st.tuples(st.booleans(), st.integers(0, 50), st.floats(0, 1)), min_size=1, max_size=12),
    beta=st.sampled_from([0.0, 1.0, 2.0, 3.0]),
    gamma=st.sampled_from([0.0, 0.5, 0.9, 1.0]),
)
def test_the_cache_follows_the_recursion(cycles, beta, gamma):
    config = CompensationConfig(beta_g=beta, gamma=gamma)
    statistics, memory, expected = one_offset(), CompensationState.zeros(1, 1), 0.0
    for low, times, mean in cycles:
        see(statistics, torch.tensor([[float(times)]]), torch.tensor([[mean]]))
        update_cache(memory, statistics, ALL if low else NONE, config)
        begin_cycle(memory, statistics)
        expected = gamma * expected + (beta * mean if low and times else 0.0)
        assert float(memory.cache) == pytest.approx(expected, rel=1e-3, abs=1e-4)


def test_two_cycles_by_hand():
    statistics, memory = one_offset(times=10, mean=0.5), CompensationState.zeros(1, 1)
    update_cache(memory, statistics, ALL, PAPER)
    assert float(memory.cache) == 1.0  # 2 x 0.5
    begin_cycle(memory, statistics)
    update_cache(memory, statistics, ALL, PAPER)  # nothing seen in this cycle: only decay
    assert float(memory.cache) == pytest.approx(0.9)
    see(statistics, torch.tensor([[4.0]]), torch.tensor([[0.25]]))
    update_cache(memory, statistics, NONE, PAPER)  # seen, but by enough cameras: only decay
    assert float(memory.cache) == pytest.approx(0.81)


@settings(max_examples=20)
@given(
    cycles=st.lists(st.tuples(st.booleans(), st.integers(1, 50), st.floats(0, 1)), min_size=2, max_size=8),
    target=st.sampled_from(["mean", "sum"]),
)
def test_a_decision_adds_the_cache_with_its_own_cycle_or_as_the_cycle_before_left_it(cycles, target):
    """The cache is the same; only when it is read differs, and `current` is what it was before there was a choice."""
    added, caches = {}, {}
    for history in ("current", "past"):
        config = replace(PAPER, history=history, target=target)
        statistics, memory, changes, states = one_offset(), CompensationState.zeros(1, 1), [], [0.0]
        for low, times, mean in cycles:
            see(statistics, torch.tensor([[float(times)]]), torch.tensor([[mean]]))
            change = close_cycle(memory, statistics, ALL if low else NONE, PAPER.t_low, GROWTH, config)
            begin_cycle(memory, statistics)
            changes.append(float(change.added))
            states.append(float(memory.cache))
        added[history], caches[history] = changes, states
    assert caches["past"] == caches["current"]
    marks = [low for low, _, _ in cycles]
    assert added["current"] == [low * cache for low, cache in zip(marks, caches["current"][1:], strict=True)]
    assert added["past"] == [low * cache for low, cache in zip(marks, caches["past"][:-1], strict=True)]


def test_growth_follows_the_order_of_cache_and_decision():
    """The default gives the bits of update and addition one after the other; without the ended cycle less grows."""
    assert PAPER.history == "current"
    current, past = simulate(PAPER, 5), simulate(replace(PAPER, history="past"), 5)
    assert len(simulate(None, 5)[0]) < len(past[0]) < len(current[0])
    first = [simulate(config, 5, cycles=1)[0] for config in (None, replace(PAPER, history="past"))]
    assert torch.equal(first[0].positions, first[1].positions)  # nothing is remembered yet


def test_fed_steadily_the_statistic_tends_to_21_times_its_size():
    memory, sizes = CompensationState.zeros(1, 1), []
    for _ in range(150):
        statistics = one_offset(times=10, mean=0.5)
        begin_cycle(memory, DensificationStats.zeros(1, 1))
        update_cache(memory, statistics, ALL, PAPER)
        sizes.append(float(memory.cache) + 0.5)
    assert sizes[0] == pytest.approx(3 * 0.5)
    assert sizes == sorted(sizes)
    assert sizes[-1] == pytest.approx(0.5 * (1 + PAPER.beta_g / (1 - PAPER.gamma)), rel=1e-4)


@pytest.mark.parametrize(("added_to", "expected"), [("mean", 0.5 + 1.0), ("sum", 0.5 + 1.0 / 8)])
def test_what_is_added_to_the_sum_is_divided_by_the_draws(added_to, expected):
    """Eight draws of a mean of 0.5, and g = 1: parents are those whose statistic reaches the threshold."""
    config = replace(PAPER, target=added_to)
    for threshold, asks in ((0.999 * expected, True), (1.001 * expected, False)):
        statistics, memory = one_offset(times=8.5, mean=0.5), CompensationState.zeros(1, 1)
        statistics.drawn.fill_(8.0)
        statistics.gradient.fill_(4.0)
        update_cache(memory, statistics, ALL, config)
        assert float(memory.cache) == 1.0
        growth = replace(GROWTH, grad_threshold=threshold, num_levels=1, min_draw_fraction=0.05)
        change = compensate(memory, ALL, config.t_low, growth, config)
        anchors = some_anchors(1)
        anchors = replace(anchors, offsets=100.0 + anchors.offsets[:, :1])
        seeds = range(12)  # an offset that asks is kept by half of them
        grown = [
            len(
                decide_densification(
                    anchors,
                    DensificationStats(**{n: t.clone() for n, t in statistics.tensors().items()}),
                    1.0,
                    growth,
                    torch.Generator().manual_seed(seed),
                    compensated=change,
                ).added
            )
            for seed in seeds
        ]
        assert any(grown) == asks


def test_what_is_not_judged_keeps_counting_and_the_cycle_is_still_its_own():
    statistics, memory = one_offset(times=30, mean=2.0), CompensationState.zeros(1, 1)
    anchors = some_anchors(1)
    anchors = replace(anchors, offsets=anchors.offsets[:, :1])
    decide_densification(anchors, statistics, 1.0, GROWTH, torch.Generator())  # 30 times is not 40: carried over
    begin_cycle(memory, statistics)
    see(statistics, torch.tensor([[5.0]]), torch.tensor([[0.5]]))
    assert float(statistics.drawn) == 35
    assert float(cycle_gradient(memory, statistics)) == pytest.approx(0.5)
    see(statistics, torch.tensor([[10.0]]), torch.tensor([[0.5]]))
    decide_densification(anchors, statistics, 1.0, GROWTH, torch.Generator())  # 45 times: judged
    begin_cycle(memory, statistics)
    assert float(statistics.drawn) == 0
    see(statistics, torch.tensor([[3.0]]), torch.tensor([[0.7]]))
    assert float(cycle_gradient(memory, statistics)) == pytest.approx(0.7)


def test_fewer_than_the_threshold_means_fewer():
    share = torch.tensor([0.0, 19 / 100, 20 / 100, 21 / 100, 1.0])
    low, threshold = low_visibility_mask(share, PAPER)
    assert low.tolist() == [True, True, False, False, False]
    assert threshold == 0.2


@given(shares=st.lists(st.integers(0, 20), max_size=30), quantile=st.sampled_from([0.1, 0.25, 0.5, 0.9]))
def test_a_quantile_of_the_anchors_that_some_camera_sees_is_met_as_nearly_as_ties_allow(shares, quantile):
    share = torch.tensor(shares, dtype=torch.float32) / 20
    low, threshold = low_visibility_mask(share, replace(PAPER, t_low_quantile=quantile))
    seen = share > 0
    if not seen.any():
        assert not low.any()
        return
    assert low[~seen].all()
    assert threshold == pytest.approx(float(np.quantile(share[seen].numpy(), quantile)))
    assert not (low.any() and (~low).any()) or float(share[low].max()) < float(share[~low].min())
    wished = quantile * int(seen.sum())
    possible = [int((share[seen] <= limit).sum()) for limit in (0.0, *share[seen].tolist())]
    assert abs(int(low[seen].sum()) - wished) == min(abs(size - wished) for size in possible)
    order = torch.randperm(len(share), generator=torch.Generator().manual_seed(0))
    assert torch.equal(low_visibility_mask(share[order], replace(PAPER, t_low_quantile=quantile))[0], low[order])


@pytest.mark.parametrize(
    ("shares", "expected"),
    [
        ([0.2] * 3 + [0.4] * 7, 3),  # the quantile is a share of seven: those below it
        ([0.2] * 4 + [0.4] * 6, 4),  # it is the least share, of four: none is below it
        ([0.5, 0.5, 1.0, 1.0], 2),  # as near as none: the larger
        ([0.5] * 10, 0),  # all are seen alike: none is of low visibility
        ([0.0] * 5 + [0.2] * 4 + [0.4] * 6, 9),  # what no camera sees counts for nothing, and is in L
    ],
)
def test_shares_that_tie_do_not_empty_the_set(shares, expected):
    low, _ = low_visibility_mask(torch.tensor(shares), replace(PAPER, t_low_quantile=0.25))
    assert low.tolist() == [True] * expected + [False] * (len(shares) - expected)


def test_an_empty_set_of_those_seen_shows_in_the_facts():
    n, config = 10, replace(PAPER, t_low_quantile=0.25)
    anchors, statistics, memory = some_anchors(n), DensificationStats.zeros(n, K), CompensationState.zeros(n, K)
    share = torch.tensor([0.0] * 2 + [1.0] * 8)
    low, threshold = low_visibility_mask(share, config)
    change = compensate(memory, low, threshold, GROWTH, config)
    decision = decide_densification(anchors, statistics, 1.0, GROWTH, torch.Generator(), compensated=change)
    facts = cycle_log(change, share, threshold, decision, config)
    assert (facts["low_share"], facts["low_share_of_seen"], facts["t_low"]) == (0.2, 0.0, 1.0)


@pytest.mark.parametrize(
    ("gate", "interval", "expected"),
    [("scaled", 100, 8.0), ("paper", 100, 40.0), ("scaled", 10, 2.0), ("scaled", 2, 0.8)],
)
def test_the_gate_of_low_visibility(gate, interval, expected):
    growth, config = replace(GROWTH, every=interval), replace(PAPER, min_draws=gate)
    change = compensate(CompensationState.zeros(1, 1), ALL, config.t_low, growth, config)
    assert change.min_draws == pytest.approx(expected)


@pytest.mark.parametrize(("gate", "judged"), [("scaled", True), ("paper", False)])
def test_an_offset_drawn_nine_times_is_judged_only_by_the_scaled_gate(gate, judged):
    config = replace(PAPER, min_draws=gate)
    n = 30
    anchors, statistics, memory = some_anchors(n), DensificationStats.zeros(n, K), CompensationState.zeros(n, K)
    see(statistics, torch.full((n, K), 9.0), torch.full((n, K), 0.5))
    low = torch.arange(n) < 20
    update_cache(memory, statistics, low, config)
    change = compensate(memory, low, 0.2, GROWTH, config)
    decision = decide_densification(
        anchors, statistics, 1.0, GROWTH, torch.Generator().manual_seed(0), compensated=change
    )
    assert (len(decision.added) > 0) == judged
    assert (statistics.drawn == 0).all(1).tolist() == [judged and bool(each) for each in low]


def test_a_poorly_seen_place_grows_where_plain_growth_sees_nothing():
    n = 200
    anchors = some_anchors(n)
    east = anchors.positions[:, 0] > 0
    results = {}
    for name, config in (("plain", None), ("compensated", PAPER)):
        statistics, memory = DensificationStats.zeros(n, K), CompensationState.zeros(n, K)
        # East: 12 of 100 views, west: 60; everywhere 80 % of the gradient that asks for an anchor.
        times = torch.where(east, 12.0, 60.0)[:, None].expand(n, K)
        see(statistics, times, torch.full((n, K), 0.8))
        change = None
        if config is not None:
            low, threshold = low_visibility_mask(torch.where(east, 0.12, 0.6), config)
            update_cache(memory, statistics, low, config)
            change = compensate(memory, low, threshold, GROWTH, config)
        decision = decide_densification(
            anchors, statistics, 1.0, GROWTH, torch.Generator().manual_seed(0), compensated=change
        )
        results[name] = decision, change
    assert len(results["plain"][0].added) == 0
    decision, change = results["compensated"]
    assert len(decision.added) > 50
    assert float(decision.added.positions[:, 0].min()) > -5  # offsets reach some units beyond their anchor
    facts = cycle_log(change, torch.where(east, 0.12, 0.6), 0.2, decision, CompensationConfig())
    assert facts["grown_low"] == len(decision.added)
    assert facts["grown_other"] == 0
    assert facts["low_share"] == facts["low_share_of_seen"] == pytest.approx(float(east.float().mean()))
    assert facts["mean_cache"] == facts["max_cache"] == pytest.approx(1.6)
    assert len(decision.added.log_scales.unique()) == 2  # both levels grew
    assert json.loads(json.dumps(facts)) == facts


def test_what_is_remembered_is_added_only_where_few_cameras_see():
    memory = CompensationState.zeros(3, K)
    memory.cache += 0.5
    change = compensate(memory, torch.tensor([True, False, True]), 0.2, GROWTH, PAPER)
    assert change.added.tolist() == [[0.5] * K, [0.0] * K, [0.5] * K]


def test_what_grows_plainly_grows_compensated_too():
    growth = replace(GROWTH, num_levels=1)  # finer levels see the anchors of coarser ones
    n = 300
    anchors, memory = some_anchors(n), CompensationState.zeros(n, K)
    g = torch.Generator().manual_seed(1)
    times, mean = torch.full((n, K), 50.0), 2 * torch.rand(n, K, generator=g)
    low = torch.arange(n) % 3 == 0
    statistics = [DensificationStats.zeros(n, K), DensificationStats.zeros(n, K)]
    for each in statistics:
        see(each, times, mean)
    update_cache(memory, statistics[1], low, PAPER)
    change = compensate(memory, low, 0.2, growth, PAPER)
    plain = decide_densification(anchors, statistics[0], 1.0, growth, torch.Generator().manual_seed(2))
    more = decide_densification(
        anchors, statistics[1], 1.0, growth, torch.Generator().manual_seed(2), compensated=change
    )
    plain_cells, more_cells = ({tuple(row) for row in d.added.positions.tolist()} for d in (plain, more))
    assert plain_cells < more_cells
    assert more.grown_low + more.grown_other == len(more.added)
    assert more.grown_other > 0
    assert plain.grown_low == 0
    assert plain.grown_other == len(plain.added)


def test_facts_without_low_visibility_are_null():
    anchors, statistics, memory = some_anchors(2), DensificationStats.zeros(2, K), CompensationState.zeros(2, K)
    change = compensate(memory, torch.zeros(2, dtype=torch.bool), 0.2, GROWTH, PAPER)
    facts = cycle_log(
        change,
        torch.ones(2),
        0.2,
        decide_densification(anchors, statistics, 1.0, GROWTH, torch.Generator(), compensated=change),
        CompensationConfig(),
    )
    assert facts["mean_cache"] is None
    assert facts["low_share"] == 0
    assert not any(isinstance(value, float) and math.isnan(value) for value in facts.values())


def test_statistics_of_other_anchors_are_refused():
    memory, statistics = CompensationState.zeros(2, K), DensificationStats.zeros(3, K)
    with pytest.raises(ValueError, match=r"\[2, 3\].*\[3, 3\]"):
        begin_cycle(memory, statistics)
    with pytest.raises(ValueError, match=r"\[2, 3\].*\[3, 3\]"):
        update_cache(memory, statistics, torch.ones(2, dtype=torch.bool), PAPER)


def test_the_snapshots_are_copies():
    statistics, memory = one_offset(times=5, mean=1.0), CompensationState.zeros(1, 1)
    begin_cycle(memory, statistics)
    see(statistics, torch.tensor([[1.0]]), torch.tensor([[3.0]]))
    assert float(memory.drawn_before) == 5
    assert float(cycle_gradient(memory, statistics)) == pytest.approx(3.0)
