"""Maps: every pixel where it says it is, heights of surfaces and of nothing between."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from support.captures import look_down
from support.mapped_house import (
    GROUND,
    HOUSE,
    ROOF,
    TOP,
    capture_of,
    draw_maps,
    model_of,
    surface,
    surveyor_of,
)  # fmt: skip
from vdgs.errors import VdgsError
from vdgs.geometry.camera import Camera
from vdgs.geometry.map_projection import MapProjection
from vdgs.model.decoder import Decoder
from vdgs.model.renderer import render
from vdgs.rendering.ortho import ortho_plan, previews, tile_renderer
from vdgs.rendering.ortho.geotiff import GDAL_CACHE_BYTES, limit_gdal_cache
from vdgs.rendering.ortho.nadir_camera import NadirCamera
from vdgs.rendering.ortho.pixel_grid import TILE_PX, PixelGrid, capture_extent, grid_from_bbox, ground_sampling_distance
from vdgs.rendering.ortho.previews import floor_to_nice_length, hillshade
from vdgs.rendering.ortho.tile_renderer import (
    NODATA_COUNT,
    NODATA_HEIGHT,
    OrthoTile,
    TileRenderer,
    samples_per_side,
)
from vdgs.visibility.visibility_counts import count_visibility

pytestmark = [pytest.mark.xdist_group("ortho"), pytest.mark.slow]

rasterio = pytest.importorskip("rasterio")
pytest.importorskip("pyproj")


@pytest.fixture(scope="module")
def fine(house, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Maps of several levels. Not to be changed."""
    return draw_maps(tmp_path_factory.mktemp("fine") / "run", *house, gsd=0.03)


@pytest.mark.parametrize("crs", ["EPSG:32632", "EPSG:2056", "enu", "local", "source"])
@pytest.mark.parametrize("away", [(0.0, 0.0), (900.0, -700.0)])
def test_every_place_falls_on_its_pixel_to_a_tenth(crs, away):
    """Through the camera that draws a tile, against the exact coordinates; 512 pixels of 4 cm, and 5 m high things."""
    center = np.array([*away, 0.0])
    places = center + np.random.default_rng(1).uniform(-1, 1, (200, 3)) * (10, 10, 5)
    capture = capture_of(places)
    placement = MapProjection.of(capture.ground, crs)
    exact = placement.project(places)
    x, y = placement.project(center[None])[0, :2]
    grid = PixelGrid(float(x) - 10.24, float(y) + 10.24, 0.04, 512, 512)
    pixels, _ = NadirCamera.of(capture, placement).camera(grid).project(places)
    expected = np.stack([(exact[:, 0] - grid.left) / grid.gsd, (grid.top - exact[:, 1]) / grid.gsd], axis=1)
    assert np.abs(pixels - expected).max() < 0.1


def test_files_open_at_the_right_place_with_the_right_heights(house, make):
    capture, model = house
    ortho_folder = make(capture, model, gsd=0.1)
    corners = np.array([[HOUSE[0], HOUSE[1], ROOF], [HOUSE[2], HOUSE[3], ROOF]])
    easting, northing, height = MapProjection.of(capture.ground).project(corners.mean(axis=0, keepdims=True))[0]
    with rasterio.open(ortho_folder / "dsm.tif") as file:
        assert file.crs.to_epsg() == 32632
        heights = file.read(1)
        roof = np.argwhere(heights > height - ROOF / 2)
        middle = file.xy(*roof.T)
    # To a tenth of a pixel: the middle of a roof of 1600 pixels.
    assert np.mean(middle[0]) == pytest.approx(easting, abs=0.01)
    assert np.mean(middle[1]) == pytest.approx(northing, abs=0.01)
    assert np.median(heights[tuple(roof.T)]) == pytest.approx(height, abs=0.02)
    # What a photograph shows in some pixel is there in the map.
    camera = capture.views[2].camera
    depth = render(model, camera, depth=True).median_depth
    place = MapProjection.of(capture.ground).project(camera.unproject(depth.numpy())[24, 32][None])[0]
    with rasterio.open(ortho_folder / "dsm.tif") as file:
        assert file.read(1)[file.index(*place[:2])] == pytest.approx(place[2], abs=0.05)


