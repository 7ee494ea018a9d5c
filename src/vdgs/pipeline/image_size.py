"""The size at which a new run uses photographs, where nobody names one: the largest whose training takes about an hour,
by the same probe and the same estimate as `vdgs run --dry-run`."""

from __future__ import annotations

import tempfile
from dataclasses import dataclass, replace
from pathlib import Path

from rich.console import Console

from vdgs.captures.capture import Capture
from vdgs.captures.format_dispatch import use_image_folder
from vdgs.captures.image_files import read_header
from vdgs.captures.loading import make_capture, read_files
from vdgs.config.capture_options import CaptureOptions
from vdgs.config.commands import RunRequest
from vdgs.config.method import resolve_iterations
from vdgs.pipeline.assumed_scene import assumed_cameras, assumed_capture
from vdgs.pipeline.run_estimate import RunEstimate, Scene, estimate_at, probe
from vdgs.runs.run_folder import RunFolder
from vdgs.runs.run_settings import with_absolute_paths
from vdgs.sfm.capture_writer import IMAGE_SIZES
from vdgs.sfm.reconstruction_plan import ReconstructionPlan
from vdgs.sfm.sfm_estimate import SfmEstimate
from vdgs.system.memory.process_memory import available_memory_bytes

#: Seconds on idle threads that training may take.
MAX_SECONDS = 3600.0
#: Memory that a pixel of a photograph takes while it trains, and the share of the free memory that may be taken.
BYTES_PER_PIXEL, MEMORY_SHARE = 400, 0.5
#: Longer side of photographs that are never shrunk further, however long it takes, and at most on a GPU (as in 3DGS).
MIN_SIDE, MAX_GPU_SIDE = 400, 1600
DOWNSCALES = (1, 2, 3, 4, 6, 8, 12, 16)


@dataclass(frozen=True, kw_only=True)
class ImageSize:
    """One way to use the photographs of a capture."""

    images: str
    downscale: float
    width: int
    height: int

    @property
    def pixels(self) -> int:
        return self.width * self.height

    @property
    def name(self) -> str:
        shrunk = f" with --downscale {self.downscale:g}" if self.downscale > 1 else ""
        return f"{self.images}{shrunk} ({self.width}x{self.height})"


@dataclass(frozen=True, kw_only=True)
class SizeChoice:
    """What was chosen."""

    request: RunRequest
    """With the size."""
    capture: Capture | None = None
    """Where it was read, and reads the same with the options of the request."""
    estimate: RunEstimate | None = None
    """Of the run with that size; None where nothing had to be chosen."""


def choose_image_size(request: RunRequest, console: Console) -> SizeChoice:
    """The request with the size of photographs that suits the machine; as it is where it names one, and where the run
    is there already. Raises what `load_capture` raises."""
    if names_size(request):
        return SizeChoice(request=request)
    root, options = request.capture.resolve(), with_absolute_paths(request.options, request.capture)
    source = read_files(root, options)
    capture = make_capture(root, source, options)
    sizes = image_sizes(capture, options)
    chosen, estimate = _choose(scene_of(capture), sizes, request, console)
    if chosen == sizes[0]:
        return SizeChoice(request=request, capture=capture, estimate=estimate)
    images = None if chosen.images == capture.images else chosen.images
    if images is not None:
        source = use_image_folder(source, root, images)
    options = replace(options, images=images, downscale=chosen.downscale)
    return SizeChoice(
        request=replace(request, options=options), capture=make_capture(root, source, options), estimate=estimate
    )


