"""What a command is asked to do, as plain objects: the rooms that do the work need not know the command line."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Literal

from vdgs.config.capture_options import CaptureOptions
from vdgs.config.executor_options import CheckpointOptions, ExecutorOptions
from vdgs.config.method import AssignmentConfig, BlockConfig, MergeConfig, MethodConfig, PartitionConfig, TrainConfig
from vdgs.config.output_paths import Output
from vdgs.config.presets import PresetChoice
from vdgs.config.ranges import MAX_COUNT, MAX_FLOAT, WORKER_COUNT, FlagName, Positional, Range, Repeatable
from vdgs.config.sfm_options import SfmOptions

#: Groups by visibility: with more than some dozens none holds enough pixels to say anything.
BIN_COUNT_RANGE = Range(1, 100)
#: Length and pace of a film; 0 leaves them to the path. Encoders take no more frames a second.
SECONDS_RANGE, FPS_RANGE = Range(0, 86_400), Range(0.1, 1000, allow_zero=True)
#: The longest side of a picture that is drawn, in pixels: more than any film and any screen holds.
MAX_RENDER_SIDE_PX = 16_384
#: What drawing takes at most of memory for each pixel: the raster, its depth, pictures made of it.
RENDER_BYTES_PER_PIXEL = 100
#: Frames of one film: nearly two hours at 30 a second.
MAX_FRAMES = 200_000

#: Coordinates of maps: no system on Earth has larger ones (Earth-centered metres have seven digits).
MAP_COORDINATE_RANGE = Range(-1e9, 1e9)

#: `best` is the merged model where there is one for the run's settings, else the coarse one.
ModelName = Literal["best", "coarse", "merged"]


#: Degree of the spherical harmonics that a scene is baked with where none is asked for.
DEFAULT_SH_DEGREE = 3
#: Programs that `vdgs export --for` writes for, and names of axes (`export.programs`, `export.formats.axes`).
ProgramName = Literal["supersplat", "playcanvas", "spark", "gaussiansplats3d", "cesium", "blender", "unity"]
AxesName = Literal["z-up", "y-up", "y-down", "y-up-left"]


@dataclass(frozen=True, kw_only=True)
class ComputeOptions:
    """Where and how widely a command computes."""

    threads: Annotated[int, WORKER_COUNT] = 0
    """Threads of the kernels; 0 for all cores. The result does not depend on it."""
    device: str = "auto"
    """Where to compute: auto, cpu, cuda or cuda:0. `auto` takes a GPU only if every operation runs on it; cuda:0 is
    that card alone."""


@dataclass(frozen=True, kw_only=True)
class RunPath:
    """A run that is there."""

    run: Annotated[Path, Positional(is_run=True)]
    """Run folder."""


@dataclass(frozen=True, kw_only=True)
class ModelRequest(RunPath, ComputeOptions):
    """A model of a run that is there."""

    model: ModelName = "best"
    """Which model. `best` is the merged one where there is one."""


@dataclass(frozen=True, kw_only=True)
class RunRequest(ComputeOptions):
    """Everything from a capture to a report (`vdgs run`)."""

    capture: Annotated[Path, Positional()]
    """Folder of the capture, or of photographs alone, or a film. These become one in RUN/capture first (`vdgs sfm`)."""
    output: Annotated[Path, Output()]
    """Run folder; new, or the run to continue."""
    preset: PresetChoice = "auto"
    """Settings by name. `auto`: those of the run that is there, else `laptop`. `laptop`: steps by the number of
    photographs, minutes to an hour on a CPU. `default`: the paper's numbers (100 000 + 50 000 iterations a block),
    and our choices where it is silent: gaps filled, outliers left out, a background of the mean color, of random
    colors in training, bounded sizes, cameras by `coverage` and each in its best block, a minimum of cameras a
    block, blocks drawn in their surroundings, a lower gate of compensated growth, g added to means, only visible
    anchors moved. `paper`: the paper as printed; docs/paper.md lists what it takes where the paper is silent."""
    overwrite: bool = False
    """Let other settings discard what was trained with the old ones."""
    jobs: Annotated[int, WORKER_COUNT] = 0
    """Blocks trained at once; 0 takes what there is room for. On a cluster also shards of other stages."""
    allow_missing_blocks: bool = False
    """Go on if a block fails: the coarse model stands in for it."""
    ortho: bool = True
    """End with maps in RUN/maps. Orthophoto, surface model and visibility as GeoTIFFs, where `vdgs ortho` can make
    them."""
    lod: bool = True
    """Make levels of detail of a merged scene of more than a million anchors (`vdgs lod`)."""
    lpips_weights: Path | None = None
    """VGG16 weights for LPIPS (torchvision's vgg16 state dict, .pth or .safetensors). Nothing is downloaded."""
    visibility_bins: Annotated[int, BIN_COUNT_RANGE] = 4
    """Number of visibility quantiles by which metrics are reported."""
    options: Annotated[CaptureOptions, FlagName("")] = field(default_factory=CaptureOptions)
    sfm: SfmOptions = field(default_factory=SfmOptions)
    training: Annotated[TrainConfig, FlagName("")] = field(default_factory=TrainConfig)
    partition: Annotated[PartitionConfig, FlagName("")] = field(default_factory=PartitionConfig)
    assignment: AssignmentConfig = field(default_factory=AssignmentConfig)
    block: BlockConfig = field(default_factory=BlockConfig)
    merge: MergeConfig = field(default_factory=MergeConfig)
    checkpointing: Annotated[CheckpointOptions, FlagName("")] = field(default_factory=CheckpointOptions)
    executor_options: Annotated[ExecutorOptions, FlagName("")] = field(default_factory=ExecutorOptions)
    extra_image_folders: Annotated[tuple[Path, ...], Positional("MORE")] = ()
    """More folders of photographs, where CAPTURE is one."""

    def method(self) -> MethodConfig:
        """The settings that the result depends on."""
        return MethodConfig(self.training, self.partition, self.assignment, self.block, self.merge)


@dataclass(frozen=True, kw_only=True)
class LodRequest(RunPath):
    """A level-of-detail tree of a run (`vdgs lod`)."""

    model: ModelName = "best"
    """Which model. `best` is the merged one where there is one."""


@dataclass(frozen=True, kw_only=True)
class RenderRequest(ModelRequest):
    """Views of a run, or a camera path, as PNG files or a film (`vdgs render`)."""

    output: Annotated[Path, Output()]
    """Folder for PNG files, or a film, NAME.mp4. The folder is new, empty, or filled by an earlier render, which is
    replaced."""
    views: Literal["test", "train", "orbit", "flyover"] = "test"
    """Which cameras. `orbit` and `flyover` are paths made from the capture."""
    path: Path | None = None
    """Camera path; overrides --views. The folder of a COLMAP model in the world of the capture, whose images become the
    frames in order of their names, or a JSON file: one exported by nerfstudio's viewer, with the
    dataparser_transforms.json of that training beside it, one folder up or in the capture, or
    {"keyframes": [{"position": [x, y, z], "look_at": [x, y, z], "fov_deg": 60}, ...]} in the ground frame; beside it,
    as you like, "frame": "source" (that of the capture's own cameras), "seconds", "fps", "closed", "interpolate". A key
    frame may also have "up", "width", "height", "fx", "fy", "cx", "cy", or in place of position and look_at a matrix
    "camera_from_world" (docs/conventions.md)."""
    seconds: Annotated[float, SECONDS_RANGE] = 0.0
    """Length of a camera path; 0: what its file says, or 12 seconds."""
    fps: Annotated[float, FPS_RANGE] = 0.0
    """Frames per second of a camera path and of the video; 0: what its file says, or 30 (2 for separate views)."""
    width: Annotated[int, Range(0, MAX_RENDER_SIDE_PX)] = 0
    """Image width; 0 takes that of the training views."""
    capture: Path | None = None
    """Where the capture lies now; needed only where the run has lost its cameras.json."""
    min_visibility: Annotated[int | None, Range(0, MAX_COUNT)] = None
    """Fade out where fewer training cameras see the scene (V): its edge, with its shreds; 0: draw all. Default: 2 in
    pictures of camera paths, 0 in those of --views test and train and in maps."""
    mode: Literal["rgb", "depth", "visibility", "alpha"] = "rgb"
    """What to draw: the picture; the median depth, at which a pixel becomes half opaque (gray where it never does); the
    number of training cameras that see each place, V; or alpha, how opaque the scene is."""
    lod_error: Annotated[float | None, Range(0, MAX_RENDER_SIDE_PX)] = None
    """Draw through the run's level-of-detail tree (`vdgs lod`), at most so many pixels off. By default, and with 0,
    everything is drawn from all anchors."""
    antialiasing: Literal["auto", "on", "off"] = "auto"
    """Draw pictures without aliasing from farther away than the photographs were taken: splats that a pixel enlarges
    become as much more transparent (docs/lod.md). auto: only with --lod-error above 0. Maps stay as they are."""
    colorbar: bool = True
    """Put a strip with the scale of the colors below each map; without it a map is as large as the image."""
    raw: bool = False
    """Also write the numbers of a map, NAME.npy beside NAME.png: float32 [height, width]. Depth is z along the view in
    units of the ground frame (metres where known); depth and V are NaN where nothing is drawn."""

    @property
    def is_antialiased(self) -> bool:
        return self.antialiasing == "on" or (self.antialiasing == "auto" and bool(self.lod_error))


@dataclass(frozen=True, kw_only=True)
class OrthoRequest(ModelRequest):
    """Maps of a run as GeoTIFFs and pictures (`vdgs ortho`)."""

    output: Annotated[Path | None, Output()] = None
    """Folder for the maps, not among photographs nor with such files of others; by default RUN/maps. Of a run that is
    given here, its folder of maps."""
    gsd: Annotated[float | None, Range(0, MAX_FLOAT, exclusive_min=True)] = None
    """Side of a pixel in units of the map, mostly metres. By default the median that a pixel of the training
    photographs shows of the ground, at the size at which they were used."""
    bbox: Annotated[tuple[float, float, float, float] | None, MAP_COORDINATE_RANGE] = None
    """X0 Y0 X1 Y1 in coordinates of the map. By default what the training photographs show."""
    crs: str | None = None
    """Coordinates: EPSG:n, `enu`, `source` or `local`. EPSG:25832, `enu` (metres east and north of the scene's origin),
    `source` (those of the capture) or `local` (the ground frame). By default the UTM zone of a georeferenced capture,
    `source` where the capture is metres of a site's grid that was moved for precision, else `local`."""
    lod_error: Annotated[float | None, Range(0, MAX_RENDER_SIDE_PX)] = None
    """Draw through the run's level-of-detail tree (`vdgs lod`), at most so many pixels off. By default, and with 0,
    everything is drawn from all anchors."""
    detail_from_images: bool = False
    """Take the fine detail of the orthophoto from the photographs. That is done where they truly see a place."""


@dataclass(frozen=True, kw_only=True)
class ExportRequest(ModelRequest):
    """A scene as files of Gaussians or points for other programs (`vdgs export`)."""

    output: Annotated[tuple[Path, ...], Repeatable(), Output()] = ()
    """File to write; its ending (.ply, .spz, .glb, .html) is the format. All there are: .ply (3DGS), .compressed.ply
    (PlayCanvas), .spz, .splat, .sog, .rad (Spark), .glb (glTF), FOLDER/tileset.json (3D Tiles), FOLDER/lod-meta.json
    (streamed SOG), .points.ply, .laz, .las (point clouds), .html (a page that shows the scene offline). Give --output
    again for more: the scene is baked once (docs/export.md)."""
    program: Annotated[ProgramName | None, FlagName("for")] = None
    """Program that opens the files. It shows the scene upright then; files that it does not open are refused.
    Without --output: write RUN/export/ and the file that suits it best."""
    axes: AxesName | None = None
    """Axes of .ply, .spz, .splat, .sog, .rad and lod-meta.json: z-up (x east, y north, z up: the usual ones of .ply),
    y-up (of .spz and .rad: x east, z south), y-down (of .compressed.ply, .splat and .sog: x west, z south), y-up-left
    (left-handed: x east, z north). Instead of --for."""
    spz_version: Literal[2, 3, 4] = 3
    """Version of .spz files: 2 for older programs, 4 (zstd) for those of 2026; 3D Tiles always hold 2."""
    block: Annotated[int | None, Range(0, 10_000)] = None
    """Only what this block of the merged scene owns."""
    bbox: Annotated[tuple[float, float, float, float] | None, MAP_COORDINATE_RANGE] = None
    """Only Gaussians with centers in X0 Y0 X1 Y1, in coordinates of --crs."""
    min_visibility: Annotated[int, Range(0, MAX_COUNT)] = 0
    """Fade out where fewer training cameras see the scene (V): its edge, with its shreds (2 or 3); 0: write all."""
    max_gaussians: Annotated[int, Range(0, MAX_COUNT)] = 0
    """Largest number of Gaussians; 0: all. Neighbors are merged, those first by which the pictures change least, and
    then moved towards the model's images."""
    sh_degree: Literal[0, 1, 2, 3] | None = None
    """Degree of the spherical harmonics of colors. 0: the same from everywhere, and a quarter of the size. By default
    3, or 0 in formats that round them (.compressed.ply, .spz, .sog, .rad, 3D Tiles) if views show no gain of 0.05 dB.
    """
    html_max_mb: Annotated[float, Range(1, 2000)] = 30.0
    """Largest size of a .html file in MB. The scene is merged until it fits."""
    color_iterations: Annotated[int | None, Range(0, 100)] = None
    """Rounds in which colors are fitted again. To the difference from the model's images; by default 8, or 1 where
    the anchors spawn more than four million Gaussians (docs/export.md)."""
    optimize_seconds: Annotated[float, SECONDS_RANGE] = 0.0
    """Seconds of optimization of baked parameters; 0: none. Of all parameters, towards the model's images, after the
    fit in closed form. Needs 0.7 kB of memory for each Gaussian of degree 3."""
    crs: str | None = None
    """Coordinates of the files: EPSG:n, `enu` (metres east and north of the scene's origin), `source` (of the capture)
    or `local` (the ground frame). By default `enu` where the capture is georeferenced, and UTM for .laz and .las;
    `source` where it is metres of a site's grid that was moved for precision; else `local`. 3D Tiles of a georeferenced
    capture always stand on the globe (`enu`)."""
    background: Annotated[Path | None, Output()] = None
    """Also write sky and what is far away: an equirectangular PNG. Its middle looks east (+x), columns go clockwise.
    Files of Gaussians leave them out."""
    evaluate: bool = True
    """Report what was lost. Test views of a file that is read back are compared with those of the model. .sog, .rad,
    .glb, 3D Tiles, lod-meta.json and points are not: of these alone, the Gaussians are, before they are written."""
    threads: Annotated[int, WORKER_COUNT] = 0
    """Threads of the kernels; 0 for all cores. The result does not depend on it, but for --optimize-seconds."""

    @property
    def baked_sh_degree(self) -> int:
        """The degree that the scene is baked with; files may have a lower one where none is asked for."""
        return DEFAULT_SH_DEGREE if self.sh_degree is None else self.sh_degree


@dataclass(frozen=True, kw_only=True)
class ViewRequest(ModelRequest):
    """A scene in a browser (`vdgs view`)."""

    model: ModelName = "best"
    """Which model. `best` is the merged one where there is one, else what training has saved last, followed while it
    goes on."""
    host: str = "127.0.0.1"
    """Address to listen at: this machine alone can open it. Another one (0.0.0.0: all) lets others in who have the
    token of the printed address."""
    port: Annotated[int | None, Range(1, 65535)] = None
    """Port; by default the first free one from 8080."""
