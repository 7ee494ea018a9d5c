"""Lenses that may be fisheyes, which no tag says: the photographs tell, by models of known truth."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from types import SimpleNamespace

import numpy as np
import pytest
from PIL import Image
from rich.console import Console

pycolmap = pytest.importorskip("pycolmap")

from vdgs.captures.reconstruction import CameraReport, read_digests  # noqa: E402
from vdgs.config.sfm_options import SfmOptions, SfmRequest  # noqa: E402
from vdgs.errors import CaptureError  # noqa: E402
from vdgs.sfm import fisheyes, focal_decision, mapping  # noqa: E402
from vdgs.sfm.capture_writer import fitted_intrinsics  # noqa: E402
from vdgs.sfm.feature_extraction import CameraGroup  # noqa: E402
from vdgs.sfm.focal_decision import CONTRADICTED  # noqa: E402
from vdgs.sfm.focal_length import DIAGONAL_35_MM, Lens  # noqa: E402
from vdgs.sfm.image_metadata import FISHEYE, RADIAL, attitude_from_gimbal  # noqa: E402
from vdgs.sfm.reconstruction_plan import plan_reconstruction  # noqa: E402
from vdgs.sfm.reconstruction_report import _warnings  # noqa: E402
from vdgs.sfm.step_keys import step_keys  # noqa: E402
from vdgs.sfm.workspace import Workspace, silence_colmap  # noqa: E402

SIZE = 800, 600
GOPRO = CameraGroup(
    camera="GoPro HERO4 Black", width=SIZE[0], height=SIZE[1], focal_px=347.0, has_focal_prior=True, source="",
    images=(), is_confirmed=False,
)  # fmt: skip


def group_of(mm: float) -> CameraGroup:
    return replace(GOPRO, focal_px=mm * math.hypot(*SIZE) / DIAGONAL_35_MM)


def mapped_model(mm: float, fisheye: bool, tilt: float) -> pycolmap.Reconstruction:
    """What the mapper makes with one radial term of photographs through a lens of such a 35 mm equivalent, which is
    equidistant or perspective; every other one looks so far from straight down (degrees)."""
    rng = np.random.default_rng(5)
    focal, middle = group_of(mm).focal_px, np.array(SIZE) / 2
    model, seen = pycolmap.Reconstruction(), list[list[tuple[int, int]]]()
    lens = pycolmap.Camera(model=RADIAL, width=SIZE[0], height=SIZE[1], params=[focal, *middle, 0.0], camera_id=1)
    model.add_camera_with_trivial_rig(lens)
    ground = np.column_stack([rng.uniform(-80, 80, (300, 2)), rng.uniform(0, 8, 300)])
    seen = [[] for _ in ground]
    for number, (x, y) in enumerate(((x, y) for y in (-15, 15) for x in (-25, -10, 5, 20)), 1):
        place = np.array([x, y, 40.0]) + rng.normal(0, 1, 3)
        turned = attitude_from_gimbal(rng.uniform(0, 360), -90 + tilt * (number % 2), 0).camera_from_enu
        local = (ground - place) @ turned.T
        off = np.hypot(local[:, 0], local[:, 1])
        angle = np.arctan2(off, local[:, 2])
        radius = focal * (angle if fisheye else np.tan(np.minimum(angle, 1.4)))
        pixels = local[:, :2] / off[:, None] * radius[:, None] + middle
        shown = np.flatnonzero((angle < 1.3) & (pixels > 0).all(axis=1) & (pixels < SIZE).all(axis=1))
        for mark, point in enumerate(shown.tolist()):
            seen[point].append((number, mark))
        marks = pixels[shown] + rng.normal(0, 0.3, (len(shown), 2))
        image = pycolmap.Image(name=f"{number}.jpg", keypoints=marks, camera_id=1, image_id=number)
        model.add_image_with_trivial_frame(image, pycolmap.Rigid3d(np.column_stack([turned, -turned @ place])))
    for point, track in zip(ground, seen, strict=True):
        if len(track) >= 3:
            model.add_point3D(point, pycolmap.Track([pycolmap.TrackElement(*each) for each in track]), np.zeros(3))
    for largest_px in (20.0, 4.0):
        focal_decision.fit_focal(model, 1)
        pycolmap.ObservationManager(model).filter_all_points3D(largest_px, 0.5)
    return model


@pytest.mark.parametrize(
    ("mm", "fisheye", "tilt"),
    [(12, True, 0), (15, True, 0), (15, True, 30), (14, False, 0), (14, False, 30), (19, False, 0)],
)
def test_photographs_tell_a_fisheye_from_a_perspective_lens(mm, fisheye, tilt):
    silence_colmap()
    model, group = mapped_model(mm, fisheye, tilt), group_of(mm)
    before = model.cameras[1].params.tolist()
    assert fisheyes.candidates([group], model) == [1]
    found = fisheyes.compare(model, [group], [1], 1)
    assert (found is not None) is fisheye
    assert found is None or found[1] < 0.6 < found[0]
    assert model.cameras[1].params.tolist() == before
    assert model.cameras[1].model_name == RADIAL


def test_only_short_lenses_and_action_cameras_may_be_fisheyes():
    film = replace(GOPRO, has_focal_prior=False, focal_px=960.0)
    cases = [GOPRO, group_of(24), group_of(20), replace(GOPRO, model=FISHEYE), film, replace(film, camera="DJI FC6310")]
    assert fisheyes.candidates(cases) == [1, 3, 5]


def test_it_is_told_before_the_work_unless_a_person_says_the_model():
    gopro = SimpleNamespace(
        camera="GoPro HERO4 Black", lens=Lens(0.434, "EXIF's 35 mm equivalent"), camera_model=RADIAL, face="",
        sensor="", size=SIZE, width=SIZE[0], height=SIZE[1], focal_mm=3.0, name="a",
    )  # fmt: skip
    (line,) = fisheyes.foretold([gopro, gopro], SfmOptions())
    assert "GoPro HERO4 Black, a 35 mm equivalent of 15 mm" in line
    assert "--camera-model opencv-fisheye" in line
    assert not fisheyes.foretold([gopro], SfmOptions(camera_model="simple-radial"))


def test_matches_are_verified_by_the_lenses_that_were_found(tmp_path, monkeypatch):
    """In the same database, and again where the work stopped between."""
    silence_colmap()
    workspace, console = Workspace(tmp_path), Console(quiet=True)
    options = pycolmap.SyntheticDatasetOptions()
    options.num_rigs, options.num_frames_per_rig, options.num_points3D = 1, 4, 60
    with workspace.open_database() as database:
        pycolmap.synthesize_dataset(options, database)
    kinds = [replace(GOPRO, model=FISHEYE)]
    monkeypatch.setattr(fisheyes, "match_pairs", lambda *_: (_ for _ in ()).throw(KeyboardInterrupt))
    with pytest.raises(KeyboardInterrupt):
        fisheyes.use_lenses(workspace, kinds, "key", 1, console)
    monkeypatch.undo()
    fisheyes.use_lenses(workspace, kinds, "key", 1, console)
    with workspace.open_database() as database:
        (camera,) = database.read_all_cameras()
        assert (camera.model_name, camera.mean_focal_length()) == (FISHEYE, GOPRO.focal_px)
        assert database.num_verified_image_pairs() == 6


class Mapper:
    """Stands for all that makes models: counts calls, and fails with perspective lenses where told."""

    def __init__(self, fails: bool):
        self.fails, self.keys = fails, list[str]()

    def __call__(self, plan, _workspace, key: str, *_) -> list[pycolmap.Reconstruction]:
        self.keys.append(key)
        if self.fails and "fisheyes" not in key:
            raise CaptureError("no two photographs could be joined.")
        return [SimpleNamespace(cameras={}, images={}, photographs=plan.image_list.images)]


@pytest.mark.parametrize("fails", [False, True])
def test_models_are_made_anew_with_fisheyes_once(tmp_path, monkeypatch, fails):
    mapper, errors = Mapper(fails), [(0.56, 0.13)]
    photo = SimpleNamespace(name="a", camera_model=RADIAL)
    monkeypatch.setattr(fisheyes, "with_fisheyes", lambda groups, _: groups)
    monkeypatch.setattr(mapping, "make_models", mapper)
    monkeypatch.setattr(fisheyes, "compare", lambda *_: errors.pop())
    monkeypatch.setattr(fisheyes, "use_lenses", lambda *_: None)
    for name, value in (("should_fix_focal", (False, "")), ("release_focal", (False, "")), ("is_contradicted", False),
                        ("is_astray", False)):  # fmt: skip
        monkeypatch.setattr(focal_decision, name, lambda *_, value=value: value)
    monkeypatch.setattr(mapping, "replace", lambda _, **changes: SimpleNamespace(
        request=SimpleNamespace(options=SfmOptions()), gps_priors=None, threads=1,
        image_list=SimpleNamespace(images=[photo]), **{k: v for k, v in changes.items() if k == "images"}))  # fmt: skip
    plan = mapping.replace(None)
    console = Console(record=True, width=300)
    for _ in range(2):
        mapping.map_photographs(plan, Workspace(tmp_path), [replace(GOPRO, images=(photo,))], "key", 6, console)
    assert mapper.keys == ["key", "key, fisheyes", "key, fisheyes"]
    said = console.export_text()
    assert ("no two photographs" if fails else "GoPro HERO4 Black: a fisheye, as the photographs tell") in said
    asked = SfmOptions(camera_model="simple-radial")
    plan.request.options = asked
    if fails:
        with pytest.raises(CaptureError):
            mapping.map_photographs(plan, Workspace(tmp_path / "asked"), [GOPRO], "key", 6, console)
    else:  # what was found by then does not count against what is said
        mapping.map_photographs(plan, Workspace(tmp_path), [GOPRO], "key", 6, console)
        assert mapper.keys[3:] == ["key"]
        assert not Workspace(tmp_path).fisheyes_file.exists()


def test_a_model_that_is_said_is_other_work_where_photographs_could_contradict_it(tmp_path):
    """The note on a fisheye advises `--camera-model simple-radial`, which must then do something."""
    exif = Image.Exif()
    exif[0x010F], exif[0x0110] = "GoPro", "HERO9 Black"
    for name, mm in (("short", 16), ("long", 50)):
        (tmp_path / name).mkdir()
        exif.get_ifd(0x8769)[0xA405] = mm
        for number in range(3):
            Image.new("RGB", (400, 300), (80 * number, 0, 0)).save(tmp_path / name / f"{number}.jpg", exif=exif)
    keys = {
        (name, model): step_keys(
            plan_reconstruction(
                SfmRequest(
                    image_folders=(tmp_path / name,), output=tmp_path / "out", options=SfmOptions(camera_model=model)
                )
            ),
            read_digests(tmp_path / "out"),
        )
        for name in ("short", "long")
        for model in ("auto", "simple-radial")
    }
    auto, told = keys["short", "auto"], keys["short", "simple-radial"]
    assert [step for step in auto if auto[step] == told[step]] == ["features", "matches"]
    assert keys["long", "auto"] == keys["long", "simple-radial"]


@dataclass(frozen=True)
class Photo:
    name: str
    camera_model: str


def test_cameras_keep_their_numbers_where_one_of_them_is_found_to_be_a_fisheye():
    """One camera whose tags say the fisheye in some photographs alone stays two, as in the database."""
    untold, told = (replace(GOPRO, model=model, images=(Photo(model, model),)) for model in (RADIAL, FISHEYE))
    found = fisheyes.with_fisheyes([untold, told], [1])
    assert found == [replace(untold, model=FISHEYE, images=(Photo(RADIAL, FISHEYE),)), told]


def test_no_perspective_lens_sees_more_than_there_are():
    """Full-frame lenses of 9 mm are perspective; what is fitted beyond is refused, with the fisheye as the remedy."""
    for mm, refused in ((9.5, False), (8.0, True)):
        lens = pycolmap.Camera(
            model=RADIAL, width=800, height=600, params=[group_of(mm).focal_px, 400, 300, 0], camera_id=1
        )
        if refused:
            with pytest.raises(CaptureError, match=r"139.* --camera-model opencv-fisheye"):
                fitted_intrinsics(lens)
        else:
            fitted_intrinsics(lens)


def test_a_short_lens_that_contradicts_its_tags_is_said_to_be_a_fisheye_first():
    camera = CameraReport(
        name="GoPro", photographs=15, width=SIZE[0], height=SIZE[1], focal_before_px=347.0, focal_source="EXIF",
        focal_after_px=140.0, radial_distortion=0.0,
    )  # fmt: skip
    (note,) = _warnings([camera], (False, CONTRADICTED), None, None, None, None)
    assert "--camera-model opencv-fisheye" in note
    assert "--focal fixed" not in note
    (note,) = _warnings([replace(camera, model=FISHEYE, focal_after_px=350.0)], (False, ""), None, None, None, None,
                        {"GoPro"})  # fmt: skip
    assert "a fisheye, as the photographs tell" in note
