"""Laws of growth: new anchors fill empty cells that hold a strong offset, and nothing else."""

import math
from dataclasses import replace

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from vdgs.config.method import DensifyConfig
from vdgs.kernels import cpu
from vdgs.kernels.kernel_types import DensificationStats
from vdgs.model.anchors import Anchors
from vdgs.training import densification
from vdgs.training.densification import decide_densification

K = 4
ALWAYS = DensifyConfig(min_draw_fraction=0.0, num_levels=1, coarsest_voxels=1.0, grad_threshold=1.0)


def anchors(n: int, seed: int = 0) -> Anchors:
    g = torch.Generator().manual_seed(seed)
    return Anchors(
        positions=torch.round(torch.randn(n, 3, generator=g) * 4),
        features=torch.randn(n, 32, generator=g),
        offsets=torch.randn(n, K, 3, generator=g),
        log_scales=torch.randn(n, 6, generator=g) * 0.3,
    )


def statistics(n: int, gradient: float = 10.0, seed: int = 0) -> DensificationStats:
    g = torch.Generator().manual_seed(seed)
    drawn = torch.ones(n, K)
    return DensificationStats(gradient * torch.rand(n, K, generator=g), drawn, torch.ones(n), torch.ones(n))


def cell_of(points: torch.Tensor, cell: float) -> set[tuple[int, ...]]:
    return {tuple(int(c) for c in row) for row in torch.floor(points / cell + 0.5)}


@settings(max_examples=25)
@given(n=st.integers(1, 60), seed=st.integers(0, 1000), cell=st.sampled_from([0.5, 1.0, 2.5]))
def test_new_anchors_are_centered_in_empty_cells_that_hold_a_strong_offset(n, seed, cell):
    before = anchors(n, seed)
    stats = statistics(n, seed=seed)
    strong = stats.gradient >= ALWAYS.grad_threshold
    means = before.positions[:, None] + before.offsets * before.log_scales[:, None, :3].exp()
    added = decide_densification(before, stats, cell, ALWAYS, torch.Generator().manual_seed(seed)).added
    new = cell_of(added.positions, cell)
    assert len(new) == len(added)
    assert new.isdisjoint(cell_of(before.positions, cell))
    assert new <= cell_of(means[strong], cell)
    centered = torch.round(added.positions / cell) * cell
    torch.testing.assert_close(added.positions, centered, atol=1e-4, rtol=1e-5)
    assert torch.all(added.offsets == 0)
    torch.testing.assert_close(added.log_scales, torch.full_like(added.log_scales, math.log(cell)))


def test_the_random_keep_follows_its_share():
    before, stats = anchors(20_000), statistics(20_000)
    stats.gradient[:] = 10.0
    before.positions[:, 0] = torch.arange(20_000) * 10.0 - 1e5
    added = decide_densification(before, stats, 0.2, ALWAYS, torch.Generator().manual_seed(1)).added
    assert 0.48 < len(added) / (20_000 * K) < 0.52


def test_features_are_the_elementwise_maximum_of_the_parents():
    parents = Anchors(
        positions=torch.tensor([[0.0, 0, 0], [10.0, 0, 0]]),
        features=torch.stack([torch.linspace(-1, 1, 32), torch.linspace(1, -1, 32)]),
        offsets=torch.zeros(2, 1, 3),
        log_scales=torch.zeros(2, 6),
    )
    parents.offsets[0, 0, 0], parents.offsets[1, 0, 0] = 5.0, -5.0  # both Gaussians lie at x = 5
    config = DensifyConfig(min_draw_fraction=0.0, num_levels=1, coarsest_voxels=1.0)
    for seed in range(50):
        stats = DensificationStats(torch.ones(2, 1), torch.ones(2, 1), torch.ones(2), torch.ones(2))
        added = decide_densification(parents, stats, 1.0, config, torch.Generator().manual_seed(seed)).added
        if len(added) and bool((added.features[0] >= 0).all()):
            torch.testing.assert_close(added.features[0], parents.features.amax(0))
            return
    pytest.fail("both parents were never kept together in 50 draws")


def test_what_lies_beyond_the_lattice_does_not_grow():
    before, stats = anchors(3), statistics(3)
    stats.gradient[:] = 10.0
    before.positions[0] = 1e9
    before.positions[1] = float("inf")
    added = decide_densification(before, stats, 1.0, ALWAYS, torch.Generator().manual_seed(0)).added
    assert 0 < len(added) <= K
    assert float(added.positions.abs().max()) < 1000


def test_weak_gradients_and_unseen_offsets_grow_nothing():
    before = anchors(30)
    weak = DensificationStats(torch.full((30, K), 0.5), torch.ones(30, K), torch.ones(30), torch.ones(30))
    assert len(decide_densification(before, weak, 1.0, ALWAYS, torch.Generator()).added) == 0
    gated = DensifyConfig(min_draw_fraction=0.4, every=100, grad_threshold=0.0)
    unseen = DensificationStats(torch.full((30, K), 9.0), torch.full((30, K), 40.0), torch.ones(30), torch.ones(30))
    assert len(decide_densification(before, unseen, 1.0, gated, torch.Generator()).added) == 0


def test_statistics_are_reset_only_where_they_were_judged():
    stats = statistics(2)
    stats.drawn = torch.tensor([[41.0, 40.0, 0.0, 90.0], [1.0, 2.0, 3.0, 41.0]])
    stats.seen = torch.tensor([81.0, 80.0])
    config = DensifyConfig(min_draw_fraction=0.4, prune_view_fraction=0.8, every=100, num_levels=0)
    decide_densification(anchors(2), stats, 1.0, config, torch.Generator())
    assert stats.drawn.tolist() == [[0, 40, 0, 0], [1, 2, 3, 0]]
    assert stats.seen.tolist() == [0, 80]


