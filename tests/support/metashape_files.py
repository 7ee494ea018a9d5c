"""Metashape's cameras.xml of a known flight, by its manual and files that it wrote."""

from __future__ import annotations

import zipfile
from pathlib import Path

import numpy as np

from support.true_flight import ORIGIN, Lens, TrueFlight, omega_phi_kappa, words
from vdgs.captures.formats.source_capture import SourceCapture
from vdgs.captures.project_formats import read_project
from vdgs.config.capture_options import CaptureOptions
from vdgs.geometry.geodesy import ecef_from_geodetic, enu_axes

WGS84 = (
    'GEOGCS["WGS 84",DATUM["World Geodetic System 1984",SPHEROID["WGS 84",6378137,298.257223563]],'
    'PRIMEM["Greenwich",0],UNIT["degree",0.01745329251994328],AUTHORITY["EPSG","4326"]]'
)
LOCAL = 'LOCAL_CS["Local Coordinates (m)",LOCAL_DATUM["Local Datum",0],UNIT["metre",1]]'
INITIAL = ' class="initial"'
#: The chunk's own world: scaled, turned, moved.
CHUNK_SCALE = 12.354
CHUNK_ROTATION = omega_phi_kappa(31.0, -22.0, 130.0)
CHUNK_ORIGIN = np.array([3.0, -40.0, 25.0])


def chunk_from_enu(points: np.ndarray) -> np.ndarray:
    return (points - CHUNK_ORIGIN) @ CHUNK_ROTATION / CHUNK_SCALE


def metashape_calibration(lens: Lens, kind: str = "frame", which: str = ' class="adjusted"') -> str:
    values = {"f": lens.f, "cx": lens.cx, "cy": lens.cy, "b1": lens.b1, "b2": lens.b2, "p1": lens.p[0], "p2": lens.p[1]}
    values |= {f"k{n}": k for n, k in enumerate(lens.k, 1)} | {"p3": lens.growth[0], "p4": lens.growth[1]}
    text = "".join(f"<{name}>{value!r}</{name}>" for name, value in values.items() if value)
    size = f'<resolution width="{lens.size[0]}" height="{lens.size[1]}"/>'
    return f'<calibration type="{kind}"{which}>{size}{text}</calibration>'


def metashape_cameras(flight: TrueFlight, attributes: str = 'sensor_id="0" component_id="0"') -> str:
    """Cameras labelled as Metashape does, by the file's name alone, in groups named as the folders."""
    groups: dict[str, list[str]] = {}
    for index, name in enumerate(flight.names):
        pose = np.eye(4)
        pose[:3, :3] = (flight.rotations[index] @ CHUNK_ROTATION).T
        pose[:3, 3] = chunk_from_enu(flight.centers[index])
        groups.setdefault(Path(name).parent.name, []).append(
            f'<camera id="{index}" {attributes} label="{Path(name).stem}"><transform>{words(pose)}</transform>'
            '<orientation>1</orientation><reference x="11.9" y="48.1" z="640" enabled="1"/></camera>'
        )
    return "".join(
        f'<group id="{n}" label="{label}" type="folder">{"".join(cameras)}</group>'
        for n, (label, cameras) in enumerate(groups.items())
    )


def metashape_transform(reference: str) -> str:
    rotation, translation = CHUNK_ROTATION, CHUNK_ORIGIN
    if reference != LOCAL:
        axes = enu_axes(*ORIGIN[:2]).T
        rotation, translation = axes @ rotation, axes @ translation + ecef_from_geodetic(np.array([ORIGIN]))[0]
    return (
        f'<transform><rotation locked="true">{words(rotation)}</rotation><translation locked="true">'
        f'{words(translation)}</translation><scale locked="true">{CHUNK_SCALE}</scale></transform>'
    )


def metashape_xml(
    flight: TrueFlight, *, reference: str = WGS84, sensors: str | None = None, cameras: str | None = None,
    transform: str | None = None,
) -> str:  # fmt: skip
    """cameras.xml of version 2.0."""
    sensor = (
        '<sensor id="0" label="FC6310, 8.8mm" type="frame">'
        f'<resolution width="{flight.lens.size[0]}" height="{flight.lens.size[1]}"/>'
        f'<property name="layer_index" value="0"/><bands><band label="Red"/></bands><data_type>uint8</data_type>'
        f"{metashape_calibration(Lens(f=3000.0), which=INITIAL)}{metashape_calibration(flight.lens)}"
        "<covariance><params>f cx</params><coeffs>1 0 0 1</coeffs></covariance></sensor>"
    )
    placed = metashape_transform(reference) if transform is None else transform
    cameras = metashape_cameras(flight) if cameras is None else cameras
    return (
        '<?xml version="1.0" encoding="UTF-8"?>\n<document version="2.0.0"><chunk label="Chunk 1" enabled="true">'
        f'<sensors next_id="1">{sensors if sensors is not None else sensor}</sensors>'
        f'<components next_id="1" active_id="0"><component id="0" label="Component 1">{placed}'
        "<region><center>0 0 0</center><size>1 1 1</size><R>1 0 0 0 1 0 0 0 1</R></region></component></components>"
        f'<cameras next_id="9" next_group_id="2">{cameras}</cameras>'
        f"<reference>{reference.replace('&', '&amp;')}</reference><region><center>0 0 0</center></region>"
        '<frames next_id="1"><frame id="0"><markers/></frame></frames></chunk></document>'
    )


