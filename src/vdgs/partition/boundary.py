"""From clusters of anchors to boundaries on the plane: components, α-shapes, disjoint cores, widening (fig. 4)."""

from __future__ import annotations

import numpy as np
import shapely
from jaxtyping import Float, Int64
from scipy import ndimage
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components
from scipy.spatial import Delaunay, QhullError, cKDTree

#: A cell is this many times the distance to a neighbor (its rank) that so large a share of the anchors has within.
CELL_FACTOR, CELL_NEIGHBOR_RANK, CELL_QUANTILE, CELL_SAMPLE = 2.0, 8, 0.95, 20_000
#: A block of average size is at least so many cells across; the whole scene at most so many.
MIN_CELLS, MAX_CELLS = 6, 512
#: Components are looked for between these quantiles of the anchors, widened by half; what lies beyond is an outlier.
WINDOW_QUANTILES, WINDOW_MARGIN = (0.01, 0.99), 0.5
#: An α-shape is drawn through at most so many anchors.
MAX_OUTLINE_POINTS = 20_000
#: Cells of a grid that may have a number each in memory; of more, those with points are sorted.
MAX_DENSE_CELLS = 1 << 24
#: α in cells to begin with, and its growth until the shape is one polygon.
ALPHA_CELLS, ALPHA_GROWTH = 1.0, 1.25
#: What smoothing reaches, in standard deviations, and closing, in cells.
SMOOTHING_REACH, CLOSING_CELLS = 4, 2
EIGHT_NEIGHBORS = np.ones((3, 3), bool)


def block_cores(
    points: Float[np.ndarray, "n 2"], labels: Int64[np.ndarray, " n"], count: int, smoothing: float
) -> list[shapely.Polygon | None]:
    """The core of every cluster: polygons without common area. None for a cluster that is the strongest nowhere, with
    weights that fall off by `smoothing` cells about each cell. At 0 a cluster's own cells are its component.

    The largest connected component of each cluster, its α-shape with holes filled, simplified. Where two shapes
    overlap the smaller keeps its place: a dense center becomes a hole in the core of the outskirts about it.
    """
    cell = cell_size(points, count)
    components = _components(points, labels, count, cell, smoothing)
    shapes = {label: _outline(members, cell) for label, members in components.items()}
    labels_of = list(shapes)
    tree, cores = shapely.STRtree(list(shapes.values())), dict[int, shapely.Polygon]()
    for label in sorted(shapes, key=lambda each: (shapes[each].area, each)):
        near = {labels_of[index] for index in tree.query(shapes[label]).tolist()}
        taken: shapely.Geometry = shapely.Polygon()
        for other, core in cores.items():
            if other in near:
                taken = taken.union(core)
        core = _remove_slivers(largest_part(shapes[label].difference(taken)), cell / 2)
        if not core.is_empty:
            cores[label] = core
    return [cores.get(label) for label in range(count)]


def expand_core(core: shapely.Polygon, expansion: float) -> shapely.Polygon:
    """The block's boundary: its core widened by `expansion` times the radius of a disc of its area (section IV-B).

    For a disc that is a factor of 1 + expansion about its center (choice); it is defined for any other shape too, and
    always holds the core.
    """
    distance = expansion * float(np.sqrt(core.area / np.pi))
    if distance <= 0:
        return core
    # The core lies a hundred times deeper inside than simplifying can cut.
    return largest_part(core.buffer(distance).simplify(distance / 100))