def test_files_are_cloud_optimized_and_say_what_they_are(fine):
    names = {file.name for file in fine.iterdir()}
    assert names == set(ortho_plan.FILE_NAMES)
    layers = {
        "orthophoto": (4, "uint8", None),
        "dsm": (1, "float32", NODATA_HEIGHT),
        "visibility": (1, "uint16", NODATA_COUNT),
    }
    for name, (count, dtype, nodata) in layers.items():
        with rasterio.open(fine / f"{name}.tif") as file:
            assert (file.count, file.dtypes[0], file.nodata) == (count, dtype, nodata)
            structure = file.tags(ns="IMAGE_STRUCTURE")
            assert (structure["LAYOUT"], structure["COMPRESSION"]) == ("COG", "DEFLATE")
            assert structure["PREDICTOR"] == ("3" if dtype == "float32" else "2")
            assert file.overviews(1)
            assert "ellipsoidal" in file.tags()["HEIGHTS"]
            assert file.tags()["MODEL"] == "coarse"
    with rasterio.open(fine / "dsm.tif") as file:
        assert file.units == ("m",)
        assert "ellipsoidal" in file.descriptions[0]


#: 600 x 100 pixels, so that there are overviews; x rises to the right from 0, in pixels.
STRIP = {"crs": "local", "bbox": (-6.0, -1.0, 6.0, 1.0), "gsd": 0.02}
STRIP_SHAPE = (100, 600)


def strip_tile(grid: PixelGrid) -> OrthoTile:
    """What a tile of `STRIP` shows in the tests below: noise and holes above, a checkerboard without holes below, and
    everywhere a slope of 0.3 to the east."""
    column = round((grid.left - STRIP["bbox"][0]) / grid.gsd) + np.arange(grid.width)
    x, y = np.meshgrid(column, np.arange(grid.height))
    noise, upper = np.random.default_rng(grid.width), y < 50
    colors = np.where(upper[..., None], noise.integers(0, 256, (*x.shape, 3)), ((x + y) % 2 * 255)[..., None])
    shown = ~upper | (noise.random(x.shape) < 0.6)
    return OrthoTile(
        (colors * shown[..., None]).astype(np.uint8), np.where(shown, 255, 0).astype(np.uint8),
        np.where(shown, 0.3 * grid.gsd * x - 1.0, NODATA_HEIGHT).astype(np.float32),
        np.where(shown, noise.integers(2, 9, x.shape), NODATA_COUNT).astype(np.uint16),
    )  # fmt: skip


