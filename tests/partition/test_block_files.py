"""The files of blocks: damaged and missing ones are named, and on the map they lie where they are."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import shapely
from shapely.affinity import translate

from vdgs.errors import RunError
from vdgs.geometry.geodesy import enu_from_geodetic, geodetic_from_enu
from vdgs.geometry.ground_frame import GroundFrame
from vdgs.partition.blocks import Block, Blocks, load_blocks, save_blocks, save_blocks_wgs84


@pytest.mark.parametrize(
    "damage",
    [
        lambda text: text[: len(text) // 2],
        lambda text: text.replace('"core"', '"kernel"', 1),
        lambda text: text.replace("Polygon", "Point"),
        lambda text: text.replace("Polygon", "Blob"),
        lambda text: '{"type": "FeatureCollection", "features": []}',
        lambda text: "[1, 2]",
        lambda text: "\udcff",
        lambda text: text.replace("2.0", "NaN"),
    ],
)
def test_a_damaged_file_is_named(tmp_path: Path, damage: object) -> None:
    file = tmp_path / "blocks.geojson"
    box = shapely.box(0, 0, 2, 1)
    save_blocks(file, Blocks((Block(box, box.buffer(1)),)), [{}])
    file.write_bytes(damage(file.read_text()).encode(errors="surrogateescape"))  # type: ignore[operator]
    with pytest.raises(RunError, match=r"blocks\.geojson: is damaged .*vdgs partition RUN"):
        load_blocks(file)


def test_a_missing_file_is_named(tmp_path: Path) -> None:
    with pytest.raises(RunError, match=r"blocks\.geojson: is not there.*vdgs partition RUN"):
        load_blocks(tmp_path / "blocks.geojson")


@pytest.mark.parametrize("origin", [(47.3, 8.5, 440.0), (-17.0, 179.9999, 20.0), (-33.9, -70.6, 900.0)])
def test_blocks_on_the_map(tmp_path: Path, origin: tuple[float, float, float]) -> None:
    ring = shapely.box(-400, -300, 500, 300).difference(shapely.box(-50, -50, 60, 50))
    hole = shapely.box(-50, -50, 60, 50)
    blocks = Blocks((Block(ring, ring.buffer(40)), Block(hole, hole.buffer(10))))
    ground = GroundFrame(
        scale=1.0, rotation=np.eye(3), translation=np.zeros(3), metric=True, description="GPS", origin_geo=origin
    )
    save_blocks_wgs84(tmp_path / "map.geojson", blocks, [{}, {}], ground)
    features = json.loads((tmp_path / "map.geojson").read_text())["features"]
    assert [(f["properties"]["block"], f["properties"]["boundary"]) for f in features][1:3] == [
        (0, "expanded"),
        (1, "core"),
    ]
    written = shapely.geometry.shape(features[0]["geometry"])
    assert len(written.interiors) == 1
    assert written.exterior.is_ccw
    assert not written.interiors[0].is_ccw
    corners = shapely.get_coordinates(written)
    back = enu_from_geodetic(np.column_stack([corners[:, ::-1], np.full(len(corners), origin[2])]), origin)[:, :2]
    # Height 0 of the frame is a plane, height `origin` of the map is not: they part by 1 cm half a kilometre away.
    nearest = np.linalg.norm(back[:, None] - shapely.get_coordinates(ring)[None], axis=2).min(axis=1)
    assert nearest.max() < 1e-3
    assert np.ptp(corners[:, 0]) < 0.02
    # A frame whose origin was moved keeps its axes: the same blocks about another origin are in the same place.
    moved = tuple(geodetic_from_enu(np.array([[3000.0, 4000, 0]]), origin)[0])
    away = replace(ground, origin_geo=moved, axes_geo=origin[:2])
    there = Blocks(tuple(Block(*(translate(s, -3000, -4000) for s in (b.core, b.expanded))) for b in blocks.items))
    save_blocks_wgs84(tmp_path / "moved.geojson", there, [{}, {}], away)
    again = json.loads((tmp_path / "moved.geojson").read_text())["features"][0]["geometry"]
    apart = shapely.get_coordinates(shapely.geometry.shape(again)) - corners
    np.testing.assert_allclose((apart + 180) % 360 - 180, 0, atol=1e-9)
    with pytest.raises(ValueError, match="not georeferenced"):
        save_blocks_wgs84(
            tmp_path / "map.geojson",
            blocks,
            [{}, {}],
            GroundFrame(scale=1.0, rotation=np.eye(3), translation=np.zeros(3), metric=True, description="-"),
        )
