"""`CompensatedGrowth`: gsplat's decisions without compensation; with it, more where few images show a Gaussian."""

from __future__ import annotations

import copy
from dataclasses import replace

import pytest
import torch

from support.fake_gsplat import needs_gsplat
from vdgs import ops
from vdgs.config.method import CompensationConfig
from vdgs.errors import UnsupportedOption, VdgsError
from vdgs.training.compensated_growth import CompensatedGrowth

SIDE = 24
PLAIN = CompensationConfig(enabled=False)


def start(n: int = 80):
    random = torch.Generator().manual_seed(0)
    drawn = {
        "means": 3 * torch.rand(n, 3, generator=random) - 1.5, "quats": torch.randn(n, 4, generator=random),
        "scales": torch.log(0.02 + 0.2 * torch.rand(n, 3, generator=random)),
        "opacities": torch.rand(n, generator=random) * 8 - 5.5, "colors": torch.rand(n, 3, generator=random),
    }  # fmt: skip
    params = torch.nn.ParameterDict(drawn)
    return params, {name: torch.optim.Adam([each], 0.01) for name, each in params.items()}


def run(strategy, steps, *, packed=True, shifts=(0.0,)):
    """The strategy in gsplat's loop; step i is seen by the camera that `shifts` moves sideways."""
    params, optimizers = start()
    strategy.check_sanity(params, optimizers)
    state = strategy.initialize_state()
    K = torch.tensor([[[30.0, 0, SIDE / 2], [0, 30.0, SIDE / 2], [0, 0, 1]]])
    for step in range(1, steps + 1):
        viewmat = torch.eye(4)[None].clone()
        viewmat[0, 0, 3], viewmat[0, 2, 3] = shifts[step % len(shifts)], 4.0
        picture, _, info = ops.rasterization(
            params["means"], params["quats"], params["scales"].exp(), params["opacities"].sigmoid(), params["colors"],
            viewmat, K, SIDE, SIDE, packed=packed,
        )  # fmt: skip
        strategy.step_pre_backward(params, optimizers, state, step, info)
        (picture - 0.3).square().mean().backward()
        strategy.step_post_backward(params, optimizers, state, step, info, packed=packed)
        for optimizer in optimizers.values():
            optimizer.step()
            optimizer.zero_grad()
    return params, optimizers, state


@needs_gsplat
@pytest.mark.parametrize("packed", [True, False])
def test_without_compensation_it_decides_as_gsplat(packed):
    from gsplat import DefaultStrategy

    settings = {"refine_start_iter": 0, "refine_every": 4, "grow_grad2d": 2e-4, "grow_scale3d": 9.0}
    theirs, moments, _ = run(DefaultStrategy(**settings), 17, packed=packed)
    ours, own, _ = run(CompensatedGrowth(**settings, compensation=PLAIN), 17, packed=packed)
    assert len(ours["means"]) != 80
    for name in theirs:
        torch.testing.assert_close(ours[name], theirs[name], rtol=0, atol=0, msg=name)
        assert torch.equal(own[name].state[ours[name]]["exp_avg"], moments[name].state[theirs[name]]["exp_avg"])


@needs_gsplat
def test_it_splits_as_many_as_gsplat():
    from gsplat import DefaultStrategy

    settings = {"refine_start_iter": 0, "refine_every": 4, "grow_grad2d": 1e-5, "grow_scale3d": 0.1}
    for revised in (False, True):
        theirs, _, _ = run(DefaultStrategy(**settings, revised_opacity=revised), 5)
        ours, _, _ = run(CompensatedGrowth(**settings, compensation=PLAIN, revised_opacity=revised), 5)
        assert len(ours["means"]) == len(theirs["means"]) > 80
        assert torch.isfinite(ours["means"]).all()
    twice = [run(CompensatedGrowth(**settings, compensation=PLAIN), 5)[0]["means"] for _ in range(2)]
    assert torch.equal(*twice)


def test_opacities_are_reset_with_their_moments_and_large_gaussians_go():
    """gsplat 1.5.3 means to, too: `step % self.reset_every == 0 & step > 0` is never true."""
    settings = {"refine_start_iter": 0, "refine_every": 4, "reset_every": 10, "prune_scale3d": 0.15}
    params, optimizers, _ = run(CompensatedGrowth(**settings, compensation=PLAIN), 10)
    assert float(params["opacities"].detach().sigmoid().max()) <= 0.01 + 1e-6
    assert not optimizers["opacities"].state[params["opacities"]]["exp_avg"].any()
    assert optimizers["means"].state[params["means"]]["exp_avg"].any()
    assert float(params["scales"].detach().exp().max()) > 0.16
    params, _, _ = run(CompensatedGrowth(**settings, compensation=PLAIN, prune_opa=0.0), 12)
    assert float(params["scales"].detach().exp().max()) < 0.16


