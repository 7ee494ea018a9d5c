"""Photographs that no file holds, in the database of a work folder: what each shows is given."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    import pycolmap


def write_camera(database: pycolmap.Database, camera: pycolmap.Camera) -> int:
    """Write a camera, with the rig of its own that COLMAP asks for; its number, which is that of the rig too."""
    import pycolmap

    number = database.write_camera(camera)
    rig = pycolmap.Rig()
    rig.add_ref_sensor(pycolmap.sensor_t(pycolmap.SensorType.CAMERA, number))
    database.write_rig(rig)
    return int(number)


def write_photograph(database: pycolmap.Database, name: str, camera: int, marks: np.ndarray) -> int:
    """Write a photograph by a camera of `write_camera` with features at `marks` [n, 2] (pixels); its number."""
    import pycolmap

    image = database.write_image(pycolmap.Image(name=name, camera_id=camera))
    frame = pycolmap.Frame()
    frame.rig_id = camera
    frame.add_data_id(pycolmap.data_t(pycolmap.sensor_t(pycolmap.SensorType.CAMERA, camera), image))
    database.write_frame(frame)
    database.write_keypoints(image, marks.astype(np.float32))
    return int(image)
