"""Write the scene of a run for other programs, on a server without a screen.

python examples/07_export_on_a_server.py RUN OUTPUT
"""

import sys
from pathlib import Path

import vdgs

#: A file for each kind of reader; the ending says what is written.
FILES = {
    "scene.ply": {"sh_degree": 3},  # the PLY of 3DGS: viewers, gsplat, Blender
    "scene.spz": {"sh_degree": 1},  # a tenth of it, for the web
    "scene.points.ply": {},  # points with colors: CloudCompare, MeshLab
}


def main(run_folder: str, output: str) -> None:
    run, folder = vdgs.open_run(run_folder), Path(output)
    folder.mkdir(parents=True, exist_ok=True)
    for name, options in FILES.items():
        vdgs.export(run, folder / name, **options)
        print(f"{folder / name}: {(folder / name).stat().st_size / 1e6:.2f} MB")
    # `program` turns the axes so that the scene stands upright there, and refuses files that it does not open.
    vdgs.export(run, folder / "supersplat.compressed.ply", program="supersplat")


if __name__ == "__main__":
    main(*sys.argv[1:])
