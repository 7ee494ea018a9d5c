"""The size at which a new run uses photographs, where nobody names one: the largest that takes about an hour."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path

from rich.console import Console

from vdgs.captures.capture import Capture
from vdgs.captures.format_dispatch import use_image_folder
from vdgs.captures.image_files import read_header
from vdgs.captures.loading import make_capture, read_files
from vdgs.config.capture_options import CaptureOptions
from vdgs.config.commands import RunRequest
from vdgs.config.method import AUTO_BLOCK_ITERATIONS, MethodConfig, ResolutionSchedule, resolve_iterations
from vdgs.kernels import default_num_threads
from vdgs.runs.run_folder import RunFolder
from vdgs.runs.run_settings import with_absolute_paths
from vdgs.system.memory.process_memory import available_memory_bytes
from vdgs.system.units import rough_duration

#: Pixels that a core trains in a second, all of a run included (0.4 and 0.8 million on two captures), and the limit.
PIXELS_PER_CORE_SECOND, MAX_SECONDS = 0.5e6, 3600.0
#: Memory that a pixel of a photograph takes while it trains, and the share of the free memory that may be taken.
BYTES_PER_PIXEL, MEMORY_SHARE = 400, 0.5
#: Longer side of photographs that are never shrunk further, however long it takes, and at most on a GPU (as in 3DGS).
MIN_SIDE, MAX_GPU_SIDE = 400, 1600
#: How many photographs a block gets, as a multiple of the photographs of the scene divided by the number of blocks.
BLOCK_OVERLAP = 1.3
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


def choose_image_size(request: RunRequest, console: Console) -> RunRequest:
    """The request of `open_at_suitable_size`."""
    return open_at_suitable_size(request, console)[0]


def open_at_suitable_size(request: RunRequest, console: Console) -> tuple[RunRequest, Capture | None]:
    """The request with the size of photographs that suits the machine, and its capture; the request as it is and no
    capture where it names a size, and where the run is there already. Raises what `load_capture` raises."""
    if (
        request.options.images is not None
        or request.options.downscale != 1
        or RunFolder(request.output).config_file.exists()
    ):
        return request, None
    root, options, method = request.capture.resolve(), with_absolute_paths(request.options), request.method()
    source = read_files(root, options)
    capture = make_capture(root, source, options)
    sizes = image_sizes(capture, options)
    cores = request.threads or default_num_threads()
    seconds = {size: run_seconds(method, len(capture.train_views), size.pixels, cores) for size in sizes}
    chosen = largest_suitable(seconds, available_memory_bytes(), on_gpu=request.device != "cpu")
    on_cpu = f", about {rough_duration(seconds[chosen])} on {cores} cores" if request.device == "cpu" else ""
    largest = "" if chosen == sizes[0] else f", not {sizes[0].name}"
    console.print(f"photographs: {chosen.name}{largest}{on_cpu}; --images overrides", markup=False, highlight=False)
    if chosen == sizes[0]:
        return request, capture
    images = None if chosen.images == capture.images else chosen.images
    if images is not None:
        source = use_image_folder(source, root, images)
    options = replace(options, images=images, downscale=chosen.downscale)
    return replace(request, options=options), make_capture(root, source, options)


def image_sizes(capture: Capture, options: CaptureOptions) -> list[ImageSize]:
    """The sizes that photographs can be used at, largest first: every folder of a COLMAP capture, and the smallest of
    them shrunk. The first is what is used if nothing is said."""
    camera = max((view.camera for view in capture.views), key=lambda camera: camera.width * camera.height)
    full = ImageSize(images=capture.images, downscale=1, width=camera.width, height=camera.height)
    sizes = [full]
    if capture.source == "colmap" and not options.undistort:
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


def run_seconds(method: MethodConfig, num_views: int, pixels: int, cores: int) -> float:
    """How long a run trains on a CPU, by the pixels that its steps draw."""
    training, block = resolve_iterations(method.training, num_views), method.block
    per_view, least, _ = AUTO_BLOCK_ITERATIONS
    blocks = method.partition.blocks if isinstance(method.partition.blocks, int) else 1
    steps = block.iterations * blocks or max(per_view * round(num_views * BLOCK_OVERLAP), least)
    shares = training.iterations * _pixel_share(training.resolution_schedule)
    shares += block.steps_scaler * steps * _pixel_share(block.resolution_schedule)
    return pixels * shares / (PIXELS_PER_CORE_SECOND * cores)


def _pixel_share(schedule: ResolutionSchedule) -> float:
    """The mean share of a photograph's pixels that a step draws."""
    ends = [start for start, _ in schedule[1:]] + [1.0]
    return sum(max(0.0, end - start) / factor**2 for (start, factor), end in zip(schedule, ends, strict=True))


def largest_suitable(seconds: dict[ImageSize, float], free_bytes: int, *, on_gpu: bool) -> ImageSize:
    """The largest size that time and memory allow, or the smallest that still shows something."""
    usable = [size for size in seconds if max(size.width, size.height) >= MIN_SIDE] or list(seconds)[:1]

    def fits(size: ImageSize) -> bool:
        in_time = max(size.width, size.height) <= MAX_GPU_SIDE if on_gpu else seconds[size] <= MAX_SECONDS
        return in_time and size.pixels * BYTES_PER_PIXEL <= MEMORY_SHARE * free_bytes

    return next((size for size in usable if fits(size)), usable[-1])
