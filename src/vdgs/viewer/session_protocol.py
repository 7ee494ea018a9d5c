"""What the parts of a client's panel need of its session."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, Protocol

from vdgs.geometry.camera import Camera
from vdgs.viewer.layers import DisplayOptions
from vdgs.viewer.navigation import CameraPose
from vdgs.viewer.viewer_scene import ViewerScene


class SessionProtocol(Protocol):
    """`client_session.ClientSession`."""

    #: The browser, as viser knows it.
    client: Any
    scene: ViewerScene

    @property
    def camera(self) -> Camera | None: ...
    @property
    def display(self) -> DisplayOptions: ...
    @property
    def pose(self) -> CameraPose: ...

    def move_to(self, pose: CameraPose, fov: float | None = None) -> None: ...
    def view_image(self, index: int) -> None: ...
    def notify(self, title: str, body: str) -> None: ...
    def submit(self, function: Callable[[], Any]) -> Any: ...
