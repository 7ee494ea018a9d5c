"""Poses of other programs that are not read, by names of files, their beginnings, or their numbers; with what is read
instead."""

from __future__ import annotations

import os
import re
from collections import Counter
from collections.abc import Callable, Iterator
from fnmatch import fnmatch, translate
from pathlib import Path, PurePath

from vdgs.captures.folders_below import folders_below
from vdgs.captures.image_suffixes import IMAGE_SUFFIXES
from vdgs.captures.pose_numbers import has_angles, has_array_poses, has_json_poses, has_matrices, has_quaternions
from vdgs.captures.pose_texts import (
    is_angle_table,
    is_bundler,
    is_dtu,
    is_kitti,
    is_kitti_360,
    is_matrices,
    is_quaternion_table,
    is_trajectory,
    is_tum,
)
from vdgs.captures.text_tables import decode_text

_METASHAPE = (
    "a project of Metashape that is not aligned, or without its folder .files; with both it is read, as is what it "
    "exports (File > Export > Export Cameras, Agisoft XML)"
)
_REALITYSCAN = (
    "a project of RealityScan; what it exports (Registration: Internal/External camera parameters, CSV, with the "
    "sparse point cloud as PLY) is read"
)
#: Its poses where the archive is unpacked.
_RECORD3D_FILE = "metadata"
_KAPTURE = "poses of Kapture; kapture_export_colmap.py makes a COLMAP model, which is read"
_POLYCAM = "poses of Polycam; ns-process-data polycam (nerfstudio) makes transforms.json of them, which is read"
_RECORD3D = "poses of Record3D; ns-process-data record3d (nerfstudio) makes transforms.json of them, which is read"
_WRITE = (
    "written as transforms.json (world from camera, axes of OpenGL, with the lens) beside the photographs they are read"
)
_AS_OTHERS = "a BlocksExchange, OPF or Agisoft XML file of the same project is read"
_MVE = "poses of MVE; the .nvm or bundle.out that its makescene was given is read"
_METASHAPE_TABLE = "poses of Metashape without lenses; its Agisoft XML (File > Export > Export Cameras) is read"
_POSITIONS = (
    "; its positions alone: --gps FILE, where they are metres with the code of their coordinate system as a first line "
    "of its own"
)
_GRAPH = (
    "a graph of poses (g2o, TORO); RTAB-Map's File > Export cameras in Bundler format (*.out) makes of its map what is "
    "read"
)
_LANDMARKS = "poses of PoseNet (Cambridge Landmarks); reconstruction.nvm of the same place is read"
#: Poses of programs that are not read, by the file that has them, and what turns them into what is.
_OTHERS = {
    "*.psx": _METASHAPE,
    "*.psz": _METASHAPE,
    "*.rcproj": _REALITYSCAN,
    "*.rsproj": _REALITYSCAN,
    "*.p4d": "a project of PIX4Dmapper; 1_initial/params in the folder of its name, after the first step, is read",
    "*.p4m": "a project of PIX4Dmatic; the OPF that it exports is read",
    "*_calibrated_external_camera_parameters*.txt": (
        "poses of PIX4Dmapper without lenses; *_calibrated_camera_parameters.txt of the same folder is read"
    ),
    "*.ccm": "a project of ContextCapture; the block that it exports (BlocksExchange, with tie points) is read",
    "AT/sfm_geo_desc.json": (
        "an aerotriangulation of DJI Terra; the BlocksExchange file that Terra puts beside it is read, and is not there"
    ),
    "sfm_data.bin": (
        "poses of OpenMVG in binary; openMVG_main_ConvertSfM_DataFormat -i sfm_data.bin -o sfm_data.json -V -I -E -S "
        "makes what is read"
    ),
    "*.mg": "a project of Meshroom; cameras.sfm of its step StructureFromMotion is read",
    "sfm.abc": "poses of Meshroom in Alembic; cameras.sfm beside it, or the .sfm of its step ConvertSfMFormat, is read",
    "Orientation-*.xml": "poses of MicMac; mm3d Apero2NVM makes a .nvm of them, which is read",
    "Ori-PerspCentral-*.xml": f"poses of MMVII (MicMac); {_WRITE}",
    "sensors/trajectories.txt": _KAPTURE,
    "*.mvs": "a scene of OpenMVS; the COLMAP or OpenMVG model that it was made of is read",
    "keyframes/*cameras/*.json": _POLYCAM,
    "bbox.txt": f"a set of NSVF; its pose/*.txt and intrinsics.txt are not read; {_WRITE}",
    "cameras*.npz": "poses of IDR or NeuS; the COLMAP model that they were made of is read",
    "dataparser_transforms.json": (
        "what nerfstudio's training wrote; the transforms.json or COLMAP model that it was trained on is read"
    ),
    "synth_0.out": _MVE,
    "views/*.mve/meta.ini": _MVE,
    "sampleinfos_interpolated.json": f"poses of UAVScenes; {_WRITE}",
    "poses_ts.json": f"poses of OMMO; {_WRITE}",
    "*.ori": f"orientations of PATB; {_AS_OTHERS}",
    "itera.dat": f"orientations of BINGO; {_AS_OTHERS}",
    "airsim_rec.txt": f"poses of AirSim in metres north, east and down (z points down); {_WRITE}",
    "tstamps.npy": (
        "poses of DROID-SLAM; the photographs or the film that it was given are read without them: vdgs sfm "
        "PHOTOGRAPHS --output CAPTURE"
    ),
    "database.db": "features of COLMAP; `colmap mapper` makes a model of them",
    "*.g2o": _GRAPH,
    "*.graph": _GRAPH,
    "*.zep": f"a project of 3DF Zephyr; its cameras, exported and {_WRITE}",
    "*.traj": f"a trajectory (ARKitScenes), turns and places of a camera; {_WRITE}",
    "oxts/data/*.txt": f"positions and angles of KITTI's raw data, degrees in front; {_WRITE}",
    "calib_cam_to_cam.txt": f"lenses of KITTI's raw data; {_WRITE}",
    "cams_meta.npy": "poses of F2-NeRF; the COLMAP model that they were made of is read",
    "predictions.npz": "poses of VGGT; demo_colmap.py of VGGT makes a COLMAP model, which is read",
}
_ALIGN = "it is read once its photographs are aligned and it is exported again"
#: The same for files that only their beginning tells: the suffix, a pattern in lower case, and what it is.
_BY_CONTENT = (
    (".xml", rb"<blocksexchange", f"a BlocksExchange file without poses; {_ALIGN}"),
    (".xml", rb"<document version", f"an export of Metashape without poses; {_ALIGN}"),
    (".json", rb'"has_mono_prior"', "poses of SDFStudio; the transforms.json or COLMAP model of the same data is read"),
    # The phone writes the keys in any order, and the lists are long.
    (".json", rb'"(initpose|perframeintrinsiccoeffs|frametimestamps)"', _RECORD3D),
    (".json", rb'\A\s*{\s*"poses"\s*:\s*\[\s*\[([^],]+,){6}[^],]+\]', _RECORD3D),
    (
        ".json", rb'\A\s*{\s*"poses"\s*:\s*\[\s*\[([^],]+,){16}[^],]+\]',
        "poses of BungeeNeRF; the photographs are read without them: vdgs sfm images --output CAPTURE",
    ),
    (".json", rb'"t_00"\s*:', _POLYCAM),
    (".json", rb'"cameraviewtransform"', f"cameras of Isaac Sim (Replicator); {_WRITE}"),
    (".json", rb'"cameraposearframe"', f"poses of 3D Scanner App (ARKit); {_WRITE}"),
    (
        ".json", rb'"transform_matrix"',
        "a file of poses like transforms.json, by another name; as transforms.json in a folder of its own it is read "
        "(with --images FOLDER where its photographs lie elsewhere)",
    ),
    ("", rb'"(initpose|perframeintrinsiccoeffs|frametimestamps)"', _RECORD3D),
    (".json", rb'"orientation"\s*:\s*\[\s*\[(?s:.*)"focal_length"\s*:', f"poses of Nerfies (HyperNeRF); {_WRITE}"),
    (
        ".txt", rb"(?m)\A(?:#.*\n)*\d+ (?:[-+.\de]+ ){7}\d+ [^\n]*\.[a-z]\w+\s*$",
        "poses of COLMAP without their lenses; with cameras.txt of the same model beside them they are read",
    ),
    (".txt", rb"\Avisual landmark dataset", _LANDMARKS),
    (
        ".txt", rb"(?m)\Ahttps?://\S+\s*\n\d+ (?:[-+.\de]+ +){17}[-+.\de]+\s*$",
        f"poses of RealEstate10K or ACID with the lens as shares of the size; {_WRITE}",
    ),
    (
        ".csv", rb"\A[^\n]*rotation_matrix[^\n]*translation_vector",
        f"poses of the Image Matching Challenge (camera from world); {_WRITE}",
    ),
    (".txt", rb"(?m)\A(?:#.*\n)*vertex(?:_se3:quat|3|2|_se2)\s", _GRAPH),
    (".json", b'"img_name"', "cameras of a trained 3DGS scene; the capture that it was trained on is read"),
    (".json", b'"sfm_data_version"', "photographs of OpenMVG without poses; the sfm_data.json after its SfM is read"),
    (".sfm", b'"viewid"', "photographs of Meshroom without poses; cameras.sfm of its step StructureFromMotion is read"),
    *((suffix, rb"photoid, ?x, ?y, ?z, ?omega", _METASHAPE_TABLE + _POSITIONS) for suffix in (".txt", ".csv")),
    (".txt", rb"\A# *kapture format", _KAPTURE),
    (".txt", rb"# *timestamp,?\s+tx,?\s+ty,?\s+tz,?\s+qx", f"poses of TUM RGB-D; {_WRITE}"),
    (".txt", rb"\Ap0: (?:[-+.\de]+ ){11}", f"lenses of KITTI; {_WRITE}"),
    (
        ".txt", rb"\A\s*(?:[-+.\de]+\s+){12}(?:[-+]?0(?:\.0*)?(?:e[-+]\d+)?\s+){3}1(?:\.0*)?(?:e\+?0+)?\s*\Z",
        f"a matrix of a photograph (NSVF, NeRF-OSR, ScanNet, 7-Scenes); {_WRITE}",
    ),
    (
        ".csv", rb"\A#?name,x,y,(?:alt|z),(?:heading|yaw),pitch,roll *\r?\n",
        "poses of RealityScan without lenses; its registration with 'Internal/External camera parameters' is read"
        + _POSITIONS,
    ),
    (".csv", rb"\A#timestamp.*p_rs_r_x", f"poses of EuRoC; {_WRITE}"),
    (
        ".txt", rb"\A\s*extrinsic\s",
        "a camera of MVSNet; the folder above is read, where these are cams/NAME_cam.txt in it, beside the photographs",
    ),
    (
        ".log", rb"\A\s*\d+ +\d+ +\d+\s*\n(?:[-+.\de]+\s+){16}",
        "poses of Tanks and Temples without lenses; the COLMAP model that they were made of is read",
    ),
    (
        ".csv", rb"\A\s*timestamp, *frame, *x, *y, *z, *qx",
        "poses of Stray Scanner; the film beside it is read without them: vdgs sfm rgb.mp4 --output CAPTURE",
    ),
    # The phone's film is a container, and the file of the other program XML.
    (
        ".r3d", rb"\A(?:\xef\xbb\xbf)?\s*<",
        "a project of Regard3D; OpenMVG's sfm_data.bin in its folders is read once openMVG_main_ConvertSfM_DataFormat "
        "-i sfm_data.bin -o sfm_data.json -V -I -E -S has made JSON of it",
    ),
    (".r3d", rb"", "a capture of Record3D; ns-process-data record3d (nerfstudio) makes transforms.json, which is read"),
    (
        ".prj", rb"\$project",
        "a project of Inpho; Metashape imports it (File > Import > Import Cameras), and its Agisoft XML is read",
    ),
)  # fmt: skip
#: The same for what only the numbers tell, of any program; asked last.
_ROTATIONS = f"a rotation matrix and a place in each row; {_WRITE}"
_TRAJECTORY = f"positions and quaternions without lenses, a trajectory; {_WRITE}"
_MATRICES = f"poses as matrices; {_WRITE}"
_ANGLES = f"positions and angles of cameras without lenses (drones, UrbanScene3D); {_WRITE}{_POSITIONS}"
#: Suffixes of texts of numbers.
_TEXTS = frozenset({".txt", ".csv", ".tsv", ".log", ".dat", ".tum", ".kitti", ".pose", ".poses", ".trajectory", ".gt"})
#: Suffixes of tables of poses that any program may have written.
_TABLES = frozenset({".txt", ".csv", ".opk", ".dat"})
#: The same for texts of numbers, which anything may be: what tells them by their names, headings and values.
_BY_NUMBERS: tuple[tuple[frozenset[str], Callable[[str, str], bool], str], ...] = (
    (frozenset({".txt"}), is_kitti, f"poses of KITTI; {_WRITE}"),
    (frozenset({".txt"}), is_kitti_360, f"poses of KITTI-360; {_WRITE}"),
    (frozenset({".txt"}), is_tum, f"poses like those of TUM RGB-D; {_WRITE}"),
    (frozenset({".txt", ".csv"}), is_trajectory, f"a trajectory of positions and quaternions (VINS, OKVIS); {_WRITE}"),
    (frozenset({".txt"}), is_matrices, f"poses of Replica (NICE-SLAM), a matrix in each row; {_WRITE}"),
    (frozenset({".txt"}), is_dtu, f"a projection matrix of a photograph (DTU); {_WRITE}"),
    (
        frozenset({".out"}),
        is_bundler,
        "poses of Bundler without the first line of their file; with the line '# Bundle file v0.3' in front it is read",
    ),
    (
        _TABLES,
        is_angle_table,
        "positions and angles (omega, phi, kappa) without lenses, which are not read; as BlocksExchange, OPF, Agisoft "
        f"XML or with the lens as transforms.json they are{_POSITIONS}",
    ),
    (
        _TABLES,
        is_quaternion_table,
        f"positions and quaternions without lenses, which are not read; {_WRITE}{_POSITIONS}",
    ),
    (_TEXTS, has_matrices, _ROTATIONS),
    (_TEXTS, has_quaternions, _TRAJECTORY),
    (_TEXTS, has_angles, _ANGLES),
    (frozenset({".json"}), has_json_poses, _MATRICES),
)
#: So much of a file is looked at, in bytes: of JSON more, whose poses may come behind long lists.
_HEAD_BYTES, _JSON_BYTES = 4096, 1 << 16
#: Files of NumPy, and suffixes of files that are looked into.
_ARRAYS = frozenset({".npy", ".npz"})
_LOOKED_INTO = (
    _ARRAYS | {suffix for suffix, _, _ in _BY_CONTENT} | frozenset[str]().union(*(each[0] for each in _BY_NUMBERS))
)
#: A file of poses with fewer bytes has none ("[]").
_LEAST_BYTES = 20
#: Of files whose names differ in numbers alone so many are looked into: programs write one for each photograph.
_OF_A_SERIES = 3
_SERIES = re.compile(r"[0-9a-f]*\d[0-9a-f]*")


