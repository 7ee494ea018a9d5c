"""How far the points of a model are from where photographs show them, and observations that show nothing of theirs."""

from __future__ import annotations

import numpy as np

from vdgs.system.lazy_pycolmap import pycolmap

#: An error counts as this much at most (px; choice), so that no single point makes the mean: COLMAP has no error for a
#: point behind a camera and takes the largest number there is.
LARGEST_PX = 100.0


def mean_reprojection_error(model: pycolmap.Reconstruction) -> float:
    """Mean distance in pixels from where photographs show points to where the model has them, each point's at most
    `LARGEST_PX`; by the errors that the model holds (`update_point_3d_errors`). 0 without observations."""
    found = (point.error for point in model.points3D.values() if point.track.length())
    errors = np.array([error for error in found if error >= 0])  # it is -1 until it is computed
    return float(np.where(errors < LARGEST_PX, errors, LARGEST_PX).mean()) if len(errors) else 0.0


def drop_unseen_observations(model: pycolmap.Reconstruction) -> int:
    """Delete the observations of points that do not lie in front of the camera, and points that less than two are left
    of; how many. Cameras that release together at one place match what is far away, which tells no distance: the mapper
    may leave such points at the camera itself."""
    model.update_point_3d_errors()
    far = [number for number, point in model.points3D.items() if not point.error < LARGEST_PX]
    unseen = [
        (each.image_id, each.point2D_idx)
        for number in far
        for each in model.points3D[number].track.elements
        if model.images[each.image_id].project_point(model.points3D[number].xyz) is None
    ]
    for image, place in unseen:
        if model.images[image].points2D[place].has_point3D():  # its point may be deleted by now
            model.delete_observation(image, place)
    if unseen:
        model.update_point_3d_errors()
    return len(unseen)
