"""Captures and models below a folder of photographs, before anyone makes their poses anew."""

from __future__ import annotations

import os
import re
from collections.abc import Callable, Iterator
from fnmatch import fnmatch
from pathlib import Path, PurePath

from vdgs.captures.capture_root import capture_root
from vdgs.captures.formats.colmap import count_images, find_models
from vdgs.captures.formats.llff import POSES_FILE, is_llff, read_llff
from vdgs.captures.formats.matrixcity import pose_files, read_matrixcity
from vdgs.captures.formats.mega_nerf import is_mega_nerf
from vdgs.captures.formats.mvsnet import CAMERA_END, is_mvsnet, read_mvsnet
from vdgs.captures.formats.transforms import read_transforms
from vdgs.captures.image_files import readable_suffixes
from vdgs.captures.output_guard import is_capture
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
from vdgs.captures.project_formats import PROJECTS, find_projects
from vdgs.captures.strays import is_mask_folder, why_not_read
from vdgs.captures.text_tables import decode_text
from vdgs.config.capture_options import CaptureOptions
from vdgs.errors import CaptureError
from vdgs.system.quoting import shell_word
from vdgs.system.units import first_names

#: So many folders deep a model is looked for: WORKSPACE/dense/0 with sparse in it, and one above.
DEEPEST = 3
_METASHAPE = (
    "a project of Metashape that is not aligned, or without its folder .files; with both it is read, as is what it "
    "exports (File > Export > Export Cameras, Agisoft XML)"
)
_REALITYSCAN = (
    "a project of RealityScan; what it exports (Registration: Internal/External camera parameters, CSV, with the "
    "sparse point cloud as PLY) is read"
)
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
        "a file of poses like transforms.json, by another name; rename it to transforms.json, which is read",
    ),
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
)
_HEAD_BYTES = 4096
#: Files beside transforms_train.json, and those of a COLMAP model.
_SET_FILES = {"transforms_train.json", "transforms_test.json", "transforms_val.json"}
_MODEL_STEMS = {"cameras", "images", "points3d", "rigs", "frames"}
#: A file of poses with fewer bytes has none ("[]").
_LEAST_BYTES = 20


def model_below(root: Path) -> str | None:
    """What to say of a capture in a folder below `root`, or of a model without photographs where there is no capture,
    the biggest of several; None where there is neither."""
    found = _captures_below(root)
    if not found:
        return None
    first = next((each for each in found if each[1] != "model"), found[0])
    alike = [folder for folder, kind in found if kind == first[1]]
    best = first[0] if first[1] == "project" else max(alike, key=_size)
    beside = [folder for folder, kind in found if (kind == "model") == (first[1] == "model") and folder != best]
    others = [folder.relative_to(root).as_posix() for folder in beside]
    return _SAID[first[1]](root, best) + (f" (beside it: {first_names(others)}; a run is of one)" if others else "")


def _captures_below(root: Path) -> list[tuple[Path, str]]:
    """Folders below `root` that are captures, those that lie higher first, without what is in them: whether each is a
    `project`, a `capture` with photographs, or a `model` alone."""
    found = list[tuple[Path, str]]()
    for folder in folders_below(root):
        if any(known in folder.parents for known, _ in found) or not is_capture(folder):
            continue
        is_whole = "capture" if _has_photographs(folder) else "model"
        found.append((folder, "project" if next(find_projects(folder), None) is not None else is_whole))
    return found


def _size(folder: Path) -> int:
    """How many photographs a capture has: as its model says, else those in its folder."""
    models = find_models(folder)
    return max(map(count_images, models)) if models else _count_images(folder, False)


def _say_of_project(root: Path, folder: Path) -> str:
    name, file = next(find_projects(folder))
    images = "" if _photographs_inside(capture_root(file)) else f" --images {shell_word(root)}"
    return f"{file} is a project of {PROJECTS[name].program}: vdgs run {shell_word(file)}{images} --output RUN"