def foreign_poses(root: Path) -> list[str]:
    """Poses below `root` that other programs made and that are not read, and what makes a capture of them: of each kind
    one file, for some programs write one for each photograph."""
    found: dict[str, Path] = {}
    for folder in (root, *folders_below(root)):
        for file in _likely_files(folder):
            what = foreign_kind(file)
            if what:
                found.setdefault(what, file)
    return [f"{file.relative_to(root).as_posix()}: {what}" for what, file in found.items()]


def foreign_kind(file: Path) -> str:
    """What a file of poses of another program is, and what is read instead; empty for others."""
    named = next((what for name, what in _OTHERS.items() if _is_called(file, name)), "")
    return named or _by_content(file)


def _likely_files(folder: Path) -> Iterator[Path]:
    """Files in a folder, sorted, that may be poses by their names, or are to be looked into: of a series the first."""
    try:
        with os.scandir(folder) as entries:
            names = sorted(entry.name for entry in entries)
    except OSError:
        return
    known, looked = _names_in(folder), Counter[str]()
    for name in names:
        lower = name.lower()
        suffix = PurePath(lower).suffix
        if suffix in IMAGE_SUFFIXES or lower.startswith("."):
            continue
        if suffix not in _LOOKED_INTO and lower != _RECORD3D_FILE and not known.match(lower):
            continue
        series = _SERIES.sub("#", lower)
        looked[series] += 1
        file = folder / name
        if looked[series] <= _OF_A_SERIES and file.is_file() and file.stat().st_size > _LEAST_BYTES:
            yield file