def choose_for_photographs(
    request: RunRequest, plan: ReconstructionPlan, sfm: SfmEstimate, console: Console
) -> SizeChoice:
    """The size, before photographs become a capture, and what the whole job takes; only the latter where the request
    names a size."""
    named = names_size(request)
    options = request.options if named else replace(request.options, images=IMAGE_SIZES[0][0])
    camera = assumed_cameras(plan, options)[0]
    full = ImageSize(images=options.images or IMAGE_SIZES[0][0], downscale=1, width=camera.width, height=camera.height)
    sizes = [full]
    if not named:
        smaller = [(name, factor, 1) for name, factor in IMAGE_SIZES[1:]]
        smaller += [(IMAGE_SIZES[-1][0], IMAGE_SIZES[-1][1] * more, more) for more in DOWNSCALES[1:]]
        sizes += [
            ImageSize(images=name, downscale=more, width=full.width // factor, height=full.height // factor)
            for name, factor, more in smaller
            if factor <= min(full.width, full.height)
        ]
    with tempfile.TemporaryDirectory(prefix="vdgs-") as folder:
        trained, tested = count_views(len(plan.image_list.images), request.options)
        timed = assumed_capture(plan, options, sfm.points, Path(folder))
        scene = Scene(timed, [camera] * trained, tested, sfm.points)
        if plan.preflight.views_per_point:
            scene = replace(scene, views_per_point=plan.preflight.views_per_point)
        if named:
            estimate = _estimates(scene, sizes, request)[full]
            return SizeChoice(request=request, estimate=with_photographs(estimate, sfm))
        chosen, estimate = _choose(scene, sizes, request, console, sfm)
    options = replace(request.options, images=chosen.images, downscale=chosen.downscale)
    return SizeChoice(request=replace(request, options=options), estimate=estimate)


def count_views(num_images: int, options: CaptureOptions) -> tuple[int, int]:
    """How many of so many photographs will train, and how many are kept for testing."""
    count = min(num_images, options.max_images or num_images)
    tested = -(-count // options.test_every)
    return count - tested, tested


def with_photographs(estimate: RunEstimate, sfm: SfmEstimate) -> RunEstimate:
    """The estimate of the whole job."""
    slowdown = max(sfm.slowdown, estimate.slowdown)
    return replace(estimate, times={"photographs": sfm.total, **estimate.times}, slowdown=slowdown)


def names_size(request: RunRequest) -> bool:
    """Whether a request says how large photographs are, or the run is there, which goes on as it began."""
    options = request.options
    return options.images is not None or options.downscale != 1 or RunFolder(request.output).config_file.exists()


def scene_of(capture: Capture) -> Scene:
    cameras = [view.camera for view in capture.train_views]
    return Scene(capture, cameras, len(capture.test_views), len(capture.points))


def estimate_capture(capture: Capture, request: RunRequest) -> RunEstimate:
    """What a run of a capture takes, at the size at which it was read."""
    camera = capture.train_views[0].camera
    size = ImageSize(images=capture.images, downscale=1, width=camera.width, height=camera.height)
    return _estimates(scene_of(capture), [size], request)[size]


def _choose(
    scene: Scene, sizes: list[ImageSize], request: RunRequest, console: Console, sfm: SfmEstimate | None = None
) -> tuple[ImageSize, RunEstimate]:
    """The size that suits the machine, said in a line, with what the run takes."""
    on_gpu = request.device != "cpu"
    estimates = _estimates(scene, sizes, request)
    seconds = {size: estimate.total.seconds for size, estimate in estimates.items()}
    chosen = largest_suitable(seconds, available_memory_bytes(), on_gpu=on_gpu)
    estimate = estimates[chosen] if sfm is None else with_photographs(estimates[chosen], sfm)
    largest = "" if chosen == sizes[0] else f", not {sizes[0].name}"
    takes = f"{'training' if sfm is None else 'the whole job'} takes {estimate.text()}"
    console.print(f"photographs: {chosen.name}{largest}; {takes}; --images overrides", markup=False, highlight=False)
    return chosen, estimate


def _estimates(scene: Scene, sizes: list[ImageSize], request: RunRequest) -> dict[ImageSize, RunEstimate]:
    """Of a run at each size, by one probe of seconds."""
    method, full = request.method(), sizes[0]
    method = replace(method, training=resolve_iterations(method.training, len(scene.cameras)))
    factors = {size: full.width / size.width for size in sizes}
    probed = probe(scene, method, request, sorted(set(factors.values())))
    return {size: estimate_at(scene, probed, method, request, factor) for size, factor in factors.items()}


def image_sizes(capture: Capture, options: CaptureOptions) -> list[ImageSize]:
    """The sizes that photographs can be used at, largest first: every folder of a COLMAP capture, and the smallest of
    them shrunk. The first is what is used if nothing is said."""
    camera = max((view.camera for view in capture.views), key=lambda camera: camera.width * camera.height)
    full = ImageSize(images=capture.images, downscale=1, width=camera.width, height=camera.height)
    sizes = [full]
    in_folder = all(view.image_path.is_relative_to(capture.root / capture.images) for view in capture.views)
    if capture.source == "colmap" and in_folder and not options.undistort:
        for folder in capture.root.glob("images_*"):
            if folder.is_dir() and folder.name.removeprefix("images_").isdigit() and folder.name != capture.images:
                sizes += _size_in(folder, capture, full)
    smallest = min(sizes, key=lambda size: size.pixels)
    for factor in DOWNSCALES[1:]:
        width, height = round(smallest.width / factor), round(smallest.height / factor)
        sizes.append(ImageSize(images=smallest.images, downscale=factor, width=width, height=height))
    return sorted(sizes, key=lambda size: -size.pixels)


def _size_in(folder: Path, capture: Capture, full: ImageSize) -> list[ImageSize]:
    """The size of photographs in a folder that has all of them smaller; none where it does not."""
    files = [folder / view.image_path.relative_to(capture.root / capture.images) for view in capture.views]
    if not all(file.is_file() for file in files):
        return []
    header = read_header(files[0])
    size = ImageSize(images=folder.name, downscale=1, width=header.width, height=header.height)
    return [size] if size.pixels < full.pixels else []


def largest_suitable(seconds: dict[ImageSize, float], free_bytes: int, *, on_gpu: bool) -> ImageSize:
    """The largest size that time and memory allow, or the smallest that still shows something."""
    usable = [size for size in seconds if max(size.width, size.height) >= MIN_SIDE] or list(seconds)[:1]

    def fits(size: ImageSize) -> bool:
        in_time = max(size.width, size.height) <= MAX_GPU_SIDE if on_gpu else seconds[size] <= MAX_SECONDS
        return in_time and size.pixels * BYTES_PER_PIXEL <= MEMORY_SHARE * free_bytes

    return next((size for size in usable if fits(size)), usable[-1])
