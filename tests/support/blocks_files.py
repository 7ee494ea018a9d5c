"""BlocksExchange XML of a known flight, by Bentley's description of format and camera models."""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence

import numpy as np

from support.true_flight import ORIGIN, Lens, TrueFlight, angles_of
from vdgs.geometry.geodesy import enu_axes, geodetic_from_enu

#: What BlocksExchange can say of a lens: three radial terms, no skew.
PLAIN = Lens(b1=0.0, b2=0.0, k=(-0.09, -0.076, 0.116, 0.0))
#: x right and y down from the axes that CameraOrientation names.
ORIENTATIONS = {
    "XRightYDown": np.eye(3),
    "XRightYUp": np.diag([1.0, -1, -1]),
    "XLeftYUp": np.diag([-1.0, -1, 1]),
    "XDownYRight": np.array([[0.0, 1, 0], [1, 0, 0], [0, 0, -1]]),
    "XUpYRight": np.array([[0.0, 1, 0], [-1, 0, 0], [0, 0, 1]]),
}


def in_system(flight: TrueFlight, code: str, height_unit: float = 1.0) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Rotations, centres and points in a projected or geographic system: each place by itself, heights in a unit of so
    many metres, each rotation about the axes that the system has there (east and north of the grid, up)."""
    import pyproj

    crs = pyproj.CRS(code)
    change = pyproj.Transformer.from_crs("EPSG:4326", crs, always_xy=True)

    def moved(points: np.ndarray) -> np.ndarray:
        geodetic = geodetic_from_enu(points, ORIGIN)
        return np.column_stack([*change.transform(geodetic[:, 1], geodetic[:, 0]), geodetic[:, 2] / height_unit])

    rotations = []
    for rotation, place in zip(flight.rotations, geodetic_from_enu(flight.centers, ORIGIN), strict=True):
        here = enu_axes(place[0], place[1]) @ enu_axes(*ORIGIN[:2]).T  # east, north, up there from those of ORIGIN
        turn = 0.0
        if crs.is_projected:
            turn = math.radians(pyproj.Proj(crs).get_factors(place[1], place[0]).meridian_convergence)
        grid = np.array([[math.cos(turn), -math.sin(turn), 0], [math.sin(turn), math.cos(turn), 0], [0, 0, 1]])
        rotations.append(rotation @ (grid @ here).T)
    return np.stack(rotations), moved(flight.centers), moved(flight.points)


def tags(names: Iterable[str], values: Iterable[float]) -> str:
    return "".join(f"<{name}>{float(value)!r}</{name}>" for name, value in zip(names, values, strict=True))


def blocks_xml(
    flight: TrueFlight, system: str | None = "EPSG:32632", *, angles: bool | str = False,
    orientation: str = "XRightYDown", in_millimeters: bool = False, tie_points: bool = True,
    paths: Sequence[str] | None = None, more: str = "", rolls: str = "clockwise", height_unit: float = 1.0,
) -> str:  # fmt: skip
    """A block, version 2.1; `system` None or of the kind ENU: metres as the flight has them. Of
    `angles` those called "roll" are Yaw, Pitch and Roll, which `rolls` cameras so, seen from behind."""
    mapped = system is not None and system.startswith(("EPSG", "+proj"))
    rotations, centers, points = (
        in_system(flight, str(system), height_unit) if mapped else (flight.rotations, flight.centers, flight.points)
    )
    paths = paths or [f"D:\\flights\\{name}".replace("/", "\\") for name in flight.names]
    photos = []
    for index, path in enumerate(paths):
        axes = ORIENTATIONS[orientation].T @ rotations[index]
        matrix = tags([f"M_{row}{column}" for row in range(3) for column in range(3)], axes.ravel())
        turned = tags(("Omega", "Phi", "Kappa"), angles_of(axes)) if angles else matrix
        if angles == "roll":
            turned = _yaw_pitch_roll(axes, 1 if rolls == "clockwise" else -1)
        photos.append(
            f"<Photo><Id>{index + 10}</Id><ImagePath>{path}</ImagePath><Component>1</Component><Pose><Rotation>{turned}"
            f"</Rotation><Center>{tags('xyz', centers[index])}</Center></Pose><NearDepth>80</NearDepth></Photo>"
        )
    srs = f"<SRS><Id>7</Id><Name>the system</Name><Definition>{system}</Definition></SRS>" if system else ""
    return (
        '<?xml version="1.0" encoding="utf-8"?>\n<BlocksExchange version="2.1">'
        f"<SpatialReferenceSystems>{srs}</SpatialReferenceSystems><BaseImagePath>D:\\flights</BaseImagePath><Block>"
        f"<Name>b</Name><Type>Aerial</Type>{'<SRSId>7</SRSId>' if system else ''}<Photogroups><Photogroup>"
        f"<Name>UCX</Name>{camera(flight.lens, orientation, in_millimeters)}{''.join(photos)}</Photogroup>{more}"
        "</Photogroups><ControlPoints><ControlPoint><Position><x>1</x><y>2</y></Position></ControlPoint>"
        f"</ControlPoints>{_tie_points(flight, points) if tie_points else ''}</Block></BlocksExchange>"
    )


def _yaw_pitch_roll(axes: np.ndarray, clockwise: int) -> str:
    """Of a camera with the axes right, down, forward: its right side is lower where it rolls clockwise."""
    right, forward = axes[0], axes[2]
    level = np.cross(forward, [0.0, 0.0, 1.0])
    level /= np.linalg.norm(level)
    roll = math.atan2(right @ np.cross(forward, level), right @ level)
    angles = math.atan2(forward[0], forward[1]), math.asin(forward[2]), clockwise * roll
    return tags(("Yaw", "Pitch", "Roll"), np.degrees(angles))


def camera(lens: Lens, orientation: str = "XRightYDown", in_millimeters: bool = False) -> str:
    """What a photogroup says of its lens, in pixels or in millimetres of the sensor."""
    pixel = 13.2 / lens.size[0]
    if in_millimeters:
        across = ORIENTATIONS[orientation][:2, :2].T @ [lens.cx * pixel, lens.cy * pixel]
        inner = tags(("SensorSize", "FocalLength"), (13.2, lens.f * pixel))
        inner += f"<PrincipalPoint>{tags(('xmm', 'ymm'), across)}</PrincipalPoint>"
    else:  # from the centre of the first pixel
        center = lens.size[0] / 2 + lens.cx - 0.5, lens.size[1] / 2 + lens.cy - 0.5
        inner = f"{tags(['FocalLengthPixels'], [lens.f])}<PrincipalPoint>{tags('xy', center)}</PrincipalPoint>"
    bends = tags(("K1", "K2", "K3", "P1", "P2"), (*lens.k[:3], *lens.p))
    return (
        f"<ImageDimensions><Width>{lens.size[0]}</Width><Height>{lens.size[1]}</Height></ImageDimensions>"
        f"<CameraModelType>Perspective</CameraModelType>{inner}<CameraOrientation>{orientation}</CameraOrientation>"
        f"<Distortion>{bends}</Distortion>"
    )


def _tie_points(flight: TrueFlight, points: np.ndarray) -> str:
    seen: dict[int, list[str]] = {}
    for index in range(len(flight.names)):
        for pixel, number in zip(*flight.pixels(index), strict=True):
            measured = f"<PhotoId>{index + 10}</PhotoId>{tags('xy', pixel - 0.5)}"
            seen.setdefault(int(number), []).append(f"<Measurement>{measured}</Measurement>")
    color = tags(("Red", "Green", "Blue"), (1.0, 0.5, 0.0))
    each = (
        f"<TiePoint><Position>{tags('xyz', point)}</Position><Color>{color}</Color>{''.join(seen.get(number, []))}"
        "</TiePoint>"
        for number, point in enumerate(points)
    )
    return f"<TiePoints>{''.join(each)}</TiePoints>"