def test_compensation_adds_only_what_few_images_show():
    """Four of five images look past the left part: it is in L, grows more, and the rest as without."""
    strategy = CompensatedGrowth(
        refine_start_iter=0, refine_every=5, grow_grad2d=1e-3, compensation=CompensationConfig(t_low=0.5, beta_g=2.0)
    )
    found = {}
    for name, compensation in (("with", strategy.compensation), ("without", PLAIN)):
        chosen, masks = replace(strategy, compensation=compensation), []
        gradients = chosen._gradients

        def seen(state, gradients=gradients, masks=masks):
            before = {key: copy.copy(value) for key, value in state.items() if key != "generator"}
            masks.append((before, gradients(state)))
            return masks[-1][1]

        chosen._gradients = seen
        run(chosen, 5, shifts=(0.0, 2.5, 2.5, 2.5, 2.5))
        ((before, decided),) = masks
        found[name] = before["seen"] / before["views"], before["grad2d"] / before["count"].clamp(min=1), decided
    share, plain, compensated = found["with"]
    low = share < 0.5
    assert 0 < int(low.sum()) < len(low)
    assert torch.equal(found["without"][2], plain)
    assert torch.equal(compensated[~low], plain[~low])
    torch.testing.assert_close(compensated[low], 3 * plain[low])  # g = 2 times the mean of the first cycle


def test_past_cycles_alone_are_added_where_that_is_asked():
    """In the first cycle there is nothing yet; the cache then holds what it would hold with the present cycle."""
    held = {}
    for history in ("current", "past"):
        compensation = CompensationConfig(t_low=1.0, beta_g=2.0, history=history)
        strategy = CompensatedGrowth(compensation=compensation)
        state = {"grad2d": torch.tensor([3.0]), "count": torch.tensor([6.0]), "seen": torch.tensor([1.0]),
                 "views": 10, "cache": torch.zeros(1)}  # fmt: skip
        held[history] = [(strategy._gradients(state).tolist(), state["cache"].tolist()) for _ in range(2)]
    assert held["current"] == [([1.5], [1.0]), ([pytest.approx(2.4)], [pytest.approx(1.9)])]
    assert held["past"] == [([0.5], [1.0]), ([1.5], [pytest.approx(1.9)])]


def test_the_cache_decays_and_follows_its_gaussians():
    strategy = CompensatedGrowth(
        refine_start_iter=0, refine_every=2, grow_grad2d=1e-4, compensation=CompensationConfig(t_low=1.0)
    )
    params, _, state = run(strategy, 7, shifts=(0.0, 1.0))
    assert len(state["cache"]) == len(params["means"]) != 80
    assert float(state["cache"].max()) > 0


def test_what_does_not_fit_is_said():
    params, optimizers = start()
    with pytest.raises(ValueError, match="optimizers of"):
        CompensatedGrowth().check_sanity(params, {"means": optimizers["means"]})
    with pytest.raises(UnsupportedOption, match="absgrad"):
        CompensatedGrowth(absgrad=True).check_sanity(params, optimizers)
    info = {"means2d": torch.zeros(1, 1, 2), "radii": torch.ones(1, 1, 2), "width": 4, "height": 4, "n_cameras": 1}
    with pytest.raises(VdgsError, match="means2d'] has no gradient: call step_pre_backward before"):
        CompensatedGrowth().step_post_backward(params, optimizers, CompensatedGrowth().initialize_state(), 1, info)
    del params["quats"]
    with pytest.raises(ValueError, match="params lacks quats"):
        CompensatedGrowth().check_sanity(params, optimizers)


@pytest.mark.parametrize(
    "wrong",
    [{"gamma": float("nan")}, {"gamma": 2.0}, {"beta_g": -5.0}, {"t_low": 20.0}, {"t_low": "0.2"}, {"target": "max"},
     {"history": "none"},
     {"min_draws": "none"}, {"enabled": "yes"}],
    ids=str,
)  # fmt: skip
def test_a_compensation_that_does_not_work_is_said_when_it_is_given(wrong):
    [name] = wrong
    with pytest.raises(VdgsError, match=rf"^compensation\.{name} is .*it must be"):
        CompensatedGrowth(compensation=CompensationConfig(**wrong))


@pytest.mark.parametrize(
    "wrong",
    [{"refine_every": 0}, {"reset_every": 0}, {"grow_grad2d": float("nan")}, {"prune_opa": -0.1}, {"seed": -1}],
    ids=str,
)
def test_a_setting_that_does_not_work_is_said_when_it_is_given(wrong):
    [name] = wrong
    with pytest.raises(VdgsError, match=f"^{name} is .*it must be"):
        CompensatedGrowth(**wrong)
    assert CompensatedGrowth(prune_scale3d=float("inf"), refine_stop_iter=10**12).prune_scale3d == float("inf")
    with pytest.raises(TypeError, match=r"compensation.*CompensationConfig"):
        CompensatedGrowth(compensation={"t_low": 0.2})
    with pytest.raises(VdgsError, match=r"^scene_scale is nan; it must be above 0"):
        CompensatedGrowth().initialize_state(float("nan"))
