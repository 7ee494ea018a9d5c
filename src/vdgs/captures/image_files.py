"""The photographs on disk: finding them, their masks and their sizes, and decoding their pixels.

Pixels are taken as COLMAP takes them: RGB, 8 bits, EXIF orientation not applied. Of whatever kind a photograph is, all
verbs decode it by `decode_image`, to sRGB.
"""

from __future__ import annotations

import io
from collections.abc import Iterable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

import cv2
import numpy as np
from PIL import Image, features

from vdgs.captures.color_profiles import foreign_space, to_srgb
from vdgs.captures.image_suffixes import (
    AVIF_SUFFIXES,
    HEIF_SUFFIXES,
    IMAGE_SUFFIXES,
    OTHER_IMAGE_SUFFIXES,
    RAW_SUFFIXES,
    TIFF_SUFFIXES,
)
from vdgs.captures.jpeg import JPEGS, has_end, lacks_only_end, with_end
from vdgs.captures.name_resolution import find_file
from vdgs.captures.optional_decoders import has_decoder, prepare_heif
from vdgs.captures.pillow_limits import pillow_without_limits
from vdgs.captures.raw_files import develop, is_raw, raw_size
from vdgs.captures.strays import is_hidden
from vdgs.captures.tiff_channels import as_tags_say, has_alpha_channel, why_no_picture
from vdgs.captures.tiff_orientation import stored_size, without_orientation
from vdgs.captures.xmp_packets import exif_of
from vdgs.errors import CaptureError
from vdgs.system.memory.memory_errors import is_out_of_memory
from vdgs.system.native_messages import without_decoder_messages
from vdgs.system.permissions import refusal

#: Maker and model of a camera in EXIF.
_CAMERA_TAGS, _ORIENTATION = {0x010F, 0x0110}, 0x0112
#: Headers that announce more pixels than this are refused rather than decoded.
MAX_IMAGE_PX = 1_000_000_000
#: A photograph or mask with a shorter side than this (pixels) shows nothing: a thumbnail, what is left of a file, or
#: what --downscale leaves (choice).
MIN_SIDE_PX = 8
#: Two sizes are of one shape if one is the other shrunk evenly, each side rounded by less than this (pixels).
ROUNDING_PX = 1.0
#: A mask keeps what is at least so bright, of 255; an alpha channel what is at least so opaque (choice).
MASK_THRESHOLD = 128
#: A mask of more gray that is left out than this share of its pixels may be a matte or numbers of classes; compression
#: and smooth edges make less (choice).
MAX_GRAY_FRACTION = 0.05
#: What programs put behind a photograph's name for that of its mask.
_MASK_TAILS = ("_mask", ".mask", "-mask", "_msk")
#: How instant-ngp's masks begin, which are white where others are black: at what is left out.
DYNAMIC_MASK = "dynamic_mask_"
#: Pillow's modes that we know how to bring to 8-bit RGB.
SUPPORTED_MODES = {"RGB", "RGBA", "L", "LA", "P", "1", "I;16", "I;16B", "I;16L", "CMYK"}
#: What may say, before the pixels, that colors are of another space than sRGB: profiles, CMYK, EXIF's Adobe RGB.
_COLOR_MARKS = (b"ICC_PROFILE\0", b"iCCP", b"ICCP", b"Adobe\0", b"R03\0")
_HEAD_BYTES = 1 << 20
_TIFF = (b"II", b"MM")
#: A mask with transparency is a photograph that was cut out where more of its pixels have colors (choice).
_MIN_COLORED = 0.05
#: Values of 16 bits none of which is greater are those of 12 bits or fewer: black, as they are.
_DARK = 4095


@dataclass(frozen=True)
class ImageHeader:
    """What an image file says before its pixels."""

    width: int
    height: int
    mode: str


@contextmanager
def open_image(path: Path) -> Iterator[Image.Image]:
    """A picture in Pillow, HEIC too; no raw file. Raises CaptureError where its decoder is not installed."""
    prepare_heif(path)
    with pillow_without_limits(), Image.open(path) as image:
        yield image


def mode_of(image: Image.Image) -> str:
    """Pillow's mode. Mode I is 32 bits a pixel, but for PNG files of 16 bits as older versions of Pillow open them."""
    return "I;16" if (image.mode, image.format) == ("I", "PNG") else image.mode


