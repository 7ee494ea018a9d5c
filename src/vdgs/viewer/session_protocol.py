"""What the parts of a visitor's panel ask of the visitor."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, Protocol

from vdgs.geometry.camera import Camera
from vdgs.viewer.layers import Shown
from vdgs.viewer.navigation import Stand
from vdgs.viewer.viewer_scene import Scene


class Host(Protocol):
    """A visitor (`visitor.Visitor`)."""

    #: Their browser, as viser knows it.
    client: Any
    scene: Scene

    @property
    def camera(self) -> Camera | None: ...
    @property
    def shown(self) -> Shown: ...
    @property
    def stand(self) -> Stand: ...

    def go(self, stand: Stand, fov: float | None = None) -> None: ...
    def look_from(self, index: int) -> None: ...
    def notify(self, title: str, body: str) -> None: ...
    def errand(self, do: Callable[[], Any]) -> Any: ...
