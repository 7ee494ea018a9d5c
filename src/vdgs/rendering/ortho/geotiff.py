"""GeoTIFF files: written tile by tile, then rewritten as cloud-optimized ones with overviews."""

from __future__ import annotations

import os
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from vdgs.errors import VdgsError
from vdgs.geometry.map_projection import MapProjection
from vdgs.rendering.ortho.pixel_grid import TILE_PX, PixelGrid
from vdgs.system.quoting import wkt_string

#: What GDAL may keep of files in memory: in bytes, as rasterio takes it; GDAL itself would take 128 for megabytes.
GDAL_CACHE_BYTES = 128 << 20


@dataclass(frozen=True, kw_only=True)
class RasterLayer:
    """One file of a map: what its bands are called, their type, unit and what stands for nothing."""

    name: str
    title: str
    bands: tuple[str, ...]
    dtype: str
    nodata: float | None = None
    #: Resampling of overviews: "average" for images; "nearest" for heights and counts, for the mean of a roof and a
    #: street is a height that nothing has.
    overviews: str = "nearest"
    unit: str = ""

    @property
    def bytes_per_pixel(self) -> int:
        return len(self.bands) * int(np.dtype(self.dtype).itemsize)


def require_rasterio() -> Any:
    """The module. Raises VdgsError where it is not installed."""
    try:
        import rasterio
        import rasterio.shutil
        import rasterio.windows
    except ImportError:
        raise VdgsError("Maps are GeoTIFFs, which need rasterio: pip install 'vdgs[geo]'.") from None
    return rasterio


@contextmanager
def limit_gdal_cache() -> Iterator[None]:
    """A context in which GDAL keeps at most `GDAL_CACHE_BYTES` of files in memory, on any machine, and raises OSError
    whatever the disk refuses."""
    rasterio = require_rasterio()
    from rasterio._err import CPLE_BaseError  # what GDAL says when it closes a file; `rasterio.errors` lacks it

    try:
        with rasterio.Env(GDAL_CACHEMAX=GDAL_CACHE_BYTES):
            yield
    except CPLE_BaseError as error:
        raise OSError(str(error)) from error


def rasterio_crs(placement: MapProjection) -> Any:
    """The system as rasterio knows it: that of the catalogue, or a local one with name and unit.

    None where nobody knows the unit: GDAL writes metres for a local system whose unit has no size. The tags say then
    what the coordinates are (`crs_name`). Raises VdgsError where rasterio does not know a system that pyproj knows.
    """
    crs = require_rasterio().crs.CRS
    if placement.wkt is not None:
        from rasterio.errors import CRSError

        try:
            return crs.from_user_input(placement.crs)
        except CRSError as error:
            raise VdgsError(f"{placement.crs}: rasterio does not know this system ({error}). {_remedy()}") from None
    if placement.meters_per_unit is None:
        return None
    unit = wkt_string("metre" if placement.meters_per_unit == 1 else placement.unit)
    local = f"LOCAL_CS[{wkt_string(placement.name)},UNIT[{unit},{placement.meters_per_unit!r}]"
    return crs.from_wkt(f'{local},AXIS["x",EAST],AXIS["y",NORTH]]')


def _remedy() -> str:
    """What to do where rasterio does not read the catalogue of systems."""
    named = [name for name in ("PROJ_DATA", "PROJ_LIB") if os.environ.get(name)]
    if not named:
        return "Update it (pip install -U rasterio), or give another --crs."
    variables = " and ".join(f"{name} ({os.environ[name]})" for name in named)
    return (
        f"The environment names the files of another PROJ by {variables}. Run `unset {' '.join(named)}`, then the same "
        "command again."
    )


@contextmanager
def open_geotiff(
    file: Path, layer: RasterLayer, grid: PixelGrid, placement: MapProjection, tags: dict[str, str]
) -> Iterator[Any]:
    """A tiled GeoTIFF open for `write_tile`; its name must end in .tif."""
    rasterio = require_rasterio()
    options = {"photometric": "RGB", "alpha": "YES"} if "alpha" in layer.bands else {}
    with rasterio.open(
        file, "w", driver="GTiff", width=grid.width, height=grid.height, count=len(layer.bands), dtype=layer.dtype,
        crs=rasterio_crs(placement), transform=rasterio.Affine(grid.gsd, 0.0, grid.left, 0.0, -grid.gsd, grid.top),
        nodata=layer.nodata, tiled=True, blockxsize=TILE_PX, blockysize=TILE_PX, compress="DEFLATE", zlevel=1,
        bigtiff="IF_SAFER", **options,
    ) as stream:  # fmt: skip
        stream.update_tags(**tags, TITLE=layer.title, AREA_OR_POINT="Area")
        for index, name in enumerate(layer.bands, start=1):
            stream.set_band_description(index, name)
        if layer.unit:
            stream.units = (layer.unit,) * len(layer.bands)
        yield stream


def write_tile(stream: Any, column: int, row: int, values: np.ndarray) -> None:
    """Write bands [b, h, w] at a place of an open file."""
    window = require_rasterio().windows.Window(column, row, values.shape[2], values.shape[1])
    stream.write(values, window=window)


def write_cog(source: Path, file: Path, layer: RasterLayer) -> None:
    """Rewrite a GeoTIFF as a cloud-optimized one: overviews, DEFLATE with a predictor.

    Raises OSError where the result is not what was written: GDAL closes files without a word when a disk is full.
    """
    rasterio = require_rasterio()
    predictor = "FLOATING_POINT" if layer.dtype.startswith("float") else "STANDARD"
    rasterio.shutil.copy(
        source, file, driver="COG", COMPRESS="DEFLATE", PREDICTOR=predictor, BLOCKSIZE=TILE_PX, BIGTIFF="IF_SAFER",
        OVERVIEW_RESAMPLING=layer.overviews.upper(), NUM_THREADS="ALL_CPUS",
    )  # fmt: skip
    with rasterio.open(source) as written, rasterio.open(file) as read:
        if any(written.checksum(band) != read.checksum(band) for band in written.indexes):
            raise OSError(f"{layer.name} came out damaged")


def read_overview(file: Path, max_px: int) -> tuple[np.ndarray, float]:
    """Bands [b, h, w] of a file at most so many pixels long, from its overviews, and how many pixels one stands for."""
    with require_rasterio().open(file) as stream:
        factor = max(1.0, max(stream.width, stream.height) / max_px)
        shape = (stream.count, max(1, round(stream.height / factor)), max(1, round(stream.width / factor)))
        return stream.read(out_shape=shape), stream.height / shape[1]