def readable_suffixes() -> set[str]:
    """Suffixes of the photographs that this installation reads."""
    found = IMAGE_SUFFIXES | (AVIF_SUFFIXES if features.check("avif") else set())
    found |= HEIF_SUFFIXES if has_decoder("pillow_heif") else set()
    return found | (RAW_SUFFIXES if has_decoder("rawpy") else set())


def read_header(path: Path) -> ImageHeader:
    """Size and mode without decoding. Raises `CaptureError` for unreadable, huge and tiny images."""
    try:
        if is_raw(path):
            header = ImageHeader(*raw_size(path), "RGB")
        else:
            with open_image(path) as image:
                header = ImageHeader(*stored_size(image), mode_of(image))
    except CaptureError:
        raise
    except FileNotFoundError:
        raise CaptureError(f"{path}: no such image.") from None
    except PermissionError as error:
        raise CaptureError(f"{path}: {refusal(path, error)}") from None
    except Exception as error:  # Pillow's parsers raise many kinds on damaged headers
        if why := why_no_picture(path):
            raise CaptureError(f"{path}: {why}.") from None
        raise CaptureError(
            f"{path}: not an image that can be read ({error}). Copy it again, or convert it to 8-bit RGB if other "
            "programs show it."
        ) from None
    if header.width * header.height > MAX_IMAGE_PX:
        raise CaptureError(f"{path}: announces {header.width}x{header.height} pixels; the file is damaged.")
    if min(header.width, header.height) < MIN_SIDE_PX:
        raise CaptureError(
            f"{path}: is {header.width}x{header.height} pixels, too small to show anything. Copy the image again."
        )
    if path.suffix.lower() in TIFF_SUFFIXES and (why := why_no_picture(path)):
        raise CaptureError(f"{path}: {why}.")
    if header.mode not in SUPPORTED_MODES:
        raise CaptureError(f"{path}: has the color mode {header.mode}; convert it to 8-bit RGB.")
    return header


def has_camera(path: Path) -> bool:
    """Whether EXIF of an image names a camera. Files of raw formats and of phones count as photographs."""
    if path.suffix.lower() in OTHER_IMAGE_SUFFIXES:
        return True
    try:
        with pillow_without_limits(), Image.open(path) as image:
            return not _CAMERA_TAGS.isdisjoint(exif_of(image))
    except Exception:  # Pillow's parsers raise many kinds on damaged headers
        return False


def is_turned(path: Path) -> bool:
    """Whether EXIF says that an image is to be shown turned by a quarter, which the pixels of its file are not."""
    try:
        with open_image(path) as image:
            return exif_of(image).get(_ORIENTATION) in (5, 6, 7, 8)
    except Exception:  # Pillow's parsers raise many kinds on damaged headers
        return False


def same_aspect(one: tuple[int, int], other: tuple[int, int]) -> bool:
    """Whether two sizes (width, height) can be of one picture, shrunk evenly and rounded in any way."""
    (width, height), (wide, high) = sorted((one, other))
    low = max((width - ROUNDING_PX) / wide, (height - ROUNDING_PX) / high)
    return low <= min((width + ROUNDING_PX) / wide, (height + ROUNDING_PX) / high)


def find_images(folder: Path) -> dict[str, Path]:
    """All images under `folder` by their posix name relative to it, in name order; HEIC and raw files only where no
    picture of the same name and another ending lies beside them."""
    files = [path for path in readable_images(folder.rglob("*")) if not is_hidden(path.relative_to(folder))]
    return dict(sorted((path.relative_to(folder).as_posix(), path) for path in files))


def readable_images(files: Iterable[Path]) -> list[Path]:
    """The images among files, by their names; HEIC and raw files only where no picture of the same name and another
    ending lies beside them."""
    readable = readable_suffixes()
    images = [path for path in files if path.suffix.lower() in readable]
    stems = {path.with_suffix("") for path in images if path.suffix.lower() in IMAGE_SUFFIXES}
    return [path for path in images if path.suffix.lower() in IMAGE_SUFFIXES or path.with_suffix("") not in stems]


