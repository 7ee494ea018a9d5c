"""Trees, bushes and hedges: a few crown shapes, turned, scaled and colored anew for every tree."""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache

import numpy as np

from vdgs.synth import palette
from vdgs.synth.mesh import Material, MeshBuilder
from vdgs.synth.shapes import Box, ObjectFrame, SurfaceMaterial, box, frustum

#: Least and greatest height of each kind of tree, m.
_HEIGHTS = {
    "round": (5.5, 9.0),
    "poplar": (8.0, 12.0),
    "bush": (0.9, 1.7),
    "conifer": (7.0, 11.0),
    "blossom": (3.5, 4.8),
}


@dataclass(frozen=True, eq=False)
class TreeCrown:
    """A crown of unit radius about its own center: vertices [v, 3], faces [f, 3], corner normals
    [f, 3, 3], and per corner how far out of the leaf mass it stands and how high, [f, 3, 2] in [0, 1]."""

    vertices: np.ndarray
    faces: np.ndarray
    normals: np.ndarray
    openness: np.ndarray


def _sphere(subdivisions: int) -> tuple[np.ndarray, np.ndarray]:
    """An icosphere: unit vertices [v, 3] and faces [f, 3]."""
    g = (1 + 5**0.5) / 2
    vertices = np.array(
        [(-1, g, 0), (1, g, 0), (-1, -g, 0), (1, -g, 0), (0, -1, g), (0, 1, g),
         (0, -1, -g), (0, 1, -g), (g, 0, -1), (g, 0, 1), (-g, 0, -1), (-g, 0, 1)]
    )  # fmt: skip
    faces = np.array(
        [(0, 11, 5), (0, 5, 1), (0, 1, 7), (0, 7, 10), (0, 10, 11), (1, 5, 9), (5, 11, 4),
         (11, 10, 2), (10, 7, 6), (7, 1, 8), (3, 9, 4), (3, 4, 2), (3, 2, 6), (3, 6, 8), (3, 8, 9),
         (4, 9, 5), (2, 4, 11), (6, 2, 10), (8, 6, 7), (9, 8, 1)]
    )  # fmt: skip
    vertices /= np.linalg.norm(vertices, axis=1, keepdims=True)
    for _ in range(subdivisions):
        edges = np.sort(np.concatenate([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]]), axis=1)
        unique, inverse = np.unique(edges, axis=0, return_inverse=True)
        middle = vertices[unique].sum(1)
        middle /= np.linalg.norm(middle, axis=1, keepdims=True)
        ab, bc, ca = (inverse.reshape(3, -1) + len(vertices)).reshape(3, -1)
        a, b, c = faces.T
        faces = np.concatenate([np.stack(t, 1) for t in ((a, ab, ca), (b, bc, ab), (c, ca, bc), (ab, bc, ca))])
        vertices = np.concatenate([vertices, middle])
    return vertices, faces


def _finish(vertices: np.ndarray, faces: np.ndarray, openness: np.ndarray, softness: float) -> TreeCrown:
    """Corner normals between those of the facets and those of a ball, so that crowns look round but leafy."""
    corners = vertices[faces]
    facet = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    facet /= np.linalg.norm(facet, axis=1, keepdims=True) + 1e-12
    ball = corners / (np.linalg.norm(corners, axis=2, keepdims=True) + 1e-12)
    normals = (1 - softness) * facet[:, None] + softness * ball
    normals /= np.linalg.norm(normals, axis=2, keepdims=True)
    low, high = vertices[:, 2].min(), vertices[:, 2].max()
    height = (vertices[:, 2] - low) / (high - low)
    return TreeCrown(vertices, faces, normals, np.stack([openness, height], 1)[faces])


@lru_cache(maxsize=64)
def _round_crown(variant: int, detail: int) -> TreeCrown:
    """A ball of leaf clumps: every clump bulges out of the crown."""
    rng = np.random.default_rng([21, variant])
    vertices, faces = _sphere(detail)
    clumps = rng.normal(size=(26 if detail > 2 else 16, 3))
    clumps /= np.linalg.norm(clumps, axis=1, keepdims=True)
    angle = np.arccos(np.clip(vertices @ clumps.T, -1, 1))
    reach = rng.uniform(0.42, 0.62, len(clumps))
    bulge = (np.sqrt(np.maximum(0, 1 - (angle / reach) ** 2)) * rng.uniform(0.75, 1.0, len(clumps))).max(1)
    radius = 0.66 + 0.32 * bulge + rng.normal(0, 0.022, len(vertices))
    shaped = vertices * radius[:, None] * [1, 1, rng.uniform(0.85, 1.1)]
    return _finish(shaped, faces, bulge, 0.45)


