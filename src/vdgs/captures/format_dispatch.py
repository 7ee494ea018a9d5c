"""Which format a folder is of, and the capture in it as the files have it.

A folder may hold a COLMAP model and transforms.json, as nerfstudio leaves them, of the same cameras. The model also
knows which photograph shows which point, so it is read; but where transforms.json says what the model cannot, lists of
training and test photographs or masks, that is read (choice). A note says which; `--format` decides otherwise.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

from vdgs.captures.foreign_poses import foreign_poses
from vdgs.captures.formats.colmap import (
    count_images,
    find_models,
    has_both_kinds,
    has_points,
    larger_models_beside,
    partial_model,
    read_colmap,
    read_lenses,
)
from vdgs.captures.formats.llff import is_llff, read_llff
from vdgs.captures.formats.matrixcity import pose_files, read_matrixcity
from vdgs.captures.formats.mega_nerf import is_mega_nerf, read_mega_nerf
from vdgs.captures.formats.mvsnet import is_mvsnet, read_mvsnet
from vdgs.captures.formats.ply_reader import read_point_cloud
from vdgs.captures.formats.project_photographs import image_root
from vdgs.captures.formats.source_capture import NoTiePoints, SourceCapture, no_points
from vdgs.captures.formats.sparse_points import POINT_CLOUDS, find_point_cloud
from vdgs.captures.formats.transforms import TRANSFORMS_FILE, exclusive_information, is_transforms, read_transforms
from vdgs.captures.image_files import find_images
from vdgs.captures.image_places import image_folder
from vdgs.captures.nested_captures import model_below
from vdgs.captures.project_formats import PROJECTS, find_projects, is_project, read_project
from vdgs.captures.reconstruction import is_reconstruction
from vdgs.captures.strays import check_no_run
from vdgs.config.capture_options import CaptureOptions
from vdgs.errors import CaptureError
from vdgs.system.quoting import shell_word


def read_source(root: Path, options: CaptureOptions, *, needs_points: bool = True) -> SourceCapture:
    """The capture in the format asked for, or in whichever the folder is. Without `needs_points` one without points is
    read too: what finds them needs its poses.

    Raises `CaptureError` where there is none, and as the readers do.
    """
    if is_transforms(root):
        root, options = root.parent, replace(options, format="transforms")
    here = [name for name, (is_here, _) in READERS.items() if is_here(root)]
    here += dict.fromkeys(name for name, _ in find_projects(root))
    if options.format != "auto":
        if options.format not in here:
            found = f"It holds: {', '.join(here)}." if here else "It holds none that is known."
            raise CaptureError(f"{root}: --format {options.format}, but the folder holds no such capture. {found}")
        return _read(root, options.format, options, needs_points)
    if here[:2] == ["colmap", "transforms"]:
        return _of_both(root, _with_image_folder(root, options), needs_points)
    if here:
        source = _read(root, here[0], options, needs_points)
        note = f"{' and '.join(here[1:])} beside it: not read (--format chooses)."
        return replace(source, warnings=(note, *source.warnings)) if PROJECTS.keys() & here[1:] else source
    check_no_run(root)
    if is_reconstruction(root):
        raise CaptureError(
            f"{root}: is not finished: vdgs sfm was stopped. The command that began it goes on "
            f"with it (its photographs, --output {shell_word(root)})."
        )
    below = model_below(root)
    if below:
        raise CaptureError(f"{root}: not a capture itself. {below}")
    others = "".join(f"Not read: {poses}. " for poses in foreign_poses(root)) if root.is_dir() else ""
    photographs = root if not root.is_dir() or find_images(root) else "PHOTOGRAPHS"
    raise CaptureError(
        f"{root}: not a capture. {partial_model(root)}{others}Looked for a COLMAP model (sparse/0/cameras.bin and "
        "images.bin, or .txt), transforms.json (nerfstudio), train/metadata/*.pt (Mega-NeRF), transforms_train.json "
        "(MatrixCity), cams/*_cam.txt (MVSNet), poses_bounds.npy (LLFF) "
        f"and projects of {', '.join(form.program for form in PROJECTS.values())}. Photographs alone "
        f"become one first: vdgs sfm {shell_word(photographs)} --output CAPTURE"
    )


def lacks_points(path: Path, options: CaptureOptions) -> bool:
    """Whether a folder, or a file, is a capture or a project with poses, whose points are to be found first. Raises as
    `read_source`."""
    is_capture, models = any(is_here(path) for is_here, _ in READERS.values()), find_models(path)
    if is_transforms(path):
        path, options, models, is_capture = path.parent, replace(options, format="transforms"), [], True
    if is_capture and (has_points(_biggest(models)) if models else find_point_cloud(path, lone=True) is not None):
        return False  # the usual case, without reading it all
    if not is_capture and not is_project(path):
        return False
    try:
        read_source(path, options)
    except NoTiePoints:
        return True
    return False


def _read(root: Path, name: str, options: CaptureOptions, needs_points: bool) -> SourceCapture:
    """The capture of a format that is there."""
    if name in PROJECTS:
        return read_project(root, name, options, needs_points=needs_points)
    if name == "mega-nerf":  # train/ and val/ each have a folder of this name
        check_folder("--images", options.images)
        return READERS[name][1](root, options, needs_points)
    return READERS[name][1](root, _with_image_folder(root, options), needs_points)


def check_folder(flag: str, folder: str | None) -> None:
    """Raise `CaptureError` for an option that must name a folder inside the capture, and does not."""
    if folder is not None and (Path(folder).is_absolute() or ".." in Path(folder).parts or not folder):
        raise CaptureError(f"{flag} {folder}: must be a folder inside the capture, such as images_4.")


def _with_image_folder(root: Path, options: CaptureOptions) -> CaptureOptions:
    """The options with `--images` by its path in the capture, or where it lies elsewhere by its absolute path. Raises
    `CaptureError` where it is not there."""
    if options.images is None:
        return options
    if not options.images or not ((root / options.images).is_dir() or Path(options.images).is_dir()):
        present = sorted(entry.name for entry in root.iterdir() if entry.is_dir())
        raise CaptureError(
            f"--images {options.images}: no such folder, neither in {root} nor from here. Present in the capture: "
            f"{', '.join(present) or 'none'}."
        )
    folder = image_root(root, options)
    return replace(options, images=(folder.relative_to(root) if folder.is_relative_to(root) else folder).as_posix())


def _of_both(root: Path, options: CaptureOptions, needs_points: bool) -> SourceCapture:
    """One of a COLMAP model and transforms.json, with a note about the other."""
    model = _biggest(find_models(root)).relative_to(root)
    theirs = f"the COLMAP model in {model}" if model.parts else "the COLMAP model"
    says = exclusive_information(root / TRANSFORMS_FILE)
    if not says:
        note = f"{theirs} is read; {TRANSFORMS_FILE} beside it is not (--format transforms reads that instead)."
        source = _read_colmap(root, options, needs_points)
        return replace(source, warnings=(note, *source.warnings))
    try:
        source = read_transforms(root, options, needs_points)
    except NoTiePoints:
        raise
    except CaptureError as error:
        raise CaptureError(f"{error}\nOr read {theirs} instead: --format colmap") from error
    note = f"{TRANSFORMS_FILE} is read, for its {says}; {theirs} is not (--format colmap reads that instead)."
    return replace(source, warnings=(note, *source.warnings))


def _biggest(models: list[Path]) -> Path:
    return max(models, key=count_images)


def _read_colmap(root: Path, options: CaptureOptions, needs_points: bool) -> SourceCapture:
    warnings, models = [], find_models(root)
    folder = _biggest(models)
    distinct = [model for model in models if model.resolve() != folder.resolve()]
    if distinct:
        sizes = ", ".join(f"{model.relative_to(root)} ({count_images(model)})" for model in models)
        warnings.append(f"several sparse models: {sizes} images; the biggest is used.")
    images, image_warnings = image_folder(root, options, _is_bent(folder))
    for larger in larger_models_beside(root, folder):
        warnings.append(
            f"{larger.relative_to(root)} holds {count_images(larger)} images, and {folder.relative_to(root)}, which is "
            f"read, {count_images(folder)}. To use the larger: vdgs run {shell_word(larger)} --images "
            f"{shell_word((root / images).absolute())} --output RUN"
        )
    if has_both_kinds(folder):
        warnings.append(f"{folder.relative_to(root) / 'images.bin'} is read; images.txt beside it is not.")
    model = read_colmap(folder, options.strict)
    warnings += model.notes
    if not model.views:
        raise CaptureError(f"{folder}: the model holds no registered images. Run the reconstruction again.")
    points, colors = model.points, model.colors
    if not len(points):
        cloud = find_point_cloud(folder, folder.parent, root, lone=True)
        if cloud is not None:
            points, colors = read_point_cloud(cloud)
            warnings.append(f"the model holds no points; those of {cloud.relative_to(root)} are used.")
        elif needs_points:
            raise no_points(
                root, options.images, f"{folder}: the model holds",
                "Or keep points3D.bin or points3D.txt beside the images of the model, or put a point cloud in the same "
                f"world there as {POINT_CLOUDS[0]}.",
            )  # fmt: skip
    return SourceCapture(
        source="colmap", images=images, views=model.views, points=points, colors=colors,
        image_folders=(root / images,), warnings=(*warnings, *image_warnings),
    )  # fmt: skip


def use_image_folder(source: SourceCapture, root: Path, name: str) -> SourceCapture:
    """A COLMAP capture that was read without `--images`, with the photographs of another folder."""
    _, notes = image_folder(root, CaptureOptions(), _is_bent(_biggest(find_models(root))))
    kept = tuple(note for note in source.warnings if note not in notes)
    return replace(source, images=name, image_folders=(root / name,), warnings=kept)


def _is_bent(model: Path) -> bool:
    return any(lens.is_distorted for lens in read_lenses(model))


#: Of each format, in the order in which they are looked for: whether a folder holds it, and its reader.
#: The readers take whether they need points.
READERS: dict[str, tuple[Callable[[Path], object], Callable[[Path, CaptureOptions, bool], SourceCapture]]] = {
    "mega-nerf": (is_mega_nerf, read_mega_nerf),
    "matrixcity": (pose_files, read_matrixcity),
    "colmap": (find_models, _read_colmap),
    "transforms": (lambda root: (root / TRANSFORMS_FILE).is_file(), read_transforms),
    "mvsnet": (is_mvsnet, read_mvsnet),
    "llff": (is_llff, read_llff),
}
