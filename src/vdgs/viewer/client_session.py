"""One client: its camera, what it shows, and its panel."""

from __future__ import annotations

import threading
from collections.abc import Callable
from concurrent.futures import CancelledError
from dataclasses import replace
from typing import Any

import numpy as np
from rich.console import Console

from vdgs.captures.first_view import FOV_DEG
from vdgs.errors import VdgsError
from vdgs.geometry.camera import Camera
from vdgs.system.memory.process_memory import available_memory_bytes
from vdgs.viewer import navigation, overlays
from vdgs.viewer.layers import LAYERS, DisplayOptions, Layer, Painter
from vdgs.viewer.navigation import CameraPose
from vdgs.viewer.path_panel import PathPanel
from vdgs.viewer.point_panel import PointPanel
from vdgs.viewer.render_scheduler import RenderedFrame, RenderScheduler
from vdgs.viewer.viewer_scene import ViewerScene
from vdgs.viewer.visitor_work import VisitorWork
from vdgs.visibility.visibility_counts import FADE_BELOW

#: Labels of the layers in the panel.
LAYER_LABELS: dict[str, Layer] = {
    "Color": "color", "Depth": "depth", "V: cameras that see it": "visibility", "Alpha: how opaque": "alpha",
    "Blocks": "blocks", "Error against nearest photograph": "error",
}  # fmt: skip
MODEL_LABELS = {"Merged": "merged", "Coarse": "coarse", "Side by side": "both"}
#: JPEG quality of previews and of full images.
_PREVIEW_QUALITY, _FULL_QUALITY = 70, 92
_LEGEND_PX = 300
#: The end of the slider that leaves out what few photographs show.
_MAX_MIN_VISIBILITY = 10
#: Farther from where a photograph was taken than this share of the camera height, it no longer lies over the model.
_IMAGE_POSE_TOLERANCE = 2e-3


