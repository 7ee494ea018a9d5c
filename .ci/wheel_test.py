"""Tests an installed wheel without checkout and compiler: the doctor, and a toy run to its report and a PLY."""

from __future__ import annotations

import subprocess
import sys
import tempfile
from pathlib import Path

SHORT_RUN = ("--preset", "laptop", "--iterations", "30", "--blocks", "2", "--block.iterations", "10", "--no-ortho")


def vdgs(*arguments: str) -> None:
    print("vdgs", *arguments, flush=True)
    subprocess.run([sys.executable, "-m", "vdgs", *arguments], check=True)


def main() -> None:
    vdgs("doctor")
    with tempfile.TemporaryDirectory() as folder:
        capture, run = f"{folder}/capture", f"{folder}/run"
        vdgs("synth", capture, "--size", "toy")
        vdgs("run", capture, "--output", run, *SHORT_RUN)
        vdgs("export", run, "--output", f"{folder}/scene.ply")
        for name in (f"{run}/report.html", f"{folder}/scene.ply"):
            if not Path(name).is_file():
                sys.exit(f"{name} was not written")


if __name__ == "__main__":
    main()
