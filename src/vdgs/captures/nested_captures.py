"""Captures and models below a folder of photographs, before anyone makes their poses anew."""

from __future__ import annotations

import os
import re
from collections.abc import Iterator
from fnmatch import fnmatch
from pathlib import Path

from vdgs.captures.formats.colmap import count_images, find_models
from vdgs.captures.formats.matrixcity import pose_files
from vdgs.captures.formats.mega_nerf import is_mega_nerf
from vdgs.captures.image_files import readable_suffixes
from vdgs.captures.output_guard import is_capture
from vdgs.captures.project_formats import PROJECTS, find_projects
from vdgs.captures.strays import is_mask_folder, why_not_read
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
_AS_OTHERS = "a BlocksExchange, OPF or Agisoft XML file of the same project is read"
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
    "sensors/trajectories.txt": _KAPTURE,
    "*.mvs": "a scene of OpenMVS; the COLMAP or OpenMVG model that it was made of is read",
    "keyframes/*cameras/*.json": _POLYCAM,
    "*.r3d": "a capture of Record3D; ns-process-data record3d (nerfstudio) makes transforms.json of it, which is read",
    "cameras*.npz": "poses of IDR or NeuS; the COLMAP model that they were made of is read",
    "dataparser_transforms.json": (
        "what nerfstudio's training wrote; the transforms.json or COLMAP model that it was trained on is read"
    ),
    "synth_0.out": "poses of MVE; the .nvm or bundle.out that its makescene was given is read",
    "*.ori": f"orientations of PATB; {_AS_OTHERS}",
    "itera.dat": f"orientations of BINGO; {_AS_OTHERS}",
    "poses_bounds.npy": "poses of LLFF; the COLMAP model that they were made of is read",
    "database.db": "features of COLMAP; `colmap mapper` makes a model of them",
}
#: The same for files that only their beginning tells: the suffix, a pattern in lower case, and what it is.
_ALIGN = "it is read once its photographs are aligned and it is exported again"
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
    (
        ".json", rb'"transform_matrix"',
        "a file of poses like transforms.json, by another name; rename it to transforms.json, which is read",
    ),
    (".json", b'"img_name"', "cameras of a trained 3DGS scene; the capture that it was trained on is read"),
    (".json", b'"sfm_data_version"', "photographs of OpenMVG without poses; the sfm_data.json after its SfM is read"),
    (".sfm", b'"viewid"', "photographs of Meshroom without poses; cameras.sfm of its step StructureFromMotion is read"),
    (
        ".txt", rb"photoid, x, y, z, omega",
        "poses of Metashape without lenses; its Agisoft XML (File > Export > Export Cameras) is read",
    ),
    (".txt", rb"\A# *kapture format", _KAPTURE),
    (".txt", rb"\A\s*extrinsic\s", "cameras of MVSNet; the COLMAP model that they were made of is read"),
    (
        ".log", rb"\A\s*\d+ +\d+ +\d+\s*\n(?:[-+.\de]+\s+){16}",
        "poses of Tanks and Temples without lenses; the COLMAP model that they were made of is read",
    ),
    (
        ".csv", rb"\A\s*timestamp, *frame, *x, *y, *z, *qx",
        "poses of Stray Scanner; the film beside it is read without them: vdgs sfm rgb.mp4 --output CAPTURE",
    ),
    (
        ".prj", rb"\$project",
        "a project of Inpho; Metashape imports it (File > Import > Import Cameras), and its Agisoft XML is read",
    ),
)  # fmt: skip
_HEAD_BYTES = 4096
#: Files beside transforms_train.json, and those of a COLMAP model.
_SET_FILES = {"transforms_train.json", "transforms_test.json", "transforms_val.json"}
_MODEL_STEMS = {"cameras", "images", "points3d", "rigs", "frames"}
#: A file of poses with fewer bytes has none ("[]").
_LEAST_BYTES = 20


