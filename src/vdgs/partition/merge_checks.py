"""Whether trained blocks are those of the cut that they are merged by, known by the anchors that they began with.

Training moves no anchor's position, removes anchors, and adds some where the block may grow. So every coarse position
that a block's model holds lies in the widened block, and where margins are frozen no two blocks hold the same one.
"""

from __future__ import annotations

import numpy as np
from jaxtyping import Bool, Float, Int64
from torch import Tensor

from vdgs.errors import VdgsError
from vdgs.partition.blocks import Blocks, xy_positions

#: Odd, of 64 bits: what makes one number of the bits of x, y and z.
_FACTORS = np.array([0x9E3779B97F4A7C15, 0xC2B2AE3D27D4EB4F, 0x165667B19E3779F9], np.uint64)


class AnchorOrigins:
    """Which coarse positions trained blocks hold, and which of them are in the merged scene. 18 bytes an anchor."""

    def __init__(self, coarse: Float[Tensor, "n 3"], blocks: Blocks) -> None:
        self._blocks = blocks
        self._keys, self._rows = np.unique(_keys(coarse), return_index=True)
        self._coarse = coarse
        #: In how many models a position is (two for more), whether the merged scene has it, and whether its owner does.
        self._holders = np.zeros(len(self._keys), np.uint8)
        self._given = np.zeros(len(self._keys), bool)
        self._owner_holds = np.zeros(len(self._keys), bool)
        #: Coarse anchors of each model, and how many of them lie outside of the widened block.
        self._counts: dict[int, tuple[int, int]] = {}
        self._has_rings = False

    def add(self, index: int, positions: Float[Tensor, "m 3"], given: Bool[np.ndarray, " m"]) -> None:
        """Note the model of a block, and which of its anchors the merged scene takes."""
        found, known = self._find(positions)
        places = xy_positions(positions)[known]
        owner = self._blocks.owner(places)
        outside = int((~self._blocks.in_expanded(index, places, owner)).sum())
        self._counts[index] = len(places), outside
        self._owner_holds[found[known][owner == index]] = True
        self._has_rings |= bool((owner != index).any())
        here = np.unique(found[known])
        self._holders[here] = np.minimum(self._holders[here] + 1, 2)
        self._given[found[known & given]] = True

    def stand_in(self, positions: Float[Tensor, "m 3"]) -> None:
        """Note coarse anchors that stand in for a block without a model."""
        found, known = self._find(positions)
        self._given[found[known]] = True

    def check(self, rule: str) -> None:
        """Raise VdgsError where anchors of trained blocks would be lost: of another cut, or by the rule.

        Where no position is in two models the margins were frozen: then the block that a position is given to has it,
        unless training has removed it everywhere. With other margins a neighbor may still hold what the owner removed.
        """
        lost = np.flatnonzero((self._holders > 0) & ~self._given)
        if not len(lost):
            return
        for index, (total, outside) in self._counts.items():
            if outside:
                raise VdgsError(
                    f"block {index} was trained for another cut of the scene: {outside:,} of the {total:,} coarse "
                    f"anchors in its model lie outside of the widened block. {_REMEDY}"
                )
        if (self._holders > 1).any():
            return
        if rule != "owner" and self._owner_holds[lost].all():  # the rule gives them to others
            if self._has_rings:
                return  # which have removed them
            raise VdgsError(
                f"rule {rule!r} would lose {len(lost):,} anchors: the blocks were trained with frozen margins, so that "
                "no block holds what another owns. Merge with rule='owner', or train them with --block.margin ramp or "
                "free"
            )
        owner = self._blocks.owner(xy_positions(self._coarse[self._rows[lost]]))
        most = int(np.bincount(owner).argmax())
        raise VdgsError(
            f"the blocks were trained for another cut of the scene: of the coarse anchors that block {most} owns, "
            f"{int((owner == most).sum()):,} are in the model of another block, and would be lost. {_REMEDY}"
        )

    def _find(self, positions: Float[Tensor, "m 3"]) -> tuple[Int64[np.ndarray, " m"], Bool[np.ndarray, " m"]]:
        """Where among the keys each position would be, and whether it is one of them."""
        keys = _keys(positions)
        at = np.minimum(np.searchsorted(self._keys, keys), max(len(self._keys) - 1, 0))
        return at, self._keys[at] == keys if len(self._keys) else np.zeros(len(keys), bool)


_REMEDY = (
    "Give the blocks and the assignment that they were trained with: .blocks and .assignment of vdgs.open_run(RUN)"
)


def _keys(positions: Float[Tensor, "n 3"]) -> np.ndarray:
    """A number [n] uint64 for each position, the same for the same bits."""
    bits = np.ascontiguousarray(positions.detach().cpu().numpy(), np.float32).view(np.uint32)
    mixed = bits.reshape(-1, 3).astype(np.uint64) * _FACTORS
    return mixed[:, 0] + mixed[:, 1] + mixed[:, 2]
