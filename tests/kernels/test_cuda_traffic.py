"""How many bytes the CUDA kernels read and write: counted while their own text runs on the processor. The table:

pytest tests/kernels/test_cuda_traffic.py -s
"""

from __future__ import annotations

import re
import subprocess
from collections.abc import Callable
from dataclasses import dataclass, fields
from functools import partial

import pytest
import torch

from support.cuda_on_host import host_compiler, needs_nvrtc, no_code
from support.cuda_traffic import Bytes, CountedProgram, Traffic, total
from support.decode_scenes import CAMERAS, Scene, anchors, moved_by, turned, view_statistics
from support.loss_scenes import scene as pictures
from support.rasterize_scenes import in_runs, make_scene, splats_of
from vdgs.kernels.cuda import launch
from vdgs.kernels.cuda.cull import PROGRAM as CULL
from vdgs.kernels.cuda.cull import cull
from vdgs.kernels.cuda.decode import ANCHORS_PER_BLOCK, decode_for_training, expand_sources
from vdgs.kernels.cuda.decode import PROGRAM as DECODE
from vdgs.kernels.cuda.decode_adam import decode_backward_adam
from vdgs.kernels.cuda.loss import PROGRAM as LOSS
from vdgs.kernels.cuda.loss import photometric_loss
from vdgs.kernels.cuda.rasterize import PROGRAM as RASTERIZE
from vdgs.kernels.cuda.rasterize import rasterize_vjp
from vdgs.kernels.cuda.statistics import PROGRAM as STATISTICS
from vdgs.kernels.cuda.statistics import add_view_statistics
from vdgs.kernels.kernel_types import DensificationStats

GCC = (compiler := host_compiler()) and "Free Software" in subprocess.run(
    [compiler, "--version"], capture_output=True, text=True, check=False
).stdout  # fmt: skip
pytestmark = [
    needs_nvrtc, pytest.mark.xdist_group("cuda_traffic"), pytest.mark.slow,
    pytest.mark.skipif(not GCC, reason="no GCC, whose thread sanitizer calls what counts"),
]  # fmt: skip
#: Anchors in view and offsets of the scene that is decoded; pixels of the pictures.
V, K, WIDTH, HEIGHT = 64, 10, 48, 32
#: Runs in which the splats of the picture stand.
RUNS = 5
#: The decoder's weights among the arguments of kernels, and what they are given of pictures.
WEIGHTS, MOMENTS, PRODUCTS = r"[ocr]_[wb]\d", r".*_(first|second)$", r".*_out$"
PICTURE = r"(by_)?(image|alpha|depth)$|transmittance|last|background|median"


@dataclass(frozen=True)
class Counted:
    """What was counted of all kernels, and of how many things."""

    traffic: dict[str, list[Traffic]]
    splats: int  # of the anchors in view
    showing: int  # anchors in view with splats
    opaque: int  # offsets of anchors in view
    culled: tuple[int, int]  # anchors, and those kept
    added: int  # splats whose statistics were counted
    drawn: int  # splats of the picture
    entries: int  # of its tiles

    def of(self, kernel: str, matching: str = "", but: str = "$^") -> tuple[Bytes, Bytes]:
        """Read and written by a kernel, of arguments with names like `matching` and unlike `but`."""
        named = [t for t in self.traffic[kernel] if re.match(matching, t.argument) and not re.match(but, t.argument)]
        assert named, f"{kernel} has no argument {matching}"
        return total(named)


