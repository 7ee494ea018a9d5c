"""`.html`: a page that shows the scene offline, in any browser with WebGL 2: viser's client with the scene inside.

The client comes from the installed package viser, with a recording of one message that carries the Gaussians: 32 bytes
each (mean in float32, covariance in float16, color and opacity in bytes), compressed, as base64. Colors do not change
with the direction. A scene that would be too large for the file is merged until it fits.
"""

from __future__ import annotations

import base64
import html
import json
import re
import zlib
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import torch
from jaxtyping import Float, UInt32

from vdgs.captures.first_view import FOV_DEG
from vdgs.errors import VdgsError
from vdgs.export.formats.export_scene import (
    ExportScene,
    InitialView,
    base_colors,
    logits_from_opacity,
    opacities,
    to_uint8,
)
from vdgs.export.formats.gaussian_store import even_rows
from vdgs.kernels.spherical_harmonics import rgb_to_sh
from vdgs.model.gaussian_merging import ellipsoid_axes, group_neighbors, merge_by_moments
from vdgs.model.gaussian_transform import gaussian_covariances
from vdgs.model.gaussians import Gaussians
from vdgs.system.atomic_files import write_bytes

#: Numbers of 32 bits a Gaussian.
WORDS_PER_GAUSSIAN = 8
#: Lengths in the page are those of the scene times a power of two, with which the median Gaussian is about so large:
#: covariances in float16 then hold all from 1/13 of it to 2000 times it.
TARGET_MEDIAN_SIZE = 0.1
#: What a page loses of every scene.
PAGE_LOSSES = (
    "colors do not change with the viewing direction",
    "covariances are rounded to half precision, colors and opacities to bytes",
)
#: No standard deviation above this, in lengths of the page: its square ends below the largest float16.
MAX_SIZE = 250.0
#: Bytes a Gaussian takes are found on so many; they are right within this share.
SAMPLE_GAUSSIANS, SIZE_MARGIN = 1 << 15, 1.05
#: Fewer than this are no scene.
MIN_GAUSSIANS = 1000
#: z up to the y up of the client: a quarter turn about x, wxyz.
_Z_UP_TO_Y_UP = (0.7071067811865476, -0.7071067811865476, 0.0, 0.0)
_EMBEDDED = re.compile(r'window\.__VISER_EMBED_DATA__="([A-Za-z0-9+/=]*)"')
_FACTS = re.compile(r'<meta name="vdgs" content="([^"]*)"')
#: The page may load nothing: all that it needs is in it.
_POLICY = (
    "default-src 'none'; script-src 'unsafe-inline' 'unsafe-eval' 'wasm-unsafe-eval' data: blob:; "
    "worker-src data: blob:; style-src 'unsafe-inline'; img-src data: blob:; font-src data:; connect-src data: blob:"
)
#: Chromium refuses module workers from blobs in pages that were opened as files, and without its worker the client
#: never sorts the Gaussians by depth. The same script as a data URL it takes.
_WORKERS = (
    "<script>{const Usual=Worker;window.Worker=class extends Usual{constructor(url,options){"
    "if(location.protocol==='file:'&&String(url).startsWith('blob:')){const script=new XMLHttpRequest();"
    "script.open('GET',url,false);script.send();"
    "url='data:text/javascript;charset=utf-8,'+encodeURIComponent(script.responseText);}super(url,options);}}}</script>"
)
#: On a window that is higher than wide one stands as many times farther, so that the scene still fits across. The
#: client takes a place to stand from its address, which the script of a file cannot change.
_PORTRAIT = (
    "<script>{const usual=URLSearchParams,from=%s,to=%s;window.URLSearchParams=class extends usual{get(name){"
    "const said=super.get(name),times=innerHeight/innerWidth;"
    "if(said!==null||name!=='initialCameraPosition'||!(times>1))return said;"
    "return from.map((x,i)=>to[i]+times*(x-to[i])).join(',');}}}</script>"
)
#: The box that marks where trust ends.
_TRUST_BOX = Path(__file__).with_name("trust_box.html")
_CAPTION = (
    "position:fixed;left:0;bottom:0;z-index:2;margin:0;padding:.35em .7em;font:13px/1.4 system-ui,sans-serif;"
    "color:#222;background:rgba(255,255,255,.75);pointer-events:none"
)


