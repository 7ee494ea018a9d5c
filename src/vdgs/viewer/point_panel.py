"""The part of the panel about clicked points: where one is, which images see it, and the measures between them."""

from __future__ import annotations

import threading
import time
from functools import partial
from typing import Any

import numpy as np

from vdgs.viewer import navigation
from vdgs.viewer.measure_panel import MeasurePanel
from vdgs.viewer.picking import PickedPoint, measured_point, pick_point, pick_position, thumbnail
from vdgs.viewer.session_protocol import SessionProtocol

_HINT = "Click a place to see what is known of it; double click to turn about it."
_NOTHING = "Nothing is drawn there."
#: Two clicks within so many seconds, so near to each other (share of the canvas), are a double click.
_DOUBLE_CLICK_SECONDS, _DOUBLE_CLICK_DISTANCE = 0.45, 0.01
#: Images shown of a point.
_THUMBNAILS = 4


class PointPanel:
    """Answers clicks of one client."""

    def __init__(self, session: SessionProtocol) -> None:
        self._session = session
        self._folder = session.client.gui.add_folder("Place")
        self._handles: list[Any] = []
        self._point: PickedPoint | None = None
        with self._folder:
            self._label = session.client.gui.add_markdown(_HINT)
        self.clock = time.monotonic
        self._lock = threading.Lock()
        #: Held while a point is shown: clicks come on several threads, and a folder takes one of them at a time.
        self._showing = threading.Lock()
        self._last: tuple[float, float, float] | None = None
        self.measure_panel = MeasurePanel(session)

    def on_click(self, screen: tuple[float, float]) -> None:
        """A click at a share of the canvas' width and height. A double click turns about the point from then on."""
        session, camera = self._session, self._session.camera
        if camera is None:
            return
        is_double = self._is_double(screen)
        scene, display = session.scene, session.display
        name, least = scene.shown_name(display.model), display.min_visibility
        x, y = screen[0] * camera.width, screen[1] * camera.height
        if self.measure_panel.is_on:
            measured = session.submit(lambda: measured_point(scene, name, camera, x, y, min_visibility=least))
            if measured is not None:
                self.measure_panel.add(measured)
            else:
                self._label.content = _NOTHING
            return
        position = session.submit(lambda: pick_position(scene.shown(name, min_visibility=least), camera, x, y))
        if position is None:
            self._label.content = _NOTHING
        elif is_double:
            session.move_to(navigation.CameraPose(session.pose.position, position))
        else:
            point = session.submit(lambda: pick_point(scene, name, position, min_visibility=least))
            if point is not None:
                with self._showing:
                    self._show_point(point)

    def _is_double(self, screen: tuple[float, float]) -> bool:
        """Whether this click is the second of two; a third one begins anew."""
        now, (x, y) = self.clock(), screen
        with self._lock:
            last, self._last = self._last, (now, x, y)
            if (
                last is None
                or now - last[0] > _DOUBLE_CLICK_SECONDS
                or np.hypot(x - last[1], y - last[2]) > _DOUBLE_CLICK_DISTANCE
            ):
                return False
            self._last = None
            return True

    def _show_point(self, point: PickedPoint) -> None:
        session, position = self._session, tuple(point.position)
        while self._handles:
            self._handles.pop().remove()
        self._point = point
        self._label.content = point_markdown(point)
        radius = 0.008 * float(np.linalg.norm(point.position - session.pose.position))
        marker = session.client.scene.add_icosphere("/place", radius, color=(255, 60, 40), position=position)
        self._handles.append(marker)
        gui = session.client.gui
        with self._folder:
            go = gui.add_button_group("Here", ("Orbit", "Zoom in"))
            self._handles.append(go)
            go.on_click(lambda _: self._navigate(go.value))
            for hit in point.hits[:_THUMBNAILS]:
                image = session.submit(partial(thumbnail, session.scene, hit))
                if image is None:
                    continue
                label = hit.name + ("" if hit.unoccluded else " (hidden there)")
                self._handles.append(gui.add_image(image, label=label, format="jpeg", jpeg_quality=85))
                button = gui.add_button("Look from there", hint=hit.name)
                button.on_click(lambda _, index=hit.index: session.view_image(index))
                self._handles.append(button)

    def _navigate(self, how: str) -> None:
        if self._point is not None:
            pose, target = self._session.pose, self._point.position
            orbit = navigation.CameraPose(pose.position, target)
            self._session.move_to(orbit if how == "Orbit" else navigation.zoom_to(pose, target))


def point_markdown(point: PickedPoint) -> str:
    """What is known of a point, in Markdown."""
    free = sum(hit.unoccluded for hit in point.hits)
    hidden = f", {len(point.hits) - free} with something in between" if free < len(point.hits) else ""
    block = [] if point.block is None else [f"block {point.block}"]
    visibility = f"**V = {point.visibility}** training cameras have it in their picture"
    return "\n\n".join([*point.coordinates, visibility, f"{free} photographs see it freely{hidden}", *block])
