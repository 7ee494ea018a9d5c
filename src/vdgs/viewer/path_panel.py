"""The part of the panel for a camera path: set key frames, play the path, save it for `vdgs render --path`."""

from __future__ import annotations

import json
import threading
import time
from collections.abc import Sequence

import numpy as np

from vdgs.geometry.camera import Camera
from vdgs.rendering.camera_paths import DEFAULT_FPS, DEFAULT_SECONDS, interpolate
from vdgs.viewer.navigation import CameraPose
from vdgs.viewer.session_protocol import SessionProtocol
from vdgs.viewer.visitor_work import PathWork

#: Frames a second while a path is played.
_PLAYBACK_FPS = 15.0
#: Width of a video at most (choice).
_MAX_WIDTH = 1920
_FILE_NAME = "path.json"


class PathPanel:
    """The key frames of one client."""

    def __init__(self, session: SessionProtocol) -> None:
        self._session = session
        self.keyframes: list[Camera] = []
        self._stopping: threading.Event | None = None
        gui = session.client.gui
        with gui.add_folder("Camera path", expand_by_default=False):
            self._label = gui.add_markdown("No key frames yet.")
            frames = gui.add_button_group("Key frame", ("Add", "Remove last"))
            self._seconds = gui.add_number("Seconds", DEFAULT_SECONDS, min=0.5, max=600.0, step=0.5)
            self._closed = gui.add_checkbox("Closed", False, hint="Come back to the first key frame")
            actions = gui.add_button_group("Path", ("Play", "Stop", "Save"))
        frames.on_click(lambda _: self.add() if frames.value == "Add" else self.remove_last())
        actions.on_click(lambda _: {"Play": self.play, "Stop": self.stop, "Save": self.save}[actions.value]())

    def add(self) -> None:
        """Make the present view the next key frame."""
        if self._session.camera is not None:
            self.keyframes.append(self._session.camera)
        self._update_label()

    def work(self) -> PathWork:
        return PathWork(tuple(self.keyframes), float(self._seconds.value), bool(self._closed.value))

    def restore(self, work: PathWork) -> None:
        """Go on with the path of an earlier visit."""
        self.keyframes = list(work.keyframes)
        self._seconds.value, self._closed.value = work.seconds, work.closed
        self._update_label()

    def remove_last(self) -> None:
        del self.keyframes[-1:]
        self._update_label()

    def _update_label(self) -> None:
        count = len(self.keyframes)
        self._label.content = f"{count} key frame{'' if count == 1 else 's'}." if count else "No key frames yet."

    def save(self) -> None:
        """Let the browser download the path."""
        if not self.keyframes:
            self._session.notify("No key frames", "Add key frames first.")
            return
        text = path_json(self.keyframes, float(self._seconds.value), bool(self._closed.value))
        self._session.client.send_file_download(_FILE_NAME, text.encode(), save_immediately=True)

    def play(self) -> None:
        """Move along the path, as fast as the video will."""
        if len(self.keyframes) < 2:
            self._session.notify("Too few key frames", "A path is played between two key frames or more.")
            return
        self.stop()
        stopping = self._stopping = threading.Event()
        seconds = float(self._seconds.value)
        path = video_cameras(self.keyframes, seconds, bool(self._closed.value))

        def follow() -> None:
            began = time.monotonic()
            while not stopping.wait(1.0 / _PLAYBACK_FPS):
                now = time.monotonic() - began
                self._move_camera(camera_at_time(path, now))
                if now >= seconds:
                    return

        threading.Thread(target=follow, name="path", daemon=True).start()

    def stop(self) -> None:
        if self._stopping is not None:
            self._stopping.set()

    def _move_camera(self, camera: Camera) -> None:
        distance = self._session.pose.distance
        fov = 2.0 * float(np.arctan(0.5 * camera.height / camera.fy))
        self._session.move_to(CameraPose(camera.position.copy(), camera.position + distance * camera.forward), fov)


def path_json(keyframes: Sequence[Camera], seconds: float, closed: bool = False, fps: float = DEFAULT_FPS) -> str:
    """The text of a camera path in the ground frame, of the size of its first key frame: others, of a window of another
    shape, keep how high they see. Numbers keep all digits.

    Raises ValueError without key frames.
    """
    if not keyframes:
        raise ValueError("a camera path needs at least one key frame")
    first = keyframes[0].limit_size(_MAX_WIDTH)
    width, height = (max(2, size // 2 * 2) for size in (first.width, first.height))
    content = {
        "frame": "ground", "seconds": seconds, "fps": fps, "closed": closed, "interpolate": True,
        "keyframes": [_keyframe_json(camera.reshaped(width, height)) for camera in keyframes],
    }  # fmt: skip
    return json.dumps(content, indent=1) + "\n"


def _keyframe_json(camera: Camera) -> dict[str, object]:
    return {
        "camera_from_world": camera.camera_from_world.tolist(), "fx": camera.fx, "fy": camera.fy, "cx": camera.cx,
        "cy": camera.cy, "width": camera.width, "height": camera.height,
    }  # fmt: skip


def video_cameras(keyframes: Sequence[Camera], seconds: float, closed: bool = False) -> list[Camera]:
    """The cameras of a path, as the video will have them."""
    return interpolate(keyframes, max(1, round(seconds * DEFAULT_FPS)), closed)


def camera_at_time(path: Sequence[Camera], time: float) -> Camera:
    """The one of `video_cameras` after so many seconds."""
    return path[min(max(int(time * DEFAULT_FPS), 0), len(path) - 1)]