def _names_in(folder: Path) -> re.Pattern[str]:
    """What files of `_OTHERS` in a folder may be called."""
    names = [PurePath(name) for name in _OTHERS]
    here = [name.name for name in names if len(name.parts) == 1 or _is_called(folder, str(name.parent))]
    return re.compile("|".join(f"(?:{translate(name.lower())})" for name in here))


def _is_called(path: Path, pattern: str) -> bool:
    """Whether a path ends in a pattern of `_OTHERS`, folders and all; case does not count."""
    count = len(PurePath(pattern).parts)
    return fnmatch("/".join(path.absolute().parts[-count:]).lower(), pattern.lower())


def _by_content(file: Path) -> str:
    """What a file is of those that only their beginning tells; empty for others."""
    kind = file.suffix.lower()
    known = [(pattern, what) for suffix, pattern, what in _BY_CONTENT if kind == suffix]
    checks = [(is_this, what) for suffixes, is_this, what in _BY_NUMBERS if kind in suffixes]
    if kind in _ARRAYS:
        return _MATRICES if file.is_file() and has_array_poses(file) else ""
    if not (known or checks) or (not kind and file.name.lower() != _RECORD3D_FILE) or not file.is_file():
        return ""
    size = _JSON_BYTES if kind == ".json" else _HEAD_BYTES
    try:
        with file.open("rb") as stream:
            head = stream.read(size)
    except OSError:
        return ""
    found = next((what for pattern, what in known if re.search(pattern, head.lower())), "")
    path, text = file.absolute().as_posix(), decode_text(head)
    whole = text if len(head) < size else text.rpartition("\n")[0]  # the last line may be cut
    return found or next((what for is_this, what in checks if is_this(path, text if kind == ".json" else whole)), "")