def find_mask(folder: Path, name: str) -> Path | None:
    """The mask of an image: name.jpg.png (COLMAP) or name.png, the image's own name, or `name_mask` and its like."""
    path = Path(name)
    stems = [str(path.with_name(path.stem + tail)) for tail in _MASK_TAILS]
    candidates = [name + ".png", str(path.with_suffix(".png")), name, name + ".mask.png"]
    candidates += [stem + suffix for stem in stems for suffix in (".png", path.suffix, ".jpg", ".tif")]
    candidates += [str(path.with_suffix(suffix)) for suffix in (".jpg", ".tif", ".PNG")]
    return next((found for found in (find_file(folder, each) for each in candidates) if found is not None), None)


def find_mask_beside(folder: Path, name: str, image: Path | None = None) -> Path | None:
    """The mask of an image in the image's own folder: name.jpg.png, `mask_name`, or `name_mask` and its like. The
    `image` itself is none, as it would be of a name without extension."""
    path = Path(name)
    stems = [str(path.with_name(stem)) for stem in (*(path.stem + tail for tail in _MASK_TAILS), f"mask_{path.stem}")]
    candidates = [name + ".png", name + ".mask.png", str(path.with_name(f"{DYNAMIC_MASK}{path.stem}.png"))]
    candidates += [stem + suffix for stem in stems for suffix in (".png", path.suffix)]
    return next(
        (found for found in (find_file(folder, each) for each in candidates) if found not in (None, image)), None
    )


def decode_image(path: Path) -> tuple[np.ndarray, np.ndarray | None]:
    """Pixels [h, w, 3] uint8 RGB, and where the file has transparency its opaque part [h, w] bool.

    Gray becomes RGB, 16 bits become 8, colors of other spaces sRGB, raw files are developed; an alpha channel is a
    mask (choice: opaque from one half up), never a blend. Raises `CaptureError` naming the file if it cannot be
    decoded.
    """
    if is_raw(path):
        return develop(path), None
    return _in_rgb(path, _decode(path))