@pytest.fixture(scope="module")
def strip(house, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Maps of what `strip_tile` says; pictures are a quarter as long. Not to be changed."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(TileRenderer, "render_tile", lambda _, grid: strip_tile(grid))
        patch.setattr(previews, "MAX_IMAGE_PX", 150)
        return draw_maps(tmp_path_factory.mktemp("strip") / "run", *house, **STRIP)


def test_files_hold_what_was_drawn_and_map_json_sums_it_up(strip):
    height, width = STRIP_SHAPE
    drawn = [strip_tile(part) for *_, part in PixelGrid(-6.0, 1.0, 0.02, width, height).tiles()]
    assert len(drawn) == 2
    colors, alpha, heights, visibility = (
        np.concatenate([getattr(tile, name) for tile in drawn], axis=1)
        for name in ("colors", "alpha", "heights", "visibility")
    )
    with rasterio.open(strip / "orthophoto.tif") as file:
        assert [band.name for band in file.colorinterp] == ["red", "green", "blue", "alpha"]
        np.testing.assert_array_equal(file.read(), np.moveaxis(np.dstack([colors, alpha]), -1, 0))
    for name, values in (("dsm", heights), ("visibility", visibility)):
        with rasterio.open(strip / f"{name}.tif") as file:
            np.testing.assert_array_equal(file.read(1), values)
    shown, facts = alpha > 0, json.loads((strip / "map.json").read_text())
    assert facts["mapped_share"] == pytest.approx(shown.mean())
    assert facts["seen_by_fewer_than_5_share"] == pytest.approx((visibility[shown] < 5).mean())
    assert (facts["lowest"], facts["highest"]) == pytest.approx((heights[shown].min(), heights[shown].max()))


def test_overviews_of_an_orthophoto_hold_mean_colors(strip):
    with rasterio.open(strip / "orthophoto.tif", overview_level=0) as file:
        lower = file.read()[:, 26:]
    assert np.abs(lower[:3].astype(int) - 127.5).max() <= 0.5
    assert (lower[3] == 255).all()


def test_pictures_for_people_have_the_colors_and_the_slopes_of_the_map(strip, tmp_path, monkeypatch):
    # Of a map longer than a picture, the light is that of the slope in metres.
    light = np.asarray(Image.open(strip / "hillshade.png"))
    assert light.shape == (25, 150, 4)
    x = np.broadcast_to(np.arange(20.0), (5, 20))
    np.testing.assert_allclose(light[14:-1, 1:-1, 0] / 255, hillshade(0.3 * x, 1.0)[2, 2], atol=0.5 / 255 + 1e-4)
    # Of one that is no longer, the picture is the map.
    monkeypatch.setattr(previews, "MAX_IMAGE_PX", 600)
    previews.write_picture(strip / "orthophoto.tif", tmp_path / "whole.png")
    with rasterio.open(strip / "orthophoto.tif") as file:
        np.testing.assert_array_equal(np.asarray(Image.open(tmp_path / "whole.png")), np.moveaxis(file.read(), 0, -1))


def test_overviews_have_no_height_between_roof_and_street_either(fine):
    for name, nothing in (("dsm", NODATA_HEIGHT), ("visibility", NODATA_COUNT)):
        with rasterio.open(fine / f"{name}.tif") as file:
            whole, factors = file.read(1), file.overviews(1)
        assert factors
        for level in range(len(factors)):
            with rasterio.open(fine / f"{name}.tif", overview_level=level) as file:
                values = file.read(1)
            assert set(np.unique(values)) <= set(np.unique(whole))
            assert (values != nothing).mean() == pytest.approx((whole != nothing).mean(), abs=0.02)


@pytest.mark.parametrize("samples", [1, 3])
def test_walls_do_not_smear(house, samples):
    """No pixel has a height between ground and roof: not at an edge, not where samples are put together."""
    capture, model = house
    surveyor = surveyor_of(model, capture, MapProjection.of(capture.ground, "local"), samples)
    tile = surveyor.render_tile(PixelGrid(-4.0, 5.0, 0.1, 130, 100))
    heights = tile.heights[tile.alpha > 0]
    assert tile.alpha.mean() > 250
    between = (heights > 0.2) & (heights < ROOF - 0.2)
    assert between.mean() < 0.001
    roof = np.count_nonzero(heights > ROOF / 2) * 0.01
    assert roof == pytest.approx((HOUSE[2] - HOUSE[0]) * (HOUSE[3] - HOUSE[1]), rel=0.15)


def test_of_samples_the_height_of_a_pixel_is_the_higher_in_the_middle(house):
    """Of four the second from above: half of the pixel lies as high."""
    capture, model = house
    placement = MapProjection.of(capture.ground, "local")
    grid = PixelGrid(-2.0, 2.0, 0.2, 16, 16)
    each = surveyor_of(model, capture, placement).render_tile(PixelGrid(-2.0, 2.0, 0.1, 32, 32)).heights
    ordered = np.sort(each.reshape(16, 2, 16, 2).swapaxes(1, 2).reshape(16, 16, 4), axis=-1)
    assert (ordered[..., 2] - ordered[..., 1]).mean() > 2e-3
    together = surveyor_of(model, capture, placement, 2).render_tile(grid).heights
    np.testing.assert_allclose(together, ordered[..., 2], atol=1e-4)


def test_what_is_half_transparent_is_as_bright_as_what_is_opaque(house):
    """White splats over nothing: black shows through nowhere."""
    capture, model = house
    tensors = {name: tensor.clone() for name, tensor in model.decoder.tensors().items()}
    for head, bias in (("color", 20.0), ("opacity", 0.2)):
        tensors[f"{head}_w2"].zero_()
        tensors[f"{head}_b2"].fill_(bias)
    sheer = replace(model, decoder=Decoder.from_tensors(tensors))
    camera = NadirCamera.of(capture, placement := MapProjection.of(capture.ground, "local")).camera(
        grid := PixelGrid(-2.0, 2.0, 0.1, 40, 40)
    )
    alpha = render(sheer, camera).alpha.numpy()
    tile = surveyor_of(sheer, capture, placement).render_tile(grid)
    assert 0.5 < alpha[tile.alpha > 0].min() < 0.9
    assert tile.colors[tile.alpha > 0].min() >= 250


def test_more_cameras_than_a_byte_holds_are_counted(house):
    capture, model = house
    crowd = replace(capture, views=tuple(replace(capture.views[1], name=f"{k}.png") for k in range(300)))
    placement = MapProjection.of(capture.ground, "local")
    tile = surveyor_of(model, crowd, placement).render_tile(PixelGrid(-3.0, 1.0, 0.5, 4, 4))
    assert (tile.visibility == 300).all()


def test_a_map_ends_with_the_scene_and_not_with_what_cameras_see_behind_it(house):
    """Photographs of a house from all sides; a tenth of the points lies on hills at the horizon."""
    capture, _ = house
    turns = np.linspace(0, 2 * np.pi, 12, endpoint=False)
    views = tuple(replace(capture.views[0], camera=looking_in(30.0, turn)) for turn in turns)
    hills = np.array([(600 * np.cos(turn), 600 * np.sin(turn), 5.0) for turn in np.linspace(0, 6, len(GROUND) // 9)])
    around, placement = replace(capture, views=views), MapProjection.of(capture.ground, "local")
    assert np.mean([view.camera.in_frustum(hills) for view in views]) > 2 / len(views)  # each is in two and more
    behind = replace(around, points=np.concatenate([capture.points, hills]))
    assert capture_extent(behind, placement) == pytest.approx(capture_extent(around, placement), abs=0.5)


def looking_in(distance: float, turn: float) -> Camera:
    """A camera beside the scene, level, that looks over its middle."""
    out = np.array([np.cos(turn), np.sin(turn), 0.0])
    pose = np.eye(4)
    pose[:3, :3] = [[-out[1], out[0], 0.0], [0.0, 0.0, -1.0], -out]
    pose[:3, 3] = -pose[:3, :3] @ (distance * out + [0, 0, 5.0])
    return Camera(camera_from_world=pose, fx=40.0, fy=40.0, cx=32.0, cy=24.0, width=64, height=48)


def test_tiles_show_what_one_picture_shows(house):
    capture, model = house
    surveyor = surveyor_of(model, capture, MapProjection.of(capture.ground))
    x0, y0, x1, y1 = capture_extent(capture, surveyor.nadir_camera.placement)
    grid = grid_from_bbox((x0, y0, x1, y1), 0.2)
    whole = surveyor.render_tile(grid)
    for column, row, part in grid.tiles(40):
        tile = surveyor.render_tile(part)
        at = np.s_[row : row + part.height, column : column + part.width]
        # Grid north turns by a millionth from tile to tile; what lies between two splats may fall to the other.
        assert (np.abs(tile.colors.astype(int) - whole.colors[at]) <= 3).mean() > 0.995
        assert (np.abs(tile.heights - whole.heights[at]) < 0.01).mean() > 0.995
        assert (tile.visibility == whole.visibility[at]).mean() > 0.995


def test_visibility_counts_cameras_and_what_none_sees_is_blank(house):
    capture, model = house
    surveyor = surveyor_of(model, capture, MapProjection.of(capture.ground, "local"))
    grid = PixelGrid(-10.0, 10.0, 0.25, 80, 80)
    tile = surveyor.render_tile(grid)
    x, y = np.meshgrid(grid.left + (np.arange(80) + 0.5) * 0.25, grid.top - (np.arange(80) + 0.5) * 0.25)
    shown = tile.alpha > 0
    places = np.stack([x[shown], y[shown], tile.heights[shown]], axis=1)
    count = sum(view.camera.in_frustum(places).astype(int) for view in capture.train_views)
    assert (tile.visibility[shown] == count).mean() > 0.999
    assert tile.visibility[shown].min() >= 1
    assert not shown.all()  # beyond all pictures, though the model is opaque there
    assert set(np.unique(tile.visibility[~shown])) == {NODATA_COUNT}
    assert set(np.unique(tile.heights[~shown])) == {np.float32(NODATA_HEIGHT)}


def test_what_hangs_as_high_as_cameras_is_not_in_the_map_and_a_tower_is():
    veil, tower = surface(-3, -3, 0, 0, 21.0), surface(4, 4, 6, 6, 24.0)
    # The tower has sparse points, as what is solid has; the veil has none.
    capture = capture_of(np.concatenate([GROUND, TOP, tower]))
    model = model_of(np.concatenate([GROUND, TOP, tower, veil]))
    tower_seen = replace(capture, views=(*capture.views, replace(capture.views[0], camera=_above(5.0, 5.0, 60.0))))
    surveyor = surveyor_of(model, tower_seen, MapProjection.of(capture.ground, "local"))
    grid = PixelGrid(-3.0, 6.5, 0.25, 40, 40)
    heights = surveyor.render_tile(grid).heights
    assert heights.max() == pytest.approx(24.0, abs=0.1)
    low = surveyor_of(model, capture, MapProjection.of(capture.ground, "local")).render_tile(
        PixelGrid(-3.0, 0.0, 0.25, 12, 12)
    )
    assert low.heights[low.alpha > 0].max() < 1.0


def test_the_ceiling_over_a_place_is_that_of_the_points_about_it_whatever_their_order():
    random = np.random.default_rng(3)
    places = random.uniform(-8, 8, (4000, 3)) * (1, 1, 4)
    capture = capture_of(places)
    clip = NadirCamera.of(capture, MapProjection.of(capture.ground, "local")).clip_height
    for point, radius in zip(random.uniform(-10, 10, (40, 3)), random.uniform(0.1, 5, 40), strict=True):
        about = np.sort(places[(np.abs(places[:, :2] - point[:2]) <= radius).all(axis=1), 2])
        expected = 20.0
        if len(about):
            top, low = np.quantile(about, 0.995), np.median(about)
            expected = max(20.0, top + 0.1 * (top - low))
        assert clip.height_above(point, radius) == pytest.approx(expected, abs=1e-12)


def test_a_tile_asks_only_the_cameras_and_points_about_it(house, monkeypatch):
    """Of a large flight, a tile is drawn and counted as of its part."""
    capture, model = house
    placement, grid = MapProjection.of(capture.ground, "local"), PixelGrid(-3.0, 1.0, 0.1, 40, 40)
    alone = surveyor_of(model, capture, placement).render_tile(grid)
    away = [replace(capture.views[0], camera=_above(500.0 + 9 * k, 0.0, 20.0)) for k in range(50)]
    many = surveyor_of(model, replace(capture, views=(*capture.views, *away)), placement)
    asked = []

    def counting(positions, cameras):
        asked.append(len(cameras))
        return count_visibility(positions, cameras)

    monkeypatch.setattr(tile_renderer, "count_visibility", counting)
    tile = many.render_tile(grid)
    assert asked == [len(capture.views)]
    for name in ("colors", "alpha", "heights", "visibility"):
        np.testing.assert_array_equal(getattr(tile, name), getattr(alone, name))


@pytest.mark.parametrize("kept", [0, 3])
def test_box_and_pixel_size_make_a_map_where_the_sparse_points_say_nothing(house, make, kept):
    capture, model = house
    points = np.array([(0.5 * k, 0.0, 0.0) for k in range(kept)]).reshape(-1, 3)
    bare = replace(capture, points=points, point_colors=capture.point_colors[:kept])
    with pytest.raises(VdgsError, match="Give --bbox" if kept else "Give --gsd"):
        make(bare, model)
    given = {"crs": "local", "bbox": (-4.0, -4.0, 4.0, 4.0), "gsd": 0.2}
    with rasterio.open(make(bare, model, **given) / "dsm.tif") as file:
        assert file.shape == (40, 40)
        assert file.read(1).max() == pytest.approx(ROOF, abs=0.05)


def _above(x: float, y: float, z: float) -> Camera:
    return Camera(
        camera_from_world=look_down(np.array([x, y, z])), fx=80.0, fy=80.0, cx=32.0, cy=24.0, width=64, height=48
    )


def test_a_capture_without_georeference_has_a_map_that_says_so(house, make, capsys):
    capture, model = house
    ortho_folder = make(replace(capture, ground=replace(capture.ground, origin_geo=None, metric=False)), model, gsd=0.2)
    assert "units without known size" in capsys.readouterr().err
    with rasterio.open(ortho_folder / "dsm.tif") as file:
        assert file.crs is None  # GDAL has no unit without a size: it would write metres
        assert file.units == ("units",)
        assert "units without known size" in file.tags()["CRS_NAME"]
        assert file.read(1).max() == pytest.approx(ROOF, abs=0.05)
        assert file.bounds.left < -6


def test_units_of_known_size_keep_it(house, make):
    capture, model = house
    scaled = replace(capture.ground, origin_geo=None, scale=0.5)
    ortho_folder = make(replace(capture, ground=scaled), model, gsd=0.2, crs="source")
    with rasterio.open(ortho_folder / "dsm.tif") as file:
        assert 'UNIT["unknown",0.5]' in file.crs.to_wkt()
        assert file.units == ("units",)


def test_without_options_pixels_are_those_of_the_photographs(house, make):
    capture, model = house
    assert ground_sampling_distance(capture, 1.0) == pytest.approx(20 / 80, rel=0.1)
    with rasterio.open(make(capture, model) / "orthophoto.tif") as file:
        assert file.res[0] == pytest.approx(0.25, rel=0.1)
    assert [samples_per_side(gsd, 0.1) for gsd in (0.02, 0.1, 0.3, 5.0)] == [1, 1, 3, 4]


def test_lines_of_a_grid_are_at_multiples_of_its_pixels():
    grid = grid_from_bbox((100.03, 50.0, 101.97, 51.0), 0.1)
    np.testing.assert_allclose(grid.bounds, (100.0, 50.0, 102.0, 51.0), atol=1e-9)
    assert (grid.width, grid.height, grid.tile_count(8)) == (20, 10, 6)
    assert sum(part.width * part.height for _, _, part in grid.tiles(8)) == 200
    # A box that ends on lines but for rounding ends there: 0.3 / 0.1 is a little below 3, 0.7 / 0.1 a little below 7.
    on_lines = grid_from_bbox((0.3, 0.7, 0.9, 1.1), 0.1)
    assert (on_lines.width, on_lines.height) == (6, 4)


@pytest.mark.parametrize("crs", ["EPSG:32632", "EPSG:3995", "local"])
def test_the_arrow_leads_north_and_the_bar_is_as_long_as_on_the_ground(house, make, monkeypatch, crs):
    """On a polar map far from its pole north is no longer the top of the sheet, and lengths are not those of the
    ground."""
    kept = []
    monkeypatch.setattr(previews, "write_png", lambda figure, file: (kept.append(figure), file.touch()))
    noted = json.loads((make(*house, gsd=0.5, crs=crs) / "map.json").read_text())
    placement = MapProjection.of(house[0].ground, crs)
    assert noted["north_deg"] == pytest.approx(placement.true_north(house[0].ground, np.zeros(3)), abs=0.01)
    assert (abs(noted["north_deg"]) > 5) is (crs == "EPSG:3995")
    panel = kept[0].axes[0]
    arrow = next(each for each in panel.texts if each.get_text() == "N")
    ahead = panel.transData.transform(arrow.xy) - panel.transData.transform(arrow.xyann)
    assert np.degrees(np.arctan2(*ahead)) == pytest.approx(noted["north_deg"], abs=0.5)
    length = next(float(text.get_text().split()[0]) for text in panel.texts if text.get_text().endswith(" m"))
    assert sum(part.get_width() for part in panel.patches) == pytest.approx(length * noted["stretch"])


def test_light_of_a_hillshade():
    x, y = np.meshgrid(np.arange(20.0), np.arange(20.0))
    assert hillshade(np.zeros((5, 5)), 1.0) == pytest.approx(np.sin(np.pi / 4))
    # Rising to the south-east, a slope looks at the sun at the upper left; the same in pixels of another size.
    facing, away = hillshade(0.3 * (x + y), 1.0), hillshade(-0.3 * (x + y), 1.0)
    assert facing.min() > 0.9 > 0.5 > away.max()
    np.testing.assert_allclose(hillshade(0.6 * (x + y), 2.0), facing)
    holed = np.where((x > 5) & (x < 9), np.nan, 0.0)
    assert np.isnan(hillshade(holed, 1.0)).sum() == np.isnan(holed).sum()


@pytest.mark.parametrize(("about", "length"), [(10.0, 10.0), (9.9, 5.0), (0.23, 0.2), (499.0, 200.0)])
def test_scale_bars_are_round(about, length):
    assert floor_to_nice_length(about) == pytest.approx(length)


def test_gdal_may_keep_megabytes_of_a_map_and_not_bytes():
    """With less than a row of tiles, each row of a preview decodes them again: minutes for a small map."""
    with limit_gdal_cache():
        assert rasterio.env.get_gdal_config("GDAL_CACHEMAX") == GDAL_CACHE_BYTES > 100 * TILE_PX * TILE_PX * 4
