"""What moves between photographs: cars, buses and people, each somewhere else on its street in every photograph."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

from vdgs.synth import props
from vdgs.synth.mesh import MeshBuilder, join_meshes
from vdgs.synth.ray_tracing import RayTracer
from vdgs.synth.shapes import ObjectFrame
from vdgs.synth.site import Site, street_plot
from vdgs.synth.streets import PAVEMENT
from vdgs.synth.town import Town

#: Shares of all that moves: people, and buses; the others are cars (choice).
_PEOPLE, _BUSES = 0.35, 0.06
#: How often a place is drawn anew where something stands already; the height (m) above ground that must be free there.
_MAX_TRIES, _FREE_HEIGHT = 8, 2.0
#: A pixel shows what moves where a channel differs by more from the photograph without it, of 255.
_LEAST_CHANGE = 3


@dataclass(frozen=True)
class MovingObject:
    """A thing that moves along one side of a street; `seed` draws how it looks."""

    build: Callable[[MeshBuilder, ObjectFrame, np.random.Generator], None]
    half_length: float
    position: float
    across: float
    along_q: bool
    backwards: bool
    span: tuple[float, float]
    seed: int


def make_moving_objects(town: Town, count: int, seed: int) -> list[MovingObject]:
    """So many things on the streets of a town; the first ones of more are the same."""
    return [_make_object(town, index, np.random.default_rng([seed, 12, index])) for index in range(count)]


def _make_object(town: Town, index: int, rng: np.random.Generator) -> MovingObject:
    plan, along_q, side, kind = town.plan, bool(rng.random() < 0.5), (-1, 1)[int(rng.integers(2))], rng.random()
    streets, halves, others = (plan.p, plan.p_half, plan.q) if along_q else (plan.q, plan.q_half, plan.p)
    street = int(rng.integers(len(streets)))
    half, on_foot = float(halves[street]), kind < _PEOPLE
    build, half_length = (props.person, 0.2) if on_foot else (props.car, 2.3)
    if _PEOPLE <= kind < _PEOPLE + _BUSES:
        build, half_length = props.bus, 5.0
    return MovingObject(
        build=build, half_length=half_length, position=float(streets[street]),
        across=side * (half + rng.uniform(0.2, 0.8) * PAVEMENT if on_foot else 0.35 * half),
        along_q=along_q, backwards=side < 0, span=(float(others[0]), float(others[-1])), seed=index,
    )  # fmt: skip


def place_moving_objects(
    town: Town, tracer: RayTracer, objects: list[MovingObject], seed: int, photograph: int
) -> tuple[Town, RayTracer]:
    """The town as one photograph meets it; a thing that finds no free place is left out of it."""
    rng, builder = np.random.default_rng([seed, 13, photograph]), MeshBuilder()
    site, taken = Site(town.plan, town.terrain, town.zones, builder, rng), list[tuple[np.ndarray, float]]()
    for thing in objects:
        frame = _free_place(site, tracer, thing, taken)
        if frame is not None:
            thing.build(builder, frame, np.random.default_rng([seed, 14, thing.seed]))
            taken.append((np.array([frame.x, frame.y]), thing.half_length))
    if not taken:
        return town, tracer
    mesh = join_meshes(town.mesh, builder.build())
    return replace(town, mesh=mesh), RayTracer(mesh)


def _free_place(
    site: Site, tracer: RayTracer, thing: MovingObject, taken: list[tuple[np.ndarray, float]]
) -> ObjectFrame | None:
    """Somewhere along its street where nothing stands, and none of the places [2] that are taken, with their radii;
    None after several tries."""
    for _ in range(_MAX_TRIES):
        along = site.rng.uniform(*thing.span)
        plot = street_plot(thing.position, thing.across, along, along_q=thing.along_q, backwards=thing.backwards)
        frame = site.frame(plot)
        here, room = np.array([frame.x, frame.y]), thing.half_length + 0.5
        feet = frame.to_world(np.array([(x, 0, 0.12) for x in np.linspace(-1, 1, 5) * thing.half_length]))
        up = np.broadcast_to(np.array([0, 0, 1], np.float32), feet.shape)
        apart = all(np.linalg.norm(here - other) > room + radius for other, radius in taken)
        if apart and not tracer.occluded(feet, up, np.full(len(feet), _FREE_HEIGHT)).any():
            return frame
    return None


def still_mask(still: np.ndarray, photograph: np.ndarray) -> np.ndarray:
    """Where two pictures [h, w, 3] of a place agree, as a mask: 255, and 0 where something moving or its shadow is."""
    change = np.abs(still.astype(np.int16) - photograph).max(axis=-1)
    return np.where(change > _LEAST_CHANGE, 0, 255).astype(np.uint8)
