"""Tables of positions and lists of control points that lie beside photographs, and that nobody has given."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from support.captures import tiny_scene, write_colmap
from support.flights import write_photograph
from vdgs.captures.loading import load_capture
from vdgs.config.capture_options import CaptureOptions
from vdgs.config.sfm_options import SfmOptions, SfmRequest
from vdgs.sfm.gps_priors import GpsPriors
from vdgs.sfm.reconstruction_plan import plan_reconstruction
from vdgs.system.quoting import shell_word

NOISE = np.random.default_rng(0).integers(0, 255, (120, 160, 3), np.uint8)
TABLES = {
    "card/geo.txt": "EPSG:4326\n{0} 8.5 47.1 500\n{1} 8.501 47.1 500\n{2} 8.502 47.1 500\n",
    "geo.txt": "EPSG:4326\n{0} 8.5 47.1 500\n{1} 8.501 47.1 500\n{2} 8.502 47.1 500\n",
    "card/flight.MRK": "1\t2.0\t[2]\t0,N\t0,E\t0,V\t47.1,Lat\t8.5,Lon\t500,Ellh\t0.01, 0.01, 0.02\t50,Q\n"
    "2\t2.0\t[2]\t0,N\t0,E\t0,V\t47.1,Lat\t8.501,Lon\t500,Ellh\t0.01, 0.01, 0.02\t50,Q\n"
    "3\t2.0\t[2]\t0,N\t0,E\t0,V\t47.1,Lat\t8.502,Lon\t500,Ellh\t0.01, 0.01, 0.02\t50,Q\n",
    "positions.csv": "name,lat,lon,alt\n{0},47.1,8.5,500\n{1},47.1,8.501,500\n{2},47.1,8.502,500\n",
}


def planned(folder: Path, name: str, text: str, placed: bool, **more) -> tuple[GpsPriors, list[str]]:
    """What is known before the work of three photographs with a file beside them, and what is said."""
    (folder / "card").mkdir()
    names = [f"DJI_{k + 1:04d}.JPG" for k in range(3)]
    for k, each in enumerate(names):
        write_photograph(
            folder / "card" / each, np.roll(NOISE, 9 * k, 0), k, np.array((9.0 * k, 0, 40)) if placed else None
        )
    (folder / name).write_text(text.format(*names))
    request = SfmRequest(image_folders=(folder / "card",), output=folder / "new", options=SfmOptions(**more))
    plan = plan_reconstruction(request)
    return plan.gps_priors, [each for each in plan.preflight.warnings if "beside" in each]


@pytest.mark.parametrize("name", TABLES)
def test_a_table_beside_photographs_is_named_before_the_work(tmp_path, name):
    priors, said = planned(tmp_path, name, TABLES[name], placed=True)
    assert priors.source == "EXIF"
    file = Path(name).name
    path = shell_word(tmp_path / name)
    assert said == [f"{file} beside the photographs holds positions of 3 of 3; not used. To use it: --gps {path}"]


@pytest.mark.parametrize("first_line", ["EPSG:32632\n", ""])
def test_a_table_of_positions_with_angles_is_no_registration(tmp_path, first_line):
    """A receiver's program writes the columns of RealityScan's table but those of the lens."""
    text = f"{first_line}image,easting,northing,height,yaw,pitch,roll\n" + "".join(
        f"{{{k}}},46200{k},5216000,540,{90 + k},-90,0\n" for k in range(3)
    )
    _, (said,) = planned(tmp_path, "card/ppk.csv", text, placed=True)
    file = tmp_path / "card" / "ppk.csv"
    if not first_line:
        assert f"{file}: has the columns 'easting' and 'northing' but does not say of which coordinate system" in said
        return
    assert "holds positions of 3 of 3; not used. To use it: --gps" in said
    request = SfmRequest(image_folders=(tmp_path / "card",), output=tmp_path / "new", gps=file)
    assert len(plan_reconstruction(request).gps_priors) == 3


@pytest.mark.parametrize(
    ("head", "row", "is_told"),
    [
        ("image,x,y,marker\n", "{},512.3,30{}.1,GCP1\n", False),
        ("image,x,y,z\n", "{},500123.4,520012{}.5,410\n", True),
        ("image,width,height\n", "{},4000,300{}\n", False),
        ("", "{},512.3,30{}.1,GCP1\n", False),
        ("", "{},4512.3,30{}.1,3\n", False),
        ("", "{},4000,300{},3\n", False),
        ("", "{},400,32{},2.8\n", False),
        ("", "{},500123.4,520012{}.5,410\n", True),
    ],
)
def test_only_positions_are_told_to_lack_a_system(tmp_path, head, row, is_told):
    """Sizes, exposures and marks in photographs are tables of names and numbers too."""
    text = head + "".join(row.format(f"{{{k}}}", k) for k in range(3))
    _, said = planned(tmp_path, "card/table.csv", text, placed=True)
    assert [("coordinate system" in each) for each in said] == ([True] if is_told else [])


def test_poses_above_the_folder_of_photographs_are_named_as_poses(tmp_path):
    text = "TimeStamp\tPOS_X\tPOS_Y\tPOS_Z\tQ_W\tQ_X\tQ_Y\tQ_Z\tImageFile\n1\t2\t3\t-4\t1\t0\t0\t0\t{0}\n"
    (told,) = planned(tmp_path, "airsim_rec.txt", text, placed=True)[1]
    assert f"{tmp_path / 'airsim_rec.txt'}: holds poses of AirSim, in metres north, east and down" in told
    assert "To use it" not in told


def test_poses_that_are_named_already_are_not_told_as_positions_too(tmp_path):
    """Both notes spoke of --gps, and one denied what the other said."""
    text = "image,x,y,z,qw,qx,qy,qz\n{0},1,2,3,1,0,0,0\n{1},2,2,3,1,0,0,0\n{2},2,9,3,1,0,0,0\n"
    (told,) = planned(tmp_path, "card/cameras.csv", text, placed=True)[1]
    assert told.startswith("not read: cameras.csv: positions and quaternions")


@pytest.mark.parametrize("name", ["card/geo.txt", "geo.txt"])
def test_the_table_of_odm_is_used_where_photographs_say_no_positions(tmp_path, name):
    priors, (said,) = planned(tmp_path, name, TABLES[name], placed=False)
    assert (priors.source, len(priors)) == ("geo.txt", 3)
    assert "which say no positions, has those of 3 of 3 and is used. To leave it out: --georeference off" in said


def test_the_table_of_odm_is_left_out_where_asked_and_where_it_cannot_be_read(tmp_path):
    (tmp_path / "a").mkdir()
    (tmp_path / "b").mkdir()
    priors, said = planned(tmp_path / "a", "geo.txt", TABLES["geo.txt"], placed=False, georeference="off")
    assert (len(priors), said) == (0, [])
    priors, (said,) = planned(tmp_path / "b", "geo.txt", "{0} 500123 5200123 500\n", placed=False)
    assert len(priors) == 0
    assert said.startswith(f"positions beside the photographs are not used: {tmp_path / 'b/geo.txt'}: names neither")


@pytest.mark.parametrize(
    ("name", "text"),
    [
        ("card/track.gpx", '<?xml version="1.0"?>\n<gpx><trkpt lat="1" lon="2"/></gpx>'),
        ("flight.kml", "<?xml version='1.0'?><kml><coordinates>-70.6,-33.5,500</coordinates></kml>"),
        ("track.tcx", "<?xml version='1.0'?><TrainingCenterDatabase/>"),
        ("log.csv", "time,lat,lon,alt\n2024-06-01 08:00:00,47.1,8.2,400\n2024-06-01 08:00:01,47.1,8.2,400\n"),
    ],
)
@pytest.mark.parametrize("placed", [False, True])
def test_a_track_beside_photographs_without_positions_is_named_with_the_remedy(tmp_path, name, text, placed):
    _, said = planned(tmp_path, name, text, placed)
    assert len(said) == (0 if placed else 1)
    assert all(f"{tmp_path / name}: " in each and "`exiftool -geotag TRACK PHOTOGRAPHS`" in each for each in said)


def test_control_points_and_other_texts_beside_photographs(tmp_path):
    (tmp_path / "a").mkdir()
    (tmp_path / "b").mkdir()
    text = "EPSG:32632\n462000 5200000 500 10 10 {0} p1\n"
    _, (said,) = planned(tmp_path / "a", "card/gcp_list.txt", text, placed=True)
    assert said.endswith(f"is not used. To use it: --gcp {shell_word(tmp_path / 'a/card/gcp_list.txt')}")
    assert planned(tmp_path / "b", "card/readme.txt", "A flight of {0}\n\nOn a day, 1, 2, 3\n", placed=True)[1] == []


def test_a_table_beside_a_capture_without_a_place_is_named(tmp_path):
    scene = tiny_scene()
    write_colmap(tmp_path, scene)
    names = [path.name for path in sorted((tmp_path / "images").iterdir())]
    rows = [f"{name},{47 + k // 4 * 1e-4},{8 + k % 4 * 1e-4},400" for k, name in enumerate(names)]
    (tmp_path / "gps.csv").write_text("name,lat,lon,alt\n" + "\n".join(rows))
    said = [each for each in load_capture(tmp_path, CaptureOptions()).warnings if "beside" in each]
    file = shell_word(tmp_path / "gps.csv")
    number = len(names)
    assert said == [
        f"gps.csv beside the photographs holds positions of {number} of {number}; not used. To use it: --gps {file}"
    ]
    assert not [each for each in load_capture(tmp_path, CaptureOptions(up="z")).warnings if "beside" in each]


def test_tables_between_the_given_folder_and_the_photographs_are_found(tmp_path):
    for k in range(3):
        (tmp_path / "given/code/images/card").mkdir(parents=True, exist_ok=True)
        write_photograph(tmp_path / f"given/code/images/card/DJI_{k + 1:04d}.JPG", np.roll(NOISE, 9 * k, 0), k, None)
    names = [f"DJI_{k + 1:04d}.JPG" for k in range(3)]
    (tmp_path / "given/code/geo.txt").write_text(TABLES["geo.txt"].format(*names))
    (tmp_path / "given/code/gcp_list.txt").write_text("EPSG:4326\n")
    request = SfmRequest(image_folders=(tmp_path / "given",), output=tmp_path / "new", options=SfmOptions())
    plan = plan_reconstruction(request)
    assert len(plan.gps_priors) == 3
    assert any(each.startswith("gcp_list.txt beside the photographs") for each in plan.preflight.warnings)


@pytest.mark.parametrize(
    ("name", "line", "is_said"),
    [
        ("gcp.txt", "GCP 1,436995.690,4572636.962,289.152,0.02,0.02", True),
        ("site GCPs.csv", "A1 436995 4572636 289", True),
        ("Passpunkte.csv", "P1;384512,33;5814000,12;35,20;0,02;0,02", True),
        ("gcp.txt", "weather was fine that day", False),
        ("notes.txt", "GCP 1,436995.690,4572636.962,289.152", False),
    ],
)
def test_surveyed_points_without_marks_are_named_with_what_they_lack(tmp_path, name, line, is_said):
    _, said = planned(tmp_path, f"card/{name}", f"{line}\n" * 4, placed=True)
    found = [each for each in said if f"{name} beside the photographs has surveyed points" in each]
    assert bool(found) == is_said
