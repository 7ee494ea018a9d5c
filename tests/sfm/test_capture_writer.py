"""Photographs without distortion and the model that goes with them, of many cameras and many photographs."""

from __future__ import annotations

import gc
import tracemalloc
import weakref

import cv2
import numpy as np
import pycolmap

from vdgs.captures.formats.source_capture import Intrinsics
from vdgs.sfm import capture_writer
from vdgs.sfm.workspace import Workspace


def test_one_map_is_in_memory_at_a_time_and_none_is_made_of_photographs_that_are_written(tmp_path, monkeypatch):
    """Each body, focal length and digital zoom is a camera of its own, and its map takes 8 bytes a pixel."""
    work, told, maps = Workspace(tmp_path / "work"), list[int](), list[weakref.ref]()
    lenses = {k: Intrinsics("SIMPLE_RADIAL", (100.0 + k, 80.0, 60.0, -0.02), 160, 120) for k in range(1, 5)}
    names = {k: [f"{k}a.jpg", f"{k}b.jpg"] for k in lenses}
    work.images.mkdir(parents=True)
    for name in (name for group in names.values() for name in group):
        cv2.imwrite(str(work.images / name), np.full((120, 160, 3), 128, np.uint8))
    make = capture_writer.make_undistortion

    def made(*arguments):
        gc.collect()
        assert all(each() is None for each in maps)
        undistortion = make(*arguments)
        maps.append(weakref.ref(undistortion.grid))
        return undistortion

    monkeypatch.setattr(capture_writer, "make_undistortion", made)
    for count in (2, 4, 4):
        first = {k: names[k] for k in list(names)[:count]}
        capture_writer.write_images(tmp_path / "out", work, first, lenses, 0, 2, told.append)
        assert told[-1] == 2 * count
        assert len(maps) == count
    sizes = {cv2.imread(str(file)).shape[1::-1] for file in (tmp_path / "out/images").iterdir()}
    pinholes = [capture_writer.straight_camera(lens, 0) for lens in lenses.values()]
    assert sizes == {(pinhole.width, pinhole.height) for pinhole in pinholes}
    assert pinholes == [make(lens, 0).intrinsics for lens in lenses.values()]


def test_a_model_of_many_observations_is_written_in_little_memory(tmp_path):
    """Thousands of photographs have millions of observations: some bytes of each, and all where they belong."""
    options = pycolmap.SyntheticDatasetOptions()
    options.num_rigs, options.num_cameras_per_rig, options.num_frames_per_rig, options.num_points3D = 1, 1, 30, 1000
    model = pycolmap.synthesize_dataset(options)
    observations = model.compute_num_observations()
    assert observations > 25_000
    pinholes = {
        number: Intrinsics("PINHOLE", (900.0, 900.0, 512.0, 384.0), camera.width, camera.height)
        for number, camera in model.cameras.items()
    }
    gc.collect()
    tracemalloc.start()
    try:
        capture_writer.write_model(tmp_path, model, pinholes)
        peak = tracemalloc.get_traced_memory()[1]
    finally:
        tracemalloc.stop()
    assert peak < 40 * observations
    written = pycolmap.Reconstruction(tmp_path / "sparse/0")
    assert written.compute_num_observations() == observations
    written.update_point_3d_errors()
    assert written.compute_mean_reprojection_error() < 1e-6