@lru_cache(maxsize=64)
def _conifer_crown(variant: int) -> TreeCrown:
    """Skirts of branches, one above the other, with ragged rims."""
    rng = np.random.default_rng([22, variant])
    vertices, faces = list[np.ndarray](), list[np.ndarray]()
    around, skirts = 22, 6
    for k in range(skirts):
        share = k / skirts
        radius, low, high = 1.0 * (1 - share) ** 0.9 + 0.06, share * 1.9 - 1, (share + 0.36) * 1.9 - 1
        angle = np.arange(around) / around * 2 * np.pi + rng.uniform(0, 1)
        rim = radius * np.where(np.arange(around) % 2, 0.72, 1.0) * rng.uniform(0.88, 1.1, around)
        drop = rng.uniform(-0.05, 0.05, around)
        ring = np.stack([rim * np.cos(angle), rim * np.sin(angle), low + drop], 1)
        start = len(vertices) * (around + 1)
        vertices.append(np.vstack([ring, [0, 0, min(high, 1.0)]]))
        following = (np.arange(around) + 1) % around
        faces.append(np.stack([np.arange(around), following, np.full(around, around)], 1) + start)
    openness = np.tile(np.append(np.full(around, 1.0), 0.15), skirts)
    return _finish(np.vstack(vertices), np.vstack(faces), openness, 0.25)


def _plant(
    builder: MeshBuilder, crown: TreeCrown, at: ObjectFrame, size: np.ndarray, color: np.ndarray, seed: float
) -> None:
    """A crown scaled by `size` [3] and stood at a frame."""
    cos, sin = np.cos(at.angle), np.sin(at.angle)
    turn = np.array([(cos, -sin, 0), (sin, cos, 0), (0, 0, 1)])
    normals = (crown.normals / size) @ turn.T
    normals /= np.linalg.norm(normals, axis=-1, keepdims=True)
    builder.part(
        at.to_world(crown.vertices * size), crown.faces, Material.FOLIAGE, color, seed,
        uv=crown.openness, panel=size[[0, 2]], normals=normals,
    )  # fmt: skip


def tree(
    builder: MeshBuilder,
    frame: ObjectFrame,
    rng: np.random.Generator,
    kind: str = "round",
    height: float | None = None,
    detail: int = 3,
) -> None:
    """One tree on the ground at a frame: round, poplar, conifer, blossom or bush.

    `detail` is how often the ball that its crown is made of is subdivided: 3 nearby, 1 far off.
    """
    tall = height or rng.uniform(*_HEIGHTS[kind])
    at = ObjectFrame(frame.x, frame.y, frame.z, rng.uniform(0, 6.28))
    seed, variant = float(rng.random()), int(rng.integers(6))
    bark = SurfaceMaterial(Material.BARK, palette.BARK)
    if kind == "conifer":
        color = palette.pick(rng, palette.NEEDLES)
        frustum(builder, at, (0.25, 0.2), (-0.5, 0.2 * tall), bark, None, 6)
        radius = tall * rng.uniform(0.2, 0.27)
        size = np.array([radius, radius, 0.46 * tall])
        _plant(builder, _conifer_crown(variant), at.child(0, 0, 0.56 * tall), size, color, seed)
        return
    leaves = {"blossom": palette.BLOSSOM}.get(kind, palette.LEAVES)
    if kind == "round" and rng.random() < 0.07:
        leaves = palette.AUTUMN
    wide = {"poplar": 0.17, "bush": 0.6}.get(kind, rng.uniform(0.33, 0.42)) * tall
    upright = {"poplar": 0.46, "bush": 0.55}.get(kind, 0.36) * tall
    if kind != "bush":
        frustum(builder, at, (0.05 * wide + 0.16, 0.12), (-0.5, tall - upright), bark, None, 7)
    size = np.array([wide, wide * rng.uniform(0.88, 1.1), upright])
    center = at.child(0, 0, 0.35 * tall if kind == "bush" else tall - upright)
    _plant(builder, _round_crown(variant, detail), center, size, palette.pick(rng, leaves, 0.15), seed)


def hedge(builder: MeshBuilder, frame: ObjectFrame, length: float, height: float = 1.1) -> None:
    """A clipped hedge along local x."""
    leaf = SurfaceMaterial(Material.FOLIAGE, palette.HEDGE, -1.0)
    shape = Box(x0=-length / 2, x1=length / 2, y0=-0.35, y1=0.35, z0=-0.6, z1=height)
    box(builder, frame, shape, leaf, leaf, inset=(0.06, 0.08))
