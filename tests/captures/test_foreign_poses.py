"""Poses of programs that are not read are named beside photographs; other texts are not taken for them."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from support.captures import tiny_scene, write_images
from vdgs.captures.foreign_poses import foreign_kind, foreign_poses
from vdgs.captures.formats.json_poses import axis_rotation
from vdgs.captures.loading import load_capture
from vdgs.captures.project_formats import is_project
from vdgs.errors import CaptureError
from vdgs.sfm.image_list import collect_images


def turned(row: str) -> str:
    """Four rows of a camera that turns and moves (x, y), by the sine and cosine of its half angle."""
    turns = [(k, 0.28 if k % 2 else 0.6, 0.96 if k % 2 else 0.8) for k in range(1, 5)]
    return "".join(row.format(k=k, s=s, c=c, x=k + 0.5, y=2.5 * k * k) + "\n" for k, s, c in turns)


@pytest.mark.parametrize(
    "name",
    [
        "a/sfm_data.bin",
        "database.db",
        "place.psx",
        "place.rcproj",
        "scene.mvs",
        "sensors/trajectories.txt",
        "keyframes/corrected_cameras/1.json",
        "cameras.npz",
        "dataparser_transforms.json",
        "synth_0.out",
        "flight.ori",
        "itera.dat",
    ],
)
def test_poses_of_formats_that_are_not_read_are_said(tmp_path, name):
    large = tiny_scene(width=160, height=120)
    write_images(tmp_path, large)
    (tmp_path / name).parent.mkdir(parents=True, exist_ok=True)
    (tmp_path / name).write_text("[]")
    assert not any("Poses are made anew" in note for note in collect_images([tmp_path]).notes)
    (tmp_path / name).write_text('[{"shots": {"a": {"rotation": [0, 0, 0]}}}]')
    assert any(name in note and "Poses are made anew" in note for note in collect_images([tmp_path]).notes)
    with pytest.raises(CaptureError, match=r"not a capture. Not read: "):
        load_capture(tmp_path)


@pytest.mark.parametrize(
    ("name", "text", "says"),
    [
        (
            "cameras.xml",
            '<?xml version="1.0"?><document version="1.5.0"><chunk/></document>',
            "of Metashape without poses",
        ),
        ("block.xml", '<?xml version="1.0"?><BlocksExchange version="3.2"><Block/></BlocksExchange>', "without poses"),
        ("metadata.json", '{"w": 720, "h": 960, "initPose": [0, 0, 0, 1, 0, 0, 0]}', "poses of Record3D"),
        ("metadata.json", '{"poses": [[0, 0, 0, 1, 0, 0, 0], [0, 0', "poses of Record3D"),
        ("poses_enu.json", '{"poses": [[1.5' + 16 * ", -2e-3" + "], [", "poses of BungeeNeRF"),
        ("metadata.json", '{"h": 960, "perFrameIntrinsicCoeffs": [[0, 0, 0, 1]', "poses of Record3D"),
        ("cameras/17.json", '{"t_00": 1.0, "t_01": 0.0, "t_02": 0.0, "fx": 900}', "poses of Polycam"),
        ("trajectories.txt", "# kapture format: 1.1\n# timestamp, device_id, qw, qx, qy, qz, tx\n", "of Kapture"),
        ("00000000_cam.txt", "extrinsic\n1 0 0 0\n0 1 0 0\n0 0 1 0\n0 0 0 1\n\nintrinsic\n", "of MVSNet"),
        ("Barn.log", "0 0 0\n1 0 0 0\n0 1 0 0\n0 0 1 -2.5e-1\n0 0 0 1\n", "of Tanks and Temples"),
        ("odometry.csv", "timestamp, frame, x, y, z, qx, qy, qz, qw\n1.0, 000000, 0, 0", "Stray Scanner; the film"),
        ("cameras.json", '[{"id": 0, "img_name": "a", "position": [0, 0, 1], "fx": 900}]', "of a trained 3DGS scene"),
        ("meta_data.json", '{"camera_model": "OPENCV", "has_mono_prior": true, "frames": []}', "poses of SDFStudio"),
        ("sfm_data.json", '{"sfm_data_version": "0.3", "views": [], "extrinsics": []}', "OpenMVG without poses"),
        (
            "views.sfm",
            '{"version": ["1", "2", "6"], "views": [{"viewId": "1", "poseId": "1"}]}',
            "of its step StructureFrom",
        ),
        ("opk.txt", "# PhotoID, X, Y, Z, Omega, Phi, Kappa, r11, r12\na.jpg,1,2,3,4,5,6,1,0\n", "Agisoft XML"),
        ("a_calibrated_external_camera_parameters.txt", "imageName X Y Z Omega Phi Kappa\na 1", "of PIX4Dmapper"),
        ("flight.prj", "$PROJECT 4.4\n  $PROJECT_NAME : flight\n", "of Inpho"),
        ("Ori-All/Orientation-a.jpg.xml", "<ExportAPERO><OrientationConique/></ExportAPERO>", "Apero2NVM"),
        (
            "groundtruth.txt",
            "# ground truth trajectory\n# timestamp tx ty tz qx qy qz qw\n1.5 1 2 3 0 0 0 1\n",
            "TUM RGB-D",
        ),
        ("poses/00.txt", "1.0e+00 0 0 2.5 0 8e-01 -6e-01 0 0 6e-01 8e-01 -1\n" * 2, "poses of KITTI; written as"),
        ("calib.txt", f"P0: {' '.join(12 * ['7.188560e+02'])}\n", "lenses of KITTI"),
        ("pose/a.txt", " ".join(["1", *11 * ["-0.25"], "0", "0.0", "0", "1.0"]), "a matrix of a photograph"),
        ("pose/b.txt", "\n".join([*3 * ["1 0 -2e-3 4.5"], "0 0 0 1", ""]), "as transforms.json"),
        ("traj.txt", ("1 0 0 4.5 0 0.6 -0.8 2 0 0.8 0.6 7 0 0 0 1.0\n" * 3), "poses of Replica"),
        ("vio_loop.csv", "".join(f"{k},1.5,2,3,0.6,0,0.8,0,0.1,0,0,\n" for k in range(17, 21)), "VINS"),
        ("camera_params_0000.json", '{"cameraAperture": [20, 15], "cameraViewTransform": [1, 0]}', "of Isaac Sim"),
        ("airsim_rec.txt", "VehicleName\tTimeStamp\tPOS_X\tPOS_Y\tPOS_Z\tQ_W\n", "z points down"),
        ("tstamps.npy", "NUMPY, and what follows is not looked at", "poses of DROID-SLAM"),
        ("bbox.txt", "-1 -1 -1 1 1 1 0.1 and no more\n", "a set of NSVF"),
        ("gt/data.csv", "#timestamp, p_RS_R_x [m], p_RS_R_y [m]\n1,2,3\n", "poses of EuRoC"),
        ("poses.txt", "".join(f"{k} 0 -1 0 {k}.5 1 0 0 -7e2 0 0 1 116\n" for k in (1, 5)), "poses of KITTI-360"),
        ("cam0_to_world.txt", "".join(f"{k} 0 0 1 9.5 1 0 0 0 0 1 0 0 0 0 0 1 \n" for k in (1, 5)), "of KITTI-360"),
        ("sampleinfos_interpolated.json", '[{"OriginalImageName": "1.jpg", "T4x4": []}]', "poses of UAVScenes"),
        ("Ori-1/Ori-PerspCentral-a.jpg.xml", "<Root><CameraPose><Center/></CameraPose></Root>", "poses of MMVII"),
        ("views/view_0000.mve/meta.ini", "[camera]\nfocal_length = 0.9\nrotation = 1 0 0", "poses of MVE"),
        ("calib/pos_001.txt", "9.5 -1e2 2 3\n4 5 -6 7\n0.1 0.2 0.3 654.5\n", "(DTU)"),
        ("frame_00001.json", '{"cameraPoseARFrame": [0.1, 0.2], "intrinsics": [1]}', "3D Scanner App"),
        ("poses_ts.json", '{"timestamps": [1, 2, 3], "poses": []}', "poses of OMMO"),
        (
            "gt.txt",
            "".join(f"130503110{k}.1758 1.3405 0.6266 -1.6575 0.6574 0.6126 -0.2949 -3.248e-1\n" for k in range(3)),
            "like those of TUM",
        ),
        ("still.txt", "".join(f"{k}.5 0 0 {k} 0 0 0 1\n" for k in range(3)), "like those of TUM"),
        ("eo.dat", "EO of a block\nID;X0;Y0;Z0;Omega;Phi;Kappa\n7;1,5;2;3;4,5;5;6\n", "omega, phi, kappa"),
        ("ros.csv", "stamp,tx,ty,tz,qx,qy,qz,qw\n1,2,3,4,0,0,0,1\n", "quaternions without lenses"),
        (
            "first_unplaced.out",
            "2 1\n" + "0 0 0\n" * 5 + "700.5 -0.1 0.02\n1 0 0\n0 1 0\n0 0 1\n-1e-3 2 3\n",
            "without the first line",
        ),
        ("poses.csv", "image,x,y,z,qw,qx,qy,qz\na.jpg,1,2,3,1,0,0,0\n", "quaternions without lenses.*transforms.json"),
        ("poses.txt", "#name x y z q_x q_y q_z q_w\na.jpg 1 2 3 0 0 0 1\n", "quaternions without lenses.*--gps FILE"),
        ("a.csv", "#name,x,y,alt,heading,pitch,roll\na.jpg,1,2,3,4,5,6\n", "poses of RealityScan without lenses"),
        ("eo.csv", "name,x,y,z,omega,phi,kappa\na.jpg,1,2,3,4,5,6\n", "omega, phi, kappa.*--gps FILE"),
        ("opk.txt", "PhotoID,X,Y,Z,Omega,Phi,Kappa\na.jpg,1,2,3,4,5,6\n", "Agisoft XML.*--gps FILE"),
        ("eo.txt", "$IMAGE X Y Z OMEGA PHI KAPPA\na.jpg 1 2 3 4 5 6\n", "omega, phi, kappa"),
        (
            "bundle.out",
            "2 1\n700.5 -0.1 0.02\n1 0 0\n0 1 0\n0 0 1\n-1e-3 2 3\n",
            "without the first line of their file; with the line",
        ),
        ("flight.r3d", '<?xml version="1.0"?>\n<Regard3D version="1"/>', "a project of Regard3D; OpenMVG"),
        ("film.r3d", "PK\x03\x04 and so on, for some bytes", "a capture of Record3D"),
        ("map.graph", "VERTEX3 0 1.5 2 3 0.1 0.2 0.3\n", "a graph of poses"),
        ("poses.txt", "VERTEX_SE3:QUAT 0 1.5 2 3 0 0.6 0 0.8\n", "a graph of poses"),
        ("place.zep", "any bytes, and more of them", "a project of 3DF Zephyr"),
        ("drive/oxts/data/0000000001.txt", "49.0 8.4 112 0.03 0.01 -0.5\n", "of KITTI's raw data"),
        ("cams_meta.npy", "NUMPY, and what follows is not looked at", "of F2-NeRF"),
        ("metadata", '{"h": 960, "perFrameIntrinsicCoeffs": [[0, 0, 0, 1]', "poses of Record3D"),
        ("dataset_train.txt", "Visual Landmark Dataset V1\nImageFile, Camera Position [X Y Z W P Q R]\n", "PoseNet"),
        ("5a.txt", "https://x.org/a\n0 0.9 1.2 0.5 0.5 0 0 1 0 0 2 0 1 0 3 0 0 1 4\n", "of RealEstate10K"),
        ("labels.csv", "image_path,rotation_matrix,translation_vector\n", "Image Matching Challenge"),
        ("camera/1.json", '{"orientation": [[1, 0, 0], [0, 1, 0]], "focal_length": 9}', "poses of Nerfies"),
        ("old_images.txt", "1 0.5 0.5 0.5 0.5 1 2 3 1 a.jpg\n\n", "of COLMAP without their lenses"),
        ("pose_left.txt", turned("{x} 2 {y} 0 {s} 0 {c}"), "positions and quaternions"),
        ("results.txt", turned("{k}.jpg {c} 0 {s} 0 {x} 1 {y}"), "positions and quaternions"),
        ("map_camera_poses.txt", turned("17.{k} {x} 2 {y} 0 {s} 0 {c} {k}"), "positions and quaternions"),
        ("ARposes.txt", turned("17{k},0,{s},0,{c},{x},{y},3"), "positions and quaternions"),
        ("poses.csv", "f,p_x,p_y,p_z,q0,q1,q2,q3\n" + turned("{k},{x},2,{y},0,{s},0,{c}"), "positions and quaternions"),
        (
            "extrinsic.txt",
            "frame r1,1 t3\n" + turned("{k} 0 {c} -{s} 0 {x} {s} {c} 0 {y} 0 0 1 3 0 0 0 1"),
            "rotation matrix",
        ),
        ("rt.csv", turned("{k}.jpg,{c};-{s};0;{s};{c};0;0;0;1,{x};{y};3"), "rotation matrix"),
        ("town.log", turned("{k}.png,{x}00,{k}00,90,-60,0,{k}5.5"), "UrbanScene3D.*--gps FILE"),
        (
            "cameras.json",
            '{"a": [[0, -1, 0, 4], [1, 0, 0, 5], [0, 0, 1, 6], [0, 0, 0, 1]], "fx": 9}',
            "poses as matrices",
        ),
        (
            "cameras.json",
            '{"cameraTransform": [[0, 1, 0, 0, -1, 0, 0, 0, 0, 0, 1, 0, 4, 5, 6, 1],\n'
            "[0, -1, 0, 0, 1, 0, 0, 0, 0, 0, 1, 0, 4, 5, 6, 1]]}",
            "poses as matrices",
        ),
        ("AT/sfm_geo_desc.json", '{"is_georeferenced": true, "x": 1}', "BlocksExchange"),
    ],
)
def test_files_that_only_their_beginning_tells_are_said(tmp_path, name, text, says):
    write_images(tmp_path, tiny_scene(width=160, height=120))
    (tmp_path / name).parent.mkdir(parents=True, exist_ok=True)
    (tmp_path / name).write_text(text)
    with pytest.raises(CaptureError, match=rf"not a capture. Not read: .*{Path(name).name}: .*{says}"):
        load_capture(tmp_path)
    assert len(foreign_poses(tmp_path)) == 1
    if is_project(tmp_path / name):  # whose reader refuses it
        return
    with pytest.raises(CaptureError, match=rf"{Path(name).name}: is .*{says}"):
        load_capture(tmp_path / name)


def test_arrays_of_poses_are_told_by_their_numbers_without_pickle(tmp_path):
    turns = np.stack([axis_rotation(2, 10.0 * k) for k in range(4)])
    poses = np.concatenate([turns, np.arange(12.0).reshape(4, 3, 1)], axis=2)
    np.save(tmp_path / "poses.npy", poses)
    np.savez(tmp_path / "0001.npz", pose=np.eye(4), intrinsics=np.eye(3))
    np.save(tmp_path / "points.npy", np.arange(60.0).reshape(5, 12))
    np.savez(tmp_path / "features.npz", descriptors=poses)
    np.save(tmp_path / "objects.npy", np.array([{"pose": 1}, None], dtype=object), allow_pickle=True)
    (tmp_path / "damaged.npz").write_bytes(b"PK\x03\x04" + 60 * b"x")
    (tmp_path / "damaged.npy").write_bytes(b"\x93NUMPY\x01\x00v\x00{'descr': " + 60 * b"x")
    named = {file.name for file in tmp_path.iterdir() if foreign_kind(file)}
    assert named == {"poses.npy", "0001.npz"}


def test_of_a_long_series_of_files_few_are_opened(tmp_path, monkeypatch):
    for k in range(40):
        (tmp_path / f"DJI_{k:04}.txt").write_text("a text of this photograph, and no poses")
    opened = list[Path]()
    real = Path.open
    monkeypatch.setattr(Path, "open", lambda self, *args, **kinds: opened.append(self) or real(self, *args, **kinds))
    assert foreign_poses(tmp_path) == []
    assert 0 < len(opened) < 5


def test_other_texts_of_numbers_are_no_poses(tmp_path):
    texts = {
        "points.txt": 2 * "1.5 2.5 3.5 255 255 255 0 1\n", "images.txt": "# Image list\n# ID, QW, QX, QY, QZ, TX\n",
        "counts.txt": "1 2 3 4\n5 6 7 8\n", "log.csv": f"{'x' * 4000}\n", "list.out": "12 photographs\nof a flight\n",
        "positions.csv": "name,lat,lon,alt,yaw,pitch,roll\na.jpg,47,8,500,1,2,3\n",
    }  # fmt: skip
    for name, text in texts.items():
        (tmp_path / name).write_text(text)
    assert foreign_poses(tmp_path) == []


def test_a_kind_of_files_is_named_once(tmp_path):
    write_images(tmp_path, tiny_scene(width=160, height=120))
    for number in range(3):
        (tmp_path / f"{number}.json").write_text('{"t_00": 1.0, "t_01": 0.0, "t_02": 0.0, "fx": 900}')
    (tmp_path / "run.log").write_text("12 photographs of 3 flights\n 1 2 3\n")
    (tmp_path / "other.log").write_text(f"1 2 3\n2026-11-27-21-00\n{'-' * 5000}\n> start\n")  # no pattern hangs on it
    assert [note.partition(":")[0] for note in foreign_poses(tmp_path)] == ["0.json"]


@pytest.mark.parametrize(
    ("name", "text"),
    [
        ("grid.out", "3 4\n1 2 3\n4 5 6\n7 8 9\n1 2 3\n4 5 6\n"),
        ("xyz.out", "100 200\n" + 8 * "1.5 2.5 3.5\n"),
        ("zeros.out", "100 200\n" + 10 * "0 0 0\n"),
        ("transform.txt", "1 0 0 5\n0 1 0 6\n0 0 1 7\n"),
        ("calib.txt", "2000 0 1024 0\n0 2000 768 0\n0 0 1 0\n"),
        ("gcp.txt", "".join(f"{k} 50000{k}.1 520000{k}.2 412.3\n" for k in range(3))),
        ("rtk.txt", "".join(f"170000000{k}.1 47.1 8.1 412.3 0.01 0.01 0.02 1\n" for k in range(5))),
        ("rtk.csv", "".join(f"170000000{k}.1,47.1,8.1,412.3,0.01,0.01,0.02,1\n" for k in range(5))),
        ("float.txt", "".join(f"170000000{k}.1 47.1 8.1 412.3 0.01 0.01 0.02 2\n" for k in range(5))),
        ("normals.txt", "".join(f"{k}.0 2.0 3.0 4.0 0.1 0.2 0.3 0.4\n" for k in range(5))),
        ("falls.txt", "".join(f"{9 - k} 2.0 3.0 4.0 0 0 0.6 0.8\n" for k in range(5))),
        ("spectra.txt", "".join(f"{k} {' '.join(12 * ['0.25'])}\n" for k in range(400, 420))),
        ("poses.txt", "".join(f"{k} {' '.join(16 * ['0.25'])}\n" for k in range(400, 420))),
        ("bands.txt", "".join(f"{k} {' '.join(11 * ['0.25'])}\n" for k in range(400, 420))),
        ("readme.txt", "Angles are given as omega, phi, kappa in the delivered files.\nAll good.\n"),
        ("delivery.txt", "The columns are name, x, y, z, omega, phi, kappa.\nIn metres, gon, and so on.\n"),
        ("ppk.csv", "name,lat,lon,alt,omega,phi,kappa\na.jpg,47.1,8.1,410,0,0,90\n"),
        ("geo.txt", "EPSG:32632\n#name x y z omega phi kappa\na.jpg 500000.1 5200000.1 410 0 0 90\n"),
        ("angles.dat", "time omega phi kappa\n1 2 3 4\n"),
        ("imu.csv", "timestamp,gx,gy,gz,ax,ay,az,qw,qx,qy,qz\n1,2,3,4,5,6,7,1,0,0,0\n"),
        ("heading.csv", "image,x,y,z,qw,qx,qy,qz\n"),
        ("cloud.txt", "1 2 3 0.48 0.64 0.6 0\n2 1 4 0.6 0.48 0.64 0\n3 5 4 0.64 0.6 0.48 0\n"),
        ("cloud.csv", "1,2,3,0.48,0.64,0.6,0.012\n2,1,4,0.6,0.48,0.64,0.02\n3,5,4,0.64,0.6,0.48,0.01\n"),
        ("imu.csv", "t,ax,ay,az,qw,qx,qy,qz\n" + turned("{k},{x},2,{y},0,{s},0,{c}")),
        ("rtk.txt", turned("{k}.jpg 47.120{k} 8.5 4{x} 0 {s} 0 {c}")),
        ("quality.csv", turned("{k}.jpg,{x}00,{y},12.5,-60,0.5,{k}5.5")),
        ("identity.txt", 5 * "a.jpg 1 0 0 0 1 0 0 0 1 4 5 6\n"),
        ("sums.txt", "".join(f"{k}d41d8cd98f00b204e9800998ecf8427  {k}.jpg\n" for k in range(5))),
        (
            "tileset.json",
            '{"geometricError": 5, "a": [0, 1, 0, 0, -1, 0, 0, 0, 0, 0, 1, 0, 4, 5, 6, 1], "fx": 1}',
        ),
        ("exif.json", '[{"GPSLatitude": [47, 7, 12.5], "Matrix": [1, 0, 0, 0, 1, 0, 0, 0, 1], "focal": 9}]'),
        ("path.json", '{"keyframes": [{"matrix": [0,1,0,0,-1,0,0,0,0,0,1,0,4,5,6,1]}], "fx": 1, "render_height": 9}'),
    ],
)
def test_texts_that_only_look_like_poses_are_not_named(tmp_path, name, text):
    (tmp_path / name).write_text(text)
    assert foreign_poses(tmp_path) == []
