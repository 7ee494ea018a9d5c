"""The town's colors, in linear light."""

from __future__ import annotations

import numpy as np

from vdgs.synth.mesh import srgb

PLASTER = [srgb(c) for c in ("#e9dcc0", "#f0e9dc", "#e3c38f", "#d99a74", "#c9d3d8", "#e8d3b0", "#b9594a", "#d8c7a6")]
ROOF_TILES = [srgb(c) for c in ("#b8532f", "#a8482c", "#c4683e", "#8f3f2b", "#9d5a3c", "#b0613f")]
SLATE = [srgb(c) for c in ("#5b6472", "#4c525c", "#6b6a70")]
OFFICE = [srgb(c) for c in ("#d6cdbd", "#c2a184", "#b5b9bd", "#a85f48", "#dfe0dc", "#cdb68d")]
FLAT_ROOF = [srgb(c) for c in ("#9a9a96", "#b3ada1", "#7f7c78", "#a9a59b")]
CAR = [
    srgb(c) for c in ("#c8281e", "#1f4fa8", "#e8e8e6", "#2b2d31", "#8d949c", "#e3b01c", "#2f7a4d", "#d8dde2", "#66232b")
]
AWNING = [srgb(c) for c in ("#d6342a", "#1f7fb8", "#e8a51d", "#2f9a57", "#b14ba0")]
LEAVES = [srgb(c) for c in ("#5f8a34", "#4f7a30", "#6f9a3c", "#7fa046", "#467038")]
AUTUMN = [srgb(c) for c in ("#b98a2e", "#a9602c")]
BLOSSOM = [srgb(c) for c in ("#e3a9b9", "#f0d9df")]
NEEDLES = [srgb(c) for c in ("#2f5a3a", "#38643c", "#2a4f3a")]
HEDGE = srgb("#3f6a2c")
BARK = srgb("#6b5138")
STONE = srgb("#bdb4a2")
PALE_STONE = srgb("#d9d1bf")
TRIM = srgb("#efece4")
BRICK = srgb("#9c5540")
TIMBER = srgb("#8a6440")
BARN_RED = srgb("#9c2f25")
DARK = srgb("#26282b")
METAL = srgb("#a6adb3")
COPPER = srgb("#5fa08a")
GOLD = srgb("#d9b13a")
STRAW = srgb("#d8b765")


def pick(rng: np.random.Generator, colors: list[np.ndarray], vary: float = 0.08) -> np.ndarray:
    """One of the colors, a little lighter or darker."""
    return colors[rng.integers(len(colors))] * np.float32(1 + rng.uniform(-vary, vary))