def _say_of_capture(root: Path, folder: Path) -> str:
    if is_mega_nerf(folder) and _count_images(folder, False) == 0:
        beside = _photographs_beside(root, folder)
        return (
            f"{folder} is a capture of Mega-NeRF without its photographs (train/rgbs, val/rgbs), which lie there "
            "undistorted and by other names. Its copy_images.py puts them there: python scripts/copy_images.py "
            f"--image_path {shell_word(beside) if beside else 'PHOTOGRAPHS'} --dataset_path {shell_word(folder)}; "
            f"then: vdgs run {shell_word(folder)} --output RUN"
        )
    return f"{folder} is a capture: vdgs run {shell_word(folder)}{_images_beside(root, folder)} --output RUN"


def _say_of_model(root: Path, folder: Path) -> str:
    biggest = max(find_models(folder), key=count_images)
    what = f"{biggest} is a COLMAP model of {count_images(biggest)} photographs. To use it"
    inside = _photographs_inside(folder)
    if inside is not None:
        images = inside.relative_to(folder).as_posix()
        return f"{what}: vdgs run {shell_word(folder)} --images {shell_word(images)} --output RUN"
    photographs = _photographs_beside(root, folder)
    link = f"ln -s {shell_word(photographs.resolve())} {shell_word(folder / 'images')}; " if photographs else ""
    return f"{what}, put them beside it as images: {link}vdgs run {shell_word(folder)} --output RUN"


_SAID = {"project": _say_of_project, "capture": _say_of_capture, "model": _say_of_model}


def _images_beside(root: Path, capture: Path) -> str:
    """What a command adds for a capture whose photographs lie beside it in `root`, and not in it: the folder of all
    that it names, as those of train/ and of test/, where there is one, else that of most."""
    images = (path for path in capture.rglob("*") if path.suffix.lower() in readable_suffixes())
    photographs = None if next(images, None) is not None else _photographs_beside(root, capture)
    if photographs is None:
        return ""
    above = [folder for folder in photographs.parents if folder == root or root in folder.parents]
    for strict in (True, False):
        for folder in (None, photographs, *above):
            if _is_readable(
                capture, CaptureOptions(images=None if folder is None else str(folder.absolute()), strict=strict)
            ):
                return f" --images {shell_word(folder)}" if folder is not None else ""
    return f" --images {shell_word(photographs)}"


def _is_readable(capture: Path, options: CaptureOptions) -> bool:
    """Whether the photographs of a data set are found."""
    readers = ((pose_files, read_matrixcity), (is_mvsnet, read_mvsnet), (is_llff, read_llff))
    try:
        next((reader for is_here, reader in readers if is_here(capture)), read_transforms)(capture, options, False)
    except CaptureError:
        return False
    return True


def foreign_poses(root: Path) -> list[str]:
    """Poses below `root` that other programs made and that are not read, and what makes a capture of them: of each kind
    one file, for some programs write one for each photograph."""
    found: dict[str, Path] = {}
    for folder in (root, *folders_below(root)):
        known = [(next(iter(sorted(folder.glob(name))), None), what) for name, what in _OTHERS.items()]
        known += [(file, _by_content(file)) for file in sorted(folder.iterdir())]
        for file, what in known:
            is_known = file in found.values()
            if file is not None and what and not is_known and file.is_file() and file.stat().st_size > _LEAST_BYTES:
                found.setdefault(what, file)
    return [f"{file.relative_to(root).as_posix()}: {what}" for what, file in found.items()]


def check_no_foreign_file(path: Path) -> None:
    """Raise CaptureError for a file of another program that is not read, with what is read instead, and for one that is
    a part of a capture, with the folder of this."""
    if not path.is_file():
        return
    whole = _capture_of(path)
    if whole is not None:
        raise CaptureError(f"{path}: is a part of a capture. Give the folder of it all: {shell_word(whole)}")
    what = next((what for name, what in _OTHERS.items() if _is_called(path, name)), "") or _by_content(path)
    if what:
        raise CaptureError(f"{path}: is {what}.")


def _is_called(path: Path, pattern: str) -> bool:
    """Whether a path ends in a pattern of `_OTHERS`, folders and all; case does not count."""
    count = len(PurePath(pattern).parts)
    return fnmatch("/".join(path.absolute().parts[-count:]).lower(), pattern.lower())


