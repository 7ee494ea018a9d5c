"""Files in which colors do not change with the direction: which they take, and when changing ones are left out."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from unittest.mock import Mock

import numpy as np
import pytest
import torch

from support.gaussians import overhead, random_gaussians
from vdgs.captures.capture import View
from vdgs.config.commands import ExportRequest
from vdgs.export.bake_plan import drop_unused_sh_degrees
from vdgs.export.fixed_colors import with_fixed_colors
from vdgs.export.formats import registry
from vdgs.export.formats.export_scene import ExportMetadata, ExportScene, base_colors
from vdgs.export.local_frame import LocalFrame
from vdgs.export.sh_degree_choice import CoveredViews, choose_fixed_colors
from vdgs.kernels.spherical_harmonics import eval_sh_colors
from vdgs.model.gaussians import Gaussians
from vdgs.runs.open_run import OpenedRun

CAMERAS = [overhead(aside=aside) for aside in (-1.0, 0.0, 1.0)]


def bright_from_below(count: int = 50) -> Gaussians:
    """Gaussians whose color from above is not their mean over all directions, by 0.2."""
    some = random_gaussians(count, 1, reach=1.0)
    shN = torch.zeros(count, 3, 3)
    shN[:, 1] = 0.4
    return replace(some, sh0=torch.zeros(count, 3), shN=shN)


def color_from(gaussians: Gaussians, camera) -> np.ndarray:
    rays = torch.nn.functional.normalize(gaussians.means - torch.from_numpy(camera.position.astype(np.float32)), dim=1)
    return eval_sh_colors(gaussians.sh0, gaussians.shN, rays, gaussians.sh_degree).numpy()


def test_a_fixed_color_is_the_one_that_the_cameras_see() -> None:
    scene = bright_from_below()
    fixed = with_fixed_colors(scene, CAMERAS)
    assert fixed.sh_degree == 0
    seen = np.mean([color_from(scene, camera) for camera in CAMERAS], 0)
    np.testing.assert_allclose(base_colors(fixed), seen, atol=0.01)
    assert np.abs(base_colors(scene) - seen).min() > 0.15  # which cutting off the change would have given


def test_a_gaussian_in_no_picture_takes_the_color_from_all_cameras() -> None:
    scene = bright_from_below(4)
    scene.means[:] = torch.tensor([40.0, 0.0, 0.0])
    fixed = with_fixed_colors(scene, CAMERAS)
    np.testing.assert_allclose(base_colors(fixed), np.mean([color_from(scene, each) for each in CAMERAS], 0), atol=0.01)


@pytest.mark.parametrize(
    ("names", "asked", "degree"),
    [
        (("a.splat",), None, 0), (("a.html", "b.laz"), 2, 0), (("a.points.ply",), None, 0),
        (("a.splat", "b.spz"), None, 3), (("a.ply",), 1, 1),
    ],
)  # fmt: skip
def test_a_scene_is_baked_with_the_degree_that_its_files_need(
    names: tuple[str, ...], asked: int | None, degree: int
) -> None:
    request = ExportRequest(run=Path("run"), output=tuple(map(Path, names)), sh_degree=asked)  # type: ignore[arg-type]
    assert drop_unused_sh_degrees(request).baked_sh_degree == degree


@pytest.mark.parametrize("name", ["a.compressed.ply", "a.sog"])  # read back, and not
@pytest.mark.parametrize(
    ("with_changes", "without", "is_fixed"), [(29.0, 29.1, True), (29.04, 29.0, True), (30.0, 29.5, False)]
)
def test_changing_colors_stay_where_they_are_worth_it(
    name: str, with_changes: float, without: float, is_fixed: bool, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    changing = bright_from_below()
    fixed = with_fixed_colors(changing, CAMERAS)
    figures = {1: with_changes, 0: without}
    monkeypatch.setattr(CoveredViews, "of", lambda run, pieces: CoveredViews(run, [Mock(View)] * 3, []))
    monkeypatch.setattr(CoveredViews, "psnr", lambda self, pieces: figures[next(iter(pieces)).sh_degree])
    frame = LocalFrame(1.0, np.eye(3), np.zeros(3), facts=ExportMetadata())
    found, note = choose_fixed_colors(
        Mock(OpenedRun),
        tmp_path / name,
        frame,
        lambda: ExportScene.of(changing),
        lambda: iter([changing]),
        lambda: iter([fixed]),
    )  # fmt: skip
    assert found is is_fixed
    assert f"{with_changes - without:+.2f} dB on 3 views" in note
    assert not list(tmp_path.iterdir())  # what was written to look at it is gone


def test_formats_that_round_changing_colors_are_those_with_bytes_for_them() -> None:
    rounding = {each.suffix for each in registry.FORMATS if each.rounds_harmonics}
    assert rounding == {".compressed.ply", ".spz", ".sog", ".rad", "tileset.json", "lod-meta.json"}
