"""The ground's texture: streets with their markings, gardens, paving, crops.

Every function takes world places x, y in metres and the pixel's footprint in metres (all [n] float32)
and returns linear albedo [n, 3].
"""

from __future__ import annotations

from collections.abc import Callable
from functools import partial

import numpy as np

from vdgs.synth.mesh import srgb
from vdgs.synth.streets import KERB_RADIUS, PAVEMENT, StreetPlan
from vdgs.synth.surface import cells, fade, line, mix_colors, scale_color, smooth
from vdgs.synth.terrain import Terrain
from vdgs.synth.zones import LandUse, LandUseMap

_GRASS = [srgb("#6d9440"), srgb("#7ca348"), srgb("#8a9a4a")]
_WHITE = srgb("#e9e8e2")


def grass(x: np.ndarray, y: np.ndarray, footprint: np.ndarray, dry: float = 0.3) -> np.ndarray:
    """Grass: large patches of lush and dry, tufts the size of a pixel."""
    patches = np.clip(0.5 + 0.35 * smooth(x, y, 9.0) + 0.2 * smooth(y, x, 2.7, footprint), 0, 1)
    green = mix_colors(_GRASS[0], _GRASS[1], patches)
    yellow = np.clip(dry * (smooth(x + 31, y - 17, 6.1) + 0.6), 0, 1)
    tufts = 1 + 0.16 * smooth(x, y, 0.62, footprint) + 0.13 * smooth(y, x, 0.27, footprint)
    return scale_color(mix_colors(green, _GRASS[2], yellow), tufts)


def _meadow(x: np.ndarray, y: np.ndarray, footprint: np.ndarray) -> np.ndarray:
    """Tall grass with flowers in drifts."""
    base = grass(x, y, footprint, dry=0.55) * np.float32(0.92)
    i, j = np.floor(x / 0.33), np.floor(y / 0.33)
    drift = np.clip(smooth(x, y, 5.0) - 0.2, 0, 0.6)
    petal = np.hypot(x / 0.33 - i - 0.5, y / 0.33 - j - 0.5) < 0.38
    bloom = ((cells(i, j) < 0.5 * drift) & petal).astype(np.float32) * fade(0.33, footprint)
    petals = np.where((cells(i, j, 1) < 0.55)[:, None], srgb("#e8cf3e"), srgb("#efeae0"))
    return mix_colors(base, petals, bloom * 0.85)


def _slabs(x: np.ndarray, y: np.ndarray, footprint: np.ndarray, size: float, color: str, vary: float) -> np.ndarray:
    """Square slabs, each a little lighter or darker, with dark joints."""
    u, v = x / np.float32(size), y / np.float32(size)
    i, j = np.floor(u), np.floor(v)
    tint = 1 + vary * (cells(i, j) - 0.5) * fade(size, footprint) + 0.05 * smooth(x, y, 1.9)
    edge = np.maximum(np.abs(u - i - 0.5), np.abs(v - j - 0.5))
    joint = line((0.5 - edge) * size, 0.035, footprint) * 0.4
    return scale_color(srgb(color), (tint + 0.05 * smooth(x, y, 0.3, footprint)) * (1 - joint))


def _asphalt(x: np.ndarray, y: np.ndarray, footprint: np.ndarray) -> np.ndarray:
    """Asphalt: fine grain, worn patches, tar-sealed cracks."""
    grain = 0.1 * smooth(x, y, 0.25, footprint) + 0.035 * smooth(y, x, 0.7, footprint)
    worn = 0.06 * smooth(x, y, 5.3) + 0.03 * smooth(y, x, 1.6, footprint)
    crack = line(smooth(x + 7, y, 6.3) * 1.2, 0.035, footprint) * (smooth(y, x, 9.1) > 0.1)
    return scale_color(srgb("#77777a"), (1 + grain + worn) * (1 - 0.35 * crack))


def _gravel(x: np.ndarray, y: np.ndarray, footprint: np.ndarray) -> np.ndarray:
    grain = 0.16 * smooth(x, y, 0.3, footprint) + 0.1 * smooth(y, x, 1.4, footprint)
    return scale_color(srgb("#cdbb97"), 1 + grain)


