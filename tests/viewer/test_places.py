"""Places in a viewer, without a browser: who sees them, how they are measured, and where buttons lead."""

from __future__ import annotations

from dataclasses import replace
from unittest.mock import MagicMock

import numpy as np
import pytest
import torch

from support.captures import camera_at
from support.hand_made_models import opaque_plane
from support.viewer_scene import PLACE
from vdgs.geometry.camera import Camera
from vdgs.rendering.camera_paths import look_at_pose
from vdgs.viewer import navigation, overlays, viewer_scene
from vdgs.viewer.layers import DisplayOptions, Painter
from vdgs.viewer.measure_panel import MeasurePanel
from vdgs.viewer.measurement import MeasuredPoint, Ruler
from vdgs.viewer.picking import measured_point, pick_point, pick_position, thumbnail
from vdgs.viewer.point_panel import PointPanel
from vdgs.viewer.viewer_scene import ViewerScene

pytestmark = pytest.mark.xdist_group("viewer_scene")


@pytest.mark.parametrize(("x", "y"), [(2.05, 2.13), (-1.71, 0.94), (0.33, -0.41)])
def test_a_clicked_pixel_is_the_place_that_it_shows(scene, x, y):
    camera = camera_at(0.2, -0.3, 6.0, tilt=15.0, width=640)
    height = 1.5 if max(abs(x), abs(y)) < 0.8 else 0.0
    pixel, _ = camera.project(np.array([[x, y, height]]))
    found = pick_position(scene.model("merged"), camera, *pixel[0])
    assert found is not None
    again, _ = camera.project(found[None])
    assert np.abs(again - pixel).max() < 1e-6
    assert np.linalg.norm(found[:2] - [x, y]) < 6.0 / camera.fx  # a pixel on the ground
    assert abs(found[2] - height) < 0.05  # depth is that of a splat's center
    assert pick_position(scene.model("merged"), camera_at(50, 50), 3.0, 3.0) is None
    assert pick_position(scene.model("merged"), camera, -1.0, 3.0) is None


def test_a_place_knows_who_sees_it_and_what_stands_between(scene):
    place = pick_point(scene, "merged", np.array([0.3, -0.2, 0.0]))  # below the roof
    lies_in = [view for view in scene.capture.views if view.camera.in_frustum(place.position[None])[0]]
    assert len(place.hits) == len(lies_in)
    assert place.visibility == sum(view.split == "train" for view in lies_in)
    assert not any(sight.unoccluded for sight in place.hits if sight.name == "4.png")
    above = pick_point(scene, "merged", np.array([0.3, -0.2, 1.5]))
    assert all(sight.unoccluded for sight in above.hits)
    assert [s.ground_sampling for s in above.hits] == sorted(s.ground_sampling for s in above.hits)
    assert above.block == 2
    assert above.coordinates[0] == "east 0.30, north -0.20, up 1.50 m (ground frame)"
    latitude, longitude = (float(part.strip(" °")) for part in above.coordinates[1].split(",")[:2])
    assert (latitude, longitude) == pytest.approx(PLACE[:2], abs=1e-5)


def test_blocks_are_those_that_the_scene_was_merged_from(scene, monkeypatch):
    """Which with rule `max-visibility` are not always the owners."""
    monkeypatch.setattr(viewer_scene, "block_lookup", lambda run, blocks: lambda places: np.full(len(places), 1))
    seen = ViewerScene(scene.run, scene._open)
    seen.__dict__["blocks"] = scene.blocks
    assert pick_point(seen, "merged", np.array([0.3, -0.2, 1.5])).block == 1
    assert len(seen.block_tint("merged").unique(dim=0)) == 1


