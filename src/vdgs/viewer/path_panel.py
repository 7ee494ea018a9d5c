"""The part of the panel for a camera path: set key frames, play it, save it for `vdgs render --path`."""

from __future__ import annotations

import threading
import time

import numpy as np

from vdgs.geometry.camera import Camera
from vdgs.rendering.camera_paths import DEFAULT_SECONDS
from vdgs.viewer.keyframes import camera_at_time, path_json
from vdgs.viewer.navigation import CameraPose
from vdgs.viewer.session_protocol import SessionProtocol

#: Pictures a second while a path is played.
_PLAYBACK_FPS = 15.0
_FILE_NAME = "path.json"


class PathPanel:
    """The key frames of one visitor."""

    def __init__(self, session: SessionProtocol) -> None:
        self._visitor = session
        self.keyframes: list[Camera] = []
        self._stopping: threading.Event | None = None
        gui = session.client.gui
        with gui.add_folder("Camera path", expand_by_default=False):
            self._words = gui.add_markdown("No key frames yet.")
            frames = gui.add_button_group("Key frame", ("Add", "Remove last"))
            self._seconds = gui.add_number("Seconds", DEFAULT_SECONDS, min=0.5, max=600.0, step=0.5)
            self._closed = gui.add_checkbox("Closed", False, hint="Come back to the first key frame")
            acts = gui.add_button_group("Path", ("Play", "Stop", "Save"))
        frames.on_click(lambda _: self.add() if frames.value == "Add" else self.remove_last())
        acts.on_click(lambda _: {"Play": self.play, "Stop": self.stop, "Save": self.save}[acts.value]())

    def add(self) -> None:
        """The present view becomes the next key frame."""
        if self._visitor.camera is not None:
            self.keyframes.append(self._visitor.camera)
        self._update_label()

    def remove_last(self) -> None:
        del self.keyframes[-1:]
        self._update_label()

    def _update_label(self) -> None:
        count = len(self.keyframes)
        self._words.content = f"{count} key frame{'' if count == 1 else 's'}." if count else "No key frames yet."

    def to_json(self) -> str:
        """The file. Raises ValueError without key frames."""
        return path_json(self.keyframes, float(self._seconds.value), bool(self._closed.value))

    def save(self) -> None:
        """Let the browser download the path."""
        if not self.keyframes:
            self._visitor.notify("No key frames", "Add key frames first.")
            return
        self._visitor.client.send_file_download(_FILE_NAME, self.to_json().encode())

    def play(self) -> None:
        """Move along the path, as fast as the film will."""
        if len(self.keyframes) < 2:
            self._visitor.notify("Too few key frames", "A path is played between two key frames or more.")
            return
        self.stop()
        stopping = self._stopping = threading.Event()
        frames, seconds, closed = list(self.keyframes), float(self._seconds.value), bool(self._closed.value)

        def along() -> None:
            began = time.monotonic()
            while not stopping.wait(1.0 / _PLAYBACK_FPS):
                now = time.monotonic() - began
                self._move_camera(camera_at_time(frames, seconds, now, closed))
                if now >= seconds:
                    return

        threading.Thread(target=along, name="path", daemon=True).start()

    def stop(self) -> None:
        if self._stopping is not None:
            self._stopping.set()

    def _move_camera(self, camera: Camera) -> None:
        distance = self._visitor.pose.distance
        fov = 2.0 * float(np.arctan(0.5 * camera.height / camera.fy))
        self._visitor.move_to(CameraPose(camera.position.copy(), camera.position + distance * camera.forward), fov)
