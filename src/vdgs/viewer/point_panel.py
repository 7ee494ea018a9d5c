"""The part of the panel about a clicked place: where it is, who sees it, and their photographs to look from."""

from __future__ import annotations

import threading
import time
from functools import partial
from typing import Any

import numpy as np

from vdgs.captures.camera_height import camera_height
from vdgs.viewer import navigation
from vdgs.viewer.measurement import Ruler
from vdgs.viewer.picking import PickedPoint, pick_point, pick_position, thumbnail
from vdgs.viewer.session_protocol import SessionProtocol

_HINT = "Click a place to see what is known of it; double click to turn about it."
#: Two clicks within so many seconds, so near to each other (share of the canvas), are a double click.
_DOUBLE_CLICK_SECONDS, _DOUBLE_CLICK_DISTANCE = 0.45, 0.01
#: Photographs shown of a place.
_THUMBNAILS = 4


class PointPanel:
    """Answers clicks of one visitor."""

    def __init__(self, session: SessionProtocol) -> None:
        self._visitor = session
        self._folder = session.client.gui.add_folder("Place")
        self._things: list[Any] = []
        self._ruler = Ruler(session.scene.capture.ground.unit)
        self._place: PickedPoint | None = None
        with self._folder:
            self._words = session.client.gui.add_markdown(_HINT)
        self._measuring = False
        self.clock = time.monotonic
        self._lock = threading.Lock()
        #: Held while a place is shown: clicks come on several threads, and a folder takes one of them at a time.
        self._showing = threading.Lock()
        self._last: tuple[float, float, float] | None = None
        self._build_measuring()

    def on_click(self, screen: tuple[float, float]) -> None:
        """A click at a share of the canvas' width and height. A double click turns about the place from then on."""
        visitor, camera = self._visitor, self._visitor.camera
        if camera is None:
            return
        double = self._is_double(screen)
        name = visitor.display.model if visitor.display.model in visitor.scene.names else visitor.scene.names[0]
        x, y = screen[0] * camera.width, screen[1] * camera.height
        position = visitor.submit(lambda: pick_position(visitor.scene.model(name), camera, x, y))
        if position is None:
            self._words.content = "Nothing is drawn there."
            return
        if double and not self._measuring:
            visitor.move_to(navigation.CameraPose(visitor.pose.position, position))
            return
        if self._measuring:
            self._measure(position)
            return
        place = visitor.submit(lambda: pick_point(visitor.scene, name, position))
        if place is not None:
            with self._showing:
                self._show_point(place)

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
        visitor = self._visitor
        self._clear()
        self._place = point
        self._words.content = point_markdown(point)
        radius = 0.008 * float(np.linalg.norm(point.position - visitor.pose.position))
        self._things.append(
            visitor.client.scene.add_icosphere("/place", radius, color=(255, 60, 40), position=tuple(point.position))
        )
        gui = visitor.client.gui
        with self._folder:
            go = gui.add_button_group("Here", ("Orbit", "Zoom in"))
            self._things.append(go)
            go.on_click(lambda _: self._navigate(go.value))
            for sight in point.hits[:_THUMBNAILS]:
                picture = visitor.submit(partial(thumbnail, visitor.scene, sight))
                if picture is None:
                    continue
                label = sight.name + ("" if sight.unoccluded else " (hidden there)")
                self._things.append(gui.add_image(picture, label=label, format="jpeg", jpeg_quality=85))
                button = gui.add_button("Look from there", hint=sight.name)
                button.on_click(lambda _, index=sight.index: visitor.view_image(index))
                self._things.append(button)

    def _navigate(self, how: str) -> None:
        place, stand = self._place, self._visitor.pose
        if place is None:
            return
        if how == "Orbit":
            self._visitor.move_to(navigation.CameraPose(stand.position, place.position))
        else:
            self._visitor.move_to(navigation.zoom_to(stand, place.position))

    def _clear(self) -> None:
        while self._things:
            self._things.pop().remove()

    # ------------------------------------------------------------------------------------- measuring

    def _build_measuring(self) -> None:
        gui = self._visitor.client.gui
        with gui.add_folder("Measure", expand_by_default=False):
            switch = gui.add_checkbox("Clicks measure", False, hint="Distance, height and area between clicked places")
            self._measured = gui.add_markdown("")
            again = gui.add_button("Begin again")
        self._line: Any = None

        @switch.on_update
        def _(_: Any) -> None:
            self._measuring = bool(switch.value)

        @again.on_click
        def _(_: Any) -> None:
            self._ruler.clear()
            self._show_measure()

    def _measure(self, position: np.ndarray) -> None:
        self._ruler.add(position)
        self._show_measure()

    def _show_measure(self) -> None:
        if self._line is not None:
            self._line.remove()
            self._line = None
        self._measured.content = self._ruler.to_markdown()
        points = self._ruler.points()
        if len(points) == 1:
            radius = 4e-3 * camera_height(self._visitor.scene.capture)
            self._line = self._visitor.client.scene.add_icosphere(
                "/measure", radius, color=(255, 220, 0), position=tuple(points[0])
            )
        elif len(points) > 1:
            segments = np.stack([points[:-1], points[1:]], axis=1).astype(np.float32)
            self._line = self._visitor.client.scene.add_line_segments(
                "/measure", segments, (255, 220, 0), thickness=3.0, thickness_units="screen"
            )


def point_markdown(point: PickedPoint) -> str:
    """What is known of a place, in Markdown."""
    free = sum(sight.unoccluded for sight in point.hits)
    hidden = len(point.hits) - free
    lines = [*point.coordinates, f"**V = {point.visibility}** training cameras have it in their picture"]
    lines.append(f"{free} photographs see it freely" + (f", {hidden} with something in between" if hidden else ""))
    if point.block is not None:
        lines.append(f"block {point.block}")
    return "\n\n".join(lines)
