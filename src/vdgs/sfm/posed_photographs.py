"""Photographs whose poses are known and whose points are to be found: of projects, and of data sets without points."""

from __future__ import annotations

import io
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path

import cv2
import numpy as np
from PIL import Image

from vdgs.captures.capture import Split
from vdgs.captures.capture_root import capture_root
from vdgs.captures.format_dispatch import READERS, read_source
from vdgs.captures.formats.source_capture import Intrinsics, SourceCapture, SourceView
from vdgs.captures.georeference import Georef
from vdgs.captures.image_matching import MatchedView, match_images
from vdgs.captures.image_tags import kind_of, may_be_transparent
from vdgs.captures.pillow_limits import pillow_without_limits
from vdgs.captures.pinholes import fold_notes
from vdgs.captures.reconstruction import read_digests
from vdgs.captures.split_lists import TEST_LIST, VALIDATION_LIST
from vdgs.captures.splits import held_out_by_capture
from vdgs.captures.tiff_orientation import without_orientation
from vdgs.config.capture_options import CaptureOptions
from vdgs.config.sfm_options import SfmRequest
from vdgs.errors import CaptureError
from vdgs.sfm.image_metadata import ImageMetadata
from vdgs.sfm.workspace import Workspace, cache_key
from vdgs.system.atomic_files import write_bytes
from vdgs.system.content_digests import ContentDigests

#: The steps of the work, and the folder of the features as the photographs show them.
FEATURES, MATCHES, POINTS, CAPTURE, BENT = "features", "matches", "points", "capture", "bent"


@dataclass(frozen=True, eq=False, kw_only=True)
class PosedPhotographs:
    """The photographs in name order, and what makes each step anew."""

    source: SourceCapture
    views: tuple[MatchedView, ...]
    #: A camera for each size of photographs, whose numbers in COLMAP's database are 1, 2, ...
    pinholes: tuple[Intrinsics, ...]
    request: SfmRequest
    digests: ContentDigests
    warnings: tuple[str, ...]
    on_white: bool = False
    """Whether what is transparent becomes white; else it is masked."""
    validation: frozenset[str] = frozenset()
    """Those that are kept for testing with `--validation` alone."""

    @cached_property
    def keys(self) -> dict[str, str]:
        """What each step depends on. Reads the photographs where their digests are not known."""
        return _keys(self)

    @property
    def is_data_set(self) -> bool:
        """Whether the poses are those of a data set, not of a project of another program."""
        return self.source.source in READERS

    @property
    def trained(self) -> list[int]:
        """The photographs that points are found from: those that are kept for testing are not, where a data set says
        which these are."""
        return [k for k, view in enumerate(self.views) if view.view.split != "test"]

    def number_of(self, view: MatchedView) -> int:
        sizes = [_size(pinhole) for pinhole in self.pinholes]
        return 1 + sizes.index(_size(view.file.intrinsics))

    def metadata(self, view: MatchedView) -> ImageMetadata:
        """The photograph as its file has it: poses of projects are of that, whatever EXIF says of its orientation."""
        path, lens = view.file.path, view.file.intrinsics
        return ImageMetadata(
            name=view.view.name, path=path, width=lens.width, height=lens.height, orientation=1, camera="", lens=None,
            datetime="", lat_lon=None, altitude=None, altitude_type="", gps_std=None, gps_error_m=None,
            relative_altitude=None, attitude=None, file_bytes=path.stat().st_size,
            has_alpha_channel=_has_alpha(view) and not self.on_white, mask=view.file.mask, kind=kind_of(path),
        )  # fmt: skip


def read_posed_photographs(request: SfmRequest, options: CaptureOptions) -> PosedPhotographs:
    """Raises CaptureError as the readers do, and for fewer than three photographs."""
    [path] = request.image_folders
    root, warnings = capture_root(path), list[str]()
    source = _in_metres(read_source(path, options, needs_points=False))
    views, _ = match_images(root, source, options, warnings)
    lists = held_out_by_capture(root, source.images, [view.view.name for view in views], options, warnings)
    views = sorted(_listed(views, lists, options, warnings), key=lambda view: view.view.name)
    training = sum(view.view.split != "test" for view in views)
    if training < 3:
        raise CaptureError(
            f"{path}: {len(views)} photographs with a pose are there, {training} of them to train on; points need 3 at "
            "the very least."
        )
    on_white = source.source == "matrixcity" and source.georef is None  # not the city: sets of Blender
    transparent = sum(map(_has_alpha, views))
    if transparent and source.source in READERS:
        what = "becomes white, as is usual for sets of Blender" if on_white else "is left out, as by a mask"
        warnings.append(f"{transparent} photographs are transparent: what is transparent {what}.")
    warnings += fold_notes(view.file.intrinsics for view in views)
    return PosedPhotographs(
        source=source, views=tuple(views), pinholes=_pinholes([view.file.intrinsics for view in views]),
        request=request, digests=read_digests(request.output), warnings=(*source.warnings, *warnings),
        on_white=bool(on_white and transparent), validation=frozenset(lists.get(VALIDATION_LIST, ())),
    )  # fmt: skip


