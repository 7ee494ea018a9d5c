"""The paper's own numbers, to stand beside what is measured. Quoted, never computed.

The paper contradicts itself about the full method on Residence: PSNR is 24.03 in Table I and as the default of
Table IV, 24.01 in Table II, where "Full" equals the row of 4 blocks of Table III, while the setup names eight blocks,
whose row says 24.04. In Table IV T_low = 0.30 and beta_g = 3.0 beat the defaults that are printed in bold.
"""

from __future__ import annotations

MetricTriple = tuple[float, float, float]

METRIC_COLUMNS = ("PSNR", "SSIM", "LPIPS")
PAPER_CONTRADICTIONS = (
    "The full method on Residence is quoted with PSNR 24.03 (Tables I and IV), 24.01 (Table II, equal to the row of 4 "
    "blocks of Table III) and 24.04 (Table III, 8 blocks, the number that the setup names).",
    "In Table IV, T_low = 0.30 (24.06) and β_g = 3.0 (24.08) are above the defaults (24.03) that are printed in bold; "
    "of SSIM, β_g = 0.5 (0.8471) is the best.",
)

_TABLE1: dict[str, dict[str, MetricTriple]] = {
    "Switch-NeRF": {
        "residence": (22.57, 0.654, 0.352), "sci-art": (26.51, 0.795, 0.271), "rubble": (24.31, 0.562, 0.478),
        "building": (21.54, 0.579, 0.397),
    },
    "3DGS": {
        "residence": (21.94, 0.764, 0.279), "sci-art": (21.85, 0.787, 0.311), "rubble": (25.20, 0.757, 0.318),
        "building": (22.04, 0.728, 0.332), "block-all": (27.36, 0.818, 0.237),
    },
    "Scaffold-GS": {
        "residence": (22.00, 0.761, 0.286), "sci-art": (22.56, 0.796, 0.302), "rubble": (24.83, 0.721, 0.353),
        "building": (22.42, 0.719, 0.335), "block-all": (27.13, 0.868, 0.210),
    },
    "DOGS": {
        "residence": (21.94, 0.740, 0.244), "sci-art": (24.42, 0.804, 0.219), "rubble": (25.78, 0.765, 0.257),
        "building": (22.73, 0.759, 0.214), "block-all": (28.58, 0.847, 0.219),
    },
    "Octree-GS": {
        "residence": (22.29, 0.762, 0.288), "sci-art": (23.38, 0.828, 0.240), "rubble": (25.34, 0.763, 0.299),
        "building": (23.66, 0.776, 0.267), "block-all": (26.41, 0.814, 0.282),
    },
    "HUG": {
        "residence": (22.33, 0.813, 0.207), "sci-art": (21.83, 0.846, 0.204), "rubble": (26.42, 0.839, 0.197),
        "building": (22.35, 0.792, 0.228), "block-all": (28.02, 0.883, 0.142),
    },
    "Momentum-GS": {
        "residence": (23.37, 0.828, 0.196), "sci-art": (25.06, 0.860, 0.204), "rubble": (26.66, 0.826, 0.200),
        "building": (23.65, 0.813, 0.194), "block-all": (29.11, 0.881, 0.180),
    },
    "MixGS": {
        "residence": (23.39, 0.815, 0.219), "sci-art": (24.20, 0.856, 0.220), "rubble": (26.66, 0.792, 0.267),
        "building": (23.03, 0.771, 0.261),
    },
    "VDGS": {
        "residence": (24.03, 0.845, 0.188), "sci-art": (26.94, 0.870, 0.180), "rubble": (26.67, 0.852, 0.188),
        "building": (23.73, 0.800, 0.208), "block-all": (28.74, 0.863, 0.204),
    },
}  # fmt: skip


def _residence(rows: dict[str, MetricTriple]) -> dict[str, dict[str, MetricTriple]]:
    return {name: {"residence": row} for name, row in rows.items()}


_TABLE2 = _residence(
    {
        "(a) Baseline": (22.64, 0.801, 0.233),
        "(b) w/o Blocking": (23.39, 0.827, 0.209),
        "(c) w/o Anchor Generation": (23.56, 0.833, 0.202),
        "(d) Full": (24.01, 0.845, 0.188),
    }
)
_TABLE3 = _residence(
    {
        "1 block": (23.39, 0.827, 0.209), "2 blocks": (23.63, 0.835, 0.196), "4 blocks": (24.01, 0.845, 0.188),
        "8 blocks": (24.04, 0.846, 0.187), "16 blocks": (24.05, 0.846, 0.187),
    }
)  # fmt: skip
_TABLE4 = _residence(
    {
        "λ_vis = 0": (23.51, 0.8353, 0.1988), "λ_vis = 0.5": (23.99, 0.8433, 0.1918),
        "λ_vis = 1": (24.03, 0.8453, 0.1884), "λ_vis = 1.3": (23.80, 0.8381, 0.1928),
        "T_low = 0.05": (23.72, 0.8357, 0.1989), "T_low = 0.15": (23.94, 0.8429, 0.1913),
        "T_low = 0.2": (24.03, 0.8453, 0.1884), "T_low = 0.3": (24.06, 0.8456, 0.1883),
        "β_g = 0.5": (23.88, 0.8471, 0.1927), "β_g = 1.5": (23.92, 0.8421, 0.1906),
        "β_g = 2": (24.03, 0.8453, 0.1884), "β_g = 3": (24.08, 0.8465, 0.1880),
        "γ = 0.8": (23.98, 0.8445, 0.1885), "γ = 0.9": (24.03, 0.8453, 0.1884), "γ = 0.95": (23.94, 0.8443, 0.1888),
    }
)  # fmt: skip

#: Per table: row -> scene -> (PSNR, SSIM, LPIPS) after color correction, A100.
PAPER_NUMBERS: dict[str, dict[str, dict[str, MetricTriple]]] = {
    "table1": _TABLE1, "table2": _TABLE2, "toy": _TABLE2, "table3": _TABLE3, "table4": _TABLE4,
}  # fmt: skip
PAPER_EFFICIENCY = (
    "Residence, 8 blocks: 1.48 h for the blocks on 8 GPUs in parallel (11.85 GPU-hours), about 5.4 GB peak memory a "
    "block, merged model 847 MB, 42.96 frames per second; coarse stage of 100 000 iterations about 5 h (A100 40 GB).",
)
