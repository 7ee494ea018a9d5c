"""Rays against triangles, by Embree."""

from __future__ import annotations

import importlib.util
from dataclasses import dataclass

import numpy as np

from vdgs.errors import VdgsError
from vdgs.synth.mesh import Mesh

_MAX_DISTANCE = np.float32(1e30)


@dataclass(frozen=True, eq=False)
class RayHits:
    """What rays met: triangle [n] int32 (-1: nothing), distance [n] m, barycentric u, v [n]."""

    triangle: np.ndarray
    distance: np.ndarray
    u: np.ndarray
    v: np.ndarray


def require_embree() -> None:
    """Raises VdgsError where Embree is not installed."""
    if importlib.util.find_spec("embreex") is None:
        raise VdgsError('Generating a capture needs the ray caster Embree: pip install "vdgs[synth]".')


class RayTracer:
    """A scene that answers rays; safe to ask from several threads at once.

    Raises VdgsError where Embree is not installed.
    """

    def __init__(self, mesh: Mesh) -> None:
        require_embree()
        from embreex.mesh_construction import TriangleMesh
        from embreex.rtcore_scene import EmbreeScene

        self._scene = EmbreeScene(robust=True)
        self._mesh = TriangleMesh(self._scene, mesh.vertices, mesh.faces)
        # the first ray builds the hierarchy; do it here, before threads share the scene
        self.intersect(np.zeros((1, 3), np.float32), np.array([[0, 0, 1]], np.float32))

    def intersect(self, origins: np.ndarray, directions: np.ndarray) -> RayHits:
        """The first triangle along each ray; origins, directions [n, 3] float32."""
        found = self._scene.run(
            np.ascontiguousarray(origins, np.float32),
            np.ascontiguousarray(directions, np.float32),
            query="INTERSECT",
            output=True,
        )
        return RayHits(found["primID"], found["tfar"], found["u"], found["v"])

    def occluded(self, origins: np.ndarray, directions: np.ndarray, reach: np.ndarray | None = None) -> np.ndarray:
        """Whether anything lies within `reach` (in lengths of the directions; None: anywhere), [n] bool."""
        far = np.full(len(origins), _MAX_DISTANCE) if reach is None else np.ascontiguousarray(reach, np.float32)
        found = self._scene.run(
            np.ascontiguousarray(origins, np.float32),
            np.ascontiguousarray(directions, np.float32),
            query="OCCLUDED",
            dists=far,
        )
        return found == 0
