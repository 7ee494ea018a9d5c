"""Compensated growth (VDGS section IV-C) for explicit Gaussians, as a strategy that a loop written for gsplat can call.

Where a Gaussian is added and removed follows 3DGS section 5.2; gradients of Gaussians that few cameras see are cached
from cycle to cycle and added (eqs. 8-10, as `training.compensation` does for the offsets of anchors). n Gaussians.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, MutableMapping
from dataclasses import asdict, dataclass, field
from typing import Annotated, Any

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from vdgs.config.method import CompensationConfig, DensifyConfig
from vdgs.config.ranges import FRACTION, Range
from vdgs.config.type_hints import field_hints
from vdgs.config.validation_rules import checked_settings, checked_value
from vdgs.errors import UnsupportedOption, VdgsError, check_kind
from vdgs.kernels.kernel_types import DensificationStats
from vdgs.kernels.rotations import rotation_matrices
from vdgs.training.compensation import CompensationState, close_cycle, low_visibility_mask

#: A split Gaussian becomes two, so many times smaller (3DGS section 5.2).
SPLIT_COUNT, SPLIT_SHRINK = 2, 1.6
#: Thresholds and steps; infinite ones are never reached.
_AT_LEAST_0, _AT_LEAST_1 = Range(0, math.inf), Range(1, math.inf)
Params = MutableMapping[str, Any] | torch.nn.ParameterDict
Optimizers = Mapping[str, torch.optim.Optimizer]


@dataclass(kw_only=True)
class CompensatedGrowth:
    """gsplat's `Strategy`: `initialize_state`, then in every step `step_pre_backward` before `loss.backward()` and
    `step_post_backward` after it.

    `params` holds means [n, 3], scales [n, 3] (logarithms), quats [n, 4], opacities [n] (logits) and whatever else
    there is of each Gaussian; `optimizers` has one optimizer for each trained one; `info` is the third result of
    `vdgs.ops.rasterization` or `gsplat.rasterization`. Settings are named as in gsplat's `DefaultStrategy`; with
    `compensation.enabled` off it decides as that does (screen-size rules aside, which are off there too).

    c_k is the share of the images of a cycle (between two decisions) that the center of Gaussian k lies in, counted at
    what was drawn: an image that is drawn twice counts twice (choice). `compensation.min_draws` plays no part: gsplat
    has no gate. Gradients are in NDC units, as in 3DGS.

    Raises VdgsError for a setting of another kind or outside its range, TypeError for another `compensation`.
    """

    prune_opa: Annotated[float, FRACTION] = 0.005
    grow_grad2d: Annotated[float, _AT_LEAST_0] = 0.0002
    grow_scale3d: Annotated[float, _AT_LEAST_0] = 0.01
    prune_scale3d: Annotated[float, _AT_LEAST_0] = 0.1
    refine_start_iter: Annotated[int, _AT_LEAST_0] = 500
    refine_stop_iter: Annotated[int, _AT_LEAST_0] = 15_000
    reset_every: Annotated[int, _AT_LEAST_1] = 3000
    refine_every: Annotated[int, _AT_LEAST_1] = 100
    pause_refine_after_reset: Annotated[int, _AT_LEAST_0] = 0
    absgrad: bool = False
    revised_opacity: bool = False
    verbose: bool = False
    compensation: CompensationConfig = field(default_factory=CompensationConfig)
    seed: Annotated[int, Range(0, 2**32 - 1)] = 0
    """Of the places of split Gaussians."""

    def __post_init__(self) -> None:
        """Check what a caller gave as `vdgs.train` checks its settings."""
        check_kind("compensation", self.compensation, CompensationConfig, remedy="vdgs.CompensationConfig(t_low=0.2)")
        checked_settings(CompensationConfig, asdict(self.compensation), "compensation")
        kind: type = type(self)
        for name, hint in field_hints(kind).items():
            if name != "compensation":
                setattr(self, name, checked_value(name, getattr(self, name), hint))

    def initialize_state(self, scene_scale: float = 1.0) -> dict[str, Any]:
        """The running state, to be passed to the other functions. `scene_scale`: extent of the scene, world units.
        Raises VdgsError for one that is no number above 0."""
        bounds = Range(0, math.inf, exclusive_min=True)
        scene_scale = checked_value("scene_scale", scene_scale, Annotated[float, bounds])
        generator = torch.Generator().manual_seed(self.seed)
        return {"grad2d": None, "count": None, "seen": None, "cache": None, "views": 0, "scene_scale": scene_scale,
                "generator": generator}  # fmt: skip

    def check_sanity(self, params: Params, optimizers: Optimizers) -> None:
        """Raise ValueError where a parameter or its optimizer is missing, UnsupportedOption with `absgrad`."""
        if self.absgrad:
            raise UnsupportedOption("absgrad: the kernels of vdgs sum signed gradients only; leave it out")
        missing = [name for name in ("means", "scales", "quats", "opacities") if name not in params]
        if missing:
            raise ValueError(f"params lacks {', '.join(missing)}")
        trained = {name for name, parameter in params.items() if parameter.requires_grad}
        if trained != set(optimizers):
            raise ValueError(f"there are optimizers of {sorted(optimizers)} for the trained {sorted(trained)}")
        if any(len(each.param_groups) != 1 for each in optimizers.values()):
            raise ValueError("each optimizer must have one group, with the parameter of its name")

    def step_pre_backward(
        self, params: Params, optimizers: Optimizers, state: dict[str, Any], step: int, info: Mapping[str, Any]
    ) -> None:
        """To be called before `loss.backward()`."""
        info["means2d"].retain_grad()

    @torch.no_grad()
    def step_post_backward(
        self,
        params: Params,
        optimizers: Optimizers,
        state: dict[str, Any],
        step: int,
        info: Mapping[str, Any],
        packed: bool | None = None,
    ) -> None:
        """To be called after `loss.backward()`: counts, and every `refine_every` steps adds and removes Gaussians.

        Raises VdgsError for an `info` without gradients, whose step had no `step_pre_backward` or no backward pass.
        Changes `params`, the states of the optimizers and `state`. `packed` is gsplat's and not used: `info` says it.
        """
        if step >= self.refine_stop_iter:
            return
        self._count(len(params["means"]), state, info)
        refines = step > self.refine_start_iter and step % self.refine_every == 0
        if refines and step % self.reset_every >= self.pause_refine_after_reset:
            grown = self._grow(params, optimizers, state)
            pruned = self._prune(params, optimizers, state, step)
            for name in ("grad2d", "count", "seen"):
                state[name].zero_()
            state["views"] = 0
            if self.verbose:
                print(f"Step {step}: {grown} Gaussians added, {pruned} removed, {len(params['means'])} now")
        if step > 0 and step % self.reset_every == 0:
            limit = torch.tensor(2 * self.prune_opa, dtype=torch.float32, device="cpu").logit().item()
            every = torch.arange(len(params["opacities"]), device=params["opacities"].device)
            changed = {"opacities": params["opacities"].clamp(max=limit)}
            _replace(params, optimizers, {}, every, torch.ones_like(every, dtype=torch.bool), changed)

    def _count(self, n: int, state: dict[str, Any], info: Mapping[str, Any]) -> None:
        """Add what one step has drawn to the sums of the cycle."""
        means2d, radii = info["means2d"], info["radii"]
        if means2d.grad is None:
            raise VdgsError(
                "info['means2d'] has no gradient: call step_pre_backward before loss.backward(), and this after it, "
                "with the `info` of the same step"
            )
        gradient, size = means2d.grad, means2d.new_tensor([info["width"], info["height"]])
        shown = (radii > 0).all(-1)
        if info.get("gaussian_ids") is None:
            rows = torch.where(shown)[-1]
            gradient, center = gradient[shown], means2d[shown]
        else:
            rows, center = info["gaussian_ids"], means2d
        for name in ("grad2d", "count", "seen", "cache"):
            if state[name] is None:
                state[name] = torch.zeros(n, device=means2d.device, dtype=torch.float32)
        images = info["n_cameras"] * info.get("n_batches", 1)
        norm = (gradient * (size / 2 * info["n_cameras"])).norm(dim=-1)
        inside = ((center >= 0) & (center < size)).all(-1)
        state["grad2d"].index_add_(0, rows, norm)
        state["count"].index_add_(0, rows, torch.ones_like(norm))
        state["seen"].index_add_(0, rows, inside.to(norm))
        state["views"] += images

    def _gradients(self, state: dict[str, Any]) -> Float[Tensor, " n"]:
        """Mean gradient of each Gaussian in the cycle, with the cache for those that few of its images show."""
        draws = state["count"].clamp(min=1)
        plain = state["grad2d"] / draws
        if not self.compensation.enabled:
            return plain
        low, threshold = low_visibility_mask(state["seen"] / max(state["views"], 1), self.compensation)
        nothing, cache = torch.zeros_like(plain)[:, None], state["cache"][:, None]
        counted = DensificationStats(state["grad2d"][:, None], state["count"][:, None], plain, state["seen"])
        memory = CompensationState(cache, nothing, nothing)
        added = close_cycle(memory, counted, low, threshold, DensifyConfig(), self.compensation)
        return plain + added.per_draw(state["count"][:, None])[:, 0]

    def _grow(self, params: Params, optimizers: Optimizers, state: dict[str, Any]) -> int:
        """Duplicate small Gaussians with a large gradient, split the large ones; returns how many there are more."""
        asks = self._gradients(state) > self.grow_grad2d
        small = params["scales"].exp().amax(-1) <= self.grow_scale3d * state["scene_scale"]
        twins, parents = (asks & small).nonzero()[:, 0], (asks & ~small).nonzero()[:, 0]
        kept = (~(asks & ~small)).nonzero()[:, 0]
        parts = parents.repeat(SPLIT_COUNT)
        rows = torch.cat([kept, twins, parts])
        changed = self._split(params, parts, state["generator"])
        filled = {name: torch.cat([params[name][rows[: -len(parts) or None]], new]) for name, new in changed.items()}
        fresh = torch.arange(len(rows), device=rows.device) >= len(kept)
        _replace(params, optimizers, state, rows, fresh, filled if len(parts) else {})
        return len(twins) + len(parents)

    def _split(self, params: Params, parts: Tensor, generator: torch.Generator) -> dict[str, Tensor]:
        """What parts of split Gaussians have that their parents have not: places are drawn from the parent."""
        scales = params["scales"][parts].exp()
        drawn = torch.randn(len(parts), 3, generator=generator, dtype=torch.float32, device="cpu").to(scales) * scales
        moved = torch.einsum("pij,pj->pi", rotation_matrices(params["quats"][parts]), drawn)
        changed = {"means": params["means"][parts] + moved, "scales": (scales / SPLIT_SHRINK).log()}
        if self.revised_opacity:  # two parts let as much light through as their parent (arXiv:2404.06109)
            opacities = params["opacities"][parts].sigmoid()
            changed["opacities"] = (1 - (1 - opacities).sqrt()).logit()
        return changed

    def _prune(self, params: Params, optimizers: Optimizers, state: dict[str, Any], step: int) -> int:
        """Remove Gaussians that are faint, and after the first reset those that are too large; returns how many."""
        unfit: Bool[Tensor, " n"] = params["opacities"].flatten().sigmoid() < self.prune_opa
        if step > self.reset_every:
            unfit |= params["scales"].exp().amax(-1) > self.prune_scale3d * state["scene_scale"]
        rows = (~unfit).nonzero()[:, 0]
        _replace(params, optimizers, state, rows, torch.zeros_like(rows, dtype=torch.bool), {})
        return len(unfit) - len(rows)


def _replace(
    params: Params,
    optimizers: Optimizers,
    state: dict[str, Any],
    rows: Tensor,
    fresh: Bool[Tensor, " r"],
    changed: Mapping[str, Tensor],
) -> None:
    """Give every parameter these rows, or those that have `changed`, with the optimizers' moments, which are zero where
    `fresh`, and the running state. Without `state` only what has changed is touched."""
    for name in list(params) if state else list(changed):
        before = params[name]
        after = torch.nn.Parameter(changed.get(name, before[rows]), requires_grad=before.requires_grad)
        params[name] = after
        if name not in optimizers:
            continue
        optimizer = optimizers[name]
        moments = optimizer.state.pop(before, {})
        for key, value in moments.items():
            if isinstance(value, Tensor) and value.shape == before.shape:
                moments[key] = value[rows].masked_fill(fresh.view(-1, *[1] * (value.ndim - 1)), 0.0)
        optimizer.param_groups[0]["params"] = [after]
        if moments:
            optimizer.state[after] = moments
    for name, value in state.items():
        if isinstance(value, Tensor):
            state[name] = value[rows]