def _square(x: np.ndarray, y: np.ndarray, footprint: np.ndarray) -> np.ndarray:
    """Cobbles in two colors, laid in a large chequer with pale bands."""
    base = _slabs(x, y, footprint, 0.42, "#c9b08c", 0.3)
    i, j = np.floor(x / 4.2), np.floor(y / 4.2)
    dark = ((i + j).astype(np.int32) & 1).astype(np.float32)
    edge = np.maximum(np.abs(x / 4.2 - i - 0.5), np.abs(y / 4.2 - j - 0.5))
    band = line((0.5 - edge) * 4.2, 0.2, footprint)
    return mix_colors(base * (1 - 0.26 * dark)[:, None], srgb("#e6dcc6"), band * 0.8)


def _soil(x: np.ndarray, y: np.ndarray, footprint: np.ndarray) -> np.ndarray:
    """A vegetable bed: rows of plants on dark soil."""
    earth = scale_color(srgb("#6b4c35"), 1 + 0.2 * smooth(x, y, 0.3, footprint))
    i, j = np.floor(x / 0.45), np.floor(y / 0.45)
    du, dv = x / 0.45 - i - 0.5, y / 0.45 - j - 0.5
    plant = (np.hypot(du, dv) < 0.2 + 0.25 * cells(i, j)).astype(np.float32)
    leaf = np.where((cells(np.floor(x / 1.5), j * 0, 3) < 0.5)[:, None], srgb("#7fae4a"), srgb("#5a8a4a"))
    return mix_colors(earth, leaf, plant * fade(0.45, footprint))


def _flowers(x: np.ndarray, y: np.ndarray, footprint: np.ndarray) -> np.ndarray:
    """A flower bed: drifts of a few colors among leaves."""
    leaf = grass(x, y, footprint, 0.0) * np.float32(0.6)
    i = np.floor(x / 0.24 + 0.5 * smooth(x, y, 0.9))
    j = np.floor(y / 0.24 + 0.5 * smooth(y, x, 0.9))
    palette = np.stack([srgb(c) for c in ("#d8342f", "#f0c22e", "#e86aa6", "#f4efe6", "#8d55b8")])
    kind = np.floor((smooth(x, y, 2.2) * 0.22 + 0.5) * 5 + 0.8 * cells(i, j)).astype(int) % 5
    return mix_colors(leaf, palette[kind], (cells(i, j, 2) < 0.72) * np.float32(0.9))


def _pitch(x: np.ndarray, y: np.ndarray, footprint: np.ndarray) -> np.ndarray:
    return grass(x, y, footprint, 0.0) * np.array([0.85, 1.02, 0.8], np.float32)


def _court(x: np.ndarray, y: np.ndarray, footprint: np.ndarray) -> np.ndarray:
    return scale_color(srgb("#b5573a"), 1 + 0.07 * smooth(x, y, 0.4, footprint) + 0.07 * smooth(x, y, 3.0))


def _white(x: np.ndarray, y: np.ndarray, footprint: np.ndarray) -> np.ndarray:
    return scale_color(_WHITE, 0.88 + 0.08 * smooth(x, y, 0.5, footprint))


def _woods(x: np.ndarray, y: np.ndarray, footprint: np.ndarray) -> np.ndarray:
    leaves = grass(x, y, footprint, 0.3) * np.float32(0.5)
    litter = np.clip(0.5 + 0.4 * smooth(x, y, 1.3, footprint), 0, 1)
    return mix_colors(leaves, srgb("#6e5738"), litter)


def _sand(x: np.ndarray, y: np.ndarray, footprint: np.ndarray) -> np.ndarray:
    return scale_color(srgb("#e0cb98"), 1 + 0.07 * smooth(x, y, 0.4, footprint) + 0.05 * smooth(x, y, 1.8))


def _rows(x: np.ndarray, y: np.ndarray, footprint: np.ndarray, period: float, furrow: str, crop: str) -> np.ndarray:
    """A crop in rows along y, with tramlines of a tractor every eighteen metres or so."""
    wander = x + 0.25 * np.sin(y * np.float32(0.21))
    ridge = 0.5 + 0.5 * np.cos(wander * np.float32(2 * np.pi / period)) * fade(period, footprint)
    grown = np.clip(ridge + 0.2 * smooth(x, y, 0.4, footprint), 0, 1)
    soil, plants = srgb(furrow), srgb(crop)
    color = mix_colors(soil, plants, grown) * (1 + 0.1 * smooth(x, y, 11.0) + 0.07 * smooth(y, x, 2.1))[:, None]
    tram = np.abs((wander / np.float32(18.0)) % 1 - 0.5) * 18.0
    track = np.maximum(line(tram - 0.8, 0.25, footprint), line(tram + 0.8, 0.25, footprint))
    return mix_colors(color, soil, 0.7 * track).astype(np.float32)