class ClientSession:
    """Connects one browser to the scheduler. Callbacks of the browser come in any thread."""

    def __init__(self, client: Any, scene: ViewerScene, scheduler: RenderScheduler, console: Console) -> None:
        self.client, self.scene, self.scheduler, self._console = client, scene, scheduler, console
        self._lock = threading.RLock()
        self._display = DisplayOptions(model=scene.names[0])
        self._camera: Camera | None = None
        # The canvas that the first view was fitted to last; None: as the server lets every browser begin.
        self._fitted: tuple[int, int] | None = None
        self._is_at_first_view = True
        # Fixed for the session: with another limit at every move, a camera at rest would seem to move.
        self._max_pixels = navigation.max_render_pixels(available_memory_bytes())
        self._arrived = False
        self._legend_key: object = None
        self.painter = Painter(scene)
        self._render_session = scheduler.add_session(self.painter, self._send_frame, self._on_render_error)
        self._build()
        client.camera.on_update(lambda _: self._on_browser_moved())
        client.scene.on_click()(lambda event: self.point_panel.on_click(event.screen_pos))
        height = scene.camera_height
        client.camera.min_orbit_distance, client.camera.max_orbit_distance = 1e-3 * height, 200 * height
        self._on_browser_moved()

    @property
    def camera(self) -> Camera | None:
        """The camera at the size of the canvas, or the largest that is drawn."""
        return self._camera

    @property
    def display(self) -> DisplayOptions:
        return self._display

    @property
    def pose(self) -> CameraPose:
        return CameraPose(np.array(self.client.camera.position), np.array(self.client.camera.look_at))

    def change_display(self, **changes: Any) -> None:
        """Show something else from the same camera."""
        with self._lock:
            self._display = replace(self._display, **changes)
            if self._camera is not None:
                self.scheduler.request_frame(self._render_session, self._camera, self._display)

    def move_to(self, pose: CameraPose, fov: float | None = None) -> None:
        camera = self.client.camera
        with self.client.atomic():
            camera.up_direction, camera.position = (0.0, 0.0, 1.0), tuple(pose.position)
            camera.look_at = tuple(pose.look_at)
            if fov is not None:
                camera.fov = float(fov)
        self._on_camera_moved(from_browser=False)

    def work(self) -> VisitorWork:
        """What this visit leaves."""
        return VisitorWork(
            self.pose, float(self.client.camera.fov), self.path_panel.work(), self.point_panel.measure_panel.work()
        )

    def restore(self, work: VisitorWork, moves: bool) -> None:
        """Go on with what an earlier visit left, and from where it stood if `moves`."""
        self.path_panel.restore(work.path)
        self.point_panel.measure_panel.restore(work.measures)
        if moves:
            self.move_to(work.pose, work.fov)
        if not work.is_empty:
            self.notify("Connected again", "Key frames, clicked places and known distances are as they were.")

    def view_image(self, index: int) -> None:
        """Move to the camera of a photograph, with the photograph over the model."""
        camera, height = self.scene.capture.views[index].camera, self.scene.camera_height
        with self._lock:
            self._arrived = False
            self._display = replace(self._display, image_index=index)
            self._image_split.visible = True
        fov = navigation.fov_to_fit(camera, self.client.camera.aspect)
        self.move_to(navigation.pose_from_camera(camera, height), fov)

    def on_model_changed(self) -> None:
        """The run has a newer model."""
        model, several = self._display.model, len(self.scene.names) > 1
        self._model_choice.visible = several
        self._legend_key = None
        self.change_display(model=model if several and model == "both" else self.scene.shown_name(model))

    def set_progress(self, progress: str) -> None:
        self._progress.content = progress
        self._training.visible = bool(progress)

    def close(self) -> None:
        self.path_panel.stop()
        self.scheduler.remove_session(self._render_session)

    def _on_camera_moved(self, from_browser: bool = True) -> None:
        """Draw for the camera that the browser has now; after `move_to` it may still send older ones for a while."""
        state = self.client.camera
        try:
            camera = navigation.camera_from_browser(
                state.wxyz, state.position, state.fov, int(state.image_width), int(state.image_height)
            )
        except (ValueError, AssertionError):  # a canvas that is just being laid out
            return
        camera = navigation.limit_resolution(camera, self._max_pixels)
        with self._lock:
            if self._camera is not None and is_same_view(camera, self._camera):
                return  # the camera rests
            self._camera = camera
            if from_browser:
                self._hide_image_if_left(camera)
            self.scheduler.request_frame(self._render_session, camera, self._display)

    def _on_browser_moved(self) -> None:
        self._on_camera_moved()
        # A canvas without pixels is one that is just being laid out, or hidden.
        if self._is_at_first_view and self._camera is not None and self._canvas != self._fitted and all(self._canvas):
            self._fit_first_view()

    def _fit_first_view(self) -> None:
        """All browsers begin where a wide window shows all: in one that is higher than wide, or where the panel would
        cover a part, one must stand farther away or aside, and so again where the canvas changes before anybody moves
        (it is laid out in steps). Where an address names another first view, that stays."""
        canvas, first = self._canvas, self.scene.first_view
        begin = first if self._fitted is None else navigation.fitted_pose(first, self._fitted)
        self._is_at_first_view = np.allclose(self.pose.position, begin.position, atol=1e-3 * begin.distance)
        if not self._is_at_first_view:
            return
        fitted = navigation.fitted_pose(first, canvas)
        self._fitted = canvas
        if not np.allclose(fitted.position, begin.position, atol=1e-6 * begin.distance):
            self.move_to(fitted)

    @property
    def _canvas(self) -> tuple[int, int]:
        """Width and height in pixels."""
        return int(self.client.camera.image_width), int(self.client.camera.image_height)

    def _hide_image_if_left(self, camera: Camera) -> None:
        index = self._display.image_index
        if index is None:
            return
        distance = float(np.linalg.norm(self.scene.capture.views[index].camera.position - camera.position))
        if distance <= _IMAGE_POSE_TOLERANCE * self.scene.camera_height:
            self._arrived = True
        elif self._arrived:
            self._display = replace(self._display, image_index=None)
            self._image_split.visible = False

    def _send_frame(self, frame: RenderedFrame) -> None:
        """Send an image, and its legend once the camera rests. Runs in the thread of the scheduler."""
        quality = _FULL_QUALITY if frame.is_full else _PREVIEW_QUALITY
        self.client.scene.set_background_image(frame.image, format="jpeg", jpeg_quality=quality)
        self.client.flush()
        if frame.is_full:
            self._show_legend(frame.display)

    def _show_legend(self, display: DisplayOptions) -> None:
        scale = self.painter.scale(display)
        if scale is None:
            self._legend.visible = False
            return
        key = (display.layer, display.model, scale.low, scale.high)
        if self._legend_key != key:
            from vdgs.rendering.scalar_maps import draw_colorbar

            self._legend.image, self._legend_key = np.ascontiguousarray(draw_colorbar(scale, _LEGEND_PX, 0)), key
        self._legend.visible = True

    def _on_render_error(self, error: Exception) -> None:
        """Report why a view cannot be drawn, and show colors again."""
        self.notify("This cannot be drawn", str(error))
        if not isinstance(error, VdgsError):
            self._console.print(f"[yellow]warning[/] a picture could not be drawn: {error!r}", highlight=False)
        if self._display.layer != "color" or self._display.image_index is not None:
            self._layer_choice.value = next(iter(LAYER_LABELS))
            self.change_display(layer="color", image_index=None)

    def notify(self, title: str, body: str) -> None:
        self.client.add_notification(title, body, auto_close_seconds=8.0)

    def submit(self, function: Callable[[], Any]) -> Any:
        """Run a function in the thread of the scheduler; None, with a notification, where it raises VdgsError."""
        try:
            return self.scheduler.submit(function).result()
        except VdgsError as error:
            self.notify("This cannot be shown", str(error))
        except CancelledError:
            pass  # the scheduler closes
        return None

    def _build(self) -> None:
        gui = self.client.gui
        self._layer_choice = gui.add_dropdown(
            "Layer", tuple(LAYER_LABELS), hint=f"What is drawn: one of {len(LAYERS)} layers"
        )
        self._layer_choice.on_update(lambda _: self.change_display(layer=LAYER_LABELS[self._layer_choice.value]))
        self._legend = gui.add_image(np.full((2, _LEGEND_PX, 3), 255, np.uint8), format="png", visible=False)
        several = len(self.scene.names) > 1
        self._model_choice = gui.add_dropdown("Model", tuple(MODEL_LABELS), visible=several)
        self._model_choice.on_update(lambda _: self._choose_model())
        self._model_split = gui.add_slider("Coarse | merged", 0.0, 1.0, 0.01, 0.5, visible=False)
        self._model_split.on_update(lambda _: self.change_display(split=float(self._model_split.value)))
        self._image_split = gui.add_slider("Photograph | model", 0.0, 1.0, 0.01, 0.5, visible=False)
        self._image_split.on_update(lambda _: self.change_display(image_split=float(self._image_split.value)))
        trust = gui.add_slider(
            "Seen by at least",
            0,
            _MAX_MIN_VISIBILITY,
            1,
            FADE_BELOW,
            hint="Fade out where fewer photographs show the scene: its edge; 0: draw all",
        )
        trust.on_update(lambda _: self.change_display(min_visibility=int(trust.value)))
        marks = gui.add_checkbox(
            "Where trust ends", False, hint="Color what one photograph or none shows red, what two show yellow"
        )
        marks.on_update(lambda _: self.change_display(mark_trust=bool(marks.value)))
        self._build_views()
        self._build_overlays()
        self.point_panel = PointPanel(self)
        self.path_panel = PathPanel(self)
        self._training = gui.add_folder("Training", visible=False)
        with self._training:
            self._progress = gui.add_markdown("")

    def _choose_model(self) -> None:
        model = MODEL_LABELS[self._model_choice.value]
        self._model_split.visible = model == "both"
        self.change_display(model=model)

    def _build_views(self) -> None:
        gui = self.client.gui
        buttons = gui.add_button_group("Go to", ("All", "From above", "North up"))

        @buttons.on_click
        def _(_: Any) -> None:
            poses: dict[str, Callable[[], CameraPose]] = {
                "All": lambda: navigation.overview_pose(self.scene.capture, self._canvas, whole=True),
                "From above": lambda: navigation.top_down_pose(self.pose),
                "North up": lambda: navigation.north_up_pose(self.pose),
            }
            self.move_to(poses[buttons.value](), np.radians(FOV_DEG))

    def _build_overlays(self) -> None:
        gui = self.client.gui
        with gui.add_folder("Over it"):
            self._checkbox("Block borders", self._add_borders)
            self._checkbox("Cameras", lambda: self._add_lines("cameras", overlays.camera_frusta, 1.5))
            self._checkbox("Sparse points", self._add_points)

    def _checkbox(self, name: str, add: Callable[[], Any]) -> None:
        box = self.client.gui.add_checkbox(name, False)
        handles: list[Any] = []

        @box.on_update
        def _(_: Any) -> None:
            while handles:
                handles.pop().remove()
            if box.value and (handle := add()) is not None:
                handles.append(handle)

    def _add_borders(self) -> Any:
        lines = self._add_lines("borders", overlays.block_borders, 3.0)
        if lines is None:
            self.notify("No borders", "The scene is not cut into blocks.")
        return lines

    def _add_lines(self, name: str, make: Callable[[ViewerScene], overlays.LineSegments], width: float) -> Any:
        lines = self.submit(lambda: make(self.scene))
        if lines is None or not len(lines[0]):
            return None
        return self.client.scene.add_line_segments(f"/{name}", *lines, thickness=width, thickness_units="screen")

    def _add_points(self) -> Any:
        points, colors = overlays.sparse_points(self.scene)
        size = 2e-3 * self.scene.camera_height
        return self.client.scene.add_point_cloud("/points", points, colors, point_size=size, precision="float32")


def is_same_view(one: Camera, other: Camera) -> bool:
    """Whether two cameras show the same: to less than a hundredth of a pixel, at any size of a screen."""
    if (one.width, one.height) != (other.width, other.height) or abs(one.fy / other.fy - 1) > 1e-7:
        return False
    return np.allclose(one.camera_from_world, other.camera_from_world, rtol=1e-7, atol=1e-7)
