"""Textures of what people build: walls with windows and doors, roofs, awnings, glass.

Every shader takes a `Surface` and returns linear albedo [n, 3] and gloss [n] in [0, 1] (float32).
"""

from __future__ import annotations

import numpy as np

from vdgs.synth.mesh import srgb
from vdgs.synth.surface import Surface, cells, fade, line, mix_colors, scale_color, smooth

AlbedoAndGloss = tuple[np.ndarray, np.ndarray]
_GLASS = srgb("#2c3a48")
_FRAME = srgb("#f1eee6")
_SHUTTERS = np.stack([srgb(c) for c in ("#4f7a5a", "#7a3b32", "#47648a", "#8a6a44", "#d8d4c8")])
_DOORS = np.stack([srgb(c) for c in ("#7a2f28", "#2f5a48", "#2f4a78", "#6b4a2c")])


def _matt(color: np.ndarray) -> AlbedoAndGloss:
    return color.astype(np.float32), np.zeros(len(color), np.float32)


def _grain_plane(s: Surface) -> tuple[np.ndarray, np.ndarray]:
    """Texture coordinates in metres that differ from one building to the next."""
    return s.uv[:, 0] + s.seed * 97, s.uv[:, 1] + s.seed * 53


def _half_bond(s: Surface, width: float, height: float) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Coordinates u, v in courses of stones (m) laid in half bond, and the column and row of the stone."""
    u, v = s.uv[:, 0] / np.float32(width), s.uv[:, 1] / np.float32(height)
    j = np.floor(v)
    u = u + 0.5 * (j % 2)
    return u, v, np.floor(u), j


def plaster(s: Surface) -> AlbedoAndGloss:
    """Rendered wall: blotches, and dirt where rain splashes up."""
    u, v = _grain_plane(s)
    grain = 1 + 0.05 * smooth(u, v, 0.5, s.footprint) + 0.06 * smooth(u, v, 2.3)
    splash = 1 - 0.2 * np.exp(-np.maximum(s.uv[:, 1], 0) / 0.35)
    return _matt(scale_color(s.color, grain * splash))


def stone(s: Surface) -> AlbedoAndGloss:
    """Ashlar: blocks of 0.9 by 0.45 m in half bond."""
    u, v, i, j = _half_bond(s, 0.9, 0.45)
    tint = 1 + 0.22 * (cells(i, j) - 0.5) * fade(0.5, s.footprint)
    joint = np.maximum(line((u - i) * 0.9, 0.03, s.footprint), line((v - j) * 0.45, 0.03, s.footprint))
    return _matt(scale_color(s.color, (tint + 0.05 * smooth(*_grain_plane(s), 1.3)) * (1 - 0.3 * joint)))


def brick(s: Surface) -> AlbedoAndGloss:
    """Courses of large bricks with pale joints."""
    u, v, i, j = _half_bond(s, 0.5, 0.22)
    tint = 1 + 0.4 * (cells(i, j) - 0.5) * fade(0.3, s.footprint)
    joint = np.maximum(line((u - i) * 0.5, 0.02, s.footprint), line((v - j) * 0.22, 0.02, s.footprint))
    return _matt(mix_colors(scale_color(s.color, tint), srgb("#c9bfb0"), 0.5 * joint))


def _panes(s: Surface, u: np.ndarray, v: np.ndarray, lit: np.ndarray) -> np.ndarray:
    """Glass of a window around (u, v) = its middle, with a glazing bar and now and then a curtain."""
    curtain = np.where((lit < 0.35)[:, None], srgb("#b8ab98") * 0.8, _GLASS * (0.7 + 0.6 * lit)[:, None])
    bars = np.maximum(line(u, 0.04, s.footprint), line(v - 0.15, 0.035, s.footprint))
    return mix_colors(curtain, _FRAME, 0.8 * bars)


def windows(s: Surface, has_door: bool = False) -> AlbedoAndGloss:
    """A house wall: evenly spaced windows with frames, sills and shutters; a door in the middle column."""
    color, gloss = plaster(s)
    width, height = s.panel.T
    columns = np.maximum(np.round(width / 2.7), 1)
    pitch = width / columns
    column, storey = np.floor(s.uv[:, 0] / pitch), np.floor(s.uv[:, 1] / np.float32(2.7))
    u = s.uv[:, 0] - (column + 0.5) * pitch
    v = s.uv[:, 1] - storey * np.float32(2.7) - 1.55
    room = (storey + 1) * 2.7 <= height + 0.2
    is_door = (column == np.floor(columns / 2)) & (storey == 0) & has_door
    glazed = room & ~is_door
    hw, hh = np.float32(0.52), np.float32(0.68)
    au, av = np.abs(u), np.abs(v)
    shutter = glazed & (au > hw + 0.08) & (au < hw + 0.5) & (av < hh + 0.05) & (s.seed < 0.7) & (pitch > 2.2)
    slats = 0.85 + 0.15 * np.cos(v * 50) * fade(0.12, s.footprint)
    tone = _SHUTTERS[(s.seed * 31).astype(int) % 5] * slats[:, None]
    color = np.where(shutter[:, None], tone, color)
    frame = glazed & (au < hw + 0.1) & (av < hh + 0.1)
    sill = glazed & (au < hw + 0.2) & (v < -hh) & (v > -hh - 0.2)
    color = np.where((frame | sill)[:, None], _FRAME, color)
    pane = glazed & (au < hw) & (av < hh)
    lit = cells(column + np.floor(s.seed * 4096), storey, 8)
    color = np.where(pane[:, None], _panes(s, u, v, lit), color)
    leaf, porch = is_door & (au < 0.5) & (v < 0.6), is_door & (au < 0.72) & (v < 0.82)
    color = np.where(porch[:, None], _FRAME * 0.9, color)
    color = np.where(leaf[:, None], _DOORS[(s.seed * 57).astype(int) % 4], color)
    return color.astype(np.float32), np.where(pane, np.float32(0.7), gloss)


def door(s: Surface) -> AlbedoAndGloss:
    """A house wall with its door."""
    return windows(s, has_door=True)


def office(s: Surface) -> AlbedoAndGloss:
    """A town block: shop windows below, storeys of windows above; seeds over 0.95 are churches."""
    color, gloss = plaster(s)
    width, height = s.panel.T
    church = s.seed > 0.95
    step = np.where(church, np.float32(2.6), np.where(s.seed < 0.45, np.float32(2.1), np.float32(2.8)))
    rise = np.where(church, height, np.float32(3.1))
    columns = np.maximum(np.round(width / step), 1)
    pitch = width / columns
    column, storey = np.floor(s.uv[:, 0] / pitch), np.floor(s.uv[:, 1] / rise)
    u, v = s.uv[:, 0] - (column + 0.5) * pitch, s.uv[:, 1] - storey * rise - 0.52 * rise
    inside = (storey + 1) * rise <= height + 0.1
    shop = (storey == 0) & ~church
    hw = np.where(church, 0.5, np.where(shop, 0.44 * pitch, np.where(s.seed < 0.45, 0.55, 0.42 * pitch)))
    hh = np.where(church, 0.3 * height, np.where(shop, 1.15, 0.8))
    arch = np.where(church, (u / hw) ** 2 * 0.8, 0.0)
    pane = inside & (np.abs(u) < hw) & (v > -hh) & (v < hh - arch)
    rim = inside & (np.abs(u) < hw + 0.12) & (np.abs(v) < hh + 0.12 - arch)
    ledge = (np.abs(s.uv[:, 1] - storey * rise) < 0.16) & ~church
    lit = cells(column + np.floor(s.seed * 4096), storey, 9)
    color = np.where((rim | ledge)[:, None], np.minimum(s.color * 1.25, 0.85), color)
    color = np.where(pane[:, None], _panes(s, u, v, np.maximum(lit, 0.2)), color)
    sign = shop & (s.uv[:, 1] > 2.65) & (s.uv[:, 1] < 3.2)
    signs = _SHUTTERS[(column + np.floor(s.seed * 100)).astype(int) % 5]
    color = np.where(sign[:, None], signs, color)
    return color.astype(np.float32), np.where(pane, np.float32(0.8), gloss)


def tiles(s: Surface) -> AlbedoAndGloss:
    """Clay pantiles: rounded columns, courses with a shadow below, no two tiles alike, some moss."""
    u, v = s.uv[:, 0] / np.float32(0.36), s.uv[:, 1] / np.float32(0.46)
    i, j = np.floor(u), np.floor(v)
    alike = fade(0.45, s.footprint)
    tint = 1 + 0.42 * (cells(i, j, (s.seed * 512).astype(np.int32)) - 0.5) * alike
    roll = 1 + 0.13 * np.cos((u - i - 0.5) * np.float32(2 * np.pi)) * fade(0.36, s.footprint)
    course = 1 - 0.3 * np.exp(-(v - j) * 5) * alike
    gu, gv = _grain_plane(s)
    weather = 1 + 0.09 * smooth(gu, gv, 2.6) + 0.06 * smooth(gv, gu, 0.9, s.footprint)
    color = scale_color(s.color, tint * roll * course * weather)
    moss = np.clip(smooth(gu, gv, 1.7) * 0.5 - 0.55, 0, 0.45) * (s.seed > 0.4)
    return _matt(mix_colors(color, srgb("#6f7a45"), moss))


def slate(s: Surface) -> AlbedoAndGloss:
    """Flat slates in half bond."""
    u, v, i, j = _half_bond(s, 0.4, 0.4)
    alike = fade(0.4, s.footprint)
    tint = 1 + 0.36 * (cells(i, j, (s.seed * 512).astype(np.int32)) - 0.5) * alike
    edge = np.maximum(line((v - j) * 0.4, 0.04, s.footprint), line((u - i) * 0.4, 0.02, s.footprint))
    weather = 1 + 0.08 * smooth(*_grain_plane(s), 2.1)
    return _matt(scale_color(s.color, tint * weather * (1 - 0.35 * edge)))


def flat_roof(s: Surface) -> AlbedoAndGloss:
    """Bitumen in strips or gravel or a planted roof, with puddle stains; by seed."""
    u, v = _grain_plane(s)
    grain = 1 + 0.09 * smooth(u, v, 0.3, s.footprint) + 0.05 * smooth(u, v, 3.4)
    seam = line((s.uv[:, 0] / 1.4 % 1 - 0.5) * 1.4, 0.05, s.footprint) * (s.seed < 0.6)
    stain = np.clip(smooth(u, v, 4.6) - 0.6, 0, 0.8) * 0.3
    bare = scale_color(s.color, grain * (1 - 0.22 * seam) * (1 - stain))
    border = np.minimum(np.minimum(*s.uv.T), np.minimum(*(s.panel - s.uv).T)) < 1.1
    planted = (s.seed > 0.72) & ~border
    sedum = mix_colors(srgb("#7f8f4a"), srgb("#a5764f"), np.clip(0.5 + 0.5 * smooth(u, v, 1.6), 0, 1))
    return _matt(np.where(planted[:, None], sedum * grain[:, None], bare))


def timber(s: Surface) -> AlbedoAndGloss:
    """Upright boards."""
    u = s.uv[:, 0] / np.float32(0.3)
    i = np.floor(u)
    tint = 1 + 0.3 * (cells(i, i * 0) - 0.5) * fade(0.3, s.footprint)
    gap = line((u - i) * 0.3, 0.025, s.footprint)
    return _matt(scale_color(s.color, (tint + 0.06 * smooth(s.uv[:, 0] * 4, s.uv[:, 1], 0.9)) * (1 - 0.4 * gap)))


def paint(s: Surface) -> AlbedoAndGloss:
    """Paint or sheet metal; seeds over 0.8 are polished."""
    u, v = _grain_plane(s)
    return scale_color(s.color, 1 + 0.03 * smooth(u, v, 0.6)), np.where(s.seed > 0.8, np.float32(0.35), 0)


def glass(s: Surface) -> AlbedoAndGloss:
    """Dark glass."""
    rim = np.minimum(np.minimum(*s.uv.T), np.minimum(*(s.panel - s.uv).T))
    color = mix_colors(scale_color(_GLASS * 0.8, np.ones(len(rim))), _FRAME * 0.4, line(rim, 0.05, s.footprint))
    return color, np.full(len(rim), 0.8, np.float32)


def awning(s: Surface) -> AlbedoAndGloss:
    """Broad stripes of color and white."""
    stripe = ((s.uv[:, 0] / s.panel[:, 0] * np.float32(3.5)) % 1 < 0.5).astype(np.float32)
    fringe = 1 - 0.15 * np.exp(-s.uv[:, 1] / 0.15)
    return _matt(mix_colors(s.color, _FRAME * 0.95, stripe) * fringe[:, None])


def solar(s: Surface) -> AlbedoAndGloss:
    """Solar panels: blue cells, pale frames."""
    u, v = s.uv[:, 0], s.uv[:, 1]
    panel = np.maximum(line((u % 1.0) - 0.5, 0.05, s.footprint), line((v % 1.05) - 0.52, 0.05, s.footprint))
    cell = np.maximum(line((u % 0.2) - 0.1, 0.01, s.footprint), line((v % 0.2) - 0.1, 0.01, s.footprint))
    color = mix_colors(scale_color(srgb("#1f3566"), 1 + 0.2 * smooth(u, v, 1.0)), srgb("#c9d2dc"), 0.85 * panel)
    return mix_colors(color, srgb("#7f93b8"), 0.3 * cell), np.full(len(u), 0.5, np.float32)


def dark(s: Surface) -> AlbedoAndGloss:
    """A color and nothing else."""
    return _matt(s.color)


def foliage(s: Surface) -> AlbedoAndGloss:
    """Leaves: dark in the hollows between clumps, light and yellowish on top, speckled all over."""
    u, v = _facing_plane(s)
    crown = s.seed >= 0  # hedges carry no crown coordinates
    hollow = np.where(crown, 0.5 + 0.62 * s.uv[:, 0], 0.95)
    height = np.where(crown, 0.7 + 0.38 * s.uv[:, 1], np.clip(0.6 + 0.5 * s.normal[:, 2], 0.5, 1.05))
    leaves = 1 + 0.26 * smooth(u, v, 0.6, s.footprint) + 0.26 * smooth(v, u, 0.27, s.footprint)
    leaves = leaves + 0.1 * smooth(u, v, 1.9)
    color = scale_color(s.color, hollow * height * np.clip(leaves, 0.3, 1.8))
    warm = np.clip(height - 0.85, 0, 0.3) * hollow
    color *= 1 + warm[:, None] * np.array([0.9, 0.5, -0.2], np.float32)
    return color, np.zeros(len(u), np.float32)


def _facing_plane(s: Surface) -> tuple[np.ndarray, np.ndarray]:
    """World coordinates in whichever of the three axis planes a place faces most (m, [n] each)."""
    x, y, z = s.position.T
    axis = np.abs(s.normal * np.array([1, 1, 1.2], np.float32)).argmax(1)
    return np.where(axis == 0, y + 11, x), np.where(axis == 2, y, z + 37)


def bark(s: Surface) -> AlbedoAndGloss:
    """Bark with upright ridges."""
    ridges = 1 + 0.25 * smooth(s.uv[:, 0] * 4, s.uv[:, 1], 0.6, s.footprint)
    return scale_color(s.color, ridges), np.zeros(len(ridges), np.float32)


def water(s: Surface) -> AlbedoAndGloss:
    """Still water: its own color below, the sky on top, faint ripples."""
    x, y = s.position[:, 0], s.position[:, 1]
    ripples = 1 + 0.1 * smooth(x, y * 1.6, 1.1, s.footprint) + 0.16 * smooth(x, y, 6.0)
    ripples = ripples + 0.07 * smooth(y, x, 0.5, s.footprint)
    return scale_color(s.color, ripples), np.full(len(x), 1.0, np.float32)