_Shader = Callable[[np.ndarray, np.ndarray, np.ndarray], np.ndarray]
_lawn: _Shader = partial(grass, dry=0.12)
_wheat: _Shader = partial(_rows, period=0.9, furrow="#b59a55", crop="#e0c578")
_lavender: _Shader = partial(_rows, period=1.5, furrow="#a58f68", crop="#8265b5")
_ploughed: _Shader = partial(_rows, period=0.8, furrow="#6d4f38", crop="#967152")
_greens: _Shader = partial(_rows, period=1.1, furrow="#7d6444", crop="#6fa045")
_drive: _Shader = partial(_slabs, size=0.8, color="#b9ada0", vary=0.16)
_pavement: _Shader = partial(_slabs, size=0.6, color="#c2beb6", vary=0.14)
#: Shaders of zones in coordinates of the street plan, and of zones in coordinates of the world.
_PLAN_SHADERS: dict[LandUse, _Shader] = {
    LandUse.LAWN: _lawn, LandUse.PATIO: partial(_slabs, size=0.65, color="#cfb295", vary=0.3), LandUse.DRIVE: _drive,
    LandUse.SOIL: _soil, LandUse.SQUARE: _square, LandUse.WHEAT: _wheat, LandUse.LAVENDER: _lavender,
    LandUse.PLOUGHED: _ploughed, LandUse.GREENS: _greens,
}  # fmt: skip
_WORLD_SHADERS: dict[LandUse, _Shader] = {
    LandUse.PATH: _gravel, LandUse.ASPHALT: _asphalt, LandUse.GRAVEL: _gravel, LandUse.PITCH: _pitch,
    LandUse.LINE: _white, LandUse.FLOWERS: _flowers, LandUse.MEADOW: _meadow, LandUse.WOODS: _woods,
    LandUse.SAND: _sand, LandUse.BUILDING: _drive, LandUse.COURT: _court,
}  # fmt: skip


def _open_land(p: np.ndarray, q: np.ndarray, footprint: np.ndarray) -> np.ndarray:
    """Farmland out to the horizon: a patchwork of crops, each with rows its own way, hedges between."""
    a = p + 5 * np.sin(q / np.float32(70)) + 2 * smooth(p, q, 40.0)
    b = q + 5 * np.sin(p / np.float32(60))
    i = np.floor(a / 62)
    shift = cells(i, i * 0, 5) * 60
    j = np.floor((b + shift) / 84)
    kind, turned = cells(i, j, 6), cells(i, j, 7) < 0.5
    u, v = np.where(turned, b, a), np.where(turned, a, b)
    color = np.empty((len(p), 3), np.float32)
    crops = (_meadow, _wheat, _greens, _ploughed, _lawn, _lavender)
    bounds = np.array([0.3, 0.52, 0.7, 0.82, 0.95])
    which = np.searchsorted(bounds, kind)
    for k in np.unique(which):
        at = np.flatnonzero(which == k)
        color[at] = crops[k](u[at], v[at], footprint[at])
    edge = np.minimum(31 - np.abs(a / 62 - i - 0.5) * 62, 42 - np.abs((b + shift) / 84 - j - 0.5) * 84)
    verge = np.clip((1.6 + 0.5 * smooth(p, q, 2.0) - edge) * 2, 0, 1)
    return mix_colors(color, _woods(p, q, footprint), verge)


def _street_colors(
    along: np.ndarray, across: np.ndarray, half: np.ndarray, gap: np.ndarray, footprint: np.ndarray,
    color: np.ndarray,
) -> np.ndarray:  # fmt: skip
    """Markings on a carriageway: center dashes, edge lines on main streets, zebras before crossings.

    `gap` is the distance to the edge of the crossing street (m), `across` the offset from the center.
    """
    main, clear = half > 4, gap > 6.0
    dash = ((along / np.float32(4.5)) % 1 < 0.5) & clear
    paint = line(across, 0.09, footprint) * dash
    paint = np.maximum(paint, line(np.abs(across) - half + 0.35, 0.07, footprint) * (main & clear))
    zebra = (np.abs(gap - 3.7) < 1.35) & (np.abs(across) < half - 0.3)
    bars = np.clip(0.5 + 4 * np.cos(across * np.float32(2 * np.pi / 1.1)), 0, 1)
    paint = np.maximum(paint, bars * zebra)
    stop = (np.abs(gap - 5.6) < 0.2) & (np.abs(across) < half - 0.3)
    paint = np.maximum(paint, stop * np.float32(0.9))
    wheel = np.exp(-((np.abs(np.abs(across) - 0.5 * half) - 0.75) ** 2) * 6)
    worn = color * (1 - 0.1 * wheel)[:, None]
    return mix_colors(worn, _WHITE * 0.9, paint * (0.82 + 0.1 * smooth(along, across, 0.8)))


