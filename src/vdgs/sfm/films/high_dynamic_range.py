"""Pictures of HDR films (HLG and PQ of ITU-R BT.2100) in the range and colors of sRGB."""

from __future__ import annotations

import numpy as np
from jaxtyping import UInt8, UInt16

#: FFmpeg's numbers of the transfer functions of HDR.
HDR_TRANSFERS = {16: "PQ", 18: "HLG"}
_PQ = 16
#: Luminance in cd/m2 of a white surface, which becomes white (ITU-R BT.2408), and of the display that HLG is meant for.
WHITE_NITS, HLG_NITS = 203.0, 1000.0
#: Constants of BT.2100: HLG's curve and system gamma, PQ's curve, luminance of BT.2020's primaries.
_A, _B, _C, _GAMMA = 0.17883277, 0.28466892, 0.55991073, 1.2
_M1, _M2, _C1, _C2, _C3 = 0.1593017578125, 78.84375, 0.8359375, 18.8515625, 18.6875
_LUMINANCE = np.array([0.2627, 0.6780, 0.0593], np.float32)
_BT709_FROM_BT2020 = np.array(
    [[1.6605, -0.5876, -0.0728], [-0.1246, 1.1329, -0.0083], [-0.0182, -0.1006, 1.1187]], np.float32
)


def to_standard_range(
    image: UInt16[np.ndarray, "h w 3"], transfer: int, *, wide_gamut: bool = True
) -> UInt8[np.ndarray, "h w 3"]:
    """sRGB of an HDR picture: what is brighter than a white surface becomes white."""
    signal = image.astype(np.float32) / 65535
    light = (_from_pq(signal) if transfer == _PQ else _from_hlg(signal)) / WHITE_NITS
    if wide_gamut:
        light = light @ _BT709_FROM_BT2020.T
    light = light.clip(0, 1)
    srgb = np.where(light <= 0.0031308, 12.92 * light, 1.055 * light ** (1 / 2.4) - 0.055)
    return (srgb * 255 + 0.5).astype(np.uint8)


def _from_hlg(signal: np.ndarray) -> np.ndarray:
    """Luminance on the display in cd/m2."""
    scene = np.where(signal <= 0.5, signal**2 / 3, (np.exp((signal - _C) / _A) + _B) / 12)
    return HLG_NITS * scene * np.maximum(scene @ _LUMINANCE, 1e-6)[..., None] ** (_GAMMA - 1)


def _from_pq(signal: np.ndarray) -> np.ndarray:
    """Luminance in cd/m2."""
    root = signal ** (1 / _M2)
    return 10_000 * (np.maximum(root - _C1, 0) / (_C2 - _C3 * root)) ** (1 / _M1)
