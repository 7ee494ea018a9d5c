"""From matches to models: with the focal length held or fitted, and with fisheyes where the photographs tell them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

from rich.console import Console
from rich.markup import escape

from vdgs.errors import CaptureError
from vdgs.sfm import fisheyes, focal_decision, global_mapper, incremental_mapper
from vdgs.sfm.camera_rigs import map_rigs, take_rigs_apart
from vdgs.sfm.feature_extraction import CameraGroup
from vdgs.sfm.reconstruction_plan import ReconstructionPlan
from vdgs.sfm.workspace import Workspace
from vdgs.system.lazy_pycolmap import pycolmap


def map_photographs(
    plan: ReconstructionPlan,
    workspace: Workspace,
    kinds: Sequence[CameraGroup],
    key: str,
    count: int,
    console: Console,
) -> tuple[list[pycolmap.Reconstruction], tuple[bool, str]]:
    """The models, and whether the focal length was held and why; anew where the first show that lenses are fisheyes."""
    is_open = plan.request.options.camera_model == "auto"  # whether the photographs may tell the lenses
    found = fisheyes.read_found(workspace, key) if is_open else []
    if not found and workspace.fisheyes_file.exists():  # found among other pairs, by another focal length, or not asked
        fisheyes.use_lenses(workspace, kinds, key, plan.threads, console)
        workspace.fisheyes_file.unlink()
    first = list[pycolmap.Reconstruction]()
    if not found and is_open and not _is_begun_anew(workspace, key):
        first, found = _find_fisheyes(plan, workspace, kinds, key, count, console)
    if not found:
        return _mapped_as_told(plan, workspace, kinds, key, count, console, first)
    kinds = fisheyes.with_fisheyes(kinds, found)
    bent = {photo.name: photo for kind in kinds for photo in kind.images}
    photographs = tuple(bent.get(photo.name, photo) for photo in plan.image_list.images)
    plan = replace(plan, image_list=replace(plan.image_list, images=photographs))
    fisheyes.use_lenses(workspace, kinds, key, plan.threads, console)
    return _mapped_as_told(plan, workspace, kinds, f"{key}, fisheyes", count, console)


def _mapped_as_told(
    plan: ReconstructionPlan,
    workspace: Workspace,
    kinds: Sequence[CameraGroup],
    key: str,
    count: int,
    console: Console,
    first: list[pycolmap.Reconstruction] | None = None,
) -> tuple[list[pycolmap.Reconstruction], tuple[bool, str]]:
    """The models by these lenses, and whether the focal length was held and why; anew where the first, which may be
    given, show that it must not be, or must be."""
    meant = focal_decision.should_fix_focal(plan.image_list.images, plan.gps_priors, plan.request.options)
    fitting, holding = _keys_anew(key)
    if not _is_begun_anew(workspace, key):
        models = first or make_models(plan, workspace, key, count, meant[0], console)
        held = focal_decision.release_focal(models, meant, kinds, plan.threads)
        if workspace.is_done("focal", key):
            return models, held
        if focal_decision.is_contradicted(models[0], held, kinds, plan.threads):
            why = "the photographs contradict the focal length that is held; it is fitted, all anew"
        elif focal_decision.is_kept_by_flat_points(models[0], meant, held, kinds, plan.threads):
            why = "the photographs tell another focal length than one tag alone says; it is fitted, all anew"
        elif not meant[0] and focal_decision.is_astray(models[0], held, kinds):
            why = "the fitted focal length is far from what tags that agree say; it is held, all anew"
            incremental_mapper.set_models_aside(workspace, workspace.models_fitted)
        else:
            workspace.finish("focal", key)
            return models, held
        console.print(f"[yellow]note[/] {why}", highlight=False)
    if not meant[0]:
        return _held_anew(plan, workspace, holding, count, meant, console)
    return make_models(plan, workspace, fitting, count, False, console), (False, focal_decision.CONTRADICTED)


def _keys_anew(key: str) -> tuple[str, str]:
    """Of models that are made anew with the focal length fitted, and held."""
    return f"{key}, focal length fitted", f"{key}, focal length held"


def _is_begun_anew(workspace: Workspace, key: str) -> bool:
    return any(workspace.is_begun("model", anew) for anew in _keys_anew(key))


def _find_fisheyes(
    plan: ReconstructionPlan,
    workspace: Workspace,
    kinds: Sequence[CameraGroup],
    key: str,
    count: int,
    console: Console,
) -> tuple[list[pycolmap.Reconstruction], list[int]]:
    """The models with lenses as tags say them, and the numbers of cameras that they show to be fisheyes; all that may
    be where there is no model."""
    held = focal_decision.should_fix_focal(plan.image_list.images, plan.gps_priors, plan.request.options)[0]
    try:
        models = make_models(plan, workspace, key, count, held, console)
    except CaptureError as error:
        models, found = [], fisheyes.candidates(kinds)
        if not found:
            raise
        why = f"with perspective lenses: {error} Now with fisheyes, all anew"
    else:
        if workspace.is_done("focal", key):  # looked at before
            return models, []
        found = fisheyes.candidates(kinds, models[0])
        errors = fisheyes.compare(models[0], kinds, found, plan.threads) if found else None
        if errors is None:
            return models, []
        names = ", ".join(dict.fromkeys(kinds[number - 1].camera for number in found))
        why = (
            f"{names}: a fisheye, as the photographs tell: points lie {errors[1]:.2g} px from where they are seen, "
            f"{errors[0]:.2g} px with a perspective lens; mapped so, all anew"
        )
    console.print(f"[yellow]note[/] {escape(why)}", highlight=False)
    fisheyes.write_found(workspace, key, found)
    return models, found


def _held_anew(
    plan: ReconstructionPlan, workspace: Workspace, key: str, count: int, meant: tuple[bool, str], console: Console
) -> tuple[list[pycolmap.Reconstruction], tuple[bool, str]]:
    """Models with the focal length held, and why it is; where these are worse, those that were set aside, for which it
    was `meant` to be fitted."""
    try:
        models = make_models(plan, workspace, key, count, True, console)
    except CaptureError as error:  # none can be made
        models = []
        console.print(f"[yellow]note[/] with the focal length held: {escape(str(error))}", highlight=False)
    fitted = incremental_mapper.read_models(workspace, workspace.models_fitted)
    if focal_decision.is_held_as_good(models, fitted):
        return models, (True, focal_decision.CONFIRMED)
    console.print("[yellow]note[/] held, the photographs fit together worse; it stays fitted", highlight=False)
    return fitted, meant


def make_models(
    plan: ReconstructionPlan, workspace: Workspace, key: str, count: int, fix_focal: bool, console: Console
) -> list[pycolmap.Reconstruction]:
    if not workspace.is_done("model", key):
        if not workspace.is_begun("model", key):
            workspace.forget("model", "joined", "rigs", "focal")  # before: what is done is read
            incremental_mapper.delete_models(workspace)
            take_rigs_apart(workspace, plan.image_list.images)
            workspace.begin("model", key)
        incremental_mapper.run_mapper(workspace, count, fix_focal, plan.threads, console)
        workspace.finish("model", key)
    if not workspace.is_done("joined", key):
        if not workspace.is_begun("joined", key) and global_mapper.leaves_photographs_out(workspace):
            incremental_mapper.set_models_aside(workspace)
            workspace.begin("joined", key)
        if workspace.is_begun("joined", key):
            global_mapper.place_left_out(workspace, count, fix_focal, plan.threads, console)
        workspace.finish("joined", key)
    if any(photo.sensor for photo in plan.image_list.images) and not workspace.is_done("rigs", key):
        if not workspace.is_begun("rigs", key):
            incremental_mapper.set_models_aside(workspace)
            workspace.begin("rigs", key)
        map_rigs(workspace, plan.image_list.images, count, fix_focal, plan.threads, console)
        workspace.finish("rigs", key)
    # Read even if they are in memory: the order of their points decides the last bits of what follows.
    return incremental_mapper.read_models(workspace)