@pytest.fixture(scope="module")
def counted(compiled_code) -> Counted:
    traffic: dict[str, list[Traffic]] = {}

    def count(program, work: Callable):
        counting = CountedProgram(program, compiled_code)
        made = work(counting)
        for each in counting.traffic:
            traffic.setdefault(each.kernel, []).append(each)
        return made

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(launch, "compile_source", no_code)
        source, opaque = count(DECODE, decoding)
        positions, log_scales = anchors(2048, seed=1)
        rows = count(CULL, lambda program: cull(positions, log_scales, CAMERAS[0], program=program))
        inputs, sums = view_statistics(0, 300, K)
        count(STATISTICS, lambda program: add_view_statistics(DensificationStats(*sums), *inputs, program=program))
        drawn, entries = count(RASTERIZE, drawing)
        count(LOSS, comparing)
    showing = len(torch.unique(source // K))
    return Counted(traffic, len(source), showing, opaque, (len(positions), len(rows)), len(inputs[2]), drawn, entries)


def decoding(program: CountedProgram):
    scene, rows = Scene.random(V, K, spread=3.0), torch.arange(V)
    shown = decode_for_training(*scene.arguments, turned(), rows, program=program).source
    source = expand_sources(shown, program=program)
    with torch.no_grad():
        viewing = scene.positions - torch.from_numpy(turned().position).float()
        distance = viewing.norm(dim=-1, keepdim=True)
        inputs = torch.cat([scene.features, viewing / distance, distance], -1)
        opaque = int((scene.weights.opacity.forward(inputs) > 0).sum())
    moved_by(partial(decode_backward_adam, program=program), scene, turned(), rows)
    return source, opaque


def drawing(program: CountedProgram) -> tuple[int, int]:
    splats, background = splats_of([t.detach().float() for t in make_scene(200, WIDTH, HEIGHT).tensors])
    _, pullback = rasterize_vjp(in_runs(splats, RUNS)[0], background, WIDTH, HEIGHT, program=program)
    pullback(torch.randn(HEIGHT, WIDTH, 3), torch.randn(HEIGHT, WIDTH))
    return len(splats.means_px), len(pullback.entries.owners)


def comparing(program: CountedProgram) -> None:
    image, target, _ = pictures(HEIGHT, WIDTH)
    leaf = image.clone().requires_grad_()
    torch.autograd.grad(photometric_loss(leaf, target, None, program=program).loss, leaf)


def test_the_table(counted):
    """For people; what must hold is below."""
    pixels, (n, kept) = WIDTH * HEIGHT, counted.culled
    rows: list[tuple[str, str, int, tuple[Bytes, Bytes]]] = [
        ("cull: marks", "anchor", n, counted.of("mark_anchors")),
        ("cull: indices", "anchor kept", kept, counted.of("write_rows")),
        ("decode", "anchor", V, counted.of("decode_anchors", but=WEIGHTS)),
        ("way back, but moments", "anchor", V, counted.of("move_anchors", but=f"{WEIGHTS}|{MOMENTS}|{PRODUCTS}")),
        ("way back: moments", "anchor", V, counted.of("move_anchors", MOMENTS)),
        ("way back: for the decoder", "anchor", V, counted.of("move_anchors", PRODUCTS)),
        ("weights: decode", "anchor", V, counted.of("decode_anchors", WEIGHTS)),
        ("weights: way back", "anchor", V, counted.of("move_anchors", WEIGHTS)),
        ("statistics: sources", "splat", counted.splats, counted.of("name_splats")),
        ("statistics", "splat", counted.added, counted.of("add_view")),
        ("order of splats", "splat", counted.drawn, counted.of("order_splats")),
        ("tiles of splats", "splat", counted.drawn, counted.of("splat_tiles")),
        ("entries of splats", "splat", counted.drawn, counted.of("splat_entries")),
        ("forward: splats", "entry", counted.entries, counted.of("rasterize_forward", but=PICTURE)),
        ("forward: picture", "pixel", pixels, counted.of("rasterize_forward", PICTURE)),
        ("backward: splats", "entry", counted.entries, counted.of("rasterize_backward", but=PICTURE)),
        ("backward: picture", "pixel", pixels, counted.of("rasterize_backward", PICTURE)),
        ("gradients of splats", "splat", counted.drawn, counted.of("gather_gradients")),
        ("SSIM + L1: forward", "pixel", pixels, counted.of("photometric_forward")),
        ("SSIM + L1: backward", "pixel", pixels, counted.of("photometric_backward")),
    ]  # fmt: skip
    kinds = [each.name for each in fields(Bytes)]
    print(
        f"\n{V} anchors in view, {counted.showing} of them show {counted.splats} splats of {counted.opaque} opaque "
        f"offsets; {counted.drawn} splats in {counted.entries} entries; {WIDTH}x{HEIGHT} pixels"
    )
    print(f"{'bytes read / written':28}{'each':12}" + "".join(f"{kind:>18}" for kind in kinds))
    for name, unit, count, (read, written) in rows:
        each = (f"{getattr(read, kind) / count:.0f} / {getattr(written, kind) / count:.0f}" for kind in kinds)
        print(f"{name:28}{unit:12}" + "".join(f"{cell:>18}" for cell in each))
    assert all(read.once + written.once > 0 for *_, (read, written) in rows)


def test_of_anchors_is_read_what_they_are_made_of_and_no_more(counted):
    """Rows (8), position (12), feature (128), log-scales (24), opaque offsets (12 each). Written are 40 bytes a
    splat, 4 an anchor and 12 for eight; and the counter is counted up."""
    read, written = counted.of("decode_anchors", but=WEIGHTS)
    assert 0 < counted.showing < V
    assert counted.splats < counted.opaque
    assert read.once == V * (8 + 12 + 128 + 24) + 12 * counted.opaque + 4
    assert written.once == 40 * counted.splats + 4 * V + 12 * V // ANCHORS_PER_BLOCK + 4
    assert len(counted.traffic["decode_anchors"]) == len({each.argument for each in counted.traffic["decode_anchors"]})


def test_on_the_way_back_each_number_that_moves_is_read_once_and_written_once(counted):
    """272 bytes of parameters and twice as much of moments an anchor, 36 bytes a splat; each read by one access."""
    moved = counted.of("move_anchors", r"(features|offsets|log_scales)(_first|_second)?$")
    assert [each.once for each in moved] == [V * 3 * 272] * 2
    read, written = counted.of("move_anchors", but=f"{WEIGHTS}|{PRODUCTS}|lacking|roots")
    # Rows, what shows, updates; where splats begin, once for eight; positions.
    around = 8 * V + 4 * V + 4 * V + 4 * V // ANCHORS_PER_BLOCK + 12 * counted.showing
    assert read.once == V * 3 * 272 + around + 36 * counted.splats
    assert written.once == V * (3 * 272 + 4)
    features = counted.of("move_anchors", "features$")[0]
    assert features.lanes == features.once  # 32 lanes, 128 bytes, at once


def bytes_of(anchors: float, showing: float, opaque: float, splats: float) -> float:
    """Of decoding and its way back without moments, by the two tests above."""
    decoding = (172 + 4 + 1.5) * anchors + 12 * opaque + 40 * splats
    back = (2 * 272 + 8 + 4 + 8 + 0.5) * anchors + 12 * showing + 36 * splats
    return decoding + back


def test_an_anchor_costs_no_more_than_was_aimed_at(counted):
    """Design: 1.2 kB an anchor with five splats of five opaque offsets, for decoding and its way back, without moments;
    with them 1.6 kB are the least that Adam in float32 moves (816 bytes read and written)."""
    passes = [counted.of("decode_anchors", but=WEIGHTS)]
    passes.append(counted.of("move_anchors", but=f"{WEIGHTS}|{PRODUCTS}|lacking|roots"))
    whole = sum(read.once + written.once for read, written in passes)
    moments = sum(each.once for each in counted.of("move_anchors", MOMENTS))
    assert moments == 1088 * V
    counter = 8
    assert whole - moments - counter == bytes_of(V, counted.showing, counted.opaque, counted.splats)
    assert bytes_of(1, 1, 5, 5) == 1194


def test_what_is_written_for_others_is_written_once(counted):
    """Sources, for statistics; the order of splats, for equal depths in the own rasterizer."""
    read, written = counted.of("name_splats")
    assert written.once == 4 * counted.splats
    assert read.once == 4 * V + 4 * V // ANCHORS_PER_BLOCK
    read, written = counted.of("order_splats")
    assert written.once == 4 * counted.drawn
    assert read.once == 8 * RUNS
    assert counted.of("splat_tiles", "order")[0].once == 4 * counted.drawn


def test_lanes_read_weights_side_by_side(counted):
    """Of ten offsets, a warp reads 40 bytes of a weight at once: at most three sectors, usually two."""
    heads = {"o": 1, "c": 7, "r": 3}
    kernels = [("decode_anchors", f"{head}_w2") for head in heads] + [("move_anchors", f"{head}_w2t") for head in heads]
    for kernel, name in kernels:
        read, outputs = counted.of(kernel, f"{name}$")[0], heads[name[0]]
        assert 0 < read.lanes <= V * 32 * outputs * 3 * 32
        assert read.once == 32 * K * outputs * 4


def test_culling_reads_scales_only_where_they_decide(counted):
    n, kept = counted.culled
    read, written = counted.of("mark_anchors", "positions|log_scales")
    assert counted.of("mark_anchors", "positions")[0].once == 12 * n
    assert 12 * n < read.once < 24 * n
    assert written.once == 0
    assert counted.of("mark_anchors", "marks|found")[1].once == 2 * 4 * n // 32
    assert counted.of("write_rows", "rows")[1].once == 8 * kept


def test_statistics_touch_each_splat_and_each_sum_once(counted):
    m = counted.added
    assert counted.of("add_view", "sources|opacities|by_means_px")[0].once == 16 * m
    for which in (0, 1):
        assert counted.of("add_view", "gradient|drawn")[which].once == 8 * m


def test_pictures_are_written_once(counted):
    pixels = WIDTH * HEIGHT
    assert counted.of("rasterize_forward", PICTURE)[1].once == 20 * pixels
    assert counted.of("rasterize_backward", "sums")[1].once == 40 * counted.entries
    assert counted.of("gather_gradients", "by_")[1].once == 36 * counted.drawn
    assert counted.of("photometric_forward", "slopes")[1].once == 36 * pixels
    assert counted.of("photometric_backward", "gradient")[1].once == 12 * pixels