def check_page(path: Path, scene: ExportScene) -> None:
    """Raise VdgsError where the package that holds the client is missing, or the client has no room in the page."""
    try:
        import viser  # noqa: F401
    except ImportError as error:
        raise VdgsError(f"{path}: pages need viser. Install it: pip install 'vdgs[viewer]'") from error
    if scene.page is not None and scene.page.max_bytes <= (frame := _frame_bytes()):
        raise _no_room(scene.page, frame)


def write_html(path: Path, scene: ExportScene) -> tuple[str, ...]:
    """Write the page, atomically. Returns what was lost. Raises VdgsError."""
    whole = _without_sh(scene)
    page = scene.page or default_page_view(whole)
    factor = length_factor(whole)
    kept = whole
    while len(content := _document(kept, factor, page, scene)) > page.max_bytes:
        count = min(html_capacity(whole, page), int(0.9 * len(kept)))
        kept = merge_by_moments(whole, group_neighbors(whole, count))
    write_bytes(path, content)
    lost = [*PAGE_LOSSES]
    if len(kept) < len(whole):
        lost.append(
            f"merged from {len(whole):,} Gaussians to {len(kept):,}, for the page may have "
            f"{page.max_bytes / 1e6:g} MB (--html-max-mb)"
        )
    return tuple(lost)


def read_html_chunks(path: Path) -> Iterator[Gaussians]:
    """The Gaussians of a page of ours, in the ground frame, all at once. Raises VdgsError if it is missing or none."""
    import msgspec
    import zstandard

    try:
        text = path.read_text(encoding="utf-8")
    except (OSError, UnicodeDecodeError) as error:
        raise VdgsError(f"{path}: cannot be read ({error}).") from error
    facts, data = _FACTS.search(text), _EMBEDDED.search(text)
    if facts is None or data is None:
        raise VdgsError(f"{path}: is no page of `vdgs export`.")
    packed = base64.b64decode(data[1])
    inner = zstandard.ZstdDecompressor().decompress(packed[8:], int.from_bytes(packed[:8], "little"))
    known = json.loads(html.unescape(facts[1]))
    length = int.from_bytes(inner[:8], "little")
    (size,) = msgspec.msgpack.decode(inner[8 : 8 + length])["binaryBufferLengths"]
    yield _unpacked(np.frombuffer(inner[-size:], np.uint32).reshape(-1, WORDS_PER_GAUSSIAN), known["factor"])


def _without_sh(scene: ExportScene) -> Gaussians:
    """All of a scene in memory, without the coefficients that are not shown: 56 bytes each."""
    parts = [
        replace(piece, shN=torch.zeros(len(piece), 0, 3, dtype=torch.float32, device="cpu")) for piece in scene.pieces()
    ]
    return Gaussians(**{name: torch.cat([part.tensors()[name] for part in parts]) for name in parts[0].tensors()})


def html_capacity(gaussians: Gaussians, page: InitialView) -> int:
    """How many like these a page has room for, by a sample of them. Raises VdgsError for next to none."""
    some = gaussians.select(torch.from_numpy(even_rows(len(gaussians), SAMPLE_GAUSSIANS)))
    frame = _frame_bytes()
    factor = length_factor(some)
    each = SIZE_MARGIN * len(_recording(packed_rows(some, factor), factor, page)) / len(some)
    count = int((page.max_bytes - frame) / each)
    if count < min(MIN_GAUSSIANS, len(gaussians)):
        raise _no_room(page, frame)
    return count


def _frame_bytes() -> int:
    """What a page takes beside the Gaussians."""
    return len(_client_html()) + 4096


def _no_room(page: InitialView, frame: int) -> VdgsError:
    return VdgsError(
        f"A page of {page.max_bytes / 1e6:g} MB has no room for the scene: the client alone takes "
        f"{frame / 1e6:.1f} MB. Allow more: --html-max-mb."
    )


