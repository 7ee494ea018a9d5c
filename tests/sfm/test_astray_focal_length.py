"""Focal lengths that are fitted although the photographs cannot tell them: far from what tags that agree say."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import pytest
from rich.console import Console

pycolmap = pytest.importorskip("pycolmap")

from vdgs.config.sfm_options import SfmOptions  # noqa: E402
from vdgs.errors import CaptureError  # noqa: E402
from vdgs.sfm import focal_decision, incremental_mapper, mapping  # noqa: E402
from vdgs.sfm.capture_writer import fitted_intrinsics, longest_focal  # noqa: E402
from vdgs.sfm.feature_extraction import CameraGroup  # noqa: E402
from vdgs.sfm.focal_decision import ASKED, CONFIRMED, OF_FLIGHTS, is_astray, is_held_as_good  # noqa: E402
from vdgs.sfm.focal_length import Lens  # noqa: E402
from vdgs.sfm.workspace import Workspace, silence_colmap  # noqa: E402

FOCAL = 1280.0
FITTED = (False, "nothing says that it was flown level, looking straight down")
GROUP = CameraGroup(
    camera="", width=1024, height=768, focal_px=FOCAL, has_focal_prior=True, source="", images=(), is_confirmed=True
)  # fmt: skip


def model_of(focal: float = FOCAL, images: int = 6, error_px: float = 1.0, cameras: int = 1) -> pycolmap.Reconstruction:
    """A model of so many photographs, fitted with such a focal length (pixels), and such an error of its points."""
    options = pycolmap.SyntheticDatasetOptions()
    options.num_rigs, options.num_cameras_per_rig, options.num_points3D = cameras, 1, 20
    options.num_frames_per_rig = images // cameras
    model = pycolmap.synthesize_dataset(options)
    for camera in model.cameras.values():
        camera.focal_length = focal
    for point in model.points3D.values():
        point.error = error_px
    return model


@pytest.mark.parametrize(
    ("focal", "astray"), [(1.0, False), (1.2, False), (1.3, True), (4.0, True), (0.7, True), (0.0005, True)]
)
def test_a_fitted_focal_length_goes_astray_where_it_leaves_tags_that_agree(focal, astray):
    model = model_of(focal * FOCAL)
    assert is_astray(model, FITTED, [GROUP]) is astray
    for held in ((False, ASKED), (True, ASKED), (True, "one height")):
        assert not is_astray(model, held, [GROUP])
    doubted = SimpleNamespace(lens=Lens(1.0, "", doubt="two ways contradict each other", confirmed=True))
    for other in ({"is_confirmed": False}, {"has_focal_prior": False}, {"images": (doubted,)}):
        assert not is_astray(model, FITTED, [replace(GROUP, **other)])


def test_a_lens_that_is_none_is_astray_whatever_the_size_of_its_focal_length():
    model = model_of()
    assert model.cameras[1].model_name == "SIMPLE_RADIAL"
    for focal, k in ((FOCAL, 3.0), (0.45 * FOCAL, -0.9)):  # the latter folds over near the middle
        model.cameras[1].params = [focal, 512, 384, k]
        with pytest.raises(CaptureError, match="none that there is"):
            fitted_intrinsics(model.cameras[1])
        assert is_astray(model, FITTED, [GROUP])


def test_long_zooms_that_tags_say_are_lenses():
    """16 times the longer side: a Zenmuse H20T at 20x. COLMAP ends at 10 where tags do not say more."""
    model = model_of(16 * 1024.0)
    assert fitted_intrinsics(model.cameras[1]).params[0] == 16 * 1024.0
    with pytest.raises(CaptureError, match="none that there is"):
        fitted_intrinsics(model_of(26 * 1024.0).cameras[1])
    [zoom] = model.cameras.values()
    zoom.has_prior_focal_length = False
    assert longest_focal([zoom]) == 10.0
    zoom.has_prior_focal_length = True
    assert longest_focal([zoom]) == 25.0
    assert longest_focal([model_of().cameras[1]]) == longest_focal([]) == 10.0


@pytest.mark.parametrize("images", [4, 20])
def test_it_is_not_held_for_cameras_of_which_nothing_says_it(images):
    """Held would be a guess; but a few photographs, or one, change no rule for the others."""
    model = model_of(3 * FOCAL, images, cameras=2)
    guessed = replace(GROUP, has_focal_prior=False)
    assert is_astray(model, FITTED, [GROUP, GROUP])
    assert not is_astray(model, FITTED, [GROUP, guessed])
    spared = [image.frame_id for image in model.images.values() if image.camera_id == 2][max(1, images // 20) :]
    for frame in spared:
        model.deregister_frame(frame)
    assert is_astray(model, FITTED, [GROUP, guessed])
    assert not is_astray(model, FITTED, [guessed, GROUP])


def test_held_models_are_taken_where_they_are_as_good_or_the_fitted_lens_is_none():
    fitted = [model_of(2 * FOCAL)]
    assert is_held_as_good([model_of()], fitted)
    assert is_held_as_good([model_of(error_px=1.04)], fitted)
    assert not is_held_as_good([model_of(error_px=1.06)], fitted)
    assert not is_held_as_good([model_of(images=5)], fitted)
    assert not is_held_as_good([], fitted)
    assert is_held_as_good([model_of(images=5, error_px=3.0)], [model_of(0.716)])


def test_a_focal_length_that_is_released_and_goes_astray_is_held_again(monkeypatch):
    """Where each flight was level within the errors of altitudes, and the model shows several heights."""
    monkeypatch.setattr(focal_decision, "MIN_OBLIQUE_SHARE", 0.0)
    for focal, held in ((FOCAL, (False, focal_decision.OF_SHAPE)), (2 * FOCAL, (True, CONFIRMED))):
        models = [model_of()]

        def fit(model, _threads, focal=focal):
            model.cameras[1].focal_length = focal

        monkeypatch.setattr(focal_decision, "fit_focal", fit)
        assert focal_decision.release_focal(models, (True, OF_FLIGHTS), [GROUP], 1) == held
        assert models[0].cameras[1].focal_length == FOCAL


@pytest.mark.parametrize(("nearer", "held"), [(0.003, True), (0.03, False)])
def test_parallel_views_along_a_line_tell_it_where_points_lie_nearer_once_it_is_fitted(monkeypatch, nearer, held):
    """A tower climbed with a tag that is off by 4 %: held, by which points lie 4 % farther, the line bends by 1 %."""
    monkeypatch.setattr(focal_decision, "MIN_OBLIQUE_SHARE", 2.0)
    monkeypatch.setattr(focal_decision, "MIN_HEIGHT_SPREAD", 1e9)
    models = [model_of(1.04 * FOCAL)]

    def fit(model, _threads):
        model.cameras[1].focal_length = FOCAL

    def error_px(model):
        return 1.0 - nearer if model.cameras[1].focal_length == FOCAL else 1.0

    monkeypatch.setattr(focal_decision, "fit_focal", fit)
    monkeypatch.setattr(focal_decision, "mean_reprojection_error", error_px)
    assert focal_decision.release_focal(models, (True, focal_decision.OF_LINE), [GROUP], 1)[0] is held
    assert models[0].cameras[1].focal_length == pytest.approx((1.04 if held else 1.0) * FOCAL)


class Mapper:
    """Stands for the mapper: writes models that it has by whether the focal length is held. Stops once where told."""

    def __init__(self, by_held: dict[bool, pycolmap.Reconstruction | None], stops_at: int | None = None):
        self.by_held, self.stops_at, self.made = by_held, stops_at, []

    def __call__(self, workspace: Workspace, _count, fix_focal: bool, _threads, _console) -> None:
        self.made.append(fix_focal)
        if len(self.made) == self.stops_at:
            raise KeyboardInterrupt
        model = self.by_held[fix_focal]
        if model is None:
            raise CaptureError("no two photographs could be joined.")
        (workspace.models / "0").mkdir(parents=True)
        model.write(workspace.models / "0")


def mapped(
    folder: Path, mapper: Mapper, monkeypatch, focal: str = "auto"
) -> tuple[pycolmap.Reconstruction, tuple[bool, str], str]:
    """The largest model, whether its focal length is held and why, and what is said."""
    silence_colmap()
    workspace, console = Workspace(folder), Console(record=True, width=200, quiet=False)
    folder.mkdir(exist_ok=True)
    plan = SimpleNamespace(
        image_list=SimpleNamespace(images=[]), threads=1, gps_priors=None,
        request=SimpleNamespace(options=SfmOptions(focal=focal)),
    )  # fmt: skip
    monkeypatch.setattr(incremental_mapper, "run_mapper", mapper)
    monkeypatch.setattr(mapping.global_mapper, "leaves_photographs_out", lambda _: False)
    if focal == "auto":
        monkeypatch.setattr(focal_decision, "should_fix_focal", lambda *_: FITTED)
    with console.capture() as said:
        models, held = mapping.map_photographs(plan, workspace, [GROUP], "key", 6, console)
    return models[0], held, said.get()


def test_a_fitted_focal_length_that_goes_astray_is_held_anew_and_work_goes_on_there(tmp_path, monkeypatch):
    """The fitted models are made once, also where the work stops after them."""
    mapper = Mapper({False: model_of(4 * FOCAL), True: model_of()}, stops_at=2)
    with pytest.raises(KeyboardInterrupt):
        mapped(tmp_path, mapper, monkeypatch)
    for made in ([False, True, True],) * 2:
        model, held, _ = mapped(tmp_path, mapper, monkeypatch)
        assert held == (True, CONFIRMED)
        assert model.cameras[1].focal_length == FOCAL
        assert mapper.made == made
    assert "is held, all anew" in mapped(tmp_path / "again", mapper, monkeypatch)[2]


@pytest.mark.parametrize("worse", ["fewer photographs", "no model"])
def test_the_fitted_models_come_back_where_the_held_ones_are_worse(tmp_path, monkeypatch, worse):
    mapper = Mapper({False: model_of(4 * FOCAL), True: None if worse == "no model" else model_of(images=4)})
    for _ in range(2):
        model, held, said = mapped(tmp_path, mapper, monkeypatch)
        assert held == FITTED
        assert model.cameras[1].focal_length == 4 * FOCAL
        assert "it stays fitted" in said
    assert mapper.made[:2] == [False, True]


@pytest.mark.parametrize(("focal", "fitted"), [("auto", FOCAL), ("refine", 4 * FOCAL)])
def test_what_is_right_or_asked_for_is_mapped_once(tmp_path, monkeypatch, focal, fitted):
    mapper = Mapper({False: model_of(fitted)})
    for _ in range(2):
        model, held, said = mapped(tmp_path, mapper, monkeypatch, focal)
        assert not held[0]
        assert model.cameras[1].focal_length == fitted
        assert "anew" not in said
    assert mapper.made == [False]


def test_fitting_the_focal_length_leaves_the_log_of_colmap_silent(capfd):
    silence_colmap()
    model = model_of(images=4)
    before = model.cameras[1].focal_length
    model.cameras[1].focal_length = 1.05 * before
    focal_decision.fit_focal(model, 1)
    assert model.cameras[1].focal_length == pytest.approx(before, rel=0.02)
    pycolmap.logging.info("told")
    assert capfd.readouterr() == ("", "")


@pytest.mark.parametrize(
    ("fitted", "nearer", "deviation", "contradicted"),
    [(1.14, 0.14, 0.005, True), (1.14, 0.07, 0.005, False), (1.03, 0.14, 0.001, False), (1.14, 0.14, 0.05, False),
     (1.3, 0.07, 0.05, True)],
)  # fmt: skip
def test_one_tag_is_contradicted_by_little_where_photographs_plainly_tell_it(
    monkeypatch, fitted, nearer, deviation, contradicted
):
    """A subtitle said 24 mm of a lens of 27.4: within what tags differ by, but points lie 14 % nearer by the latter."""
    model = model_of(FOCAL)

    def fit(model, _threads):
        model.cameras[1].focal_length = fitted * FOCAL

    monkeypatch.setattr(focal_decision, "fit_focal", fit)
    monkeypatch.setattr(
        focal_decision,
        "mean_reprojection_error",
        lambda each: 1.0 if each.cameras[1].focal_length == FOCAL else 1.0 - nearer,
    )
    monkeypatch.setattr(focal_decision, "focal_deviation", lambda _: deviation)
    held = (True, focal_decision.OF_ONE_HEIGHT)
    by_one = replace(GROUP, is_confirmed=False)
    assert focal_decision.is_contradicted(model, held, [by_one], 1) is contradicted
    assert not focal_decision.is_contradicted(model, held, [GROUP], 1)


@pytest.mark.parametrize(
    ("confirmed", "deep", "anew"), [(True, 1.14, False), (False, 1.14, True), (False, 1.01, False)]
)
def test_a_focal_length_of_one_tag_that_flat_points_keep_is_fitted_anew(tmp_path, monkeypatch, confirmed, deep, anew):
    """Points that were made by a wrong focal length hold it there, however it is fitted afterwards; where without the
    flat ones it is the same, another model would be, too."""
    told = (False, focal_decision.OF_SHAPE)
    mapper = Mapper({True: model_of(FOCAL), False: model_of(1.14 * FOCAL)})
    monkeypatch.setattr(focal_decision, "should_fix_focal", lambda *_: (True, OF_FLIGHTS))
    monkeypatch.setattr(focal_decision, "release_focal", lambda *_: told)
    plan = SimpleNamespace(
        image_list=SimpleNamespace(images=[]), threads=1, gps_priors=None,
        request=SimpleNamespace(options=SfmOptions()),
    )  # fmt: skip
    monkeypatch.setattr(incremental_mapper, "run_mapper", mapper)
    monkeypatch.setattr(mapping.global_mapper, "leaves_photographs_out", lambda _: False)
    silence_colmap()

    def fit(model, _threads):
        model.cameras[1].focal_length = deep * FOCAL

    monkeypatch.setattr(focal_decision, "fit_focal", fit)
    groups, console = [replace(GROUP, is_confirmed=confirmed)], Console(quiet=True)
    monkeypatch.setattr(mapping.fisheyes, "candidates", lambda *_: [])
    models, held = mapping.map_photographs(plan, Workspace(tmp_path), groups, "key", 6, console)
    assert models[0].cameras[1].focal_length == pytest.approx((1.14 if anew else 1.0) * FOCAL)
    assert mapper.made == ([True, False] if anew else [True])
    assert not held[0]
