"""Metashape's cameras.xml of a known flight, by its manual and files that it wrote."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from support.true_flight import ORIGIN, Lens, TrueFlight, omega_phi_kappa, words
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