def cell_size(points: Float[np.ndarray, "n 2"], count: int) -> float:
    """Edge of the cells on which components are found (choice): twice the distance within which 95 % of the anchors
    have eight neighbors, so that cells of sparse outskirts are seldom empty; within bounds set by the scene's size.
    """
    extent = scene_extent(points)
    rank = min(CELL_NEIGHBOR_RANK, len(points) - 1)
    sample = points[:: -(-len(points) // CELL_SAMPLE)]
    # Not balanced: built several times faster, and exact all the same.
    tree = cKDTree(points, balanced_tree=False, compact_nodes=False)
    distances = tree.query(sample, k=[rank + 1])[0]
    wanted = CELL_FACTOR * float(np.quantile(distances, CELL_QUANTILE))
    return float(np.clip(wanted, extent / MAX_CELLS, extent / (MIN_CELLS * np.sqrt(count))))


def scene_extent(points: Float[np.ndarray, "n 2"]) -> float:
    """How far places reach along the longer axis, outliers aside."""
    low, high = np.quantile(points, WINDOW_QUANTILES, axis=0)
    return float((high - low).max()) or float(np.ptp(points, axis=0).max())


def _components(
    points: np.ndarray, labels: np.ndarray, count: int, cell: float, smoothing: float
) -> dict[int, Float[np.ndarray, "m 2"]]:
    """The anchors of each cluster's largest component: most anchors, over cells in which the cluster is strongest.

    Strongest about the cell, not only in it: borders drawn through mixed anchors would have fingers. Without smoothing
    over all cells that hold an anchor of the cluster.
    """
    low, high = np.quantile(points, WINDOW_QUANTILES, axis=0)
    margin = WINDOW_MARGIN * (high - low) + cell
    inside = ((points >= low - margin) & (points <= high + margin)).all(axis=1)
    points, labels = points[inside], labels[inside]
    # Two empty cells about everything: a closing reaches no border.
    index = ((points - points.min(axis=0)) / cell).astype(np.int64) + 2
    rows, columns = index.max(axis=0) + 3
    flat = index[:, 0] * columns + index[:, 1]
    del index
    if smoothing == 0:
        return _own_components(points, labels, flat, (int(rows), int(columns)))
    strongest = _dominant_cluster(labels, flat, (int(rows), int(columns)), count, smoothing)
    own = np.flatnonzero(strongest.ravel()[flat] == labels)
    members = np.split(
        own[np.argsort(labels[own], kind="stable")], np.cumsum(np.bincount(labels[own], minlength=count))
    )
    result = {}
    for label, window in enumerate(ndimage.find_objects(strongest + 1, count)):
        home = members[label]
        if window is None or len(home) == 0:
            continue
        window = _grow_window(window, CLOSING_CELLS, strongest.shape)
        components = ndimage.label(
            ndimage.binary_closing(strongest[window] == label, EIGHT_NEIGHBORS), EIGHT_NEIGHBORS
        )[0]
        row, column = np.divmod(flat[home], columns)
        component = components[row - window[0].start, column - window[1].start]
        result[label] = points[home[component == np.bincount(component).argmax()]]
    return result


def _own_components(
    points: np.ndarray, labels: np.ndarray, flat: Int64[np.ndarray, " n"], shape: tuple[int, int]
) -> dict[int, Float[np.ndarray, "m 2"]]:
    """The anchors of the largest component of each cluster, over the cells that hold one of its anchors."""
    result = {}
    for label in np.unique(labels).tolist():
        home = np.flatnonzero(labels == label)
        occupied = np.bincount(flat[home], minlength=shape[0] * shape[1]).reshape(shape) > 0
        component = ndimage.label(occupied, EIGHT_NEIGHBORS)[0].ravel()[flat[home]]
        result[label] = points[home[component == np.bincount(component).argmax()]]
    return result


def _dominant_cluster(
    labels: Int64[np.ndarray, " n"], flat: Int64[np.ndarray, " n"], shape: tuple[int, int], count: int, smoothing: float
) -> Int64[np.ndarray, "rows columns"]:
    """The cluster that is the strongest about each cell with anchors, else -1; `flat` is the cell of each anchor.

    Each cluster is smoothed over a window that holds all that it reaches: as over all cells, and no slower for many.
    """
    most = np.zeros(shape)
    strongest = np.full(shape, -1, np.int64)
    reach = round(SMOOTHING_REACH * smoothing)
    order = np.argsort(labels, kind="stable")
    ends = np.cumsum(np.bincount(labels, minlength=count))
    for label, cells in enumerate(np.split(flat[order], ends[:-1])):
        if len(cells) == 0:
            continue
        row, column = np.divmod(cells, shape[1])
        window = _grow_window(
            (slice(int(row.min()), int(row.max()) + 1), slice(int(column.min()), int(column.max()) + 1)),
            reach, shape,
        )  # fmt: skip
        above, left = window[0].start, window[1].start
        across = window[1].stop - left
        cells = (row - above) * across + (column - left)
        anchors = np.bincount(cells, minlength=(window[0].stop - above) * across).reshape(-1, across)
        nearby = ndimage.gaussian_filter(anchors.astype(np.float64), smoothing, radius=reach)
        strongest[window][nearby > most[window]] = label
        most[window] = np.maximum(most[window], nearby)
    strongest.ravel()[np.bincount(flat, minlength=strongest.size) == 0] = -1
    return strongest


def _grow_window(window: tuple[slice, slice], cells: int, shape: tuple[int, ...]) -> tuple[slice, slice]:
    """A window on a grid with so many cells more to every side, as far as the grid goes."""
    rows, columns = (
        slice(max(0, each.start - cells), min(size, each.stop + cells))
        for each, size in zip(window, shape, strict=True)
    )
    return rows, columns


def _outline(points: Float[np.ndarray, "m 2"], cell: float) -> shapely.Polygon:
    """The α-shape of a component, simplified to what a cell can tell. One or two points, or a line, get a buffer."""
    spacing = cell / 4
    while len(thinned := points[_first_of_cells(points, spacing)]) > MAX_OUTLINE_POINTS:
        spacing *= np.sqrt(2)
    shape = alpha_shape(thinned, ALPHA_CELLS * cell)
    if shape is None or shape.area < (cell / 4) ** 2:
        return shapely.MultiPoint(thinned).convex_hull.buffer(cell / 2)
    return largest_part(shape.simplify(cell / 4))


def _first_of_cells(
    points: Float[np.ndarray, "m 2"], edge: float, most_flags: int = MAX_DENSE_CELLS
) -> Int64[np.ndarray, " c"]:
    """The first point in each cell of a grid, ascending."""
    cells = np.floor(points / edge).astype(np.int64)
    cells -= cells.min(axis=0)
    across, along = (int(size) for size in cells.max(axis=0) + 1)
    if across * along > most_flags:
        return np.sort(np.unique(cells, axis=0, return_index=True)[1])
    # Of indices that are written twice the last one stays: written backwards, the first.
    first = np.full(across * along, -1, np.int64)
    first[(cells[:, 0] * along + cells[:, 1])[::-1]] = np.arange(len(points))[::-1]
    return np.sort(first[first >= 0])


def alpha_shape(points: Float[np.ndarray, "m 2"], alpha: float) -> shapely.Polygon | None:
    """The union of the Delaunay triangles of circumradius up to α, without holes; None if the points span no area.

    α grows until the triangles hang together by their edges and every point is a corner of one.
    """
    if len(points) < 3:
        return None
    try:
        mesh = Delaunay(points)
    except QhullError:
        return None
    radii = _circumradii(points[mesh.simplices])
    corners = np.unique(mesh.simplices[np.isfinite(radii)])
    if len(corners) == 0:
        return None
    widest = radii[np.isfinite(radii)].max()
    while alpha < widest:
        kept = radii <= alpha
        if len(np.unique(mesh.simplices[kept])) == len(corners) and _is_connected(mesh.neighbors, kept):
            break
        alpha *= ALPHA_GROWTH
    kept = radii <= alpha
    shape = largest_part(shapely.coverage_union_all(shapely.polygons(points[mesh.simplices[kept]])))
    return largest_part(shapely.Polygon(shape.exterior).buffer(0))


def _circumradii(triangles: Float[np.ndarray, "t 3 2"]) -> Float[np.ndarray, " t"]:
    """abc / 4A of each triangle; infinite for one without area."""
    sides = triangles - np.roll(triangles, 1, axis=1)
    lengths = np.linalg.norm(sides, axis=2)
    twice_area = np.abs(sides[:, 0, 0] * sides[:, 1, 1] - sides[:, 0, 1] * sides[:, 1, 0])
    flat = twice_area <= 1e-12 * lengths.max(axis=1) ** 2
    return np.where(flat, np.inf, lengths.prod(axis=1) / np.where(flat, 1.0, 2 * twice_area))


def _is_connected(neighbors: np.ndarray, kept: np.ndarray) -> bool:
    """Whether the kept triangles are connected through common edges."""
    start = np.repeat(np.arange(len(kept)), 3)
    end = neighbors.ravel()
    edges = (end >= 0) & kept[start] & kept[end]
    graph = coo_array((np.ones(edges.sum(), bool), (start[edges], end[edges])), shape=(len(kept), len(kept)))
    labels = connected_components(graph, directed=False)[1]
    return len(np.unique(labels[kept])) == 1


def _remove_slivers(shape: shapely.Polygon, width: float) -> shapely.Polygon:
    """The largest part of the shape that is more than twice `width` wide everywhere; a narrow shape stays as it is."""
    opened = largest_part(shape.buffer(-width).buffer(width, quad_segs=4).intersection(shape))
    return shape if opened.area < shape.area / 2 else opened


def largest_part(shape: shapely.Geometry) -> shapely.Polygon:
    """The polygon of largest area in any geometry; an empty one if there is none."""
    parts = [part for part in shapely.get_parts(shape) if part.geom_type == "Polygon"]
    return max(parts, key=lambda part: part.area, default=shapely.Polygon())