def _in_rgb(path: Path, pixels: np.ndarray) -> tuple[np.ndarray, np.ndarray | None]:
    """As `decode_image`, of a file's pixels as they are stored."""
    if pixels.dtype == np.uint16:
        if 0 < pixels.max() <= _DARK:
            raise CaptureError(
                f"{path}: has 16 bits a pixel, of which it uses no value above {pixels.max()} of 65535: black, as it "
                "is. Scale the values of all photographs by one factor, or let MaxSampleValue (tag 281; 4095 for "
                "12 bits) say which value is white."
            )
        pixels = ((pixels.astype(np.uint32) + 128) // 257).astype(np.uint8)
    if pixels.dtype != np.uint8:
        raise CaptureError(f"{path}: has {pixels.dtype} samples; convert it to 8-bit RGB.")
    if pixels.ndim == 2:
        return cv2.cvtColor(pixels, cv2.COLOR_GRAY2RGB), None
    if pixels.shape[2] == 3:
        return cv2.cvtColor(pixels, cv2.COLOR_BGR2RGB), None
    opaque = pixels[:, :, 3] >= MASK_THRESHOLD
    return cv2.cvtColor(pixels, cv2.COLOR_BGRA2RGB), None if opaque.all() else opaque


def decode_mask(path: Path, width: int, height: int) -> np.ndarray:
    """What a mask keeps (white), [height, width] bool; a mask of another size is resampled to the image's."""
    return _resampled(_mask(path, _decode(path)), width, height)


def _resampled(keep: np.ndarray, width: int, height: int) -> np.ndarray:
    if keep.shape == (height, width):
        return keep
    return cv2.resize(keep.astype(np.uint8), (width, height), interpolation=cv2.INTER_NEAREST) > 0


def _mask(path: Path, pixels: np.ndarray) -> np.ndarray:
    """What a mask, decoded as it is stored, keeps at its own size, [h, w] bool: of instant-ngp's what is black, of
    others what is bright and opaque, of a photograph that was cut out all that is opaque."""
    light = _lightness(path, pixels)
    if path.name.lower().startswith(DYNAMIC_MASK):
        return light == 0
    if pixels.ndim == 2 or pixels.shape[2] != 4:
        return _kept(light)
    half = MASK_THRESHOLD if pixels.max() <= 255 else MASK_THRESHOLD * 257
    opaque = pixels[..., 3] >= half
    colored = np.ptp(pixels[..., :3][opaque], axis=1) > half // 16
    cut_out = not opaque.all() and opaque.any() and colored.mean() > _MIN_COLORED
    return opaque if cut_out else _kept(light) & opaque


def _lightness(mask: Path, pixels: np.ndarray) -> np.ndarray:
    """The brightest channel of a mask at its own size, [h, w] uint8."""
    if pixels.ndim == 2 and pixels.dtype == np.uint8:
        return pixels
    if pixels.dtype == np.uint16 and pixels.size and pixels.max() <= 255:  # 8 bits, written as 16
        return pixels.reshape(*pixels.shape[:2], -1)[..., :3].max(axis=2).astype(np.uint8)
    return _in_rgb(mask, pixels)[0].max(axis=2)


def _kept(light: np.ndarray) -> np.ndarray:
    """What a mask keeps: the bright; all that is not 0 in a mask of 0 and 1 (COLMAP's)."""
    return light > 0 if light.size and light.max() == 1 else light >= MASK_THRESHOLD


def _decode(path: Path) -> np.ndarray:
    """Pixels as stored (BGR order), of a JPEG that lacks nothing but its end marker too."""
    try:
        data = np.fromfile(path, np.uint8)
    except PermissionError as error:
        raise CaptureError(f"{path}: {refusal(path, error)}") from error
    except OSError as error:
        raise CaptureError(f"{path}: cannot be read ({error.strerror or error}).") from error
    try:
        return _decode_bytes(path, data)
    except CaptureError:
        if not lacks_only_end(path):
            raise
    return _decode_bytes(path, np.frombuffer(with_end(path).getvalue(), np.uint8))


def _decode_bytes(path: Path, data: np.ndarray) -> np.ndarray:
    """OpenCV's decoding of a file's bytes; Pillow's where OpenCV cannot."""
    data = without_orientation(data)
    converted = _converted(path, data)
    if converted is not None:
        return converted
    try:
        with without_decoder_messages():
            pixels = cv2.imdecode(data, cv2.IMREAD_UNCHANGED) if data.size else None
    except cv2.error as error:
        if is_out_of_memory(error):
            raise
        pixels = None
    if pixels is not None and pixels.ndim in (2, 3) and (pixels.ndim == 2 or pixels.shape[2] in (3, 4)):
        return as_tags_say(pixels, data)
    try:
        with pillow_without_limits(), Image.open(io.BytesIO(data.tobytes())) as image:
            return np.asarray(image.convert("RGB"))[:, :, ::-1]
    except MemoryError:
        raise
    except Exception as error:  # whatever Pillow finds wrong with it
        raise CaptureError(f"{path}: cannot be decoded ({error}). Copy it again or remove it.") from None


def _converted(path: Path, data: np.ndarray) -> np.ndarray | None:
    """Pixels, BGR or BGRA, of what OpenCV does not decode alike: HEIC, AVIF, and colors of other spaces. None for all
    else, and for what Pillow does not open."""
    head = data[:_HEAD_BYTES].tobytes()
    own = head[4:8] == b"ftyp"
    if not own and head[:2] not in _TIFF and not any(mark in head for mark in _COLOR_MARKS):
        return None
    try:
        prepare_heif(path)
        with pillow_without_limits(), Image.open(io.BytesIO(data.tobytes())) as image:
            if not own and not foreign_space(image) and (image.format, image.mode) != ("TIFF", "LA"):
                return None
            pixels = np.asarray(to_srgb(image))
            return np.ascontiguousarray(pixels[:, :, [2, 1, 0, 3][: pixels.shape[2]]])
    except (CaptureError, MemoryError):
        raise
    except Exception:  # OpenCV may know more, and else says what is wrong
        return None


class VerifiedImage(NamedTuple):
    """What decoding an image told: whether it shows more than one color, and whether it may be transparent."""

    has_content: bool
    has_alpha_channel: bool


def verify_image(path: Path) -> VerifiedImage:
    """Decode every byte of an image file once. Raises `CaptureError` naming a file that is truncated or damaged.

    OpenCV fills the missing part of a truncated file with gray and says nothing; Pillow is strict. JPEGs are
    decoded at 1/8 size, which still reads the whole stream, several times faster.
    """
    try:
        if is_raw(path):
            return VerifiedImage(bool(np.ptp(develop(path))), False)
        with open_image(path) as image:
            if image.format in JPEGS and not has_end(path, image):
                return _verify_without_end(path)
            if image.format in JPEGS:
                image.draft(image.mode, (max(1, image.width // 8), max(1, image.height // 8)))
            image.load()
            ranges = [_extremes(image, band) for band in image.getbands() if band != "A"]
            transparent = has_alpha_channel(image)
    except PermissionError as error:
        raise CaptureError(f"{path}: {refusal(path, error)}") from None
    except Exception as error:  # any complaint of a decoder is what we came for
        raise CaptureError(f"{path}: {error}") from None
    return VerifiedImage(any(high != low for low, high in ranges), transparent)


def _verify_without_end(path: Path) -> VerifiedImage:
    """Of a JPEG without an end marker: as `verify_image`, where nothing but the marker is missing."""
    if not lacks_only_end(path):
        raise CaptureError("it is cut off")
    with Image.open(with_end(path)) as image:
        image.draft(image.mode, (max(1, image.width // 8), max(1, image.height // 8)))
        return VerifiedImage(
            any(high != low for low, high in (_extremes(image, band) for band in image.getbands())), False
        )


def _extremes(image: Image.Image, band: str) -> tuple[float, float]:
    """The smallest and the largest value of a band; Pillow's own way knows no 16 bits."""
    if len(image.getbands()) == 1:
        values = np.asarray(image)
        return values.min(), values.max()
    return image.getchannel(band).getextrema()  # type: ignore[return-value]


def _why_nothing(mask: Path, pixels: np.ndarray) -> str:
    """Why a mask of these pixels keeps nothing, and what to do."""
    if mask.name.lower().startswith(DYNAMIC_MASK):
        return f"Black is kept of masks that are named {DYNAMIC_MASK}..., and none of it is black. Turn it round"
    light = _lightness(mask, pixels)
    if pixels.ndim == 3 and pixels.shape[2] == 4 and _kept(light).any():
        return "It is transparent where it is white. Save it without transparency"
    brightest = int(light.max())
    hint = "Scale its values to 0 and 255" if brightest else "Turn it round if it is inverted"
    return f"White is kept, and the brightest value here is {brightest} of 255. {hint}"


def gray_fraction(mask: Path) -> float:
    """The share of a mask that is left out though it is not black; 0 where black is kept, where values are 0 and 1, and
    where transparency says what is kept. Raises `CaptureError` for a mask that cannot be decoded."""
    return _gray(mask, _decode(mask))


def _gray(mask: Path, pixels: np.ndarray) -> float:
    """As `gray_fraction`, of a mask's pixels as they are stored."""
    if mask.name.lower().startswith(DYNAMIC_MASK) or (pixels.ndim == 3 and pixels.shape[2] == 4):
        return 0.0
    light = _lightness(mask, pixels)
    return float(((light > 0) & ~_kept(light)).mean())


def gray_masks_note(shares: Mapping[Path, float]) -> list[str]:
    """What to say of masks by their `gray_fraction`: nothing, unless one is more than compression leaves."""
    gray = {mask: share for mask, share in shares.items() if share > MAX_GRAY_FRACTION}
    if not gray:
        return []
    worst = max(gray, key=lambda mask: gray[mask])
    return [
        f"{worst}: {gray[worst]:.0%} of the mask is gray, from 1 to {MASK_THRESHOLD - 1} of 255, and left out like "
        f"black ({len(gray)} of {len(shares)} masks looked at are so). Other programs keep all that is not black: "
        "where that is meant, write 255 there."
    ]


def masked_shares(photograph: Path, mask: Path | None, may_be_transparent: bool) -> tuple[float, float]:
    """The share of a photograph that its mask and its transparency keep, 1 without either, and the `gray_fraction` of
    its mask, 0 without one; each file is decoded once.

    Raises `CaptureError` where nothing is kept.
    """
    keep = opaque = decode_image(photograph)[1] if may_be_transparent else None
    gray = 0.0
    if mask is not None:
        pixels = _decode(mask)
        kept, gray = _mask(mask, pixels), _gray(mask, pixels)
        if not kept.any():
            raise CaptureError(
                f"{mask}: leaves nothing of its photograph. {_why_nothing(mask, pixels)}, or remove the photograph "
                "from the model."
            )
        keep = kept if opaque is None else _resampled(kept, *opaque.shape[::-1]) & opaque
    if keep is not None and not keep.any():
        raise CaptureError(
            f"{photograph}: is transparent everywhere that it is not masked; nothing of it is left. Remove its "
            "alpha channel, or the photograph from the model."
        )
    return 1.0 if keep is None else float(keep.mean()), gray