def test_faint_anchors_go_once_they_were_seen_often_enough():
    stats = statistics(3)
    stats.seen = torch.tensor([100.0, 100.0, 10.0])
    stats.opacity = torch.tensor([0.4, 0.6, 0.0])  # limit 0.005 per view
    config = DensifyConfig(num_levels=0, every=100)
    decision = decide_densification(anchors(3), stats, 1.0, config, torch.Generator())
    assert decision.keep_mask.tolist() == [False, True, True]
    assert decision.pruned == 1


def test_the_budget_serves_the_strongest_first():
    before, stats = anchors(200), statistics(200)
    free = decide_densification(before, statistics(200), 0.1, ALWAYS, torch.Generator().manual_seed(0)).added
    config = DensifyConfig(
        min_draw_fraction=0.0, num_levels=1, coarsest_voxels=1.0, grad_threshold=1.0, max_anchors=210
    )
    capped = decide_densification(before, stats, 0.1, config, torch.Generator().manual_seed(0)).added
    assert len(free) > 10
    assert len(capped) == 10
    assert cell_of(capped.positions, 0.1) <= cell_of(free.positions, 0.1)


def test_a_view_is_counted_where_it_was_drawn():
    stats = DensificationStats.zeros(5, K)
    visible = torch.tensor([1, 3])
    source = torch.tensor([0, 2, K + 1], dtype=torch.int32)  # anchor 1: offsets 0, 2; anchor 3: offset 1
    gradient = torch.tensor([[3.0, 0.0], [0.0, 1.0], [1.0, 1.0]])
    inside = torch.tensor([False, True])
    cpu.add_view_statistics(stats, visible, inside, source, torch.tensor([0.5, 0.25, 1.0]), gradient, width=4, height=2)
    assert stats.gradient[1].tolist() == [6.0, 0.0, 1.0, 0.0]
    assert stats.gradient[3, 1] == pytest.approx(math.hypot(2.0, 1.0))
    assert stats.drawn.sum() == 3
    assert stats.opacity.tolist() == [0, 0.75, 0, 1.0, 0]
    assert stats.seen.tolist() == [0, 0, 0, 1, 0]


def test_surroundings_occupy_cells_but_neither_grow_nor_go():
    before = anchors(60)
    free = decide_densification(before, statistics(60), 1.0, ALWAYS, torch.Generator().manual_seed(0))
    neighbors = free.added.select(torch.arange(0, len(free.added), 2))
    neighbors = neighbors.concat(replace(anchors(1), positions=torch.full((1, 3), 1e9)))  # beyond the lattice
    decision = decide_densification(
        before, statistics(60), 1.0, ALWAYS, torch.Generator().manual_seed(0), frozen=neighbors
    )
    assert torch.equal(decision.added.positions, free.added.positions[1::2])
    assert torch.equal(decision.added.features, free.added.features[1::2])
    assert len(decision.keep_mask) == 60


def test_new_anchors_stay_where_they_may_be_and_no_budget_is_spent_elsewhere():
    before, coins = anchors(200), torch.Generator
    config = DensifyConfig(min_draw_fraction=0.0, num_levels=2, coarsest_voxels=1.0, grad_threshold=1.0)

    def east(places: torch.Tensor) -> torch.Tensor:
        return places[:, 0] >= 0

    free = decide_densification(before, statistics(200), 0.5, config, coins().manual_seed(0)).added
    held = decide_densification(before, statistics(200), 0.5, config, coins().manual_seed(0), growth_mask=east).added
    assert torch.equal(held.positions, free.positions[east(free.positions)])
    assert 0 < len(held) < len(free)
    budget = DensifyConfig(
        min_draw_fraction=0.0, num_levels=2, coarsest_voxels=1.0, grad_threshold=1.0, max_anchors=220
    )
    few = decide_densification(before, statistics(200), 0.5, budget, coins().manual_seed(0), growth_mask=east).added
    assert len(few) == 20
    assert bool(east(few.positions).all())
    none = decide_densification(
        before, statistics(200), 0.5, config, coins().manual_seed(0), growth_mask=lambda places: places[:, 0] > 1e6
    )
    assert len(none.added) == 0


def test_the_order_of_anchors_does_not_decide_where_new_ones_come(monkeypatch):
    monkeypatch.setattr(densification, "_random", lambda index, count, generator: torch.ones(len(index)))
    before, stats = anchors(80), statistics(80)
    order = torch.randperm(80, generator=torch.Generator().manual_seed(1))
    config = DensifyConfig(min_draw_fraction=0.0, num_levels=3, coarsest_voxels=4.0, grad_threshold=1.0)
    turned = DensificationStats(**{name: tensor[order] for name, tensor in stats.tensors().items()})
    moved = decide_densification(before.select(order), turned, 1.0, config, torch.Generator()).added
    added = decide_densification(before, stats, 1.0, config, torch.Generator()).added
    assert len(added) > 50
    assert torch.equal(moved.positions, added.positions)
    assert torch.equal(moved.features, added.features)


@settings(max_examples=30)
@given(count=st.integers(1, 300), chunk=st.integers(1, 100), data=st.data())
def test_random_numbers_are_those_of_one_draw(count, chunk, data):
    index = torch.tensor(sorted(data.draw(st.sets(st.integers(0, count - 1)))), dtype=torch.int64)
    before = densification.RANDOM_CHUNK
    densification.RANDOM_CHUNK = chunk
    try:
        numbers = densification._random(index, count, torch.Generator().manual_seed(7))
    finally:
        densification.RANDOM_CHUNK = before
    assert torch.equal(numbers, torch.rand(count, generator=torch.Generator().manual_seed(7))[index])
