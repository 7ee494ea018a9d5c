"""Why a run of a generated capture is no better: aliasing of its photographs, too few views, or the model itself.

    vdgs synth city --size city --images 600 --width 320 --height 240 --samples-per-pixel 1 --truth
    vdgs run city --preset laptop --blocks 8 --iterations 12000 --output run
    python -m experiments.reports.analyses.ceiling run [--views 75]

The capture is built again from the options in its capture.md, and its test views are drawn with 32 samples per pixel:
what a picture without aliasing looks like. PSNR of that against the photographs bounds what any model can reach on
them. PSNR of the models is printed on training views (what is not learned there is the model's doing, not the lack of
views), on test views against the photographs and against the pictures without aliasing, and by true V.
"""

from __future__ import annotations

import argparse
import re
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from pathlib import Path

import numpy as np
import torch
from experiments.microbench.machine import describe
from PIL import Image

from vdgs.captures.capture import View
from vdgs.model.render import render
from vdgs.runs.opening import open_run
from vdgs.synth.lighting import sky_map
from vdgs.synth.photography import photograph
from vdgs.synth.town import build_town
from vdgs.synth.tracing import Tracer
from vdgs.synth.truth import load_truth

#: Samples per pixel of a picture without aliasing.
SAMPLES = 32
#: Groups by true V: from, below.
GROUPS = ((0, 1), (1, 2), (2, 3), (3, 5), (5, 10), (10, 20), (20, 10_000))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("run", type=Path)
    parser.add_argument("--views", type=int, default=75, help="training and test views to look at, evenly chosen")
    arguments = parser.parse_args()
    runs = {name: open_run(arguments.run, name) for name in ("coarse", "merged")}
    capture = runs["merged"].capture
    test, train = (some(views, arguments.views) for views in (capture.test_views, capture.train_views))
    photographs, smooth = [picture(view) for view in test], without_aliasing(capture.root, test)
    truth = load_truth(capture.root)
    seen = np.concatenate([truth.visibility_map(view).ravel() for view in test])
    print(
        describe(),
        f"{len(test)} test views, {len(train)} training views; median true V {np.nanmedian(seen):g}\n",
        sep="\n",
    )
    errors = {f"{SAMPLES} samples": squares(smooth, photographs)}
    for name, run in runs.items():
        learned = squares([drawn(run, view) for view in train], [picture(view) for view in train])
        pictures = [drawn(run, view) for view in test]
        errors[name] = squares(pictures, photographs)
        print(
            f"{name:12} {psnr(learned):.2f} dB on training views, {psnr(errors[name]):.2f} on test views, "
            f"{psnr(squares(pictures, smooth)):.2f} against pictures with {SAMPLES} samples per pixel"
        )
    print(f"{SAMPLES} samples   {psnr(errors[f'{SAMPLES} samples']):.2f} dB on test views: what aliasing leaves\n")
    print(f"{'true V':>10} {'pixels':>7}", *(f"{name:>12}" for name in errors))
    for low, high in GROUPS:
        group = (seen >= low) & (seen < high)
        if group.any():
            label = f"{low}" if high == low + 1 else f"{low} to {high - 1}"
            print(f"{label:>10} {group.mean():>7.1%}", *(f"{psnr(error[group]):>12.2f}" for error in errors.values()))


def some(views: list[View], count: int) -> list[View]:
    """At most `count` of them, evenly chosen."""
    return [views[k] for k in np.unique(np.linspace(0, len(views) - 1, min(count, len(views))).astype(int))]


def picture(view: View) -> np.ndarray:
    """A photograph, [h, w, 3] uint8."""
    return np.asarray(Image.open(view.image_path).convert("RGB"))


def drawn(run, view: View) -> np.ndarray:
    """A view as the model draws it, [h, w, 3] uint8."""
    with torch.inference_mode():
        image = render(run.model, view.camera).image
    return (image.clamp(0, 1) * 255 + 0.5).to(torch.uint8).numpy()


def without_aliasing(capture: Path, views: list[View]) -> list[np.ndarray]:
    """The true pictures of views, with many samples per pixel and the exposure of each."""
    note = (capture / "capture.md").read_text(encoding="utf-8")
    seed, extent = (float(re.search(rf"^- {name}: (.*)$", note, re.M).group(1)) for name in ("seed", "extent_m"))
    with np.load(capture / "truth" / "cameras.npz", allow_pickle=False) as stored:
        gains = dict(zip(stored["names"].tolist(), stored["gains"], strict=True))
        # The capture has its own ground frame; the town stands where it was built.
        poses = dict(zip(stored["names"].tolist(), stored["camera_from_world"], strict=True))
    town = build_town(int(seed), extent)
    tracer = Tracer(town.mesh)
    with ThreadPoolExecutor(2) as pool:
        sky = sky_map(tracer, town.terrain, town.zones, extent / 2 + 40, pool)

        def take(view: View) -> np.ndarray:
            camera = replace(view.camera, camera_from_world=poses[view.name])
            return photograph(town, tracer, sky, camera, SAMPLES, gains[view.name])

        return list(pool.map(take, views))


def squares(of: list[np.ndarray], to: list[np.ndarray]) -> np.ndarray:
    """Squared error of all pixels, mean over channels, [pixels]."""
    pairs = zip(of, to, strict=True)
    return np.concatenate([((a.astype(np.float32) - b) ** 2).mean(-1).ravel() for a, b in pairs])


def psnr(errors: np.ndarray) -> float:
    """In dB, of the mean over all pixels at once."""
    return float(10 * np.log10(255**2 / errors.mean()))


if __name__ == "__main__":
    main()