def length_factor(gaussians: Gaussians) -> float:
    """The power of two that lengths are multiplied with."""
    usual = float(gaussians.log_scales.amax(1).median().exp())
    return float(2.0 ** np.round(np.log2(TARGET_MEDIAN_SIZE / max(usual, 1e-30))))


def packed_rows(gaussians: Gaussians, factor: float) -> UInt32[np.ndarray, "n 8"]:
    """As the client's textures hold them."""
    rows = np.zeros((len(gaussians), WORDS_PER_GAUSSIAN), np.uint32)
    rows[:, :3] = (factor * gaussians.means.numpy()).astype(np.float32).view(np.uint32)
    largest = float(np.log(MAX_SIZE / factor))
    clamped = Gaussians(**{**gaussians.tensors(), "log_scales": gaussians.log_scales.clamp_max(largest)})
    spread = factor**2 * gaussian_covariances(clamped).numpy().reshape(-1, 9)[:, [0, 1, 2, 4, 5, 8]]
    rows[:, 4:7] = np.ascontiguousarray(spread.astype(np.float16)).view(np.uint32)
    shown = np.concatenate([base_colors(gaussians), opacities(gaussians)[:, None]], 1)
    rows[:, 7:] = to_uint8(shown).view(np.uint32)
    return rows


def _unpacked(rows: UInt32[np.ndarray, "n 8"], factor: float) -> Gaussians:
    """The inverse of `packed_rows`, but for what is rounded."""
    upper = torch.from_numpy(np.ascontiguousarray(rows[:, 4:7]).view(np.float16).astype(np.float64)) / factor**2
    log_scales, quaternions = ellipsoid_axes(upper[:, [0, 1, 2, 1, 3, 4, 2, 4, 5]].reshape(-1, 3, 3))
    rgba = np.ascontiguousarray(rows[:, 7:]).view(np.uint8).astype(np.float32) / 255
    return Gaussians(
        means=torch.from_numpy(np.ascontiguousarray(rows[:, :3]).view(np.float32) / np.float32(factor)),
        log_scales=log_scales.float(), quaternions=quaternions.float(), opacity_logits=logits_from_opacity(rgba[:, 3]),
        sh0=rgb_to_sh(torch.from_numpy(rgba[:, :3])),
        shN=torch.zeros(len(rows), 0, 3, dtype=torch.float32, device="cpu"),
    )  # fmt: skip


def _document(gaussians: Gaussians, factor: float, page: InitialView, scene: ExportScene) -> bytes:
    """The whole file."""
    title = html.escape(page.title)
    facts = {**scene.metadata.to_dict(), "axes": "z up", "gaussians": len(gaussians), "factor": factor}
    head = (
        f'<meta http-equiv="Content-Security-Policy" content="{_POLICY}">'
        f'<meta name="vdgs" content="{html.escape(json.dumps(facts))}">{_WORKERS}'
    )
    stand, target = ([factor * each for each in place] for place in (page.position, page.target))
    head += _PORTRAIT % (stand, target)
    recording = _recording(packed_rows(gaussians, factor), factor, page)
    script = (
        f'<script>window.__VISER_EMBED_DATA__="{recording}";window.__VISER_EMBED_CONFIG__={{darkMode:false}};</script>'
    )
    caption = (
        f'<p style="{_CAPTION}">{title} · {len(gaussians):,} Gaussians, the same colors from all sides · '
        "drag to turn, right button or two fingers to move, wheel or pinch to zoom</p>"
    )
    caption += _trust_box(gaussians, page)
    client = _client_html().replace("<title>Viser</title>", f"<title>{title}</title>", 1)
    client = client.replace('<meta charset="utf-8" />', f'<meta charset="utf-8" />{head}', 1)
    client = client.replace("</head>", f"{script}</head>", 1)
    before, after = client.rsplit("</body>", 1)
    return f"{before}{caption}</body>{after}".encode()


