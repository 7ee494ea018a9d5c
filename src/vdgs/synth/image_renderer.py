"""From hits to light: which shader, how much sun, how much sky."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np

from vdgs.geometry.camera import Camera
from vdgs.synth import facades
from vdgs.synth.facades import AlbedoAndGloss
from vdgs.synth.ground_texture import ground_albedo
from vdgs.synth.lighting import (
    BOUNCE_COLOR,
    SKY_COLOR,
    SUN,
    SUN_COLOR,
    SkyMap,
    add_haze,
    cloudy_sky_color,
    sky_color,
    tone_map,
)
from vdgs.synth.mesh import Material
from vdgs.synth.ray_tracing import RayHits, RayTracer
from vdgs.synth.surface import Surface, smooth
from vdgs.synth.town import Town

#: The shader of each material but the ground is the function of its name in `facades`.
_SHADERS: dict[Material, Callable[[Surface], AlbedoAndGloss]] = {
    kind: getattr(facades, kind.name.lower()) for kind in Material if kind != Material.GROUND
}
#: Rays shaded at a time: their arrays stay in the cache.
_CHUNK = 1 << 16
#: How far samples spread beyond their pixel: a little softness against aliasing.
_SAMPLE_SPREAD = 1.15
#: Root mean square slope of waves along an axis in a wind of about 7 m/s (Cox and Munk, 1954), and the lengths (m) of
#: the waves with the share of its square that each has (choice).
_WAVE_SLOPE, _WAVE_LENGTHS, _WAVE_SHARES = np.float32(0.14), (3.0, 1.2, 0.5), (0.25, 0.35, 0.4)


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
    flat = mesh.face_normals[triangle]
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

    `pixel_angle` is the angle between neighboring pixels in radians.
    """
    hits = tracer.intersect(origins, directions)
    light = cloudy_sky_color(directions) if sky.is_cloudy else sky_color(directions)
    met = np.flatnonzero(hits.triangle >= 0)
    if not len(met):
        return light, hits
    found = RayHits(hits.triangle[met], hits.distance[met], hits.u[met], hits.v[met])
    surface, material, flat = surface_at(town, found, origins[met], directions[met], pixel_angle)
    if town.waves is not None:
        surface = replace(surface, normal=_normals_on_waves(surface, material, town.waves))
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
    if sky.is_cloudy:
        light[met] = add_haze(light[met], found.distance)
    return light, hits


def _normals_on_waves(surface: Surface, material: np.ndarray, start: tuple[float, float]) -> np.ndarray:
    """The normals [n, 3], those of water turned by the slopes of waves."""
    at, normals = np.flatnonzero(material == Material.WATER), surface.normal.copy()
    x, y = (surface.position[at, k] + np.float32(start[k]) for k in range(2))
    for length, share in zip(_WAVE_LENGTHS, _WAVE_SHARES, strict=True):
        for k, (u, v) in enumerate(((x, y), (y + 511, x))):
            normals[at, k] -= _WAVE_SLOPE * np.float32(share**0.5) * smooth(u, v, length, surface.footprint[at])
    normals[at] /= np.linalg.norm(normals[at], axis=1, keepdims=True)
    return normals


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


def pixel_sample_offsets(count: int) -> np.ndarray:
    """Places of a pixel's samples around its center, [count, 2] in pixels: rotated grid or R2 sequence."""
    if count == 1:
        return np.zeros((1, 2))
    if count == 4:
        return _SAMPLE_SPREAD * np.array([(-0.125, -0.375), (0.375, -0.125), (0.125, 0.375), (-0.375, 0.125)])
    k = np.arange(count)[:, None]
    offsets = (0.5 + k * np.array([0.7548776662466927, 0.5698402909980532])) % 1
    return _SAMPLE_SPREAD * (offsets - offsets.mean(0))


def pixel_rays(camera: Camera, pixels: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Origins and unit directions [n, 3] float32 of the rays through image places [n, 2] (pixels)."""
    rotation = camera.camera_from_world[:3, :3]
    x, y = (pixels[:, 0] - camera.cx) / camera.fx, (pixels[:, 1] - camera.cy) / camera.fy
    directions = np.stack([x, y, np.ones(len(pixels))], 1) @ rotation
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    origins = np.broadcast_to(camera.position, directions.shape)
    return origins.astype(np.float32), directions.astype(np.float32)


def pixel_centers(camera: Camera) -> np.ndarray:
    """Image places of all pixel centers, row by row, [height * width, 2]."""
    x, y = np.meshgrid(np.arange(camera.width) + 0.5, np.arange(camera.height) + 0.5)
    return np.stack([x.ravel(), y.ravel()], 1)


def render_image(
    town: Town, tracer: RayTracer, sky: SkyMap, camera: Camera, samples: int, gain: np.ndarray
) -> np.ndarray:
    """The picture that a camera takes, [height, width, 3] uint8; `gain` [3] is its exposure, per channel."""
    centers, offsets = pixel_centers(camera), pixel_sample_offsets(samples)
    step = max(1, _CHUNK // samples)
    rows = []
    for start in range(0, len(centers), step):
        pixels = centers[start : start + step, None] + offsets
        rays = pixel_rays(camera, pixels.reshape(-1, 2))
        light, _ = radiance(town, tracer, sky, *rays, 1 / camera.fx)
        rows.append(tone_map(light.reshape(-1, samples, 3).mean(1) * gain.astype(np.float32)))
    values = np.concatenate(rows).reshape(camera.height, camera.width, 3)
    return (values * 255 + 0.5).astype(np.uint8)
