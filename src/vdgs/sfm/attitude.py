"""Where a camera looked, by what the drone recorded: axes of the camera in east, north, up."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np


@dataclass(frozen=True, eq=False)
class Attitude:
    """Rows of `camera_from_enu` [3, 3] are the camera's right, down and forward as east, north, up."""

    camera_from_enu: np.ndarray

    @property
    def tilt_deg(self) -> float:
        """Angle between the view and straight down."""
        return float(np.degrees(np.arccos(np.clip(-self.camera_from_enu[2, 2], -1, 1))))

    @property
    def gravity(self) -> np.ndarray:
        """Straight down in the camera's axes, unit [3]."""
        return -self.camera_from_enu[:, 2]


def of_gimbal(yaw_deg: float, pitch_deg: float, roll_deg: float) -> Attitude:
    """Yaw is clockwise from north, pitch -90 is straight down, roll turns the picture about the view."""
    yaw, pitch, roll = np.radians([yaw_deg, pitch_deg, roll_deg])
    forward = np.array([np.sin(yaw) * np.cos(pitch), np.cos(yaw) * np.cos(pitch), np.sin(pitch)])
    right = np.array([np.cos(yaw), -np.sin(yaw), 0.0])
    down = np.cross(forward, right)
    return Attitude(
        np.stack([np.cos(roll) * right + np.sin(roll) * down, np.cos(roll) * down - np.sin(roll) * right, forward])
    )


def of_aircraft(heading_deg: float, pitch_deg: float, roll_deg: float) -> Attitude:
    """A camera fixed to an aircraft, looking down, its top forwards; pitch is nose up, roll right wing down."""
    h, p, r = np.radians([heading_deg, pitch_deg, roll_deg])
    about_down = np.array([[np.cos(h), -np.sin(h), 0], [np.sin(h), np.cos(h), 0], [0, 0, 1]])
    about_wing = np.array([[np.cos(p), 0, np.sin(p)], [0, 1, 0], [-np.sin(p), 0, np.cos(p)]])
    about_nose = np.array([[1, 0, 0], [0, np.cos(r), -np.sin(r)], [0, np.sin(r), np.cos(r)]])
    nose, wing, belly = (about_down @ about_wing @ about_nose).T  # in north, east, down
    enu = np.array([[0, 1, 0], [1, 0, 0], [0, 0, -1]])
    return Attitude(np.stack([wing, -nose, belly]) @ enu)