def _keys(photographs: PosedPhotographs) -> dict[str, str]:
    views, source, chosen = photographs.views, photographs.source, photographs.request.options
    content = photographs.digests.of_all(path for view in views for path in _files(view))
    files = [[view.view.name, *(content[path] for path in _files(view))] for view in views]
    lenses = [view.file.intrinsics for view in views]
    found = cache_key(files, chosen.max_image_size, chosen.max_num_features)
    straight = cache_key(
        found, [vars(lens) for lens in lenses], [view.view.camera_from_world.tolist() for view in views]
    )
    splits = [view.view.split for view in views]
    matched = cache_key(straight, chosen.num_neighbors, *([splits] if any(splits) else []))
    keys = {FEATURES: found, BENT: straight, MATCHES: matched, POINTS: matched}
    validation = sorted(photographs.validation)
    keys[CAPTURE] = cache_key(
        matched, chosen.max_output_size, source.georef and vars(source.georef), *([validation] if validation else [])
    )
    return keys


def _in_metres(source: SourceCapture) -> SourceCapture:
    """With poses in metres, z up, where a data set says how its world becomes that."""
    world = source.world
    if world is None or not world.metric:
        return source
    moved = list[SourceView]()
    for view in source.views:
        pose = view.camera_from_world.copy()
        pose[:3, :3], pose[:3, 3] = pose[:3, :3] @ world.rotation.T, world.scale * pose[:3, 3]
        moved.append(replace(view, camera_from_world=pose))
    return replace(source, views=tuple(moved), world=None, georef=Georef(None, "", world.how))


def _listed(
    views: list[MatchedView], lists: Mapping[str, set[str]], options: CaptureOptions, warnings: list[str]
) -> list[MatchedView]:
    """With the splits of the capture's own lists, else without photographs that stand in none of a data set's, as where
    it has points. What is kept for validation trains neither."""
    tests = lists.get(TEST_LIST)
    if tests is not None:
        views = [_with_split(view, "test" if view.view.name in tests else "train") for view in views]
    kept = [view for view in views if view.view.split is not None]
    if not kept or options.split == "every":
        kept = [_with_split(view, None) for view in views]
    if len(kept) < len(views):
        warnings.append(
            f"{len(views) - len(kept)} of {len(views)} photographs stand in none of the lists of training and test "
            "photographs and are left out. --split every uses them all."
        )
    validation = lists.get(VALIDATION_LIST, set())
    return [_with_split(view, "test") if view.view.name in validation else view for view in kept]


def _with_split(view: MatchedView, split: Split | None) -> MatchedView:
    return MatchedView(replace(view.view, split=split), view.file)


def _has_alpha(view: MatchedView) -> bool:
    return may_be_transparent(view.file.path)


def _size(lens: Intrinsics) -> tuple[int, int]:
    return lens.width, lens.height


def _pinholes(lenses: Sequence[Intrinsics]) -> tuple[Intrinsics, ...]:
    """For the photographs of each size one camera about as theirs are, without distortion."""
    found = []
    for width, height in dict.fromkeys(map(_size, lenses)):
        focal = float(np.median([lens.focal for lens in lenses if _size(lens) == (width, height)]))
        found.append(Intrinsics("PINHOLE", (focal, focal, width / 2, height / 2), width, height))
    return tuple(found)


def _files(view: MatchedView) -> list[Path]:
    """The photograph, and its mask if there is one."""
    return [file for file in (view.file.path, view.file.mask) if file is not None]


def write_on_white(photographs: PosedPhotographs, work: Workspace) -> None:
    """Copies of transparent photographs in the work folder, on white, where they are to become that."""
    for view in photographs.views if photographs.on_white else ():
        target = work.images / view.view.name
        if target.exists() or not _has_alpha(view):
            continue
        stored = without_orientation(np.fromfile(view.file.path, np.uint8)).tobytes()
        with pillow_without_limits(), Image.open(io.BytesIO(stored)) as image:
            pixels = np.asarray(image.convert("RGBA")).astype(np.float32)
        alpha = pixels[..., 3:] / 255
        flat = (pixels[..., :3] * alpha + 255 * (1 - alpha) + 0.5).astype(np.uint8)
        target.parent.mkdir(parents=True, exist_ok=True)
        write_bytes(target, cv2.imencode(".png", flat[..., ::-1])[1].tobytes())
