"""The part of the panel that measures: clicked places, what lies between them, and known distances as a file."""

from __future__ import annotations

import math
import threading
from typing import Any

import numpy as np

from vdgs.captures.known_distances import MIN_OBSERVATIONS, MOST_APART
from vdgs.system.quoting import shell_word
from vdgs.viewer.measurement import SCALE_BAR_FILE, KnownDistance, MeasuredPoint, Ruler, known_distances_text
from vdgs.viewer.session_protocol import SessionProtocol
from vdgs.viewer.visitor_work import MeasureWork

_COLOR = (255, 220, 0)


class MeasurePanel:
    """The ruler of one client. Files go to its browser as a download: no visitor writes on the server."""

    def __init__(self, session: SessionProtocol) -> None:
        self._session, self._line = session, None
        self.ruler = Ruler(session.scene.capture.ground.unit)
        self.known: list[KnownDistance] = []
        #: Held while measures change: clicks come on several threads.
        self._showing = threading.Lock()
        gui = session.client.gui
        with gui.add_folder("Measure", expand_by_default=False):
            self._switch = gui.add_checkbox("Clicks measure", False, hint="Distance, height and area between places")
            self._measured = gui.add_markdown("")
            actions = gui.add_button_group("Points", ("Begin again",))
            self._meters = gui.add_number("Known metres", 0.0, min=0.0, hint="How far the two clicked places are apart")
            save = gui.add_button("Save known distance", hint="A file that --scale-bar takes")
            self._command = gui.add_markdown("")
        actions.on_click(lambda _: self.clear())
        save.on_click(lambda _: self.save())

    @property
    def is_on(self) -> bool:
        """Whether clicks measure."""
        return bool(self._switch.value)

    def add(self, point: MeasuredPoint) -> None:
        with self._showing:
            self.ruler.add(point)
            self._show()

    def clear(self) -> None:
        with self._showing:
            self.ruler.clear()
            self._show()

    def work(self) -> MeasureWork:
        with self._showing:
            return MeasureWork(tuple(self.ruler.clicked), tuple(self.known), self.is_on)

    def restore(self, work: MeasureWork) -> None:
        """Go on with the measures of an earlier visit."""
        with self._showing:
            self.ruler.clicked, self.known, self._switch.value = list(work.clicked), list(work.known), work.is_on
            self._show()
            self._show_command()

    def save(self) -> None:
        """Let the browser download all distances that were said to be known, with the one between the clicked places;
        or tell what is missing."""
        points, meters = self.ruler.clicked, float(self._meters.value or 0.0)
        if len(points) != 2 or not self.ruler.distance() > 0:
            self._session.notify("Two places", "Click the two places whose distance you know, no more.")
        elif not (math.isfinite(meters) and meters > 0):
            self._session.notify("No distance", "Say how many metres the two places are apart.")
        elif min(len(point.rays) for point in points) < MIN_OBSERVATIONS:
            self._session.notify("Too few photographs", "Two photographs at least must show each place freely.")
        else:
            # Saved again, a distance takes the place of what was said of it before.
            others = [each for each in self.known if (each.one, each.other) != tuple(points)]
            self.known = [*others, KnownDistance(points[0], points[1], meters)]
            text = known_distances_text(self.known)
            self._session.client.send_file_download(SCALE_BAR_FILE, text.encode(), save_immediately=True)
            self._show_command()

    def _show_command(self) -> None:
        if self.known:
            self._command.content = scale_markdown(self.known, self._session.scene.capture.root.name)

    def _show(self) -> None:
        if self._line is not None:
            self._line.remove()
            self._line = None
        self._measured.content = self.ruler.to_markdown()
        points, scene = self.ruler.points(), self._session.client.scene
        added: Any = None
        if len(points) == 1:
            radius = 4e-3 * self._session.scene.camera_height
            added = scene.add_icosphere("/measured place", radius, color=_COLOR, position=tuple(points[0]))
        elif len(points) > 1:
            line = np.stack([points[:-1], points[1:]], axis=1).astype(np.float32)
            # Of another name than the place: browsers keep the position of a name.
            added = scene.add_line_segments("/measured line", line, _COLOR, thickness=3.0, thickness_units="screen")
        self._line = added


def scale_markdown(known: list[KnownDistance], capture: str) -> str:
    """What known distances say of the scene, and the command that takes their file, in Markdown."""
    scales = [each.meters_per_unit for each in known]
    mean = math.exp(sum(map(math.log, scales)) / len(scales))
    apart = max(abs(scale / mean - 1) for scale in scales)
    lines = [f"{len(known)} known: a unit of this scene is **{mean:.4g} m**"]
    if apart > 0:
        lines[0] += f"; they differ from that by up to {100 * apart:.2g} %"
    if apart > MOST_APART:
        lines.append("**They contradict each other**: look at places and metres again.")
    lines += [
        f"`vdgs run {shell_word(capture)} --scale-bar {SCALE_BAR_FILE} --output NEW-RUN`",
        f"begins a run in metres. A capture by `vdgs sfm` is placed anew in seconds: `vdgs sfm PHOTOGRAPHS --output "
        f"{shell_word(capture)} --scale-bar {SCALE_BAR_FILE}`",
    ]
    return "\n\n".join(lines)