def _trust_box(gaussians: Gaussians, page: InitialView) -> str:
    """What lets a visitor mark where trust ends; nothing where V is not known. Two bits for each Gaussian: V of 0 or 1,
    of 2, or more (the number that is free in the client's rows is overwritten by the client)."""
    if page.count_visibility is None:
        return ""
    few = (page.count_visibility(gaussians.means).clamp(1, 3) - 1).to(torch.uint8).numpy()
    fours = np.concatenate([few, np.zeros(-len(few) % 4, np.uint8)]).reshape(-1, 4)
    packed = base64.b64encode(zlib.compress((fours << np.arange(0, 8, 2, dtype=np.uint8)).sum(1, dtype=np.uint8), 9))
    box = _TRUST_BOX.read_text(encoding="utf-8")
    return box.replace("$SEEN", packed.decode("ascii")).replace("$COUNT", str(len(few)))


def _client_html() -> str:
    """The page of viser's client, as the installed package has it."""
    import viser

    file = Path(viser.__file__).parent / "client" / "build" / "index.html"
    try:
        text = file.read_text(encoding="utf-8")
    except OSError as error:
        raise VdgsError(f"{file}: cannot be read ({error.strerror or error}). Install viser again.") from error
    if not all(part in text for part in ('<meta charset="utf-8" />', "</head>", "</body>")):
        raise VdgsError(f"{file}: is a client that vdgs does not know. Install viser 1.1.")
    return text


def _recording(rows: UInt32[np.ndarray, "n 8"], factor: float, page: InitialView) -> str:
    """What the client plays: where one stands, the color behind, and the Gaussians. Base64."""
    from viser import _messages as messages
    from viser.infra import StateSerializer, WebsockMessageHandler

    position, target = factor * np.array(page.position), factor * np.array(page.target)
    away = float(np.linalg.norm(position - target))

    class Nowhere(WebsockMessageHandler):
        """Of no server: it only holds the list of recordings."""

        def get_message_buffer(self) -> Any:
            raise AssertionError("nothing is sent: a page is only recorded")

    recording: StateSerializer = Nowhere().get_message_serializer(lambda message: True)
    said: list[Any] = [
        messages.SetOrientationMessage("", _Z_UP_TO_Y_UP),
        messages.SetCameraUpDirectionMessage((0.0, 0.0, 1.0), initial=True),
        messages.SetCameraPositionMessage(tuple(position.tolist()), initial=True),
        messages.SetCameraLookAtMessage(tuple(target.tolist()), initial=True),
        messages.SetCameraFovMessage(float(np.radians(FOV_DEG)), initial=True),
        messages.SetCameraNearMessage(1e-3 * away, initial=True),
        messages.SetCameraFarMessage(1e3 * away, initial=True),
        messages.SetCameraMinOrbitDistanceMessage(1e-3 * away),
        messages.SetCameraMaxOrbitDistanceMessage(100 * away),
        messages.BackgroundImageMessage("png", _png(page.background), None),
        messages.GaussianSplatsMessage("/scene", messages.GaussianSplatsProps(rows, 1.0)),
    ]
    for message in said:
        recording._insert_message(message)
    return base64.b64encode(recording.serialize()).decode("ascii")


def _png(color: tuple[float, float, float]) -> bytes:
    """A picture of one color."""
    pixels = np.broadcast_to(to_uint8(np.array(color))[::-1], (2, 2, 3))
    done, encoded = cv2.imencode(".png", np.ascontiguousarray(pixels))
    assert done
    return encoded.tobytes()


def default_page_view(gaussians: Gaussians) -> InitialView:
    """A view of all from the south, half from above."""
    low, high = (np.quantile(gaussians.means.numpy(), q, axis=0) for q in (0.02, 0.98))
    middle: Float[np.ndarray, "3"] = (low + high) / 2
    away = max(float((high - low).max()), 1e-6)
    position = middle + away * np.array([0.0, -0.9, 0.9])
    return InitialView(_float_triple(position), _float_triple(middle))


def _float_triple(place: Float[np.ndarray, "3"]) -> tuple[float, float, float]:
    x, y, z = (float(each) for each in place)
    return x, y, z
