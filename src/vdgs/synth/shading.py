"""From hits to light: which shader, how much sun, how much sky."""

from __future__ import annotations

import numpy as np

from vdgs.synth import facades, nature
from vdgs.synth.ground_texture import ground_albedo
from vdgs.synth.lighting import BOUNCE_COLOR, SKY_COLOR, SUN, SUN_COLOR, SkyMap, sky_color
from vdgs.synth.mesh import Material
from vdgs.synth.ray_tracing import RayHits, RayTracer
from vdgs.synth.surface import Surface
from vdgs.synth.town import Town

_SHADERS = {
    Material.PLASTER: facades.plaster,
    Material.WINDOWS: facades.windows,
    Material.DOOR: facades.front,
    Material.OFFICE: facades.office,
    Material.TILES: facades.tiles,
    Material.SLATE: facades.slate,
    Material.FLAT_ROOF: facades.flat_roof,
    Material.STONE: facades.stone,
    Material.BRICK: facades.brick,
    Material.TIMBER: facades.timber,
    Material.PAINT: facades.paint,
    Material.GLASS: facades.glass,
    Material.AWNING: facades.awning,
    Material.SOLAR: facades.solar,
    Material.DARK: facades.plain,
    Material.FOLIAGE: nature.foliage,
    Material.BARK: nature.bark,
    Material.WATER: nature.water,
}


def surface_at(
    town: Town, hits: RayHits, origins: np.ndarray, directions: np.ndarray, pixel_angle: float
) -> tuple[Surface, np.ndarray, np.ndarray]:
    """The surface at each hit (all must have hit), its material [n] and its geometric normal [n, 3]."""
    mesh, triangle = town.mesh, hits.triangle
    u, v = hits.u[:, None], hits.v[:, None]
    weights = (1 - u - v, u, v)
    texture, normals = mesh.uv[triangle], mesh.normals[triangle]
    uv = sum(w * texture[:, k] for k, w in enumerate(weights))
    normal = sum(w * normals[:, k] for k, w in enumerate(weights))
    normal /= np.linalg.norm(normal, axis=1, keepdims=True)
    corners = mesh.vertices[mesh.faces[triangle]]
    flat = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    flat /= np.linalg.norm(flat, axis=1, keepdims=True) + np.float32(1e-20)
    away = np.einsum("ij,ij->i", flat, directions) > 0
    flat = np.where(away[:, None], -flat, flat)
    normal = np.where((np.einsum("ij,ij->i", normal, flat) < 0)[:, None], -normal, normal)
    surface = Surface(
        position=origins + directions * hits.distance[:, None],
        normal=normal,
        uv=uv,
        panel=mesh.panel[triangle],
        color=mesh.color[triangle],
        seed=mesh.seed[triangle],
        footprint=hits.distance * np.float32(pixel_angle),
        view=directions,
    )
    return surface, mesh.material[triangle], flat


def _albedo(town: Town, surface: Surface, material: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Albedo [n, 3] and gloss [n] of every place."""
    albedo, gloss = np.empty_like(surface.color), np.zeros(len(material), np.float32)
    for kind in np.unique(material):
        at = np.flatnonzero(material == kind)
        if kind == Material.GROUND:
            x, y = surface.position[at, 0], surface.position[at, 1]
            albedo[at] = ground_albedo(town.plan, town.terrain, town.zones, x, y, surface.footprint[at])
        else:
            albedo[at], gloss[at] = _SHADERS[Material(kind)](surface.take(at))
    return np.clip(albedo, 0, 0.92), gloss


def _ambient(town: Town, sky: SkyMap, surface: Surface, flat: np.ndarray, material: np.ndarray) -> np.ndarray:
    """Share of the sky that lights each place, [n]: from the map on the ground, ever more further up."""
    step = np.where((material == Material.GROUND)[:, None], 0, flat[:, :2]) * np.float32(0.7)
    x, y = surface.position[:, 0] + step[:, 0], surface.position[:, 1] + step[:, 1]
    below = sky.sample(x, y)
    raised = np.flatnonzero((material != Material.GROUND) & (material != Material.WATER))
    height = np.zeros(len(x), np.float32)
    height[raised] = surface.position[raised, 2] - town.terrain.height(x[raised], y[raised])
    share = below + (1 - below) * np.clip(height / 7.0, 0, 1)
    return np.where(material == Material.FOLIAGE, 0.5 + 0.5 * share, share)


def radiance(
    town: Town, tracer: RayTracer, sky: SkyMap, origins: np.ndarray, directions: np.ndarray, pixel_angle: float
) -> tuple[np.ndarray, RayHits]:
    """Linear light that comes along rays [n, 3] float32, [n, 3], and what they met.

    `pixel_angle` is the angle between neighbouring pixels in radians.
    """
    hits = tracer.intersect(origins, directions)
    light = sky_color(directions)
    met = np.flatnonzero(hits.triangle >= 0)
    if not len(met):
        return light, hits
    found = RayHits(hits.triangle[met], hits.distance[met], hits.u[met], hits.v[met])
    surface, material, flat = surface_at(town, found, origins[met], directions[met], pixel_angle)
    albedo, gloss = _albedo(town, surface, material)
    facing = np.clip(surface.normal @ SUN, 0, 1)
    lit = np.flatnonzero((facing > 0) & (flat @ SUN > 0))
    start = surface.position[lit] + flat[lit] * np.float32(0.02)
    sun = np.zeros(len(met), np.float32)
    clear = ~tracer.occluded(start, np.broadcast_to(SUN, start.shape))
    sun[lit] = facing[lit] * clear
    share = _ambient(town, sky, surface, flat, material).astype(np.float32)
    up = 0.5 + 0.5 * surface.normal[:, 2]
    arriving = sun[:, None] * SUN_COLOR + (share * up)[:, None] * SKY_COLOR
    arriving += ((0.4 + 0.6 * share) * (1 - 0.75 * up))[:, None] * BOUNCE_COLOR
    light[met] = albedo * arriving + _reflection(surface, gloss, sun)
    return light, hits


def _reflection(surface: Surface, gloss: np.ndarray, sun: np.ndarray) -> np.ndarray:
    """Sky and sun mirrored in glass, water and paint (Schlick's Fresnel term), [n, 3]."""
    out = np.zeros_like(surface.position)
    at = np.flatnonzero(gloss > 0)
    if not len(at):
        return out
    normal, view = surface.normal[at], surface.view[at]
    cosine = np.clip(-np.einsum("ij,ij->i", normal, view), 0, 1)
    mirrored = view + 2 * cosine[:, None] * normal
    fresnel = gloss[at] * (0.06 + 0.94 * (1 - cosine) ** 5)
    glint = np.clip(mirrored @ SUN, 0, 1) ** 90 * 4.0 * (sun[at] > 0) * gloss[at]
    out[at] = fresnel[:, None] * sky_color(mirrored) + (0.2 * glint)[:, None] * SUN_COLOR
    return out