def model_below(root: Path) -> str | None:
    """What to say of a capture in a folder below `root`, or of a model without photographs where there is no capture;
    None where there is neither."""
    alone: Path | None = None
    for folder in _folders(root):
        if not is_capture(folder):
            continue
        project = next(find_projects(folder), None)
        if project is not None:
            name, file = project
            return (
                f"{file} is a project of {PROJECTS[name].program}: vdgs run {shell_word(file)} --images "
                f"{shell_word(root)} --output RUN"
            )
        if _has_photographs(folder):
            command = f"vdgs run {shell_word(folder)}{_images_beside(root, folder)} --output RUN"
            return f"{folder} is a capture: {command}{_other_captures(root, folder)}"
        alone = alone or (folder if find_models(folder) else None)
    if alone is None:
        return None
    biggest = max(find_models(alone), key=count_images)
    photographs = _photographs_beside(root, alone)
    link = f"ln -s {shell_word(photographs.resolve())} {shell_word(alone / 'images')}; " if photographs else ""
    return (
        f"{biggest} is a COLMAP model of {count_images(biggest)} photographs. To use it, put them beside it as images: "
        f"{link}vdgs run {shell_word(alone)} --output RUN"
    )


def _other_captures(root: Path, first: Path) -> str:
    """What to say of captures beside one, as of val/ beside train/: a run is of one."""
    others = [folder for folder in sorted(first.parent.iterdir()) if folder.is_dir() and folder != first]
    names = [
        folder.relative_to(root).as_posix() for folder in others if is_capture(folder) and _has_photographs(folder)
    ]
    return f" (without the photographs of {first_names(names)}, which a run of its own takes)" if names else ""


def _images_beside(root: Path, capture: Path) -> str:
    """What a command adds for a capture whose photographs lie beside it in `root`, and not in it."""
    images = (path for path in capture.rglob("*") if path.suffix.lower() in readable_suffixes())
    photographs = None if next(images, None) is not None else _photographs_beside(root, capture)
    return f" --images {shell_word(photographs)}" if photographs is not None else ""


def foreign_poses(root: Path) -> list[str]:
    """Poses below `root` that other programs made and that are not read, and what makes a capture of them: of each kind
    one file, for some programs write one for each photograph."""
    found: dict[str, Path] = {}
    for folder in (root, *_folders(root)):
        known = [(next(iter(sorted(folder.glob(name))), None), what) for name, what in _OTHERS.items()]
        known += [(file, _by_content(file)) for file in sorted(folder.iterdir())]
        for file, what in known:
            if file is not None and what and file.is_file() and file.stat().st_size > _LEAST_BYTES:
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
    what = next((what for name, what in _OTHERS.items() if fnmatch(path.name.lower(), name)), "") or _by_content(path)
    if what:
        raise CaptureError(f"{path}: is {what}.")


def _capture_of(file: Path) -> Path | None:
    """The folder of a capture that a file of poses or points is a part of: of a set's transforms_train.json, or of a
    COLMAP model; None for other files."""
    folder = file.absolute().parent
    if file.name in _SET_FILES and pose_files(folder):
        return file.parent
    if file.stem.lower() not in _MODEL_STEMS or folder not in find_models(folder):
        return None
    roots = [root for root in folder.parents[:3] if folder in find_models(root) and _has_photographs(root)]
    return roots[0] if roots else file.parent


def _by_content(file: Path) -> str:
    """What a file is of those that only their beginning tells; empty for others."""
    known = [(pattern, what) for suffix, pattern, what in _BY_CONTENT if file.suffix.lower() == suffix]
    if not known or not file.is_file():
        return ""
    try:
        with file.open("rb") as stream:
            head = stream.read(_HEAD_BYTES).lower()
    except OSError:
        return ""
    return next((what for pattern, what in known if re.search(pattern, head)), "")


def _folders(root: Path) -> Iterator[Path]:
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
    if (folder / "transforms.json").is_file() or is_mega_nerf(folder) or pose_files(folder):
        return True
    return any(entry.is_dir() and entry.name.startswith("images") for entry in folder.iterdir())


def _photographs_beside(root: Path, model: Path) -> Path | None:
    """The folder with most images beside a model or above it, up to `root`, the nearest first; one that has them in
    folders of its own only where no other has any."""
    above = [folder for folder in model.parents if folder == root or root in folder.parents]
    for directly in (True, False):
        for level in above:
            beside = [entry for entry in sorted(level.iterdir()) if entry.is_dir() and entry not in (model, *above)]
            beside = [entry for entry in beside if not is_mask_folder(entry.name) and why_not_read(entry) is None]
            counts = {folder: _count_images(folder, directly) for folder in beside}
            counts |= {level: _count_images(level, directly)} if directly else {}
            best = max(counts, key=lambda folder: counts[folder], default=level)
            if counts.get(best):
                return best
    return None


def _count_images(folder: Path, directly: bool) -> int:
    files = folder.iterdir() if directly else folder.rglob("*")
    return sum(entry.suffix.lower() in readable_suffixes() for entry in files)