def read_export(root: Path, xml: str, flight: TrueFlight, options: CaptureOptions | None = None) -> SourceCapture:
    """The export beside the photographs, read without points."""
    flight.touch(root)
    (root / "cameras.xml").write_text(xml, encoding="utf-8")
    return read_project(root, "metashape", options or CaptureOptions(), needs_points=False)


def metashape_rig(flight: TrueFlight, lens: Lens, bands: str = "Red") -> tuple[str, TrueFlight]:
    """cameras.xml in which each photograph has a slave, whose sensor looks 20° aside; and the flight of the slaves."""
    turn, place = omega_phi_kappa(20.0, 0.0, 3.0).T, np.array([0.4, -0.1, 0.2])
    rotations = np.stack([turn.T @ rotation for rotation in flight.rotations])
    centers = flight.centers + np.einsum("nji,j->ni", flight.rotations, place)
    names = [name.replace("DJI", "SIDE") for name in flight.names]
    sensor = (
        f'<sensor id="1" label="side" type="frame" master_id="0"><bands><band label="{bands}"/></bands>'
        f"{metashape_calibration(lens)}<rotation>{words(turn)}</rotation>"
        f"<location>{words(place / CHUNK_SCALE)}</location></sensor>"
    )
    slaves = "".join(
        f'<camera id="{100 + index}" sensor_id="1" master_id="{index}" label="{Path(name).stem}"/>'
        for index, name in enumerate(names)
    )
    xml = metashape_xml(flight, cameras=metashape_cameras(flight) + slaves).replace("</sensors>", f"{sensor}</sensors>")
    return xml, TrueFlight(names, rotations, centers, flight.points, lens)


def write_project(root: Path, flight: TrueFlight, *, suffix: str = ".psx", color_kind: str = "u1") -> Path:
    """A project as the program stores it: a document that points to a folder of zips, or one zip; with tie points,
    whose colors are of 8 or 16 bits."""
    xml = metashape_xml(flight)
    chunk = xml[xml.index("<chunk") : xml.index("</document>")].replace("<frame id", '<frame path="0/frame.zip" id')
    photos = "".join(
        f'<camera camera_id="{index}"><photo path="../../../{name}"/></camera>'
        for index, name in enumerate(flight.names)
    )
    lists = _tie_points(flight, color_kind)
    counted = "".join(f'<projections camera_id="{k}" path="p{k}.ply"/>' for k in range(len(flight.names)))
    cloud = f'<point_cloud><tracks path="tracks.ply"/><points path="points0.ply"/>{counted}</point_cloud>'
    head = '<?xml version="1.0" encoding="UTF-8"?>\n'
    file = root / f"project{suffix}"
    if suffix == ".psz":
        chunk = chunk.replace("<markers/>", f"<cameras>{photos}</cameras>{cloud}")
        chunks = f'{head}<document version="1.2.0"><chunks active_id="0">{chunk}</chunks></document>'
        return _zip(file, {"doc.xml": chunks, **lists})
    folder = root / "project.files"
    (folder / "0" / "0" / "point_cloud").mkdir(parents=True)
    file.write_text(f'{head}<document version="1.2.0" path="{{projectname}}.files/project.zip"/>')
    listed = '<chunks next_id="1" active_id="0"><chunk id="0" path="0/chunk.zip"/></chunks>'
    _zip(folder / "project.zip", {"doc.xml": f'{head}<document version="1.2.0">{listed}</document>'})
    _zip(folder / "0" / "chunk.zip", {"doc.xml": head + chunk})
    _zip(folder / "0" / "0" / "frame.zip", {"doc.xml": f"{head}<frame><cameras>{photos}</cameras></frame>"})
    _zip(folder / "0" / "0" / "point_cloud" / "point_cloud.zip", {"doc.xml": head + cloud, **lists})
    return file


def _tie_points(flight: TrueFlight, color_kind: str) -> dict[str, bytes]:
    """Lists of points in the chunk's coordinates, and of their pixels in each photograph."""
    numbers = np.arange(len(flight.points), dtype="<u4")
    places = chunk_from_enu(flight.points).astype("<f4")
    steps = np.iinfo(color_kind).max // 255
    lists = {
        "points0.ply": _ply({**dict(zip("xyz", places.T, strict=True)), "id": numbers}),
        "tracks.ply": _ply(
            {
                name: np.full(len(numbers), (10 + k) * steps, color_kind)
                for k, name in enumerate(("red", "green", "blue"))
            }
        ),
    }
    for index in range(len(flight.names)):
        pixels, seen = flight.pixels(index)
        x, y = pixels.astype("<f4").T
        lists[f"p{index}.ply"] = _ply({"x": x, "y": y, "size": np.ones_like(x), "id": seen.astype("<u4")})
    return lists


def _ply(columns: dict[str, np.ndarray]) -> bytes:
    kinds = {"f4": "float", "u4": "uint", "u2": "ushort", "u1": "uchar"}
    listed = "".join(f"property {kinds[column.dtype.str[1:]]} {name}\n" for name, column in columns.items())
    count = len(next(iter(columns.values())))
    records = np.rec.fromarrays(list(columns.values()), names=list(columns))
    head = f"ply\nformat binary_little_endian 1.0\nelement vertex {count}\n{listed}end_header\n"
    return head.encode() + records.tobytes()


def _zip(file: Path, members: dict[str, str | bytes]) -> Path:
    with zipfile.ZipFile(file, "w", zipfile.ZIP_DEFLATED) as archive:
        for name, content in members.items():
            archive.writestr(name, content)
    return file