def _streets(plan: StreetPlan, p: np.ndarray, q: np.ndarray, footprint: np.ndarray, color: np.ndarray) -> np.ndarray:
    """Draw carriageways, kerbs and pavements over whatever lies below."""
    by_p, by_q = plan.nearest_street(p, q)
    out_p, out_q = by_p.outside, by_q.outside
    r = np.float32(KERB_RADIUS)
    corner = r - np.hypot(np.maximum(r - out_p, 0), np.maximum(r - out_q, 0))
    # outside both streets near their crossing the kerb runs on a circle; elsewhere on the nearer street
    rounded = (out_p > 0) & (out_q > 0) & ~by_p.ended & ~by_q.ended
    nearest = np.minimum(out_p, out_q)
    beyond = np.where(rounded, np.minimum(corner, nearest), nearest)
    paved = np.flatnonzero(beyond < PAVEMENT)
    if not len(paved):
        return color
    p, q, fp = p[paved], q[paved], footprint[paved]
    beyond, out_p, out_q = beyond[paved], out_p[paved], out_q[paved]
    surface = mix_colors(_pavement(p, q, fp), srgb("#dcdad4"), line(beyond - 0.1, 0.12, fp))
    road = np.flatnonzero(beyond < 0)
    tar = _asphalt(p[road], q[road], fp[road])
    for inside, other, along, across, half in (
        (out_p, out_q, q, by_p.offset[paved], by_p.half[paved]),
        (out_q, out_p, p, by_q.offset[paved], by_q.half[paved]),
    ):
        on = np.flatnonzero((inside[road] < 0) & (other[road] > 0))
        at = road[on]
        tar[on] = _street_colors(along[at], across[at], half[at], other[at], fp[at], tar[on])
    surface[road] = tar * (1 - np.clip(1 + beyond[road] / 0.5, 0, 1) * 0.16)[:, None]
    color[paved] = surface
    return color


def ground_albedo(
    plan: StreetPlan, terrain: Terrain, zones: LandUseMap, x: np.ndarray, y: np.ndarray, footprint: np.ndarray
) -> np.ndarray:
    """Albedo of the ground at world places, [n, 3] float32 in linear light."""
    p, q = plan.to_plan(x, y)
    # ragged edges: nothing that grows ends in a line drawn with a ruler
    jx, jy = x + 0.12 * smooth(x, y, 0.8), y + 0.12 * smooth(y, x, 0.8)
    zone, exact = zones.sample(jx, jy), zones.sample(x, y)
    ruled = np.isin(exact, (LandUse.LINE, LandUse.PATIO, LandUse.DRIVE, LandUse.SQUARE, LandUse.ASPHALT, LandUse.COURT))
    zone = np.where(ruled | (zone == LandUse.LINE), exact, zone)
    color = np.empty((len(x), 3), np.float32)
    for kind in np.unique(zone):
        at = np.flatnonzero(zone == kind)
        if kind == LandUse.OPEN:
            color[at] = _open_land(p[at], q[at], footprint[at])
        elif kind in _PLAN_SHADERS:
            color[at] = _PLAN_SHADERS[LandUse(kind)](p[at], q[at], footprint[at])
        else:
            color[at] = _WORLD_SHADERS[LandUse(kind)](x[at], y[at], footprint[at])
    color = _streets(plan, p, q, footprint, color)
    for pond in terrain.ponds:
        near = np.flatnonzero(pond.distance(x, y) < 2.0)
        if len(near):
            shore = np.clip((1.4 - pond.distance(x[near], y[near])) / 0.8, 0, 1).astype(np.float32)
            color[near] = mix_colors(color[near], _sand(x[near], y[near], footprint[near]) * 0.75, shore)
    return color