def _capture_of(file: Path) -> Path | None:
    """The folder of a capture that a file of poses or points is a part of: of a set's transforms_train.json or cameras,
    or of a COLMAP model; None for other files."""
    folder = file.absolute().parent
    if file.name in _SET_FILES and pose_files(folder):
        return file.parent
    if file.name == POSES_FILE or (file.name.endswith(CAMERA_END) and is_mvsnet(folder.parent)):
        return file.parent if file.name == POSES_FILE else folder.parent
    if file.stem.lower() not in _MODEL_STEMS or folder not in find_models(folder):
        return None
    roots = [root for root in folder.parents[:3] if folder in find_models(root) and _has_photographs(root)]
    return roots[0] if roots else file.parent


def _by_content(file: Path) -> str:
    """What a file is of those that only their beginning tells; empty for others."""
    known = [(pattern, what) for suffix, pattern, what in _BY_CONTENT if file.suffix.lower() == suffix]
    checks = [(is_this, what) for suffixes, is_this, what in _BY_NUMBERS if file.suffix.lower() in suffixes]
    if not (known or checks) or not file.is_file():
        return ""
    try:
        with file.open("rb") as stream:
            head = stream.read(_HEAD_BYTES)
    except OSError:
        return ""
    found = next((what for pattern, what in known if re.search(pattern, head.lower())), "")
    path, text = file.absolute().as_posix(), decode_text(head)
    whole = text if len(head) < _HEAD_BYTES else text.rpartition("\n")[0]  # the last line may be cut
    return found or next((what for is_this, what in checks if is_this(path, whole)), "")


def folders_below(root: Path) -> Iterator[Path]:
    """Folders below `root`, those that lie higher first, without hidden ones."""
    level = [root]
    for _ in range(DEEPEST):
        level = [
            Path(entry.path)
            for folder in level
            for entry in sorted(os.scandir(folder), key=lambda entry: entry.name)
            if entry.is_dir(follow_symlinks=False) and not entry.name.startswith(".")
        ]
        yield from level


def _has_photographs(folder: Path) -> bool:
    if (folder / "transforms.json").is_file() or is_mega_nerf(folder) or pose_files(folder) or is_mvsnet(folder):
        return True
    return is_llff(folder) or any(entry.is_dir() and entry.name.startswith("images") for entry in folder.iterdir())


def _photographs_inside(folder: Path) -> Path | None:
    """The folder with most images in that of a model, itself included."""
    below = [each for each in folders_below(folder) if not any(map(is_mask_folder, each.relative_to(folder).parts))]
    places = [folder, *(each for each in below if why_not_read(each) is None)]
    counts = {place: _count_images(place, True) for place in places}
    best = max(places, key=lambda place: counts[place])
    return best if counts[best] else None


def _photographs_beside(root: Path, model: Path) -> Path | None:
    """The folder with most images beside a model or above it, up to `root`, the nearest first; one that has them in
    folders of its own only where no other has any. Photographs of other captures are none of it."""
    above = [folder for folder in model.parents if folder == root or root in folder.parents]
    for directly in (True, False):
        for level in above:
            beside = [entry for entry in sorted(level.iterdir()) if entry.is_dir() and entry not in (model, *above)]
            beside = [entry for entry in beside if not is_mask_folder(entry.name) and why_not_read(entry) is None]
            counts = {folder: _count_images(folder, directly) for folder in beside if not is_capture(folder)}
            counts |= {level: _count_images(level, directly)} if directly else {}
            best = max(counts, key=lambda folder: counts[folder], default=level)
            if counts.get(best):
                return best
    return None


def _count_images(folder: Path, directly: bool) -> int:
    """How many images lie in a folder, or in it and in those below it that are no captures."""
    count = 0
    for at, folders, files in os.walk(folder):
        count += sum(PurePath(name).suffix.lower() in readable_suffixes() for name in files)
        folders[:] = [] if directly else [name for name in folders if not is_capture(Path(at, name))]
    return count