def test_what_has_faded_is_neither_met_nor_measured_nor_compared(scene):
    """A shred above all cameras, which none of them sees: clicks, colors of depth and errors are of what is shown."""
    whole, camera = scene.model("merged"), camera_at(0.0, 0.0, 8.0)
    lifted = opaque_plane(half=0.8).anchors
    lifted = replace(lifted, positions=lifted.positions + torch.tensor([0.0, 0.0, 5.0]))
    tensors = {name: torch.cat([t, lifted.tensors()[name]]) for name, t in whole.anchors.tensors().items()}
    model = replace(whole, anchors=type(whole.anchors)(**tensors))
    shredded = ViewerScene(replace(scene.run, model=model), scene._open)
    middle, session = (camera.width / 2, camera.height / 2), MagicMock()
    session.scene, session.camera, session.pose = shredded, camera, navigation.CameraPose(camera.position, np.zeros(3))
    session.submit.side_effect = lambda work: work()
    panel = PointPanel(session)
    panel.measure_panel, panel.clock = MagicMock(is_on=False), lambda: 0.0
    for least, height in ((0, 5.0), (2, 1.5)):
        session.display = DisplayOptions("depth", min_visibility=least)
        measured = measured_point(shredded, "merged", camera, *middle, min_visibility=least)
        assert measured is not None
        assert measured.position[2] == pytest.approx(height, abs=0.05)
        for _ in range(2):
            panel.on_click((0.5, 0.5))
        assert session.move_to.call_args.args[0].look_at[2] == pytest.approx(height, abs=0.05)
        painter = Painter(shredded)
        painter.update_depth_range(session.display, camera)
        assert (painter.scale(session.display).low < 5.0) == (least == 0)
        error = painter._comparison.error_map("merged", camera, camera, least)
        assert np.isfinite(error[camera.height // 2, camera.width // 2]) == (least == 2)
    point = np.array([0.0, 0.0, 1.5])
    assert all(hit.unoccluded for hit in pick_point(shredded, "merged", point, min_visibility=2).hits)


def test_a_thumbnail_marks_the_place(scene):
    sight = pick_point(scene, "merged", np.array([0.3, -0.2, 1.5])).hits[0]
    small = thumbnail(scene, sight)
    assert max(small.shape[:2]) == 320
    red = (small[..., 0] > 200) & (small[..., 1] < 120) & (small[..., 2] < 100)
    # Half of the photograph each way, cut about the place as far as the photograph reaches.
    camera, (x, y) = scene.capture.views[sight.index].camera, sight.pixel
    left = int(np.clip(x - camera.width / 4, 0, camera.width / 2))
    top = int(np.clip(y - camera.height / 4, 0, camera.height / 2))
    scale = 320 / (camera.width / 2)
    wanted = (y - top) * scale, (x - left) * scale
    assert abs(wanted[0] - wanted[1]) > 10
    assert np.argwhere(red).mean(axis=0) == pytest.approx(wanted, abs=2)


def test_a_ruler_measures(scene):
    ruler = Ruler("m")
    for corner in ((0, 0, 0), (3, 4, 0), (3, 4, 2)):
        ruler.add(MeasuredPoint(np.array(corner, float), 0.1))
    assert (ruler.distance(), ruler.height_difference()) == (7.0, 2.0)
    assert ruler.distance_deviation() == pytest.approx(0.1 * 6**0.5)  # the point in the middle moves both segments
    assert "± 0.24" in ruler.to_markdown()
    ruler.clear()
    for corner in ((0, 0, 5), (2, 0, 1), (2, 3, 0), (0, 3, 0)):
        ruler.add(MeasuredPoint(np.array(corner, float)))
    clockwise = Ruler("m")
    clockwise.clicked = ruler.clicked[::-1]
    assert clockwise.area() == ruler.area() == 6.0
    assert "area **6.00 m²**" in ruler.to_markdown()


def test_a_measured_point_lies_where_its_photographs_show_it(scene):
    camera = camera_at(0.4, 0.3)
    point = measured_point(scene, "merged", camera, 30.0, 20.0)
    assert point is not None
    assert 0 < point.deviation < 0.5
    views = {view.name: view.camera for view in scene.capture.views}
    assert 2 <= len(point.rays) <= 8
    for name, x, y in point.rays:
        there = views[name].camera_from_world @ [*point.position, 1.0]
        assert (there[0] / there[2], there[1] / there[2]) == pytest.approx((x, y), abs=1e-9)


def test_lines_lie_where_cameras_and_borders_are(scene):
    lines, colors = overlays.camera_frusta(scene)
    assert lines.shape == (8 * 9, 2, 3)
    assert colors.shape == lines.shape
    assert np.allclose(lines[:4, 0], scene.capture.views[0].camera.position, atol=1e-5)
    corners, _ = scene.capture.views[0].camera.project(lines[:4, 1].astype(float))
    assert corners == pytest.approx(np.array([[0, 0], [64, 0], [64, 48], [0, 48]]), abs=0.01)
    lines, _ = overlays.block_borders(scene)
    assert np.abs(lines[..., :2]).max() == pytest.approx(4.0)
    assert lines[..., 2].min() >= -0.1
    assert len(overlays.sparse_points(scene)[0]) == len(scene.capture.points)


# ------------------------------------------------------------------------------------- where one stands


def test_buttons_lead_where_they_say(scene):
    stand = navigation.overview_pose(scene.capture)
    whole = Camera(
        camera_from_world=look_at_pose(stand.position, stand.look_at),
        fx=500.0,
        fy=500.0,
        cx=320.0,
        cy=240.0,
        width=640,
        height=480,
    )
    assert all(whole.in_frustum(np.array([[x, y, 0.0]]))[0] for x in (-1.5, 1.5) for y in (-1.5, 1.5))
    above = navigation.top_down_pose(stand)
    assert np.allclose(above.look_at, stand.look_at)
    assert np.linalg.norm(above.position[:2] - above.look_at[:2]) < 0.01 * above.distance
    east = navigation.CameraPose(np.array([5.0, 0.0, 3.0]), np.zeros(3))
    north = navigation.north_up_pose(east)
    assert north.position == pytest.approx(np.array([0.0, -5.0, 3.0]))
    near = navigation.zoom_to(east, np.array([1.0, 1.0, 0.0]))
    assert near.distance < east.distance
    taken = camera_at(1.0, 2.0, 4.0, 0.0, 30.0)
    there = navigation.pose_from_camera(taken, 4.0)
    looking = Camera(
        camera_from_world=look_at_pose(there.position, there.look_at), fx=64.0, fy=64.0, cx=32.0, cy=24.0, width=64,
        height=48,
    )  # fmt: skip
    assert np.allclose(looking.camera_from_world, taken.camera_from_world, atol=0.02)  # its upper edge stays up


def test_a_distance_that_is_saved_again_replaces_the_first(scene):
    session = MagicMock(scene=scene)
    session.client.gui.add_number.return_value = meters = MagicMock(value=10.0)
    panel = MeasurePanel(session)
    for z in (0.0, 4.0):
        panel.add(MeasuredPoint(np.array([0.0, 0.0, z]), rays=(("a.jpg", 0.1, 0.2), ("b.jpg", 0.3, z))))
    panel.save()
    meters.value = 12.0
    panel.save()
    assert [each.meters for each in panel.known] == [12.0]
    (name, text), _ = session.client.send_file_download.call_args
    assert (name, text.decode().count("ray")) == ("known-distances.txt", 4 + 1)  # the first line names the form
